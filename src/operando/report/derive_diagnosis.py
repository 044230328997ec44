"""Numbers behind the figures of the diagnosis: the model with the effects, hold-out lines, error maps, the two routes to the OFRFs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare import clear_lines, level_error_db, rms_over
from operando.compare.measures import band_masks
from operando.data import Frf
from operando.errors import DataError, OperandoError
from operando.report import derive
from operando.results import CheckRun, Results

MAP_LINES = 3000
"""Lines of a map or of the comparison of the two routes, at most."""

DECIBEL = 8.685889638065035
"""dB of a relative change of one: 20/ln 10."""


def effect_model(results: Results) -> Any:
    """The idle model with the effects now in the diagnosis (:func:`operando.diagnosis.stored.effect_model`); None where there is none."""
    from operando.diagnosis.stored import effect_model as stored

    try:
        try:
            return stored(results)
        except DataError:  # a covariance of other effects
            return stored(replace(results, effect_covariance=None))
    except (OperandoError, KeyError, TypeError, ValueError):
        return None


def hold_out_ranges(results: Results, run: CheckRun) -> tuple[list[tuple[float, float]], bool]:
    """Frequency ranges of a validation measurement [Hz] in the hold-out set, and whether that is all of it."""
    hold_out = (results.diagnosis or {}).get("judged_on") or {}
    if run.name not in (hold_out.get("runs") or ()):
        return [], False
    return [(float(low), float(high)) for low, high in hold_out.get("ranges_hz") or []], bool(hold_out.get("whole_run"))


def every(frf: Frf, most: int = MAP_LINES) -> Frf:
    """One line in so many that at most ``most`` are left."""
    step = max(1, -(-len(frf.axis) // most))
    return frf if step == 1 else frf.decimate(step)


def noise_by_dof_band(measured: Frf, edges: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """rms dB error that the noise of the measurement alone makes, by response DOF and band; None without a variance."""
    if measured.variance is None:
        return None
    mask = clear_lines(measured)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = DECIBEL * np.sqrt(measured.variance / 2) / np.abs(measured.data)
    bands = band_masks(measured.frequencies_hz, edges)
    return np.column_stack([rms_over(noise, mask & inside, axis=(1, 2)) for inside in bands])


def relative_by_dof_band(size2: NDArray[np.float64], measured: Frf, edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the measured response [%] by response DOF and band: root of the sum of |ΔH|² (or of the variance) over that of |H|²."""
    mask = clear_lines(measured) & np.isfinite(size2)
    whole = np.where(mask, np.abs(measured.data) ** 2, 0.0)
    part = np.where(mask, size2, 0.0)
    columns = []
    for inside in band_masks(measured.frequencies_hz, edges):
        top, under = (np.sum(v[:, :, inside], axis=(1, 2)) for v in (part, whole))
        columns.append(100 * np.sqrt(np.divide(top, under, out=np.full(top.shape, np.nan), where=under > 0)))
    return np.column_stack(columns)


@dataclass(frozen=True)
class Routes:
    """Two routes to the operational FRFs: hybrid (idle shapes, operating poles) and idle model with effects."""

    frequencies_hz: NDArray[np.float64]  # (n_lines,)
    references: tuple[str, ...]
    difference_db: NDArray[np.float64]  # (n_references, n_lines), rms over the responses at each line
    rms_db: NDArray[np.float64]  # (n_references,), over lines and responses
    hybrid_db: NDArray[np.float64] | None  # (n_references,), error against the validation measurement, where there is one
    effect_db: NDArray[np.float64] | None  # the same; faults of channels count on this route
    total_db: float  # over everything


def routes(results: Results, model: Any) -> Routes | None:
    """How far the two routes to the operational FRFs lie apart in band; None where one of them is missing.

    With a check its lines that stand clear of the noise count, else all lines of the idle FRFs.
    """
    run = derive.validation_run(results)
    grid = run.frf if run is not None else results.idle_frf
    if model is None or results.hybrid is None or grid is None:
        return None
    band = derive.analysis_band(results)
    grid = every(grid if band is None else grid.band(*band))
    running = model.structure()
    hybrid, effect = derive.model_frf(results.hybrid, grid), derive.model_frf(running, grid)
    measured = effect if running.effects == model.effects else derive.model_frf(model, grid)  # faults of channels are measured, too
    if hybrid is None or effect is None or measured is None or not len(grid.axis):
        return None
    mask = clear_lines(grid) if run is not None else np.isfinite(hybrid.data)
    gap = level_error_db(effect, hybrid)
    against: list[NDArray[np.float64] | None] = [None, None]
    if run is not None:
        against = [rms_over(level_error_db(one, grid), mask, axis=(0, 2)) for one in (hybrid, measured)]
    return Routes(
        grid.frequencies_hz,
        tuple(str(d) for d in grid.references),
        np.asarray(rms_over(gap, mask, axis=0)),
        np.asarray(rms_over(gap, mask, axis=(0, 2))),
        against[0],
        against[1],
        float(rms_over(gap, mask)),
    )


def telling_pairs(frf: Frf, idle_error: NDArray[np.float64] | None, places: Sequence[str]) -> list[tuple[int, int, str]]:
    """Four pairs worth a picture: a drive point, where the idle model fails most, and at the places of the effects."""
    pairs = derive.choose_pairs(frf, idle_error, 1, 2)
    pairs = [(i, j, why.replace("worst pair", "where the idle model is worst").replace("next where", "next: where")) for i, j, why in pairs]
    names = {label.rstrip("XYZ").rstrip("+-") for label in places}
    taken = {(i, j) for i, j, _ in pairs}
    for i, dof in enumerate(frf.responses):
        if str(dof) in places or str(dof.node) in names:
            j = 0
            if idle_error is not None and np.isfinite(idle_error[i]).any():
                j = int(np.nanargmax(idle_error[i]))
            if (i, j) not in taken:
                pairs.append((i, j, "at the effect"))
                taken.add((i, j))
    return pairs[:4]
