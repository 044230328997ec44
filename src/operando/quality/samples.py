"""Faults of single channels, found in their samples alone. Pure functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data.mapped import PIECE

Array = NDArray[Any]

SHORTEST_DROPOUT = 16
SLOPES = 1 << 22
"""Samples of which the slopes are compared, in the middle of longer records: the 5 % at the top are 200 000."""

PILED = 8.0
"""Samples at an extreme over those beside it, in a signal that is cut there (see :func:`pile_up`)."""
WIDEST = 0.03
"""Largest width of a pile, of the extreme: a cut with noise of 0.4 % of it."""
LEAST_PILED = 5e-4
"""Smallest share of the samples piled up at one extreme: a random force cut there is 0.01 dB off (Bussgang 1952)."""


@dataclass(frozen=True)
class Span:
    """Samples ``first`` to ``last`` (both included)."""

    first: int
    last: int

    @property
    def length(self) -> int:
        """Number of samples."""
        return self.last - self.first + 1


def constant_runs(x: Array, shortest: int = 2) -> list[Span]:
    """Runs of at least ``shortest`` equal samples, in order."""
    equal = x[1:] == x[:-1]
    if not equal.any():
        return []
    starts, stops = _stretches(equal)  # run covers starts .. stops
    keep = stops - starts + 1 >= shortest
    return [Span(int(a), int(b)) for a, b in zip(starts[keep], stops[keep], strict=True)]


def not_finite(x: Array) -> list[Span]:
    """Runs of NaN or Inf."""
    bad = ~np.isfinite(x)
    if not bad.any():
        return []
    return [Span(int(a), int(b) - 1) for a, b in zip(*_stretches(bad), strict=True)]


def _stretches(where: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First sample of each stretch that is true, and one past its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def smallest_step(x: Array) -> float:
    """Smallest difference of neighbouring samples that is not zero: the quantisation of a digitised signal."""
    smallest = np.inf
    for first in range(0, x.size - 1, PIECE):
        steps = np.abs(np.diff(x[first : first + PIECE + 1].astype(float)))
        smallest = min(smallest, float(steps[steps > 0].min(initial=np.inf)))
    return smallest if np.isfinite(smallest) else 0.0


def overload(x: Array, runs: list[Span] | None = None) -> list[Span]:
    """Clipping at full scale: three or more equal samples at the highest or lowest value, reached by a jump.

    A jump is more than twenty quantisation steps on either side: a few equal samples at the top of a coarsely digitised small signal
    are no overload.

    Parameters
    ----------
    x : (n,) finite array
    runs : list of Span, optional
        Runs of equal samples, where known.
    """
    runs = constant_runs(x) if runs is None else runs
    top, bottom = float(x.max()), float(x.min())
    if top == bottom:
        return []
    candidates = [r for r in runs if r.length >= 3 and float(x[r.first]) in (top, bottom)]
    if not candidates:
        return []
    step = smallest_step(x)

    def jump(run: Span) -> float:
        sides = [abs(float(x[k]) - float(x[run.first])) for k in (run.first - 1, run.last + 1) if 0 <= k < x.size]
        return max(sides, default=0.0)

    part = x[:: max(1, x.size // 20001)].astype(float)
    middle = float(np.median(part))
    spread = float(1.4826 * np.median(np.abs(part - middle)))
    limit = max(spread, 0.02 * max(top - middle, middle - bottom))
    # A long rest value that happens to be the least or largest sample (a hammer at rest) is near the median, not at full scale.
    return [r for r in candidates if jump(r) > 20 * step and abs(float(x[r.first]) - middle) > limit]


@dataclass(frozen=True)
class PileUp:
    """Samples piled up at the top, the bottom or both: where, how many, and the first and last of them."""

    level: float
    share: float
    span: Span


def pile_up(x: Array) -> PileUp | None:
    """Evidence that a signal is cut at a level: far more samples within some width of an extreme than in the two widths next to it.

    Unlike :func:`overload` it needs no runs of equal samples, so that it finds what a converter with noise, or a fast signal, leaves. The
    density of a sine grows to its top, too: with depth w as √w, by a factor of 2.7 over the mean of the next two widths; that of a wave as
    flat as a fourth power by 6.3; a cut by ``PILED`` and more. Two-level signals (nearly everything at the extremes) are no cut ones.

    Parameters
    ----------
    x : (n,) finite array
    """
    middle = float(np.median(x))
    top, bottom = float(x.max()) - middle, middle - float(x.min())
    step = smallest_step(x)
    rows = np.zeros(x.size, bool)
    level = 0.0
    starts = range(0, x.size, PIECE)
    for sign, height in ((1.0, top), (-1.0, bottom)):

        def depth(first: int, sign: float = sign, height: float = height) -> Array:
            return np.asarray(height - sign * (x[first : first + PIECE] - middle))

        near = np.sort(np.concatenate([d[d < 3 * WIDEST * height] for d in map(depth, starts)]))
        width = max(1.5 * step, 1e-6 * height)
        while width < WIDEST * height:
            first = int(np.searchsorted(near, width))
            beside = 0.5 * (int(np.searchsorted(near, 3 * width)) - first)
            if first > max(LEAST_PILED * x.size, 10.0) and first > PILED * max(beside, 1.0) and first < 0.4 * x.size:
                for start in starts:
                    rows[start : start + PIECE] |= depth(start) < width
                level = max(level, abs(middle + sign * height))
                break
            width *= 2
    where = np.flatnonzero(rows)
    return PileUp(level, where.size / x.size, Span(int(where[0]), int(where[-1]))) if where.size else None


def dropouts(x: Array, runs: list[Span] | None = None) -> list[Span]:
    """Runs of one value far longer than the signal explains, at least 16 samples; those at full scale are overload, not dropout.

    In a coarsely digitised signal, where equal neighbours are usual, a run must be ten times longer than 99 % of the runs.
    """
    runs = constant_runs(x) if runs is None else runs
    long = [r for r in runs if r.length >= SHORTEST_DROPOUT]
    if not long:
        return []
    clipped = {(r.first, r.last) for r in overload(x, runs)}
    long = [r for r in long if (r.first, r.last) not in clipped]
    lengths = np.array([r.length for r in runs])
    short = lengths[lengths < SHORTEST_DROPOUT]
    if short.sum() > 0.02 * x.size:
        limit = max(64.0, 10 * float(np.quantile(lengths, 0.99)))
        long = [r for r in long if r.length >= limit]
    return long


@dataclass(frozen=True)
class Saturation:
    """Evidence of soft clipping: crest factor, and mean square slope at the top relative to the middle."""

    crest: float
    slope_ratio: float


def soft_clipping(x: Array) -> Saturation | None:
    """Evidence that large values are compressed, None where there is none or it cannot be told.

    In a random signal slope and level are independent; a compressing characteristic y = g(x) leaves the slope at the top small,
    and the crest factor low. Not tested are signals of few zero crossings, those of few tones and sweeps (a sine looks the
    same), and white noise up to the Nyquist frequency, where neighbouring samples say nothing about the slope.
    """
    x = x - float(np.mean(x, dtype=float))
    rms = float(np.sqrt(sum(float(np.sum(np.square(x[k : k + PIECE], dtype=float))) for k in range(0, x.size, PIECE)) / x.size))
    if rms == 0:
        return None
    crest = max(float(x.max()), -float(x.min())) / rms
    if crest > 2.6 or np.count_nonzero(np.signbit(x[1:]) != np.signbit(x[:-1])) < 500 or _few_tones(x):
        return None
    x = x[max(0, (x.size - SLOPES) // 2) :][:SLOPES]
    size = np.abs(x[1:-1])
    slope = np.square(x[2:] - x[:-2], dtype=float)
    high, middle = slope[size > np.quantile(size, 0.95)], slope[size < np.quantile(size, 0.5)]
    ratio = float(high.mean() / max(float(middle.mean()), 1e-300))
    return Saturation(crest, ratio) if ratio < 0.35 else None


def _few_tones(x: Array) -> bool:
    """Whether 80 % of the energy is in fewer than 1 % of the lines of a long spectrum, or most short pieces hold a single line."""
    part = x[: min(x.size, 1 << 16)].astype(float)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(part.size) / part.size)
    power = np.sort(np.abs(fft.rfft(part * hann)) ** 2)[::-1]
    if np.searchsorted(np.cumsum(power), 0.8 * power.sum()) < 0.01 * power.size:
        return True
    length = 128
    pieces = part[: part.size // length * length].reshape(-1, length)
    pieces = pieces * (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length))
    short = np.abs(fft.rfft(pieces, axis=1)) ** 2
    top = np.clip(short.argmax(axis=1), 2, short.shape[1] - 3)
    around = np.take_along_axis(short, top[:, None] + np.arange(-2, 3), axis=1).sum(axis=1)
    return bool(np.median(around / np.maximum(short.sum(axis=1), 1e-300)) > 0.9)
