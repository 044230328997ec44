"""Lines of measured FRFs to fit and to validate, and how alike their noise and a discrepancy are."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.diagnosis.criteria import BLOCKS, CORRELATED_LINES, FIT_LINES, POOLED_LINES, VALIDATION_LINES
from operando.ema.pairs import noise_shape
from operando.errors import DataError

Array = NDArray[Any]
_FLOOR_LINES = 25  # to each side, for the floor of the noise: wider than any peak
_LEAST_VARIANCE = 1e-12  # of the mean of a pair: sums of its inverse keep four digits
_ROUGH, _STEPS = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), (1, 4)  # difference of the fourth order; of lines so far apart
_OWN = 0.1  # of the variance, that each line has of its own where lines are alike: of a local model of order 2 over 17 lines 0.08 by the
# differences of neighbours, 0.12 by what a model leaves; beside it the correlation falls evenly to none at 11
_MOST_ALIKE = 60  # lines over which noise can be alike
_LEAST_BLOCK = 8  # lines from peak to peak
_NOTHING = 1e12  # variance of a pair that was not measured, over the mean square of those that were


class Lines:
    """Lines where FRFs change, a level for the discrepancy, and two sets: to fit, and to validate.

    Each third block of lines validates, which tells what a model is worth where nothing was fitted; blocks at the ends of the band never
    do. Blocks end at the peaks, so that one flank of each is fitted: a mode that no line tells could be moved at will. Or lines in between
    validate, so that both flanks are.

    Parameters
    ----------
    frf : Frf
        Receptance; rows in the order of the model's DOFs.
    f, zeta : (modes,) arrays
        Hz, ratio.
    number : int
        Lines to fit.
    correlated : float, optional
        Neighbouring lines over which the noise is alike; default from the FRFs (:func:`alike_lines`).
    between : bool
        Whether lines in between validate.

    Attributes
    ----------
    fit, validation : int arrays
        Numbers of the lines of each set.
    there : (responses, references) bool array
        Pairs that were measured.
    noise_stated : bool
        Whether the FRFs bring a variance; else it is that of :func:`~operando.ema.pairs.noise_shape`, by which neighbouring lines differ.
    w : (lines,) array [rad/s]
    h, variance, level : (lines, responses, references) arrays
        FRFs, their variance, and their rms over ±1 % of frequency: a share of it does not vanish at antiresonances.

    Raises
    ------
    DataError
        If fewer than ``BLOCKS`` lines are finite.
    """

    frequencies = 40  # trial ones of an absorber
    stride, rough = 2, 4  # each second line ranks candidates about a state, each fourth those about what is not fitted yet
    sizes = 24  # trial ones, that meet every peak

    def __init__(
        self,
        frf: Frf,
        f: Array,
        zeta: Array,
        number: int = FIT_LINES,
        correlated: float | None = None,
        between: bool = False,
    ) -> None:
        self.f, self.zeta = f, zeta
        hz, h = frf.frequencies_hz, np.moveaxis(frf.data, 2, 0)
        self.noise_stated = frf.variance is not None
        variance = np.zeros(h.shape) if frf.variance is None else np.moveaxis(frf.variance, 2, 0)
        finite = np.isfinite(h) & np.isfinite(variance)
        self.there = finite.mean(axis=0) > 0.5
        good = finite[:, self.there].all(1)
        if good.sum() < BLOCKS or not self.there.any():
            raise DataError(
                f"{int(good.sum()) if self.there.any() else 0} lines of validation FRFs are finite in all measured pairs, "
                f"a diagnosis needs {BLOCKS}",
                hint="name the bad channel in the test file, or widen the band",
            )
        hz, h = hz[good], np.where(self.there, h[good], 0)
        given = (
            np.where(self.there, variance[good], 1.0)
            if self.noise_stated
            else noise_shape(np.asarray(h, complex).reshape(len(h), -1).T).T.reshape(h.shape)
        )
        variance = np.maximum(_pooled(given, np.abs(h) ** 2), 1e-8 * np.abs(h) ** 2)
        measured = h[:, self.there], variance[:, self.there]
        self.correlated = correlated or (alike_lines(*measured) if self.noise_stated else CORRELATED_LINES)
        # a pair that was not measured weighs nothing
        variance = np.where(self.there, variance, _NOTHING * np.mean(np.abs(h[:, self.there]) ** 2))
        block = _blocks(np.mean(np.log(np.maximum(np.abs(h[:, self.there]) ** 2, 1e-300)), axis=1), np.searchsorted(hz, f))
        change = np.median((np.abs(np.gradient(h, axis=0)) ** 2 / variance)[:, self.there], axis=1)
        density = np.convolve(change, np.ones(5) / 5, "same") ** 0.25
        level = np.sqrt(_mean(np.abs(h) ** 2, np.maximum(2, (0.01 * hz / np.median(np.diff(hz))).astype(int))))

        self.band = float(hz[0]), float(hz[-1])
        moves = np.gradient(self._warp(hz))  # each mode of the model as much, however narrow

        def some(at: Array, count: int) -> Array:
            share = np.cumsum(0.6 * density[at] / density[at].sum() + 0.4 * moves[at] / moves[at].sum())
            return np.unique(at[np.searchsorted(share, (np.arange(count) + 0.5) / count * share[-1] * 0.999999)])

        if between:
            every = some(np.arange(hz.size), number + VALIDATION_LINES)
            out = np.linspace(0, every.size, VALIDATION_LINES + 2)[1:-1].astype(int)
            chosen = [np.delete(every, out), every[out]]
        else:
            chosen = [
                some(np.flatnonzero(((block % 3 == 1) & (block < block[-1])) == validates), n)
                for validates, n in ((False, number), (True, VALIDATION_LINES))
            ]
        i = np.concatenate(chosen)
        self.fit, self.validation = np.split(np.arange(i.size), [chosen[0].size])
        edges = np.flatnonzero(np.diff(block)) + 1
        self.validation_hz = [(float(b[0]), float(b[-1])) for k, b in enumerate(np.split(hz, edges)) if k % 3 == 1 and k < block[-1]]
        self.w, self.h, self.variance, self.level = 2 * np.pi * hz[i], h[i], variance[i], level[i]
        self._number = i
        self._all = hz, h, variance, level
        self._bases: dict[tuple[int, ...], tuple[Array, Array]] = {}
        self._warped = self._warp(hz[i])

    def alike(self, at: Array) -> Array:
        """Correlation of the noise of some lines, (lines, lines)."""
        line = self._number[at]
        return _alike(np.abs(line[:, None] - line), self.correlated)

    def basis(self, at: Array) -> tuple[Array, Array]:
        """Independent combinations of some lines, and λ of their variances 1 + α²λ.

        The noise of neighbouring lines is alike, as the estimate makes it. The discrepancy α multiplies an FRF by something smooth: it
        changes as fast as the FRF does, over half the distance to the nearest pole and no faster than its half-power width.

        The combinations are (responses, references, combinations, lines), λ (responses, references, combinations).
        """
        key = tuple(at)
        if key not in self._bases:
            whiten = np.linalg.inv(np.linalg.cholesky(self.alike(at)))
            smooth = np.exp(-np.abs(self._warped[at][:, None] - self._warped[at]))
            shape = *self.there.shape, at.size
            combinations, spread = np.empty((*shape, at.size)), np.empty(shape)
            for response in range(shape[0]):  # all at once take several times the memory
                variance, level = (v[at, response].T[:, None] for v in (self.variance, self.level))
                scaled = whiten / np.sqrt(variance)
                values, vectors = np.linalg.eigh(scaled @ (smooth * level * np.swapaxes(level, 1, 2)) @ np.swapaxes(scaled, 1, 2))
                np.matmul(np.swapaxes(vectors, 1, 2), scaled, out=combinations[response])
                spread[response] = np.maximum(values, 0)
            self._bases[key] = combinations, spread
        return self._bases[key]

    def rows(self, values: Array, at: Array) -> Array:
        """Values (lines, responses, references, k) as independent real ones, (responses, rows, k), of variance ½ without a discrepancy."""
        basis = self.basis(at)[0]
        responses, references, combinations, _ = basis.shape
        laid = np.ascontiguousarray(np.moveaxis(values, 0, 2)).view(float)
        k = values.shape[3]
        out = (basis @ laid).reshape(responses, references, combinations, k, 2)
        return np.ascontiguousarray(np.moveaxis(out, 4, 3)).reshape(responses, references * combinations * 2, k)

    def spread(self, at: Array) -> Array:
        """λ of the rows, (responses, rows)."""
        spread = self.basis(at)[1]
        return np.repeat(spread.reshape(spread.shape[0], -1), 2, axis=1)

    def rows_variance(self, alpha: float, at: Array) -> Array:
        """Of the rows, times two, (responses, rows)."""
        return np.asarray(1 + alpha**2 * self.spread(at))

    @property
    def known(self) -> Array:
        """Lines from which those that validate are predicted."""
        return self.fit

    def by_stretch(self, values: Array, at: Array) -> Array:
        """Sums of values (lines,) over stretches in which a discrepancy stays alike."""
        return np.bincount((self._warped[at] - self._warped[at].min()).astype(int), weights=values)

    def error(self, predicted: Array, at: Array) -> float:
        """Of predicted FRFs (lines, responses, references), dB, rms."""
        db = 20 * np.log10(np.abs(predicted[:, self.there]) / np.abs(self.h[at][:, self.there]))
        return float(np.sqrt(np.mean(db**2)))

    def telling(self, rows: int) -> Array:
        """A quarter of the rows, real and imaginary parts together, which tells a discrepancy as well as all."""
        some = np.arange(0, rows // 2, 4)
        return np.asarray(np.stack([2 * some, 2 * some + 1], 1).ravel())

    def correlation(self, predicted: Array, alpha: float) -> float:
        """Neighbouring lines over which the noise is alike, from what a prediction on all lines (``w_all``) leaves.

        1 + 2 Σ ρ_k of the residuals over their standard deviation, to the first below 0.1, without what each has of its own; single large
        ones are cut to three.
        """
        _, h, variance, level = self._all
        left = (h - predicted) / np.sqrt(variance + (alpha * level) ** 2)
        left = left[:, self.there] / np.maximum(np.abs(left[:, self.there]) / 3, 1)
        power = np.mean(np.abs(left) ** 2)
        total = 1.0
        for k in range(1, min(60, len(left) // 4)):
            rho = float(np.mean((left[k:] * left[:-k].conj()).real) / power)
            if rho < 0.1:
                break
            total += 2 * rho
        return max(CORRELATED_LINES, (total - _OWN) / (1 - _OWN))

    @property
    def every(self) -> tuple[Array, Array, Array, Array]:
        """All lines of the band: frequency [Hz], and FRFs with their variance and level (lines, responses, references)."""
        return self._all

    @property
    def w_all(self) -> Array:
        """All lines of the band [rad/s]."""
        return 2 * np.pi * self._all[0]

    def _warp(self, f: Array) -> Array:
        return changes(f, self.band, self.f, self.zeta)


def changes(hz: Array, band: tuple[float, float], f: Array, zeta: Array) -> Array:
    """Frequency in units over which FRFs of modes (Hz, ratio) change: half the distance to the nearest, its half-power width at least."""
    fine = np.linspace(*band, 4000)
    away = np.abs(fine[:, None] - f)
    nearest = np.argmin(away, axis=1)
    width = np.maximum(np.abs(zeta[nearest]) * f[nearest], away.min(1) / 2)
    return np.asarray(np.interp(hz, fine, np.concatenate([[0], np.cumsum(np.diff(fine) / width[1:])])))


def alike_lines(h: Array, variance: Array) -> float:
    """Neighbouring lines over which the noise of FRFs (lines, pairs) is alike, by their differences of the fourth order.

    These take away what changes slowly, and the median over lines and pairs does without the peaks: from lines that follow each other, and
    from each fourth. The variance of such a difference over that of a line is 70 where lines are independent, and less the farther they
    are alike (:func:`_alike`). Where the FRFs themselves are seen in the differences, lines count as independent.
    """
    counts = np.arange(1.0, _MOST_ALIKE + 1)
    missed = np.zeros(counts.size)
    for step in _STEPS:
        size = step * (_ROUGH.size - 1)
        if len(h) <= size:
            return CORRELATED_LINES
        rough = sum(a * h[step * k : len(h) - size + step * k] for k, a in enumerate(_ROUGH))
        middle = variance[size // 2 : len(h) - size + size // 2]
        power = max(float(np.median(np.abs(rough) ** 2 / middle)) / np.log(2), 1e-300)  # a squared modulus is exponential
        apart = step * np.abs(np.subtract.outer(np.arange(_ROUGH.size), np.arange(_ROUGH.size)))
        wanted = [float(_ROUGH @ _alike(apart, c) @ _ROUGH) for c in counts]
        missed += np.log(min(power, _ROUGH @ _ROUGH) / np.array(wanted)) ** 2
    return float(counts[int(np.argmin(missed))])


def _alike(apart: Array, count: float) -> Array:
    """Correlation of the noise of lines so far apart: it falls evenly over ``count`` lines, beside what each line has of its own."""
    return np.asarray(np.where(apart == 0, 1.0, (1 - _OWN) * np.maximum(0, 1 - apart / count)))


def _blocks(level: Array, modes: Array) -> Array:
    """Number of the block of each line, given the logarithm of the mean power of all FRFs, and the lines of the modes of the model.

    Blocks end at the peaks (of 3 dB or more) and at the modes, and are no longer than the band over ``BLOCKS``.
    """
    from scipy.signal import find_peaks  # half a second, which only a search needs

    count = level.size
    smooth = np.convolve(np.pad(level, 1, "edge"), np.ones(3) / 3, "valid")
    peaks, _ = find_peaks(smooth, prominence=np.log(2), distance=max(_LEAST_BLOCK, count // (4 * BLOCKS)))
    ends = [0, count]
    for line in [*peaks.tolist(), *modes.tolist()]:
        if min(abs(line - end) for end in ends) >= _LEAST_BLOCK:
            ends.append(line)
    inner = [np.linspace(a, b, max(1, round((b - a) * BLOCKS / count)) + 1)[:-1] for a, b in pairwise(sorted(ends))]
    starts = np.unique(np.concatenate(inner).astype(int))
    return np.asarray(np.searchsorted(starts, np.arange(count), side="right") - 1)


def _pooled(variance: Array, power: Array) -> Array:
    """Variances of few averages, averaged over lines where their shape is known: a floor, and a share of the FRF's own power.

    Noise of the response is smooth over frequency; that of the force, and what changes from hit to hit, is a share of |H|², and a
    plain mean would take it from the peaks to their flanks.
    """
    count = len(variance)
    # a harmonic mean over a wide stretch is the floor beside the peaks; a line that is exactly zero would swallow the sums of all others
    least = np.maximum(_LEAST_VARIANCE * variance.mean(axis=0), 1e-300)
    floor = 1 / _mean(1 / np.maximum(variance, least), np.full(count, _FLOOR_LINES))
    loud = power > 10 * np.median(power, axis=0)
    share = np.sum(np.where(loud, variance - floor, 0), axis=0) / np.maximum(np.sum(np.where(loud, power, 0), axis=0), 1e-300)
    shape = floor + np.maximum(share, 0) * power
    return np.asarray(shape * _mean(variance / shape, np.full(count, POOLED_LINES)))


def _mean(values: Array, half: Array) -> Array:
    """Mean over so many lines to each side, along the first axis."""
    count = len(values)
    total = np.cumsum(np.concatenate([np.zeros((1, *values.shape[1:])), values]), 0)
    low, high = np.maximum(0, np.arange(count) - half), np.minimum(count, np.arange(count) + half + 1)
    return np.asarray((total[high] - total[low]) / (high - low).reshape(-1, *[1] * (values.ndim - 1)))
