"""FRFs of the model with level-dependent effects at levels of the force that were not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from operando.data import Frf, ModalModel, one_level
from operando.dof import parse_dofs
from operando.errors import MissingError
from operando.results import CheckRun, Results
from operando.structure import Model, at_level
from operando.structure.effects import Effect
from operando.threads import one_blas_thread

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
) -> Frf:
    """What an FRF measurement would find under a random force of this size: the best linear model of the running structure there.

    Each reference is driven by itself; level-dependent effects stand in its column as the spring and damper that they are equivalent to
    then: idle model, effects, level and band as for :func:`operando.structure.at_level`, which raises; the rest as for ``Model.frf``.
    """
    driven = idle.dofs if references is None else tuple(parse_dofs(references))
    columns: list[Frf] = []
    with one_blas_thread():
        for reference in driven:
            standing = at_level(idle, effects, level, reference, band)
            columns.append(Model(idle, tuple(standing)).frf(frequencies, responses, (reference,), quantity, variance=False))
    return replace(columns[0], data=np.concatenate([c.data for c in columns], axis=1), references=driven)


@dataclass(frozen=True)
class LevelModel:
    """The idle model with effects on the structure under a random force of given size; predicts FRFs like any model."""

    idle: ModalModel
    effects: tuple[Effect, ...]
    level: float  # rms of the force [N]
    band: tuple[float, float] | None = None  # of the force [Hz]

    @classmethod
    def of(cls, results: Results, level: float) -> LevelModel:
        """From a results folder; linear effects as the diagnosis left them, channel faults left out.

        Raises
        ------
        MissingError
            If there is no diagnosis.
        """
        if results.diagnosis is None or results.idle is None:
            raise MissingError("there is no model with accepted effects", hint="run the test to the stage diagnose")
        effects = [Effect.from_dict(e) for e in results.diagnosis.get("effects") or []]
        kept = tuple(e for e in effects if e.definition.group in ("structure", "idle"))
        band = results.settings.get("band")
        return cls(results.effect_idle or results.idle, kept, level, (float(band[0]), float(band[1])) if band else None)

    def frf(self, frequencies: ArrayLike, responses: Any = None, references: Any = None, quantity: str = "accelerance") -> Frf:
        """FRFs at the level; see :func:`level_frf`."""
        return level_frf(self.idle, self.effects, self.level, frequencies, responses, references, quantity, band=self.band)


def level_picture(
    idle: ModalModel, effects: Sequence[Effect], check: Sequence[CheckRun], levels: Sequence[float], band: tuple[float, float] | None
) -> dict[str, Any]:
    """FRFs of the model at the levels measured [N rms] and at twice the highest, and what was measured, for one pair of DOFs.

    Returns
    -------
    dict
        ``response``, ``reference``, ``frequencies_hz``, ``curves`` [{force_n, measured (bool), magnitude}], ``runs`` [{name, level,
        unit, level_name, frequencies_hz, magnitude}]; accelerances [(m/s²)/N]. Empty without a level-dependent effect or an FRF.

    Raises
    ------
    DataError
        If no steady motion is found at a level.
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
