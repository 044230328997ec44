"""The result in words and figures: effects with sizes, errors by step, verdict, alternatives, the measurement that would decide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from operando.compare.verdict import GOOD, PARTLY, floor_reason, verdict_of
from operando.data import Geometry
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.closed_loop import against_records
from operando.diagnosis.records.detect import Detection
from operando.diagnosis.records.fit_laws import free_law
from operando.diagnosis.records.hold_out import DISCREPANCY, Discrepancy, judged_on, step_row, where_it_fails
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.refine import OF_ALL_RUNS, of_all_runs, std_of
from operando.diagnosis.records.result import Equivalents, FoundLaws, RecordsDiagnosis, linear_model
from operando.diagnosis.records.run import running_mean
from operando.diagnosis.records.steps import ALIKE, SearchStep, Tried, alike, nested
from operando.diagnosis.records.surface import equivalents, surface
from operando.diagnosis.result import spacing
from operando.dof import Dof
from operando.errors import DataError
from operando.structure.effects import Effect

GOOD_LAW = 0.5
"""A law without a formula that leaves less than this part of the named law's misfit says that the name is wrong."""

TWICE = 2.0
"""Reduced chi-square of the hold-out set, 3 dB above the floor, from which it is asked where the rest comes from."""

SEEN_PART, SHARE = 0.8, 0.25
"""Motion above this part of the recorded band is left out; the records are too slow if that changes the misfit by this share of what
remains. Records four times as fast of a dry friction changed by 0.001, at 512 samples a second by 2, 2.5 remaining."""

FAST_SEEN = 4.0
"""Power of the measured acceleration over noise from which motion above that part is seen at all."""

FASTER = 4
"""Times the sampling rate that is proposed."""

OF_THEIR_OWN_DAY = 3
"""So many locations where laws leave least are looked at on a day of their own where records are of another one. On a day beside nothing
the true one was third in two of nine fresh measurements (bilinear stiffness 10513, hysteresis 10514), and first or second otherwise."""

NEIGHBOURS = 1.05
"""Places within so many sensor spacings are neighbours."""


def effect_of(case: RecordsCase, tried: Tried) -> Effect:
    """The law as an effect; a one-sided law towards the other side turns its place round."""
    law, place = tried.law, tried.spot.place
    dofs, name = case.located(place), law.kind
    if len(dofs) == 2 and name.startswith("ground_"):
        name = name.replace("ground_", "coupling_")
    if law.side < 0:
        dofs = (dofs[0].opposite,) if len(dofs) == 1 else dofs[::-1]
    return Effect(name, dofs, dict(law.values), std_of(tried, case.day))


def candidate_row(case: RecordsCase, tried: Tried, base: float) -> dict[str, Any]:
    """One entry of ``candidates``."""
    fall = 100 * (1 - tried.selection / base)
    return effect_of(case, tried).to_dict() | {
        "selection_misfit": tried.selection,
        "evidence": f"reduced chi-square on validation lines {base:.4g} → {tried.selection:.4g} ({fall:.1f} % lower)",
    }


