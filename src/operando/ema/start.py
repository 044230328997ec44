"""Starting values of the maximum-likelihood fit: linear residues on the run spectra, made rank one with unit modal mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from operando.ema.polish_model import OUTSIDE_DAMPING, Complex, Real, decays, end_basis
from operando.ema.spectra import RunSpectra
from operando.synthesis import modal_kernel, power_of, real_inner

OUTSIDE_FACTORS = (1.04, 1.1, 1.25, 1.6, 2.5, 5.0)
"""Frequencies of the fixed kernels for modes above the band, in units of the highest line."""

DAMPED_FACTORS, MORE_DAMPING = (1.04, 1.1), 0.03
"""Further kernels there of more damping: sums of two dampings have any between. A mode 4 to 20 % above the lines, damped by 0.3 to 2 %, is
then described to 0.3 % of what it adds to them (0.5 to 3 % without, damped by 0.7 %; least squares over the lines)."""

LOWER_FACTORS, DAMPED_LOWER, LOWER_DAMPING = (0.02, 0.6), (0.6,), 0.1
"""The same below the band, in units of the lowest line: a mass line, a suspension, and one of more damping. Elastic cords have 1 to 10 %:
of a structure hung up at a fifth of the lowest line with 3 % the mass line lags by 1.2 % there. Suspensions up to four tenths of it are
described to 0.5 % of what they add (without the third up to 2.7 %; least squares over a decade of lines)."""

N_LOWER = len(LOWER_FACTORS) + len(DAMPED_LOWER)

LEAST_DRIVE = 1e-4
"""Least drive residue, as a share of the largest residue, that gives a mode's scale to start with; the fit tells it."""

GRID = 64
"""Frequencies asked at a time: their kernels on all lines are a few megabytes."""


def outside_kernels(runs: Sequence[RunSpectra], hz: Real, lower: bool) -> tuple[Real, Real]:
    """Poles of the fixed kernels that stand for what lies outside the lines of the runs and above the modes ``hz``."""
    top = max([float(run.frequencies_hz[-1]) for run in runs] + [float(h) for h in hz])
    bottom = min(float(run.frequencies_hz[0]) for run in runs)
    parts = [top * np.array(OUTSIDE_FACTORS), top * np.array(DAMPED_FACTORS)]
    parts += [bottom * np.array(factors if lower else ()) for factors in (LOWER_FACTORS, DAMPED_LOWER)]
    damping = (OUTSIDE_DAMPING, MORE_DAMPING, OUTSIDE_DAMPING, LOWER_DAMPING)
    return np.concatenate(parts), np.repeat(damping, [part.size for part in parts])


def linear_residues(runs: Sequence[RunSpectra], hz: Real, zeta: Real, outside: tuple[Real, Real]) -> list[Real]:
    """Real residues R_jr = φ_jr φ_kr (k, m, n) of each run by weighted least squares, transients and local terms beside them."""
    out = []
    n = hz.size
    for run in runs:
        f = run.frequencies_hz
        all_hz, all_zeta = np.concatenate([hz, outside[0]]), np.concatenate([zeta, outside[1]])
        g = modal_kernel(f, all_hz, all_zeta, "accelerance", run.window_rate)
        parts = [g[:n] * force for force in run.forces] + [g[n:] * force for force in run.forces]
        if run.step_s is not None:
            t1, t2 = decays(f, hz, zeta, run.step_s)[:2]
            parts += [t1, t2, end_basis(f, run.top_hz, run.step_s)]
        stack = np.concatenate(parts)
        k, m = run.forces.shape[0], run.response_rows.size
        # Force noise is proportional to the response it makes; as part of the variance it keeps peaks from ruling alone.
        gain = np.abs(run.responses) ** 2 * np.sum(run.force_variance / np.maximum(np.abs(run.forces) ** 2, 1e-300), axis=0)
        residues = np.empty((k, m, n))
        for j in range(m):
            weight = np.repeat(1 / np.sqrt(run.response_variance[j] + gain[j]), 2)  # of real and imaginary parts side by side
            target = np.ascontiguousarray(run.responses[j]).view(float) * weight
            residues[:, j] = _ridge(stack.view(float) * weight, target)[: k * n].reshape(k, n)
        out.append(residues)
    return out


def inverted_forces(runs: Sequence[RunSpectra], residues: Sequence[Real]) -> list[tuple[int, int]]:
    """Runs and forces whose drive-point residues are mostly negative: modal masses would be, too.

    That is where Σ R|R| over the modes is below −0.5 Σ R². The sense of the force or that of the accelerometer at its DOF is wrong; one
    reference alone cannot say which, and turning the force makes all columns consistent in both cases.
    """
    out = []
    for i, (run, residue) in enumerate(zip(runs, residues, strict=True)):
        for k, row in enumerate(run.force_rows):
            at = np.flatnonzero(run.response_rows == row)
            if at.size:
                values = residue[k, at[0]]
                if np.sum(values * np.abs(values)) < -0.5 * np.sum(values**2):
                    out.append((i, k))
    return out


def _ridge(design: Real, target: Real) -> Real:
    gram = design @ design.T
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0] = 1
    normal = gram / np.outer(scale, scale)
    normal[np.diag_indices_from(normal)] += 1e-7
    return np.asarray(cho_solve(cho_factor(normal), design @ target / scale) / scale)


