"""Experimental modal analysis in one call: from FRFs and raw records to modes of unit modal mass with their covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, ModalModel, TimeRecord, bands_of, count_of, expect, frequencies_of, several
from operando.dof import Dof, DofIndex
from operando.ema.answers import LinearModes, linear_model, linear_modes, polished_model
from operando.ema.band import analysis_band
from operando.ema.by_hand import AddModes, modes_by_hand
from operando.ema.candidates import Candidate, candidate_poles, stabilization_diagram
from operando.ema.choose import ChoiceLog, choose_modes
from operando.ema.close_pairs import separated
from operando.ema.details import EmaDetails
from operando.ema.doubts import evidence_of_modes, unknown_to
from operando.ema.findings import (
    DriveResidues,
    drive_residues,
    fit_findings,
    linear_findings,
    misfit_findings,
    quantity_finding,
    turned_finding,
    unfinished_finding,
)
from operando.ema.frf_noise import frf_noise
from operando.ema.handed_out import left_of
from operando.ema.linear import MAX_DAMPING, NOISE_LIMITED, LinearFit, fit_linear
from operando.ema.order import UnseenModesError
from operando.ema.pairs import Pairs, Real, frf_pairs, informative_lines, with_values
from operando.ema.polished import polish_runs, polish_work, polished_answer
from operando.ema.projection import Poles, project
from operando.ema.spectra import RunSpectra, whole_records
from operando.ema.unit_mass import UnitMassShapes, tied_rows, turned_dofs, unit_mass_shapes
from operando.errors import DataError, IdentificationError
from operando.limits import LOWER, UPPER
from operando.stabilization import RejectedPole, Stabilization
from operando.threads import one_blas_thread

ANSWERS = ("auto", "linear", "polished")

MIN_SUPPORT = 0.3
"""Share of linear fits (times their orders) that a starting pole of the linear stage needs."""

POLISH_SUPPORT = 0.4
"""The same for the maximum-likelihood fit, which searches for weaker ones by its residuals."""

POLISH_WORK = 4e12
"""Largest work of a polish that is begun by itself, in floating-point operations: about two minutes of one core."""

ACCEPTED_MISFIT = 3.0
"""Reduced chi-square on unused lines up to which a polished answer is taken without a look at the linear one's."""


@dataclass(frozen=True)
class _Job:
    """What one identification works on."""

    frf: Frf
    dofs: tuple[Dof, ...]
    band: tuple[float, float]
    exclude_bands: tuple[tuple[float, float], ...]
    records: tuple[TimeRecord, ...]
    answer: str
    progress: Callable[[str], None] | None
    weights: Real | None

    def say(self, text: str) -> None:
        if self.progress is not None:
            self.progress(text)


