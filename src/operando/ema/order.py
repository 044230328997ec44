"""How many modes: start from candidate poles, refine, take out what does not improve the model, add what the residuals show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from operando.ema.normal import Information, residual
from operando.ema.polish import Polished, polish, start_parameters
from operando.ema.polish_model import Parameters, Real, run_model
from operando.ema.spectra import RunSpectra
from operando.ema.start import linear_residues, mode_gain, outside_kernels, rank_one
from operando.stabilization import RejectedPole
from operando.synthesis import power_of

FREE_PRIOR = 20.0
MAX_DAMPING = 0.15


@dataclass
class OrderLog:
    """What the search did: rejected modes with reasons, and one line a round."""

    rejected: list[RejectedPole] = field(default_factory=list)
    rounds: list[str] = field(default_factory=list)
    unseen_hz: list[float] = field(default_factory=list)


class UnseenModesError(Exception):
    """The search needs modes that were not to be added."""

    def __init__(self, hz: Sequence[float]) -> None:
        super().__init__(hz)
        self.hz = tuple(hz)


def thin_lines(runs: Sequence[RunSpectra], hz: Real, zeta: Real, per_width: int = 12) -> list[RunSpectra]:
    """Fewer lines for the rounds of the search: all where resonances are narrow, a share elsewhere.

    Lines are independent of each other, so leaving some out costs information, not correctness.
    """
    out = []
    for run in runs:
        f = run.frequencies_hz
        if f.size < 3000:
            out.append(run)
            continue
        step = (f[-1] - f[0]) / (f.size - 1)
        width = np.interp(f, hz, 2 * zeta * hz) if hz.size else np.full(f.size, step)
        stride = np.clip((width / step / per_width).astype(int), 1, 6)
        keep = np.arange(f.size) % stride == 0
        for h, z in zip(hz, zeta, strict=True):
            keep |= (np.abs(f - h) < 2 * z * h) & (np.arange(f.size) % max(1, int(2 * z * h / step / per_width)) == 0)
        out.append(run.lines(keep))
    return out


def refine(
    runs: Sequence[RunSpectra],
    n_dofs: int,
    hz: Real,
    zeta: Real,
    *,
    lower: bool,
    start: Parameters | None = None,
    max_iterations: int = 12,
    tolerance: float = 1.0,
    want_covariance: bool = False,
    log: OrderLog | None = None,
    progress: Callable[[str], None] | None = None,
    hold_poles: bool | NDArray[np.bool_] = False,
    needed_cost: float = np.inf,
    known: Information | None = None,
    apart: Sequence[NDArray[np.bool_]] | None = None,
) -> Polished:
    """Linear start (unless ``start`` is given) and maximum-likelihood fit of the given modes."""
    if start is None:
        outside = outside_kernels(runs, hz, lower)
        residues = linear_residues(runs, hz, zeta, outside)
        shapes, seen = rank_one(runs, residues, n_dofs)
        if log is not None:
            log.unseen_hz = [float(h) for h, s in zip(hz, seen, strict=True) if not s]
        start = start_parameters(runs, hz, zeta, shapes, outside)
    # A wide prior only keeps shapes that no drive point sees from running away.
    rms = np.sqrt(np.mean(start.shapes**2, axis=0, keepdims=True))
    std = np.broadcast_to(FREE_PRIOR * np.maximum(rms, np.median(rms)), start.shapes.shape) if hz.size else None
    return polish(
        runs,
        start,
        shape_std=std,
        hold_poles=hold_poles,
        max_iterations=max_iterations,
        tolerance=tolerance,
        want_covariance=want_covariance,
        progress=progress,
        needed_cost=needed_cost,
        known=known,
        apart=apart,
    )


def mode_strength(runs: Sequence[RunSpectra], theta: Parameters) -> Real:
    """Share of each mode in the data in units of the noise: Σ |φ_jr Q_r|²/variance, (n,)."""
    out = np.zeros(theta.hz.size)
    for i, run in enumerate(runs):
        model = run_model(run, theta, i, run.forces)
        phi = theta.shapes[run.response_rows]
        power = power_of(model.modal)
        out += np.sum(phi**2 * ((1 / run.response_variance) @ power.T), axis=0)
    return out


def complete_start(runs: Sequence[RunSpectra], n_dofs: int, hz: Real, zeta: Real, log: OrderLog) -> tuple[Real, Real, Polished | None]:
    """Starting poles, with modes added first where the free fit would bend others to explain them, and the free fit of them.

    The fit (on thinned lines, no kernels below the band) is what any later one from these poles ends at; None where it did not settle.
    A mode missing from the start makes a neighbour broad and moves it away before the residuals can show where it is. So where a
    free fit moves a pole out of its resonance or makes it several times broader, the poles are held and what is missing is added.
    """
    order = np.argsort(hz)
    hz, zeta = np.asarray(hz, float)[order], np.clip(np.asarray(zeta, float)[order], 2e-4, 0.1)
    thinned = thin_lines(runs, hz, zeta)
    free = refine(thinned, n_dofs, hz, zeta, lower=False, max_iterations=8, log=log)
    theta = free.parameters
    bent = (np.abs(theta.hz - hz) > 1.5 * zeta * hz) | (theta.zeta > 2.5 * zeta)
    if not bent.any():
        return hz, zeta, free if free.converged else None
    for _ in range(3):
        held = refine(thinned, n_dofs, hz, zeta, lower=False, hold_poles=True, max_iterations=4)
        near = [h + k * z * h for h, z in zip(hz, zeta, strict=True) for k in (-3, 0, 3)]
        new = _missing_modes(thinned, held, near, _scanned(thinned, held))[:1]
        if not new:
            break
        log.rounds.append(f"start: {bent.sum()} poles would bend; a mode near {new[0][0]:.4g} Hz added first")
        rank = np.argsort(np.append(hz, new[0][0]))
        hz, zeta = np.append(hz, new[0][0])[rank], np.append(zeta, new[0][1])[rank]
        grown = refine(thinned, n_dofs, hz, zeta, lower=False, max_iterations=8).parameters
        bent = (np.abs(grown.hz - hz) > 1.5 * zeta * hz) | (grown.zeta > 2.5 * zeta)
        if not bent.any():
            break
    return hz, zeta, None


def search_order(
    runs: Sequence[RunSpectra],
    n_dofs: int,
    hz: Real,
    zeta: Real,
    *,
    lower: bool,
    max_rounds: int = 10,
    max_modes: int = 200,
    first: Polished | None = None,
    log: OrderLog | None = None,
    progress: Callable[[str], None] | None = None,
    unseen: Callable[[Sequence[float]], Sequence[float]] | None = None,
) -> tuple[Polished, OrderLog]:
    """Refine the candidate poles (n,) and settle the number of modes, on thinned lines, without covariance: a start for the final fit.

    ``lower`` says whether a pseudo-mode below the band is needed (rigid-body or suspension modes); ``first`` is the fit of these poles
    where it is known (of :func:`complete_start`). ``unseen`` says which of some frequencies [Hz] are not to be added, however much they
    lower the cost: where such a mode improves the model, :class:`UnseenModesError` is raised.
    """
    log = OrderLog() if log is None else log
    order = np.argsort(hz)
    hz, zeta = np.asarray(hz, float)[order], np.clip(np.asarray(zeta, float)[order], 2e-4, 0.1)
    thinned = thin_lines(runs, hz, zeta)
    fit = refine(thinned, n_dofs, hz, zeta, lower=lower, log=log) if first is None else first
    tried: list[float] = []
    scan: list[tuple[float, float, float]] = []
    scanned: Polished | None = None
    for number in range(max_rounds):
        misfit = fit.cost / fit.n_data
        out = weak_modes(thinned, fit, log)
        if out.size:
            tried += [float(fit.parameters.hz[i]) for i in out]
            keep = np.setdiff1d(np.arange(fit.parameters.hz.size), out)
            log.rounds.append(f"round {number}: reduced chi-square {misfit:.3g}, {out.size} modes taken out")
            fit = refine(thinned, n_dofs, fit.parameters.hz[keep], fit.parameters.zeta[keep], lower=lower)
            misfit = fit.cost / fit.n_data
        if scanned is not fit:  # of a fit that stays, because what was tried did not help, the scan does
            scan, scanned = _scanned(thinned, fit), fit
        new = _missing_modes(thinned, fit, tried, scan)
        if progress is not None:
            progress(f"EMA order search: {fit.parameters.hz.size} modes, normalised error {misfit:.3g}")
        if not new or fit.parameters.hz.size + len(new) > max_modes:
            log.rounds.append(f"round {number}: reduced chi-square {misfit:.3g}, {fit.parameters.hz.size} modes, nothing more to add")
            break
        grown_hz = np.concatenate([fit.parameters.hz, [h for h, _ in new]])
        grown_zeta = np.concatenate([fit.parameters.zeta, [z for _, z in new]])
        rank = np.argsort(grown_hz)
        bound = fit.cost - _price(thinned) * len(new)
        trial = refine(thinned, n_dofs, grown_hz[rank], grown_zeta[rank], lower=lower, needed_cost=bound)
        if trial.cost > fit.cost:
            # More modes cannot fit worse: the linear start led astray.
            start = _grown(thinned, n_dofs, fit.parameters, new)
            trial = refine(thinned, n_dofs, grown_hz, grown_zeta, lower=lower, start=start, needed_cost=bound)
        fall = fit.cost - trial.cost
        needed = _price(thinned) * len(new) * max(1.0, trial.cost / trial.n_data)
        tried += [h for h, _ in new]
        if fall < needed:
            log.rounds.append(f"round {number}: {len(new)} more modes lower the cost by {fall:.3g} only (needed {needed:.3g}): not taken")
            if len(new) == 1:
                break
            continue
        if unseen is not None and (wrong := unseen([h for h, _ in new])):
            raise UnseenModesError(wrong)
        log.rounds.append(f"round {number}: reduced chi-square {misfit:.3g} -> {trial.cost / trial.n_data:.3g} with {len(new)} more modes")
        fit = trial
    out = weak_modes(thinned, fit, log)
    if out.size and out.size < fit.parameters.hz.size:
        keep = np.setdiff1d(np.arange(fit.parameters.hz.size), out)
        fit = refine(thinned, n_dofs, fit.parameters.hz[keep], fit.parameters.zeta[keep], lower=lower)
        log.rounds.append(f"last look: {out.size} modes taken out, {keep.size} left")
    return fit, log


def _grown(runs: Sequence[RunSpectra], n_dofs: int, theta: Parameters, new: Sequence[tuple[float, float]]) -> Parameters:
    """The fitted parameters and a few more modes, these with the shapes of a linear start; in order of frequency."""
    hz = np.concatenate([theta.hz, [h for h, _ in new]])
    zeta = np.concatenate([theta.zeta, [z for _, z in new]])
    residues = linear_residues(runs, hz, zeta, (theta.outside_hz, theta.outside_zeta))
    shapes = np.c_[theta.shapes, rank_one(runs, residues, n_dofs)[0][:, theta.hz.size :]]
    rank = np.argsort(hz)
    more = np.zeros((2, len(new)))
    transients = tuple(np.c_[t, more][:, rank] if t.size else t for t in theta.transients)
    return Parameters(hz[rank], zeta[rank], shapes[:, rank], theta.outside_hz, theta.outside_zeta, transients, theta.local)


def _price(runs: Sequence[RunSpectra]) -> float:
    """Fall of the cost that one more mode must bring: its unknowns times ln(data), a Bayesian information criterion."""
    responses = max(run.response_rows.size for run in runs)
    return (responses + 2) * float(np.log(sum(run.responses.size for run in runs))) * 0.5 * 1.5


def weak_modes(runs: Sequence[RunSpectra], fit: Polished, log: OrderLog) -> NDArray[np.int_]:
    """Modes to take out: no share in the data, damping beyond any structure, or twins of a neighbour."""
    theta = fit.parameters
    n = theta.hz.size
    strength = mode_strength(runs, theta)
    price = _price(runs) * max(1.0, fit.cost / fit.n_data)
    out = []
    low = min(run.frequencies_hz[0] for run in runs)
    high = max(run.frequencies_hz[-1] for run in runs)
    for i in range(n):
        h, z = float(theta.hz[i]), float(theta.zeta[i])
        code = reason = ""
        if strength[i] < price:
            code, reason = "no_evidence", f"its share in the data is {strength[i]:.3g} noise units, {price:.3g} are needed"
        elif z > MAX_DAMPING:
            code, reason = "too_damped", f"damping {100 * z:.3g} % is a curved background, not a mode"
        elif not (0.8 * low <= h <= 1.12 * high):
            code, reason = "outside_band", f"moved to {h:.4g} Hz, beyond the fitted lines {low:.4g}-{high:.4g} Hz"
        elif i and h - theta.hz[i - 1] < 0.3 * z * h and _alike(theta, i, i - 1) and strength[i] < strength[i - 1]:
            code, reason = "twin", f"the same frequency and shape as {theta.hz[i - 1]:.5g} Hz"
        elif i < n - 1 and theta.hz[i + 1] - h < 0.3 * z * h and _alike(theta, i, i + 1) and strength[i] < strength[i + 1]:
            code, reason = "twin", f"the same frequency and shape as {theta.hz[i + 1]:.5g} Hz"
        if code:
            out.append(i)
            log.rejected.append(RejectedPole(h, z, code, reason))
    return np.array(out, int)


def uncertain_modes(runs: Sequence[RunSpectra], fit: Polished, log: OrderLog) -> NDArray[np.int_]:
    """Modes among the fitted lines whose own covariance says that the data do not determine them: damping unknown to half its value."""
    theta = fit.parameters
    n = theta.hz.size
    spread = np.sqrt(np.diag(fit.covariance)[n : 2 * n] * max(1.0, fit.cost / fit.n_data))
    low = min(run.frequencies_hz[0] for run in runs)
    high = max(run.frequencies_hz[-1] for run in runs)
    out = []
    for i in range(n):
        h, z = float(theta.hz[i]), float(theta.zeta[i])
        if spread[i] > 0.5 and low < h < high:
            out.append(i)
            log.rejected.append(
                RejectedPole(h, z, "uncertain", f"its damping {100 * z:.3g} % is uncertain by {100 * spread[i]:.0f} % of itself")
            )
    return np.array(out, int)


def _alike(theta: Parameters, i: int, j: int) -> bool:
    a, b = theta.shapes[:, i], theta.shapes[:, j]
    norm = float((a @ a) * (b @ b))
    return norm > 0 and float(a @ b) ** 2 / norm > 0.95


def _missing_modes(
    runs: Sequence[RunSpectra], fit: Polished, tried: Sequence[float], scan: Sequence[tuple[float, float, float]]
) -> list[tuple[float, float]]:
    """Places of a scan where one more mode would lower the cost most; at most three a round, apart from each other."""
    price = _price(runs) * max(1.0, fit.cost / fit.n_data) * 2
    out: list[tuple[float, float]] = []
    for rise, h, z in scan:
        if rise < price or len(out) == 3:
            break
        near = [abs(h - t) < max(3 * z * h, 0.004 * h) for t in [*tried, *(o for o, _ in out)]]
        if not any(near) and (not out or rise > 0.1 * scan[0][0]):
            out.append((h, z))
    return out


def _scanned(runs: Sequence[RunSpectra], fit: Polished) -> list[tuple[float, float, float]]:
    """Fall of the cost by one more mode, its frequency [Hz] and damping, on a grid over the lines of the runs; the greatest first."""
    theta = fit.parameters
    states = [residual(run, theta, i) for i, run in enumerate(runs)]
    f0 = min(float(r.frequencies_hz[0]) for r in runs)
    f1 = max(float(r.frequencies_hz[-1]) for r in runs)
    typical = float(np.median(theta.zeta)) if theta.hz.size else 0.01
    found: list[tuple[float, float, float]] = []
    inflated = [
        replace(
            r,
            response_variance=r.response_variance
            + np.abs(r.responses) ** 2 * np.sum(r.force_variance, 0) / np.sum(np.abs(r.forces) ** 2, 0),
        )
        for r in runs
    ]
    for z in (0.5 * typical, typical, 3 * typical):
        grid = _grid(f0, f1, z)
        gain = mode_gain(inflated, [s.error for s in states], grid, z)
        found += [(float(g), float(h), z) for g, h in zip(gain, grid, strict=True)]
    return sorted(found, reverse=True)


def _grid(f0: float, f1: float, zeta: float) -> Real:
    count = int(np.clip(np.log(f1 / f0) / (0.7 * zeta), 50, 1500)) if f0 > 0 else 500
    return np.geomspace(max(f0, f1 * 1e-3), f1, count)
