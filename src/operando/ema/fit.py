"""Experimental modal analysis in one call: from FRFs and raw records to modes of unit modal mass with their covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, ModalModel, Provenance, TimeRecord
from operando.dof import Dof
from operando.ema.candidates import candidate_poles, stabilization_diagram
from operando.ema.findings import fit_findings, turned_finding
from operando.ema.heldout import heldout_misfit
from operando.ema.model_error import relative_model_error, with_model_error
from operando.ema.order import OrderLog, complete_start, refine, search_order, thin_lines, uncertain_modes, weak_modes
from operando.ema.outside import OutsideModes, make_up, outside_modes, without_modes
from operando.ema.polish import Polished, signed, start_parameters
from operando.ema.polish_model import Parameters, Real
from operando.ema.remaining import choose_core, remaining_rows
from operando.ema.spectra import RunSpectra, excited_fit_band, frf_spectra, record_spectra, whole_records
from operando.ema.start import inverted_forces, linear_residues, outside_kernels
from operando.errors import DataError, IdentificationError
from operando.stabilization import RejectedPole, Stabilization

WIDER = 1.33
"""The fit reaches this far above the analysis band where the force does."""

MIN_SUPPORT = 0.4
"""Share of linear fits (times their orders) that a starting mode needs; weaker ones are left to the search by residuals."""

FREQUENCY_FLOOR = 1e-6
DAMPING_FLOOR = 1.3e-4
SHAPE_FLOOR = 1.3e-4
"""Relative standard deviations that no likelihood sees: clock and filters of a measurement chain, the integrator of a simulated one."""


@dataclass(frozen=True)
class EmaDetails:
    """What the identification did.

    Parameters
    ----------
    stabilization : Stabilization
        Diagram of the linear fit over the band; the modes selected are the final ones.
    rejected : tuple of RejectedPole
        Everything that was not taken, with reasons.
    rounds : tuple of str
        One line a round of the search for the number of modes.
    fit_band_hz : (float, float)
        Lines that the fit used.
    misfit_by_dof : (n_dofs,) array
        Held-out misfit of each response DOF; NaN where it was not measured.
    fit_misfit : float
        Mean of eᴴC⁻¹e/m on the lines of the fit.
    converged : bool
    lower_residual : bool
        Whether kernels below the band were needed.
    second_opinion : tuple of dict
        sdypy-EMA beside it, where asked for.
    """

    stabilization: Stabilization | None
    rejected: tuple[RejectedPole, ...]
    rounds: tuple[str, ...]
    fit_band_hz: tuple[float, float]
    misfit_by_dof: NDArray[np.float64]
    fit_misfit: float
    converged: bool
    lower_residual: bool
    second_opinion: tuple[dict[str, Any], ...] = field(default=())


def fit_ema(
    frf: Frf,
    *,
    band: tuple[float, float] | None = None,
    max_order: int | None = None,
    records: Sequence[TimeRecord] | None = None,
    select_hz: Sequence[float] = (),
    reject_hz: Sequence[float] = (),
    second_opinion: bool = False,
    progress: Callable[[str], None] | None = None,
) -> ModalModel:
    """Identify the modes of the structure at rest.

    Poly-reference least-squares complex frequency fits of the FRFs (Peeters et al. 2004) over the band and its parts give candidate
    poles; a maximum-likelihood fit of real modes of unit modal mass, on the spectra of the whole records where they are given
    (transients modelled, response and force noise weighted), else on the FRFs with their variances, refines them, settles how many
    there are and gives their covariance. Modes outside the band become residual modes, so that undriven FRF columns are predicted too.

    Parameters
    ----------
    frf : Frf
        FRF matrix; any number of responses and references, also more references than responses (roving hammer).
    band : (float, float), optional
        Analysis band [Hz]; default: the lines of the FRF without those at the edges.
    max_order : int, optional
        Order of the linear fit shown in the stabilisation diagram.
    records : sequence of TimeRecord, optional
        Raw runs behind the FRFs: forces and responses. Runs with a single hit are fitted through their FRFs.
    select_hz, reject_hz : sequences of float
        Modes chosen or refused by hand [Hz].
    second_opinion : bool
        Ask sdypy-EMA as well.
    progress : callable, optional
        Told one line now and then.

    Returns
    -------
    ModalModel
        Real shapes; ``scaling`` is ``unit_modal_mass`` where units are known and a drive point gives the scale, else ``unscaled``.
        ``misfit`` is judged on lines the fit did not use; ``details`` is an :class:`EmaDetails`.

    Raises
    ------
    IdentificationError
        If the band holds too few lines or no mode is found.
    DataError
        If records and FRFs do not belong together.
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        return _fit(frf, band, max_order, records, tuple(select_hz), tuple(reject_hz), second_opinion, progress)


