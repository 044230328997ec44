"""Maximum-likelihood refinement of a real modal model on the spectra of whole records.

The errors-in-variables likelihood for known noise variances: with e = X − H(θ)F − T(θ), response noise D and force noise σ_f,
the covariance of a line is C = D + H σ_f² Hᴴ; eᴴC⁻¹e is minimised by Levenberg–Marquardt with an analytic Jacobian
(Pintelon & Schoukens, System Identification, 2nd ed., 2012, ch. 9, errors-in-variables maximum likelihood; here with
modal parameters). The Jacobian uses the force as cleaned by the model, which makes the step unbiased by force noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.ema.normal import LEAST_RESIDUE, Equations, Information, Residual, gradients, linearised, residual, scales
from operando.ema.polish_model import Complex, Parameters, Real, n_local
from operando.ema.spectra import RunSpectra
from operando.synthesis import combined, modal_kernel, power_of

MAX_STEP_WIDTHS = 2.0
"""Largest move of a pole in one step, in units of its half bandwidth ζ·f."""

REUSED = 0.1
"""A normal matrix serves for the next step too where the fall that this foresees is below this share of the last one. The gradient takes
a fifth of the work of the matrix, so that five steps, each with a tenth of the fall before, stand against one that squares it."""

NEAR = 1e-4
"""Share of the tolerance that steps with a normal matrix of another place must reach: they do not end in a quadratic one."""

SAME = 6e-4
"""Change of poles and shapes, relative to half bandwidth, damping and rms of the shape, up to which the covariance stays as it was.
Deviations change by 1.4 to 1.9 times as much (three cases): a thousandth at most."""


Outside = tuple[Real, Real, Real, NDArray[np.int_]]
"""Frequencies, damping ratios and shapes of residual terms, and numbers of the modes of the fit that they stand for as well."""


@dataclass(frozen=True)
class Polished:
    """Result of :func:`polish`.

    ``covariance`` is that of [ln f, ln ζ, shapes mode by mode]; ``local_estimates`` are for each run the local coefficients response by
    response (m·b,) and their information given the modes, transients eliminated: (m·b, m·b), or (m, b, b) where nothing joins the
    responses. ``cost`` is Σ eᴴC⁻¹e over runs and lines; ``without`` the normal matrix without the lines named as ``apart``.
    """

    parameters: Parameters
    covariance: Real
    local_estimates: tuple[tuple[Real, Real], ...]
    cost: float
    n_data: int
    iterations: int
    converged: bool
    without: Information | None = None


def start_parameters(runs: Sequence[RunSpectra], hz: Real, zeta: Real, shapes: Real, outside: tuple[Real, Real]) -> Parameters:
    """Parameters with empty transients and local terms."""
    n = len(hz)
    transients = tuple(np.zeros((2, 0 if run.step_s is None else n)) for run in runs)
    local = tuple(np.zeros((run.response_rows.size, n_local(run, len(outside[0])))) for run in runs)
    return Parameters(np.asarray(hz, float), np.asarray(zeta, float), np.asarray(shapes, float), *outside, transients, local)


def signed(run: RunSpectra) -> RunSpectra:
    """The run with all senses as in the model's DOF list."""
    return replace(
        run,
        responses=run.responses * run.response_signs[:, None],
        forces=run.forces * run.force_signs[:, None],
        response_signs=np.ones_like(run.response_signs),
        force_signs=np.ones_like(run.force_signs),
    )


def driven_rows(runs: Sequence[RunSpectra]) -> list[int]:
    """Rows of all DOFs that a force drives in some run."""
    return sorted({int(row) for run in runs for row in run.force_rows})


def _evaluated(runs: Sequence[RunSpectra], theta: Parameters, shape_std: Real | None) -> tuple[float, list[Residual]]:
    """Σ eᴴC⁻¹e plus half the quadratic form of the shapes' prior, and the residuals of the runs."""
    states = [residual(run, theta, i) for i, run in enumerate(runs)]
    prior = 0.0 if shape_std is None else 0.5 * float(np.sum((theta.shapes / shape_std) ** 2))
    return sum(state.cost for state in states) + prior, states


