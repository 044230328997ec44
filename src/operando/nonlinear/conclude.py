"""The result in words and figures: effects with sizes, errors by step, verdict, alternatives, the measurement that would decide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.compare.verdict import floor_reason, verdict_of
from operando.data import Geometry
from operando.effects import Effect, kind_of
from operando.errors import DataError
from operando.nonlinear.equivalent import equivalents
from operando.nonlinear.hold_out import discrepancy, judged_on, step_row, where_it_fails
from operando.nonlinear.laws import free_law
from operando.nonlinear.place import Weighted
from operando.nonlinear.polish import std_of
from operando.nonlinear.result import NonlinearDiagnosis
from operando.nonlinear.search import Case
from operando.nonlinear.simulate import against_records
from operando.nonlinear.steps import Step, Tried, alike, nested
from operando.nonlinear.surface import surface

GOOD_LAW = 0.5
"""A law without a formula that leaves less than this part of the named law's misfit says that the name is wrong."""

TWICE = 2.0
"""Judge misfit, 3 dB above the floor, from which it is asked where the rest comes from."""

DISCREPANCY = 0.03
"""Part of the responses by which a law may be off (contract, ``explained``): forces follow from a motion whose errors no covariance
carries, those of contacts above all."""

SEEN_PART, SHARE = 0.8, 0.25
"""Motion above this part of the recorded band is left out; the records are too slow if that changes the misfit by this share of what
remains. Records four times as fast of a dry friction changed by 0.001, at 512 samples a second by 2, 2.5 remaining."""

FAST_SEEN = 4.0
"""Power of the measured acceleration over noise from which motion above that part is seen at all."""

FASTER = 4
"""Times the sampling rate that is proposed."""


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


def candidate_row(case: Case, tried: Tried, base: float) -> dict[str, Any]:
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
    first: Case,
    steps: list[Step],
    accepted: list[Tried],
    more: str | None,
    detection: dict[str, Any],
    geometry: Geometry | None,
) -> NonlinearDiagnosis:
    """Verdict, errors by step and words; ``more``: why something may be missing still."""
    last = steps[-1].case
    notes: list[str] = []
    weak = next((k for k, t in enumerate(accepted) if not effect_of(first, t).supported), len(accepted))
    dropped, accepted = [effect_of(first, t) for t in accepted[weak:]], accepted[:weak]
    if dropped:
        more = f"{dropped[0].kind} at {dropped[0].place} is a candidate only: its 95 % interval holds zero"
    weighted = [Weighted.of(r) for r in (*last.fitted, *last.validation)]
    idle_errors = [r.error for r in (*first.fitted, *first.validation)]
    n = len(first.fitted)
    rows = [step_row(0, None, weighted, n, idle_errors)]
    effects = []
    alternatives: list[Tried] = []
    other = False
    for k, best in enumerate(accepted):
        effect = effect_of(first, best)
        effects.append(effect)
        errors = []
        for m in best.spot.whole:
            corrected = m.along.weighted.error / m.along.weighted.root
            errors.append(corrected + m.along.h * m.under(best.law))
        rows.append(step_row(k + 1, effect, weighted, n, errors))
        for t in steps[k].tried:
            if t.key != best.key and not nested(best, t) and alike(best, t):
                alternatives.append(t)
                other = other or t.law.kind != best.law.kind or not neighbours(first, best, t, geometry)
    validation = [r["heldout_misfit"] for r in rows]
    unseen = floor_reason(rows[0].get("noise_floor_db"))
    hold_out = slice(n if len(weighted) > n else 0, None)
    off = discrepancy(weighted[hold_out], errors[hold_out]) if accepted else 0.0
    within = bool(accepted) and off <= DISCREPANCY
    picture = pictures_of(first, effects, accepted, notes)
    verdict, reason = verdict_of(validation, unseen=unseen, more=more, ambiguous=other, within=within)
    if verdict in ("explained", "ambiguous") and off > 0:
        notes.append(f"what is left beyond the noise is {100 * off:.2g} % of the responses; {100 * DISCREPANCY:g} % are allowed")
    if len(accepted) == 1 and accepted[0].selection > 2.0:
        best = accepted[0]
        count = sum(m.along.weighted.error.size for m in best.spot.select)
        unnamed = free_law(best.spot.fit, best.spot.select) / count
        if unnamed < GOOD_LAW * best.selection and verdict in ("explained", "ambiguous"):
            more = (
                f"a force law without a formula leaves {unnamed:.3g} where {best.law.kind} leaves {best.selection:.3g}: "
                "the location is right, the force law is none of the catalogue"
            )
            verdict, reason = verdict_of(validation, unseen=unseen, more=more, within=within)
    if verdict not in ("explained", "ambiguous", "partial") and effects:
        dropped, effects, alternatives, rows, picture = [*effects, *dropped], [], [], rows[:1], dict[str, Any]()
    notes += too_fast(effects, accepted[: len(effects)], n, rows[-1]["heldout_misfit"])
    if not first.validation:
        notes.append("one level alone: a third of the blocks of lines is the hold-out set; a second level would show what scales")
    step = steps[0]
    return NonlinearDiagnosis(
        verdict,
        tuple(effects),
        tuple(effect_of(first, t) for t in alternatives),
        proposal(effects, alternatives, first),
        tuple(rows),
        (*(unsupported_row(e, rows) for e in dropped), *(candidate_row(first, t, step.base_select) for t in step.tried)),
        where_it_fails(last, weighted, idle_errors),
        rows[0].get("noise_floor_db"),
        detection,
        picture,
        simulated(steps[0].case, accepted[: len(effects)], notes),
        tuple(notes),
        judged_on(last),
        None if not effects else off,
        reason,
    )


def too_fast(effects: Sequence[Effect], accepted: Sequence[Tried], fitted: int, left: float) -> list[str]:
    """What says that places move faster than the records show, so that no law can be taken of that motion.

    Parameters
    ----------
    effects : sequence of Effect
    accepted : sequence of Tried
        The same with their motions.
    fitted : int
        Runs that were fitted; those behind them are the hold-out set (all where there are none).
    left : float
        Chi-square of the validation records with all effects.
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


def pictures_of(case: Case, effects: Sequence[Effect], accepted: Sequence[Tried], notes: list[str]) -> dict[str, Any]:
    """Restoring force, law over it and equivalents of each level-dependent effect; notes say how much of the force each explains."""
    pictures = []
    levels = [r.force_level for r in (*case.fitted, *case.validation)]
    for effect, best in zip(effects, accepted, strict=True):
        if not effect.definition.level_dependent:
            continue
        drawn = surface(best.spot.whole[: len(case.fitted)], best.law) | {
            "kind": effect.kind,
            "location": [str(d) for d in effect.location],
            "equivalent": equivalents(best.law, best.spot.whole, levels),
        }
        pictures.append(drawn)
        notes.append(f"{effect.kind} explains {100 * drawn['goodness']:.1f} % of the restoring force seen at {effect.place}")
    return {"restoring_force": pictures} if pictures else {}


def simulated(case: Case, accepted: Sequence[Tried], notes: list[str]) -> dict[str, Any]:
    """The closed loop against the validation records, where a level-dependent law was accepted."""
    if not any(kind_of(t.law.kind).level_dependent for t in accepted):
        return {}
    try:
        return against_records(case, accepted)
    except DataError as error:
        notes.append(f"not simulated: {error.message}")
        return {}


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
