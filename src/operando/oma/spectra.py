"""Output spectra for the eye: singular values of the power spectral density matrix (frequency-domain decomposition)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

TOGETHER = 16
"""Blocks whose spectra are multiplied at once."""


@dataclass(frozen=True)
class Spectra:
    """Singular values of the one-sided PSD matrix: frequencies [Hz] (k,), singular_values (n_curves, k), unit²/Hz; unpacks into the two."""

    frequencies_hz: NDArray[np.float64]
    singular_values: NDArray[np.float64]

    def __iter__(self) -> Iterator[NDArray[np.float64]]:
        return iter((self.frequencies_hz, self.singular_values))


def output_spectra(
    runs: Sequence[NDArray[Any]], sampling_hz: float, band: tuple[float, float], n_curves: int = 4, max_lines: int = 2000
) -> Spectra:
    """Singular values of the averaged PSD matrix (Brincker, Zhang & Andersen 2001): Hann blocks, half overlapped, streamed.

    Parameters
    ----------
    runs : sequence of (r, n_samples) arrays
        Samples (n_channels, n_samples) of each run.
    sampling_hz : float
        Sampling rate [Hz].
    band : (low, high)
        [Hz]; a tenth more is shown on either side.
    n_curves : int
        Largest singular values kept.
    max_lines : int
        The block length is chosen for at least 30 averages and no more lines than this.

    Returns
    -------
    Spectra

    Examples
    --------
    >>> import numpy as np
    >>> from operando.oma import output_spectra
    >>> motion = np.sin(2 * np.pi * 12.5 * np.arange(4000) / 100)
    >>> spectra = output_spectra([np.stack([motion, motion])], 100.0, (2.0, 40.0))
    >>> bool(abs(spectra.frequencies_hz[spectra.singular_values[0].argmax()] - 12.5) < 0.2)
    True
    """
    n = min(run.shape[1] for run in runs)
    total = sum(run.shape[1] for run in runs)
    low, high = 0.9 * band[0], min(1.1 * band[1], sampling_hz / 2)
    size = min(total // 15, n, int(max_lines * sampling_hz / max(high - low, sampling_hz / n)))
    size = max(64, 2 ** int(np.log2(max(size, 64))))
    size = min(size, n)
    f = np.arange(size // 2 + 1) * sampling_hz / size
    keep = np.flatnonzero((f >= low) & (f <= high) & (f > 0))[:max_lines]
    r = runs[0].shape[0]
    window = np.hanning(size + 1)[:-1]
    psd = np.zeros((keep.size, r, r), complex)
    count = 0
    hop = max(size // 2, 1)
    together = max(1, min(TOGETHER, (1 << 22) // (r * size)))
    for run in runs:
        starts = range(0, run.shape[1] - size + 1, hop)
        for batch in (starts[k : k + together] for k in range(0, len(starts), together)):
            stretch = np.asarray(run[:, batch[0] : batch[-1] + size])
            blocks = np.array([stretch[:, start - batch[0] : start - batch[0] + size] for start in batch], float)
            blocks -= blocks.mean(axis=2, keepdims=True)
            blocks *= window
            lines = np.ascontiguousarray(fft.rfft(blocks, axis=2, overwrite_x=True)[:, :, keep].transpose(2, 1, 0))
            psd += lines @ lines.conj().swapaxes(1, 2)
            count += len(batch)
    psd *= 2 / (max(count, 1) * sampling_hz * np.sum(window**2))
    values = np.linalg.eigvalsh(psd)[:, ::-1][:, :n_curves].T
    return Spectra(f[keep], np.maximum(values, 0))
