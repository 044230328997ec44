"""Averaged auto and cross spectra, streamed block by block through a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from operando.errors import DataError

WINDOWS = ("hann", "rectangular")


@dataclass(frozen=True)
class CrossSpectra:
    """One-sided spectral densities of forces and responses.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
    force : (n_forces, n_forces, n_lines) complex array
        Gff[i, j] = E F_i F_j*.
    cross : (n_responses, n_forces, n_lines) complex array
        Gxf[i, j] = E X_i F_j*.
    response : (n_responses, n_lines) array
        Auto spectra of the responses.
    blocks, averages : int, float
        Blocks used, and the number of independent averages they are worth.
    skipped : int
        Blocks left out because of samples that are not finite or lie in a span marked as bad.
    """

    frequencies_hz: NDArray[np.float64]
    force: NDArray[np.complex128]
    cross: NDArray[np.complex128]
    response: NDArray[np.float64]
    blocks: int
    averages: float
    skipped: int = 0


def window_samples(name: str, length: int) -> NDArray[np.float64]:
    """Window of ``length`` samples: periodic ``hann`` or ``rectangular``.

    Raises
    ------
    DataError
        If the name is unknown.
    """
    if name == "hann":
        return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    if name == "rectangular":
        return np.ones(length)
    raise DataError(f"window {name!r} is none of {', '.join(WINDOWS)}")


def effective_averages(window: ArrayLike, starts: ArrayLike) -> float:
    """Independent averages that overlapping blocks are worth.

    n / (1 + 2/n Σ_{a<b} ρ²(t_b − t_a)), ρ(k) = Σ w(t)w(t+k)/Σ w² (Welch 1967). The same factor holds for
    the variance of an FRF, where noise and force decorrelate together.

    Parameters
    ----------
    window : (block,) array
    starts : (n,) array of int
        First sample of each block, increasing.
    """
    w = np.asarray(window, float)
    s = np.asarray(starts, int)
    if s.size == 0:
        return 0.0
    total = 0.0
    power = float(w @ w)
    cache: dict[int, float] = {}
    for step in range(1, s.size):
        lags = s[step:] - s[:-step]
        near = lags[lags < w.size]
        if near.size == 0:
            break
        for lag, count in zip(*np.unique(near, return_counts=True), strict=True):
            if int(lag) not in cache:
                cache[int(lag)] = (float(w[: w.size - lag] @ w[lag:]) / power) ** 2
            total += float(count) * cache[int(lag)]
    return float(s.size / (1 + 2 * total / s.size))


def block_starts(n_samples: int, block: int, overlap: float) -> NDArray[np.intp]:
    """First sample of each block of a record, ``overlap`` in [0, 1).

    Raises
    ------
    DataError
        If the record is shorter than a block or the overlap is out of range.
    """
    if not 0 <= overlap < 1:
        raise DataError(f"overlap {overlap} is not in [0, 1)", hint="0.5 suits a Hann window")
    if block < 4 or n_samples < block:
        raise DataError(f"{n_samples} samples do not hold a block of {block}", hint="give a smaller block_seconds")
    hop = max(1, round(block * (1 - overlap)))
    return np.arange(0, n_samples - block + 1, hop)


def cross_spectra(
    data: NDArray[np.floating[Any]],
    force_rows: Sequence[int],
    response_rows: Sequence[int],
    sampling_hz: float,
    block: int,
    *,
    overlap: float = 0.5,
    window: str = "hann",
    lines: slice | None = None,
    bad: Sequence[tuple[int, int]] = (),
    starts: ArrayLike | None = None,
    windows: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    offsets: NDArray[np.float64] | None = None,
    group: int = 8,
) -> CrossSpectra:
    """Welch estimate of Gff, Gxf and the diagonal of Gxx (Welch 1967; Bendat & Piersol, Random Data).

    The record is read block by block (memory maps and single precision are fine); nothing of its length is
    ever held in memory. The mean of each block is removed.

    Parameters
    ----------
    data : (n_channels, n_samples) array
    force_rows, response_rows : sequence of int
    sampling_hz : float
    block : int
        Samples a block.
    overlap : float
        Share of a block that the next one repeats.
    window : {"hann", "rectangular"}
    lines : slice, optional
        Lines of the block spectrum to keep.
    bad : sequence of (first, last)
        Sample spans that no block may touch.
    starts : array of int, optional
        First sample of each block (hammer hits) instead of even overlap.
    windows : (force window, response window), optional
        Arrays of ``block`` samples instead of ``window``.
    offsets : (n_channels,) array, optional
        Taken off each row instead of the mean of each block (a hit has a mean of its own).
    group : int
        Response rows transformed at once (bounds the working memory).

    Raises
    ------
    DataError
        If no block is usable.
    """
    first = block_starts(data.shape[1], block, overlap) if starts is None else np.asarray(starts, int)
    w_force, w = windows if windows is not None else (window_samples(window, block),) * 2
    keep = slice(None) if lines is None else lines
    frequencies = fft.rfftfreq(block, 1 / sampling_hz)[keep]
    n_f, n_x, n_l = len(force_rows), len(response_rows), frequencies.size
    gff = np.zeros((n_f, n_f, n_l), complex)
    gxf = np.zeros((n_x, n_f, n_l), complex)
    gxx = np.zeros((n_x, n_l))
    scratch = np.empty((group, n_l), complex)
    forces, responses = list(force_rows), list(response_rows)
    groups = [slice(i, min(i + group, n_x)) for i in range(0, n_x, group)]

    def transform(rows: list[int], start: int, w: NDArray[np.float64]) -> NDArray[np.complex128]:
        x = np.empty((len(rows), block))
        for i, row in enumerate(rows):
            x[i] = data[row, start : start + block]
        x -= x.mean(axis=1, keepdims=True) if offsets is None else offsets[rows, None]
        x *= w
        return np.asarray(fft.rfft(x, axis=1, overwrite_x=True)[:, keep])

    used = []
    for start in first:
        if any(start <= last and start + block > begin for begin, last in bad) or bad_values(data, (*forces, *responses), start, block):
            continue
        used.append(start)
        f = transform(forces, start, w_force)
        fc = f.conj()
        for i in range(n_f):
            gff[i] += f[i] * fc
        for g in groups:
            x = transform(responses[g], start, w)
            gxx[g] += x.real**2 + x.imag**2
            tmp = scratch[: g.stop - g.start]
            for j in range(n_f):
                np.multiply(x, fc[j], out=tmp)
                gxf[g, j] += tmp
    if not used:
        raise DataError("no block of the record is free of bad samples", hint="exclude the bad channel, or give a smaller block_seconds")
    scale = 2 / (sampling_hz * float(w @ w) * len(used))
    gff *= scale
    gxf *= scale
    return CrossSpectra(frequencies, gff, gxf, gxx * scale, len(used), effective_averages(w, used), int(first.size - len(used)))


def bad_values(data: NDArray[np.floating[Any]], rows: Sequence[int], start: int, block: int) -> bool:
    """Whether any of the rows holds a value that is not finite within the block."""
    return any(not np.isfinite(data[row, start : start + block].sum()) for row in rows)
