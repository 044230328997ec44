"""Idle modes that are complex: the fitted model with the damping that ties them, where the idle FRFs ask for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, ModalModel
from operando.diagnosis.criteria import EARNED, EXPLAINED, MOST_CHI_SQUARE, REST_DISCREPANCY, REST_LINES
from operando.diagnosis.force_noise import moved_by_force_noise
from operando.diagnosis.idle import Idle
from operando.diagnosis.poles import poles
from operando.diagnosis.posterior import AtRest, at_rest, on_idle_frfs
from operando.ema.answers import floor_variance
from operando.ema.by_hand import without_doubts
from operando.ema.details import EmaDetails
from operando.ema.findings import misfit_findings
from operando.errors import DataError, DofError
from operando.frf import in_one_sense, opposed_dofs, with_fewer_references
from operando.threads import one_blas_thread

Array = NDArray[Any]
_OF_REAL_MODES = ("complex_modes", "misfit")
_OF_REAL_SHAPES = ("twin", "complex_shape")
"""Doubts of a pole that only real shapes call for: a damper in one place gives close modes nearly one shape, of any phase."""


def with_complex_modes(
    model: ModalModel, frf: Frf, *, band: tuple[float, float] | None = None, progress: Callable[[str], None] | None = None
) -> ModalModel:
    """The idle model with complex modes, where real modes do not explain the idle FRFs and complex ones do.

    A local damper ties modes to each other; then no set of real modes has the FRFs. Damping between modes and the lag of their shapes
    (:class:`operando.ModalCoupling`) are fitted to the FRFs together with frequencies, damping ratios, and shapes, which start from
    the model, where its reduced chi-square is above 1.5 or 1 % of the FRFs and more is left unexplained. Taken where that becomes less
    than 3 %, the evidence is above that of real modes fitted in the same way (MacKay, Neural Computation 4, 1992, 415–447) by as much
    as an effect has to be, and the error on lines that the fit did not use is less than that of the model, which did use them.
    Not tried where the linear stage has the modes in phase: what it leaves real modes leave for another reason.

    Parameters
    ----------
    model : ModalModel
        Real modes of unit modal mass, from :func:`operando.fit_ema`.
    frf : Frf
        Idle FRFs they were fitted to.
    band : (float, float), optional
        Hz; default that of the model.
    progress : callable, optional
        Told what is being done.

    Returns
    -------
    ModalModel
        With ``coupling``, frequencies and damping ratios of the complex poles, and a finding that says what was gained; or the model
        as it was.
    """
    band = band or model.band_hz
    if model.scaling != "unit_modal_mass" or not model.si or model.coupling is not None or band is None or not model.n_modes:
        return model
    if _in_phase(model):
        return model
    with one_blas_thread():
        try:
            return _fitted(model, with_fewer_references(in_one_sense(frf, opposed_dofs(frf))), band, progress)
        except (DataError, DofError, np.linalg.LinAlgError) as error:  # the real modes stand without it
            return replace(model, findings=(*model.findings, _not_tried(error)))


def _in_phase(model: ModalModel) -> bool:
    """Whether the linear stage, whose answer this is, finds less in quadrature at resonance (rms) than real modes may leave."""
    kept = model.details.linear if isinstance(model.details, EmaDetails) and model.details.answer == "linear" else None
    if kept is None:
        return False
    inside = np.isin(kept.frequencies_hz, model.frequencies_hz[model.in_band])
    parts = np.array([e.quadrature for e in kept.evidence])[inside]
    return bool(parts.size and np.sqrt(np.mean(parts**2)) < REST_DISCREPANCY)


def _fitted(model: ModalModel, frf: Frf, band: tuple[float, float], progress: Callable[[str], None] | None) -> ModalModel:
    """The model with complex modes where they are better, else as it was."""
    tied = without_doubts(model, _OF_REAL_SHAPES)
    known = Idle.of(tied, band, frf.references)
    beyond_noise = model.misfit is not None and model.misfit > MOST_CHI_SQUARE
    rest = at_rest(known, frf, band, again=beyond_noise)
    if not rest.again or rest.state.alpha > EXPLAINED:
        return model
    if progress is not None:
        progress("complex modes")
    real = known.loose(np.flatnonzero(known.driven), band, complex_modes=False)
    plain = on_idle_frfs(real, frf, band, REST_LINES, rest.correlated, True)
    if rest.state.log_evidence < plain.log_evidence + EARNED:
        return model
    found = _tied(tied, rest.idle, moved_by_force_noise(rest.state))
    (before, _), (after, chi) = (_left(m, rest) for m in (model, found))
    if not after < before:
        return model
    kept = tuple(f for f in tied.findings if f.kind not in _OF_REAL_MODES)
    return replace(found, misfit=chi, findings=(*kept, _finding(before, after), *misfit_findings(chi)))


def _left(model: ModalModel, rest: AtRest) -> tuple[float, float]:
    """What a model leaves of lines that the complex modes were not fitted to: error [dB, rms], and chi-square per value under noise."""
    lines, forward, dofs = rest.state.case.lines, rest.state.case.forward, rest.state.case.dofs
    at = lines.validation
    rows, columns = ([dofs[i] for i in numbers] for numbers in (forward.responses, forward.references))
    h = np.moveaxis(model.frf(lines.w[at] / 2 / np.pi, rows, columns, "receptance", False).data, 2, 0)
    chi = np.abs(h - lines.h[at])[:, lines.there] ** 2 / lines.variance[at][:, lines.there]
    return lines.error(h, at), float(chi.mean())


def _tied(model: ModalModel, idle: Idle, by_force_noise: tuple[Array, Array]) -> ModalModel:
    """The model as an idle model has it, told by its poles, with its covariance and what the noise of the forces adds to that."""
    n, m = model.terms.n, len(model.dofs)
    form, slopes = poles(idle)
    shared = np.concatenate([slopes, np.swapaxes(idle.shapes.shared, 0, 1).reshape(n * m, -1)])
    by_g, by_own = by_force_noise
    covariance, by_force = shared @ shared.T, shared @ by_g
    at = 2 * n + np.arange(n) * m
    for dof, own in enumerate(idle.shapes.own):
        covariance[np.ix_(at + dof, at + dof)] += own @ own.T
        by_force[at + dof] += own @ by_own[dof]
    covariance += by_force @ by_force.T
    modes = np.concatenate([np.tile(~model.terms.residual, 2), np.repeat(~model.terms.residual, m)])
    covariance[np.diag_indices_from(covariance)] += modes * floor_variance(form.frequencies_hz, form.damping_ratios, idle.phi)
    if model.covariance is not None:  # poles outside the band were held where they were
        held = np.flatnonzero(~model.terms.residual & ~model.terms.in_band)
        held = np.concatenate([held, n + held])
        covariance[np.ix_(held, held)] += model.covariance[np.ix_(held, held)]
    return model.with_terms(
        frequencies_hz=form.frequencies_hz,
        damping_ratios=form.damping_ratios,
        shapes=idle.phi,
        covariance=covariance,
        std=None,
        coupling=form.coupling,
    )


def _not_tried(error: Exception) -> Finding:
    return Finding(
        "complex_modes_not_tried",
        f"complex modes cannot be fitted to these idle FRFs: {str(error).split(' (')[0]}",
        "info",
        consequence="the idle model has real modes",
        action="measure all pairs on the same lines, if modes may be complex",
    )


def _finding(before: float, after: float) -> Finding:
    return Finding(
        "complex_modes",
        "modes are complex: with damping that ties them, the error on lines of the idle FRFs that the fit did not use falls "
        f"from {before:.2g} to {after:.2g} dB",
        "info",
        consequence="frequencies and damping ratios are those of the complex modes, the shapes stated those without damping; "
        "what ties the modes counts as known in the variance of FRFs",
        action="local dampers look like this; the hybrid route holds real modes, the model with effects holds complex ones",
    )
