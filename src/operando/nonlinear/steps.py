"""The steps of the search: laws at the best places, what counts as better, what cannot be told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from operando.effects import kind_of
from operando.nonlinear.hold_out import residual
from operando.nonlinear.laws import LawFit, fit_law, law_cost, linear_law, turned
from operando.nonlinear.outside import Outside, force_columns, look
from operando.nonlinear.run import Real, Run, smoothed_variance
from operando.nonlinear.search import NOISE_FLOOR, WITHIN, Case, Field, Spot, examine, rank_places, settled
from operando.threads import each

IMPROVES, PARSIMONY = 0.10, 0.03
"""An effect lowers the selection misfit by more than this part; within this part of the best the fewest parameters win."""

ALIKE, ALIKE_Z, ALIKE_AT_MOST = 0.02, 2.0, 0.15
KEPT = 4
"""Places at which laws are fitted."""

FINALISTS = 5
ROUGH_ROUNDS = 1
TURNS, FIRST_TURNS, STILL_OPEN = 6, 2, 2.0
"""Turns in which law and motion are brought together; turns for all finalists, and how far from the best one is worth the others."""

FLOOR, NEARLY = 3.0, 0.01
"""Hysteresis takes a walk through time: only where no simpler law comes this near to what any force at the place could do."""

WORTH = 1.2
"""Another place is worth its laws where what no force there explains is less than this part of what the best law so far leaves."""

FAR = 3.0
"""Hysteresis is tried before the others are settled where they leave this part more than it takes."""

UNPROMISING = 0.8
"""A second law at the same place is not settled where it leaves more than this part of the misfit with the motion as seen."""

HOPE = 0.98
"""Part of the misfit without any law above which the best one after its first turns is given up."""

UNSETTLED = 0.02
"""Relative change of a value that is still swinging."""

SAME_PLACE = 0.5
"""A second law at the same place must leave less than this part of the misfit: errors of the motion look like one."""


@dataclass(frozen=True)
class Tried:
    """A law at a place, its motions settled.

    Parameters
    ----------
    spot : Spot
    law : LawFit
    selection, validation : float
        Chi-squares.
    """

    spot: Spot
    law: LawFit
    selection: float
    validation: float

    @property
    def key(self) -> tuple[tuple[int, ...], str, float]:
        """Place, kind, side."""
        return self.spot.place, self.law.kind, self.law.side


@dataclass
class Step:
    """One step of the search: what was tried, and the errors of the runs before it."""

    case: Case
    base_select: float
    base_validation: float
    tried: list[Tried]
    free: float


def search_step(case: Case, kinds: list[str], say: Callable[[str], None] | None, at_first: float | None) -> Step:
    """Rank the places, weigh the lines by what the best one leaves (at first), fit all laws at the best places."""
    ranked = rank_places(case, case.places, say)
    if at_first is None:
        case = weighed(case, ranked[0][1])
        stage = Field.of(case)
        ranked = rank_places(case, [p for _, p in ranked[:8]])
    stage = Field.of(case)
    base_select, base_validation = baseline(stage)
    near = [p for misfit, p in ranked if misfit <= WITHIN * ranked[0][0]][:KEPT]
    singles = [p for _, p in ranked if len(p) == 1]
    if singles and singles[0] not in near:
        near.append(singles[0])
    if say:
        say(f"fit force laws at {'; '.join(place_name(case, p) for p in near)}")

    def compared(places: Sequence[tuple[int, ...]]) -> tuple[list[Spot], list[tuple[float, Spot, LawFit]]]:
        spots = each(lambda p: examine(stage, p), places)
        wanted = [(spot, name, side) for spot in spots for name in kinds if name != "hysteresis" for side in sides(name)]
        return spots, [r for r in each(lambda w: roughly(*w), wanted) if r is not None]

    spots, rough = compared(near[:1])
    # No law leaves less than what no force at its place explains.
    bound = WORTH * min((r[0] for r in rough), default=np.inf)
    misfits = {place: misfit for misfit, place in ranked}
    further = compared([p for p in near[1:] if misfits[p] <= bound])
    spots, rough = spots + further[0], rough + further[1]
    rough.sort(key=lambda r: r[0])
    floor = min((s.free for s in spots), default=1.0)
    simple = max(FLOOR * max(floor, 1.0), NEARLY * (at_first or base_select))
    if at_first is not None and len(case.places) == 1 and rough and base_select <= simple and rough[0][0] > UNPROMISING * base_select:
        return Step(case, base_select, base_validation, [], floor)
    finalists = [(spot, law) for _, spot, law in rough[:FINALISTS]]
    have = {(spot.place, law.kind, law.side) for _, spot, law in rough}
    # Without the mean deflection an even law may seem to act towards the other side.
    finalists += [
        (spot, turned(law)) for spot, law in finalists if len(sides(law.kind)) > 1 and (spot.place, law.kind, -law.side) not in have
    ]
    tried = each(lambda f: settle_law(stage, *f, turns=FIRST_TURNS), finalists)
    walked: list[Tried] = []

    def least() -> float:
        return min((t.selection for t in (*tried, *walked)), default=np.inf)

    def remember() -> None:
        law = fit_law(spots[0].fit, "hysteresis") if "hysteresis" in kinds and not walked and least() > simple else None
        if law is not None:
            walked.append(settle_law(stage, spots[0], law, turns=FIRST_TURNS))

    if least() > FAR * simple:
        remember()
    # Where two turns earn nothing more of them do not.
    close = STILL_OPEN * least() if least() < HOPE * base_select else 0.0
    tried = each(lambda t: settle_law(stage, t.spot, t.law, turns=TURNS - FIRST_TURNS) if t.selection <= close else t, tried)
    remember()
    tried += walked
    tried.sort(key=lambda t: t.selection)
    return Step(case, base_select, base_validation, tried, floor)


def roughly(spot: Spot, kind: str, side: float) -> tuple[float, Spot, LawFit] | None:
    """A law with the motion as measured, and its chi-square on the select set; enough to tell which laws are worth more."""
    law = fit_law([m.coarse for m in spot.fit], kind, side, rounds=ROUGH_ROUNDS)
    if law is None:
        return None
    cost, count = law_cost(law, [m.coarse for m in spot.select])
    return cost / count, spot, law


def sides(kind: str) -> tuple[float, ...]:
    """Both sides for a law that is not odd."""
    return (1.0,) if getattr(kind_of(kind), "odd", True) else (1.0, -1.0)


def place_name(case: Case, place: tuple[int, ...]) -> str:
    """DOFs of a place in words."""
    return ", ".join(str(case.idle.dofs[i]) for i in place)


def settle_law(stage: Field, spot: Spot, law: LawFit, turns: int = TURNS) -> Tried:
    """The law refitted with motions that it makes itself where the data say nothing (the mean among them).

    Motion and values are found in turn. Where one answers the other too strongly they swing about what they seek: so every second turn the
    values go to where the last three point (Aitken's rule, on logarithms).
    """
    best, here = law, spot
    cost, count = law_cost(law, spot.select)
    trail, seen, step = [law], [law], 0.0
    for turn in range(turns):
        moved = settled(here, stage.case, trail[-1])
        again = fit_law(moved.fit, law.kind, law.side, near=trail[-1])
        if again is None:
            break
        new, _ = law_cost(trail[-1], moved.select)
        if turn == 0 or new < cost:
            best, here, cost = trail[-1], moved, new
        elif new > 1.5 * cost and turn > 2:
            break
        step = apart(trail[-1], again)
        trail.append(again)
        seen.append(again)
        if step < 1e-3:
            break
        if len(trail) == 3:
            trail = [towards(*trail)]
    if step > UNSETTLED and turns > FIRST_TURNS and len(law.values) == 1 and len(sides(law.kind)) > 1:
        best, here, cost = narrowed(stage, here, best, cost, seen)
    validation, n = law_cost(best, here.validation)
    return Tried(here, best, cost / count, validation / n)


def narrowed(stage: Field, spot: Spot, law: LawFit, cost: float, seen: Sequence[LawFit]) -> tuple[LawFit, Spot, float]:
    """The one value of a law by golden section between the smallest and the largest seen, each with the motion it makes."""
    (name,) = law.values
    low, high = (float(np.log(f(x.values[name] for x in seen))) for f in (min, max))
    best = (cost, law, spot)
    golden = 0.5 * (np.sqrt(5) - 1)

    def tried(at: float) -> float:
        nonlocal best
        one = replace(law, values={name: float(np.exp(at))})
        moved = settled(spot, stage.case, one)
        own, _ = law_cost(one, moved.fit)
        validation, _ = law_cost(one, moved.select)
        if validation < best[0]:
            best = (validation, one, moved)
        return own

    a, b = high - golden * (high - low), low + golden * (high - low)
    at_a, at_b = tried(a), tried(b)
    while high - low > 1e-3:
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - golden * (high - low)
            at_a = tried(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + golden * (high - low)
            at_b = tried(b)
    return best[1], best[2], best[0]


def apart(one: LawFit, two: LawFit) -> float:
    """Largest relative difference of the values of two laws of one kind."""
    return max(abs(float(np.log(two.values[n] / one.values[n]))) if one.values[n] > 0 and two.values[n] > 0 else 0.0 for n in one.values)


def towards(one: LawFit, two: LawFit, three: LawFit) -> LawFit:
    """Where a row of three laws of one kind points (Aitken's rule), no farther than it went so far."""
    values = {}
    for name, v in three.values.items():
        if min(one.values[name], two.values[name], v) <= 0:
            values[name] = v
            continue
        a, b, c = (float(np.log(law.values[name])) for law in (one, two, three))
        bend = c - 2 * b + a
        there = c - (c - b) ** 2 / bend if abs(bend) > 1e-9 else c
        reach = abs(b - a) + abs(c - b)
        values[name] = float(np.exp(np.clip(there, min(a, b, c) - reach, max(a, b, c) + reach)))
    return replace(three, values=values)


def baseline(stage: Field) -> tuple[float, float]:
    """Chi-squares on the select and hold-out sets of the idle model with what lies outside the band, and nothing at any place."""
    case = stage.case
    none = Outside.none([w.run for w in stage.fit], case.n_dofs, case.band[1])
    nowhere = np.zeros(case.n_dofs)
    zero = [np.zeros(w.run.hz.size, complex) for w in stage.fit]
    seen = look(stage.fit, case.modes, nowhere, case.doubt, none, 2, zero)
    out = []
    for weights in (stage.select, stage.validation):
        cost, count = 0.0, 0
        for w in weights:
            known = next((seen.outside.forces[i] for i, r in enumerate(case.fitted) if r.forces_at == w.run.forces_at), None)
            error = w.run.error if known is None else w.run.error - known @ force_columns(w.run, case.band[1])
            cost += w.with_error(error).ringing()[1]
            count += error.size
        out.append(cost / count)
    return out[0], out[1]


def weighed(case: Case, place: tuple[int, ...]) -> Case:
    """The case with the noise of each line from what no force at the place explains, and the idle model's own variance."""
    stage = Field.of(case)
    spot = examine(stage, place)
    runs = []
    for run, m in zip([*case.fitted, *case.validation], spot.whole, strict=True):
        if run.rows.size == 1:  # a free force explains all of one response: nothing is left that would tell its noise
            runs.append(run)
            continue
        rest = residual(m, m.force) * np.sqrt(run.variance)
        floor = NOISE_FLOOR**2 * np.mean(np.abs(run.responses[:, run.lines]) ** 2, axis=1, keepdims=True)
        q = run.rows.size
        runs.append(replace(run, variance=run.own + smoothed_variance(rest, floor, max((q - 1) / q, 0.5))))
    n = len(case.fitted)
    return replace(case, fitted=tuple(runs[:n]), validation=tuple(runs[n:]))


def choose(tried: Sequence[Tried]) -> Tried:
    """Parsimony: within 3 % of the best the fewest parameters, then one DOF before two."""
    near = [t for t in tried if t.selection <= (1 + PARSIMONY) * tried[0].selection]
    return min(near, key=lambda t: (t.law.size, len(t.spot.place), t.selection))


def improves(step: Step, best: Tried, before: Sequence[Tried] = ()) -> bool:
    """Whether the law lowers the chi-square, and a level-dependent one more than any linear law at the same place could."""
    again = any(set(b.spot.place) == set(best.spot.place) for b in before)
    if not best.selection < (SAME_PLACE if again else 1 - IMPROVES) * step.base_select:
        return False
    if not best.validation < step.base_validation:
        return False
    if not kind_of(best.law.kind).level_dependent:
        return True
    count = sum(m.along.weighted.error.size for m in best.spot.select)
    linear = linear_law(best.spot.fit, best.spot.select) / count
    return best.selection < (1 - IMPROVES) * linear


def with_law(case: Case, best: Tried) -> Case:
    """The case with the restoring force of an accepted law as one more known force."""
    runs: list[Run] = []
    for run, m in zip([*case.fitted, *case.validation], best.spot.whole, strict=True):
        runs.append(run.with_force(case.modes, best.spot.b, m.along.h, -m.spectrum(best.law)))
    n = len(case.fitted)
    return replace(case, fitted=tuple(runs[:n]), validation=tuple(runs[n:]))


def block_misfits(tried: Tried, blocks: int = 18) -> Real:
    """Chi-square on each block of the select set."""
    out = []
    for m in tried.spot.select:
        r = residual(m, m.under(tried.law))
        part = np.minimum(m.along.run.lines * blocks // (m.along.run.lines[-1] + 1), blocks - 1)
        power = np.mean(np.abs(r) ** 2, axis=0)
        out += [float(np.mean(power[part == b])) for b in np.unique(part)]
    return np.array(out)


def alike(best: Tried, other: Tried) -> bool:
    """Whether the select set cannot tell two laws apart."""
    ratio = other.selection / best.selection - 1
    if ratio < ALIKE:
        return True
    if ratio >= ALIKE_AT_MOST:
        return False
    d = block_misfits(other) - block_misfits(best)
    error = float(np.std(d, ddof=1) / np.sqrt(d.size)) if d.size > 1 else np.inf
    return error == 0 or float(np.mean(d)) / error < ALIKE_Z


def nested(a: Tried, b: Tried) -> bool:
    """Whether one kind contains the other at the same place, or one is the other turned round."""
    if set(a.spot.place) != set(b.spot.place):
        return False
    one, two = kind_of(a.law.kind), kind_of(b.law.kind)
    return one.kind in two.contains or two.kind in one.contains or one.kind == two.kind