def _fit(
    frf: Frf,
    band: tuple[float, float] | None,
    max_order: int | None,
    records: Sequence[TimeRecord] | None,
    select_hz: tuple[float, ...],
    reject_hz: tuple[float, ...],
    second_opinion: bool,
    progress: Callable[[str], None] | None,
) -> ModalModel:
    frf = frf.to_quantity("accelerance")
    dofs = model_dofs(frf)
    band = _analysis_band(frf, band)
    records = whole_records(records)
    runs, fit_band = _runs(frf, dofs, band, records)
    weights = _weights(frf)
    data = np.nan_to_num(frf.data)
    candidates = candidate_poles(frf.frequencies_hz, data, weights, fit_band, window_rate=frf.exponential_window_rate)
    start = [(c.frequency_hz, c.damping_ratio) for c in candidates if c.prominent and c.support > MIN_SUPPORT]
    for wanted in select_hz:
        near = min(candidates, key=lambda c: abs(c.frequency_hz - wanted), default=None)
        if near is not None and abs(near.frequency_hz - wanted) < 0.01 * wanted:
            start.append((near.frequency_hz, near.damping_ratio))
        else:
            start.append((wanted, 0.01))
    start = _distinct([s for s in start if not any(abs(s[0] - r) < 0.01 * r for r in reject_hz)])
    if not start:
        raise IdentificationError(
            f"no stable pole between {fit_band[0]:g} and {fit_band[1]:g} Hz",
            hint="widen the band, check the FRFs, or name modes by select_hz",
        )
    core = choose_core(runs, dofs, len(start))
    core_runs = runs if core is None else [_reduced(run, core) for run in runs]
    n_dofs = len(dofs) if core is None else len(core)
    hz, zeta = np.array([s[0] for s in start]), np.array([s[1] for s in start])
    core_runs, turned = _turned(core_runs, hz, zeta)
    log = OrderLog()
    hz, zeta = complete_start(core_runs, n_dofs, hz, zeta, log)
    lower, share, theta = _needs_lower(core_runs, n_dofs, hz, zeta)
    weighted = with_model_error(core_runs, theta, share)
    fit, log = search_order(weighted, n_dofs, hz, zeta, lower=lower, keep_hz=select_hz, reject_hz=reject_hz, log=log, progress=progress)
    final = _final(weighted, n_dofs, fit, lower, select_hz, reject_hz, log, progress)
    misfit, by_row = heldout_misfit(core_runs, n_dofs, final, band)
    gone = make_up(core_runs, final)
    outside = outside_modes(core_runs, final, band, lower, gone=gone)
    if gone.size:
        log.rounds.append(f"{gone.size} modes beyond the lines taken for part of what lies outside")
        final = without_modes(final, gone)
    if core is not None:
        runs = _turn(runs, turned)
        final, outside = remaining_rows(runs, core, len(dofs), final, outside)
        by_row = _spread(by_row, core, len(dofs))
    used = records is not None
    stabilization = _diagram(frf, data, weights, fit_band, max_order, final, select_hz, reject_hz)
    model = _model(frf, dofs, final, outside, band, fit_band, misfit, log, used)
    if turned:
        names = dict.fromkeys(str(dofs[int(runs[i].force_rows[k])]) for i, k in turned)
        model = replace(model, findings=(*model.findings, *(turned_finding(name) for name in names)))
    opinion: tuple[dict[str, Any], ...] = ()
    if second_opinion:
        opinion = _opinion(frf, model)
    rejected = (*log.rejected, *(() if stabilization is None else stabilization.rejected))
    details = EmaDetails(
        stabilization,
        rejected,
        tuple(log.rounds),
        fit_band,
        by_row,
        final.cost / final.n_data,
        final.converged,
        lower,
        opinion,
    )
    return replace(model, details=details)


def model_dofs(frf: Frf) -> tuple[Dof, ...]:
    """DOFs of the model: the responses, then references that are not among them."""
    have = {(d.node, d.axis) for d in frf.responses}
    return (*frf.responses, *(d for d in frf.references if (d.node, d.axis) not in have))


def _analysis_band(frf: Frf, band: tuple[float, float] | None) -> tuple[float, float]:
    f = frf.frequencies_hz
    if band is None:
        margin = 0.02 * (f[-1] - f[0])
        return float(max(f[0] + margin, f[f > 0][0])), float(f[-1] - margin)
    low, high = float(band[0]), float(band[1])
    if not 0 <= low < high:
        raise DataError(f"band {low:g}-{high:g} Hz is empty", hint="give [low, high] in Hz")
    return low, high


