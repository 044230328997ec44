"""Normal equations of the maximum-likelihood fit: residuals under the full noise covariance of each line, Gram matrices, elimination.

The Gram matrix of a run takes several times the work of its gradient. It changes little near the end of a fit, so
:class:`Information` is kept apart from the gradient and serves for more than one step.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.blas import dsyrk

from operando.ema.polish_model import (
    Complex,
    Parameters,
    Real,
    jacobian_functions,
    n_local,
    n_nuisance,
    parameter_map,
    predict,
    run_model,
    transfer,
)
from operando.ema.spectra import RunSpectra
from operando.errors import IdentificationError
from operando.synthesis import combined, power_of, real_inner

Lines = slice | NDArray[np.int_]

_BAND_GRAMS = 12

_COMMON_VALUES = 1 << 18
"""Complex values of V at a time: four megabytes, large enough for a product and still in the cache."""


@dataclass(frozen=True)
class Residual:
    """What the model leaves of one run, weighted by the full noise covariance of each line.

    ``error`` and ``whitened`` are e and C⁻¹e (m, L); ``common`` (k, m, L) are rows w_k of C⁻¹ = D⁻¹ − Σ_k w_kᴴ w_k, None where the forces
    hold no noise; ``variance`` (m, L) is that of each response line, the noise of the forces included.
    """

    error: Complex
    whitened: Complex
    clean_force: Complex
    common: Complex | None
    variance: Real
    cost: float


@dataclass(frozen=True)
class _Own:
    """How the unknowns of one run alone follow from the gradient and the step of the global parameters.

    ``factor`` is the Cholesky factor of their normal matrix, scaled to a unit diagonal; ``slope`` (q, p) their scaled change for one unit
    of each global parameter, with the sense reversed.
    """

    factor: tuple[Real, bool]
    slope: Real
    scale: Real


@dataclass(frozen=True)
class Information:
    """Normal matrix of the global parameters without prior, taken ``at`` some, everything of single runs eliminated; the way back to it.

    ``local`` has for each run the normal matrix of the local coefficients given the modes, transients eliminated: (m·b, m·b) or (m, b, b).
    """

    at: Parameters
    normal: Real
    own: tuple[_Own, ...]
    local: tuple[Real, ...]


LEAST_RESIDUE = 0.25
"""Least share of its drive residues that a step leaves to a mode: the scale halves. It limits how fast it falls, not where it ends."""

LEAST_CHANGE = 0.5 * (LEAST_RESIDUE - 1)
"""The relative change of the scale, to first order, that leaves so much."""


def scales(theta: Parameters, driven: Sequence[int]) -> Real:
    """Relative change of each mode's scale at the driven DOFs by each global parameter, (n, p)."""
    m, n = theta.shapes.shape
    drive = theta.shapes[list(driven)]
    power = np.sum(drive**2, axis=0)
    out = np.zeros((n, n, m))
    out[:, :, list(driven)] = np.eye(n)[:, :, None] * np.divide(drive, power, out=np.zeros_like(drive), where=power > 0).T
    return np.concatenate([np.zeros((n, 2 * n)), out.reshape(n, -1)], axis=1)


@dataclass(frozen=True)
class Equations:
    """What a step follows from: a normal matrix and the gradient of the cost, which may be of another place near by."""

    information: Information
    precision: Real  # (p,): of the prior; infinite for parameters that are held
    right: Real  # (p,): gradient of the global parameters, everything of single runs eliminated
    # base, rest: for each run the change of its own unknowns where the global parameters stay, and their gradient, both scaled
    base: tuple[Real, ...]
    rest: tuple[Real, ...]
    scales: Real  # (n, p): relative change of each mode's scale at the driven DOFs by each global parameter

    @classmethod
    def of(
        cls, information: Information, gradients: Sequence[Real], theta: Parameters, precision: Real, driven: Sequence[int]
    ) -> Equations:
        """Equations with the gradient of each run at ``theta``."""
        p = precision.size
        held = np.isinf(precision)
        right = -np.where(held, 0, precision) * np.concatenate([np.zeros(2 * theta.hz.size), theta.shapes.T.ravel()])
        base, rest = [], []
        for own, gradient in zip(information.own, gradients, strict=True):
            rest.append(gradient[p:] / own.scale)
            base.append(cho_solve(own.factor, rest[-1]) if rest[-1].size else rest[-1])
            right += gradient[:p] - own.slope.T @ rest[-1]
        right[held] = 0
        return cls(information, precision, right, tuple(base), tuple(rest), scales(theta, driven))

    def step(self, damping: float) -> tuple[Real, list[Real], float]:
        """Levenberg step of the global parameters and of those of each run, and the fall of the cost it foresees.

        Noise can ask for negative drive residues, which no mode has. Such modes keep the share :data:`LEAST_RESIDUE` of theirs, and all
        other parameters move as is best with that. The unknowns of each run follow the global step in full; their own step the damping
        shortens: far off, the noise of the forces takes up errors that are none of it, and a full one leads astray.
        """
        held = np.isinf(self.precision)
        normal = self.information.normal + np.diag(np.where(held, 0, self.precision))
        normal[held], normal[:, held] = 0, 0
        normal[held, held] = 1
        d = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        d[d < 1e-12 * d.max()] = d.max()  # a parameter without information stays where it is
        scaled = normal / np.outer(d, d)
        scaled[np.diag_indices_from(scaled)] += damping
        factor = _safe_factor(scaled)
        step = cho_solve(factor, self.right / d) / d
        gain = float(step @ self.right)
        low = np.flatnonzero(self.scales @ step < LEAST_CHANGE)
        if low.size:
            rows = self.scales[low]
            pull = cho_solve(factor, (rows / d).T) / d[:, None]
            force = np.linalg.solve(rows @ pull, LEAST_CHANGE - rows @ step)
            step = step + pull @ force
            gain = float(step @ self.right - LEAST_CHANGE * force.sum())
        nuisance = []
        short = 1 / (1 + damping)
        for own, base, rest in zip(self.information.own, self.base, self.rest, strict=True):
            nuisance.append((short * base - own.slope @ step) / own.scale)
            gain += short * (2 - short) * float(base @ rest)
        return step, nuisance, gain


