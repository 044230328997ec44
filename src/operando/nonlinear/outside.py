"""What modes outside the band add at a place: the idle model knows it only as far as its drive points saw it.

Where nothing was driven, the part of H0·b that comes from modes above the band is a guess. It is a smooth function of frequency, so each
response may have a few smooth kernels of its own, times the restoring force and times the measured forces. What is found in
band is not touched by them. Restoring force and kernels are found in turn; the product is what the data see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from operando.data import ModalModel
from operando.nonlinear.place import Along, Weighted
from operando.nonlinear.run import Complex, Modes, Real, Run

FACTORS = (1.08, 1.3, 2.0, 5.0)
"""Kernels stand at these multiples of the last line."""

LOOKED_AT, LEAST = 25, 1e-3
"""Lines on which the idle model is asked how sure it is, and the least doubt over what is usual."""

DAMPING = 0.01
TIMING_PRIOR = 8.0
"""Prior of the term that a skewed clock or force channel leaves at the driven response itself, over that of the kernels."""


def kernels(hz: Real, top_hz: float) -> Complex:
    """Smooth accelerances of modes above the band, (4, L), then iω/ω_top: a small delay of what feeds directly through."""
    w, top = 2 * np.pi * hz, 2 * np.pi * top_hz
    rows = [-(w**2) / ((q * top) ** 2 - w**2 + 2j * DAMPING * q * top * w) for q in FACTORS]
    return np.stack([*rows, 1j * w / top])


@dataclass(frozen=True)
class Outside:
    """Coefficients of the kernels.

    Parameters
    ----------
    top_hz : float
    place : (m, 5) array
        For the restoring force at each DOF of the idle model.
    forces : tuple of (q, 5·k) arrays
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
    """Kernels times each measured force, (5k, L)."""
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
        Mean squared weighted error that no force at the place explains; 1 is noise. With one response and a free force nothing is left
        (0): any place explains it.
    """

    b: Real
    outside: Outside
    alongs: tuple[Along, ...]
    forces: tuple[Complex, ...]
    amplitudes: tuple[Real, ...]
    misfit: float


def look(
    weighted: Sequence[Weighted], modes: Modes, b: Real, doubt: Doubt, start: Outside, turns: int = 3, laws: Sequence[Complex] | None = None
) -> Seen:
    """Restoring force at a place without a law, in turn with what modes outside the band add there.

    Parameters
    ----------
    weighted : sequence of Weighted
        All runs, with the errors of the idle model.
    modes : Modes
    b : (m,) array
    doubt : Doubt
        How far each kernel may go.
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
                if turn == 0 < turns:
                    force, amplitude, _ = doubted(here, along, doubt.place(b), float(np.median(np.abs(force))), outside.top_hz).free_force()
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
        # A response whose path is doubtful hides what is wrong with it at first: the force of the others stands then.
        outside = _correct(weighted, raw, alongs, forces, [0 for _ in weighted] if turn == 0 else fixed, amplitudes, b, doubt, outside)
    return Seen(b, outside, tuple(alongs), tuple(forces), tuple(amplitudes), remaining / max(count, 1))


def doubted(weighted: Weighted, along: Along, std: Real, size: float, top_hz: float) -> Along:
    """A place whose responses count by what is sure of their paths, too, for restoring forces of a size.

    Parameters
    ----------
    weighted : Weighted
    along : Along
    std : (m,) array
        Standard deviations of the kernels' coefficients at all DOFs [1/kg].
    size : float
        Usual size of the force's spectrum.
    top_hz : float
    """
    run = weighted.run
    spread = np.sum(np.abs(kernels(run.hz, top_hz)[:-1]) ** 2, axis=0)
    variance = run.variance + (size * std[run.rows][:, None]) ** 2 * spread
    return Along.of(Weighted.of(replace(run, variance=variance), weighted.error / weighted.root), along.b, along.h)


