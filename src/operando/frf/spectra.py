"""Averaged auto and cross spectra, streamed block by block through a record."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from operando.data import MappedSamples
from operando.errors import DataError
from operando.limits import WINDOWS

BLOCKS = {4: 16, 8: 8}
"""Blocks of a row taken at once, by the bytes of a sample: they stay in the cache of a core at usual block lengths, and the sums go
through the memory once for all of them."""
STRETCH = 1 << 23
"""Samples of all rows held at once (64 MB), unless a single block has more."""


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
    """Window of ``length`` samples: periodic ``hann`` or ``rectangular``."""
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
        Samples of the window.
    starts : (n,) array of int
        First sample of each block, increasing.

    Returns
    -------
    float

    Examples
    --------
    >>> import numpy as np
    >>> round(effective_averages(np.hanning(100), np.arange(0, 1000, 50)), 1)
    19.1
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
    """First sample of each block of a record, ``overlap`` in [0, 1)."""
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
    finite: bool = False,
) -> CrossSpectra:
    """Welch estimate of Gff, Gxf and the diagonal of Gxx (Welch 1967; Bendat & Piersol, Random Data).

    The record is read block by block (samples in their file and single precision are fine); nothing of its length is
    ever held in memory. The mean of each block is removed.

    Samples in single precision are windowed and transformed as such. That adds white noise of about 1.4e-7 of the effective value of
    a block, five times what rounding the samples to single precision left (Schatzman 1996, Accuracy of the discrete Fourier transform
    and the fast Fourier transform). Sums over more than 16 blocks are in double precision.

    Parameters
    ----------
    data : (n_channels, n_samples) array
        Samples (rows, n_samples).
    force_rows, response_rows : sequence of int
        Rows of the forces.
    sampling_hz : float
        Sampling rate [Hz].
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
    finite : bool
        All samples of the rows are known to be finite; else each block is looked through.

    Returns
    -------
    CrossSpectra

    Raises
    ------
    DataError
        If no block is usable.

    Examples
    --------
    >>> import numpy as np
    >>> force = np.random.default_rng(0).normal(size=4096)
    >>> spectra = cross_spectra(np.array([force, 2 * force]), [0], [1], 256.0, 512)
    >>> bool(np.allclose(spectra.cross[0, 0, 5] / spectra.force[0, 0, 5], 2))
    True
    """
    first = block_starts(data.shape[1], block, overlap) if starts is None else np.asarray(starts, int)
    w_force, w = windows if windows is not None else (window_samples(window, block),) * 2
    keep = slice(None) if lines is None else lines
    frequencies = fft.rfftfreq(block, 1 / sampling_hz)[keep]
    forces, responses = list(force_rows), list(response_rows)
    n_f, n_x, n_l = len(forces), len(responses), frequencies.size
    real = np.dtype(np.float32 if data.dtype == np.float32 else np.float64)  # of the transforms
    gff = np.zeros((n_f, n_f, n_l), complex)
    gxf = np.zeros((n_x, n_f, n_l), complex)
    squares = np.zeros((n_x, 2 * n_l))
    most = BLOCKS[real.itemsize]
    blocks = np.empty((most, block), real)
    conjugate = np.empty((most, n_f, n_l), np.result_type(real, np.complex64))
    total, scratch = np.empty((2, n_f, n_l), conjugate.dtype)
    rows = [*forces, *responses]
    weights = w_force.astype(real), w.astype(real)
    mean = np.full(block, 1 / block, real)  # a product of BLAS is faster than the mean

    def transform(place: int, w: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """Spectra of a row (its place in ``rows``) in the blocks of the batch: (blocks, lines)."""
        samples = np.asarray(data[rows[place], begin:stop]) if held is None else held[place]
        x = blocks[: len(at)]
        for b, start in enumerate(at):
            x[b] = samples[start : start + block]
        x -= (x @ mean)[:, None] if offsets is None else offsets[rows[place]]
        x *= w
        spectra: NDArray[Any] = fft.rfft(x, axis=1, overwrite_x=True)[:, keep]
        return spectra

    def products(x: NDArray[Any]) -> NDArray[Any]:
        """Sum over the blocks of a row's spectra times the conjugate ones of the forces: (n_forces, n_lines)."""
        np.multiply(x[0], conjugate[0], out=total)
        for one, other in zip(x[1:], conjugate[1 : len(x)], strict=True):
            np.multiply(one, other, out=scratch)
            np.add(total, scratch, out=total)
        return total

    used = []
    for batch in _batches(first, block, len(rows), most):
        good = [start for start in batch if not any(start <= last and start + block > begin for begin, last in bad)]
        if not good:
            continue
        begin, stop = good[0], good[-1] + block
        if finite and (not isinstance(data, MappedSamples) or data.rows_apart):
            held = None  # a row that is read when it is transformed stays in the cache
        else:
            held = np.asarray(data[rows, begin:stop])
        at = [start - begin for start in good]
        if held is not None and not finite:
            at = [k for k in at if all(np.isfinite(s[k : k + block].sum()) for s in held)]
            if not at:
                continue
        used += [begin + k for k in at]
        f = [transform(i, weights[0]) for i in range(n_f)]
        for i in range(n_f):
            np.conjugate(f[i], out=conjugate[: len(at), i])
        for i in range(n_f):
            gff[i] += products(f[i])
        for k in range(n_x):
            # One response at a time: its sums and the spectra of the forces stay in the cache over the blocks.
            x = transform(n_f + k, weights[1])
            if n_f:
                gxf[k] += products(x)
            parts = np.ascontiguousarray(x).view(real)
            squares[k] += np.einsum("bl,bl->l", parts, parts)
    if not used:
        raise DataError("no block of the record is free of bad samples", hint="exclude the bad channel, or give a smaller block_seconds")
    scale = 2 / (sampling_hz * float(w @ w) * len(used))
    gff *= scale
    gxf *= scale
    gxx = (squares[:, ::2] + squares[:, 1::2]) * scale
    return CrossSpectra(frequencies, gff, gxf, gxx, len(used), effective_averages(w, used), int(first.size - len(used)))


def _batches(starts: NDArray[np.intp], block: int, rows: int, most: int) -> Iterator[list[int]]:
    """Blocks that are read at once: up to ``most`` that follow each other closely, and no more samples than ``STRETCH``."""
    batch: list[int] = []
    for start in starts.tolist():
        if batch and (len(batch) == most or start > batch[-1] + block or (start + block - batch[0]) * rows > STRETCH):
            yield batch
            batch = []
        batch.append(start)
    if batch:
        yield batch