def fit_ema(
    frf: Frf,
    *,
    band: tuple[float, float] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    max_order: int | None = None,
    records: Sequence[TimeRecord] | None = None,
    ema: str = "auto",
    modes_hz: float | Sequence[float] = (),
    select_hz: float | Sequence[float] = (),
    reject_hz: float | Sequence[float] = (),
    automatic: ModalModel | None = None,
    second_opinion: bool = False,
    progress: Callable[[str], None] | None = None,
) -> ModalModel:
    """Identify the modes of the structure at rest.

    Poly-reference least-squares complex frequency fits of the FRFs (Peeters et al. 2004) over the band and its parts give candidate
    poles. The linear stage fits them with free complex residues in each pair, under noise and an error in proportion to the FRF that
    it estimates, and says which are modes. Where noise is what limits it, a maximum-likelihood fit of real modes of unit modal mass, on
    the spectra of the whole records where they are given, else on the FRFs with their variances, polishes the answer. What lies
    outside the band becomes residual terms, so that undriven FRF columns are predicted too.

    Parameters
    ----------
    frf : Frf
        FRF matrix; any number of responses and references, also more references than responses (roving hammer).
    band : (float, float), optional
        Analysis band [Hz]; default: the lines of the FRF without those at the edges. It ends with the last line of the FRFs, and a
        finding says where less is used than was asked for.
    exclude_bands : sequence of (float, float)
        Lines inside these bands [Hz] are not used, of the FRFs nor of the records.
    max_order : int, optional
        Order of the linear fit shown in the stabilisation diagram; the modes do not depend on it. Where the lines do not allow for such an
        order, there is no diagram, and a finding says so.
    records : sequence of TimeRecord, optional
        Raw runs behind the FRFs: forces and responses. Runs with a single hit are fitted through their FRFs.
    ema : {"auto", "linear", "polished"}
        Which answer to give; "auto" polishes where the model error is below 1 % and the work within two minutes or so.
    modes_hz : float or sequence of float
        Exactly these modes [Hz]: the nearest stable pole of each, within 1 % of it.
    select_hz, reject_hz : float or sequence of float
        Modes beside the automatic ones, and modes without the one nearest to each [Hz].
    automatic : ModalModel, optional
        What this function returned for the same data without settings by hand: they are then answered from its kept candidates.
    second_opinion : bool
        Ask sdypy-EMA as well.
    progress : callable, optional
        Told one line now and then.

    Returns
    -------
    ModalModel
        Real shapes; ``scaling`` is ``unit_modal_mass`` where units are known and a drive point gives the scale, else ``unscaled``.
        ``misfit`` is that of this model on lines the fit did not use; ``details`` is an :class:`EmaDetails`.

    Raises
    ------
    IdentificationError
        If the band holds too few lines, no mode is found, no pole is near a frequency named by hand, or two reach one pole.
    DataError
        If records and FRFs do not belong together, all FRFs are zero, ``ema`` is unknown or ``max_order`` is no count.

    Examples
    --------
    >>> import numpy as np, operando
    >>> model = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> operando.fit_ema(model.frf(np.arange(5, 80, 0.1), references="1+Z"), band=(10, 70)).frequencies_hz.round(2)
    array([20., 45.])
    """
    expect(frf, Frf, "modes are identified from FRFs", "estimate_frf(records) makes them of records, read(file).frfs holds measured ones")
    if automatic is not None:
        expect(automatic, ModalModel, "automatic is the model that other modes are chosen in", "give what fit_ema(frf) returned")
    exact, more = frequencies_of(modes_hz, "modes_hz"), frequencies_of(select_hz, "select_hz")
    less = frequencies_of(reject_hz, "reject_hz")
    max_order, excluded = count_of(max_order, "max_order", 60), bands_of(exclude_bands, "exclude_bands")
    if records is not None:
        records = several(records, TimeRecord, "the whole records are fitted", "give those the FRFs were estimated from")
    if not isinstance(ema, str) or ema not in ANSWERS:
        raise DataError(f"ema = {ema!r:.60} is not known", hint="one of " + ", ".join(ANSWERS))
    with one_blas_thread():
        given = frf
        frf, lost = with_values(given.without_bands(excluded))
        frf = frf.to_quantity("accelerance")
        band, beyond = analysis_band(given, frf.frequencies_hz, band)
        records = whole_records(records)
        job = _Job(frf, model_dofs(frf), band, excluded, tuple(records or ()), ema, progress, _weights(frf))
        model = automatic
        if model is None or not isinstance(model.details, EmaDetails) or ema not in ("auto", model.details.answer):
            model = _identify(job, max_order)
        if not model.n_modes:
            low, high = job.band
            hint = "widen the band, check the FRFs, or name modes by modes_hz"
            raise IdentificationError(f"no mode is found between {low:g} and {high:g} Hz", hint=hint)
        if exact or more or less:
            model = modes_by_hand(model, exact, more, less, _exactly(job))
        model = replace(model, findings=(*model.findings, *(f for f in (*lost, *beyond) if f not in model.findings)))
        if second_opinion:
            from operando.ema.second_opinion import opinion_on

            model = replace(model, details=replace(model.details, second_opinion=opinion_on(frf, model)))
        return model


def model_dofs(frf: Frf) -> tuple[Dof, ...]:
    """DOFs of the model: the responses, then references that are not among them."""
    have = DofIndex(frf.responses)
    return (*frf.responses, *(d for d in frf.references if d not in have))


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


def _identify(job: _Job, max_order: int | None) -> ModalModel:
    """The automatic answer."""
    f = job.frf.frequencies_hz
    ends = float(max(LOWER * job.band[0], f[f > 0][0])), float(min(UPPER * job.band[1], f[-1]))
    runs: list[RunSpectra] = []
    fit_band = ends
    if job.records:
        runs, fit_band = polish_runs(job.frf, job.dofs, job.band, job.records, job.exclude_bands)
    candidates = candidate_poles(f, np.nan_to_num(job.frf.data), job.weights, fit_band, window_rate=job.frf.exponential_window_rate)
    pairs = frf_pairs(job.frf, job.dofs, ends)
    start = _starting_poles(candidates, ends)
    if not start.hz.size:
        raise IdentificationError(
            f"no stable pole between {ends[0]:g} and {ends[1]:g} Hz", hint="widen the band, check the FRFs, or name modes by modes_hz"
        )
    pairs, findings = _right_quantity(pairs, start)
    fit, log = choose_modes(pairs, start, job.band, progress=job.progress)
    return _answer(job, pairs, fit, log, tuple(candidates), runs, fit_band, max_order, findings)