def residual(run: RunSpectra, theta: Parameters, index: int) -> Residual:
    """Residuals of one run, weighted by the full noise covariance of each line."""
    model = run_model(run, theta, index, run.forces)
    error = run.responses - predict(run, theta, index, model)
    weighted = error / run.response_variance
    if not np.any(run.force_variance > 0):
        return Residual(error, weighted, run.forces, None, run.response_variance, real_sum(error, weighted))
    h = transfer(run, theta, index, model)  # (k, m, L)
    variance = run.response_variance + np.einsum("kml,kl->ml", power_of(h), run.force_variance)
    root = np.sqrt(run.force_variance)[:, None, :]
    scaled = h.conj() * root / run.response_variance  # σ_f hᴴ D⁻¹
    k = h.shape[0]
    if k == 1:
        inner = np.sum(power_of(h[0]) / run.response_variance, axis=0) * run.force_variance[0]
        rows = scaled / np.sqrt(1 + inner)
    else:
        inner = np.einsum("kml,jml->ljk", h * root, scaled, optimize=True)
        factor = np.linalg.cholesky(np.eye(k) + inner)
        rows = np.linalg.solve(factor, scaled.transpose(2, 0, 1)).transpose(1, 2, 0)
    projection = np.einsum("kml,ml->kl", rows, error)
    whitened = weighted - np.einsum("kml,kl->ml", rows.conj(), projection)
    clean = run.forces + run.force_variance * np.einsum("kml,ml->kl", h.conj(), whitened)
    return Residual(error, whitened, clean, rows, variance, real_sum(error, whitened))


def real_sum(a: Complex, b: Complex) -> float:
    """Re Σ ā b."""
    return float(np.sum(a.real * b.real) + np.sum(a.imag * b.imag))


def _band_grams(stack: Complex, variance: Real) -> NDArray[np.float64]:
    """Real Gram matrices Re(B W_j Bᴴ) for each response, (m, K, K); cheap where the variance is piecewise constant over lines."""
    m, n_lines = variance.shape
    change = np.flatnonzero(np.any(np.diff(variance, axis=1) != 0, axis=0)) + 1
    pieces = np.concatenate([[0], change, [n_lines]])
    if pieces.size - 1 <= _BAND_GRAMS * 4:
        out = np.zeros((m, stack.shape[0], stack.shape[0]))
        for start, stop in itertools.pairwise(pieces):
            part = np.concatenate([stack[:, start:stop].real, stack[:, start:stop].imag], axis=1)
            out += (part @ part.T)[None] / variance[:, start, None, None]
        return out
    out = np.empty((m, stack.shape[0], stack.shape[0]))
    real = np.ascontiguousarray(np.concatenate([stack.real, stack.imag], axis=1))
    for j in range(m):
        weighted = real * np.tile(1 / np.sqrt(variance[j]), 2)
        half = dsyrk(1.0, weighted.T, trans=1)  # half the work of a product
        out[j] = half + np.triu(half, 1).T
    return out


