"""Effects fitted to records, with what the FRFs of the same measurement say: sizes of masses, and what the day was."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from operando.data import ModalModel, TimeRecord
from operando.diagnosis.another_day import day_of
from operando.diagnosis.applied import Applied
from operando.diagnosis.arguments import chosen_run
from operando.diagnosis.by_hand import apply_effects
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.records import Day, RecordsApplied, apply_to_records
from operando.diagnosis.records_and_days import NO_DAY, OF_A_DAY, ONE_DAY, day_again, spring_and_damper
from operando.errors import IdentificationError, OperandoError
from operando.results import CheckRun
from operando.structure.effects import Effect


def apply_with_frfs(
    idle: ModalModel,
    effects: Sequence[Effect],
    records: Sequence[TimeRecord],
    check: Sequence[CheckRun],
    exclude_bands: Sequence[tuple[float, float]] = (),
    frf_options: dict[str, Any] | None = None,
    **options: Any,
) -> RecordsApplied:
    """:func:`apply_to_records`, with masses sized by the FRFs of the same records, and on the day of these FRFs.

    A spring and a damper stand in the FRFs of each level for a level-dependent effect; the level whose FRFs they explain best counts.
    Without masses, records that the effects leave unexplained are held against the idle model on the day of the FRFs, too, and that counts
    where they are more probable with it.

    ``options`` are of both :func:`apply_to_records` and :func:`operando.apply_effects`, ``frf_options`` of the latter alone.
    """
    masses = [e for e in effects if e.kind == "point_mass" and not e.fixed]
    words: list[str] = []
    if masses and any(e.definition.level_dependent for e in effects):
        sized, why = _sized(idle, effects, check, options | (frf_options or {}))
        if sized is None:
            words.append(f"{_named(masses)} held at the values given: {why}")
        else:
            size = {e.place: e for e in sized.effects if e.kind == "point_mass"}
            effects = [size[e.place] if e in masses else e for e in effects]
            words.append(f"{_named(masses)} sized by the FRFs of {why}; the other effects are fitted to the records with it")
    look = partial(apply_to_records, idle, effects, records, exclude_bands=exclude_bands, **options)
    tried: list[RecordsApplied] = []
    refused: OperandoError | None = None
    try:
        tried.append(look())
    except IdentificationError as error:
        refused = error
    explained = bool(tried) and tried[0].ladder[-1]["heldout_misfit"] < ONE_DAY
    if check and not explained and not any(e.kind == "point_mass" for e in effects):
        try:
            for applied in _on_days(look, idle, effects, chosen_run(check), options, frf_options or {}):
                tried.append(applied)  # what is found on the first day stays where the second is refused
        except OperandoError as error:
            words.append(NO_DAY.format(why=error.message))
    if refused is not None and not tried:
        raise refused
    applied = min(tried, key=lambda one: one.log_score)
    if any(left < applied.ladder[-1]["heldout_misfit"] for _, _, left in tried[0].better):
        applied = tried[0]  # a day may stand for the effect that was not chosen
    return replace(applied, words=(*applied.words, *words))


def _on_days(
    look: Callable[..., RecordsApplied],
    idle: ModalModel,
    effects: Sequence[Effect],
    run: CheckRun,
    options: dict[str, Any],
    frf_options: dict[str, Any],
) -> Iterator[RecordsApplied]:
    """The effects in records that are held against the idle model on the days of the FRFs of a run."""
    of_day = {name: options.get(name) for name in ("band", "geometry")} | {"idle_frf": None, "between": None} | frf_options

    def beside(linear: Sequence[Effect], measured: CheckRun) -> Day | None:
        return day_of(idle, linear, measured, options.get("progress"), **of_day)

    def on(day: Day) -> RecordsApplied:
        applied = look(day=day)
        return replace(applied, words=(*applied.words, OF_A_DAY.format(run=run.name)))

    day = beside(_linear(effects, of_day["band"] or idle.band_hz), run)
    if day is not None:
        first = on(day)
        yield first
        again = day_again(beside, first, run)
        if again is not None:
            yield on(again)


def _sized(idle: ModalModel, effects: Sequence[Effect], check: Sequence[CheckRun], options: dict[str, Any]) -> tuple[Applied | None, str]:
    """The fit of a spring and a damper for each level-dependent effect to FRFs of one run, and which; or None, and why."""
    linear = _linear(effects, options.get("band") or idle.band_hz)
    best, why = None, "there are no FRFs of the validation measurement"
    least = float("inf")
    for run in check:
        try:
            made = apply_effects(idle, linear, check=run, **options)
        except OperandoError as error:
            why = why if best else f"{run.name}: {error.message}"
            continue
        share = float((made.discrepancy or {}).get("value") or 0.0)
        if share < least:
            best, least, why = made, share, run.name
    if best is not None and least > EXPLAINED:
        why += f", of which {100 * least:.2g} % stay unexplained"
    return best, why


def _linear(effects: Sequence[Effect], band: tuple[float, float] | None) -> list[Effect]:
    """Effects as FRFs know them: a spring and a damper for each that depends on the level."""
    return [part for e in effects for part in (spring_and_damper(e.location, band) if e.definition.level_dependent else [e])]


def _named(masses: Sequence[Effect]) -> str:
    return " and ".join(f"point_mass at {e.place}" for e in masses) + (" is" if len(masses) == 1 else " are")
