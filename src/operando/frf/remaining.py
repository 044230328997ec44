"""What a hit leaves at the end of its block: how far its response has decayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[Any]

STANDS = 20.0
"""A line stands out of the noise at this many times its power (of 1000 lines of noise alone one does with a probability of 2e-6)."""
GROWS = 1.2
"""A response does not grow after the hit: what has a fifth more power in the last quarter than in the first is background."""
BEFORE = 4.0
"""A line was not there before the hit where its power at the end is this many times that before (a tone between two lines of a short
spectrum loses a third of its power)."""
HIDES = 9.0
"""Before the hit noise hides less of a tone than √9 times its own amplitude (in one of 90 000 lines: erfc(3)/2)."""
AROUND = 16
"""Lines on either side that tell the noise near a line."""


def remaining_share(
    data: NDArray[np.floating[Any]],
    rows: Sequence[int],
    starts: NDArray[np.intp],
    block: int,
    sampling_hz: float,
    band: tuple[float, float] | None = None,
    quiet: int = 0,
) -> tuple[float, float]:
    """Largest share of its amplitude that a line still has at the end of the blocks, where it stands out of the noise (else 0); that line.

    The spectra of the first and last quarter of the blocks are compared line by line. What stands out at the end is no response to the hit
    where the noise near that line is as large, where it grew since the beginning, or where it was there before the hit: in the first
    ``quiet`` samples of the record nothing was hit yet. Without a band: what the quarters resolve, up to the anti-alias limit.
    """
    quarter = block // 4
    if quarter < 16 or starts.size == 0:
        return 1.0, 0.0
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(quarter) / quarter)
    frequency = fft.rfftfreq(quarter, 1 / sampling_hz)
    low, high = band if band is not None else (2 / (quarter / sampling_hz), sampling_hz / 2.56)
    keep = (frequency >= low) & (frequency <= high)
    if not keep.any():
        return 1.0, 0.0
    worst, where = 0.0, 0.0
    for row in rows:
        begin, end = np.zeros(frequency.size), np.zeros(frequency.size)
        for start in starts:
            for total, at in ((begin, start), (end, start + block - quarter)):
                x = np.array(data[row, at : at + quarter], float)
                total += np.abs(fft.rfft((x - x.mean()) * window)) ** 2
        noise = np.maximum(np.quantile(end[keep], 0.25) / 0.3, _noise_near(end))
        stands = keep & (end > STANDS * noise) & (end < GROWS * begin)
        before, gain = _power_before(np.asarray(data[row, :quiet], float), frequency, sampling_hz, quarter)
        stands &= end > starts.size * np.maximum(BEFORE * before, (np.sqrt(before) + np.sqrt(HIDES * gain * noise / starts.size)) ** 2)
        if stands.any():
            share = (end[stands] / begin[stands]) ** (0.5 * 4 / 3)
            k = int(np.argmax(share))
            if share[k] > worst:
                worst, where = float(share[k]), float(frequency[stands][k])
    return worst, where


def _noise_near(power: Array) -> Array:
    """Noise power near each line: the lower quartile over the lines around it, scaled to the mean of an exponential distribution."""
    from scipy import ndimage

    return np.asarray(ndimage.percentile_filter(power, 25, size=2 * AROUND + 1, mode="nearest") / 0.3)


def _power_before(x: Array, frequency: Array, sampling_hz: float, length: int) -> tuple[Array, Array]:
    """Power of each line before the first hit, as a tone of that size would have in ``length`` samples, and of noise over its own there.

    By the spectrum; below two cycles by least squares of a tone and a constant; 0 below one, where a drift looks like a tone.
    """
    out, gain = np.zeros(frequency.size), np.zeros(frequency.size)
    if x.size < 16:
        return out, gain
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(x.size) / x.size)
    power = np.abs(fft.rfft((x - x.mean()) * window)) ** 2
    have = fft.rfftfreq(x.size, 1 / sampling_hz)
    cycles = frequency * x.size / sampling_hz
    known = cycles > 2
    out[known] = np.interp(frequency[known], have, power) * (length / x.size) ** 2
    gain[known] = length / x.size  # a tone's power grows with the square of the samples, that of noise with them
    for k in np.flatnonzero((cycles >= 1) & ~known):
        turn = np.exp(2j * np.pi * frequency[k] / sampling_hz * np.arange(x.size))
        columns = np.column_stack([turn.real, turn.imag, np.ones(x.size)])
        inverse = np.linalg.inv(columns.T @ columns)
        amplitude = (inverse @ columns.T @ x)[:2]
        # a window of 0.5 makes (length/4)² of a tone's power and 3 length/8 of noise; twice the variance in the phase that noise moves most
        out[k] = (amplitude @ amplitude) * (length / 4) ** 2
        gain[k] = np.linalg.eigvalsh(inverse[:2, :2])[-1] * length / 3
    return out, gain
