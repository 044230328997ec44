"""Maximum-likelihood refinement of a real modal model on the spectra of whole records.

The errors-in-variables likelihood for known noise variances: with e = X − H(θ)F − T(θ), response noise D and force noise σ_f,
the covariance of a line is C = D + H σ_f² Hᴴ; eᴴC⁻¹e is minimised by Levenberg–Marquardt with an analytic Jacobian
(Pintelon & Schoukens, System Identification, 2nd ed., 2012, ch. 9, errors-in-variables maximum likelihood; here with
modal parameters). The Jacobian uses the force as cleaned by the model, which makes the step unbiased by force noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
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

_BAND_GRAMS = 12

_COMMON_VALUES = 1 << 18
"""Complex values of V at a time: four megabytes, large enough for a product and still in the cache."""

MAX_STEP_WIDTHS = 2.0
"""Largest move of a pole in one step, in units of its half bandwidth ζ·f."""


@dataclass(frozen=True)
class Polished:
    """Result of :func:`polish`.

    Parameters
    ----------
    parameters : Parameters
    covariance : (p, p) array
        Of [ln f, ln ζ, shapes mode by mode].
    local_estimates : tuple of (coefficients (m·b,), information (m·b, m·b) or (m, b, b))
        For each run the local coefficients response by response and their information given the modes, transients eliminated; response
        by response where nothing joins them.
    cost : float
        Σ eᴴC⁻¹e over runs and lines.
    n_data : int
        Complex data.
    iterations : int
    converged : bool
    """

    parameters: Parameters
    covariance: Real
    local_estimates: tuple[tuple[Real, Real], ...]
    cost: float
    n_data: int
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Residual:
    """What the model leaves of one run, weighted by the full noise covariance of each line.

    Parameters
    ----------
    error, whitened : (m, L) complex arrays
        e and C⁻¹e.
    clean_force : (k, L) complex array
    common : (k, m, L) complex array or None
        Rows w_k: C⁻¹ = D⁻¹ − Σ_k w_kᴴ w_k; None where the forces hold no noise.
    variance : (m, L) array
        Of each response line, the noise of the forces included.
    cost : float
    """

    error: Complex
    whitened: Complex
    clean_force: Complex
    common: Complex | None
    variance: Real
    cost: float


@dataclass(frozen=True)
class _Equations:
    """Normal equations of the global parameters, everything of single runs eliminated, and the way back to it.

    Parameters
    ----------
    normal, right : (p, p), (p,) arrays
    back : tuple of (base, slope, scale, gradient)
        For each run: its own unknowns are (base − slope·step)/scale.
    local : tuple of (m·b, m·b) or (m, b, b) arrays
        Normal matrix of the local coefficients of each run given the modes, transients eliminated.
    """

    normal: Real
    right: Real
    back: tuple[tuple[Real, Real, Real, Real], ...]
    local: tuple[Real, ...]


def start_parameters(runs: Sequence[RunSpectra], hz: Real, zeta: Real, shapes: Real, outside_hz: Real) -> Parameters:
    """Parameters with empty transients and local terms."""
    n = len(hz)
    transients = tuple(np.zeros((2, 0 if run.step_s is None else n)) for run in runs)
    local = tuple(np.zeros((run.response_rows.size, n_local(run, len(outside_hz)))) for run in runs)
    return Parameters(
        np.asarray(hz, float), np.asarray(zeta, float), np.asarray(shapes, float), np.asarray(outside_hz, float), transients, local
    )


def signed(run: RunSpectra) -> RunSpectra:
    """The run with all senses as in the model's DOF list."""
    return replace(
        run,
        responses=run.responses * run.response_signs[:, None],
        forces=run.forces * run.force_signs[:, None],
        response_signs=np.ones_like(run.response_signs),
        force_signs=np.ones_like(run.force_signs),
    )