def polish(
    runs: Sequence[RunSpectra],
    start: Parameters,
    *,
    shape_std: Real | None = None,
    hold_poles: bool | NDArray[np.bool_] = False,
    max_iterations: int = 30,
    tolerance: float = 0.05,
    progress: Callable[[str], None] | None = None,
    want_covariance: bool = True,
    needed_cost: float = np.inf,
    known: Information | None = None,
    apart: Sequence[NDArray[np.bool_]] | None = None,
) -> Polished:
    """Minimise the errors-in-variables cost over poles, shapes, transients and local terms.

    Senses of the runs are those of the model (:func:`signed`). ``shape_std`` (M, n) is that of a Gaussian prior of the shapes; wide, it
    only holds what the data do not see. ``hold_poles`` keeps all poles or some (n,) as they are. There are ``max_iterations`` steps with a
    normal matrix of their own. The fit stops when the fall of the cost is below ``tolerance`` (unit variance per datum: 0.05 moves every
    estimate by less than about a third of its standard deviation), or where the steps that are left do not reach ``needed_cost`` at the
    pace of the last one. ``known`` is a normal matrix of these lines near the start, which serves for the first step; ``apart`` are lines
    (L,) of each run without which the normal matrix is wanted too.
    """
    theta = start
    m_dofs, n = theta.shapes.shape
    n_global, driven = 2 * n + m_dofs * n, driven_rows(runs)
    precision = np.zeros(n_global)
    if shape_std is not None:
        precision[2 * n :] = (0.5 / shape_std**2).T.ravel()
    precision[: 2 * n][np.tile(np.broadcast_to(hold_poles, n), 2)] = np.inf
    damping = 1e-4
    cost, states = _evaluated(runs, theta, shape_std)
    converged, iteration, without, fresh = False, 0, None, known is None
    since = 0.0  # fall of the cost since the normal matrix was taken
    if known is None:
        known, without, slopes = linearised(runs, theta, states, apart)
    else:
        slopes = gradients(runs, theta, states)
    equations = Equations.of(known, slopes, theta, precision, driven)
    while iteration < max_iterations:
        iteration += fresh
        trial, trial_cost, gain, there = None, np.inf, 0.0, states
        enough = tolerance if fresh else NEAR * tolerance
        for _ in range(14 if fresh else 1):
            step, nuisance, gain = equations.step(damping)
            trial = _moved(theta, step, nuisance, runs)
            trial_cost = np.inf
            if trial is not None:
                trial_cost, there = _evaluated(runs, trial, shape_std)
            if np.isfinite(trial_cost) and trial_cost <= cost:
                break
            trial = None
            if gain < enough:
                break
            damping = max(damping * 10, 1e-8)
        if trial is None and (fresh or gain < enough):
            converged = gain < max(tolerance, 1e-7 * cost)
            break
        if trial is None:
            known, without, slopes = linearised(runs, theta, states, apart)
            equations, since, fresh = Equations.of(known, slopes, theta, precision, driven), 0.0, True
            continue
        fall, cost, theta, states = cost - trial_cost, trial_cost, trial, there
        since += fall
        damping = max(damping / 30, 1e-12)
        if progress is not None:
            progress(f"maximum-likelihood fit, step {iteration}: cost lower by {100 * fall / max(cost, 1e-300):.2g} %")
        if fall < enough:
            converged = True
            break
        if fall * (max_iterations - iteration) < cost - needed_cost:
            break
        equations = Equations.of(known, gradients(runs, theta, states), theta, precision, driven)
        gain = equations.step(damping)[2]
        if gain < NEAR * tolerance:
            converged = True
            break
        fresh = gain > REUSED * fall
        if fresh:
            known, without, slopes = linearised(runs, theta, states, apart)
            equations, since = Equations.of(known, slopes, theta, precision, driven), 0.0
    if want_covariance and since > tolerance and not _same(known.at, theta):
        known, without, _ = linearised(runs, theta, states, apart)
    covariance = _covariance(known.normal, precision) if want_covariance else np.zeros((0, 0))
    estimates = tuple((local.ravel(), 2 * normal) for local, normal in zip(theta.local, known.local, strict=True))
    n_data = sum(run.responses.size for run in runs)
    return Polished(theta, covariance, estimates, cost, n_data, iteration, converged, without)