def rank_one(runs: Sequence[RunSpectra], residues: Sequence[Real], n_dofs: int) -> tuple[Real, NDArray[np.bool_]]:
    """Shapes (M, n) of unit modal mass from the residues of all references; whether a drive point of the right sign scales each."""
    n = residues[0].shape[2]
    shapes = np.zeros((n_dofs, n))
    seen = np.zeros(n, bool)
    columns: list[tuple[int, NDArray[np.int_], Real]] = []
    for run, residue in zip(runs, residues, strict=True):
        columns += [(int(row), run.response_rows, residue[i]) for i, row in enumerate(run.force_rows)]
    for r in range(n):
        shapes[:, r], seen[r] = _rank_one_mode([(row, rows, residue[:, r]) for row, rows, residue in columns], n_dofs)
    return shapes, seen


def _rank_one_mode(columns: list[tuple[int, NDArray[np.int_], Real]], n_dofs: int, rounds: int = 25) -> tuple[Real, bool]:
    """One shape φ with R_jk ≈ φ_j φ_k, by alternating least squares from the best drive point."""
    best, scale = None, 0.0
    for row, rows, value in columns:
        at = np.flatnonzero(rows == row)
        if at.size and value[at[0]] > scale:
            best, scale = (row, rows, value), float(value[at[0]])
    size = max(float(np.max(np.abs(np.concatenate([v for _, _, v in columns])))), 1e-30)
    seen = best is not None and scale > LEAST_DRIVE * size
    phi = np.zeros(n_dofs)
    if not seen:
        row, rows, value = max(columns, key=lambda c: float(np.sum(c[2] ** 2)))
        at = np.flatnonzero(rows == row)
        # A drive residue of the wrong sign is noise of that magnitude; the products with all other DOFs are right from the start.
        reference = np.sqrt(max(abs(float(value[at[0]])), LEAST_DRIVE * size) if at.size else size)
        phi[rows] = value / reference
        phi[row] = reference
        return phi, False
    assert best is not None
    row, rows, value = best
    phi[rows] = value / np.sqrt(scale)
    known = {c[0] for c in columns}
    # of each reference DOF: the columns it drives, with the other rows there, and its place as a response of the other columns
    driven = {k: [(rows[rows != k], value[rows != k]) for row, rows, value in columns if row == k] for k in known}
    seen_in = {k: [(row, value[rows == k][0]) for row, rows, value in columns if row != k and np.any(rows == k)] for k in known}
    own = {k: [float(value[rows == k][0]) for row, rows, value in columns if row == k and np.any(rows == k)] for k in known}
    other = ~np.isin(np.arange(n_dofs), list(known))
    for _ in range(rounds):
        for k in known:
            top = bottom = 0.0
            for rows, value in driven[k]:
                top += float(phi[rows] @ value)
                bottom += float(phi[rows] @ phi[rows])
            for row, residue in seen_in[k]:
                top += float(phi[row] * residue)
                bottom += float(phi[row] ** 2)
            if own[k] and max(own[k]) > 0:
                guess = np.sqrt(max(own[k])) * (np.sign(phi[k]) or np.sign(top) or 1.0)
                weight = phi[k] ** 2 + 1e-30
                top += weight * guess
                bottom += weight
            if bottom > 0:
                phi[k] = top / bottom
        top_all, bottom_all = np.zeros(n_dofs), np.zeros(n_dofs)
        for row, rows, value in columns:
            np.add.at(top_all, rows, phi[row] * value)
            np.add.at(bottom_all, rows, phi[row] ** 2)
        free = (bottom_all > 0) & other
        phi[free] = top_all[free] / bottom_all[free]
    return phi, True


def mode_gain(runs: Sequence[RunSpectra], errors: Sequence[Complex], hz: Real, zeta: float) -> Real:
    """Fall of the cost if one more mode of damping ``zeta`` stood at each of ``hz``, from the present residuals.

    Free real residues in each response and run are allowed, so the figure is an upper bound with one unknown a response and force.
    """
    total = np.zeros(hz.size)
    columns = [
        (i, error / run.response_variance * force.conj(), power_of(force) / run.response_variance)
        for i, (run, error) in enumerate(zip(runs, errors, strict=True))
        for force in run.forces
    ]
    for start in range(0, hz.size, GRID):
        part = slice(start, start + GRID)
        of, g, power = -1, np.zeros((0, 0), complex), np.zeros((0, 0))
        for i, pull, weight in columns:
            if of < 0 or not _same_lines(runs[of], runs[i]):  # runs mostly share them
                g = modal_kernel(runs[i].frequencies_hz, hz[part], np.full(hz[part].size, zeta), "accelerance", runs[i].window_rate)
                power = power_of(g)
            of = i
            total[part] += np.sum(real_inner(pull, g) ** 2 / np.maximum(weight @ power.T, 1e-300), axis=0)
    return total


def _same_lines(a: RunSpectra, b: RunSpectra) -> bool:
    return a.window_rate == b.window_rate and np.array_equal(a.frequencies_hz, b.frequencies_hz)
