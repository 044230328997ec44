"""Where an effect acts: the structure with the locations that a diagnosis found marked on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, direction_of
from operando.dof import Dof, parse_dofs
from operando.errors import DataError, DofError, ObjectError
from operando.plots.diagnosis import DRAWN
from operando.plots.errors import document_of
from operando.plots.shapes import plot_geometry, unclipped
from operando.plots.style import GREY, IDLE, INK, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ARROW = 0.13
"""Length of the arrow along the DOF, as part of the diagonal of the structure."""


class Mark(NamedTuple):
    """One effect on the structure: its name, the points it acts at (n, 3) [m], unit vectors along them (n, 3)."""

    name: str
    points: NDArray[np.float64]
    directions: NDArray[np.float64]


def marks(effects: Sequence[Mapping[str, Any]], geometry: Geometry) -> list[Mark]:
    """Effects of ``diagnosis.json`` that act at nodes or positions of the geometry; of the others there is nothing to mark."""
    found = []
    for effect in effects:
        name = str(effect.get("kind", "effect")).replace("_", " ")
        points, ways = [], []
        try:
            dofs = parse_dofs(tuple(effect.get("location") or ()))
        except DofError:
            continue
        if (at := effect.get("position")) is not None:
            way = direction_of(Dof(0, str(effect.get("direction") or "").lstrip("+") or "Z"), geometry.directions)
            points, ways = [np.asarray(at, float)], [np.zeros(3) if way is None else way]
            name = f"{name} at ({', '.join(f'{v:.3g}' for v in at)}) m"
        elif dofs:
            for dof in dofs:
                if (point := geometry.position(dof.node)) is not None:
                    way = direction_of(dof, geometry.directions)
                    points.append(np.asarray(point, float))
                    ways.append(np.zeros(3) if way is None else way)
            name = f"{name} at {' and '.join(map(str, dofs))}"
        if points:
            found.append(Mark(name, np.array(points), np.array(ways, float)))
    return found


def plot_location(diagnosis: Any, geometry: Geometry, axes: Axes | None = None, *, names: bool | None = None) -> Axes:
    """The structure with each effect found marked at its location; effects that the data do not exclude as grey rings.

    Parameters
    ----------
    diagnosis : Diagnosis or mapping
        A diagnosis, or ``diagnosis.json``.
    geometry : Geometry
        Positions of the nodes.
    axes : matplotlib Axes, optional
        With ``projection="3d"``. Default: of a new figure.
    names : bool, optional
        Write node names; default: with 100 nodes at most.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    DataError
        If no effect has a location on the geometry.
    ObjectError
        If something else than a geometry is given, or the axes are flat.

    Examples
    --------
    >>> import numpy as np, operando
    >>> beam = operando.Geometry((1, 2, 3), np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), ((1, 2, 3),))
    >>> found = {"effects": [{"kind": "ground_spring", "location": ["2+Z"]}]}
    >>> axes = operando.plots.plot_location(found, beam)
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['ground spring at 2+Z']
    """
    if not isinstance(geometry, Geometry):
        raise ObjectError(f"a {type(geometry).__name__} is no geometry", hint="read(file).geometry is one")
    document = document_of(diagnosis, *DRAWN)
    here = marks(document.get("effects") or (), geometry)
    others = marks(document.get("ambiguous_with") or (), geometry)
    if not here and not others:
        raise DataError("no effect of the diagnosis has a location on the geometry", hint="an effect of the whole structure has none")
    axes = plot_geometry(geometry, axes, names=names)
    space: Any = axes
    span = float(np.linalg.norm(np.ptp(np.asarray(geometry.coordinates, float), axis=0))) or 1.0
    with style():
        for k, mark in enumerate(others):
            label = "not excluded: " + "; ".join(dict.fromkeys(m.name for m in others)) if k == 0 and len(others) < 4 else None
            label = f"{len(others)} locations not excluded" if k == 0 and label is None else label
            space.scatter(*mark.points.T, s=90, facecolors="none", edgecolors=GREY, linewidths=1.6, depthshade=False, label=label)
        for mark in here:
            space.scatter(
                *mark.points.T, s=110, color=IDLE, edgecolors=INK, linewidths=0.8, marker="D", depthshade=False, label=mark.name, zorder=30
            )
            space.quiver(
                *mark.points.T, *mark.directions.T, length=ARROW * span, color=IDLE, linewidth=2.2, arrow_length_ratio=0.3, zorder=29
            )
            if len(mark.points) == 2:
                space.plot(*mark.points.T, color=IDLE, lw=2.0, zorder=28)
        unclipped(axes)
        axes.set_title("")
        axes.legend(loc="upper left", fontsize=9)
    return axes
