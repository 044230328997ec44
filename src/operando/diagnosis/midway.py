"""Places half-way between sensors: nothing was measured there, and the shapes lie near what the neighbouring sensors suggest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry
from operando.diagnosis.criteria import BETWEEN_STD, COMMON_BETWEEN, LEAST_BETWEEN_STD, NEIGHBOURS
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import State
from operando.dof import Dof, split_node
from operando.errors import DataError, DofError
from operando.structure.effects import spline_weights

Array = NDArray[Any]

_MOST = 24  # places, the closest neighbours first
TOGETHER = 2  # unknowns of a place, the first ones, that move all its shapes together
_OFF_MIDDLE = 1 / np.sqrt(48)  # of the way between two sensors: uniformly anywhere nearer to their middle than to the next two


@dataclass(frozen=True)
class Midway:
    """A place [m] half-way between two sensors of one axis, the DOFs ``ends``.

    ``weights`` (DOFs,) are what the sensors suggest for its displacement along the axis; ``doubt`` (DOFs,) those of another suggestion:
    their difference tells what either is worth. ``along`` (DOFs,) is what the weights change by where the place is so far from the middle
    as it may be, in one standard deviation.
    """

    position: tuple[float, float, float]
    axis: str
    ends: tuple[int, int]
    weights: Array
    doubt: Array
    along: Array


def midway(dofs: tuple[Dof, ...], geometry: Geometry) -> list[Midway]:
    """Places half-way between neighbouring sensors that measure the same axis: by a spline where four or more stand on one line."""
    out: list[tuple[float, Midway]] = []
    at = {i: p for i, d in enumerate(dofs) for p in [geometry.position(d.node)] if p is not None}
    for axis in ("X", "Y", "Z"):
        rows = [i for i in at if dofs[i].axis == axis]
        if len(rows) < 2:
            continue
        signs = np.array([dofs[i].sign for i in rows])
        points = np.array([at[i] for i in rows])
        ways = np.linalg.norm(points[:, None] - points[None], axis=2)
        np.fill_diagonal(ways, np.inf)
        nearest = ways.min(axis=1)
        for a, b in combinations(range(len(rows)), 2):
            if ways[a, b] > NEIGHBOURS * max(nearest[a], nearest[b]) or not ways[a, b] > 0:
                continue
            middle = 0.5 * (points[a] + points[b])
            others = [c for c in range(len(rows)) if c not in (a, b)]
            if any(np.linalg.norm(points[c] - middle) < 0.45 * ways[a, b] for c in others):
                continue  # another sensor of this axis stands between the two
            linear = np.zeros(len(dofs))
            linear[[rows[a], rows[b]]] = 0.5 * signs[[a, b]]
            line = _on_line(points, a, b)
            weights, along = linear.copy(), np.zeros(len(dofs))
            along[[rows[a], rows[b]]] = _OFF_MIDDLE * signs[[a, b]] * [-1, 1]
            if len(line) >= 4:
                weights[:] = 0
                weights[[rows[c] for c in line]] = spline_weights(points[line], middle[None])[0] * signs[line]
            place = (float(middle[0]), float(middle[1]), float(middle[2]))
            out.append((float(ways[a, b]), Midway(place, axis, (rows[a], rows[b]), weights, linear, along)))
    out.sort(key=lambda item: item[0])
    return [m for _, m in out[:_MOST]]


def _on_line(points: Array, a: int, b: int) -> list[int]:
    """Points on the line through two of them."""
    along = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
    off = points - points[a]
    off = off - (off @ along)[:, None] * along
    return [int(i) for i in np.flatnonzero(np.linalg.norm(off, axis=1) < 0.02 * np.linalg.norm(points[b] - points[a]))]


def at_position(dofs: tuple[Dof, ...], geometry: Geometry, position: tuple[float, float, float], direction: str) -> Midway:
    """Any place without a sensor: what all sensors of its axis suggest, against the nearer two of them.

    At least two sensors must measure that axis.
    """
    wanted = Dof.parse(f"0{direction}")
    known = {i: geometry.position(d.node) for i, d in enumerate(dofs) if d.axis == wanted.axis}
    rows = [i for i, p in known.items() if p is not None]
    if len(rows) < 2:
        raise DofError(f"fewer than two sensors with a known position measure along {wanted.axis}", hint="name a measured DOF instead")
    points, signs = np.array([known[i] for i in rows]), np.array([dofs[i].sign for i in rows])
    ways = np.linalg.norm(points - np.array(position), axis=1)
    a, b = np.argsort(ways)[:2]
    linear, weights = np.zeros(len(dofs)), np.zeros(len(dofs))
    share = ways[b] / max(ways[a] + ways[b], 1e-300)
    linear[[rows[a], rows[b]]] = np.array([share, 1 - share]) * signs[[a, b]]
    try:
        weights[rows] = spline_weights(points, np.array(position)[None])[0] * signs
    except DataError:  # too few sensors for a spline
        weights = linear.copy()
    return Midway(position, wanted.axis, (rows[a], rows[b]), weights, linear, np.zeros(len(dofs)))


def with_midway(idle: Idle, geometry: Geometry, places: Sequence[Midway] | None = None) -> Idle | None:
    """The idle model with places between sensors as further DOFs (``midway``: where these are); None where there are none.

    What is not known of a shape there is its own, as of any DOF: by how much the suggestions of its neighbours may err. Places are by
    default half-way between all neighbours.
    """
    places = midway(idle.dofs, geometry) if places is None else places
    if not places:
        return None
    node = max(split_node(n)[1] for n in (*geometry.nodes, *(d.node for d in idle.dofs)))
    dofs = [Dof(node + 1 + i, p.axis, 1) for i, p in enumerate(places)]
    weights = np.array([p.weights for p in places])
    phi = weights @ idle.phi

    def unknown(place: Midway, suggested: Array) -> Array:
        """All shapes by where exactly the place is (``TOGETHER``), and by one factor: a member bends in many modes; and each by itself."""
        each = np.diag(shape_spread(place, idle.phi, idle.f, idle.modes))
        return np.column_stack([place.along @ idle.phi, COMMON_BETWEEN[order_of(place) - 1] * suggested, each])

    own = np.array([unknown(place, row) for place, row in zip(places, phi, strict=True)])
    return idle.with_dofs(dofs, weights, phi, own, [p.position for p in places])


def order_of(place: Midway) -> int:
    """Of the polynomials that suggest a shape: 1 for a straight line, 2 for a spline, which the square of a wave's length goes with."""
    return 2 if np.any(place.weights != place.doubt) else 1


