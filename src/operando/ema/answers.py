"""From either answer of the modal analysis, linear or polished, to a modal model with its covariance and residual terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, ModalModel, Provenance
from operando.dof import Dof
from operando.ema.doubts import Evidence
from operando.ema.frf_noise import stated_covariance
from operando.ema.linear import LinearFit
from operando.ema.outside import OutsideModes, outside_modes
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.polish import Polished
from operando.ema.polish_model import OUTSIDE_DAMPING, Parameters
from operando.ema.polished import PolishedAnswer
from operando.ema.projection import basis, tail_columns
from operando.ema.spectra import RunSpectra
from operando.ema.start import LOWER_FACTORS, OUTSIDE_FACTORS
from operando.ema.unit_mass import ModalCovariance, UnitMassShapes, kept_parameters, tied_rows
from operando.synthesis import combined, real_inner

FREQUENCY_FLOOR = 1e-6
DAMPING_FLOOR = 1.3e-4
SHAPE_FLOOR = 1.3e-4
"""Relative standard deviations that no likelihood sees: clock and filters of a measurement chain, the integrator of a simulated one."""

CORE_DOFS = 16
"""DOFs whose residual terms are fitted together; the others follow from these row by row."""

MOST_PARAMETERS = 4000
"""Largest covariance that is kept whole (128 MB): beyond it the own compliance of undriven DOFs is left out of the residual terms."""


def floor_variance(hz: Real, zeta: Real, shapes: Real) -> Real:
    """Variance of [f; ζ; shapes mode by mode] that no likelihood sees, (2n + n m,)."""
    rms = np.sqrt(np.mean(shapes**2, axis=0))
    return np.asarray(np.concatenate([FREQUENCY_FLOOR * hz, DAMPING_FLOOR * zeta, np.repeat(SHAPE_FLOOR * rms, len(shapes))]) ** 2)


@dataclass(frozen=True)
class LinearModes:
    """The linear stage's own answer, kept beside the polished one.

    Poles are with doubts included; ``scaled`` says which modes a drive point scales. ``model_error`` is α, the median over the pairs of the
    error in proportion to the FRF, ``correlation`` ν, lines that count as one, and ``sensor_offset`` what an offset of the sensors (1/s),
    which no structure has, is of the FRFs: median over lines and pairs.
    """

    frequencies_hz: Real
    damping_ratios: Real
    frequency_std_hz: Real
    damping_ratio_std: Real
    evidence: tuple[Evidence, ...]
    scaled: NDArray[np.bool_]
    model_error: float
    correlation: float
    sensor_offset: float

    def to_dict(self) -> dict[str, Any]:
        """JSON object, one entry a pole."""
        poles = [
            {
                "frequency_hz": float(self.frequencies_hz[k]),
                "frequency_std_hz": float(self.frequency_std_hz[k]),
                "damping_ratio": float(self.damping_ratios[k]),
                "damping_ratio_std": float(self.damping_ratio_std[k]),
                "scaled": bool(self.scaled[k]),
                "evidence": e.evidence,
                "rank_share": e.rank_share,
                "collinearity": e.collinearity,
                "dominance": e.dominance,
                "quadrature": e.quadrature,
                "drift": e.drift,
                "doubts": [{"code": code, "reason": reason} for code, reason in e.doubts],
            }
            for k, e in enumerate(self.evidence)
        ]
        return {"poles": poles, "model_error": self.model_error, "correlated_lines": self.correlation, "sensor_offset": self.sensor_offset}


def linear_modes(
    fit: LinearFit, pairs: Pairs, band: tuple[float, float], evidence: list[Evidence], scaled: NDArray[np.bool_]
) -> LinearModes:
    """What is kept of the linear stage; ``pairs`` with all lines."""
    std = np.sqrt(np.diag(stated_covariance(fit)))
    return LinearModes(
        fit.mean_hz,
        fit.poles.zeta,
        fit.poles.hz * std[: fit.n_modes],
        fit.poles.zeta * std[fit.n_modes :],
        tuple(evidence),
        scaled,
        fit.model_error,
        fit.correlation,
        fit.sensor_offset(pairs, band),
    )


def _assemble(
    frf: Frf,
    dofs: tuple[Dof, ...],
    band: tuple[float, float],
    poles: tuple[Real, Real],
    shapes: Real,
    covariance: Real | ModalCovariance,
    outside: OutsideModes,
    residual: NDArray[np.bool_],
    misfit: float,
    scaled: bool,
    how: str,
) -> ModalModel:
    """The model: modes (each with its largest shape value positive), poles that are no modes, and terms for what lies outside."""
    hz, zeta = poles
    m, n = shapes.shape
    tied = tied_rows(frf)
    sign = np.sign(shapes[tied][np.argmax(np.abs(shapes[tied]), axis=0), np.arange(n)])
    sign[sign == 0] = 1
    units = np.concatenate([np.ones(2 * n), np.repeat(sign, m)])
    floor = floor_variance(hz, zeta, shapes)
    total = n + outside.hz.size
    whole = np.zeros((total * (2 + m), total * (2 + m)))
    # frequencies, damping ratios and shape values of the modes, and where they stand among those of all terms
    parts, places = (
        (slice(n), slice(n, 2 * n), slice(2 * n, None)),
        (slice(n), slice(total, total + n), slice(2 * total, 2 * total + n * m)),
    )
    if isinstance(covariance, ModalCovariance):
        covariance.fill(whole, places, units)
    else:
        for i, row in zip(parts, places, strict=True):
            for j, column in zip(parts, places, strict=True):
                np.multiply(covariance[i, j], units[j], out=whole[row, column])
                whole[row, column] *= units[i, None]
    for i, row in zip(parts, places, strict=True):
        whole[row, row][np.diag_indices(floor[i].size)] += floor[i]
    rest = 2 * total + n * m + np.arange(outside.hz.size * m)
    whole[np.ix_(rest, rest)] = outside.covariance
    in_band = (hz >= band[0]) & (hz <= band[1]) & ~residual
    p = outside.hz.size
    kept = kept_parameters(total, m, tied)
    return ModalModel.from_terms(
        np.concatenate([hz, outside.hz]),
        np.concatenate([zeta, outside.zeta]),
        np.concatenate([shapes * sign, outside.shapes], axis=1)[tied],
        dofs[tied],
        "unit_modal_mass" if scaled else "unscaled",
        residual=np.concatenate([residual, np.ones(p, bool)]),
        in_band=np.concatenate([in_band, np.zeros(p, bool)]),
        covariance=whole if kept.size == len(whole) else whole[np.ix_(kept, kept)],
        band_hz=band,
        misfit=None if not np.isfinite(misfit) else float(misfit),
        si=frf.si,
        findings=frf.findings,
        provenance=Provenance.merge(frf.provenance).then(f"fit_ema(band={band}, {how})"),
    )


def polished_model(
    frf: Frf, dofs: tuple[Dof, ...], answer: PolishedAnswer, band: tuple[float, float], fit_band: tuple[float, float], scaled: bool
) -> ModalModel:
    """Model of the maximum-likelihood fit; its covariance is inflated by the reduced chi-square of the fit on unused lines."""
    theta = answer.fit.parameters
    m, n = theta.shapes.shape
    units = np.concatenate([theta.hz, theta.zeta, np.ones(n * m)])
    inflation = max(1.0, answer.free_misfit if np.isfinite(answer.free_misfit) else 1.0)
    covariance = answer.fit.covariance * np.outer(units, units) * inflation
    residual = (theta.hz > fit_band[1]) | (theta.hz < 0.8 * fit_band[0])
    poles = theta.hz, theta.zeta
    return _assemble(frf, dofs, band, poles, theta.shapes, covariance, answer.outside, residual, answer.misfit, scaled, "polished")


def linear_model(
    frf: Frf,
    dofs: tuple[Dof, ...],
    fit: LinearFit,
    evidence: list[Evidence],
    mass: UnitMassShapes,
    band: tuple[float, float],
    misfit: float,
    scaled: bool,
) -> ModalModel:
    """Model of the linear stage: modes without doubts; the other poles are residual terms."""
    outside, terms = linear_outside(fit, mass, band), np.flatnonzero(~without_shape(fit, mass))
    residual = np.array([bool(evidence[k].doubts) for k in terms])
    poles = fit.mean_hz[terms], fit.poles.zeta[terms]
    covariance = mass.covariance if terms.size == fit.n_modes else mass.covariance.of_modes(terms.tolist())
    return _assemble(frf, dofs, band, poles, mass.shapes[:, terms], covariance, outside, residual, misfit, scaled, "linear stage")


def without_shape(fit: LinearFit, mass: UnitMassShapes) -> NDArray[np.bool_]:
    """Poles beyond the lines that no drive point scales while it scales others, (n,).

    Their residues are part of what lies outside: a shape from products of next to nothing has any size.
    """
    return np.asarray(_beyond(fit) & ~mass.scaled & mass.scaled.any())


def _beyond(fit: LinearFit) -> NDArray[np.bool_]:
    return np.asarray((fit.poles.hz < fit.ends_hz[0]) | (fit.poles.hz > fit.ends_hz[1]))


def linear_outside(fit: LinearFit, mass: UnitMassShapes, band: tuple[float, float], local_terms: bool = True) -> OutsideModes:
    """Residual terms for all DOFs from the tails of the measured pairs; 1/s, an offset of a sensor, is no part of a structure."""
    gone = without_shape(fit, mass)
    runs, parameters = column_runs(fit, mass.shapes, gone)
    columns = tail_columns(fit.pairs.frequencies_hz, max(fit.ends_hz[1], float(fit.poles.hz.max())), fit.ends_hz[0], fit.pairs.window_rate)
    poles = basis(fit.pairs.frequencies_hz, fit.poles.take(gone), fit.pairs.window_rate)[0]
    physical = np.concatenate([columns[: len(OUTSIDE_FACTORS) + len(LOWER_FACTORS)], poles])
    estimates = []
    for run, local in zip(runs, parameters.local, strict=True):
        information = np.stack([2 * real_inner(physical / variance, physical) for variance in run.response_variance])
        estimates.append((local.ravel(), information))
    lines = fit.pairs.accelerance.size
    polished = Polished(parameters, np.zeros((0, 0)), tuple(estimates), float(fit.projection.cost.sum()), lines, 0, True)
    m, n = parameters.shapes.shape
    local_terms = local_terms and (n + 14 + m) * (2 + m) <= MOST_PARAMETERS
    return outside_modes(runs, polished, band, True, max_dofs=CORE_DOFS, local_terms=local_terms, model_error=fit.model_error)


def left_beyond(fit: LinearFit, shapes: Real, gone: NDArray[np.bool_], frequencies_hz: Real) -> Complex:
    """What shapes leave of the residues of modes beyond the lines, (P, L): these and the tails of each pair make up for each other."""
    at = np.flatnonzero(_beyond(fit) & ~gone)
    residues = (fit.projection.a - shapes[fit.pairs.rows] * shapes[fit.pairs.columns])[:, at]
    return combined(residues, basis(frequencies_hz, fit.poles.take(at), fit.pairs.window_rate)[0])


def _physical_tails(fit: LinearFit, rest: Complex) -> Real:
    """Coefficients of the kernels outside and of the mass line, (P, 8), which take up what shapes leave of modes beyond the lines.

    1/s² is how a suspension below the band begins, and joins them.
    """
    columns = tail_columns(fit.pairs.frequencies_hz, max(fit.ends_hz[1], float(fit.poles.hz.max())), fit.ends_hz[0], fit.pairs.window_rate)
    columns[-2] *= fit.pairs.offset
    keep = len(OUTSIDE_FACTORS) + len(LOWER_FACTORS)
    low = np.arange(len(OUTSIDE_FACTORS), keep)
    share = np.linalg.lstsq(columns[low].real.T, columns[-1].real, rcond=None)[0]
    whole = fit.projection.tails
    if rest.any():
        parts, rest = (np.concatenate([part.real, part.imag], axis=1) for part in (columns, rest))
        weights = 1 / np.sqrt(np.tile(fit.variance.plain, 2))
        whole = whole + [np.linalg.lstsq((w * parts).T, w * r, rcond=1e-9)[0] for w, r in zip(weights, rest, strict=True)]
    tails = whole[:, :keep].copy()
    tails[:, low] += whole[:, -1:] * share
    return np.asarray(tails)


def column_runs(fit: LinearFit, shapes: Real, gone: NDArray[np.bool_]) -> tuple[list[RunSpectra], Parameters]:
    """The pairs as columns of the FRF matrix, as the maximum-likelihood fit takes them, and the linear fit in its parameters.

    By reciprocity the side with fewer DOFs stands for the references: the accelerometers of a roving-hammer test. Of the poles in ``gone``
    the residues are amounts of kernels outside.
    """
    pairs, runs, local = fit.pairs, [], []
    rest = left_beyond(fit, shapes, gone, pairs.frequencies_hz)
    tails = np.c_[_physical_tails(fit, rest), fit.projection.a[:, gone]]
    few, many = pairs.columns, pairs.rows
    if np.unique(few).size > np.unique(many).size:
        few, many = many, few
    for column in np.unique(few):
        at = np.flatnonzero(few == column)
        lines = pairs.frequencies_hz.size
        runs.append(
            RunSpectra(
                pairs.frequencies_hz,
                pairs.accelerance[at],
                np.ones((1, lines), complex),
                many[at],
                np.ones(at.size),
                np.array([column]),
                np.ones(1),
                fit.variance.plain[at],
                np.zeros((1, lines)),
                None,
                window_rate=pairs.window_rate,
            )
        )
        local.append(tails[at])
    top, bottom = max(fit.ends_hz[1], float(fit.poles.hz.max())), fit.ends_hz[0]
    # the constant tail stands for free masses: a kernel far below the lines
    outside = np.array([k * top for k in OUTSIDE_FACTORS] + [LOWER_FACTORS[1] * bottom, LOWER_FACTORS[0] * bottom])
    damping = np.concatenate([np.full(outside.size, OUTSIDE_DAMPING), fit.poles.zeta[gone]])
    outside, terms = np.append(outside, fit.poles.hz[gone]), fit.poles.take(~gone)
    empty = tuple(np.zeros((0, 0)) for _ in runs)
    return runs, Parameters(terms.hz, terms.zeta, shapes[:, ~gone], outside, damping, empty, tuple(local))
