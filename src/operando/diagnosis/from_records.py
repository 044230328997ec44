"""Where the running structure does not behave linearly: the diagnosis from its records instead of its FRFs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from operando.compare.verdict import SURE
from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.diagnosis.another_day import between_beside
from operando.diagnosis.at_level import level_picture
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.records import RecordsApplied, RecordsDiagnosis, measured_distortion
from operando.diagnosis.records_and_days import RecordsAndDays, linear_at
from operando.diagnosis.result import Diagnosis, where_and_levels
from operando.diagnosis.size_by_level import levels_disagree, sizes_by_level
from operando.diagnosis.suspicion import FAINT, distorted_at_two, suspicion, suspicion_at
from operando.errors import MissingError, OperandoError
from operando.results import CheckRun
from operando.structure import LinearEquivalent, has_restoring_force, linear_effects
from operando.structure.effects import Effect

UNTOUCHED = (
    "the validation FRFs are as probable with nothing touched between the idle and the operating measurement; gains, positions of "
    "sensors, temperature and damping count as the same"
)


def need_records(effects: Sequence[Effect], data: Sequence[str] = ()) -> bool:
    """Whether effects depend on the level, so that FRFs cannot size them; or records made the diagnosis and can size these, too."""
    if any(e.definition.acts == "pseudo_force" for e in effects):
        return True
    return "check_records" in data and all(has_restoring_force(e) for e in effects)


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

    wanted = {"kinds": kinds, "places": places, "exclude_bands": exclude_bands}
    looks = RecordsAndDays(idle, check, records, band, geometry, idle_frf, between, progress, wanted)

    def told(seen: RecordsDiagnosis, words: Sequence[str] = ()) -> RecordsDiagnosis:
        return with_days(merged(seen, idle, check, band, compared, words), idle, check, progress=progress, **looks.of_frfs)

    if linear is None:
        return told(looks.look())
    notes: list[str] = []

    def seen_because(reason: str) -> RecordsDiagnosis | None:
        looks.say(f"look at the records: {reason}")
        try:
            seen = looks.look()
        except OperandoError as error:
            notes.append(f"{reason}; the records cannot tell why: {error.message}")
            return None
        if not seen.nonlinear:
            notes.append(f"{reason}, but the records support no level-dependent effect of the catalogue")
        return seen

    times, unused = _at_the_higher_level(idle, records, band, exclude_bands)
    more = times is not None and times > FAINT
    levels = levels_disagree(check) or more
    reason = suspicion(check, idle_frf)
    if reason is None and more:
        # A law of even order, or one that what differs between the days hides, leaves FRFs as they are: only records tell.
        reason = f"the higher level holds at least {times:.3g} times as much as the lower one that is not proportional to the force"
    seen = None if reason is None else seen_because(reason)
    if reason is not None and seen is not None and seen.nonlinear:
        return told(seen, (reason,))
    found = linear()
    if reason is None:
        if found.verdict in SURE:
            reason = suspicion_at(found.effects, check, idle_frf)
        if reason is None:
            reason, why_not = _by_sizes(found, records, band)
            unused, levels = (*unused, *why_not), levels or reason is not None
        seen = None if reason is None else seen_because(reason)
    if check and seen is not None and not seen.nonlinear and seen.verdict != "no_misfit" and found.effects:
        # What stands for the law at the lowest level leaves the day as it is.
        seen = looks.on_that_day(seen, found.effects)
    found = replace(found, notes=(*found.notes, *notes, *unused)) if notes or unused else found
    if reason is not None:
        if seen is not None and seen.nonlinear:
            return told(seen, (reason,))
        # Where levels agree and linear effects leave what noise does, more than at rest that is not proportional to the force is noise.
        if found.verdict in SURE and (levels or (seen is None and found.verdict == "explained")):
            left = "partial" if found.effects else "unexplained"
            found = replace(found, verdict=left, reason=f"{reason}, and no effect found so far says why")
        return found
    # Where nothing of the records depends on the level, no law of theirs says what linear effects do not.
    quiet = times is not None and not distorted_at_two(check, idle_frf)
    if found.verdict in SURE or unused or quiet:
        return found
    try:
        looks.say(f"look at the records: the linear diagnosis is {found.verdict}")
        seen = looks.look()
    except OperandoError as error:
        return replace(found, notes=(*found.notes, f"the records were not used: {error.message}"))
    return told(seen) if seen.nonlinear and seen.verdict in SURE else found


def _at_the_higher_level(
    idle: ModalModel, records: Sequence[TimeRecord], band: tuple[float, float] | None, exclude_bands: Sequence[tuple[float, float]]
) -> tuple[float | None, tuple[str, ...]]:
    """Times that the higher level surely holds what is not proportional to the force, or why that is not known."""
    try:
        return measured_distortion(idle, records, band, exclude_bands), ()
    except OperandoError as error:
        return None, (f"the levels of the records were not compared: {error.message}",)


def _by_sizes(found: Diagnosis, records: Sequence[TimeRecord], band: tuple[float, float] | None) -> tuple[str | None, tuple[str, ...]]:
    """Effects found in FRFs whose size depends on the level of the records, in words; or why that is not known."""
    if found.model is None:
        return None, ()
    try:
        return "; ".join(str(row) for row in sizes_by_level(found.model, records, band) if row.changes) or None, ()
    except OperandoError as error:
        return None, (f"sizes of effects were not compared between levels: {error.message}",)


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
    that they explain. Records that were held against another day have it from the FRFs of that day already.

    ``options`` are of :func:`operando.diagnosis.another_day.between_beside`.
    """

    def unknown(why: str) -> RecordsDiagnosis:
        return replace(seen, notes=(*seen.notes, f"what differs between the two measurements is not known: {why}"))

    if seen.between is not None:
        return seen
    if not check:
        return unknown("it is estimated from FRFs of the validation measurement, and there are none")
    left = []
    for run in sorted(check, key=lambda run: -(run.force_n or 0.0)):
        try:
            between, share = between_beside(idle, linear_at(seen, run), run, **options)
        except OperandoError as error:
            left.append(f"{run.name}: {error.message}")
            continue
        if share <= EXPLAINED:
            return replace(seen, between=between, notes=seen.notes if between else (*seen.notes, UNTOUCHED))
        left.append(f"{100 * share:.2g} % of the FRFs of {run.name} stay unexplained")
    mean = " with the mean springs and dampers of its level" if seen.nonlinear else ""
    return unknown(f"{'; '.join(left)}{mean}; no more than {100 * EXPLAINED:g} % may")


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
