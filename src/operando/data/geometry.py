"""Geometry: node coordinates, lines and faces for drawing and interpolation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent, frozen
from operando.data.declared import check_fields, listed
from operando.data.objects import Noun, counted, names_text, plots
from operando.data.provenance import Provenance
from operando.dof import Dof, Node, node_label, parse_dofs, split_node
from operando.errors import DataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def _nodes(given: Any) -> Any:
    """Nodes with their labels; what lists none is left for :func:`check_fields` to refuse."""
    nodes = listed(given)
    return tuple(node_label(*split_node(n)) for n in nodes) if isinstance(nodes, tuple) else nodes


@dataclass(frozen=True, eq=False)
class CoordinateSystem(ByContent):
    """A local coordinate system, as a geometry file defines it.

    Parameters
    ----------
    number : int
        As nodes refer to it; 0 is the global system and needs no definition.
    kind : {0, 1, 2}
        Cartesian, cylindrical, spherical.
    origin : (3,) array
        In global Cartesian coordinates [m].
    axes : (3, 3) array
        Its x, y, z axes as rows of unit vectors in global Cartesian coordinates.
    name : str
    color : int
    """

    number: int
    kind: int
    origin: NDArray[np.float64]
    axes: NDArray[np.float64]
    name: str = ""
    color: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", frozen(self.origin, float, 1, "origin"))
        object.__setattr__(self, "axes", frozen(self.axes, float, 2, "axes"))
        check_fields(self)
        if self.origin.shape != (3,) or self.axes.shape != (3, 3):
            raise DataError(f"coordinate system {self.number}: origin {self.origin.shape} and axes {self.axes.shape}, not (3,) and (3, 3)")

    @property
    def has_global_axes(self) -> bool:
        """Whether its directions are the global ones (to the six digits of the older formats)."""
        return self.kind == 0 and bool(np.allclose(self.axes, np.eye(3), atol=2e-5))


@dataclass(frozen=True)
class Appearance:
    """Names and colours (numbers of the UFF palette) of what a geometry draws, as its file gives them.

    Parameters
    ----------
    node_colors : dict
        Node → colour.
    line_names, line_colors : tuple
        One a line of the geometry, or empty.
    face_colors : tuple
        One a face of the geometry, or empty.
    """

    node_colors: dict[Node, int] = field(default_factory=dict)
    line_names: tuple[str, ...] = ()
    line_colors: tuple[int, ...] = ()
    face_colors: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, repr=False, eq=False)
class Geometry(Noun):
    """Nodes with coordinates [m], lines and faces between them.

    Parameters
    ----------
    nodes : tuple of int or str
        Nodes, each once: numbers, or ``FRAM:12`` where they are numbered within components.
    coordinates : (n_nodes, 3) array
        x, y, z [m].
    lines : tuple of tuple of int
        Polylines through nodes.
    faces : tuple of tuple of int
        Triangles and quadrilaterals of nodes.
    name : str
        What it is, as the file says.
    unit_known : bool
        Whether the unit of the coordinates was stated; else they are taken as metres.
    provenance : Provenance, optional
        Where it came from.
    directions : dict
        DOF in its positive sense ("5+a", "7+X") → unit vector, for those that are no axes of the coordinates.
    systems : tuple of CoordinateSystem
        Local coordinate systems of the file; the coordinates here are global all the same.
    node_systems : dict
        Node → number of the system its directions are given in, for those whose directions are not global.
    appearance : Appearance
        Names and colours.

    Examples
    --------
    >>> import operando
    >>> operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]], ((1, 2),))
    <Geometry: 2 nodes 1, 2; 1 line, 0 faces; 1 × 0 × 0 m>
    """

    nodes: tuple[Node, ...]
    coordinates: NDArray[np.float64]
    lines: tuple[tuple[Node, ...], ...] = ()
    faces: tuple[tuple[Node, ...], ...] = ()
    name: str = ""
    unit_known: bool = True
    provenance: Provenance = field(default_factory=Provenance)
    directions: dict[str, tuple[float, ...]] = field(default_factory=dict)
    systems: tuple[CoordinateSystem, ...] = ()
    node_systems: dict[Node, int] = field(default_factory=dict)
    appearance: Appearance = field(default_factory=Appearance)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", _nodes(self.nodes))
        object.__setattr__(self, "coordinates", frozen(self.coordinates, float, 2, "coordinates"))
        for part in ("lines", "faces"):
            given = listed(getattr(self, part))
            object.__setattr__(self, part, tuple(map(_nodes, given)) if isinstance(given, tuple) else given)
        object.__setattr__(self, "systems", listed(self.systems))
        check_fields(self)
        if self.coordinates.shape != (len(self.nodes), 3):
            raise DataError(f"{len(self.nodes)} nodes but coordinates of shape {self.coordinates.shape}")
        if not np.all(np.isfinite(self.coordinates)):
            node = self.nodes[int(np.argmin(np.all(np.isfinite(self.coordinates), axis=1)))]
            raise DataError(f"the coordinates of node {node} are no finite numbers", hint="leave nodes out whose position is not known")
        if len(set(self.nodes)) != len(self.nodes):
            raise DataError("a node number appears twice in the geometry")
        shown = self.appearance
        for values, drawn, what in (
            (shown.line_names, self.lines, "line"),
            (shown.line_colors, self.lines, "line"),
            (shown.face_colors, self.faces, "face"),
        ):
            if values and len(values) != len(drawn):
                raise DataError(f"{len(values)} names or colours for {len(drawn)} {what}s of the geometry")

    def with_components(self, dofs: Iterable[Dof]) -> tuple[Geometry, tuple[int, ...]]:
        """The geometry with its bare node numbers as nodes of the components that the DOFs name, as far as that is clear.

        Parameters
        ----------
        dofs : iterable of Dof
            All DOFs measured.

        Returns
        -------
        Geometry
            Itself where no DOF has a component, or its own nodes have them.
        tuple of int
            Numbers that more than one component has: they stay as they are.
        """
        owners: dict[int, set[str]] = {}
        for component, number in {split_node(dof.node) for dof in dofs}:
            owners.setdefault(number, set()).add(component)
        if not any(any(names) for names in owners.values()) or any(isinstance(node, str) for node in self.nodes):
            return self, ()
        unclear = tuple(sorted(n for n in self.nodes if isinstance(n, int) and len(owners.get(n, ())) > 1))
        label: dict[Node, Node] = {
            n: node_label(min(owners[n]), n) for n in self.nodes if isinstance(n, int) and len(owners.get(n, ())) == 1
        }
        new = lambda nodes: tuple(label.get(n, n) for n in nodes)  # noqa: E731
        shown = replace(self.appearance, node_colors={label.get(n, n): color for n, color in self.appearance.node_colors.items()})
        named = replace(
            self, nodes=new(self.nodes), lines=tuple(map(new, self.lines)), faces=tuple(map(new, self.faces)), appearance=shown,
            node_systems={label.get(n, n): system for n, system in self.node_systems.items()},
        )  # fmt: skip
        return named, unclear

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        size = " × ".join(f"{s:.3g}" for s in (np.ptp(self.coordinates, axis=0) if self.nodes else np.zeros(3)))
        return {
            "Name": self.name,
            "Nodes": f"{counted(len(self.nodes), 'node')} {names_text(self.nodes)}" if self.nodes else "no nodes",
            "Drawn": f"{counted(len(self.lines), 'line')}, {counted(len(self.faces), 'face')}",
            "Size": f"{size} m" + ("" if self.unit_known else " (unit not stated, taken as metres)"),
            "Directions": f"{len(self.directions)} directions that are no axes" if self.directions else "",
        }

    def plot(self, axes: Axes | None = None, *, dofs: object = (), names: bool | None = None) -> Axes:
        """Nodes, lines and faces with axes and node names (:func:`operando.plots.plot_geometry`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
            With ``projection="3d"``. Default: of a new figure.
        dofs : DOF labels
            Measured directions, drawn as arrows.
        names : bool, optional
            Write node names; default: with 100 nodes at most.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_geometry(self, axes, dofs=parse_dofs(dofs), names=names)
        return made

    def position(self, node: Node) -> NDArray[np.float64] | None:
        """Coordinates [m] of a node, or None."""
        try:
            return self.coordinates[self.nodes.index(node)]
        except ValueError:
            return None


_AXIS_VECTORS = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0), "": (0.0, 0.0, 1.0)}
LEAST_INDEPENDENT = 0.1
"""A combination of a node's directions is solved for where its singular value exceeds this part of the largest: below, errors of the
measured values would grow more than tenfold; the motion along it is left at zero."""