def _runs(
    frf: Frf, dofs: tuple[Dof, ...], band: tuple[float, float], records: Sequence[TimeRecord] | None
) -> tuple[list[RunSpectra], tuple[float, float]]:
    """Spectra to fit, on lines a little wider than the analysis band where the force excites."""
    f = frf.frequencies_hz
    if not records:
        fit_band = (float(max(0.6 * band[0], f[f > 0][0])), float(min(WIDER * band[1], f[-1])))
        return [signed(run) for run in frf_spectra(frf, dofs, fit_band)], fit_band
    fit_band = excited_fit_band(records, band, WIDER)
    return [signed(record_spectra(record, dofs, fit_band)) for record in records], fit_band


def _weights(frf: Frf) -> Real | None:
    """1/standard deviation of each line for the linear fits, 0 where a pair was not measured; None where there is nothing to weigh."""
    missing = ~np.isfinite(frf.data)
    if frf.variance is None:
        return np.where(missing, 0.0, 1.0) if missing.any() else None
    known = np.isfinite(frf.variance) & (frf.variance > 0)
    if not known.any():
        return np.where(missing, 0.0, 1.0) if missing.any() else None
    std = np.sqrt(np.where(known, frf.variance, np.inf))
    floor = 1e-4 * np.sqrt(np.mean(np.abs(frf.data[~missing]) ** 2))
    return np.where(missing, 0.0, 1 / np.maximum(std, max(float(floor), 1e-300)))


def _distinct(poles: list[tuple[float, float]]) -> list[tuple[float, float]]:
    out: list[tuple[float, float]] = []
    for h, z in sorted(poles):
        if out and abs(h - out[-1][0]) < 1e-4 * h:
            continue
        out.append((h, z))
    return out


def _turned(runs: Sequence[RunSpectra], hz: Real, zeta: Real) -> tuple[list[RunSpectra], list[tuple[int, int]]]:
    """The runs with forces of the wrong sense turned, and which they were."""
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


def _needs_lower(runs: Sequence[RunSpectra], n_dofs: int, hz: Real, zeta: Real) -> tuple[bool, float, Parameters]:
    """Whether kernels below the band lower the cost by more than their number earns, the relative error that remains, and that fit.

    The error is 0 where the candidates already describe the data to within a few times their noise.
    """
    thinned = thin_lines(runs, hz, np.clip(zeta, 2e-4, 0.1))
    without = refine(thinned, n_dofs, hz, np.clip(zeta, 2e-4, 0.1), lower=False, max_iterations=6)
    theta = without.parameters
    with_lower = refine(thinned, n_dofs, theta.hz, theta.zeta, lower=True, max_iterations=6)
    unknowns = 2 * sum(run.response_rows.size * run.forces.shape[0] for run in runs)
    price = unknowns * 0.5 * np.log(without.n_data) * 2 * max(1.0, with_lower.cost / with_lower.n_data)
    lower = without.cost - with_lower.cost > price
    best = with_lower if lower else without
    return bool(lower), relative_model_error(thinned, best.parameters), best.parameters


def _final(
    runs: Sequence[RunSpectra],
    n_dofs: int,
    fit: Polished,
    lower: bool,
    keep_hz: Sequence[float],
    reject_hz: Sequence[float],
    log: OrderLog,
    progress: Callable[[str], None] | None,
) -> Polished:
    """Fit on all lines, to convergence; modes that turn out to be backgrounds there are taken out."""
    theta = fit.parameters
    for _ in range(4):
        rank = np.argsort(theta.hz)
        start = start_parameters(runs, theta.hz[rank], theta.zeta[rank], theta.shapes[:, rank], theta.outside_hz)
        final = refine(
            runs,
            n_dofs,
            theta.hz[rank],
            theta.zeta[rank],
            lower=lower,
            start=start,
            max_iterations=25,
            tolerance=0.05,
            want_covariance=True,
            progress=progress,
        )
        out = np.union1d(weak_modes(runs, final, keep_hz, log, reject_hz), uncertain_modes(runs, final, keep_hz, log)).astype(int)
        if not out.size or out.size == final.parameters.hz.size:
            break
        log.rounds.append(f"final fit: {out.size} modes taken out")
        keep = np.setdiff1d(np.arange(final.parameters.hz.size), out)
        theta = replace(
            final.parameters, hz=final.parameters.hz[keep], zeta=final.parameters.zeta[keep], shapes=final.parameters.shapes[:, keep]
        )
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