@dataclass(frozen=True)
class _Outcome:
    """One of the two answers, with what the details tell of it alone."""

    model: ModalModel
    poles: tuple[Real, Real, Real]  # frequencies, damping ratios, shapes of the modes
    details: EmaDetails
    findings: list[Finding]


def _answer(
    job: _Job,
    pairs: Pairs,
    fit: LinearFit,
    log: ChoiceLog,
    candidates: tuple[Candidate, ...],
    runs: list[RunSpectra],
    fit_band: tuple[float, float],
    max_order: int | None,
    findings: list[Finding],
) -> ModalModel:
    """The linear answer, and the polished one in its place where that is wanted."""
    turned = turned_dofs(fit)
    if turned.size:
        pairs = pairs.turned(turned)
        fit = fit.turned(turned)
    whole, fit = fit, separated(replace(fit, noise=frf_noise(pairs, fit)))
    evidence = evidence_of_modes(fit)
    mass = unit_mass_shapes(fit, len(job.dofs))
    kept = linear_modes(fit, pairs, job.band, evidence, mass.scaled)
    signs = drive_residues(fit, mass, np.array([not e.doubts for e in evidence]))
    wanted, reason = _polish_wanted(job, fit)
    found: _Outcome | None = None
    if wanted:
        found, reason = _polished(job, pairs, fit, log, candidates, runs, fit_band, reason, signs)
    answer = "linear" if found is None else "polished"
    if found is None:
        found = _linear(job, pairs, (fit, whole), log, kept, mass, turned, signs)
    stabilization = _diagram(job, found.details.fit_band_hz, max_order, found.findings, *found.poles)
    rejected = (*found.details.rejected, *(() if stabilization is None else stabilization.rejected))
    details = replace(
        found.details,
        stabilization=stabilization,
        rejected=rejected,
        answer=answer,
        answer_reason=reason,
        linear=kept,
        candidates=candidates,
    )
    return replace(found.model, findings=(*found.model.findings, *findings, *found.findings), details=details)


def _polished(
    job: _Job,
    pairs: Pairs,
    fit: LinearFit,
    log: ChoiceLog,
    candidates: tuple[Candidate, ...],
    runs: list[RunSpectra],
    fit_band: tuple[float, float],
    reason: str,
    signs: DriveResidues,
) -> tuple[_Outcome | None, str]:
    """The maximum-likelihood answer, or None and why it is not taken: too much work, or worse on unused lines than the linear stage."""
    if not runs:
        runs, fit_band = polish_runs(job.frf, job.dofs, job.band, None, noise=fit.noise)
    first = [(c.frequency_hz, c.damping_ratio) for c in candidates if c.prominent and c.support > POLISH_SUPPORT]
    hz, zeta = _distinct(first) if first else (fit.poles.hz, fit.poles.zeta)
    work = polish_work(runs, len(job.dofs), hz.size)
    if job.answer == "auto" and work > POLISH_WORK:
        minutes = 2 * work / POLISH_WORK
        return None, f'polishing would take about {minutes:.0f} minutes, two are allowed; ema = "polished" does it'
    unseen = (lambda places: unknown_to(fit, places, job.band)) if job.answer == "auto" else None
    try:
        answer = polished_answer(runs, job.dofs, job.band, hz, zeta, progress=job.progress, unseen=unseen)
        if unseen is not None and (new := unseen(answer.fit.parameters.hz)):
            raise UnseenModesError(new)
    except UnseenModesError as more:
        listed = ", ".join(f"{h:.4g}" for h in more.hz)
        return None, f"polished, real modes of one scale need others beside those that the linear stage sees (near {listed} Hz)"
    if job.answer == "auto" and pairs.noise_known and not answer.free_misfit < ACCEPTED_MISFIT:
        left = left_of(pairs, fit, job.band, len(job.dofs))
        if left is None or not answer.free_misfit < left.free:
            linear = float("nan") if left is None else left.free
            chi = f"the reduced chi-square on unused lines is {answer.free_misfit:.3g}"
            return None, f"polished, {chi}; by the linear stage it is {linear:.3g}"
    theta = answer.fit.parameters
    drive = any(r.same_axis(d) for r in job.frf.references for d in job.frf.responses)
    scaled = job.frf.si and drive and len(answer.log.unseen_hz) < theta.hz.size
    said = [*fit_findings(job.frf, job.band, signs), *misfit_findings(answer.misfit, answer.free_misfit, {"outside": answer.misfit})]
    details = EmaDetails(
        None,
        tuple(answer.log.rejected),
        (*log.rounds, *answer.log.rounds),
        fit_band,
        answer.misfit_by_row[tied_rows(job.frf)],
        answer.fit.cost / answer.fit.n_data,
        answer.fit.converged,
        answer.lower,
        free_misfit=answer.free_misfit,
    )
    model = polished_model(job.frf, job.dofs, answer, job.band, fit_band, scaled)
    said += [turned_finding(str(job.dofs[row])) for row in answer.turned]
    if not answer.fit.converged:
        said.append(unfinished_finding(answer.fit.iterations, answer.fit.cost / answer.fit.n_data))
    return _Outcome(model, (theta.hz, theta.zeta, theta.shapes), details, said), reason


