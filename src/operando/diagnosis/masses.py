"""Masses beside level-dependent effects: sized by FRFs, and held where the others are fitted to records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from operando.data import ModalModel, TimeRecord
from operando.diagnosis.applied import Applied
from operando.diagnosis.by_hand import apply_effects
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.records import RecordsApplied, apply_to_records
from operando.errors import OperandoError
from operando.results import CheckRun
from operando.structure.effects import Effect, parse_effect


def apply_with_masses(
    idle: ModalModel,
    effects: Sequence[Effect],
    records: Sequence[TimeRecord],
    check: Sequence[CheckRun],
    exclude_bands: Sequence[tuple[float, float]] = (),
    frf_options: dict[str, Any] | None = None,
    **options: Any,
) -> RecordsApplied:
    """:func:`apply_to_records`, with masses sized by the FRFs of the same records.

    A spring and a damper stand in the FRFs of each level for a level-dependent effect; the level whose FRFs they explain best counts.

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
    applied = apply_to_records(idle, effects, records, exclude_bands=exclude_bands, **options)
    return replace(applied, words=(*applied.words, *words))


def _sized(idle: ModalModel, effects: Sequence[Effect], check: Sequence[CheckRun], options: dict[str, Any]) -> tuple[Applied | None, str]:
    """The fit of a spring and a damper for each level-dependent effect to FRFs of one run, and which; or None, and why."""
    linear: list[Effect] = []
    for e in effects:
        name = "coupling" if len(e.location) == 2 else "ground"
        place = ",".join(map(str, e.location))
        kinds = (f"{name}_spring", f"{name}_damper") if e.definition.level_dependent else ()
        linear += [parse_effect(f"{kind}@{place}", options.get("band") or idle.band_hz) for kind in kinds] or [e]
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


def _named(masses: Sequence[Effect]) -> str:
    return " and ".join(f"point_mass at {e.place}" for e in masses) + (" is" if len(masses) == 1 else " are")
