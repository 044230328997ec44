"""Where the running structure does not behave linearly: the diagnosis from its records instead of its FRFs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from operando.data import Frf, Geometry, ModalModel, TimeRecord, one_level
from operando.diagnosis.another_day import day_of, usual_day
from operando.diagnosis.arguments import chosen_run
from operando.diagnosis.at_level import level_picture
from operando.diagnosis.by_hand import apply_effects
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.records import Day, RecordsApplied, RecordsDiagnosis, diagnose_records, measured_distortion
from operando.diagnosis.result import Diagnosis, where_and_levels
from operando.diagnosis.size_by_level import levels_disagree, sizes_by_level
from operando.dof import Dof, Node
from operando.errors import MissingError, OperandoError
from operando.results import CheckRun
from operando.structure import LinearEquivalent, has_restoring_force, linear_effects
from operando.structure.effects import Effect, parse_effect

DISTORTION, LOUDEST = 3.0, 0.75
"""What FRFs leave unexplained in the check may be this many times what they leave at rest, at the quantile of the responses that follows;
over 119 linear cases it was 0.3 to 2.9 times. Responses far from a contact show little of it, so the median says too little. At the
locations of linear effects that were found it was 2.9 times at most in 228 cases; 4.9 where a bilinear stiffness had been taken for a
spring."""

FAINT = 1.5
"""And where they agree, what is not proportional to the force may surely be this many times as much at the higher level as at the lower:
one linear system leaves no more than 1, and noise may grow faster than the force. 0.5 to 1.06 in 115 linear cases; 1.9 to 1700 in 32 cases
with hysteresis, gaps and laws of powers. A bilinear stiffness scales with the level and is left to ``DISTORTION``."""

UNTOUCHED = (
    "the validation FRFs are as probable with nothing touched between the idle and the operating measurement; gains, positions of "
    "sensors, temperature and damping count as the same"
)

OF_A_DAY = "the records are compared with the idle model as it is on another day: what differs comes from the FRFs of {run}"
NO_DAY = "records and what differs between the days: {why}"
OF_ANY_DAY = (
    "the records are compared with an idle model whose frequencies and damping may differ as between two days in a laboratory: the FRFs of "
    "{run} speak of another day and hold what depends on the level, too"
)
DAYS = 2
"""Times that the day is found: beside what is known first, and beside what the records say then. The second time moved values by 0 to 6 %,
less than a quarter of their standard deviations (clearance and saturating spring of ``benchmarks/hidden_effects``, 10300 and 10305)."""

SURE = ("explained", "no_misfit", "ambiguous")


def need_records(effects: Sequence[Effect], data: Sequence[str] = ()) -> bool:
    """Whether effects depend on the level, so that FRFs cannot size them; or records made the diagnosis and can size these, too."""
    if any(e.definition.acts == "pseudo_force" for e in effects):
        return True
    return "check_records" in data and all(has_restoring_force(e) for e in effects)


def suspicion(check: Sequence[CheckRun], idle_frf: Frf | None = None) -> str | None:
    """Why the running structure may not be linear, or None.

    Runs of different level that disagree carry a finding ``nonlinear``. What the responses of ``idle_frf`` leave unexplained at rest is
    noise; what is beyond it in operation is distortion. A stiffness that changes with the sign of the motion shows only there: it scales
    with the level.
    """
    if levels_disagree(check):
        return "runs of different level disagree"
    loudest = [float(np.quantile(list(times.values()), LOUDEST)) for times in beyond_rest(check, idle_frf) if times]
    return _held("the responses in operation hold", max(loudest, default=0.0))


def suspicion_at(effects: Sequence[Effect], check: Sequence[CheckRun], idle_frf: Frf | None = None) -> str | None:
    """Why linear effects may stand for one that is not linear, or None: by the responses at their own locations.

    A stiffness that changes with the sign of the motion has the FRFs of a spring at every level; what it adds beside is largest at its own
    location.
    """
    here = {dof.key: dof for effect in effects if effect.definition.group not in ("sensor", "force") for dof in effect.location}
    at = [(times, here[key]) for run in beyond_rest(check, idle_frf) for key, times in run.items() if key in here]
    most, dof = max(at, key=lambda row: row[0], default=(0.0, None))
    return _held(f"the response at {dof} holds", most)


def _held(what: str, times: float) -> str | None:
    if not times > DISTORTION:
        return None
    return f"{what} {times:.3g} times as much as in the idle state that is not proportional to the force"


def beyond_rest(check: Sequence[CheckRun], idle_frf: Frf | None) -> list[dict[tuple[Node, str], float]]:
    """Of each run and response: how many times as much is not proportional to the force as at rest."""
    quiet = {} if idle_frf is None else unexplained(idle_frf)
    return [{dof: value / quiet[dof] for dof, value in unexplained(run.frf).items() if quiet.get(dof, 0) > 0} for run in check]


def unexplained(frf: Frf) -> dict[tuple[Node, str], float]:
    """Share of each response's power that is not proportional to the forces, in the median over lines."""
    if frf.variance is None:
        return {}
    size = np.abs(frf.data) ** 2
    out = {}
    for dof, variance, power in zip(frf.responses, frf.variance, size, strict=True):
        good = np.isfinite(variance) & np.isfinite(power) & (power > 0)
        if good.any():
            out[dof.key] = float(np.median(variance[good] / power[good]) * (frf.averages or 1.0))
    return out


