"""Correlations of long records by FFT, block by block: bounded memory, and the scatter between blocks for the uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data import row_statistics
from operando.errors import IdentificationError

CACHE_VALUES, MOST_VALUES = 300_000, 4_000_000
"""Samples of all channels transformed at a time: few enough that they and their spectra stay in the cache, but as many pieces as there
are channels within the second limit, so that the sum of cross spectra is not written more often than the pieces are."""


@dataclass(frozen=True)
class BlockCorrelations:
    """Unbiased correlations R(τ) = E[x(t+τ)·x_ref(t)ᵀ] of a record, and of consecutive blocks of it.

    ``mean`` (n_lags + 1, r, q) is that of the ``blocks`` with their ``weights``, the share of the samples in each.
    """

    mean: NDArray[np.float64]
    blocks: NDArray[np.floating[Any]] | None
    weights: NDArray[np.float64]


def correlate(
    data: NDArray[Any],
    references: NDArray[np.int_],
    n_lags: int,
    n_blocks: int = 1,
    keep_blocks: bool = True,
    centre: bool = False,
) -> BlockCorrelations:
    """Correlations of all channels (r, n_samples) with the reference channels (rows).

    Each block takes its own times t and looks ``n_lags`` samples beyond its end, so that nothing is lost at the block borders and no window
    is needed: blocks add up to the exact unbiased estimate of the whole record (but for the last ``n_lags`` samples as references). The
    mean alone takes less memory and fewer inverse FFTs. ``centre`` takes each channel's mean off first, without a copy of the record.
    """
    r, n_samples = data.shape
    usable = n_samples - n_lags
    length = usable // n_blocks
    if length < n_lags:
        raise IdentificationError(
            f"{n_samples} samples are too few for {n_blocks} blocks and {n_lags} lags",
            hint="take a longer record, a narrower band, or fewer block rows",
        )
    q, every = len(references), np.array_equal(references, np.arange(r))
    total = np.zeros((n_lags + 1, r, q))
    blocks = np.empty((n_blocks, n_lags + 1, r, q), np.float32) if keep_blocks else None
    # eight times the lags a transform, where blocks are longer: spectra stay in the cache; powers of two are transformed fastest
    size = 1 << int(np.ceil(np.log2(max(1024, 8 * n_lags))))
    step = size - n_lags
    if length <= step:
        step, size = length, fft.next_fast_len(length + n_lags, real=True)
    group = max(1, CACHE_VALUES // (r * size), min(r, MOST_VALUES // (r * size)))
    spectrum = np.zeros((size // 2 + 1, r, q), complex)
    offset = row_statistics(data).mean[:, None] if centre else 0.0

    def add(start: int, count: int, samples: int) -> None:
        """``count`` pieces one after the other, each with the lags beyond its end."""
        stretch = np.asarray(data[:, start : start + count * samples + n_lags])
        far, near = stretch.strides
        window = np.lib.stride_tricks.as_strided(stretch, (count, r, samples + n_lags), (samples * near, far, near), writeable=False)
        ahead = np.subtract(window, offset, dtype=float)
        x = np.ascontiguousarray(fft.rfft(ahead, size, axis=2).transpose(2, 1, 0))
        own = ahead if every else ahead[:, references]
        own[:, :, samples:] = 0  # times of this piece alone
        y = np.ascontiguousarray(fft.rfft(own, size, axis=2).transpose(2, 0, 1))
        np.add(spectrum, x @ np.conj(y, out=y), out=spectrum)

    for b in range(n_blocks):
        whole = length // step
        for first in range(0, whole, group):
            add(b * length + first * step, min(group, whole - first), step)
        if whole * step < length:
            add(b * length + whole * step, 1, length - whole * step)
        if blocks is not None:
            block = fft.irfft(spectrum, size, axis=0)[: n_lags + 1] / length
            blocks[b] = block
            total += block
            spectrum[:] = 0
    mean = total / n_blocks if blocks is not None else fft.irfft(spectrum, size, axis=0)[: n_lags + 1] / (n_blocks * length)
    return BlockCorrelations(mean, blocks, np.full(n_blocks, 1 / n_blocks))


def pool(parts: list[BlockCorrelations], samples: list[int]) -> BlockCorrelations:
    """Correlations of several runs (same lags, channels and references) as one, weighted by their lengths; their blocks stay apart."""
    if len(parts) == 1:
        return parts[0]
    share = np.asarray(samples, float) / sum(samples)
    mean = np.sum([s * p.mean for s, p in zip(share, parts, strict=True)], axis=0)
    blocks = None if parts[0].blocks is None else np.concatenate([p.blocks for p in parts])
    return BlockCorrelations(mean, blocks, np.concatenate([s * p.weights for s, p in zip(share, parts, strict=True)]))


def block_hankel(correlations: NDArray[Any], block_rows: int, block_columns: int) -> NDArray[Any]:
    """Block-Hankel matrix of the lags 1 … block_rows + block_columns − 1: block (k, l) is R(k + l + 1), k and l from 0."""
    _, r, q = correlations.shape
    flat = np.ascontiguousarray(correlations[1 : block_rows + block_columns])
    step = flat.strides
    view = np.lib.stride_tricks.as_strided(flat, (block_rows, r, block_columns, q), (step[0], step[1], step[0], step[2]), writeable=False)
    return view.reshape(block_rows * r, block_columns * q)
