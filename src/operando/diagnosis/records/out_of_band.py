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
from operando.diagnosis.records.place import Along, Weighted, apart
from operando.diagnosis.records.run import Run
from operando.structure.modal_space import Complex, Modes, Real

FACTORS = (1.08, 1.3, 2.0, 5.0)
"""Kernels stand at these multiples of the last line."""

WIDTH = len(FACTORS) + 1
"""Kernels of a response: one a factor, and that of a delay."""

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


def force_columns(run: Run, top_hz: float) -> Complex:
    """Kernels times each measured force, (5k, L)."""
    k = kernels(run.hz, top_hz)
    return np.concatenate([k * f for f in run.forces[: len(run.forces_at), run.lines]])


@dataclass(frozen=True)
class OutOfBand:
    """Coefficients of the kernels up from the last line at ``top_hz``."""

    top_hz: float
    place: Real  # for the restoring force at each DOF of the idle model (m, 5)
    forces: tuple[Real, ...]  # for the forces of each run, force by force (q, 5k)

    @classmethod
    def none(cls, runs: Sequence[Run], n_dofs: int, top_hz: float) -> OutOfBand:
        """No correction."""
        return cls(top_hz, np.zeros((n_dofs, WIDTH)), tuple(np.zeros((r.rows.size, WIDTH * len(r.forces_at))) for r in runs))

    def accelerance(self, run: Run) -> Complex:
        """Correction of H0·b at the responses of a run."""
        return np.asarray(self.place[run.rows] @ kernels(run.hz, self.top_hz))

    def response(self, run: Run, number: int) -> Complex:
        """Correction of H0·F."""
        return np.asarray(self.forces[number] @ force_columns(run, self.top_hz))

    def compliance(self, hz: Real, b: Real) -> Complex:
        """Receptance across the place that the modes lack; the clock term is no motion and is left out."""
        w, wq = 2 * np.pi * hz, 2 * np.pi * self.top_hz * np.array(FACTORS)[:, None]
        return np.asarray((b @ self.place)[:-1] @ (1 / (wq**2 - w**2 + 2j * DAMPING * wq * w)))


@dataclass(frozen=True)
class Doubt:
    """How far the FRFs of the idle model may be off by what lies outside the band: standard deviations of the coefficients [1/kg]."""

    pairs: Real  # for each pair of DOFs (m, m)
    scale: float  # what is usual for a DOF that was not driven

    @classmethod
    def of(cls, idle: ModalModel, modes: Modes, band: tuple[float, float]) -> Doubt:
        """From the covariance of the idle model; where it has none each pair may be off by what is usual."""
        in_band = idle.terms.in_band
        proper = modes.phi[:, in_band] if np.any(in_band) else modes.phi
        usual = float(np.median(np.mean(proper**2, axis=1)))
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


def look(
    weighted: Sequence[Weighted],
    modes: Modes,
    b: Real,
    doubt: Doubt,
    start: OutOfBand,
    turns: int = 3,
    laws: Sequence[Complex] | None = None,
) -> tuple[OutOfBand, float]:
    """Restoring force at a place b (m,) without a law, in turn with what modes outside the band add there, from all runs.

    Where the restoring forces ``laws`` (L,) of the runs are already known only the corrections are sought. With them goes the mean
    squared weighted error that no force there explains; 1 is noise. With one response and a free force nothing is left (0): any place
    explains it.
    """
    outside = start
    fixed = [None] * len(weighted) if laws is None else list(laws)
    base = [w.run.accelerance(modes.phi.T @ b) for w in weighted]
    for turn in range(turns + 1):
        found: list[tuple[Along, Complex, Real]] = []
        remaining, count = 0.0, 0
        for i, w in enumerate(weighted):
            here = w.with_error(w.raw - outside.response(w.run, i))
            along = Along.of(here, b, base[i] + outside.accelerance(w.run))
            known = fixed[i]
            force, amplitudes, rest = along.free_force() if known is None else along.free_force(0.0, known)
            if known is None and turn == 0 < turns:
                sure = doubted(along, doubt.place(b), float(np.median(np.abs(force))), outside.top_hz)
                force, amplitudes, _ = sure.free_force()
            count += (w.run.rows.size - (known is None)) * w.run.hz.size
            found.append((along, force, amplitudes))
            remaining += rest
        if turn < turns:
            # A response whose path is doubtful hides what is wrong with it at first: the force of the others stands then.
            outside = _corrected(weighted, found, [turn > 0 and f is None for f in fixed], b, doubt, outside)
    return outside, remaining / max(count, 1)