def residual(run: RunSpectra, theta: Parameters, index: int) -> Residual:
    """Residuals of one run, weighted by the full noise covariance of each line."""
    model = run_model(run, theta, index, run.forces)
    error = run.responses - predict(run, theta, index, model)
    weighted = error / run.response_variance
    if not np.any(run.force_variance > 0):
        return Residual(error, weighted, run.forces, None, run.response_variance, _inner(error, weighted))
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
    return Residual(error, whitened, clean, rows, variance, _inner(error, whitened))


def _inner(a: Complex, b: Complex) -> float:
    """Re Σ ā b."""
    return float(np.sum(a.real * b.real) + np.sum(a.imag * b.imag))


def _evaluated(runs: Sequence[RunSpectra], theta: Parameters, shape_std: Real | None) -> tuple[float, list[Residual]]:
    """Σ eᴴC⁻¹e plus half the quadratic form of the shapes' prior, and the residuals of the runs."""
    states = [residual(run, theta, i) for i, run in enumerate(runs)]
    prior = 0.0 if shape_std is None else 0.5 * float(np.sum((theta.shapes / shape_std) ** 2))
    return sum(state.cost for state in states) + prior, states


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


def _grams(run: RunSpectra, theta: Parameters, stack: Complex) -> NDArray[np.float64]:
    """Gram matrices of the Jacobian's functions; an FRF column has Q = φ_k·G·F there beside G·F, and each function is used once."""
    n = theta.hz.size
    if run.step_s is not None or run.forces.shape[0] != 1:
        return _band_grams(stack, run.response_variance)
    drive = theta.shapes[run.force_rows[0]]
    base = np.concatenate([part * run.forces for part in theta.functions(run).kernels])
    of = np.concatenate([np.arange(3 * n), np.arange(n), np.arange(3 * n, stack.shape[0] - n)])
    factor = np.concatenate([drive, drive, drive, np.ones(stack.shape[0] - 3 * n)])
    grams = _band_grams(np.concatenate([base, stack[4 * n :]]), run.response_variance)
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


def normal_equations(run: RunSpectra, theta: Parameters, index: int, state: Residual | None = None) -> tuple[Real, Real]:
    """Re(JᴴC⁻¹J), Re(JᴴC⁻¹e) of one run over [global parameters, nuisance of the run]."""
    state = residual(run, theta, index) if state is None else state
    stack = jacobian_functions(run, theta, index, state.clean_force)
    m_dofs, n = theta.shapes.shape
    n_global = 2 * n + m_dofs * n
    n_all = n_global + n_nuisance(run, n, theta.outside_hz.size)
    positions, factors = parameter_map(run, theta, n_global)
    if state.common is None:
        normal = np.zeros((n_all, n_all))
    else:
        normal = _common_gram(run, theta, stack, state.common, n_all)
    grams = _grams(run, theta, stack)
    for at, factor, gram in zip(positions, factors, grams, strict=True):
        _add_block(normal, at, gram * np.outer(factor, factor))
    gradient = np.zeros(n_all)
    np.add.at(gradient, positions, real_inner(state.whitened, stack) * factors)
    return normal, gradient


def _add_block(normal: Real, at: NDArray[np.int_], block: Real) -> None:
    """Add a block to the rows and columns ``at``; those that stand there twice (the response at the driven DOF) are added up first."""
    once, place = np.unique(at, return_inverse=True)
    if once.size < at.size:
        joined = np.zeros((once.size, at.size))
        joined[place, np.arange(at.size)] = 1
        at, block = once, joined @ block @ joined.T
    normal[at[:, None], at[None, :]] += block


