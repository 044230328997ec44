"""Diagnosis from records with measured force: which level-dependent effect the idle model lacks, where and how large."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from operando.data import Geometry, ModalModel, TimeRecord
from operando.dof import Dof, parse_dofs
from operando.effects import Effect, catalogue, kind_of
from operando.errors import DataError
from operando.nonlinear.detect import detect
from operando.nonlinear.judge import ladder_row, residual, verdict_of, where_it_fails
from operando.nonlinear.laws import LawFit, fit_law, free_law, law_cost, linear_law
from operando.nonlinear.outside import Outside, force_columns, look
from operando.nonlinear.result import NonlinearDiagnosis
from operando.nonlinear.run import Real, Run, smoothed_variance
from operando.nonlinear.search import NOISE_FLOOR, WITHIN, Case, Field, Spot, examine, make_case, rank_places, settled
from operando.nonlinear.surface import goodness, surface

EARNED, PARSIMONY = 0.10, 0.03
"""An effect lowers the selection misfit by more than this part; within this part of the best the fewest parameters win."""

ALIKE, ALIKE_Z, ALIKE_AT_MOST = 0.02, 2.0, 0.15
MAX_EFFECTS = 3
KEPT = 4
"""Places at which laws are fitted."""

FINALISTS = 5
FLOOR, NEARLY = 3.0, 0.01
"""Hysteresis takes a walk through time: only where no simpler law comes this near to what any force at the place could do."""

ONE_PLACE, SAME_PLACE = 1.5, 0.5
"""Where one force at the place found leaves no more than this misfit nothing acts elsewhere; a second law at the same place must leave less
than this part of the misfit, for errors of the motion look like one."""

GOOD_LAW = 0.5
"""A law without a formula that leaves less than this part of the named law's misfit says that the name is wrong."""


@dataclass(frozen=True)
class Tried:
    """A law at a place, its motions settled.

    Parameters
    ----------
    spot : Spot
    law : LawFit
    selection, judge : float
        Misfits.
    """

    spot: Spot
    law: LawFit
    selection: float
    judge: float

    @property
    def key(self) -> tuple[tuple[int, ...], str, float]:
        """Place, kind, side."""
        return self.spot.place, self.law.kind, self.law.side


@dataclass
class Step:
    """One step of the search: what was tried, and the errors of the runs before it."""

    case: Case
    base_select: float
    base_judge: float
    tried: list[Tried]
    free: float