def _same(a: Parameters, b: Parameters) -> bool:
    """Whether two places are so near that the covariance of one serves for the other."""
    shapes = np.mean((a.shapes - b.shapes) ** 2, axis=0) / np.mean(b.shapes**2, axis=0)
    moves = np.concatenate([np.log(a.hz / b.hz) / b.zeta, np.log(a.zeta / b.zeta), np.sqrt(shapes)])
    return bool(np.all(np.abs(moves) < SAME))


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
    # Measured are products of the shape at a driven DOF and that at another one, or a transient's amplitude. Where a reference hardly moves
    # in a mode they are known far better than its scale. By sums they would be wrong by the square of the scale's step: a fit creeps along
    # a bent valley and ends before its minimum. With a factor here and its inverse there they change as the step foresees; so do the drive
    # residues, squares of the scale, by this factor.
    driven, moves = driven_rows(runs), step[2 * n :].reshape(n, m_dofs).T
    change = scales(theta, driven) @ step
    factor = np.sqrt(np.maximum(1 + 2 * change, LEAST_RESIDUE))
    shapes = (theta.shapes + moves + change * theta.shapes) / factor
    shapes[driven] = (theta.shapes + moves - change * theta.shapes)[driven] * factor
    transients, local = [], []
    for i, run in enumerate(runs):
        split = 0 if run.step_s is None else 2 * n
        old = theta.transients[i]
        transients.append((old + nuisance[i][:split].reshape(old.shape) - change[: old.shape[1]] * old) * factor[: old.shape[1]])
        local.append(theta.local[i] + nuisance[i][split:].reshape(run.response_rows.size, -1))
    return replace(theta, hz=hz, zeta=zeta, shapes=shapes, transients=tuple(transients), local=tuple(local))


def _covariance(normal: Real, precision: Real) -> Real:
    """Inverse Fisher information of the global parameters, 0 for those held; the information of complex data is twice the normal matrix."""
    free = np.ix_(np.isfinite(precision), np.isfinite(precision))
    total = normal[free] + np.diag(precision[np.isfinite(precision)])
    d = np.sqrt(np.maximum(np.diag(total), 1e-300))
    d[d < 1e-12 * d.max()] = d.max()
    values, vectors = np.linalg.eigh(total / np.outer(d, d))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    out = np.zeros_like(normal)
    out[free] = 0.5 * inverse / np.outer(d, d)
    return out


def run_misfit(
    runs: Sequence[RunSpectra], theta: Parameters, keep: Sequence[NDArray[np.bool_]], terms: Outside | None = None
) -> tuple[float, Real]:
    """Mean of |e_j|²/(D_j + |H_j|²σ_f²), of noise of a line, over the kept lines of each run, and per row of the model's DOFs.

    The kept lines are those the fit did not use; the transients come from the fit. Residual ``terms`` stand for what lies outside where
    given, in place of the free terms of each run.
    """
    total, count = 0.0, 0
    by_row = np.zeros((theta.shapes.shape[0], 2))
    for i, (run, mask) in enumerate(zip(runs, keep, strict=True)):
        if not mask.any():
            continue
        part = run.lines(mask)
        state = residual(part, theta, i)
        error = state.error if terms is None else state.error - _other_terms(part, theta, i, terms)
        ratio = power_of(error) / state.variance * run.correlated_lines
        total += float(ratio.sum())
        count += ratio.size
        np.add.at(by_row, part.response_rows, np.stack([ratio.sum(axis=1), np.full(ratio.shape[0], ratio.shape[1])], axis=1))
    with np.errstate(invalid="ignore"):
        return (float(total / count) if count else float("nan")), by_row[:, 0] / by_row[:, 1]


def _other_terms(run: RunSpectra, theta: Parameters, index: int, terms: Outside) -> Complex:
    """What the responses of a run change by where residual terms stand for the free terms of what lies outside, (m, L)."""
    hz, zeta, shapes, gone = terms
    q = theta.outside_hz.size
    known = theta.functions(run)
    kernel = modal_kernel(run.frequencies_hz, hz, zeta, "accelerance", run.window_rate)
    functions = np.concatenate([kernel, -known.kernels[0][gone], -known.outside])
    shapes = np.concatenate([shapes, theta.shapes[:, gone]], axis=1)
    out = np.zeros(run.responses.shape, complex)
    for k, (row, force) in enumerate(zip(run.force_rows, run.forces, strict=True)):
        local = theta.local[index][:, k * q : (k + 1) * q]
        out += combined(np.concatenate([shapes[run.response_rows] * shapes[row], local], axis=1), functions) * force
    return out