def _assembled(runs: Sequence[RunSpectra], theta: Parameters, states: Sequence[Residual], precision: Real) -> _Equations:
    """Normal equations over all runs; those of a run are dropped once its own unknowns are eliminated."""
    n = theta.hz.size
    n_global = precision.size
    total = np.diag(precision)
    right = -precision * np.concatenate([np.zeros(2 * n), theta.shapes.T.ravel()])
    back, local = [], []
    for i, (run, state) in enumerate(zip(runs, states, strict=True)):
        normal, gradient = normal_equations(run, theta, i, state)
        local.append(_local_normal(run, n, normal, n_global))
        base, slope, scale = _eliminated(normal, gradient, n_global)
        cross, rest = normal[n_global:, :n_global] / scale[:, None], gradient[n_global:] / scale
        total += normal[:n_global, :n_global]
        total -= cross.T @ slope
        right += gradient[:n_global] - cross.T @ base
        back.append((base, slope, scale, rest))
    return _Equations(total, right, tuple(back), tuple(local))


def polish(
    runs: Sequence[RunSpectra],
    start: Parameters,
    *,
    shape_std: Real | None = None,
    hold_poles: bool = False,
    max_iterations: int = 30,
    tolerance: float = 0.05,
    progress: Callable[[str], None] | None = None,
    want_covariance: bool = True,
    needed_cost: float = np.inf,
) -> Polished:
    """Minimise the errors-in-variables cost over poles, shapes, transients and local terms.

    Parameters
    ----------
    runs : sequence of RunSpectra
        Spectra with noise variances; senses as in the model (:func:`signed`).
    start : Parameters
        Starting values.
    shape_std : (M, n) array, optional
        Standard deviation of a Gaussian prior of the shapes; wide, it only holds what the data do not see.
    hold_poles : bool
        Keep the poles as they are and fit shapes, transients and local terms only.
    max_iterations : int
    tolerance : float
        Stop when the fall of the cost is below this. The cost has unit variance per datum: 0.05 moves every estimate
        by less than about a third of its standard deviation.
    progress : callable, optional
        Told one line an iteration.
    want_covariance : bool
    needed_cost : float
        The fit is of no use above this cost: it ends where the steps that are left do not reach it at the pace of the last one.

    Raises
    ------
    IdentificationError
        If the normal equations stay singular.
    """
    theta = start
    m_dofs, n = theta.shapes.shape
    n_global = 2 * n + m_dofs * n
    precision = np.zeros(n_global)
    if shape_std is not None:
        precision[2 * n :] = (0.5 / shape_std**2).T.ravel()
    if hold_poles:
        precision[: 2 * n] = 1e30
    damping = 1e-4
    cost, states = _evaluated(runs, theta, shape_std)
    converged = False
    iteration = 0
    equations = _assembled(runs, theta, states, precision)
    for iteration in range(1, max_iterations + 1):
        trial, trial_cost, gain = None, np.inf, 0.0
        for _ in range(14):
            step, nuisance, gain = _step(equations, damping)
            trial = _moved(theta, step, nuisance, runs)
            trial_cost = np.inf
            if trial is not None:
                trial_cost, states = _evaluated(runs, trial, shape_std)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            trial = None
            if gain < tolerance:
                break
            damping = max(damping * 10, 1e-8)
        if trial is None:
            converged = gain < max(tolerance, 1e-7 * cost)
            break
        fall, cost, theta = cost - trial_cost, trial_cost, trial
        damping = max(damping / 30, 1e-12)
        if progress is not None:
            progress(f"maximum-likelihood fit, step {iteration}: cost lower by {100 * fall / max(cost, 1e-300):.2g} %")
        if fall < tolerance:
            converged = True
            break
        if fall * (max_iterations - iteration) < cost - needed_cost:
            break
        equations = _assembled(runs, theta, states, precision)
    covariance = _covariance(equations.normal) if want_covariance else np.zeros((0, 0))
    estimates = tuple((local.ravel(), 2 * normal) for local, normal in zip(theta.local, equations.local, strict=True))
    return Polished(theta, covariance, estimates, cost, sum(run.responses.size for run in runs), iteration, converged)


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


