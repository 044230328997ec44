"""Sinusoids in operating records (rotor orders, mains): found by what no random vibration does, and taken out before identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data import MappedSamples, pieces, row_statistics
from operando.data.arrays import ByContent
from operando.data.mapped import PIECE

LEVELS = ((1, 30.0), (4, 14.0), (16, 9.0))
"""Segments a record is cut into, and how far a line must stand above its neighbours (power, mean over channels) to be looked at."""

STEADY_WIDTH, DRIFT_WIDTH = 16, 32
"""Bandwidth about a line, in 1/duration, in which a steady or drifting sinusoid must hold its own."""
LONGEST = 1 << 20
"""Samples of a segment at most: the spectrum of a longer record would take several times the memory of a channel. A line then stands as
high as in a record of that length."""
ENVELOPE_BINS = 4096
"""Samples of the envelope that a record longer than ``4·LONGEST`` is averaged to before its few lines are cut out. Within 38 lines of the
centre (``4·segments`` of a record of 40 million samples, half of it) the mean over a bin changes an amplitude by 1.4e-4, and lets through
1 % of the amplitude of what lies a whole number of bins per record away."""
MIN_SHARE = 0.75
"""Smallest share of the power in ``STEADY_WIDTH`` that one steady frequency explains (random: below 0.5)."""
MAX_KURTOSIS = 1.25


@dataclass(frozen=True)
class Harmonic:
    """One sinusoid of a record.

    Parameters
    ----------
    hz : float
        Mean frequency [Hz].
    spread_hz : float
        Bandwidth its phase was followed with [Hz]; 0 for a steady one.
    height : float
        Power of the line over that of its neighbours; NaN for one named by the user and not seen.
    kurtosis : float
        E|a|⁴/(E|a|²)² of its envelope a: 1 for a sinusoid, 2 for narrow-band random vibration.
    energy_share : float
        Largest share of a channel's mean square.
    """

    hz: float
    spread_hz: float
    height: float
    kurtosis: float
    energy_share: float


def line_height(data: NDArray[Any], sampling_hz: float, segments: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of each spectral line over the median of its neighbours three to nine lines away, mean over channels, and the lines.

    Hann-windowed, half-overlapped segments; channel by channel, so that memory stays that of one channel.
    """
    n = data.shape[1]
    size = n // segments
    if n > LONGEST:
        size = fft.prev_fast_len(size, real=True)
    window = np.hanning(size + 1)[:-1]
    offsets = np.r_[-9:-2, 3:10]
    height = np.zeros(size // 2 + 1)
    for row in data:
        power = np.zeros(size // 2 + 1)
        for start in range(0, n - size + 1, max(size // 2, 1)):
            part = np.asarray(row[start : start + size], float)
            power += np.abs(fft.rfft((part - part.mean()) * window)) ** 2
        padded = np.pad(power, 9, mode="reflect")
        around = np.median([padded[9 + k : 9 + k + power.size] for k in offsets], axis=0)
        height += power / np.maximum(around, 1e-300)
    return np.arange(height.size) * sampling_hz / size, height / data.shape[0]


def envelope(data: NDArray[Any], sampling_hz: float, hz: float, width_hz: float) -> NDArray[np.complex128]:
    """Complex envelopes of all channels about one frequency (r, k): all within ± width/2, shifted to zero, sampled at ``width_hz``."""
    n = data.shape[1]
    centre = hz * n / sampling_hz
    half = max(2, round(width_hz * n / sampling_hz / 2))
    low = max(round(centre) - half, 1)
    if n > 4 * LONGEST:
        out = _lines_by_bins(data, low + half, half)
    else:
        out = np.empty((data.shape[0], 2 * half + 1), complex)
        for i, row in enumerate(data):
            lines = fft.rfft(np.asarray(row, float))[low : low + 2 * half + 1]
            out[i, : lines.size] = lines
            out[i, lines.size :] = 0
    k = out.shape[1]
    t = np.arange(k) / k
    return np.asarray(fft.ifft(out, axis=1) * k * 2 / n * np.exp(-2j * np.pi * (centre - low) * t))


def _lines_by_bins(data: NDArray[Any], middle: int, half: int) -> NDArray[np.complex128]:
    """DFT lines ``middle`` ± ``half`` of a long record, whose middle line is shifted to zero frequency and averaged in bins."""
    r, n = data.shape
    edges = np.linspace(0, n, max(ENVELOPE_BINS, 32 * half) + 1).astype(int)
    bins = np.empty((r, edges.size - 1), complex)
    together = max(1, PIECE // int(np.diff(edges).max()))
    for first in range(0, edges.size - 1, together):
        last = min(first + together, edges.size - 1)
        part = np.asarray(data[:, edges[first] : edges[last]], float)
        turning = np.exp((-2j * np.pi * middle / n) * np.arange(edges[first], edges[last]))
        bins[:, first:last] = np.add.reduceat(part * turning, edges[first:last] - edges[first], axis=1)
    m = np.arange(-half, half + 1)
    # a mean belongs to the middle of its bin
    return np.asarray(fft.fft(bins, axis=1)[:, m] * np.exp(-1j * np.pi * m / bins.shape[1]))


def find_harmonics(
    data: NDArray[Any], sampling_hz: float, band: tuple[float, float], known_hz: Sequence[float] = (), max_count: int = 20
) -> tuple[list[Harmonic], NDArray[Any]]:
    """Find sinusoids and take them out of the record.

    A line that stands out of its neighbours is a sinusoid only if its envelope keeps its size: the kurtosis of the envelope is 1 for
    a sinusoid, also of slowly drifting frequency, and 2 for the response of a mode, however lightly damped, to random forces. It is
    removed by following its phase and subtracting the best-fitting amplitude and phase of each channel.

    Parameters
    ----------
    data : (r, n_samples) array
        Samples (n_channels, n_samples).
    sampling_hz : float
        Sampling rate [Hz].
    band : (low, high)
        Where to look [Hz].
    known_hz : sequence of float
        Rotor orders the user names: removed whether or not they stand out (searched within 0.5 %).
    max_count : int
        Largest number of sinusoids.

    Returns
    -------
    harmonics : list of Harmonic
        By frequency.
    data : (r, n_samples) array
        The record without them (the input itself if there are none).

    Examples
    --------
    >>> import numpy as np
    >>> from operando.oma import find_harmonics
    >>> t = np.arange(20_000) / 200
    >>> rng = np.random.default_rng(0)
    >>> found, rest = find_harmonics(5 * np.sin(2 * np.pi * 25 * t)[None] + rng.standard_normal((1, t.size)), 200.0, (5.0, 90.0))
    >>> [round(h.hz, 2) for h in found], round(float(rest.std()), 1)
    ([25.0], 1.0)
    """
    found: list[Harmonic] = []
    cleaned = data
    duration = data.shape[1] / sampling_hz
    refused: list[tuple[float, float]] = []
    fewest = -(-data.shape[1] // LONGEST)
    for hz in known_hz:
        if 0 < hz < sampling_hz / 2:
            f, height = line_height(cleaned, sampling_hz, fewest)
            near = np.abs(f - hz) <= max(0.005 * hz, 2 / duration)
            best = int(np.argmax(np.where(near, height, 0)))
            start = float(f[best]) if height[best] > 8 else float(hz)
            follow = follow_line(cleaned, sampling_hz, start, STEADY_WIDTH / duration, True)
            if follow.share < MIN_SHARE:
                follow = follow_line(cleaned, sampling_hz, start, max(DRIFT_WIDTH, 4 * (fewest - 1)) / duration, False)
            cleaned, energy = subtract_line(cleaned, sampling_hz, follow)
            found.append(Harmonic(follow.hz, follow.spread_hz, float(height[best]), follow.kurtosis, energy))
    for level, threshold in LEVELS:
        segments = level * fewest
        if data.shape[1] // segments < 256 or duration * (band[1] - band[0]) < 64 * segments:
            break
        for _ in range(3):
            f, height = line_height(cleaned, sampling_hz, segments)
            high = (f >= band[0]) & (f <= band[1]) & (height > threshold)
            peaks = np.flatnonzero(high & (height >= np.roll(height, 1)) & (height >= np.roll(height, -1)))
            peaks = peaks[[all(abs(f[k] - hz) > 2 * width for hz, width in refused) for k in peaks]] if peaks.size else peaks
            step = segments / duration
            before = len(found)
            for k in peaks[np.argsort(-height[peaks])]:
                line = _accepted(cleaned, sampling_hz, float(f[k]), segments)
                if line is None or len(found) >= max_count:
                    refused.append((float(f[k]), step))
                    continue
                cleaned, energy = subtract_line(cleaned, sampling_hz, line)
                found.append(Harmonic(line.hz, line.spread_hz, float(height[k]), line.kurtosis, energy))
            if len(found) == before:
                break
    found.sort(key=lambda h: h.hz)
    return _merged(found, duration), cleaned


def _accepted(data: NDArray[Any], sampling_hz: float, hz: float, segments: int) -> Line | None:
    """The line at ``hz`` if it is a sinusoid: steady and nearly all there is around, or drifting with an envelope that keeps its size."""
    duration = data.shape[1] / sampling_hz
    if segments == 1:
        line = follow_line(data, sampling_hz, hz, STEADY_WIDTH / duration, True)
        if line.share >= MIN_SHARE and line.kurtosis < MAX_KURTOSIS:
            return line
    line = follow_line(data, sampling_hz, hz, max(DRIFT_WIDTH, 4 * segments) / duration, False)
    return line if line.kurtosis < MAX_KURTOSIS else None


@dataclass(frozen=True, eq=False)
class Line(ByContent):
    """A sinusoid followed through a record: mean frequency, phase samples (time, phase about ``centre_hz``), and how well it holds.

    ``share`` is the part of the envelope's power that one steady frequency explains.
    """

    hz: float
    centre_hz: float
    time_s: NDArray[np.float64]
    phase: NDArray[np.float64]
    spread_hz: float
    kurtosis: float
    share: float


def follow_line(data: NDArray[Any], sampling_hz: float, hz: float, width_hz: float, steady: bool) -> Line:
    """Follow the sinusoid near ``hz`` by the envelope, within ± width/2, of the combination of channels that holds most of it."""
    duration = data.shape[1] / sampling_hz
    bands = envelope(data, sampling_hz, hz, width_hz)
    known = row_statistics(data)
    scale = np.maximum(np.sqrt(known.std**2 + known.mean**2), 1e-300)
    direction, _, _ = np.linalg.svd(bands / scale[:, None], full_matrices=False)
    one = (direction[:, 0].conj() / scale) @ bands
    edge = max(1, one.size // 16)
    power = np.abs(one[edge:-edge]) ** 2
    kurtosis = float(np.mean(power**2) / np.mean(power) ** 2)
    t = np.arange(one.size) * duration / one.size
    fine = 64 * one.size
    spectrum = np.abs(fft.fft(one, fine)) ** 2
    k = int(np.argmax(spectrum))
    offset = float(fft.fftfreq(fine, duration / one.size)[k])
    share = float(spectrum[k] / (one.size * np.sum(np.abs(one) ** 2)))
    if steady:
        return Line(hz + offset, hz, np.array([0.0, duration]), 2 * np.pi * offset * np.array([0.0, duration]), 0.0, kurtosis, share)
    phase = np.unwrap(np.angle(one))
    slope = (phase[-edge] - phase[edge]) / (t[-edge] - t[edge]) / 2 / np.pi
    return Line(float(hz + slope), hz, t, phase, width_hz, kurtosis, share)


def subtract_line(data: NDArray[Any], sampling_hz: float, line: Line) -> tuple[NDArray[np.float64], float]:
    """The record without the line (least-squares amplitude and phase of each channel), and its largest share of a channel's mean square."""

    def waves(first: int, last: int) -> NDArray[np.float64]:
        t = np.arange(first, last) / sampling_hz
        angle = 2 * np.pi * line.centre_hz * t + np.interp(t, line.time_s, line.phase)
        return np.array([np.cos(angle), np.sin(angle)])

    gram, right, power = np.zeros((2, 2)), np.zeros((2, data.shape[0])), np.zeros(data.shape[0])
    for first, part in pieces(data):
        x, both = np.asarray(part, float), waves(first, first + part.shape[1])
        gram += both @ both.T
        right += both @ x.T
        power += np.einsum("ij,ij->i", x, x)
    size = np.linalg.solve(gram, right)
    share = float(np.max(np.sum(size * right, axis=0) / np.maximum(power, 1e-300), initial=0.0))
    if isinstance(data, MappedSamples):

        def without(samples: NDArray[Any], rows: Sequence[int], first: int, last: int) -> NDArray[Any]:
            return np.asarray(samples - size[:, list(rows)].T @ waves(first, last))

        return data.changed_by(without, np.float64), share
    out = np.array(data, float)
    for first in range(0, out.shape[1], PIECE):
        out[:, first : first + PIECE] -= size.T @ waves(first, min(first + PIECE, out.shape[1]))
    return out, share


def _merged(found: list[Harmonic], duration: float) -> list[Harmonic]:
    """One entry where several passes took out parts of the same line."""
    out: list[Harmonic] = []
    for h in found:
        if out and h.hz - out[-1].hz < max(4 / duration, h.spread_hz / 2, out[-1].spread_hz / 2):
            if h.energy_share > out[-1].energy_share:
                out[-1] = h
        else:
            out.append(h)
    return out