def _grams(run: RunSpectra, theta: Parameters, stack: Complex, forces: Complex, lines: Lines) -> NDArray[np.float64]:
    """Gram matrices of the Jacobian's functions; an FRF column has Q = φ_k·G·F there beside G·F, and each function is used once."""
    n = theta.hz.size
    if run.step_s is not None or run.forces.shape[0] != 1:
        return _band_grams(stack, run.response_variance[:, lines])
    drive = theta.shapes[run.force_rows[0]]
    base = np.concatenate([(part * forces)[:, lines] for part in theta.functions(run).kernels])
    of = np.concatenate([np.arange(3 * n), np.arange(n), np.arange(3 * n, stack.shape[0] - n)])
    factor = np.concatenate([drive, drive, drive, np.ones(stack.shape[0] - 3 * n)])
    grams = _band_grams(np.concatenate([base, stack[4 * n :]]), run.response_variance[:, lines])
    return np.asarray(grams[:, of[:, None], of[None, :]] * np.outer(factor, factor))


def _common_rows(run: RunSpectra, theta: Parameters, stack: Complex, rows: Complex, out: Complex) -> None:
    """Fill V (n_all, k, L), zero before: the Jacobian of some lines seen through the force-noise direction of each."""
    n, m_dofs = theta.hz.size, theta.shapes.shape[0]
    phi = theta.shapes[run.response_rows]
    by_dof = out[2 * n : 2 * n + m_dofs * n].reshape(n, m_dofs, *out.shape[1:])
    b = n_local(run, theta.outside_hz.size)
    nuisance = out[2 * n + m_dofs * n :]
    local = nuisance[nuisance.shape[0] - b * run.response_rows.size :].reshape(-1, b, *out.shape[1:])
    for i, w in enumerate(rows):  # w (m, L)
        through = combined(phi.T, w)  # (n, L)
        np.multiply(through, stack[n : 2 * n], out=out[:n, i])
        np.multiply(through, stack[2 * n : 3 * n], out=out[n : 2 * n, i])
        for j, row in enumerate(run.response_rows):
            by_dof[:, row, i] += w[j] * stack[:n]
            np.multiply(stack[stack.shape[0] - b :], w[j], out=local[j, :, i])
        position = 3 * n
        for row in run.force_rows:
            by_dof[:, row, i] += through * stack[position : position + n]
            position += n
        if run.step_s is not None:
            np.multiply(through, stack[position : position + n], out=nuisance[:n, i])
            np.multiply(through, stack[position + n : position + 2 * n], out=nuisance[n : 2 * n, i])


