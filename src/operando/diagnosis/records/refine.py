"""The last word on an accepted law: all of its values moved together, and how far they can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from operando.diagnosis.records.day import Day, powers
from operando.diagnosis.records.fit_laws import RIDGE, law_cost
from operando.diagnosis.records.motion import Motion
from operando.diagnosis.records.place import TOGETHER, Along, Normal, Weighted, solved, summed
from operando.diagnosis.records.run import smoothed_variance
from operando.diagnosis.records.spot import Spot, noise_floor
from operando.diagnosis.records.steps import Tried, change
from operando.structure.force_law import ForceLaw
from operando.structure.modal_space import Real
from operando.threads import each

EASY = 0.01
"""Relative change of a value for a difference quotient."""

TURNS, ENOUGH = 4, 1e-3
"""Gauss–Newton steps at most; relative change that ends them."""

FARTHEST = 0.3
"""Relative change of a value in one step, at most."""

OF_ALL_RUNS = "the values are those that all runs have in common; the figures of the hold-out set are of values from the other lines alone"

LEAST = 0.0015
"""A value is known to this part at best, as the scale of the idle model is."""

SYSTEMATIC, SHARE = 3.0, 0.5
"""Misfit beyond which what is left is the motion's error and not noise; part of what is then left that may lie along the law."""


def free_names(law: ForceLaw) -> list[str]:
    """Values that a fit may move: those above zero."""
    return [n for n in law.values if law.values[n] > 0]


def eased(law: ForceLaw, names: Sequence[str]) -> list[ForceLaw]:
    """The law with each of the values a little larger."""
    return [law.moved(**{n: law.values[n] * (1 + EASY)}) for n in names]


def linearised(law: ForceLaw, motions: Sequence[Motion], names: Sequence[str]) -> Normal:
    """Normal equations of relative changes of the values about the law as it stands, and the cost with it."""

    def part(m: Motion) -> Normal:
        base = m.under(law)
        gram, right, total = m.along.normal(np.stack([base, *((m.under(moved) - base) / EASY for moved in eased(law, names))]))
        # The error is total − base's own part: what a small change of each value would still take away.
        return gram[1:, 1:], right[1:] - gram[1:, 0], total - 2 * float(right[0]) + float(gram[0, 0])

    return summed(each(part, motions))


def refined(tried: Tried) -> Tried:
    """The law with all its values moved together by Gauss–Newton steps on the lines fitted, each with the motion it makes.

    Grids and alternating regressions stop where one value could make up for another. A step counts if it lowers the cost.
    """
    if len(free_names(tried.law)) < 2:
        return tried
    found = _moved(tried, lambda spot: spot.fit)
    return found if found.selection < tried.selection else tried


def of_all_runs(tried: Tried) -> Tried:
    """The law with the values that all lines of all runs have in common: those of the hold-out set count once they had their say.

    At one level two values may make up for each other: by the louder runs the stiffness of a clearance was 7 % too small and its gap 9 %
    too large, which the others know to 1 % (frame 10553). Each line counts by what the law leaves around it: the path of the force to the
    sensor at the location itself is known least, and by noise alone that counts most. A force made in the closed loop keeps its values.
    """
    if _made_in_the_loop(tried):
        return tried
    for _ in range(TURNS):
        before, tried = tried.law, _moved(_by_what_is_left(tried), lambda spot: spot.whole)
        if change(before, tried.law) < ENOUGH:
            break
    return tried


def _made_in_the_loop(tried: Tried) -> bool:
    """Whether the force is that of the closed loop: its values are those of the lines fitted."""
    return any(m.closed for m in tried.spot.whole)


def _by_what_is_left(tried: Tried) -> Tried:
    """All runs with the noise of each line from what the law leaves around it."""

    def weighed(m: Motion) -> Motion:
        along = m.along
        left = along.under(m.beside(tried.law)).decayed() / along.weighted.root
        run = replace(along.run, variance=smoothed_variance(left, noise_floor(along.run), 1.0))
        return replace(m, along=Along.of(Weighted.of(run, along.weighted.raw), along.b, along.h))

    return replace(tried, spot=tried.spot.moving(each(weighed, tried.spot.whole)))


def _moved(tried: Tried, of: Callable[[Spot], Sequence[Motion]]) -> Tried:
    """Gauss–Newton steps of all values on some motions of a spot, each with the motion it makes, as far as they lower the cost."""
    law, spot, names = tried.law, tried.spot, free_names(tried.law)
    best, least = tried, law_cost(law, of(spot))[0]
    for _ in range(TURNS):
        normal = linearised(law, of(spot), names)
        step = solved(normal, 1e-9)
        largest = float(np.max(np.abs(step), initial=0.0))
        step *= min(1.0, FARTHEST / max(largest, 1e-300))
        ends = (stepped(law, names, share * step) for share in (1.0, 0.3))
        better = next((one for one in ends if law_cost(one, of(spot))[0] < normal[2]), None)
        if better is None:
            break
        law, spot = better, spot.settled(better)
        cost = law_cost(law, of(spot))[0]
        if cost < least:
            best, least = Tried.of(spot, law), cost
        if largest < ENOUGH:
            break
    return best