def shape_spread(place: Midway, phi: Array, hz: Array, modes: Array) -> Array:
    """Standard deviation of each shape (DOFs, terms) at a place, about what the neighbours suggest, (terms,); ``modes`` are those in band.

    The error of a straight line over a wave of so many sensors goes with the square of their distance over the wave's length, that of a
    spline with its fourth power: in a structure that bends, with the frequency and with its square.
    """
    order = order_of(place)
    # what lies outside the band stands for shapes of many waves, which no neighbour tells
    by_near, by_all = np.ones(hz.size), np.full(hz.size, LEAST_BETWEEN_STD)
    if modes.size:
        waves = (hz[modes] / hz[modes].max()) ** order
        by_near[modes], by_all[modes] = BETWEEN_STD * waves, LEAST_BETWEEN_STD * waves
    near = np.sqrt(np.mean(phi[list(place.ends)] ** 2, axis=0))
    size = np.sqrt(np.mean(phi**2, axis=0))
    apart = 0.5 * (place.weights - place.doubt) @ phi
    return np.asarray(np.sqrt((by_near * near) ** 2 + (by_all * size) ** 2 + apart**2))


def located(geometry: Geometry | None, idle: Idle) -> Geometry | None:
    """The geometry with the places between sensors that an idle model has."""
    places = {i: position for i, position in idle.midway.items() if position is not None}
    if geometry is None or not places:
        return geometry
    nodes = (*geometry.nodes, *(idle.dofs[i].node for i in places))
    return replace(geometry, nodes=nodes, coordinates=np.concatenate([geometry.coordinates, np.array([*places.values()])]))


def between_sensors(state: State, geometry: Geometry | None) -> bool:
    """Whether one effect between two sensors may stand for what was found: for several at these; for one on their sum."""
    if geometry is None:
        return False
    at_ends = (sum(bool({*t.places} & {*place.ends}) for t in state.terms) for place in midway(state.case.dofs, geometry))
    return any(count > 1 for count in at_ends) or on_a_sum(state, geometry)


def on_a_sum(state: State, geometry: Geometry | None) -> bool:
    """Whether an effect acts on the difference of two neighbouring channels of opposite senses.

    The sum of two motions is twice what lies half-way between them: what acts there changes the FRFs like this, and no spring does.
    """
    if geometry is None:
        return False
    dofs = state.case.dofs
    ends = [set(p.ends) for p in midway(dofs, geometry) if dofs[p.ends[0]].sign != dofs[p.ends[1]].sign]
    return any(t.structural and set(t.places) in ends for t in state.terms)