def _linear(
    job: _Job,
    pairs: Pairs,
    fits: tuple[LinearFit, LinearFit],
    log: ChoiceLog,
    kept: LinearModes,
    mass: UnitMassShapes,
    turned: NDArray[np.int_],
    signs: DriveResidues,
) -> _Outcome:
    """The linear stage's answer: modes without doubts. The second fit, before close modes were parted, is compared with unused lines."""
    fit, whole = fits
    nothing = float("nan")
    left = left_of(pairs, whole, job.band, len(job.dofs)) if pairs.noise_known else None
    misfit = nothing if left is None else left.misfit
    model = linear_model(job.frf, job.dofs, fit, list(kept.evidence), mass, job.band, misfit, bool(job.frf.si and mass.scaled.any()))
    sure = np.array([not e.doubts for e in kept.evidence])
    doubtful = [
        RejectedPole(float(h), float(z), e.doubts[0][0], "; ".join(text for _, text in e.doubts))
        for h, z, e in zip(fit.mean_hz, fit.poles.zeta, kept.evidence, strict=True)
        if e.doubts
    ]
    undriven = len(job.dofs) - np.unique(fit.pairs.columns).size
    details = EmaDetails(
        None,
        (*doubtful, *log.rejected),
        tuple(log.rounds),
        fit.ends_hz,
        (np.full(len(job.dofs), np.nan) if left is None else left.by_row)[tied_rows(job.frf)],
        float(np.mean(np.abs(fit.projection.error) ** 2 / fit.variance.plain)),
        converged=True,
        lower_residual=True,
        free_misfit=nothing if left is None else left.free,
    )
    findings = [
        *fit_findings(job.frf, job.band, signs),
        *([] if left is None else misfit_findings(left.misfit, left.free, left.parts)),
        *linear_findings(kept, job.band, undriven if model.n_residuals < undriven else 0),
        *(turned_finding(str(job.dofs[row])) for row in turned),
    ]
    return _Outcome(model, (fit.mean_hz[sure], fit.poles.zeta[sure], mass.shapes[:, sure]), details, findings)


def _polish_wanted(job: _Job, fit: LinearFit) -> tuple[bool, str]:
    """Whether to polish, and why or why not."""
    error = f"{100 * fit.model_error:.2g} % of the FRFs"
    if job.answer != "auto":
        return job.answer == "polished", f"ema = {job.answer!r}"
    if not (job.records or fit.pairs.noise_known):
        return False, "the FRFs come without coherence: their noise is not known well enough to weigh every line by it"
    if not fit.noise_limited:
        return False, f"the model error is {error}: a likelihood of noise alone would bend the modes"
    if (moved := fit.shift_error(job.band)) > NOISE_LIMITED:
        shift = f"{100 * moved:.2g} % of a half bandwidth"
        return False, f"modes differ between the pairs by {shift}: poles common to all would err by as much of the FRF at a resonance"
    return True, f"noise limits the fit (model error {error})"