def _diagram(
    frf: Frf,
    data: NDArray[np.complex128],
    weights: Real | None,
    fit_band: tuple[float, float],
    max_order: int | None,
    final: Polished,
    select_hz: tuple[float, ...],
    reject_hz: tuple[float, ...],
) -> Stabilization | None:
    n_in = min(data.shape[:2])
    order = max_order or int(np.clip(np.ceil(6 * final.parameters.hz.size / n_in), 10, 80))
    try:
        rate = frf.exponential_window_rate
        diagram = stabilization_diagram(frf.frequencies_hz, data, max_order=order, weights=weights, band=fit_band, window_rate=rate)
    except IdentificationError:
        return None
    hz, zeta = final.parameters.hz, final.parameters.zeta
    members = []
    for h in hz:
        near = np.flatnonzero(np.abs(diagram.table.frequency_hz - h) < 0.003 * h)
        members.append(near)
    # What the linear diagram rejected but the refined fit took is not rejected.
    rejected = tuple(r for r in diagram.rejected if not np.any(np.abs(hz - r.frequency_hz) < 0.005 * hz))
    return replace(
        diagram,
        selected_hz=hz,
        selected_damping=zeta,
        selected_vectors=final.parameters.shapes,
        selected_members=tuple(members),
        rejected=rejected,
    )


def _model(
    frf: Frf,
    dofs: tuple[Dof, ...],
    final: Polished,
    outside: OutsideModes,
    band: tuple[float, float],
    fit_band: tuple[float, float],
    misfit: float,
    log: OrderLog,
    from_records: bool,
) -> ModalModel:
    theta = final.parameters
    n = theta.hz.size
    p = outside.hz.size
    sign = np.sign(theta.shapes[np.argmax(np.abs(theta.shapes), axis=0), np.arange(n)])
    sign[sign == 0] = 1
    shapes = np.concatenate([theta.shapes * sign, outside.shapes], axis=1)
    hz, zeta = theta.hz, theta.zeta
    covariance = _model_covariance(final, sign, outside, zeta, max(1.0, misfit if np.isfinite(misfit) else 1.0))
    residual = np.concatenate([(hz > fit_band[1]) | (hz < 0.8 * fit_band[0]), np.ones(p, bool)])
    in_band = np.concatenate([(hz >= band[0]) & (hz <= band[1]), np.zeros(p, bool)]) & ~residual
    findings = list(frf.findings) + fit_findings(frf, dofs, theta.hz, band, log, misfit)
    drive = any(r.same_axis(d) for r in frf.references for d in frf.responses)
    scaled = frf.si and drive and len(log.unseen_hz) < n
    provenance = Provenance.merge(frf.provenance).then(f"fit_ema(band={band}, records={from_records})")
    return ModalModel(
        np.concatenate([hz, outside.hz]),
        np.concatenate([zeta, outside.zeta]),
        shapes,
        dofs,
        "unit_modal_mass" if scaled else "unscaled",
        residual,
        in_band,
        covariance,
        None,
        band,
        None if not np.isfinite(misfit) else float(misfit),
        frf.si,
        tuple(findings),
        provenance,
    )


def _model_covariance(final: Polished, sign: Real, outside: OutsideModes, zeta: Real, inflation: float) -> Real:
    """Covariance in the order and units of ModalModel, inflated by the misfit and with the floors added."""
    theta = final.parameters
    m_dofs, n = theta.shapes.shape
    p = outside.hz.size
    units = np.concatenate([theta.hz, zeta, np.repeat(sign, m_dofs)])
    block = final.covariance * np.outer(units, units) * inflation
    rms = np.sqrt(np.mean(theta.shapes**2, axis=0))
    floor = np.concatenate([FREQUENCY_FLOOR * theta.hz, DAMPING_FLOOR * zeta, np.repeat(SHAPE_FLOOR * rms, m_dofs)]) ** 2
    block[np.diag_indices_from(block)] += floor
    total = n + p
    out = np.zeros((total * (2 + m_dofs), total * (2 + m_dofs)))
    index = np.concatenate([np.arange(n), total + np.arange(n), 2 * total + np.arange(n * m_dofs)])
    out[np.ix_(index, index)] = block
    rest = 2 * total + n * m_dofs + np.arange(p * m_dofs)
    out[np.ix_(rest, rest)] = outside.covariance
    return out


def _opinion(frf: Frf, model: ModalModel) -> tuple[dict[str, Any], ...]:
    from operando.ema.second_opinion import second_opinion

    proper = model.modes_proper()
    # That program knows nothing of the window: it is compared with the damping that the FRFs carry.
    damping = proper.damping_ratios + frf.exponential_window_rate / (2 * np.pi * proper.frequencies_hz)
    return tuple(second_opinion(frf.frequencies_hz, frf.data, proper.frequencies_hz, damping, references=[str(r) for r in frf.references]))
