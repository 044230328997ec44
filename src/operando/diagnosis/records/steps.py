"""The steps of the search: laws at the best places, what counts as better, what cannot be told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from operando.diagnosis.records.case import RecordsCase, Sets
from operando.diagnosis.records.fit_laws import fit_law, law_cost, linear_law, misfit
from operando.diagnosis.records.hold_out import DISCREPANCY
from operando.diagnosis.records.motion import Motion
from operando.diagnosis.records.out_of_band import OutOfBand, force_columns, look
from operando.diagnosis.records.spot import Spot, examine, rank_places, weighed
from operando.structure.effects import kind_of
from operando.structure.force_law import ForceLaw
from operando.structure.modal_space import Complex, Real
from operando.threads import each

IMPROVES, PARSIMONY = 0.10, 0.03
"""An effect lowers the selection misfit by more than this part; within this part of the best the fewest parameters win."""

ALIKE, ALIKE_Z, ALIKE_AT_MOST = 0.02, 2.0, 0.15
KEPT, WITHIN = 4, 40.0
"""Places at which laws are fitted; a place whose remaining misfit is more than this times the best is not worth one."""

FINALISTS = 5
ROUGH_ROUNDS = 1
TURNS, FIRST_TURNS, STILL_OPEN = 6, 2, 2.0
"""Turns in which law and motion are brought together; turns for all finalists, and how far from the best one is worth the others."""

FLOOR, NEARLY = 1.2, DISCREPANCY**2
"""Hysteresis takes a walk through time: only where no simpler law comes this near to what any force at the place could do, or leaves no
more of what there was than the discrepancy that is allowed, 3 % of the responses (contract, ``explained``). With three times as much a
spring of 1.94, where any force leaves 0.96, hid a hysteresis that leaves 1.53 (rotor 10397); with 0.01 of what there was one was not tried
where a spring with a knee leaves 381 of 74 000, any force 0.9 and the hysteresis 38 (frame 10591)."""

WORTH = 1.2
"""Another place is worth its laws where what no force there explains is less than this part of what the best law so far leaves."""

FAR = 3.0
"""Hysteresis is tried before the others are settled where they leave this part more than it takes."""

UNPROMISING = 0.8
"""A second law at the same place is not settled where it leaves more than this part of the misfit with the motion as seen."""

HOPE = 0.98
"""Part of the misfit without any law above which the best one after its first turns is given up."""

SAME_PLACE = 0.5
"""A second law at the same place must leave less than this part of the misfit: errors of the motion look like one."""

UNSETTLED, NARROWEST = 0.02, 1e-3
"""Relative change of a value that is still swinging, and of one that stands."""

BLOCKS = 18
"""Blocks of the band on which two laws are compared."""


@dataclass(frozen=True)
class Tried:
    """A law at a place, its motions settled, with its chi-squares."""

    spot: Spot
    law: ForceLaw
    selection: float
    validation: float

    @classmethod
    def of(cls, spot: Spot, law: ForceLaw) -> Tried:
        """With the chi-squares of the motions as they are."""
        return cls(spot, law, misfit(law, spot.select), misfit(law, spot.validation))

    @property
    def key(self) -> tuple[tuple[int, ...], str, float]:
        """Place, kind, side."""
        return self.spot.place, self.law.kind, self.law.side


@dataclass(frozen=True)
class SearchStep:
    """One step of the search: what was tried, the errors of the runs before it, and the place at which any force law explains most."""

    case: RecordsCase
    place: tuple[int, ...]
    base_select: float
    base_validation: float
    tried: list[Tried]


def search_step(case: RecordsCase, kinds: Sequence[str], say: Callable[[str], None] | None, at_first: float | None) -> SearchStep:
    """Rank the places, weigh the lines by what the best one leaves (at first), fit all laws at the best places."""
    if say:
        say(f"{len(case.places)} locations")
    ranked = rank_places(case, case.places)
    if at_first is None:
        case = weighed(case, ranked[0][1])
        ranked = rank_places(case, case.places)
    sets = Sets.of(case)
    base_select, base_validation = baseline(sets)
    near = [p for misfit, p in ranked if misfit <= WITHIN * ranked[0][0]][:KEPT]
    singles = [p for _, p in ranked if len(p) == 1]
    if singles and singles[0] not in near:
        near.append(singles[0])
    if say:
        say(f"fit force laws at {'; '.join(case.place_name(p) for p in near)}")

    def compared(some: Sequence[Spot]) -> list[tuple[float, Spot, ForceLaw]]:
        wanted = [(spot, name, side) for spot in some for name in kinds if name != "hysteresis" for side in sides(name)]
        return [r for r in each(lambda w: roughly(*w), wanted) if r is not None]

    spots = each(lambda p: examine(sets, p), near)
    rough = compared(spots[:1])
    # No law leaves less than what no force at its place explains.
    bound = WORTH * min((r[0] for r in rough), default=np.inf)
    further = [s for s in spots[1:] if s.free <= bound]
    spots, rough = spots[:1] + further, sorted(rough + compared(further), key=lambda r: r[0])
    floor = min((s.free for s in spots), default=1.0)
    simple = max(FLOOR * floor, NEARLY * (at_first or base_select))
    if at_first is not None and len(case.places) == 1 and rough and base_select <= simple and rough[0][0] > UNPROMISING * base_select:
        return SearchStep(case, near[0], base_select, base_validation, [])
    finalists = [(spot, law) for _, spot, law in rough[:FINALISTS]]
    have = {(spot.place, law.kind, law.side) for _, spot, law in rough}
    # Without the mean deflection an even law may seem to act towards the other side.
    finalists += [
        (spot, ForceLaw(law.kind, law.values, -law.side))
        for spot, law in finalists
        if not law.two_sided and (spot.place, law.kind, -law.side) not in have
    ]
    tried = each(lambda f: settle_law(*f, turns=FIRST_TURNS), finalists)
    walked: list[Tried] = []

    def least() -> float:
        return min((t.selection for t in (*tried, *walked)), default=np.inf)

    def remember() -> None:
        """Hysteresis, at the best place of all forces and at that of the best law."""
        if "hysteresis" not in kinds or walked or least() <= simple:
            return
        of_laws = min(tried, key=lambda t: t.selection).spot if tried else spots[0]
        for spot in {s.place: s for s in (spots[0], of_laws)}.values():
            if (law := fit_law(spot.fit, "hysteresis")) is not None:
                walked.append(settle_law(spot, law, turns=FIRST_TURNS))

    if least() > FAR * simple:
        remember()
    # Where two turns improve nothing more of them do not.
    close = STILL_OPEN * least() if least() < HOPE * base_select else 0.0
    tried = each(lambda t: settle_law(t.spot, t.law, turns=TURNS - FIRST_TURNS) if t.selection <= close else t, tried)
    remember()
    return SearchStep(case, near[0], base_select, base_validation, sorted(tried + walked, key=lambda t: t.selection))


def roughly(spot: Spot, kind: str, side: float) -> tuple[float, Spot, ForceLaw] | None:
    """A law with the motion as measured, and its chi-square on the select set; enough to tell which laws are worth more."""
    law = fit_law([m.coarse for m in spot.fit], kind, side, rounds=ROUGH_ROUNDS)
    return None if law is None else (misfit(law, [m.coarse for m in spot.select]), spot, law)


def sides(kind: str) -> tuple[float, ...]:
    """Both sides for a law that is not odd."""
    return (1.0,) if getattr(kind_of(kind), "odd", True) else (1.0, -1.0)


def settle_law(spot: Spot, law: ForceLaw, turns: int = TURNS) -> Tried:
    """The law refitted with motions that it makes itself where the data say nothing (the mean among them).

    Motion and values are found in turn. Where one answers the other too strongly they swing about what they seek: so every second turn the
    values go to where the last three point (Aitken's rule, on logarithms).
    """
    best, here = law, spot
    cost, _ = law_cost(law, spot.select)
    trail, seen, step = [law], [law], 0.0
    for turn in range(turns):
        moved = here.settled(trail[-1])
        again = fit_law(moved.fit, law.kind, law.side, near=trail[-1])
        if again is None:
            break
        new, _ = law_cost(trail[-1], moved.select)
        if turn == 0 or new < cost:
            best, here, cost = trail[-1], moved, new
        elif new > 1.5 * cost and turn > 2:
            break
        step = change(trail[-1], again)
        trail.append(again)
        seen.append(again)
        if step < NARROWEST:
            break
        if len(trail) == 3:
            trail = [towards(*trail)]
    if step > UNSETTLED and turns > FIRST_TURNS and len(law.values) == 1 and not law.two_sided:
        best, here = narrowed(here, best, cost, seen)
    return Tried.of(here, best)


def narrowed(spot: Spot, law: ForceLaw, cost: float, seen: Sequence[ForceLaw]) -> tuple[ForceLaw, Spot]:
    """The one value of a law that leaves least between the smallest and the largest seen, each with the motion it makes."""
    from scipy.optimize import minimize_scalar

    (name,) = law.values
    logs = [float(np.log(x.values[name])) for x in seen]
    found = [(cost, law, spot)]

    def fit_cost(at: float) -> float:
        one = law.moved(**{name: float(np.exp(at))})
        moved = spot.settled(one)
        found.append((law_cost(one, moved.select)[0], one, moved))
        return law_cost(one, moved.fit)[0]

    minimize_scalar(fit_cost, bounds=(min(logs), max(logs)), method="bounded", options={"xatol": NARROWEST})
    return min(found, key=lambda f: f[0])[1:]


def change(one: ForceLaw, two: ForceLaw) -> float:
    """Largest relative difference of the values of two laws of one kind."""
    return max(abs(float(np.log(two.values[n] / v))) if v > 0 and two.values[n] > 0 else 0.0 for n, v in one.values.items())


def towards(one: ForceLaw, two: ForceLaw, three: ForceLaw) -> ForceLaw:
    """Where a row of three laws of one kind points (Aitken's rule), no farther than it went so far."""
    values = {}
    for name in three.values:
        row = [law.values[name] for law in (one, two, three)]
        if min(row) <= 0:
            continue
        a, b, c = (float(np.log(v)) for v in row)
        bend = c - 2 * b + a
        there = c - (c - b) ** 2 / bend if abs(bend) > 1e-9 else c
        reach = abs(b - a) + abs(c - b)
        values[name] = float(np.exp(np.clip(there, min(a, b, c) - reach, max(a, b, c) + reach)))
    return three.moved(**values)


def baseline(sets: Sets) -> tuple[float, float]:
    """Chi-squares on the select and hold-out sets of the idle model with what lies outside the band, and nothing at any place."""
    case, fit = sets.case, sets.parts["fit"]
    m = len(case.idle.dofs)
    none = OutOfBand.none([w.run for w in fit], m, case.band[1])
    outside, _ = look(fit, case.modes, np.zeros(m), case.doubt, none, 2, [np.zeros(w.run.hz.size, complex) for w in fit])
    out = []
    for name in ("select", "validation"):
        cost, count = 0.0, 0
        for w in sets.parts[name]:
            known = next((outside.forces[i] for i, r in enumerate(case.fitted) if r.forces_at == w.run.forces_at), None)
            error = w.run.error if known is None else w.run.error - known @ force_columns(w.run, case.band[1])
            cost += w.with_error(error).ringing()[1]
            count += error.size
        out.append(cost / count)
    return out[0], out[1]


def choose(tried: Sequence[Tried]) -> Tried:
    """Parsimony: within 3 % of the best the fewest values, then one DOF before two."""
    near = [t for t in tried if t.selection <= (1 + PARSIMONY) * tried[0].selection]
    return min(near, key=lambda t: (len(t.law.values), len(t.spot.place), t.selection))


def improves(step: SearchStep, best: Tried, before: Sequence[Tried] = ()) -> bool:
    """Whether the law lowers the chi-square, and a level-dependent one more than any linear law at the same place could."""
    again = any(set(b.spot.place) == set(best.spot.place) for b in before)
    if not best.selection < (SAME_PLACE if again else 1 - IMPROVES) * step.base_select:
        return False
    if not best.validation < step.base_validation:
        return False
    if not best.law.definition.level_dependent:
        return True
    count = sum(m.along.weighted.error.size for m in best.spot.select)
    return best.selection < (1 - IMPROVES) * linear_law(best.spot.fit, best.spot.select) / count


def with_law(case: RecordsCase, best: Tried) -> RecordsCase:
    """The case with the restoring force of an accepted law as one more known force."""
    spot = best.spot
    drive = case.modes.phi.T @ spot.b

    def force(m: Motion) -> Complex:
        out = np.array(m.spectrum(best.law))
        out[m.along.run.lines] = m.beside(best.law)
        return out

    return case.with_runs([r.with_force(drive, m.along.h, -force(m)) for r, m in zip(case.runs, spot.whole, strict=True)])


def block_misfits(tried: Tried) -> Real:
    """Chi-square on each block of the select set."""
    out = []
    for m in tried.spot.select:
        power = np.mean(np.abs(m.along.under(m.beside(tried.law)).decayed()) ** 2, axis=0)
        part = np.minimum(m.along.run.lines * BLOCKS // (m.along.run.lines[-1] + 1), BLOCKS - 1)
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
    """Whether one kind contains the other at the same place, or one is the other mirrored."""
    if set(a.spot.place) != set(b.spot.place):
        return False
    one, two = a.law.definition, b.law.definition
    return one.kind in two.contains or two.kind in one.contains or one.kind == two.kind