def diagnose_levels(
    linear: Callable[[], Diagnosis] | None,
    idle: ModalModel,
    check: Sequence[CheckRun],
    records: Sequence[TimeRecord],
    *,
    idle_frf: Frf | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    geometry: Geometry | None = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
    compared: Mapping[str, Any] | None = None,
    between: Mapping[str, float] | None = None,
) -> Diagnosis:
    """The diagnosis from the records where something depends on the level, else the linear one; options as in :func:`operando.diagnose`.

    ``linear`` makes the diagnosis from the check FRFs; None where there are none, and the records alone decide.
    """

    of_frfs: dict[str, Any] = {"band": band, "geometry": geometry, "idle_frf": idle_frf, "between": between}
    of_records: dict[str, Any] = {"geometry": geometry, "kinds": kinds, "places": places, "band": band, "exclude_bands": exclude_bands}

    def look() -> RecordsDiagnosis:
        """Against the idle model as it is, then as it is on the day of the lowest level's FRFs where these speak of another one."""
        seen = diagnose_records(idle, records, progress=progress, **of_records)
        return on_that_day(seen, linear_at(seen, chosen_run(check))) if check else seen

    def on_that_day(seen: RecordsDiagnosis, effects: Sequence[Effect]) -> RecordsDiagnosis:
        """The day beside linear effects, then beside the mean springs and dampers of what the records say then, while they say more."""
        run = chosen_run(check)

        def on(day: Day, words: str) -> RecordsDiagnosis:
            if progress:
                progress(f"look at the records with what differs between the days by {run.name}")
            other = diagnose_records(idle, records, progress=progress, day=day, **of_records)
            return replace(other, notes=(*other.notes, words.format(run=run.name)))

        def beside(linear: Sequence[Effect]) -> RecordsDiagnosis | None:
            day = day_of(idle, linear, run, progress, **of_frfs)
            return None if day is None else on(day, OF_A_DAY)

        for _ in range(DAYS):
            try:
                other = beside(effects)
                if other is None:
                    break
                # A day beside nothing may be what the FRFs hold of a law; the location shows all the same.
                tried = [row for row in other.candidates if row["selection_misfit"] is not None]
                if tried and not (seen.nonlinear or other.nonlinear):
                    best = Effect.from_dict(tried[0]).location
                    other = beside(spring_and_damper(best, band or idle.band_hz)) or other
                if not (seen.nonlinear or other.nonlinear):
                    other = on(usual_day(idle, between or {}), OF_ANY_DAY)
            except OperandoError as error:
                return replace(seen, notes=(*seen.notes, NO_DAY.format(why=error.message)))
            if not _says_more(other, seen):
                break
            seen, effects = other, linear_at(other, run)
        return seen

    def told(seen: RecordsDiagnosis, words: Sequence[str] = ()) -> RecordsDiagnosis:
        return with_days(merged(seen, idle, check, band, compared, words), idle, check, progress=progress, **of_frfs)

    if linear is None:
        return told(look())
    notes: list[str] = []

    def seen_because(reason: str) -> RecordsDiagnosis | None:
        if progress:
            progress(f"look at the records: {reason}")
        try:
            seen = look()
        except OperandoError as error:
            notes.append(f"{reason}; the records cannot tell why: {error.message}")
            return None
        if not seen.nonlinear:
            notes.append(f"{reason}, but no level-dependent effect of the catalogue improves the model")
        return seen

    unused: tuple[str, ...] = ()
    try:
        times = measured_distortion(idle, records, band, exclude_bands)
    except OperandoError as error:
        times, unused = None, (f"the levels of the records were not compared: {error.message}",)
    more = times is not None and times > FAINT
    levels = levels_disagree(check) or more
    reason = suspicion(check, idle_frf)
    if reason is None and more:
        # A law of even order, or one that what differs between the days hides, leaves FRFs as they are: only records tell.
        reason = f"the higher level holds at least {times:.3g} times as much as the lower one that is not proportional to the force"
    seen = None if reason is None else seen_because(reason)
    if reason is None or seen is None or not seen.nonlinear:
        found = linear()
        if reason is None and found.verdict in SURE:
            reason = suspicion_at(found.effects, check, idle_frf)
            seen = None if reason is None else seen_because(reason)
        if reason is None and found.model is not None:
            try:
                reason = "; ".join(str(row) for row in sizes_by_level(found.model, records, band) if row.changes) or None
            except OperandoError as error:
                unused = (f"sizes of effects were not compared between levels: {error.message}",)
            if reason is not None:
                levels, seen = True, seen_because(reason)
        if check and seen is not None and not seen.nonlinear and found.effects:
            # What stands for the law at the lowest level leaves the day as it is.
            seen = on_that_day(seen, found.effects)
        found = replace(found, notes=(*found.notes, *notes, *unused)) if notes or unused else found
    if reason is not None and seen is not None and seen.nonlinear:
        return told(seen, (reason,))
    if reason is not None:
        # Where levels agree and linear effects leave what noise does, more than at rest that is not proportional to the force is noise.
        if found.verdict in SURE and (levels or (seen is None and found.verdict == "explained")):
            left = "partial" if found.effects else "unexplained"
            found = replace(found, verdict=left, reason=f"{reason}, and no effect found so far says why")
        return found
    # Where nothing of the records depends on the level, no law of theirs says what linear effects do not.
    quiet = times is not None and all(run and max(run.values()) <= DISTORTION for run in beyond_rest(check, idle_frf))
    if found.verdict in SURE or unused or quiet:
        return found
    try:
        if progress:
            progress(f"look at the records: the linear diagnosis is {found.verdict}")
        seen = look()
    except OperandoError as error:
        return replace(found, notes=(*found.notes, f"the records were not used: {error.message}"))
    return told(seen) if seen.nonlinear and seen.verdict in SURE else found


