"""Idle modes that are complex: the fitted model with the damping that ties them, where the idle FRFs ask for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, ModalCoupling, ModalModel
from operando.data.modal_poles import pole_form
from operando.diagnosis.criteria import EARNED, EXPLAINED, REST_LINES
from operando.diagnosis.idle import Idle
from operando.diagnosis.posterior import AtRest, at_rest, left_on, on_idle_frfs
from operando.ema.findings import misfit_findings
from operando.threads import one_blas_thread

Array = NDArray[Any]
_OF_REAL_MODES = ("complex_modes", "misfit")


def with_complex_modes(
    model: ModalModel, frf: Frf, *, band: tuple[float, float] | None = None, progress: Callable[[str], None] | None = None
) -> ModalModel:
    """The idle model with complex modes, where real modes do not explain the idle FRFs and complex ones do.

    A local damper ties modes to each other; then no set of real modes has the FRFs. Damping between modes and the lag of their shapes
    (:class:`operando.ModalCoupling`) are fitted to the FRFs together with frequencies, damping ratios, and shapes, which start from
    the model. Taken where less than 3 % of the FRFs is left unexplained, the evidence is above that of real modes fitted in the same
    way (MacKay, Neural Computation 4, 1992, 415–447) by as much as an effect has to be, and the error on lines that the fit did not
    use is less than that of the model, which did use them.

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
    with one_blas_thread():
        known = Idle.of(model, band, frf.references)
        rest = at_rest(known, frf, band)
        if not rest.again or rest.state.alpha > EXPLAINED:
            return model
        if progress is not None:
            progress("complex modes")
        real = known.loose(np.flatnonzero(known.driven), complex_modes=False)
        plain = on_idle_frfs(real, frf, band, REST_LINES, rest.correlated, True)
        before, after = _errors(model, rest)
        better = rest.state.log_evidence > plain.log_evidence + EARNED and after < before
        return _tied(model, rest, before, after) if better else model


def _errors(model: ModalModel, rest: AtRest) -> tuple[float, float]:
    """Errors of the real and the complex modes on the lines that the latter were not fitted to [dB, rms]."""
    state = rest.state
    lines, forward = state.case.lines, state.case.forward
    at = lines.validation
    dofs = state.case.dofs
    real = model.frf(
        lines.w[at] / 2 / np.pi, [dofs[i] for i in forward.responses], [dofs[i] for i in forward.references], "receptance", False
    )
    return lines.error(np.moveaxis(real.data, 2, 0), at), lines.error(forward.predict(state.x, lines.w[at], derivatives=False).h, at)


def _tied(model: ModalModel, rest: AtRest, before: float, after: float) -> ModalModel:
    """The model as the fit with complex modes has it, told by its poles."""
    idle, n, m = rest.idle, model.terms.n, len(model.dofs)
    modes, (first, second) = idle.modes, np.triu_indices(idle.modes.size, 1)
    first, second = modes[first], modes[second]
    loss = 2 * idle.zeta * 2 * np.pi * idle.f
    scale = np.sqrt(loss[first] * loss[second])
    damping, lag = np.zeros((n, n)), np.zeros((m, n))
    damping[first, second] = idle.between * scale
    lag[:, modes] = idle.lag
    terms = replace(
        model.terms,
        frequencies_hz=idle.f,
        damping_ratios=idle.zeta,
        shapes=idle.phi,
        covariance=None,
        std=None,
        coupling=ModalCoupling(damping + damping.T, lag),
    )
    form = pole_form(terms)
    assert form is not None
    by_between = 2 * form.by_damping[:, first, second] * scale  # both triangles
    poles = form.by_terms @ np.concatenate([idle.f_root, idle.zeta_root]) + by_between @ idle.between_root
    shared = np.concatenate([poles, np.swapaxes(idle.shapes.shared, 0, 1).reshape(n * m, -1)])
    covariance = shared @ shared.T
    at = 2 * n + np.arange(n) * m
    for dof, own in enumerate(idle.shapes.own):
        covariance[np.ix_(at + dof, at + dof)] += own @ own.T
    chi = left_on(rest.state.case, rest.state.x, 0.0, rest.state.case.lines.validation)[0]
    kept = tuple(f for f in model.findings if f.kind not in _OF_REAL_MODES)
    return model.with_terms(
        frequencies_hz=form.frequencies_hz,
        damping_ratios=form.damping_ratios,
        shapes=idle.phi,
        covariance=covariance,
        std=None,
        coupling=form.coupling,
        misfit=chi,
        findings=(*kept, _finding(before, after), *misfit_findings(chi)),
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