def _common_gram(run: RunSpectra, theta: Parameters, stack: Complex, rows: Complex, n_all: int) -> Real:
    """−Re(V Vᴴ): what the noise of the forces, which all responses share, takes from the normal matrix; some lines at a time."""
    k, n_lines = rows.shape[0], rows.shape[2]
    step = max(64, _COMMON_VALUES // (n_all * k))
    half = np.zeros((n_all, n_all), order="F")
    for first in range(0, n_lines, step):
        part = slice(first, first + step)
        v = np.zeros((n_all, k, min(step, n_lines - first)), complex)
        _common_rows(run, theta, stack[:, part], rows[:, :, part], v)
        half = dsyrk(-1.0, v.reshape(n_all, -1).view(float).T, beta=1.0, c=half, trans=1, overwrite_c=1)  # half the work of a product
    return np.asarray(half + np.triu(half, 1).T)


def _run_gram(run: RunSpectra, theta: Parameters, stack: Complex, state: Residual, lines: Lines) -> Real:
    """Re(JᴴC⁻¹J) of some lines of one run over [global parameters, unknowns of the run]."""
    m_dofs, n = theta.shapes.shape
    n_global = 2 * n + m_dofs * n
    n_all = n_global + n_nuisance(run, n, theta.outside_hz.size)
    part = stack[:, lines]
    normal = np.zeros((n_all, n_all)) if state.common is None else _common_gram(run, theta, part, state.common[:, :, lines], n_all)
    positions, factors = parameter_map(run, theta, n_global)
    for at, factor, gram in zip(positions, factors, _grams(run, theta, part, state.clean_force, lines), strict=True):
        _add_block(normal, at, gram * np.outer(factor, factor))
    return normal


def _run_gradient(run: RunSpectra, theta: Parameters, stack: Complex, state: Residual) -> Real:
    """Re(JᴴC⁻¹e) of one run over [global parameters, unknowns of the run]."""
    m_dofs, n = theta.shapes.shape
    n_global = 2 * n + m_dofs * n
    positions, factors = parameter_map(run, theta, n_global)
    gradient = np.zeros(n_global + n_nuisance(run, n, theta.outside_hz.size))
    np.add.at(gradient, positions, real_inner(state.whitened, stack) * factors)
    return gradient


def normal_equations(run: RunSpectra, theta: Parameters, index: int, state: Residual | None = None) -> tuple[Real, Real]:
    """Re(JᴴC⁻¹J), Re(JᴴC⁻¹e) of one run over [global parameters, nuisance of the run]."""
    state = residual(run, theta, index) if state is None else state
    stack = jacobian_functions(run, theta, index, state.clean_force)
    return _run_gram(run, theta, stack, state, slice(None)), _run_gradient(run, theta, stack, state)


def _add_block(normal: Real, at: NDArray[np.int_], block: Real) -> None:
    """Add a block to the rows and columns ``at``; those that stand there twice (the response at the driven DOF) are added up first."""
    once, place = np.unique(at, return_inverse=True)
    if once.size < at.size:
        joined = np.zeros((once.size, at.size))
        joined[place, np.arange(at.size)] = 1
        at, block = once, joined @ block @ joined.T
    normal[at[:, None], at[None, :]] += block


def gradients(runs: Sequence[RunSpectra], theta: Parameters, states: Sequence[Residual]) -> list[Real]:
    """Re(JᴴC⁻¹e) of each run over [global parameters, unknowns of the run]."""
    return [
        _run_gradient(run, theta, jacobian_functions(run, theta, i, state.clean_force), state)
        for i, (run, state) in enumerate(zip(runs, states, strict=True))
    ]


def linearised(
    runs: Sequence[RunSpectra], theta: Parameters, states: Sequence[Residual], apart: Sequence[NDArray[np.bool_]] | None = None
) -> tuple[Information, Information | None, list[Real]]:
    """Normal matrix over all runs, that without the lines ``apart`` (None: there is no second), and the gradients."""
    whole, others, slopes = _Sum(theta), None if apart is None else _Sum(theta), []
    for i, (run, state) in enumerate(zip(runs, states, strict=True)):
        stack = jacobian_functions(run, theta, i, state.clean_force)
        slopes.append(_run_gradient(run, theta, stack, state))
        if apart is None or others is None:
            whole.add(run, _run_gram(run, theta, stack, state, slice(None)))
        else:
            kept, rest = (_run_gram(run, theta, stack, state, np.flatnonzero(lines)) for lines in (~apart[i], apart[i]))
            others.add(run, kept)
            rest += kept
            whole.add(run, rest)
    return whole.information(), None if others is None else others.information(), slopes


class _Sum:
    """Normal matrices of runs, added up once the unknowns of each are eliminated."""

    def __init__(self, theta: Parameters) -> None:
        self.theta, self.p = theta, theta.hz.size * (2 + theta.shapes.shape[0])
        self.normal = np.zeros((self.p, self.p))
        self.own: list[_Own] = []
        self.local: list[Real] = []

    def add(self, run: RunSpectra, normal: Real) -> None:
        p = self.p
        own, cross = _eliminated(normal, p)
        self.normal += normal[:p, :p]
        self.normal -= cross.T @ own.slope
        self.own.append(own)
        self.local.append(_local_normal(run, self.theta.hz.size, normal, p))

    def information(self) -> Information:
        """The sum, without the functions of frequency that the parameters keep."""
        return Information(replace(self.theta), self.normal, tuple(self.own), tuple(self.local))


def _local_normal(run: RunSpectra, n: int, normal: Real, n_global: int) -> Real:
    """Normal matrix of the local coefficients with the transients eliminated."""
    first = n_global + (0 if run.step_s is None else 2 * n)
    block = normal[first:, first:]
    if first == n_global:
        m = run.response_rows.size
        blocks = block.reshape(m, block.shape[0] // m, m, block.shape[0] // m)
        return block.copy() if np.any(run.force_variance > 0) else np.array(blocks[np.arange(m), :, np.arange(m)])
    cross = normal[n_global:first, first:]
    inner = normal[n_global:first, n_global:first]
    d = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    factor = _safe_factor(inner / np.outer(d, d))
    return np.asarray(block - (cross / d[:, None]).T @ cho_solve(factor, cross / d[:, None]))


def _safe_factor(matrix: Real) -> tuple[Real, bool]:
    """Cholesky factor of a unit-diagonal matrix; a ridge no larger than needed makes it positive."""
    ridge = 1e-9
    while True:
        trial = matrix.copy()
        trial[np.diag_indices_from(trial)] += ridge
        try:
            return cho_factor(trial)
        except np.linalg.LinAlgError:
            ridge *= 10
            if ridge > 1:
                raise IdentificationError("the normal equations of the fit are singular", hint="fewer modes, or more references") from None


def _eliminated(normal: Real, n_global: int) -> tuple[_Own, Real]:
    """How the unknowns of one run alone follow, and their scaled normal matrix with the global parameters."""
    d = np.sqrt(np.maximum(np.diag(normal)[n_global:], 1e-300))
    cross = normal[n_global:, :n_global] / d[:, None]
    if not d.size:
        return _Own((np.zeros((0, 0)), False), cross, d), cross
    factor = _safe_factor(normal[n_global:, n_global:] / np.outer(d, d))
    return _Own(factor, cho_solve(factor, cross), d), cross
