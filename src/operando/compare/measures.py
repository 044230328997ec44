"""Error measures on complex FRF lines (specification, "Error measures"), as pure functions of flat arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent

SNR_LIMIT = 100.0
"""|H|²/var_meas above which a line counts in dB measures."""

DB = 20 / np.log(10)
"""dB of a small relative change, 8.686."""


@dataclass(frozen=True, eq=False)
class Lines(ByContent):
    """Complex lines of all pairs, flat: one entry a response–reference pair and frequency line.

    Parameters
    ----------
    model, measured : (k,) complex arrays
    var_meas : (k,) array
        E|ΔH|² of the measurement; 0 where the reference is exact.
    var_model : (k,) array
        E|ΔH|² of the model itself.
    response : (k,) int array
        Index of the response DOF.
    frequency_hz : (k,) array
    """

    model: NDArray[np.complex128]
    measured: NDArray[np.complex128]
    var_meas: NDArray[np.float64]
    var_model: NDArray[np.float64]
    response: NDArray[np.int_]
    frequency_hz: NDArray[np.float64]

    def where(self, mask: NDArray[np.bool_]) -> Lines:
        """Some of the lines."""
        return Lines(*(getattr(self, part.name)[mask] for part in fields(self)))

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Lines that count in dB: SNR above the limit (all where the reference is exact), both magnitudes positive."""
        size = np.abs(self.measured) ** 2
        return (size > SNR_LIMIT * self.var_meas) & (size > 0) & (np.abs(self.model) > 0)


def error_db(lines: Lines) -> float | None:
    """Rms over counted lines of 20·log10(|H_model|/|H_measured|); None without a line."""
    k = lines.counted
    if not np.any(k):
        return None
    ratio = 20 * np.log10(np.abs(lines.model[k]) / np.abs(lines.measured[k]))
    return float(np.sqrt(np.mean(ratio**2)))


def relative_error(lines: Lines) -> float | None:
    """sqrt(Σ|H_model − H_measured|²/Σ|H_measured|²) over all lines; None where the measurement is zero."""
    total = float(np.sum(np.abs(lines.measured) ** 2))
    return None if total == 0 else float(np.sqrt(np.sum(np.abs(lines.model - lines.measured) ** 2) / total))


def misfit(lines: Lines) -> float | None:
    """Mean of |H_model − H_measured|²/(var_meas + var_model) over lines that have a variance; None without one."""
    total = lines.var_meas + lines.var_model
    k = total > 0
    return float(np.mean(np.abs(lines.model[k] - lines.measured[k]) ** 2 / total[k])) if np.any(k) else None


def misfit_meas(lines: Lines) -> float | None:
    """The same by the variance of the measurement alone."""
    k = lines.var_meas > 0
    return float(np.mean(np.abs(lines.model[k] - lines.measured[k]) ** 2 / lines.var_meas[k])) if np.any(k) else None


def noise_floor_db(lines: Lines) -> float | None:
    """Rms of 8.686·sqrt(var_total/2)/|H_measured| over counted lines; None without a variance."""
    k = lines.counted
    total = lines.var_meas + lines.var_model
    if not np.any(k) or not np.any(total[k] > 0):
        return None
    return float(DB * np.sqrt(np.mean(total[k] / 2 / np.abs(lines.measured[k]) ** 2)))


def model_share(lines: Lines) -> float | None:
    """Mean share of the model's own variance in var_total; None without a variance."""
    total = lines.var_meas + lines.var_model
    k = total > 0
    return float(np.mean(lines.var_model[k] / total[k])) if np.any(k) else None


def band_edges(low: float, high: float) -> NDArray[np.float64]:
    """Edges [Hz] of eight bands, equal in logarithmic frequency."""
    return np.geomspace(low, high, 9)


def band_masks(f: NDArray[np.float64], edges: Sequence[float] | NDArray[np.float64]) -> list[NDArray[np.bool_]]:
    """Lines of each band; a line on an edge belongs to the band above, on the last edge to the last band."""
    return [(f >= low) & (f < high if high < edges[-1] else f <= high) for low, high in pairwise(edges)]
