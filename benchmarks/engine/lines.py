"""Lines of measured FRFs to fit and to validate, and how alike their noise and a discrepancy are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

CORRELATED = 6.0  # neighbouring lines of a local rational estimate that count as one
FIT_LINES, VALIDATION_LINES, BLOCKS = 100, 50, 18


@dataclass
class Lines:
    """Lines where FRFs change: FRFs h, their variance, and a level for the discrepancy.

    By blocks, of which each third validates; never those at the ends of the band, beyond which nothing is fitted.
    """

    frf: Any
    f: np.ndarray  # Hz, of the modes
    zeta: np.ndarray
    number: int = FIT_LINES  # to fit

    def __post_init__(self) -> None:
        frf = self.frf
        hz, h = frf.frequencies_hz, np.moveaxis(frf.data, 2, 0)
        variance = (0.01 * np.abs(h)) ** 2 if frf.variance is None else np.moveaxis(frf.variance, 2, 0)
        good = np.isfinite(h).all((1, 2)) & np.isfinite(variance).all((1, 2))
        hz, h, variance = hz[good], h[good], np.maximum(variance[good], 1e-8 * np.abs(h[good]) ** 2)
        block = np.minimum(np.arange(hz.size) * BLOCKS // hz.size, BLOCKS - 1)
        change = np.median(np.abs(np.gradient(h, axis=0)) ** 2 / variance, axis=(1, 2))
        density = np.convolve(change, np.ones(5) / 5, "same") ** 0.25
        # the discrepancy is a share of the rms over ±1 % of frequency: it does not vanish at antiresonances
        total = np.cumsum(np.concatenate([np.zeros((1, *h.shape[1:])), np.abs(h) ** 2]), 0)
        half = np.maximum(2, (0.01 * hz / np.median(np.diff(hz))).astype(int))
        low, high = np.maximum(0, np.arange(hz.size) - half), np.minimum(hz.size, np.arange(hz.size) + half + 1)
        level = np.sqrt((total[high] - total[low]) / (high - low)[:, None, None])
        chosen = []
        for validates, number in ((False, self.number), (True, VALIDATION_LINES)):
            at = np.flatnonzero((block % 3 == 1) == validates)
            share = np.cumsum(0.6 * density[at] / density[at].sum() + 0.4 / at.size)
            i = np.unique(at[np.searchsorted(share, (np.arange(number) + 0.5) / number * share[-1] * 0.999999)])
            chosen.append(i)
        i = np.concatenate(chosen)
        self.fit, self.validation = np.split(np.arange(i.size), [chosen[0].size])
        self.w, self.h, self.variance, self.level = 2 * np.pi * hz[i], h[i], variance[i], level[i]
        self.line = i
        self.bases: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = {}
        self.band = float(hz[0]), float(hz[-1])
        self.warped = self._warp(hz[i])

    def basis(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Independent combinations of the lines of each pair (pairs, combinations, lines), and λ of their variances 1 + α²λ.

        The noise of neighbouring lines is alike, as the estimate makes it. The discrepancy multiplies an FRF by something smooth: it
        changes as fast as the FRF does, over half the distance to the nearest pole and no faster than its half-power width.
        """
        key = tuple(at)
        if key not in self.bases:
            line = self.line[at]
            noise = np.maximum(0, 1 - np.abs(line[:, None] - line) / CORRELATED)
            whiten = np.linalg.inv(np.linalg.cholesky(noise + 1e-9 * np.eye(at.size)))
            smooth = np.exp(-np.abs(self.warped[at][:, None] - self.warped[at]))
            variance = np.moveaxis(self.variance[at], 0, -1).reshape(-1, 1, at.size)
            level = np.moveaxis(self.level[at], 0, -1).reshape(-1, 1, at.size)
            scaled = whiten / np.sqrt(variance)
            values, vectors = np.linalg.eigh(scaled @ (smooth * level * np.swapaxes(level, 1, 2)) @ np.swapaxes(scaled, 1, 2))
            self.bases[key] = np.swapaxes(vectors, 1, 2) @ scaled, np.maximum(values, 0)
        return self.bases[key]

    def _warp(self, f: np.ndarray) -> np.ndarray:
        """Frequency in units over which an FRF changes."""
        fine = np.linspace(*self.band, 4000)
        away = np.abs(fine[:, None] - self.f)
        nearest = np.argmin(away, axis=1)
        width = np.maximum(np.abs(self.zeta[nearest]) * self.f[nearest], away.min(1) / 2)
        return np.interp(f, fine, np.concatenate([[0], np.cumsum(np.diff(fine) / width[1:])]))