def diagnose_records(
    idle: ModalModel,
    records: Sequence[TimeRecord],
    *,
    geometry: Geometry | None = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
) -> NonlinearDiagnosis:
    """Name the level-dependent effect that the idle model lacks in records of the running state with measured force.

    Reverse path with a known linear part (Bendat & Piersol, Random Data): the idle model is the underlying linear system, so the only
    unknowns are the place, the law and its few values. Searched in response space, weighted by the model and the noise.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, residual modes included.
    records : sequence of TimeRecord
        Force and responses of the running state, best at two levels: the lower one judges.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    kinds, places : sequences, optional
        Look only for these; a place is a DOF or a pair of DOFs.
    band : (float, float), optional
        Lines used [Hz]; default the idle model's band, and up to its last mode.
    progress : callable, optional
        Told what is being done.

    Returns
    -------
    NonlinearDiagnosis

    Raises
    ------
    DataError
        If the idle model is not scaled to unit modal mass, or a force is not at one of its DOFs.
    MissingError
        If there is no record.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so it predicts no response to fail", hint="give the units of force and acceleration")
    with threadpool_limits(1, "blas"):
        case = make_case(idle, records, band, None if places is None else place_rows(idle, places))
        wanted = wanted_kinds(kinds)
        return _diagnose(case, wanted, geometry, progress)


def place_rows(idle: ModalModel, places: Sequence[Any]) -> list[tuple[int, ...]]:
    """Rows of the idle model of DOFs or pairs of DOFs."""
    index = {(d.node, d.axis): i for i, d in enumerate(idle.dofs)}
    out = []
    for place in places:
        dofs = parse_dofs(place if not isinstance(place, (str, Dof)) else (place,))
        out.append(tuple(index[d.node, d.axis] for d in dofs if (d.node, d.axis) in index))
    return [p for p in out if p]


def wanted_kinds(kinds: Sequence[str] | None) -> list[str]:
    """Level-dependent kinds, and spring and damper, which a linear effect is told from them by."""
    nonlinear = [name for name, kind in catalogue().items() if kind.acts == "pseudo_force"]
    if kinds is None:
        return ["ground_spring", "ground_damper", *nonlinear]
    return [k for k in (kind_of(k).kind for k in kinds) if k in (*nonlinear, "ground_spring", "ground_damper")] or nonlinear


def _diagnose(case: Case, kinds: list[str], geometry: Geometry | None, say: Callable[[str], None] | None) -> NonlinearDiagnosis:
    first = case
    detection = detect(case)
    steps: list[Step] = []
    accepted: list[Tried] = []
    further = 1.0
    while True:
        step = search_step(case, kinds, say, steps[0].base_select if steps else None)
        steps.append(step)
        case = step.case
        if not step.tried:
            break
        best = choose(step.tried)
        further = best.selection / step.base_select
        if not earns(step, best, accepted):
            further = max(further, 1 - EARNED)
            break
        accepted.append(best)
        further = 1.0
        if len(accepted) == MAX_EFFECTS or best.judge < 1.5:
            break
        case = with_law(case, best)
        if best.spot.free < ONE_PLACE:
            case = replace(case, places=(best.spot.place,))
        if say:
            say(f"{best.law.kind} accepted, look for more")
    return conclude(first, steps, accepted, further, detection, geometry)


def search_step(case: Case, kinds: list[str], say: Callable[[str], None] | None, at_first: float | None) -> Step:
    """Rank the places, weigh the lines by what the best one leaves (at first), fit all laws at the best places."""
    ranked = rank_places(case, case.places, say)
    if at_first is None:
        case = weighed(case, ranked[0][1])
        stage = Field.of(case)
        ranked = rank_places(case, [p for _, p in ranked[:8]])
    stage = Field.of(case)
    base_select, base_judge = baseline(stage)
    near = [p for misfit, p in ranked if misfit <= WITHIN * ranked[0][0]][:KEPT]
    singles = [p for _, p in ranked if len(p) == 1]
    if singles and singles[0] not in near:
        near.append(singles[0])
    spots = [examine(stage, p) for p in near]
    rough: list[tuple[float, Spot, LawFit]] = []
    for spot in spots:
        if say:
            say(f"fit laws at {place_name(case, spot.place)}")
        for name in kinds:
            if name == "hysteresis":
                continue
            for side in sides(name):
                law = fit_law(spot.fit, name, side)
                if law is not None:
                    cost, count = law_cost(law, spot.select)
                    rough.append((cost / count, spot, law))
    rough.sort(key=lambda r: r[0])
    tried = [settle_law(stage, spot, law) for _, spot, law in rough[:FINALISTS]]
    floor = min((s.free for s in spots), default=1.0)
    best = min((t.selection for t in tried), default=np.inf)
    if "hysteresis" in kinds and spots and best > max(FLOOR * max(floor, 1.0), NEARLY * (at_first or base_select)):
        for spot in spots[:1]:
            law = fit_law(spot.fit, "hysteresis")
            if law is not None:
                tried.append(settle_law(stage, spot, law, turns=1))
    tried.sort(key=lambda t: t.selection)
    return Step(case, base_select, base_judge, tried, floor)


def sides(kind: str) -> tuple[float, ...]:
    """Both sides for a law that is not odd."""
    return (1.0,) if getattr(kind_of(kind), "odd", True) else (1.0, -1.0)


def place_name(case: Case, place: tuple[int, ...]) -> str:
    """DOFs of a place in words."""
    return ", ".join(str(case.idle.dofs[i]) for i in place)


def settle_law(stage: Field, spot: Spot, law: LawFit, turns: int = 2) -> Tried:
    """The law refitted with motions that it makes itself where the data say nothing."""
    best, here = law, spot
    cost, count = law_cost(law, spot.select)
    for _ in range(turns):
        moved = settled(here, stage, best)
        again = fit_law(moved.fit, law.kind, law.side)
        if again is None:
            break
        new, _ = law_cost(again, moved.select)
        if not new < 1.02 * cost:
            break
        better = new < 0.98 * cost
        here, best, cost = moved, again, new
        if not better:
            break
    judged, n = law_cost(best, here.judge)
    return Tried(here, best, cost / count, judged / n)


def baseline(stage: Field) -> tuple[float, float]:
    """Misfits on the select and judge sets of the idle model with what lies outside the band, and nothing at any place."""
    case = stage.case
    none = Outside.none([w.run for w in stage.fit], case.n_dofs, case.band[1])
    nowhere = np.zeros(case.n_dofs)
    zero = [np.zeros(w.run.hz.size, complex) for w in stage.fit]
    seen = look(stage.fit, case.modes, nowhere, case.prior, none, 2, zero)
    out = []
    for weights in (stage.select, stage.judge):
        cost, count = 0.0, 0
        for w in weights:
            known = next((seen.outside.forces[i] for i, r in enumerate(case.fitted) if r.forces_at == w.run.forces_at), None)
            error = w.run.error if known is None else w.run.error - known @ force_columns(w.run, case.band[1])
            cost += w.with_error(error).ringing()[1]
            count += error.size
        out.append(cost / count)
    return out[0], out[1]


def weighed(case: Case, place: tuple[int, ...]) -> Case:
    """The case with the noise of each line from what no force at the place explains; never more than before."""
    stage = Field.of(case)
    spot = examine(stage, place)
    runs = []
    for run, m in zip([*case.fitted, *case.judged], spot.whole, strict=True):
        rest = residual(m, m.force) * np.sqrt(run.variance)
        floor = NOISE_FLOOR**2 * np.mean(np.abs(run.responses[:, run.lines]) ** 2, axis=1, keepdims=True)
        q = run.rows.size
        runs.append(replace(run, variance=smoothed_variance(rest, floor, max((q - 1) / q, 0.5))))
    n = len(case.fitted)
    return replace(case, fitted=tuple(runs[:n]), judged=tuple(runs[n:]))


def choose(tried: Sequence[Tried]) -> Tried:
    """Parsimony: within 3 % of the best the fewest parameters, then one DOF before two."""
    near = [t for t in tried if t.selection <= (1 + PARSIMONY) * tried[0].selection]
    return min(near, key=lambda t: (t.law.size, len(t.spot.place), t.selection))


def earns(step: Step, best: Tried, before: Sequence[Tried] = ()) -> bool:
    """Whether the law lowers the misfit, and a level-dependent one more than any linear law at the same place could."""
    again = any(set(b.spot.place) == set(best.spot.place) for b in before)
    if not best.selection < (SAME_PLACE if again else 1 - EARNED) * step.base_select:
        return False
    if not best.judge < step.base_judge:
        return False
    if not kind_of(best.law.kind).level_dependent:
        return True
    count = sum(m.along.weighted.error.size for m in best.spot.select)
    linear = linear_law(best.spot.fit, best.spot.select) / count
    return best.selection < (1 - EARNED) * linear


def with_law(case: Case, best: Tried) -> Case:
    """The case with the restoring force of an accepted law as one more known force."""
    runs: list[Run] = []
    for run, m in zip([*case.fitted, *case.judged], best.spot.whole, strict=True):
        force = -m.crossing.lines(best.law.force(m.x, m.v, m.step))
        runs.append(run.with_force(case.modes, best.spot.b, m.along.h, force))
    n = len(case.fitted)
    return replace(case, fitted=tuple(runs[:n]), judged=tuple(runs[n:]))


def block_misfits(tried: Tried, blocks: int = 18) -> Real:
    """Misfit on each block of the select set."""
    out = []
    for m in tried.spot.select:
        r = residual(m, m.spectra(tried.law.force(m.x, m.v, m.step)))
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


def effect_of(case: Case, tried: Tried) -> Effect:
    """The law as an effect; a one-sided law towards the other side turns its place round."""
    law, place = tried.law, tried.spot.place
    dofs = [case.idle.dofs[i] for i in place]
    name = law.kind
    if len(dofs) == 2 and name.startswith("ground_"):
        name = name.replace("ground_", "coupling_")
    if law.side < 0:
        dofs = [d.opposite for d in dofs] if len(dofs) == 1 else dofs[::-1]
    return Effect(name, tuple(dofs), dict(law.values), std_of(tried))


def std_of(tried: Tried) -> dict[str, float]:
    """Standard deviations from the curvature of the misfit, for errors that stay together over some lines."""
    law, motions = tried.law, tried.spot.fit
    names = [n for n in law.values if law.values[n] > 0 and n != "slip_speed"]
    gram = np.zeros((len(names), len(names)))
    cost, count = 0.0, 0
    for m in motions:
        base = m.spectra(law.force(m.x, m.v, m.step))
        moved = [m.spectra(replace(law, values=law.values | {n: law.values[n] * 1.01}).force(m.x, m.v, m.step)) - base for n in names]
        g, r, total = m.along.normal(np.stack([base, *moved]))
        gram += g[1:, 1:] / 0.01**2
        cost += total - 2 * float(r[0]) + float(g[0, 0])
        count += 2 * m.along.weighted.error.size
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(gram)) * cost / count * 2, 0))
    return {n: float(law.values[n] * np.hypot(8 * s, 0.005)) for n, s in zip(names, spread, strict=True)}


def candidate_row(case: Case, tried: Tried, base: float) -> dict[str, Any]:
    """One entry of ``candidates``."""
    fall = 100 * (1 - tried.selection / base)
    return effect_of(case, tried).to_dict() | {
        "selection_misfit": tried.selection,
        "evidence": f"misfit on lines the fit has not seen {base:.4g} → {tried.selection:.4g} ({fall:.1f} % lower)",
    }


def conclude(
    first: Case,
    steps: list[Step],
    accepted: list[Tried],
    further: float,
    detection: dict[str, Any],
    geometry: Geometry | None,
) -> NonlinearDiagnosis:
    """Verdict, ladder and words."""
    last = steps[-1].case
    notes: list[str] = []
    rows = [ladder_row(0, None, last, [r.error for r in (*first.fitted, *first.judged)])]
    effects = []
    alternatives: list[Tried] = []
    other = False
    for k, best in enumerate(accepted):
        effect = effect_of(first, best)
        effects.append(effect)
        errors = []
        for run, m in zip((*steps[k].case.fitted, *steps[k].case.judged), best.spot.whole, strict=True):
            corrected = m.along.weighted.error / m.along.weighted.root
            errors.append(corrected + m.along.h * m.spectra(best.law.force(m.x, m.v, m.step)))
            del run
        rows.append(ladder_row(k + 1, effect, last, errors))
        for t in steps[k].tried:
            if t.key != best.key and not nested(best, t) and alike(best, t):
                alternatives.append(t)
                other = other or t.law.kind != best.law.kind or not neighbours(first, best, t, geometry)
    judged = [r["heldout_misfit"] for r in rows]
    verdict = verdict_of(judged, bool(accepted), other, further)
    picture: dict[str, Any] = {}
    if accepted:
        best = accepted[0]
        n = len(first.fitted)
        picture = surface(best.spot.whole[:n], best.law)
        share = goodness(best.spot.whole[:n], best.law)
        picture["place"] = [str(d) for d in effects[0].location]
        if len(accepted) == 1 and best.selection > 2.0:
            count = sum(m.along.weighted.error.size for m in best.spot.select)
            unnamed = free_law(best.spot.fit, best.spot.select) / count
            if unnamed < GOOD_LAW * best.selection and verdict in ("explained", "ambiguous"):
                verdict = "partial"
                notes.append(
                    f"a law without a formula leaves {unnamed:.3g} where {best.law.kind} leaves {best.selection:.3g}: "
                    "the place is right, the law is none of the catalogue"
                )
        notes.append(f"the law explains {100 * share:.1f} % of the restoring force seen at its place")
    if not first.judged:
        notes.append("one level alone: a third of the blocks of lines judges; a second level would show what scales")
    step = steps[0]
    return NonlinearDiagnosis(
        verdict,
        tuple(effects),
        tuple(effect_of(first, t) for t in alternatives),
        proposal(effects, alternatives, first),
        tuple(rows),
        tuple(candidate_row(first, t, step.base_select) for t in step.tried),
        where_it_fails(last, [r.error for r in (*first.fitted, *first.judged)]),
        rows[0].get("noise_floor_db"),
        detection,
        picture,
        {},
        tuple(notes),
    )


def neighbours(case: Case, a: Tried, b: Tried, geometry: Geometry | None) -> bool:
    """Whether two places lie within one sensor spacing of each other."""
    if len(a.spot.place) != len(b.spot.place):
        return False
    if set(a.spot.place) == set(b.spot.place):
        return True
    if geometry is None:
        return False
    x = geometry.coordinates
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    limit = 1.05 * float(np.median(apart.min(axis=1)))
    dofs = case.idle.dofs
    one = [p for i in a.spot.place if (p := geometry.position(dofs[i].node)) is not None]
    two = [p for i in b.spot.place if (p := geometry.position(dofs[i].node)) is not None]
    if len(one) != len(two) or len(one) != len(a.spot.place):
        return False
    orders = [two, two[::-1]]
    return min(max(float(np.linalg.norm(np.subtract(p, q))) for p, q in zip(one, o, strict=True)) for o in orders) <= limit


def proposal(effects: Sequence[Effect], alternatives: Sequence[Tried], case: Case) -> str | None:
    """The measurement that would decide."""
    if alternatives and effects:
        rival = effect_of(case, alternatives[0])
        return f"to tell {effects[0].kind} at {effects[0].place} from {rival.kind} at {rival.place}: {rival.confirm}"
    return effects[0].confirm if effects else None
