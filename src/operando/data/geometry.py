"""Geometry: node coordinates, lines and faces for drawing and interpolation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import frozen
from operando.data.provenance import Provenance
from operando.dof import Dof
from operando.errors import DataError


@dataclass(frozen=True)
class Geometry:
    """Nodes with coordinates [m], lines and faces between them.

    Parameters
    ----------
    nodes : tuple of int
        Node numbers, each once.
    coordinates : (n_nodes, 3) array
        x, y, z [m].
    lines : tuple of tuple of int
        Polylines through node numbers.
    faces : tuple of tuple of int
        Triangles and quadrilaterals of node numbers.
    name : str
        What it is, as the file says.
    unit_known : bool
        Whether the unit of the coordinates was stated; else they are taken as metres.
    provenance : Provenance, optional
        Where it came from.
    directions : dict
        DOF in its positive sense ("5+a", "7+X") → unit vector, for those that are no axes of the coordinates.
    """

    nodes: tuple[int, ...]
    coordinates: NDArray[np.float64]
    lines: tuple[tuple[int, ...], ...] = ()
    faces: tuple[tuple[int, ...], ...] = ()
    name: str = ""
    unit_known: bool = True
    provenance: Provenance = field(default_factory=Provenance)
    directions: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", tuple(int(n) for n in self.nodes))
        object.__setattr__(self, "coordinates", frozen(self.coordinates, float, 2, "coordinates"))
        if self.coordinates.shape != (len(self.nodes), 3):
            raise DataError(f"{len(self.nodes)} nodes but coordinates of shape {self.coordinates.shape}")
        if len(set(self.nodes)) != len(self.nodes):
            raise DataError("a node number appears twice in the geometry")

    def position(self, node: int) -> NDArray[np.float64] | None:
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
    along z."""
    vector = directions.get(str(dof.unsigned), _AXIS_VECTORS.get(dof.axis))
    return None if vector is None else dof.sign * np.asarray(vector, float)


def node_motion(dofs: Sequence[Dof], values: NDArray[Any], directions: Mapping[str, Sequence[float]]) -> dict[int, NDArray[Any]]:
    """Motion (3, n_modes) of each measured node, from its values along the measured directions.

    Each measured value is the projection of the node's motion on its direction: three independent directions give the motion, fewer the
    part of it they see (the shortest motion that has these projections).

    Parameters
    ----------
    dofs : sequence of Dof
    values : (n_dofs, n_modes) array
    directions : mapping
        As ``Geometry.directions``.
    """
    rows: dict[int, list[tuple[NDArray[np.float64], int]]] = {}
    for i, dof in enumerate(dofs):
        vector = direction_of(dof, directions)
        if vector is not None:
            rows.setdefault(dof.node, []).append((vector, i))
    out = {}
    for node, seen in rows.items():
        matrix = np.array([vector for vector, _ in seen])
        out[node] = np.linalg.pinv(matrix, rcond=LEAST_INDEPENDENT) @ values[[i for _, i in seen]]
    return out