def _eliminated(normal: Real, gradient: Real, n_global: int) -> tuple[Real, Real, Real]:
    """The unknowns of one run alone as base − slope·step, over the scale that is returned with them."""
    d = np.sqrt(np.maximum(np.diag(normal)[n_global:], 1e-300))
    if not d.size:
        return np.zeros(0), np.zeros((0, n_global)), d
    factor = _safe_factor(normal[n_global:, n_global:] / np.outer(d, d))
    solved = cho_solve(factor, np.column_stack([normal[n_global:, :n_global] / d[:, None], gradient[n_global:] / d]))
    return solved[:, -1], solved[:, :-1], d


def _step(equations: _Equations, damping: float) -> tuple[Real, list[Real], float]:
    """Levenberg step of the global parameters and of those of each run, and the fall of the cost it foresees."""
    d = np.sqrt(np.maximum(np.diag(equations.normal), 1e-300))
    d[d < 1e-12 * d.max()] = d.max()  # a parameter without information stays where it is
    scaled = equations.normal / np.outer(d, d)
    scaled[np.diag_indices_from(scaled)] += damping
    factor = _safe_factor(scaled)
    step = cho_solve(factor, equations.right / d) / d
    gain = float(step @ equations.right)
    nuisance = []
    for base, slope, scale, rest in equations.back:
        nuisance.append((base - slope @ step) / scale)
        gain += float(base @ rest)
    return step, nuisance, gain


def _moved(theta: Parameters, step: Real, nuisance: Sequence[Real], runs: Sequence[RunSpectra]) -> Parameters | None:
    """Parameters after a step, or None where a pole would leave the physical range."""
    m_dofs, n = theta.shapes.shape
    # A pole that leaves its own resonance in one step no longer explains the peak it was started for.
    if np.any(np.abs(step[:n]) > MAX_STEP_WIDTHS * np.maximum(theta.zeta, 1e-3)) or np.any(np.abs(step[n : 2 * n]) > 1.5):
        return None
    hz = theta.hz * np.exp(step[:n])
    zeta = theta.zeta * np.exp(step[n : 2 * n])
    if np.any(zeta > 0.9) or np.any(zeta < 1e-7):
        return None
    shapes = theta.shapes + step[2 * n :].reshape(n, m_dofs).T
    transients, local = [], []
    for i, run in enumerate(runs):
        split = 0 if run.step_s is None else 2 * n
        transients.append(theta.transients[i] + nuisance[i][:split].reshape(2, -1))
        local.append(theta.local[i] + nuisance[i][split:].reshape(run.response_rows.size, -1))
    return replace(theta, hz=hz, zeta=zeta, shapes=shapes, transients=tuple(transients), local=tuple(local))


def _covariance(total: Real) -> Real:
    """Inverse Fisher information of the global parameters; the information of complex data is twice the normal matrix."""
    d = np.sqrt(np.maximum(np.diag(total), 1e-300))
    d[d < 1e-12 * d.max()] = d.max()
    values, vectors = np.linalg.eigh(total / np.outer(d, d))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(0.5 * inverse / np.outer(d, d))


def run_misfit(runs: Sequence[RunSpectra], theta: Parameters, keep: Sequence[NDArray[np.bool_]]) -> tuple[float, Real]:
    """Mean of |e_j|²/(D_j + |H_j|²σ_f²) over the kept lines of each run, and per row of the model's DOFs.

    The kept lines are those the fit did not use; the transients come from the fit.
    """
    total, count = 0.0, 0
    by_row = np.zeros((theta.shapes.shape[0], 2))
    for i, (run, mask) in enumerate(zip(runs, keep, strict=True)):
        if not mask.any():
            continue
        part = run.lines(mask)
        state = residual(part, theta, i)
        ratio = power_of(state.error) / state.variance
        total += float(ratio.sum())
        count += ratio.size
        np.add.at(by_row, part.response_rows, np.stack([ratio.sum(axis=1), np.full(ratio.shape[0], ratio.shape[1])], axis=1))
    with np.errstate(invalid="ignore"):
        return (float(total / count) if count else float("nan")), by_row[:, 0] / by_row[:, 1]