def _correct(
    weighted: Sequence[Weighted],
    raw: Sequence[Complex],
    alongs: Sequence[Along],
    forces: Sequence[Complex],
    fixed: Sequence[Any],
    amplitudes: Sequence[Real],
    b: Real,
    doubt: Doubt,
    last: Outside,
) -> Outside:
    """Coefficients of the kernels at given decays, by one Gauss–Newton step in which the restoring force is free on each line.

    ``fixed`` is None where the force is free. It only hides what lies along H0·b then, so that direction is projected out (variable
    projection, Golub & Pereyra 1973). In turn, force first and coefficients then, a response that outweighs all others would keep what is
    wrong with it.
    """
    width = len(FACTORS) + 1
    m = b.size
    sizes = [w.run.rows.size * width * len(w.run.forces_at) for w in weighted]
    offset = m * width + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    gram = np.zeros((offset[-1], offset[-1]))
    right = np.zeros(offset[-1])
    std = np.zeros(offset[-1])
    std[: m * width] = np.repeat(doubt.place(b), width)
    std[width - 1 : m * width : width] = 1e-9 * doubt.scale
    std[np.flatnonzero(b) * width + width - 1] = TIMING_PRIOR * doubt.scale
    for i, w in enumerate(weighted):
        run, q = w.run, w.run.rows.size
        own = offset[i] + np.arange(sizes[i]).reshape(q, -1)
        index = np.concatenate([run.rows[:, None] * width + np.arange(width), own], axis=1)
        base = alongs[i].h - last.accelerance(run)
        error = (raw[i] + base * forces[i] - run.decay_shapes @ (amplitudes[i][:, None] * run.decays)) * w.root
        columns = np.concatenate([-kernels(run.hz, last.top_hz) * forces[i], force_columns(run, last.top_hz)])
        pairs = np.real(columns[:, None] * columns[None].conj())
        inner = np.tensordot(w.root**2, pairs, axes=([1], [2]))
        for rows, block in zip(index, inner, strict=True):
            gram[np.ix_(rows, rows)] += block
        right[index] += np.real((error * w.root) @ columns.conj().T)
        if fixed[i] is None:
            u = alongs[i].h * w.root / alongs[i].gain
            hidden = ((u.conj() * w.root)[:, None] * columns[None]).reshape(-1, run.hz.size)
            along = np.sum(u.conj() * error, axis=0)
            both = np.concatenate([hidden.real, hidden.imag], axis=1)
            flat = index.ravel()
            gram[np.ix_(flat, flat)] -= both @ both.T
            right[flat] -= both @ np.concatenate([along.real, along.imag])
        std[own] = np.repeat(doubt.pairs[np.ix_(run.rows, np.array(run.forces_at))], width, axis=1)
        timing = own[:, width - 1 :: width]
        std[timing] = 1e-9 * doubt.scale
        for k, row in enumerate(run.forces_at):
            std[timing[run.rows == row, k]] = TIMING_PRIOR * doubt.scale
    solved = std * np.linalg.solve(gram * np.outer(std, std) + np.eye(offset[-1]), right * std)
    found = tuple(solved[offset[i] : offset[i + 1]].reshape(w.run.rows.size, -1) for i, w in enumerate(weighted))
    return Outside(last.top_hz, solved[: m * width].reshape(m, width), found)


@dataclass(frozen=True)
class Doubt:
    """How far the FRFs of the idle model may be off by what lies outside the band, as standard deviations of the kernels' coefficients.

    Parameters
    ----------
    pairs : (m, m) array
        For each pair of DOFs [1/kg].
    scale : float
        What is usual for a DOF that was not driven [1/kg].
    """

    pairs: Real
    scale: float

    @classmethod
    def of(cls, idle: ModalModel, modes: Modes, band: tuple[float, float]) -> Doubt:
        """From the covariance of the idle model; where it has none each pair may be off by what is usual."""
        usual = kernel_prior(modes, idle.terms.in_band)
        m = len(idle.dofs)
        hz = np.linspace(*band, LOOKED_AT)
        variance = None if idle.covariance is None else idle.frf(hz, idle.dofs, idle.dofs, "accelerance").variance
        if variance is None:
            return cls(np.full((m, m), usual), usual)
        size = np.sum(np.abs(kernels(hz, band[1])[:-1]) ** 2, axis=0)
        # In the median over lines: near a resonance its own uncertainty stands above that of what lies outside.
        return cls(np.maximum(np.sqrt(np.median(variance / size, axis=2)), LEAST * usual), usual)

    def place(self, b: Real) -> Real:
        """For the accelerances of a force along b."""
        return np.asarray(np.sqrt(self.pairs**2 @ b**2))


def kernel_prior(modes: Modes, in_band: np.ndarray) -> float:
    """Size of a kernel's coefficient to be expected: the mean square of the shapes in band [1/kg]."""
    proper = modes.phi[:, in_band] if np.any(in_band) else modes.phi
    return float(np.median(np.mean(proper**2, axis=1)))
