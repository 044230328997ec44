"""The default analysis band: where the resonances hold their power, and what the correlations can resolve at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data import Finding, TimeRecord

AVERAGES = 12
"""Blocks (without overlap) the spectra are averaged over: enough that a line of noise never reaches ``STANDS_OUT`` times its neighbours
(a chi-square of 24 degrees of freedom exceeds ten times its median with probability 1e-30)."""
STANDS_OUT = 10.0
"""Power of a line over the median about it (half an octave to either side) from which it counts as resonant."""
SHARE = 0.99
"""Part of the resonant power that must lie below the upper limit; the resonances above hold less than 1 % of it."""
BELOW, ABOVE = 0.6, 1.25
"""The band begins at 0.6 of the lowest resonance and ends at 1.25 times the highest, so that neither lies on its edge."""
LEAST_CYCLES = 10.0
"""Periods of the lower limit in a record, at least."""
HIGHEST = 0.4
"""Largest upper limit as part of the sampling rate: anti-aliasing filters begin above."""
LEAST_LAG = 0.4
"""Part of the lowest resonance's period that the correlation lags must span: on a lattice mast (18 sensors, 2.8 to 118 Hz) all modes are
found at 0.4 and one of them at 0.12. It bounds the upper limit, since the lags are counted in samples."""
SAMPLES_PER_PERIOD = 2.5
"""Rate of the identification over the upper limit of the band (``conditioning.at_suitable_rate``)."""


@dataclass(frozen=True)
class BandChoice:
    """Band [Hz], how it was chosen in words, and what there is to say."""

    band: tuple[float, float]
    text: str
    findings: tuple[Finding, ...] = ()


def default_band(records: Sequence[TimeRecord], block_rows: int) -> BandChoice:
    """Band that holds the resonances with the power.

    Lines count that stand at least tenfold above the median about them, in the mean of the channels' spectra, each of unit power. The
    lowest such line gives the lower limit, the line below which 99 % of their power lies the upper one; this is the power of what was
    measured (acceleration weighs high, displacement low resonances). ``block_rows`` of the Hankel matrix and the lowest resonance bound the
    upper limit.
    """
    rate = min(r.sampling_hz for r in records)
    seconds = min(r.duration_s for r in records)
    widest = (LEAST_CYCLES / seconds, HIGHEST * rate)
    f, power = mean_spectrum(records, rate)
    background = median_about(f, power)
    resonant = (f >= widest[0]) & (f <= widest[1]) & (power > STANDS_OUT * background)
    if not resonant.any() or widest[0] >= widest[1]:
        low, high = widest if widest[0] < widest[1] else (0.0, widest[1])
        finding = Finding(
            "band_by_default",
            f"no resonance stands out of the spectra; the band is ten periods in the record to 0.4 of the sampling rate, "
            f"{low:.4g} to {high:.4g} Hz",
            "warning",
            band_hz=(low, high),
            consequence="modes found in so wide a band may be noise",
            action="give [analysis] band",
        )
        return BandChoice((low, high), "no resonance stands out", (finding,))
    lines = np.flatnonzero(resonant)
    share = np.cumsum(power[lines]) / np.sum(power[lines])
    lowest, highest = float(f[lines[0]]), float(f[lines[int(np.searchsorted(share, SHARE))]])
    low, high = max(BELOW * lowest, widest[0]), min(ABOVE * highest, widest[1])
    bound = block_rows * lowest / (LEAST_LAG * SAMPLES_PER_PERIOD)
    text = f"resonances from {lowest:.4g} Hz, {100 * SHARE:.0f} % of their power below {highest:.4g} Hz"
    action = "give [analysis] band where modes beyond are wanted"
    if bound < high:
        text += f"; cut at {bound:.4g} Hz, {block_rows} lags resolve no more at once"
        action = f"analyse {bound:.4g} to {high:.4g} Hz by itself ([analysis] band), or with more block_rows"
        high = max(bound, ABOVE * lowest)
    finding = Finding(
        "band_by_default",
        f"analysis band {low:.4g} to {high:.4g} Hz, chosen from the operating spectra: {text}",
        "info",
        band_hz=(low, high),
        consequence="modes outside the band are not looked for",
        action=action,
    )
    return BandChoice((low, high), text, (finding,))


def mean_spectrum(records: Sequence[TimeRecord], rate: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lines [Hz] and the mean power spectrum of all response channels, each of unit mean square, on the lines of the shortest record."""
    n = min(int(r.n_samples * rate / r.sampling_hz) for r in records)
    f = np.arange(1, max(n // AVERAGES, 16) // 2) * rate / max(n // AVERAGES, 16)
    total = np.zeros(f.size)
    for r in records:
        size = max(r.n_samples // AVERAGES, 16)
        window = np.hanning(size + 1)[:-1]
        own = np.arange(size // 2 + 1) * r.sampling_hz / size
        part = np.zeros(own.size)
        rows = r.response_indices
        for i in rows:
            row = r.data[i]
            mean = r.statistics.mean[i] if r.statistics.finite[i] else np.nan_to_num(row).mean(dtype=float)
            spectrum = np.zeros(own.size)
            for start in range(0, row.size - size + 1, size // 2):
                spectrum += np.abs(fft.rfft((np.nan_to_num(row[start : start + size]) - mean) * window)) ** 2
            part += spectrum / max(float(np.sum(spectrum[1:])), 1e-300)
        total += np.interp(f, own, part / max(len(rows), 1))
    return f, total / len(records)


def median_about(f: NDArray[np.float64], power: NDArray[Any]) -> NDArray[np.float64]:
    """Median of a spectrum over half an octave (and eight lines) to either side of each line, taken every twelfth of an octave."""
    centres = f[0] * 2 ** np.arange(0, np.log2(f[-1] / f[0]) + 1 / 12, 1 / 12)
    at = np.unique(np.clip(np.searchsorted(f, centres), 0, f.size - 1))
    reach, least = 2**0.5, 8
    values = []
    for k in at:
        low = min(int(np.searchsorted(f, f[k] / reach)), max(k - least, 0))
        high = max(int(np.searchsorted(f, f[k] * reach)), min(k + least, f.size))
        values.append(np.median(power[low : high + 1]))
    return np.asarray(np.interp(f, f[at], values))