def spring_and_damper(location: Sequence[Dof], band: tuple[float, float] | None) -> list[Effect]:
    """What FRFs of one level know a law at a location by, with the sizes that a fit begins at."""
    kind, place = "coupling" if len(location) == 2 else "ground", ",".join(map(str, location))
    return [parse_effect(f"{kind}_{part}@{place}", band) for part in ("spring", "damper")]


def _says_more(one: RecordsDiagnosis, other: RecordsDiagnosis) -> bool:
    """Whether one diagnosis says more of level-dependent effects: surely, or with less error on the hold-out set.

    In dB, for what differs between the days counts as noise where it is not known: chi-squares are not of one noise.
    """
    if not one.nonlinear or not other.nonlinear:
        return bool(one.nonlinear)
    left = [(d.verdict not in SURE, d.ladder[-1]["heldout_error_db"]) for d in (one, other)]
    return left[0] < left[1]


def merged(
    seen: RecordsDiagnosis,
    idle: ModalModel,
    check: Sequence[CheckRun],
    band: tuple[float, float] | None,
    compared: Mapping[str, Any] | None = None,
    words: Sequence[str] = (),
) -> RecordsDiagnosis:
    """The diagnosis from the records, with where the idle model fails by the check FRFs."""
    picture, notes = with_levels(seen, idle, check, band)
    seen = replace(seen, picture=picture, notes=(*words, *seen.notes, *notes))
    if not check:
        return seen
    where, by_level = where_and_levels(idle, check, band or idle.band_hz, compared)
    return replace(seen, where=where, by_level=by_level, data=("check_frf", *seen.data))