def direction_of(dof: Dof, directions: Mapping[str, Sequence[float]]) -> NDArray[np.float64] | None:
    """Unit vector (3,) in which a DOF measures, its sign included; None for rotations and directions nobody declared. Scalars measure
    along z.

    Parameters
    ----------
    dof : Dof
        The DOF.
    directions : mapping
        DOF in its positive sense → unit vector, for DOFs that are no axes.

    Returns
    -------
    (3,) array or None

    Examples
    --------
    >>> direction_of(Dof.parse("7-X"), {}).tolist()
    [-1.0, -0.0, -0.0]
    """
    vector = directions.get(str(dof.unsigned), _AXIS_VECTORS.get(dof.axis))
    return None if vector is None else dof.sign * np.asarray(vector, float)


def node_motion(dofs: Sequence[Dof], values: NDArray[Any], directions: Mapping[str, Sequence[float]]) -> dict[Node, NDArray[Any]]:
    """Motion (3, n_modes) of each measured node, from its values along the measured directions.

    Each measured value is the projection of the node's motion on its direction: three independent directions give the motion, fewer the
    part of it they see (the shortest motion that has these projections).

    Parameters
    ----------
    dofs : sequence of Dof
        DOFs of the values.
    values : (n_dofs, n_modes) array
        Values (n_dofs, n_modes).
    directions : mapping
        As ``Geometry.directions``.

    Returns
    -------
    dict
        Node → motion.

    Examples
    --------
    >>> import numpy as np
    >>> motion = node_motion([Dof.parse("7+X"), Dof.parse("7-Z")], np.array([[1.0], [2.0]]), {})
    >>> motion[7].ravel().tolist()
    [1.0, 0.0, -2.0]
    """
    rows: dict[Node, list[tuple[NDArray[np.float64], int]]] = {}
    for i, dof in enumerate(dofs):
        vector = direction_of(dof, directions)
        if vector is not None:
            rows.setdefault(dof.node, []).append((vector, i))
    out = {}
    for node, seen in rows.items():
        matrix = np.array([vector for vector, _ in seen])
        out[node] = np.linalg.pinv(matrix, rcond=LEAST_INDEPENDENT) @ values[[i for _, i in seen]]
    return out
