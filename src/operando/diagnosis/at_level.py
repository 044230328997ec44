"""FRFs of the model with level-dependent effects at levels of the force that were not measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from operando.data import Frf, ModalModel, one_level
from operando.diagnosis.document import discrepancy_of
from operando.dof import Dof, parse_dofs
from operando.errors import DataError, MissingError
from operando.results import CheckRun, Results
from operando.structure import LinearEquivalent, Model, at_level, linear_effects
from operando.structure.effects import Effect
from operando.threads import one_blas_thread

if TYPE_CHECKING:
    from operando.compare import Comparison
    from operando.diagnosis.records.result import Equivalents

TWICE = 2.0
"""Level beyond those measured that the report shows."""

DRAWN = 500
"""Lines of the figure."""


def level_frf(
    idle: ModalModel,
    effects: Sequence[Effect],
    level: float,
    frequencies: ArrayLike,
    responses: Any = None,
    references: Any = None,
    quantity: str = "accelerance",
    *,
    band: tuple[float, float] | None = None,
    variance: bool = False,
    discrepancy: float = 0.0,
    known: Sequence[Sequence[LinearEquivalent]] = (),
) -> Frf:
    """What an FRF measurement would find under a random force of this size: the best linear model of the running structure there.

    Each reference is driven by itself; level-dependent effects stand in its column as the spring and damper that they are equivalent to
    then: idle model, effects, level and band as for :func:`operando.structure.at_level`, which raises; the rest as for ``Model.frf``.
    Of ``known`` equivalents, one tuple an effect, those of records at this level and reference are taken as they are. The variance is
    that of the idle model, with the discrepancy.
    """
    driven = idle.dofs if references is None else tuple(parse_dofs(references))
    columns: list[Frf] = []
    with one_blas_thread():
        for reference in driven:
            standing = _recorded(effects, known, level, reference) or at_level(idle, effects, level, reference, band)
            model = Model(idle, tuple(standing), discrepancy=discrepancy)
            columns.append(model.frf(frequencies, responses, (reference,), quantity, variance=variance))
    own = [c.variance for c in columns if c.variance is not None]
    together = np.concatenate(own, axis=1) if own else None
    return replace(columns[0], data=np.concatenate([c.data for c in columns], axis=1), references=driven, variance=together)


def _recorded(effects: Sequence[Effect], known: Sequence[Sequence[LinearEquivalent]], level: float, reference: Dof) -> list[Effect]:
    """Effects as records at a level and reference have them; empty where there is no such record."""
    out: list[Effect] = []
    for effect, rows in zip(effects, known, strict=bool(known)):
        same = [row for row in rows if row.at(level, reference)]
        if effect.definition.level_dependent and not same:
            return []
        out += linear_effects(effect, same) if same else [effect]
    return out


@dataclass(frozen=True)
class LevelModel:
    """The idle model with effects on the structure under a random force of given size; predicts FRFs like any model."""

    idle: ModalModel
    effects: tuple[Effect, ...]
    level: float  # rms of the force [N]
    band: tuple[float, float] | None = None  # of the force [Hz]
    discrepancy: float = 0.0
    known: Equivalents = ()  # of each effect, in records

    @classmethod
    def of(cls, results: Results, level: float, changes: Sequence[tuple[int, str, float]] = ()) -> LevelModel:
        """From a results folder; linear effects as the diagnosis left them, channel faults left out.

        ``changes`` are (step, parameter, value): a state that was not measured.
        """
        if results.diagnosis is None or results.idle is None:
            raise MissingError("there is no model with accepted effects", hint="run the test to the stage diagnose")
        given = results.diagnosis.get("effects") or []
        model = Model(results.idle, tuple(Effect.from_dict(e) for e in given))
        for step, name, value in changes:
            model = model.with_values(step, **{name: value})
        band = results.settings.get("band")
        band = (float(band[0]), float(band[1])) if band else None
        # records say nothing of other values
        return _of(replace(model, idle=results.effect_idle or results.idle), () if changes else given, level, band, results.diagnosis)

    def frf(self, frequencies: ArrayLike, responses: Any = None, references: Any = None, quantity: str = "accelerance") -> Frf:
        """FRFs at the level; see :func:`level_frf`."""
        more: dict[str, Any] = {"band": self.band, "variance": True, "discrepancy": self.discrepancy, "known": self.known}
        return level_frf(self.idle, self.effects, self.level, frequencies, responses, references, quantity, **more)

    @property
    def words(self) -> str:
        """At which force the effects are linearised."""
        return f"level-dependent effects are linearised under {self.level:.4g} N rms, for each reference by itself"


def _of(
    model: Model, stated: Sequence[Mapping[str, Any]], level: float, band: tuple[float, float] | None, document: Mapping[str, Any]
) -> LevelModel:
    """The effects on the structure at a level, with the equivalents in records that ``diagnosis.json`` states of them."""
    rows = [tuple(LinearEquivalent.from_dict(row) for row in e.get("equivalents") or []) for e in stated]
    kept = [i for i, e in enumerate(model.effects) if e.definition.group in ("structure", "idle")]
    known = tuple(rows[i] for i in kept) if rows else ()
    return LevelModel(model.idle, tuple(model.effects[i] for i in kept), level, band, discrepancy_of(document), known)


@dataclass(frozen=True)
class FollowingModel:
    """The idle model with level-dependent effects, to be compared at the force of each measurement.

    ``at_level`` has the effects themselves, ``standing`` their equivalents at the lowest level measured: for where no force is known, or no
    steady motion belongs to it.
    """

    standing: Model
    at_level: LevelModel

    @property
    def idle(self) -> ModalModel:
        """The idle model."""
        return self.standing.idle

    def frf(self, frequencies: ArrayLike, responses: Any = None, references: Any = None, quantity: str = "accelerance") -> Frf:
        """FRFs at the lowest level measured, in the mean over the records there."""
        return self.standing.frf(frequencies, responses, references, quantity)

    def compared(self, compare: Callable[[Any], Comparison], force_n: float | None) -> Comparison:
        """The comparison with a measurement under a force [N rms]; its notes state what the effects are linearised under."""
        why = "the measurement states no force"
        if force_n is not None:
            model = replace(self.at_level, level=force_n)
            try:
                found = compare(model)
            except DataError as error:
                why = error.message
            else:
                return replace(found, notes=(*found.notes, model.words))
        found = compare(self.standing)
        mean = f"level-dependent effects are linearised at the lowest level measured, in the mean over its records: {why}"
        return replace(found, notes=(*found.notes, mean))


def following(model: Model, document: Mapping[str, Any], band: tuple[float, float] | None) -> Model | FollowingModel:
    """The model as it is compared with measurements: with level-dependent effects of ``diagnosis.json`` at the force of each."""
    stated = document.get("effects") or []
    effects = tuple(Effect.from_dict(e) for e in stated)
    if not any(e.definition.level_dependent for e in effects):
        return model
    return FollowingModel(model, _of(Model(model.idle, effects), stated, math.nan, band, document))


def lowest_force(document: Mapping[str, Any]) -> float | None:
    """Lowest level [N rms] at which level-dependent effects of ``diagnosis.json`` have an equivalent; None where there are none."""
    return min((float(row["level"]) for e in document.get("effects") or [] for row in e.get("equivalents") or []), default=None)


def level_picture(
    idle: ModalModel, effects: Sequence[Effect], check: Sequence[CheckRun], levels: Sequence[float], band: tuple[float, float] | None
) -> dict[str, Any]:
    """FRFs of the model at the levels measured [N rms] and at twice the highest, and what was measured, for one pair of DOFs.

    ``response``, ``reference``, ``frequencies_hz``, ``curves`` [{force_n, measured (bool), magnitude}], ``runs`` [{name, level, unit,
    level_name, frequencies_hz, magnitude}]; accelerances [(m/s²)/N]. Empty without a level-dependent effect or an FRF.
    """
    varying = [e for e in effects if e.definition.level_dependent]
    if not varying or not check or not levels:
        return {}
    low, high = band or idle.band_hz or (float(idle.frequencies_hz.min()), float(idle.frequencies_hz.max()))
    hz = np.linspace(low, high, DRAWN)
    first = check[0].frf
    reference, response = first.references[0], varying[0].location[0]
    if not any(d.same_axis(response) for d in first.responses):
        response = reference
    top, least = max(levels), min(levels)
    shown = [least, top, TWICE * top] if not one_level(least, top) else [top, TWICE * top]
    curves = [
        {
            "force_n": float(level),
            "measured": level <= top,
            "magnitude": np.abs(level_frf(idle, effects, level, hz, (response,), (reference,), band=(low, high)).data[0, 0]).tolist(),
        }
        for level in shown
    ]
    runs = []
    for run in check:
        own = [i for i, d in enumerate(run.frf.responses) if d.same_axis(response)]
        driven = [j for j, d in enumerate(run.frf.references) if d.same_axis(reference)]
        if own and driven:
            inside = (run.frf.frequencies_hz >= low) & (run.frf.frequencies_hz <= high)
            step = max(1, int(np.sum(inside)) // DRAWN)
            size = np.abs(run.frf.data[own[0], driven[0]][inside])[::step]
            good = np.isfinite(size)
            row = {"name": run.name, **run.stated_level(), "frequencies_hz": run.frf.frequencies_hz[inside][::step][good].tolist()}
            runs.append(row | {"magnitude": size[good].tolist()})
    return {"response": str(response), "reference": str(reference), "frequencies_hz": hz.tolist(), "curves": curves, "runs": runs}
