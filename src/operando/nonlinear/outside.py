"""What modes outside the band add at a place: the idle model knows it only as far as its drive points saw it.

Where nothing was driven, the part of H0·b that comes from modes above the band is a guess. It is a smooth function of frequency, so each
response may have a few smooth kernels of its own, times the restoring force and times the measured forces. What is found in
band is not touched by them. Restoring force and kernels are found in turn; the product is what the data see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from operando.nonlinear.place import Along, Weighted
from operando.nonlinear.run import Complex, Modes, Real, Run

FACTORS = (1.3, 2.0, 5.0)
"""Kernels stand at these multiples of the last line."""

DAMPING = 0.01
TIMING_PRIOR = 8.0
"""Prior of the term that a skewed clock or force channel leaves at the driven response itself, over that of the kernels."""


def kernels(hz: Real, top_hz: float) -> Complex:
    """Smooth accelerances of modes above the band, (3, L), then iω/ω_top: a small delay of what feeds directly through."""
    w, top = 2 * np.pi * hz, 2 * np.pi * top_hz
    rows = [-(w**2) / ((q * top) ** 2 - w**2 + 2j * DAMPING * q * top * w) for q in FACTORS]
    return np.stack([*rows, 1j * w / top])


@dataclass(frozen=True)
class Outside:
    """Coefficients of the kernels.

    Parameters
    ----------
    top_hz : float
    place : (m, 4) array
        For the restoring force at each DOF of the idle model.
    forces : tuple of (q, 4·k) arrays
        For the forces of each run, force by force.
    """

    top_hz: float
    place: Real
    forces: tuple[Real, ...]

    @classmethod
    def none(cls, runs: Sequence[Run], n_dofs: int, top_hz: float) -> Outside:
        """No correction."""
        width = len(FACTORS) + 1
        return cls(top_hz, np.zeros((n_dofs, width)), tuple(np.zeros((r.rows.size, width * len(r.forces_at))) for r in runs))

    def accelerance(self, run: Run) -> Complex:
        """Correction of H0·b at the responses of a run."""
        return np.asarray(self.place[run.rows] @ kernels(run.hz, self.top_hz))

    def response(self, run: Run, number: int) -> Complex:
        """Correction of H0·F."""
        return np.asarray(self.forces[number] @ force_columns(run, self.top_hz))

    def compliance(self, hz: Real, b: Real) -> Complex:
        """Receptance across the place that the modes lack; the clock term is no motion and is left out."""
        w = 2 * np.pi * hz
        own = b @ self.place
        out = np.zeros(hz.size, complex)
        for c, q in zip(own, FACTORS, strict=False):
            wq = 2 * np.pi * self.top_hz * q
            out += c / (wq**2 - w**2 + 2j * DAMPING * wq * w)
        return out


def force_columns(run: Run, top_hz: float) -> Complex:
    """Kernels times each measured force, (4k, L)."""
    k = kernels(run.hz, top_hz)
    return np.concatenate([k * f for f in run.forces[: len(run.forces_at), run.lines]])


@dataclass(frozen=True)
class Seen:
    """A place with its restoring forces and corrections.

    Parameters
    ----------
    b : (m,) array
    outside : Outside
    alongs : tuple of Along
        One a run, corrected.
    forces : tuple of (L,) arrays
        Restoring force without a law.
    amplitudes : tuple of (J,) arrays
        Of the free decays.
    misfit : float
        Mean squared weighted error that no force at the place explains; 1 is noise.
    """

    b: Real
    outside: Outside
    alongs: tuple[Along, ...]
    forces: tuple[Complex, ...]
    amplitudes: tuple[Real, ...]
    misfit: float


def look(
    weighted: Sequence[Weighted], modes: Modes, b: Real, prior: float, start: Outside, turns: int = 3, laws: Sequence[Complex] | None = None
) -> Seen:
    """Restoring force at a place without a law, in turn with what modes outside the band add there.

    Parameters
    ----------
    weighted : sequence of Weighted
        All runs, with the errors of the idle model.
    modes : Modes
    b : (m,) array
    prior : float
        Standard deviation of a kernel's coefficient [1/kg].
    start : Outside
    turns : int
    laws : sequence of (L,) arrays, optional
        Restoring forces that are already known; then only the corrections are sought.

    Returns
    -------
    Seen
    """
    outside = start
    fixed = [None] * len(weighted) if laws is None else list(laws)
    base = [w.run.accelerance(modes, b) for w in weighted]
    raw = [w.error / w.root for w in weighted]
    for turn in range(turns + 1):
        alongs, forces, amplitudes = [], [], []
        remaining, count = 0.0, 0
        for i, w in enumerate(weighted):
            here = w.with_error(raw[i] - outside.response(w.run, i))
            along = Along.of(here, b, base[i] + outside.accelerance(w.run))
            if fixed[i] is None:
                force, amplitude, rest = along.free_force()
                count += (w.run.rows.size - 1) * w.run.hz.size
            else:
                force, amplitude, rest = along.free_force(0.0, fixed[i])
                count += w.run.rows.size * w.run.hz.size
            alongs.append(along)
            forces.append(force)
            amplitudes.append(amplitude)
            remaining += rest
        if turn == turns:
            break
        outside = _correct(weighted, raw, base, forces, amplitudes, b, prior, outside)
    return Seen(b, outside, tuple(alongs), tuple(forces), tuple(amplitudes), remaining / count)


def _correct(
    weighted: Sequence[Weighted],
    raw: Sequence[Complex],
    base: Sequence[Complex],
    forces: Sequence[Complex],
    amplitudes: Sequence[Real],
    b: Real,
    prior: float,
    last: Outside,
) -> Outside:
    """Coefficients of the kernels for given restoring forces and decays: a ridge regression at each response."""
    width = len(FACTORS) + 1
    m = b.size
    sizes = [width * len(w.run.forces_at) for w in weighted]
    offset = np.concatenate([[width], width + np.cumsum(sizes)])
    gram = np.zeros((m, offset[-1], offset[-1]))
    right = np.zeros((m, offset[-1]))
    std = np.full((m, offset[-1]), prior)
    timing = np.arange(width - 1, offset[-1], width)
    std[:, timing] = 1e-9 * prior
    std[np.flatnonzero(b), width - 1] = TIMING_PRIOR * prior
    for i, w in enumerate(weighted):
        run = w.run
        error = raw[i] + base[i] * forces[i] - run.decay_shapes @ (amplitudes[i][:, None] * run.decays)
        columns = np.concatenate([-kernels(run.hz, last.top_hz) * forces[i], force_columns(run, last.top_hz)])
        weight = w.root**2
        pairs = np.real(columns[:, None] * columns[None].conj())
        inner = np.tensordot(weight, pairs, axes=([1], [2]))
        index = np.r_[:width, offset[i] : offset[i + 1]]
        gram[np.ix_(run.rows, index, index)] += inner
        right[np.ix_(run.rows, index)] += np.real((error * weight) @ columns.conj().T)
        for k, row in enumerate(run.forces_at):
            std[row, offset[i] + width * k + width - 1] = TIMING_PRIOR * prior
    gram += np.einsum("mc,cd->mcd", 1 / std**2, np.eye(offset[-1]))
    solved = np.linalg.solve(gram, right[..., None])[..., 0]
    return Outside(last.top_hz, solved[:, :width], tuple(solved[w.run.rows, offset[i] : offset[i + 1]] for i, w in enumerate(weighted)))


def kernel_prior(modes: Modes, in_band: np.ndarray) -> float:
    """Size of a kernel's coefficient to be expected: the mean square of the shapes in band [1/kg]."""
    proper = modes.phi[:, in_band] if np.any(in_band) else modes.phi
    return float(np.median(np.mean(proper**2, axis=1)))