def _starting_poles(candidates: Sequence[Candidate], ends: tuple[float, float]) -> Poles:
    """Prominent candidates, strongest first, none nearer than 0.35 half bandwidths to a stronger one; by rising frequency."""
    taken: list[Candidate] = []
    for c in sorted((c for c in candidates if c.prominent and c.support > MIN_SUPPORT), key=lambda c: -c.support):
        width = [0.35 * min(c.damping_ratio * c.frequency_hz, t.damping_ratio * t.frequency_hz) for t in taken]
        inside = 0.95 * ends[0] <= c.frequency_hz <= 1.05 * ends[1]
        if inside and all(abs(c.frequency_hz - t.frequency_hz) > w for t, w in zip(taken, width, strict=True)):
            taken.append(c)
    taken.sort(key=lambda c: c.frequency_hz)
    return Poles(np.array([c.frequency_hz for c in taken]), np.clip(np.array([c.damping_ratio for c in taken]), 1e-5, MAX_DAMPING))


def _distinct(poles: list[tuple[float, float]]) -> tuple[Real, Real]:
    out: list[tuple[float, float]] = []
    for h, z in sorted(poles):
        if out and abs(h - out[-1][0]) < 1e-4 * h:
            continue
        out.append((h, z))
    return np.array([h for h, _ in out]), np.array([z for _, z in out])


def _right_quantity(pairs: Pairs, start: Poles) -> tuple[Pairs, list[Finding]]:
    """FRFs whose residues stand at 90° are no accelerances: taken for mobilities, which they most likely are.

    Each mode with equal weight: mean over the modes of Σ R²/Σ|R|², 1 for real residues, −1 for residues rotated by 90°.
    """
    thinned = pairs.lines(informative_lines(pairs.frequencies_hz, start.hz, start.zeta))
    ends = float(pairs.frequencies_hz[0]), float(pairs.frequencies_hz[-1])
    variance = thinned.noise + 0.05**2 * np.abs(thinned.accelerance) ** 2
    fit = project(thinned, start, variance, None, ends, with_slopes=False)
    residues = fit.a + 1j * fit.b
    strength = fit.evidence.sum(axis=0)
    clear = strength > 0.01 * strength.max()
    phase = np.sum(residues**2, axis=0) / np.maximum(np.sum(np.abs(residues) ** 2, axis=0), 1e-300)
    if float(np.mean(phase[clear].real)) > -0.5:
        return pairs, []
    factor = 2j * np.pi * pairs.frequencies_hz + pairs.window_rate
    turned = replace(pairs, accelerance=pairs.accelerance * factor, noise=pairs.noise * np.abs(factor) ** 2)
    return turned, [quantity_finding("mobilities, and multiplied by iω")]


def _exactly(job: _Job) -> AddModes:
    """Linear fits of exactly the poles given."""

    def add(hz: Real, zeta: Real) -> tuple[LinearFit, UnitMassShapes]:
        f = job.frf.frequencies_hz
        ends = float(max(LOWER * job.band[0], f[f > 0][0])), float(min(UPPER * job.band[1], f[-1]))
        poles = Poles(hz, np.clip(zeta, 1e-5, MAX_DAMPING))
        pairs, _ = _right_quantity(frf_pairs(job.frf, job.dofs, ends), poles)
        fit = fit_linear(pairs.lines(informative_lines(pairs.frequencies_hz, hz, zeta)), poles, ends, rounds=3)
        turned = turned_dofs(fit)
        if turned.size:
            fit = fit.turned(turned)
        return fit, unit_mass_shapes(fit, len(job.dofs)).at(tied_rows(job.frf))

    return add


def _diagram(
    job: _Job, fit_band: tuple[float, float], max_order: int | None, findings: list[Finding], hz: Real, zeta: Real, shapes: Real
) -> Stabilization | None:
    data = np.nan_to_num(job.frf.data)
    order = int(max_order) if max_order else int(np.clip(np.ceil(6 * hz.size / min(data.shape[:2])), 10, 80))
    try:
        rate = job.frf.exponential_window_rate
        diagram = stabilization_diagram(job.frf.frequencies_hz, data, max_order=order, weights=job.weights, band=fit_band, window_rate=rate)
    except IdentificationError as error:
        findings.append(Finding(
            "no_diagram", f"no stabilisation diagram of order {order} can be made: {error.message}", "info", band_hz=fit_band,
            consequence="the modes do not depend on it", action="give a lower max_order" if max_order else "",
        ))  # fmt: skip
        return None
    members = tuple(np.flatnonzero(np.abs(diagram.table.frequency_hz - h) < 0.003 * h) for h in hz)
    # What the linear diagram rejected but the refined fit took is not rejected.
    rejected = tuple(r for r in diagram.rejected if not np.any(np.abs(hz - r.frequency_hz) < 0.005 * hz))
    return replace(diagram, selected_hz=hz, selected_damping=zeta, selected_vectors=shapes, selected_members=members, rejected=rejected)
