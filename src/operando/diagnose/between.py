"""Places between sensors: an effect where nothing was measured, found through what it does at the sensors.

The shapes at such a place are not known, only that they lie near what the neighbouring sensors suggest. They become further DOFs of
the idle model with a wide prior; an effect there is fitted together with them, and the place is the one whose fitted shapes stay
nearest to what its neighbours suggest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.predict import Term
from operando.diagnose.problem import Problem, Tried, choose, step
from operando.diagnose.search import Search
from operando.diagnose.sets import SELECT
from operando.dof import Dof, split_node
from operando.effects import catalogue, spline_weights

Array = NDArray[Any]

REACH = 1.7
"""Two sensors are neighbours where they are no farther apart than this many times the way to the nearest of the same axis."""

MOST_PLACES = 24

SUGGESTED, AT_LEAST = 0.25, 0.05
"""Standard deviation of a shape value between two sensors, over the root mean square of theirs, and over that of the whole shape."""

EXPLAINS, WIDENED = 2.0, 2.5
"""A place between sensors is told where it brings the selection misfit below this, without its shapes leaving what the neighbours
suggest by more than this many standard deviations on average."""

BETTER, BETTER_ALONE = 0.18, 0.05
"""… and below this part of what the best measured place leaves; with one reference even measured places are known poorly."""


@dataclass(frozen=True)
class Middle:
    """A place half-way between two sensors of one axis.

    Parameters
    ----------
    position : (float, float, float)
        [m].
    axis : str
    ends : (int, int)
        Rows of the two sensors.
    weights : (n_dofs,) array
        What the sensors suggest for its displacement.
    doubt : (n_dofs,) array
        Weights of another suggestion; their difference tells what either is worth.
    """

    position: tuple[float, float, float]
    axis: str
    ends: tuple[int, int]
    weights: Array
    doubt: Array


def middles(idle: ModalModel, geometry: Geometry) -> list[Middle]:
    """Places half-way between neighbouring sensors that measure the same axis."""
    out: list[tuple[float, Middle]] = []
    at = {i: p for i, d in enumerate(idle.dofs) for p in [geometry.position(d.node)] if p is not None}
    for axis in ("X", "Y", "Z"):
        rows = [i for i in at if idle.dofs[i].axis == axis]
        if len(rows) < 2:
            continue
        points = np.array([at[i] for i in rows])
        ways = np.linalg.norm(points[:, None] - points[None], axis=2)
        np.fill_diagonal(ways, np.inf)
        nearest = ways.min(axis=1)
        for a, b in combinations(range(len(rows)), 2):
            if ways[a, b] > REACH * max(nearest[a], nearest[b]) or not ways[a, b] > 0:
                continue
            middle = 0.5 * (points[a] + points[b])
            # No other sensor of this axis between the two.
            others = [c for c in range(len(rows)) if c not in (a, b)]
            if any(np.linalg.norm(points[c] - middle) < 0.45 * ways[a, b] for c in others):
                continue
            linear = np.zeros(len(idle.dofs))
            for c in (a, b):
                linear[rows[c]] = 0.5 * idle.dofs[rows[c]].sign
            along = _on_line(points, a, b)
            weights = linear.copy()
            if len(along) >= 4:
                weights[:] = 0
                spline, _ = spline_weights(points[along], middle[None])
                weights[[rows[c] for c in along]] = spline[0] * np.array([idle.dofs[rows[c]].sign for c in along])
            place = (float(middle[0]), float(middle[1]), float(middle[2]))
            out.append((float(ways[a, b]), Middle(place, axis, (rows[a], rows[b]), weights, linear)))
    out.sort(key=lambda item: item[0])
    return [m for _, m in out[:MOST_PLACES]]


def _on_line(points: Array, a: int, b: int) -> list[int]:
    """Points on the line through two of them."""
    along = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
    off = points - points[a]
    off = off - (off @ along)[:, None] * along
    return [int(i) for i in np.flatnonzero(np.linalg.norm(off, axis=1) < 0.02 * np.linalg.norm(points[b] - points[a]))]


def with_middles(idle: ModalModel, geometry: Geometry, places: list[Middle]) -> tuple[ModalModel, Geometry]:
    """The idle model and its geometry with these places as further DOFs."""
    node = max(split_node(n)[1] for n in (*geometry.nodes, *(d.node for d in idle.dofs)))
    dofs = tuple(Dof(node + 1 + i, p.axis, 1) for i, p in enumerate(places))
    weights = np.array([p.weights for p in places])
    shapes = np.asarray(idle.terms.shapes)
    size = np.sqrt(np.mean(shapes**2, axis=0))
    spread = []
    for p in places:
        near = np.sqrt(np.mean(shapes[list(p.ends)] ** 2, axis=0))
        spread.append(np.sqrt((SUGGESTED * near) ** 2 + (AT_LEAST * size) ** 2 + (0.5 * (p.weights - p.doubt) @ shapes) ** 2))
    n, m, more = idle.terms.n, len(idle.dofs), len(places)
    assert idle.covariance is not None
    lift = np.zeros((2 * n + n * (m + more), idle.n_parameters))
    lift[: 2 * n, : 2 * n] = np.eye(2 * n)
    both = np.concatenate([np.eye(m), weights])
    for r in range(n):
        lift[2 * n + r * (m + more) : 2 * n + (r + 1) * (m + more), 2 * n + r * m : 2 * n + (r + 1) * m] = both
    covariance = lift @ idle.covariance @ lift.T
    at = 2 * n + np.arange(n)[None, :] * (m + more) + m + np.arange(more)[:, None]
    covariance[at.ravel(), at.ravel()] += np.array(spread).ravel() ** 2
    wider = idle.with_terms(shapes=np.concatenate([shapes, weights @ shapes]), dofs=(*idle.dofs, *dofs), covariance=covariance, std=None)
    points = np.concatenate([geometry.coordinates, np.array([p.position for p in places])])
    return wider, replace(geometry, nodes=(*geometry.nodes, *(d.node for d in dofs)), coordinates=points)


def between_sensors(problem: Problem, geometry: Geometry | None, found: Search) -> tuple[Problem, Geometry, Search] | None:
    """One effect at a place without a sensor, where that explains what no measured place does.

    Parameters
    ----------
    problem : Problem
    geometry : Geometry or None
        Positions of the sensors.
    found : Search
        What the measured places came to.

    Returns
    -------
    problem : Problem
        With the places as further DOFs.
    geometry : Geometry
    search : Search
    """
    if geometry is None or problem.idle.covariance is None:
        return None
    places = middles(problem.idle, geometry)
    if not places:
        return None
    idle, known = with_middles(problem.idle, geometry, places)
    wanted = {t.kind.kind for t in problem.templates}
    m = len(problem.idle.dofs)
    terms = []
    for name, kind in catalogue().items():
        if name not in wanted or kind.acts != "dynamic_stiffness" or kind.places != 1 or kind.group in ("sensor", "force"):
            continue
        constants = {p.name: float(p.start(problem.templates[0].band_hz)) for p in kind.constants}
        for i, p in enumerate(places):
            row = np.eye(len(idle.dofs))[m + i][None]
            terms.append(Term(kind, (), row, 1, problem.templates[0].band_hz, constants, position=p.position, direction=f"+{p.axis}"))
    wider = Problem(idle, problem.lines, problem.own, terms, problem.say, len(places))
    tried, judged = step(wider, wider.empty())
    if not tried:
        return None
    best = choose(_plausible(tried))
    empty = judged.misfit(SELECT, wider.empty())
    better = BETTER if problem.lines.references.size > 1 else BETTER_ALONE
    if best.selection > EXPLAINS or best.fit.prior.scale > WIDENED or best.selection > better * found.before[-1]:
        return None
    return wider, known, Search([wider.empty(), best.fit], [(best, tried)], [empty, best.selection], tried, 1.0)


def _plausible(tried: list[Tried]) -> list[Tried]:
    """Of the candidates that do about as well the one whose shapes had to move least comes first."""
    good = [t for t in tried if t.selection < max(1.5 * tried[0].selection, 1.0)]
    good.sort(key=lambda t: t.fit.prior.scale**2 * float(t.fit.z @ t.fit.z) + t.term.size)
    first = good[0]
    return [first, *(t for t in tried if t is not first and t.term.position == first.term.position)]
