"""Numbers the report draws that no stage keeps: errors by DOF and band, level and reciprocity tests, conditioning by DOF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare import measures
from operando.compare.comparison import lowest_level
from operando.data import Finding, Frf, ModalModel, once_of_a_sense, with_further
from operando.dof import Dof
from operando.errors import DataError, OperandoError
from operando.plots.shapes import real_shape
from operando.report.parts import Numbering
from operando.report.svg import thin
from operando.report.text import number
from operando.report.words_diagnosis import changed_by_hand
from operando.results import CheckRun, Results

BAND_LINES = 500
"""Intervals of frequency in which the variance of a curve is worked out at its least and its greatest line."""

_RANK = {"error": 0, "warning": 1, "info": 2}


def all_findings(results: Results) -> list[Finding]:
    """Findings of the test and of every object in it, each once, the gravest first."""
    objects = (results.idle_frf, results.idle, results.operating, results.hybrid, *(run.frf for run in results.check))
    further = [f for item in objects for f in getattr(item, "findings", ()) or ()]
    return sorted(once_of_a_sense(with_further(results.findings, further)), key=lambda f: _RANK[f.severity])


def pairing_of(results: Results) -> list[dict[str, Any]]:
    """The pairing rows of ``summary.json``; empty where no hybrid model was made."""
    return list(_hybrid_dict(results).get("pairing") or [])


def scaling_of(results: Results) -> dict[str, Any]:
    """The scaling object of ``summary.json``; empty where no hybrid model was made."""
    return dict(_hybrid_dict(results).get("scaling") or {})


@dataclass(frozen=True)
class ModePair:
    """One mode from idle to operation."""

    idle: int | None  # its number at rest; None where it has none
    operating: int | None  # the same in operation
    idle_hz: float | None
    operating_hz: float | None
    row: dict[str, Any] = field(default_factory=dict)  # its row of the pairing; empty where it was not paired

    @property
    def percent(self) -> float | None:
        """Change of frequency from idle to operation; None where one of both is missing."""
        return 100 * (self.operating_hz / self.idle_hz - 1) if self.idle_hz and self.operating_hz else None


def mode_pairs(results: Results) -> list[ModePair]:
    """Every mode of both states once, by frequency (idle where there is one)."""
    idle, operating = results.idle, results.operating
    hz = lambda model: [] if model is None else [float(f) for f in model.frequencies_hz]  # noqa: E731
    idle_hz, operating_hz = hz(idle), hz(operating)
    rows = {int(p["operating"]): p for p in pairing_of(results) if p.get("operating") is not None}
    pairs = []
    for k, f in enumerate(operating_hz):
        row = rows.get(k, {})
        j = row.get("idle")
        j = int(j) if j is not None and 0 <= j < len(idle_hz) else None
        pairs.append(ModePair(j, k, None if j is None else idle_hz[j], f, row))
    taken = {p.idle for p in pairs}
    pairs += [ModePair(j, None, f, None) for j, f in enumerate(idle_hz) if j not in taken]
    return sorted(pairs, key=lambda p: p.idle_hz if p.idle_hz is not None else p.operating_hz or 0.0)


def _hybrid_dict(results: Results) -> dict[str, Any]:
    return {} if results.hybrid is None else dict(results.hybrid.to_dict())


def comparison_models(results: Results) -> dict[str, dict[str, Any]]:
    """The models of ``comparison.json`` that have numbers; without ``effect`` where effects were changed by hand since."""
    models = (results.comparison or {}).get("models") or {}
    stale = changed_by_hand(results.diagnosis or {})
    return {name: m for name, m in models.items() if m and not (stale and name == "effect")}


def validation_run(results: Results) -> CheckRun | None:
    """What the dB errors are drawn for: validation measurements of the level compared, their references side by side where they fit."""
    if not results.check:
        return None
    compared = ((results.comparison or {}).get("judged_on") or {}).get("runs") or ()
    level = lowest_level(results.check)
    runs = [run for run in results.check if run.name in compared] or [run for run in results.check if run.level == level]
    return beside(runs) or runs[0]


def validation(results: Results, page: Numbering) -> tuple[CheckRun | None, Frf | None, Frf | None]:
    """The validation measurement, and the operational FRFs and the idle model on its lines and pairs."""

    def make() -> tuple[CheckRun | None, Frf | None, Frf | None]:
        run = validation_run(results)
        if run is None:
            return None, None, None
        return run, model_frf(results.hybrid, run.frf), model_frf(scaled_idle(results), run.frf)

    kept: tuple[CheckRun | None, Frf | None, Frf | None] = page.once("validation", make)
    return kept


def beside(runs: Sequence[CheckRun]) -> CheckRun | None:
    """Runs with the same responses and lines but other references as one; None where they do not fit."""
    try:
        frf = runs[0].frf.beside(*(run.frf for run in runs[1:]))
    except DataError:
        return None
    return replace(runs[0], name=", ".join(run.name for run in runs), frf=frf)


def range_text(frequencies_hz: NDArray[np.float64]) -> str:
    """One frequency, or the least and the greatest of several."""
    low, high = float(np.min(frequencies_hz)), float(np.max(frequencies_hz))
    return f"{number(low, 4)} Hz" if high - low < 1e-6 * high else f"{number(low, 4)} to {number(high, 4)} Hz"


def model_frf(model: Any, frf: Frf) -> Frf | None:
    """FRF of a model on the lines and pairs of a measured one; None where there is no model, or it has no such DOFs or no scale.

    Without its variance: that of every pair costs more than all figures together.
    """
    modal = getattr(model, "modal", model)
    if modal is None:
        return None
    try:
        made: Frf = modal.frf(frf.frequencies_hz, frf.responses, frf.references, frf.quantity, variance=False)
    except (OperandoError, NotImplementedError):
        return None
    return made


def with_variance(model: Any, frf: Frf, pairs: Sequence[tuple[int, int, str]]) -> Frf:
    """An FRF of a model with the model's variance at some pairs, on the lines that keep the look of the curve (NaN elsewhere).

    As it is where the model has none.
    """
    variance = np.full(frf.data.shape, np.nan)
    for i, j, _ in pairs:
        with np.errstate(divide="ignore", invalid="ignore"):
            lines = thin(frf.frequencies_hz, np.log(np.abs(frf.data[i, j])), BAND_LINES)
        part = model.frf(frf.frequencies_hz[lines], (frf.responses[i],), (frf.references[j],), frf.quantity)
        if part.variance is None:
            return frf
        variance[i, j, lines] = part.variance[0, 0]
    return replace(frf, variance=variance)


def scaled_idle(results: Results) -> ModalModel | None:
    """The idle model where it has unit modal mass, else None."""
    return results.idle if results.idle is not None and results.idle.scaling == "unit_modal_mass" else None


def analysis_band(results: Results) -> tuple[float, float] | None:
    """The band of the analysis [Hz], from the models or the settings."""
    for model in (results.idle, results.operating):
        if model is not None and model.band_hz is not None:
            return (float(model.band_hz[0]), float(model.band_hz[1]))
    band = results.settings.get("band") or (results.settings.get("analysis") or {}).get("band")
    if band:
        return (float(band[0]), float(band[1]))
    if results.idle_frf is not None:
        f = results.idle_frf.frequencies_hz
        return (float(f[0]), float(f[-1]))
    return None


def band_edges(band: Sequence[float]) -> NDArray[np.float64]:
    """Edges [Hz] of the bands of ``by_band``."""
    return measures.band_edges(max(float(band[0]), 1e-3 * float(band[1])), float(band[1]))


def choose_pairs(frf: Frf, error: NDArray[np.float64] | None, most_drive: int = 2, most_worst: int = 2) -> list[tuple[int, int, str]]:
    """Pairs worth a picture, each with why: drive points, then those with the greatest error; without either the strongest responses.

    ``error`` (n_responses, n_references) is NaN where there is none.
    """
    chosen: dict[tuple[int, int], str] = {}
    for i, j in frf.drive_points()[:most_drive]:
        chosen[(i, j)] = "drive point"
    missing = most_drive - len(chosen)
    if error is not None and np.any(np.isfinite(error)):
        order = np.argsort(np.where(np.isfinite(error), -error, np.inf), axis=None)
        for flat in order[: int(np.isfinite(error).sum())]:
            i, j = (int(v) for v in np.unravel_index(flat, error.shape))
            if (i, j) in chosen:
                chosen[(i, j)] += ", worst pair" if len(chosen) <= most_drive else ""
                continue
            chosen[(i, j)] = "worst pair" if not any("worst" in why for why in chosen.values()) else "next worst pair"
            if sum("worst" in why for why in chosen.values()) >= most_worst + max(missing, 0):
                break
    if not chosen:
        with np.errstate(invalid="ignore"):
            size = np.nan_to_num(np.nanmean(np.abs(frf.data), axis=2)) if frf.data.size else np.zeros(frf.data.shape[:2])
        for flat in np.argsort(-size, axis=None)[: most_drive + most_worst]:
            i, j = (int(v) for v in np.unravel_index(flat, size.shape))
            chosen[(i, j)] = "strong response"
    return [(i, j, why) for (i, j), why in chosen.items()]


def reciprocity(frf: Frf, band: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """How far H[i, j] is from H[j, i], for each ``pair`` of references that are also responses.

    ``relative`` is the rms difference over the rms size, ``ratio`` the mean |difference|² over its variance (None without variances).
    """
    rows: list[dict[str, Any]] = []
    for second, first, one, two, variance in (frf if band is None else frf.band(*band)).both_ways():
        ok = np.isfinite(one) & np.isfinite(two)
        if not ok.any():
            continue
        gap = np.abs(one - two)[ok] ** 2
        size = 0.5 * (np.abs(one[ok]) ** 2 + np.abs(two[ok]) ** 2)
        ratio = None if variance is None else _over_noise(gap, variance[ok])
        rows.append({"pair": (first, second), "relative": float(np.sqrt(gap.sum() / max(size.sum(), 1e-300))), "ratio": ratio})
    return rows


def _over_noise(gap: NDArray[np.float64], variance: NDArray[np.float64]) -> float | None:
    """Mean |difference|² over its variance, where both are known."""
    good = np.isfinite(gap) & np.isfinite(variance) & (variance > 0)
    return float(np.mean(gap[good] / variance[good])) if good.any() else None


def level_difference(check: Sequence[CheckRun], band: Sequence[float] | None = None) -> dict[str, Any] | None:
    """Whether the FRFs of two levels agree in band: relative difference and mean |ΔH|² over its variance; None with one level."""
    levels = list(dict.fromkeys(run.level for run in check))
    if len(levels) < 2:
        return None
    low = lowest_level(check)
    high = next(level for level in reversed(levels) if level != low)
    ends = [[run for run in check if run.level == level] for level in (high, low)]
    first, second = (beside(runs) or runs[0] for runs in ends)
    one, two = (first.frf, second.frf) if band is None else (first.frf.band(*band), second.frf.band(*band))
    if one.data.shape != two.data.shape or one.references != two.references or not np.allclose(one.frequencies_hz, two.frequencies_hz):
        return None
    gap = np.abs(one.data - two.data) ** 2
    ok = np.isfinite(gap)
    size = float(np.sum(np.abs(two.data[ok]) ** 2))
    ratio = None if one.variance is None or two.variance is None else _over_noise(gap, one.variance + two.variance)
    return {"levels": (high, low), "relative": float(np.sqrt(gap[ok].sum() / size)) if size > 0 else None, "ratio": ratio}


def sensor_redundancy(shapes: NDArray[Any], dofs: Sequence[Dof]) -> dict[str, Any] | None:
    """What makes the condition number of the idle shapes large.

    The singular vectors of the least singular value say which combination of modes the sensors barely see, and which
    sensors carry nearly the same information about the modes.

    Returns
    -------
    dict or None
        ``kappa``, ``modes`` (share of each mode), ``dofs`` (share of each DOF), ``without`` (κ with one DOF left out, NaN
        where too few are left); None with fewer DOFs than modes.
    """
    m, n = shapes.shape
    if n == 0 or m < n:
        return None
    u, s, vh = np.linalg.svd(shapes, full_matrices=False)
    without = np.full(m, np.nan)
    if m > n:
        for i in range(m):
            without[i] = np.linalg.cond(np.delete(shapes, i, axis=0))
    return {
        "kappa": float(s[0] / s[-1]) if s[-1] > 0 else float("inf"),
        "modes": np.abs(vh[-1]) ** 2,
        "dofs": np.abs(u[:, -1]) ** 2,
        "without": without,
        "labels": [str(d) for d in dofs],
    }


def real_shapes(model: ModalModel) -> NDArray[np.float64]:
    """Shapes turned to the real axis, greatest entry 1: for drawing only."""
    return np.array([real_shape(model.shapes[:, k]) for k in range(model.n_modes)]).T.reshape(model.shapes.shape)
