"""How sharp the resonances are, and whether blocks or records are long enough for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

LINES_NEEDED = 25.0
"""Lines in a half-power bandwidth that blocks need. A Hann window smooths H over the lines with a variance of a third of a line squared
(the moment of its spectrum): a peak N lines wide loses 4/(3N²) of its height, and its damping grows by about half of that. With eight
lines that is 1 %, three standard deviations of a fit to many sensors; with 25 it is 0.1 %."""


HANN_DAMPING = 0.03
"""Share by which modes fitted to averages over Hann windows are damped too much, times the lines that a peak is wide.

0.02 to 0.05 at 1 to 10 lines (a chain of three masses, damping 0.5 and 1 %, 60 blocks of 1 to 16 s). The flanks, which leak less, tell most
of a damping ratio."""


@dataclass(frozen=True)
class Peak:
    """A resonance peak: its frequency and half-power bandwidth [Hz]."""

    frequency_hz: float
    bandwidth_hz: float


def resonance_peaks(frequencies_hz: Array, data: Array, variance: Array | None = None, prominence: float = 4.0) -> list[Peak]:
    """Peaks of Σ|H|²/ω² with their half-power bandwidths.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Lines [Hz].
    data : (n_responses, n_references, n_lines) complex array
        Accelerance (or any quantity; the weight only balances low and high modes).
    variance : array like ``data``, optional
        A peak must exceed ten times the noise.
    prominence : float
        Ratio of power by which a peak stands above the lowest line towards the next higher peak on either side.

    Returns
    -------
    list of Peak, by frequency

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.frf import resonance_peaks
    >>> [round(peak.frequency_hz, 1) for peak in resonance_peaks(frf.frequencies_hz, frf.data)]
    [20.0, 45.0]
    """
    f = np.asarray(frequencies_hz, float)
    weight = 1 / np.maximum(f, f[f > 0].min() if np.any(f > 0) else 1.0) ** 2
    power = np.nansum(np.abs(data) ** 2, axis=(0, 1)) * weight
    noise = np.zeros_like(power) if variance is None else np.nansum(variance, axis=(0, 1)) * weight
    peaks = []
    for k in np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])) + 1:
        top = power[k]
        if top < 10 * noise[k]:
            continue
        # Noise has many maxima: most are told by their prominence, without a walk to the half power.
        sides = [lowest_towards_higher(power, int(k), -1), lowest_towards_higher(power, int(k), 1)]
        if top <= 0 or top < prominence * max(sides):
            continue
        left, right = _half_power(f, power, int(k), -1), _half_power(f, power, int(k), 1)
        if left is None or right is None:
            continue
        peaks.append(Peak(float(f[k]), right - left))
    return peaks


def _half_power(f: Array, power: Array, peak: int, step: int) -> float | None:
    """Frequency where the power has fallen to half on one side, by linear interpolation."""
    k = peak
    while 0 <= k + step < power.size and power[k + step] > 0.5 * power[peak]:
        k += step
        if power[k] > power[peak]:
            return None
    if not 0 <= k + step < power.size:
        return None
    a, b = power[k], power[k + step]
    return float(f[k] + (f[k + step] - f[k]) * (a - 0.5 * power[peak]) / (a - b))


def lowest_towards_higher(power: Array, peak: int, step: int) -> float:
    """Lowest power on the way to the next higher line on one side."""
    side = power[peak + 1 :] if step > 0 else power[:peak][::-1]
    higher = np.flatnonzero(side > power[peak])
    side = side[: higher[0]] if higher.size else side
    return float(side.min()) if side.size else float(power[peak])


def sharpest(peaks: list[Peak]) -> Peak | None:
    """The peak with the least half-power bandwidth."""
    return min(peaks, key=lambda p: p.bandwidth_hz) if peaks else None