def stepped(law: ForceLaw, names: Sequence[str], step: Real) -> ForceLaw:
    """The law with values changed by a step of their logarithms, inside the bounds of its kind."""
    limits = {p.name: (p.low, p.high) for p in law.definition.parameters}
    values = law.values | {n: law.values[n] * float(np.exp(s)) for n, s in zip(names, step, strict=True)}
    return law.moved(**{n: float(np.clip(v, *limits[n])) if n in limits else v for n, v in values.items()})


def std_of(tried: Tried, day: Day | None = None) -> dict[str, float]:
    """Standard deviations, from three sources that add up, and on another day from gains of sensors and forces.

    The curvature of the chi-square, for errors that stay together over some lines. What is wrong with the motion of the idle model is
    common to all lines of a run, so the curvature does not show it. It differs between runs, for another drive point and level moves the
    location otherwise: the scatter of the values of each run by itself, validation runs included. And where much more is left than
    noise, some of it may lie along the law in all runs alike: a part of what is left over what the law explains.
    """
    law = tried.law
    names = free_names(law)
    motions = tried.spot.fit if _made_in_the_loop(tried) else tried.spot.whole
    gram, _, cost = linearised(law, motions, names)
    without, count = law_cost(None, motions)
    spread = TOGETHER * np.sqrt(np.maximum(np.diag(np.linalg.pinv(gram)) * cost / count, 0))
    scatter = own_values(law, tried.spot.whole, names)
    systematic = SHARE * max(cost - SYSTEMATIC * count, 0.0) / max(without - cost, 1e-300)
    power = spread**2 + scatter**2 + LEAST**2
    if day is not None:
        power = power + of_gains(tried, day, names) ** 2
    relative = np.sqrt(power + systematic)
    return {n: float(law.values[n] * r) for n, r in zip(names, relative, strict=True)}


def of_gains(tried: Tried, day: Day, names: Sequence[str]) -> Real:
    """Relative standard deviations of values that come from gains of motion and force, and from shapes as sensors show them.

    A motion that is shown too large by a part makes a stiffness too small by it and a gap too large: the powers of metre and newton in
    the unit say which. Of the difference of two motions gains show the more, the smaller it is beside these.
    """
    place, b = np.array(tried.spot.place), tried.spot.b
    by_gain, by_shape = np.zeros(place.size), np.zeros((place.size, day.modes.size))
    for m in tried.spot.whole:
        run = m.along.run
        rows = [(k, int(np.flatnonzero(run.rows == row)[0])) for k, row in enumerate(place) if row in run.rows]
        across = sum(b[place[k]] * run.responses[at, run.lines] for k, at in rows) / run.omega**4
        for k, at in rows:
            by_gain[k] += b[place[k]] * float(np.vdot(across, run.responses[at, run.lines]).real)
            by_shape[k] += b[place[k]] * (run.moving[day.modes] @ np.conj(across)).real
    shown = np.sum((day.sensor_std[place] * by_gain) ** 2) + np.sum((day.shown_std[place] * by_shape) ** 2)
    motion = np.sqrt(shown) / max(float(np.sum(by_gain)), 1e-300)
    units = {p.name: p.unit for p in tried.law.definition.parameters}
    of = np.array([powers(units.get(name, "")) for name in names], float).reshape(-1, 2)
    return np.asarray(np.hypot(of[:, 0] * motion, of[:, 1] * day.force_std))


def own_values(law: ForceLaw, motions: Sequence[Motion], names: Sequence[str]) -> Real:
    """Scatter of the values that each run by itself would have, relative, weighted by how well each run knows them.

    A run in which a gap stays open knows nothing of it and counts for nothing.
    """
    weights, moves = [], []
    for gram, right, _ in each(lambda m: linearised(law, [m], names), motions):
        known = np.diag(gram) > 0
        scale = np.sqrt(np.where(known, np.diag(gram), 1.0))
        inverse = np.linalg.inv(gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size)) / np.outer(scale, scale)
        weights.append(np.where(known, 1 / np.diag(inverse), 0.0))
        moves.append(np.clip(inverse @ right, -1, 1))
    w, d = np.array(weights), np.array(moves)
    return np.asarray(np.sqrt(np.sum(w * d**2, axis=0) / np.maximum(np.sum(w, axis=0), 1e-300)))