def unsupported_row(effect: Effect, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """An entry of ``candidates`` for what was found and is not supported."""
    evidence = f"found, but not supported by the validation records (reduced chi-square of the idle model {rows[0]['heldout_misfit']:.4g})"
    return effect.to_dict() | {"selection_misfit": None, "evidence": evidence}


def conclude(
    first: RecordsCase,
    steps: list[SearchStep],
    accepted: list[Tried],
    more: str | None,
    detection: Detection,
    geometry: Geometry | None,
) -> RecordsDiagnosis:
    """Verdict, errors by step and words; ``more``: why something may be missing still."""
    last = steps[-1].case
    notes: list[str] = []
    every = [of_all_runs(t) for t in accepted]
    found = [effect_of(first, t) for t in every]
    weak = next((k for k, e in enumerate(found) if not e.supported), len(found))
    effects, dropped, accepted = found[:weak], found[weak:], accepted[:weak]
    if dropped:
        more = f"{dropped[0].kind} at {dropped[0].place} is a candidate only: its 95 % interval holds zero"
    weighted = [Weighted.of(r) for r in last.runs]
    idle_errors = errors = [r.error for r in first.runs]
    rows = [step_row(0, None, last, weighted, idle_errors)]
    rivals: list[tuple[Tried, Tried]] = []
    for k, (best, effect) in enumerate(zip(accepted, effects, strict=True)):
        errors = best.spot.errors(best.law)
        rows.append(step_row(k + 1, effect, last, weighted, errors))
        rivals += [(best, t) for t in steps[k].tried if t.key != best.key and not nested(best, t) and alike(best, t)]
    alternatives = [effect_of(first, t) for _, t in rivals]
    other = any(
        t.law.kind != best.law.kind or not neighbours(first.located(best.spot.place), first.located(t.spot.place), geometry)
        for best, t in rivals
    )
    validation = [r["heldout_misfit"] for r in rows]
    unseen = floor_reason(rows[0].get("noise_floor_db"))
    part = last.hold_out()
    off = Discrepancy.of(last, weighted[part], errors[part]) if accepted else None
    within = off is not None and is_allowed(off, Discrepancy.of(last, weighted[part], idle_errors[part]))
    if off is not None and first.validation and not within and off.chi_square(DISCREPANCY) <= GOOD:
        # A level at which a contact stays open does not speak of it: the louder runs do, of which few numbers are fitted to many lines.
        loud = slice(0, len(last.fitted))
        within = is_allowed(*(Discrepancy.of(last, weighted[loud], e[loud]) for e in (errors, idle_errors)))
    verdict, reason = verdict_of(validation, unseen=unseen, more=more, ambiguous=other, within=within)
    if verdict == "no_misfit":
        verdict, reason = without_law(rows[0])
    picture = pictures_of(first, effects, every[:weak], notes)
    if off is not None and verdict in ("explained", "ambiguous") and validation[-1] >= GOOD:
        notes.append(
            f"the validation lines are left at a reduced chi-square of {validation[-1]:.3g}; with a discrepancy of {100 * DISCREPANCY:g} % "
            f"of the responses, which is allowed, at {off.chi_square(DISCREPANCY):.2g}"
        )
    if len(accepted) == 1 and verdict in ("explained", "ambiguous") and (wrong := wrong_law(accepted[0])):
        verdict, reason = verdict_of(validation, unseen=unseen, more=wrong, within=within)
    if verdict not in ("explained", "ambiguous", "partial") and effects:
        dropped, effects, alternatives, rows, picture = [*effects, *dropped], [], [], rows[:1], {}
    accepted = accepted[: len(effects)]
    notes += [OF_ALL_RUNS] if any(one is not other for one, other in zip(accepted, every, strict=False)) else []
    notes += too_fast(effects, accepted, len(first.fitted), rows[-1]["heldout_misfit"])
    if not first.validation:
        notes.append(
            "one level alone: the errors by step are of all its lines, fitted ones included; a second level would show what scales"
        )
    search = found_laws(last, weighted, every, found, steps[0], geometry)
    same = search.equivalents[: len(accepted)]
    candidates = [candidate_row(first, t, steps[0].base_select) for t in steps[0].tried]
    return RecordsDiagnosis(
        verdict,
        tuple(effects),
        tuple(alternatives),
        proposal(effects, alternatives),
        tuple(rows),
        (*(unsupported_row(e, rows) for e in dropped), *candidates),
        where_it_fails(last, weighted, idle_errors),
        rows[0].get("noise_floor_db"),
        ("check_records",),
        picture,
        idle=first.idle,
        model=linear_model(first.idle, effects, same, geometry),
        judged_on=judged_on(last),
        reason=reason,
        discrepancy=off.to_dict() if off is not None and effects else None,
        detection=detection,
        simulation=simulated(steps[0].case, accepted, notes),
        equivalents=same,
        found=search,
        notes=tuple(notes),
    )


def without_law(row: Mapping[str, Any]) -> tuple[str, str | None]:
    """Verdict and reason where the hold-out set fits as it is: a day of its level may have taken the mean spring of a force law."""
    left = row["misfit"]
    if left < GOOD:
        return "no_misfit", None
    return "unexplained", f"the runs of all levels keep a reduced chi-square of {left:.3g}, where less than {GOOD:g} is asked"


def found_laws(
    last: RecordsCase,
    weighted: Sequence[Weighted],
    accepted: Sequence[Tried],
    effects: Sequence[Effect],
    step: SearchStep,
    geometry: Geometry | None,
) -> FoundLaws:
    """What the search accepted, with the score that it has."""
    places = dict.fromkeys([step.place, *list(dict.fromkeys(t.spot.place for t in step.tried))[:OF_THEIR_OWN_DAY]])
    locations = tuple(last.located(place) for place in places)
    if not accepted:
        return FoundLaws(locations=locations)
    same = equivalents_of(last, effects, accepted)
    pairs = zip(weighted, accepted[-1].spot.errors(accepted[-1].law), strict=True)
    return FoundLaws(tuple(effects), same, log_score(pairs), locations, linear_model(last.idle, effects, same, geometry))


def log_score(runs: Iterable[tuple[Weighted, np.ndarray]]) -> float:
    """Mean over all lines of runs of ln of the mean square error of the lines around, each run with its error.

    The less, the more probable are the records. What is left has no known size, and the likelihood with the most probable one counts
    (concentrated likelihood: Seber & Wild, Nonlinear Regression, 1989, section 2.2.3), whatever noise was found beside the force laws.
    """
    left = [running_mean(np.abs(w.with_error(error).decayed() / w.root) ** 2) for w, error in runs]
    return float(np.mean(np.concatenate([np.log(np.maximum(power, 1e-300)).ravel() for power in left])))


def is_allowed(left: Discrepancy, idle: Discrepancy) -> bool:
    """Whether what is left is no more than noise and ``DISCREPANCY``, where that is no ground for the idle model as well.

    Where the idle model is within the same allowance the effects must lower the chi-square by as much as ``partial`` asks: a law of another
    kind may leave four fifths of it (rotor 10393).
    """
    lowered = left.chi_square(0.0) < (1 - PARTLY) * idle.chi_square(0.0)
    return left.chi_square(DISCREPANCY) <= GOOD and (lowered or idle.chi_square(DISCREPANCY) > GOOD)


def wrong_law(best: Tried) -> str | None:
    """Why the law is none of the catalogue, where one without a formula leaves much less."""
    if best.selection <= TWICE:
        return None
    unnamed = free_law(best.spot.fit, best.spot.select) / sum(m.along.weighted.error.size for m in best.spot.select)
    if unnamed >= GOOD_LAW * best.selection:
        return None
    return (
        f"a force law without a formula leaves {unnamed:.3g} where {best.law.kind} leaves {best.selection:.3g}: "
        "the location is right, the force law is none of the catalogue"
    )


def too_fast(effects: Sequence[Effect], accepted: Sequence[Tried], fitted: int, left: float) -> list[str]:
    """What says that places move faster than the records show, so that no law can be taken of that motion.

    ``fitted`` runs stand before the hold-out set (all where there are no others); ``left`` is its chi-square with all effects.
    """
    if left < TWICE:
        return []
    out = []
    for effect, tried in zip(effects, accepted, strict=True):
        if effect.definition.acts != "pseudo_force":
            continue
        motions = tried.spot.whole[fitted:] or tried.spot.whole
        change = float(np.mean([m.without_fastest(tried.law, SEEN_PART) for m in motions]))
        # What is but noise up there says nothing of what lies above.
        if change > SHARE * (left - 1) and max(m.above_noise(SEEN_PART) for m in motions) > FAST_SEEN:
            top = motions[0].along.run.sampling_hz / 2
            out.append(
                f"the validation records stay {10 * np.log10(left):.1f} dB above the floor, and {effect.place} moves faster than "
                f"they show: what lies between {SEEN_PART * top:.0f} and {top:.0f} Hz changes the force in the band by {change:.2g} times "
                f"the floor, so what lies above counts, too; record at {FASTER * 2 * top:.0f} samples a second or more"
            )
    return out


def pictures_of(case: RecordsCase, effects: Sequence[Effect], accepted: Sequence[Tried], notes: list[str]) -> dict[str, Any]:
    """Restoring force and law over it of each level-dependent effect; notes say how much of the force each explains."""
    pictures = []
    for effect, best in zip(effects, accepted, strict=True):
        if effect.definition.level_dependent:
            drawn = surface(best.spot.whole[: len(case.fitted)], best.law)
            pictures.append(drawn | {"kind": effect.kind, "location": [str(d) for d in effect.location]})
            notes.append(f"{effect.kind} explains {100 * drawn['goodness']:.1f} % of the restoring force seen at {effect.place}")
    return {"restoring_force": pictures} if pictures else {}


def equivalents_of(case: RecordsCase, effects: Sequence[Effect], accepted: Sequence[Tried]) -> Equivalents:
    """Spring and damper at each level of each level-dependent effect."""
    pairs = zip(effects, accepted, strict=True)
    return tuple(equivalents(t.law, t.spot.whole, case.idle.dofs) if e.definition.level_dependent else () for e, t in pairs)


def simulated(case: RecordsCase, accepted: Sequence[Tried], notes: list[str]) -> dict[str, Any]:
    """The closed loop against the validation records, where a level-dependent law was accepted."""
    if not any(t.law.definition.level_dependent for t in accepted):
        return {}
    try:
        return against_records(case, accepted)
    except DataError as error:
        notes.append(f"not simulated: {error.message}")
        return {}


def neighbours(a: Sequence[Dof], b: Sequence[Dof], geometry: Geometry | None) -> bool:
    """Whether two locations lie within one sensor spacing of each other."""
    if len(a) != len(b):
        return False
    if set(a) == set(b):
        return True
    if geometry is None:
        return False
    ends = [[geometry.position(dof.node) for dof in location] for location in (a, b)]
    if any(p is None for end in ends for p in end):
        return False
    one, two = np.array(ends, float)
    ways = [float(np.max(np.linalg.norm(one - order, axis=1))) for order in (two, two[::-1])]
    return min(ways) <= NEIGHBOURS * spacing(geometry)


def beside_others(stands: RecordsDiagnosis, looks: Sequence[RecordsDiagnosis], geometry: Geometry | None) -> RecordsDiagnosis:
    """One force law that stands, with those elsewhere by which the records are as probable, each on a day of its own.

    On its day the others leave more: that day was found beside it. As within one search, :data:`ALIKE` is what cannot be told apart.
    """
    if stands.verdict not in ("explained", "ambiguous") or len(stands.effects) != 1:
        return stands
    best, bound = stands.effects[0], stands.found.log_score + np.log1p(ALIKE)
    known = {(e.kind, frozenset(e.location)) for e in stands.ambiguous_with}
    alike = {(e.kind, frozenset(e.location)): e for d in looks if d.nonlinear and d.found.log_score < bound for e in d.effects[:1]}
    others = [e for (kind, at), e in alike.items() if at != frozenset(best.location) and (kind, at) not in known]
    if not others:
        return stands
    far = any(e.kind != best.kind or not neighbours(best.location, e.location, geometry) for e in others)
    alternatives = (*stands.ambiguous_with, *others)
    proposed = proposal(stands.effects, alternatives)
    verdict = "ambiguous" if far else stands.verdict
    return replace(stands, verdict=verdict, ambiguous_with=alternatives, proposed_measurement=proposed)


def proposal(effects: Sequence[Effect], alternatives: Sequence[Effect]) -> str | None:
    """The measurement that would decide."""
    if alternatives and effects:
        rival = alternatives[0]
        return f"to tell {effects[0].kind} at {effects[0].place} from {rival.kind} at {rival.place}: {rival.confirm}"
    return effects[0].confirm if effects else None