def with_days(seen: RecordsDiagnosis, idle: ModalModel, check: Sequence[CheckRun], **options: Any) -> RecordsDiagnosis:
    """The diagnosis from the records with what differs between the two measurements, or the words why that is not known.

    Gains of sensors and forces are no unknowns of the fit to records. The FRFs of one level are those of the idle model with linear effects
    and the mean springs and dampers of that level: with these they are fitted again, beginning at the highest level, up to the first one
    that they explain.

    ``options`` are of :func:`operando.apply_effects`.
    """

    def unknown(why: str) -> RecordsDiagnosis:
        return replace(seen, notes=(*seen.notes, f"what differs between the two measurements is not known: {why}"))

    if not check:
        return unknown("it is estimated from FRFs of the validation measurement, and there are none")
    left = []
    for run in sorted(check, key=lambda run: -(run.force_n or 0.0)):
        try:
            applied = apply_effects(idle, linear_at(seen, run), check=run, **options)
        except OperandoError as error:
            left.append(f"{run.name}: {error.message}")
            continue
        share = float((applied.discrepancy or {}).get("value") or 0.0)
        if share <= EXPLAINED:
            return replace(seen, between=applied.between, notes=seen.notes if applied.between else (*seen.notes, UNTOUCHED))
        left.append(f"{100 * share:.2g} % of the FRFs of {run.name} stay unexplained")
    mean = " with the mean springs and dampers of its level" if seen.nonlinear else ""
    return unknown(f"{'; '.join(left)}{mean}; no more than {100 * EXPLAINED:g} % may")


def linear_at(seen: RecordsDiagnosis | RecordsApplied, run: CheckRun) -> list[Effect]:
    """The effects as FRFs of a run have them: of level-dependent ones the mean spring and damper of records at its level, or of all."""
    out: list[Effect] = []
    for effect, rows in zip(seen.effects, seen.equivalents, strict=True):
        same = [row for row in rows if run.force_n and one_level(row.level, run.force_n)]
        out += linear_effects(effect, same or rows) if rows else [effect]
    return out


def with_levels(
    seen: RecordsDiagnosis | RecordsApplied, idle: ModalModel, check: Sequence[CheckRun], band: tuple[float, float] | None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The picture with FRFs at the levels measured and at twice the highest; and why there are none."""
    levels = sorted({row.level for rows in seen.equivalents for row in rows})
    try:
        made = level_picture(idle, seen.effects, check, levels, band)
    except OperandoError as error:
        return seen.picture, (f"no FRFs at other levels: {error.message}",)
    return (seen.picture | {"levels": made} if made else seen.picture), ()


def standing(document: Mapping[str, Any]) -> list[Effect]:
    """The effects of ``diagnosis.json`` as a linear model knows them: of a level-dependent one its equivalent at the lowest level."""
    out: list[Effect] = []
    for stated in document.get("effects") or []:
        effect = Effect.from_dict(stated)
        if effect.definition.acts != "pseudo_force":
            out.append(effect)
            continue
        if not stated.get("equivalents"):
            raise MissingError(
                f"{effect.kind} at {effect.place} depends on the level: without records it has no FRF",
                hint="run the diagnosis with the records of the validation measurement",
            )
        out += linear_effects(effect, [LinearEquivalent.from_dict(row) for row in stated["equivalents"]])
    return out
