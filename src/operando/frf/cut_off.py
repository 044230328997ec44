"""What blocks at hits cut off, and what rings into them from the hits before: put right by the poles of the peaks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.frf.leakage import Peak, resonance_peaks

Array = NDArray[Any]

LEAST = 1e-5
"""Part of its amplitude that a peak must keep at the end of a block to be put right: far below any noise."""
_LINES, _WIDTHS = 5.5, 2.5  # half the stretch that a pole is fitted to: lines, or half-power bandwidths where these are more
_ALONE, _HALVED = 3.0, 0.5  # squares over their number under noise that one pole leaves where a peak hides two, and the part that two do
_EXPLAINED = 30.0  # the same, above which nothing is put right
_PASSES = 3  # each takes the error down by the part that is cut off


@dataclass(frozen=True)
class CutOff:
    """One mode of which blocks hold too little, and too much from the hits before."""

    peak_hz: float
    pole: complex  # [rad/s]
    residues: Array  # of the FRFs (n_responses,)
    part: float  # of the amplitude at its peak that is wrong in the average
    states: Array  # motion before each block less that at its end (n_blocks,)


def cut_off_modes(
    frequencies_hz: ArrayLike,
    h: Array,
    variance: Array,
    force: Array,
    starts: NDArray[np.intp],
    block: int,
    sampling_hz: float,
) -> list[CutOff]:
    """The modes whose decays blocks at hits cut off, and which ring into them from the hits before, by frequency.

    Of a mode with the pole p = exp(λΔt), whose motion is y[n] = p·y[n−1] + f[n], a block of N samples from s holds

        Y(z) (1 − p/z) = F(z) + p·(y[s−1] − y[s+N−1])        at the lines of the block, where z^N = 1:

    the error has the pole of the mode itself, and the force alone tells how large it is against the response. Poles and residues are fitted
    to the lines around each peak, all responses together. ``h`` and ``variance`` (n_responses, n_lines) are averaged over the blocks (H1);
    ``force`` is that of the whole record, without offset: hits that are not used ring on as well.
    """
    from scipy.signal import lfilter

    f = np.asarray(frequencies_hz, float)
    seconds = block / sampling_hz
    peaks = [p for p in resonance_peaks(f, h[:, None], variance[:, None]) if np.exp(-np.pi * p.bandwidth_hz * seconds) > LEAST]
    if not peaks:
        return []
    lines = np.rint(f * seconds).astype(int)
    spectra = np.array([np.fft.rfft(force[s : s + block])[lines] for s in starts])
    power = np.maximum(np.sum(np.abs(spectra) ** 2, axis=0), 1e-300)
    out, found = h, list[CutOff]()
    for _ in range(_PASSES):
        wrong, found = np.zeros_like(h), []
        for peak in peaks:
            for pole, residues in _poles_and_residues(f, out, variance, peak, peaks, max(_WIDTHS * peak.bandwidth_hz, _LINES / seconds)):
                if not pole.real < 0 or np.exp(pole.real * seconds) < LEAST or not f[0] <= pole.imag / (2 * np.pi) <= f[-1]:
                    continue
                p = np.exp(pole / sampling_hz)
                y = np.append(lfilter([1.0], [1.0, -p], force.astype(complex)), 0.0)  # the motion before the first sample is none
                states = y[starts - 1] - y[starts + block - 1]
                part = (p * states) @ spectra.conj() / power
                wrong += residues[:, None] * part / (2j * np.pi * f - pole)
                at_peak = float(np.abs(np.interp(peak.frequency_hz, f, np.abs(part))))
                found.append(CutOff(peak.frequency_hz, pole, residues, at_peak, states))
        out = h - wrong
    return sorted(found, key=lambda c: c.peak_hz)


def with_whole_decays(responses: Array, modes: Sequence[CutOff], starts: NDArray[np.intp], block: int, sampling_hz: float) -> Array:
    """Responses (n, n_samples) whose blocks hold the whole decays of their own hits, and nothing of those before; changed in place.

    The error of a block, p·(y[s−1] − y[s+N−1])/(1 − p/z) at its lines, is in time the decay pⁿ⁺¹/(1 − p^N) of the same state.
    """
    n = np.arange(block)
    for mode in modes:
        p = np.exp(mode.pole / sampling_hz)
        decay = p ** (n + 1) / (1 - p**block) / sampling_hz
        for start, state in zip(starts, mode.states, strict=True):
            responses[:, start : start + block] -= 2 * np.real(np.outer(mode.residues, state * decay))
    return responses


def _poles_and_residues(f: Array, h: Array, variance: Array, peak: Peak, peaks: list[Peak], far: float) -> list[tuple[complex, Array]]:
    """Pole [rad/s] and residues of a peak, or of two that it hides: by least squares of all responses, beside neighbours and a parabola.

    None where the lines around it are not explained.
    """
    from scipy.optimize import least_squares

    near = np.abs(f - peak.frequency_hz) < far
    w, across = 2 * np.pi * f[near], (f[near] - peak.frequency_hz) / far
    noise = np.mean(variance[:, near], axis=1)
    rows = (h[:, near] / np.sqrt(np.maximum(noise, 1e-12 * np.mean(np.abs(h[:, near]) ** 2, axis=1) + 1e-300))[:, None]).T
    rows = rows[:, np.isfinite(noise)]
    others = [_start(q, 0.0) for q in peaks if q is not peak and abs(q.frequency_hz - peak.frequency_hz) < far]
    free = rows.shape[1] * (w.size - 3 - len(others) - 2)
    if free <= 0:
        return []

    def fitted(first: Array) -> tuple[float, Array, Array]:
        unit = np.abs(first.real)

        def poles(x: Array) -> Array:
            return np.asarray(first + unit * (x[::2] + 1j * x[1::2]))

        def basis(pole: Array) -> Array:
            return np.concatenate([unit / (1j * w[:, None] - pole), across[:, None] ** np.arange(3)], axis=1)

        def left(x: Array) -> Array:
            q = np.linalg.qr(basis(poles(x)))[0]
            return np.ascontiguousarray(rows - q @ (q.conj().T @ rows)).view(float).ravel()

        ended = least_squares(left, np.zeros(2 * first.size), max_nfev=30)
        found = poles(ended.x)
        residues = unit[:, None] * np.linalg.lstsq(basis(found), h[:, near].T, rcond=None)[0][: first.size]
        return float(2 * ended.cost), found, residues

    hidden = False
    squares, poles, residues = fitted(np.array([_start(peak, 0.0), *others]))
    if squares > _ALONE * free:
        two = fitted(np.array([_start(peak, -0.25), _start(peak, 0.25), *others]))
        hidden = two[0] < _HALVED * squares
        squares, poles, residues = two if hidden else (squares, poles, residues)
    if squares > _EXPLAINED * free:
        return []
    # A pole outside the stretch is an extrapolation: it describes what the parabola does not, and says nothing where it lies.
    at = poles[: 1 + hidden].imag / (2 * np.pi)
    own = [peak is min(peaks, key=lambda q: abs(hz - q.frequency_hz)) and abs(hz - peak.frequency_hz) < far for hz in at]
    return [(complex(poles[k]), residues[k]) for k in np.flatnonzero(own)]


def _start(peak: Peak, aside: float) -> complex:
    """A pole that a peak suggests, so many of its bandwidths aside."""
    return complex(-np.pi * peak.bandwidth_hz * (1 - abs(aside)), 2 * np.pi * (peak.frequency_hz + aside * peak.bandwidth_hz))
