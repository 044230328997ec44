"""The polished answer: a maximum-likelihood fit of real modes of unit modal mass, from poles that the linear fits propose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, TimeRecord
from operando.dof import Dof
from operando.ema.hold_out import heldout_misfit, hold_out_masks
from operando.ema.model_error import relative_model_error, with_model_error
from operando.ema.order import OrderLog, complete_start, refine, search_order, thin_lines, uncertain_modes, weak_modes
from operando.ema.outside import OutsideModes, make_up, outside_modes, without_modes
from operando.ema.polish import Polished, signed
from operando.ema.polish_model import Parameters, Real
from operando.ema.remaining import MAX_UNKNOWNS, choose_core, remaining_rows
from operando.ema.spectra import FRF_NOISE, FrfNoise, RunSpectra, excited_fit_band, frf_spectra, record_spectra
from operando.ema.start import N_LOWER, inverted_forces, linear_residues, outside_kernels
from operando.synthesis import power_of

WIDER = (1.3, 1.5)
"""The fit ends so far above the analysis band where the force reaches there, between two modes.

Of 259 modes in band of 30 simulated tests no scale was off by more than 3.4 standard deviations. From 1.2 times the band on, with other
kernels for what lies above, one was off by 4.3 and one by 6.8."""

VALLEY = 0.01
"""The power of the FRFs is averaged over so much of the frequency to both sides, a resonance damped by 1 %: antiresonances are no end."""

BEYOND = 2.0
"""A pole whose resonance reaches the end of the lines by so many half bandwidths, where a fifth of its power is left, is held in the last
fit. On such a pole 25 steps were not enough (two tests); its frequency and damping have no deviation but the least one stated."""

POLISH_STEPS = 60
"""Steps that the searches, the final fit and the one that judges it take together, about (30 … 90 on the practice cases)."""


SCAN_STEPS = 5 * 3 * 1500 * 8
"""Operations of the scans for missing modes, for each line, response and force: rounds (about), damping ratios, frequencies (at most),
three real products with their sums and the kernels (start.mode_gain)."""


@dataclass(frozen=True)
class PolishedAnswer:
    """What the maximum-likelihood fit says.

    ``misfit`` is that of modes and residual terms on lines the fit did not use, ``free_misfit`` the same with what lies outside free in
    each run. ``turned`` are DOFs whose force was reversed in polarity: opposite sense of force and accelerometer; ``lower`` says whether
    kernels below the band were needed.
    """

    fit: Polished
    outside: OutsideModes
    misfit: float
    misfit_by_row: Real
    free_misfit: float
    log: OrderLog
    turned: tuple[int, ...]
    lower: bool


def polish_work(runs: Sequence[RunSpectra], n_dofs: int, n_modes: int) -> float:
    """Floating-point operations of a polish, about: normal equations over the lines of each run, their solution, the search for more."""
    lines = sum(run.frequencies_hz.size * run.response_rows.size * (6 * n_modes + 12) ** 2 / 4 for run in runs)
    unknowns = n_modes * (2 + min(n_dofs, MAX_UNKNOWNS // max(n_modes, 1)))
    scans = sum(SCAN_STEPS * run.frequencies_hz.size * run.responses.shape[0] * run.forces.shape[0] for run in runs)
    nuisance = sum(run.response_rows.size * (8 * run.forces.shape[0] + 7) for run in runs)
    return float(POLISH_STEPS * (lines + unknowns**3 / 3 + unknowns**2 * nuisance) + scans)


def polished_answer(
    runs: list[RunSpectra],
    dofs: tuple[Dof, ...],
    band: tuple[float, float],
    hz: Real,
    zeta: Real,
    *,
    progress: Callable[[str], None] | None = None,
    unseen: Callable[[Sequence[float]], Sequence[float]] | None = None,
) -> PolishedAnswer:
    """Maximum-likelihood fit from starting poles; the number of modes follows from what they add (``unseen``: :func:`search_order`)."""
    core = choose_core(runs, dofs, hz.size)
    core_runs = runs if core is None else [_reduced(run, core) for run in runs]
    n_dofs = len(dofs) if core is None else len(core)
    core_runs, turned = _turned(core_runs, hz, zeta)
    log = OrderLog()
    hz, zeta, free = complete_start(core_runs, n_dofs, hz, zeta, log)
    lower, share, theta = _needs_lower(core_runs, n_dofs, hz, zeta, free)
    weighted = with_model_error(core_runs, theta, share)
    first = None if lower or share > 0 else free  # of other kernels or weights
    fit, log = search_order(weighted, n_dofs, hz, zeta, lower=lower, first=first, log=log, progress=progress, unseen=unseen)
    final = _final(weighted, n_dofs, fit, lower, log, progress)
    gone = make_up(core_runs, final)
    outside = outside_modes(core_runs, final, band, lower, gone=gone, model_error=share)
    terms = outside.hz, outside.zeta, outside.shapes, gone
    misfit, by_row, free_misfit = heldout_misfit(core_runs, n_dofs, final, band, terms, final.without if share <= 0 else None)
    if gone.size:
        log.rounds.append(f"{gone.size} modes beyond the lines taken for residual terms")
        final = without_modes(final, gone)
    rows = tuple(dict.fromkeys(int(core_runs[i].force_rows[k]) for i, k in turned))
    if core is not None:
        final, outside = remaining_rows(_turn(runs, turned), core, len(dofs), final, outside)
        by_row = _spread(by_row, core, len(dofs))
        rows = tuple(int(core[row]) for row in rows)
    return PolishedAnswer(final, outside, misfit, by_row, free_misfit, log, rows, lower)


def polish_runs(
    frf: Frf,
    dofs: tuple[Dof, ...],
    band: tuple[float, float],
    records: Sequence[TimeRecord] | None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    noise: FrfNoise = FRF_NOISE,
) -> tuple[list[RunSpectra], tuple[float, float]]:
    """Spectra to fit, on lines a little wider than the analysis band where the force excites, and outside the bands excluded.

    ``noise`` is that of FRFs fitted alone; the lines of whole records are independent.
    """
    f = frf.frequencies_hz
    if not records:
        fit_band = (float(max(0.6 * band[0], f[f > 0][0])), float(min(WIDER[1] * band[1], f[-1])))
        fit_band = fit_band[0], between_modes(frf, WIDER[0] * band[1], fit_band[1])
        return [signed(run) for run in frf_spectra(frf, dofs, fit_band, noise)], fit_band
    fit_band = excited_fit_band(records, band, WIDER[1])
    fit_band = fit_band[0], between_modes(frf, WIDER[0] * band[1], fit_band[1])
    return [signed(record_spectra(record, dofs, fit_band).without_bands(exclude_bands)) for record in records], fit_band


def between_modes(frf: Frf, first: float, last: float) -> float:
    """Frequency [Hz] from ``first`` to ``last`` where the FRFs are lowest altogether; ``last`` where they have no lines there.

    A fit that ends on the flank of a mode beyond its lines has to bend others to it, or a mode whose pole nothing there shows.
    """
    f = frf.frequencies_hz
    lines = np.flatnonzero((f >= first) & (f <= last) & np.isfinite(frf.data).any(axis=(0, 1)))
    if not lines.size:
        return last
    power = power_of(np.nan_to_num(frf.data[:, :, lines]))
    typical = np.median(power, axis=2, keepdims=True)
    level = np.sum(np.divide(power, typical, out=np.zeros_like(power), where=typical > 0), axis=(0, 1))
    window = np.ones(min(2 * int(np.sum(f[lines] > (1 - VALLEY) * f[lines[-1]])) + 1, level.size))
    level = np.convolve(level, window, "same") / np.convolve(np.ones_like(level), window, "same")
    inner = np.flatnonzero((level[1:-1] <= level[:-2]) & (level[1:-1] <= level[2:])) + 1  # the ends may be flanks
    return float(f[lines[inner[np.argmin(level[inner])] if inner.size else np.argmin(level)]])


def _turned(runs: Sequence[RunSpectra], hz: Real, zeta: Real) -> tuple[list[RunSpectra], list[tuple[int, int]]]:
    """The runs with forces of the wrong sense reversed in polarity, and which they were."""
    thinned = thin_lines(runs, hz, np.clip(zeta, 2e-4, 0.1))
    residues = linear_residues(thinned, hz, np.clip(zeta, 2e-4, 0.1), outside_kernels(thinned, hz, False))
    turned = inverted_forces(runs, residues)
    return _turn(runs, turned), turned


def _turn(runs: Sequence[RunSpectra], turned: Sequence[tuple[int, int]]) -> list[RunSpectra]:
    out = list(runs)
    for i, k in turned:
        sign = np.ones((out[i].forces.shape[0], 1))
        sign[k] = -1
        out[i] = replace(out[i], forces=out[i].forces * sign)
    return out


def _needs_lower(runs: Sequence[RunSpectra], n_dofs: int, hz: Real, zeta: Real, without: Polished | None) -> tuple[bool, float, Parameters]:
    """Whether kernels below the band lower the cost by more than their number allows, the relative error that remains, and that fit.

    ``without`` is the fit without them where it is known. The error is 0 where the candidates already describe the data to within a few
    times their noise.
    """
    thinned = thin_lines(runs, hz, np.clip(zeta, 2e-4, 0.1))
    if without is None:
        without = refine(thinned, n_dofs, hz, np.clip(zeta, 2e-4, 0.1), lower=False, max_iterations=6)
    theta = without.parameters
    unknowns = N_LOWER * sum(run.response_rows.size * run.forces.shape[0] for run in runs)
    price = unknowns * 0.5 * np.log(without.n_data) * 2
    start, needed = _with_lower(thinned, theta), without.cost - price
    with_lower = refine(thinned, n_dofs, theta.hz, theta.zeta, lower=True, start=start, max_iterations=6, needed_cost=needed)
    lower = without.cost - with_lower.cost > price * max(1.0, with_lower.cost / with_lower.n_data)
    best = with_lower if lower else without
    return bool(lower), relative_model_error(thinned, best.parameters), best.parameters


def _with_lower(runs: Sequence[RunSpectra], theta: Parameters) -> Parameters:
    """The parameters with kernels below the band that add nothing yet."""
    lower, lower_zeta = (part[-N_LOWER:] for part in outside_kernels(runs, theta.hz, True))
    q, local = theta.outside_hz.size, []
    for run, old in zip(runs, theta.local, strict=True):
        k = run.forces.shape[0]
        kernels = np.pad(old[:, : q * k].reshape(-1, k, q), ((0, 0), (0, 0), (0, lower.size)))
        local.append(np.c_[kernels.reshape(old.shape[0], -1), old[:, q * k :]])
    poles = np.append(theta.outside_hz, lower), np.append(theta.outside_zeta, lower_zeta)
    return replace(theta, outside_hz=poles[0], outside_zeta=poles[1], local=tuple(local))


def _final(
    runs: Sequence[RunSpectra],
    n_dofs: int,
    fit: Polished,
    lower: bool,
    log: OrderLog,
    progress: Callable[[str], None] | None,
) -> Polished:
    """Fit on all lines, to convergence; modes that turn out to be backgrounds there are taken out.

    Poles at the end of the lines and beyond stay: they stand for what lies there, and the lines tell so little of them that they would
    wander without end.
    """
    theta, masks = fit.parameters.modes(np.argsort(fit.parameters.hz)), hold_out_masks(runs)
    top = max(run.top_hz for run in runs)
    for _ in range(4):
        held = theta.hz * (1 + BEYOND * theta.zeta) > top
        final = refine(
            runs,
            n_dofs,
            theta.hz,
            theta.zeta,
            lower=lower,
            start=theta,
            hold_poles=held,
            max_iterations=25,
            tolerance=0.05,
            want_covariance=True,
            progress=progress,
            apart=masks,
        )
        out = np.union1d(weak_modes(runs, final, log), uncertain_modes(runs, final, log)).astype(int)
        if not out.size or out.size == final.parameters.hz.size:
            break
        log.rounds.append(f"final fit: {out.size} modes taken out")
        theta = final.parameters.modes(np.setdiff1d(np.arange(final.parameters.hz.size), out))
    if held.any():
        listed = ", ".join(f"{h:.4g}" for h in final.parameters.hz[held])
        log.rounds.append(f"final fit: poles at the end of the lines held ({listed} Hz), so their deviations are the least ones stated")
    return final


def _reduced(run: RunSpectra, core: NDArray[np.int_]) -> RunSpectra:
    position = {int(row): i for i, row in enumerate(core)}
    keep = np.array([i for i, row in enumerate(run.response_rows) if int(row) in position])
    return replace(
        run,
        responses=run.responses[keep],
        response_rows=np.array([position[int(run.response_rows[i])] for i in keep]),
        response_signs=run.response_signs[keep],
        response_variance=run.response_variance[keep],
        force_rows=np.array([position[int(row)] for row in run.force_rows]),
    )


def _spread(values: Real, core: NDArray[np.int_], n: int) -> Real:
    out = np.full(n, np.nan)
    out[core] = values
    return out
