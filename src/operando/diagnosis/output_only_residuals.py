"""Operating modes against predicted ones: matching, and standardised residuals of ln f, ln ζ and shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from operando.data import ModalModel
from operando.diagnosis.output_only_forward import Basis, Modes
from operando.dof import match_dofs
from operando.errors import DataError

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

KNEE = 8.0
"""Residuals beyond this many standard deviations grow as their logarithm only, so that one wrong pair or pole does not decide."""

SHAPE_FLOOR = 5e-4
"""Smallest standard deviation of a shape value, over the largest of its mode: what any identification leaves."""

SECOND_ORDER = 0.6
"""Standard deviation added to every shape value, in parts of the summed variance of its mode's shape of unit norm: the covariance is of
first order, and a sample covariance underestimates its smallest directions."""

ZETA_FLOOR = 1e-5
"""Predicted damping below this (or negative) counts as this: ln ζ must exist."""

ASSUMED = (5e-4, 0.08, 0.01)
"""Relative standard deviations of f, ζ and shape where the operating modes bring none."""


def compress(r: Real) -> Real:
    """Residuals with large ones drawn in: c·asinh(r/c), equal to r where it is small."""
    return np.asarray(KNEE * np.arcsinh(r / KNEE))


def compress_slope(r: Real) -> Real:
    """Derivative of :func:`compress`."""
    return np.asarray(1 / np.sqrt(1 + (r / KNEE) ** 2))


@dataclass(frozen=True)
class Target:
    """Operating modes to be predicted.

    Parameters
    ----------
    log_hz, log_zeta : (n,) arrays
    std_log_hz, std_log_zeta : (n,) arrays
    shapes : (m, n) complex array
    covariance : (n, 2m, 2m) array
        Of the real, then the imaginary parts of each shape.
    joint : (n, per_mode, n, per_mode) array
        Covariance of [ln f, ln ζ, Re shape, Im shape] of all modes, as identified: what close modes share is in it.
    rows : (m,) int array
        Rows of the idle model at which the shapes are measured.
    signs : (m,) array
    """

    log_hz: Real
    log_zeta: Real
    std_log_hz: Real
    std_log_zeta: Real
    shapes: Complex
    covariance: Real
    joint: Real
    rows: NDArray[np.int_]
    signs: Real

    @property
    def n(self) -> int:
        """Number of operating modes."""
        return int(self.log_hz.size)

    @property
    def per_mode(self) -> int:
        """Residuals a mode: f, ζ and the real and imaginary shape values."""
        return 2 + 2 * len(self.rows)


def target_of(idle: ModalModel, operating: ModalModel) -> Target:
    """Operating modes with their standard deviations, on the DOFs both models have.

    Parameters
    ----------
    idle, operating : ModalModel

    Raises
    ------
    DataError
        If the two share fewer than two DOFs or the operating model has no mode in the band.
    """
    known = {(d.node, d.axis) for d in idle.dofs}
    common = tuple(d for d in operating.dofs if (d.node, d.axis) in known)
    if len(common) < 2:
        raise DataError("idle and operating modes share fewer than two DOFs", hint="measure at the same sensors in both states")
    top = 1.15 * float(idle.frequencies_hz.max()) if idle.n_modes else 0.0
    inside = np.asarray(operating.in_band) & (operating.frequencies_hz < top)
    inside &= (operating.damping_ratios > 0) & (operating.frequencies_hz > 0)
    kept = operating.select_modes(inside)
    if kept.n_modes == 0:
        raise DataError("no operating mode lies in the band of the idle model", hint="identify the operating record over the idle band")
    rows, signs = match_dofs(common, idle.dofs)
    own, _ = match_dofs(common, operating.dofs)
    n, full, m = kept.n_modes, len(operating.dofs), len(common)
    shapes = np.asarray(kept.shapes, complex)[own]
    # Sign of the idle row times that of the operating row: match_dofs reports the first against ``common``.
    covariance = np.empty((n, 2 * m, 2 * m))
    joint = np.zeros((n, 2 + 2 * m, n, 2 + 2 * m))
    if kept.covariance is not None and np.iscomplexobj(kept.shapes):
        real = 2 * n + np.arange(n)[:, None] * full + np.asarray(own)
        at = np.concatenate([np.arange(n)[:, None], n + np.arange(n)[:, None], real, real + n * full], axis=1)
        unit = np.ones(at.shape)
        unit[:, 0], unit[:, 1] = 1 / kept.frequencies_hz, 1 / kept.damping_ratios
        joint = np.asarray(kept.covariance)[at.ravel()[:, None], at.ravel()].reshape(joint.shape) * unit[:, :, None, None] * unit
    f_std, z_std, s_std = kept.frequency_std_hz, kept.damping_ratio_std, kept.shape_std
    for k in range(n):
        floor = (SHAPE_FLOOR * np.abs(shapes[:, k]).max()) ** 2
        if kept.covariance is not None and np.iscomplexobj(kept.shapes):
            real = 2 * n + k * full + np.asarray(own)
            index = np.r_[real, real + n * full]
            block = np.asarray(kept.covariance)[np.ix_(index, index)]
        elif s_std is not None:
            block = np.diag(np.tile(np.asarray(s_std)[own, k] ** 2 / 2, 2))
        else:
            block = np.eye(2 * m) * (ASSUMED[2] * np.abs(shapes[:, k]).max()) ** 2
        size = float(np.sum(np.abs(shapes[:, k]) ** 2))
        second = (SECOND_ORDER * float(np.trace(block)) / size) ** 2 * size
        covariance[k] = block + np.eye(2 * m) * (floor + second)
    relative_f = np.full(n, ASSUMED[0]) if f_std is None else np.maximum(f_std / kept.frequencies_hz, 2e-5)
    relative_z = np.full(n, ASSUMED[1]) if z_std is None else np.maximum(z_std / kept.damping_ratios, 5e-3)
    return Target(
        np.log(kept.frequencies_hz),
        np.log(kept.damping_ratios),
        np.asarray(relative_f),
        np.asarray(relative_z),
        shapes,
        covariance,
        joint,
        np.asarray(rows),
        np.asarray(signs, float),
    )


def match(target: Target, modes: Modes) -> tuple[NDArray[np.int_], Complex]:
    """Which pole belongs to each operating mode, by assignment on frequency and MAC.

    Returns
    -------
    index : (n,) int array
        Index of the pole, −1 where there is none left.
    shapes : (m, n) complex array
        Predicted shapes on the target's DOFs.
    """
    # A shape at complex s is that of displacement, velocity or acceleration alike: they differ by a scalar.
    candidates = np.flatnonzero(modes.poles.imag > 0)
    low, high = target.log_hz.min() - 0.7, target.log_hz.max() + 0.7
    log_hz = np.log(np.maximum(np.abs(modes.poles[candidates]) / (2 * np.pi), 1e-12))
    near = (log_hz > low) & (log_hz < high)
    candidates, log_hz = candidates[near], log_hz[near]
    shapes = (modes.shapes[target.rows] * target.signs[:, None]) @ modes.vectors[:, candidates]
    norm_a = np.linalg.norm(target.shapes, axis=0)
    norm_b = np.maximum(np.linalg.norm(shapes, axis=0), 1e-300)
    mac = np.abs(target.shapes.conj().T @ shapes / np.outer(norm_a, norm_b)) ** 2
    cost = np.minimum(np.abs(target.log_hz[:, None] - log_hz) / 0.05, 6.0) + 4 * (1 - mac)
    index = np.full(target.n, -1)
    picked = np.zeros((len(target.rows), target.n), complex)
    if cost.size:
        a, b = linear_sum_assignment(cost)
        index[a] = candidates[b]
        picked[:, a] = shapes[:, b]
    return index, picked


def whiteners(target: Target, model_variance: Real | None = None) -> Real:
    """(n, 2m, 2m) matrices that turn shape differences into unit variance.

    Parameters
    ----------
    target : Target
    model_variance : (n, 2m) array, optional
        The idle model's own variance, in the scale of the operating shapes.
    """
    out = np.empty_like(target.covariance)
    for k in range(target.n):
        total = target.covariance[k] + (0 if model_variance is None else np.diag(model_variance[k]))
        values, vectors = np.linalg.eigh(total)
        values = np.maximum(values, 1e-12 * values[-1])
        out[k] = (vectors / np.sqrt(values)).T
    return out


def shared(target: Target, white: Real) -> Real:
    """Covariance of the standardised residuals of all modes (n·per_mode, n·per_mode): one on the diagonal, and what modes share."""
    n, size = target.n, target.per_mode
    whiten = np.zeros((n, size, size))
    whiten[:, 0, 0], whiten[:, 1, 1] = 1 / target.std_log_hz, 1 / target.std_log_zeta
    whiten[:, 2:, 2:] = white
    out = np.einsum("iab,ibjc,jdc->iajd", whiten, target.joint, whiten, optimize=True)
    for k in range(n):
        out[k, :, k, :] = np.eye(size)
    return np.asarray(out.reshape(n * size, n * size))


def fit_scale(y: Complex, psi: Complex, white: Real) -> tuple[Complex, Real, Real]:
    """Free complex scale of predicted shapes, by least squares of the whitened difference, mode by mode.

    Parameters
    ----------
    y, psi : (m, n) complex arrays
        Operating and predicted shapes.
    white : (n, 2m, 2m) array

    Returns
    -------
    scale : (n,) complex array
    residual : (n, 2m) array
        Whitened difference that is left.
    away : (n, 2m, 2) array
        Orthonormal directions the scale takes away.
    """
    first = (white @ np.concatenate([psi.real, psi.imag]).T[:, :, None])[..., 0]
    second = (white @ np.concatenate([-psi.imag, psi.real]).T[:, :, None])[..., 0]
    t = (white @ np.concatenate([y.real, y.imag]).T[:, :, None])[..., 0]
    # Two columns: Gram–Schmidt in closed form, all modes at once.
    norm = np.maximum(np.linalg.norm(first, axis=1), 1e-300)
    q1 = first / norm[:, None]
    across = np.sum(q1 * second, axis=1)
    q2 = second - across[:, None] * q1
    rest = np.maximum(np.linalg.norm(q2, axis=1), 1e-300)
    q2 /= rest[:, None]
    t1, t2 = np.sum(q1 * t, axis=1), np.sum(q2 * t, axis=1)
    imaginary = t2 / rest
    real = (t1 - across * imaginary) / norm
    return real + 1j * imaginary, t - t1[:, None] * q1 - t2[:, None] * q2, np.stack([q1, q2], axis=-1)


def residuals(target: Target, modes: Modes, white: Real) -> tuple[Real, NDArray[np.int_], Complex]:
    """Standardised residuals, mode by mode [ln f, ln ζ, shape (2m)], not yet compressed; unmatched modes are far off.

    Returns
    -------
    residuals : (n, 2 + 2m) array
    index : (n,) int array
        Pole of each mode.
    scale : (n,) complex array
    """
    index, shapes = match(target, modes)
    out = np.full((target.n, target.per_mode), 3 * KNEE)
    scale, shape_part, _ = fit_scale(target.shapes, shapes, white)
    poles = modes.poles[index]
    zeta = np.maximum(-poles.real / np.abs(poles), ZETA_FLOOR)
    found = index >= 0
    out[found, 0] = ((target.log_hz - np.log(np.abs(poles) / 2 / np.pi)) / target.std_log_hz)[found]
    out[found, 1] = ((target.log_zeta - np.log(zeta)) / target.std_log_zeta)[found]
    out[found, 2:] = shape_part[found]
    return out, index, np.where(found, scale, 0)


def model_variance(
    basis: Basis, target: Target, modes: Modes, index: NDArray[np.int_], scale: Complex, floating: NDArray[np.int_] | None = None
) -> Real:
    """The idle model's own variance of the shapes read out (n, 2m), in the scale of the operating shapes.

    Rows of the idle model that ``floating`` names have none: their shape values are fitted, and would count twice.
    """
    m = len(target.rows)
    out = np.zeros((target.n, 2 * m))
    if basis.covariance is None:
        return out
    for k, j in enumerate(index):
        if j < 0:
            continue
        u = scale[k] * modes.vectors[:, j]
        for a, dof in enumerate(target.rows):
            if floating is not None and dof in floating:
                continue
            block = basis.covariance[dof, dof]
            out[k, a] = max(float(u.real @ block @ u.real), 0.0)
            out[k, m + a] = max(float(u.imag @ block @ u.imag), 0.0)
    return out