def doubted(along: Along, std: Real, size: float, top_hz: float) -> Along:
    """A place whose responses count by what is sure of their paths, too: ``std`` (m,) of the coefficients, usual size of the force."""
    run = along.run
    spread = np.sum(np.abs(kernels(run.hz, top_hz)[:-1]) ** 2, axis=0)
    variance = run.variance + (size * std[run.rows][:, None]) ** 2 * spread
    return Along.of(Weighted.of(replace(run, variance=variance), along.weighted.raw), along.b, along.h)


def _corrected(
    weighted: Sequence[Weighted],
    found: Sequence[tuple[Along, Complex, Real]],
    free: Sequence[bool],
    b: Real,
    doubt: Doubt,
    last: OutOfBand,
) -> OutOfBand:
    """Coefficients of the kernels at given decays, by one Gauss–Newton step in which a ``free`` restoring force is so on each line.

    It only hides what lies along H0·b then, so that direction is projected out (variable projection, Golub & Pereyra 1973). In turn,
    force first and coefficients then, a response that outweighs all others would keep what is wrong with it.
    """
    m = b.size
    sizes = [w.run.rows.size * WIDTH * len(w.run.forces_at) for w in weighted]
    offset = m * WIDTH + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    gram, right, std = np.zeros((offset[-1], offset[-1])), np.zeros(offset[-1]), np.zeros(offset[-1])
    std[: m * WIDTH] = np.repeat(doubt.place(b), WIDTH)
    std[WIDTH - 1 : m * WIDTH : WIDTH] = 1e-9 * doubt.scale
    std[np.flatnonzero(b) * WIDTH + WIDTH - 1] = TIMING_PRIOR * doubt.scale
    for i, (w, (along, force, amplitudes)) in enumerate(zip(weighted, found, strict=True)):
        run = w.run
        own = offset[i] + np.arange(sizes[i]).reshape(run.rows.size, -1)
        index = np.concatenate([run.rows[:, None] * WIDTH + np.arange(WIDTH), own], axis=1)
        base = along.h - last.accelerance(run)
        error = (w.raw + base * force - run.fallen(amplitudes)) * w.root
        columns = np.concatenate([-kernels(run.hz, last.top_hz) * force, force_columns(run, last.top_hz)])
        pairs = np.real(columns[:, None] * columns[None].conj())
        inner = np.tensordot(w.root**2, pairs, axes=([1], [2]))
        for rows, block in zip(index, inner, strict=True):
            gram[np.ix_(rows, rows)] += block
        right[index] += np.real((error * w.root) @ columns.conj().T)
        if free[i]:
            u = along.h * w.root / along.gain
            hidden = apart(((u.conj() * w.root)[:, None] * columns[None]).reshape(-1, run.hz.size))
            flat = index.ravel()
            gram[np.ix_(flat, flat)] -= hidden @ hidden.T
            right[flat] -= hidden @ apart(np.sum(u.conj() * error, axis=0))
        std[own] = np.repeat(doubt.pairs[np.ix_(run.rows, np.array(run.forces_at))], WIDTH, axis=1)
        timing = own[:, WIDTH - 1 :: WIDTH]
        std[timing] = 1e-9 * doubt.scale
        for k, row in enumerate(run.forces_at):
            std[timing[run.rows == row, k]] = TIMING_PRIOR * doubt.scale
    values: Any = std * np.linalg.solve(gram * np.outer(std, std) + np.eye(offset[-1]), right * std)
    forces = tuple(values[offset[i] : offset[i + 1]].reshape(w.run.rows.size, -1) for i, w in enumerate(weighted))
    return OutOfBand(last.top_hz, values[: m * WIDTH].reshape(m, WIDTH), forces)
