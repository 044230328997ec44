"""The idle model with a cautious idea of what lies outside the band where nothing was driven.

Measured is only the out-of-band part of the driven columns. What an effect at an undriven place meets is the out-of-band compliance of
that place itself, of which the driven columns say no more than a lower bound: the residual matrix must stay positive. Pseudo-modes that
match the columns with shape values driven nowhere put compliances there that may be a hundred times too large, with a linearised
covariance that does not say so; here they are pooled, completed as small as the columns allow, and what may be missing floats widely.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, ResidualTerms

Real = NDArray[np.float64]

SOLID = (0.3, 4.0, 0.5)
"""A mode outside the band is solid when its largest driven shape value exceeds this part of its rms over all DOFs, and its rms and
standard deviation stay below these multiples of the typical rms of modes in the band."""

IDENTIFIED = 0.2
"""A mode identified outside the band (with a frequency of its own) stays as it is when its shape's standard deviation lies below this part
of its rms, however little the drive points see of it."""

CAP = 3.0
"""Largest out-of-band compliance taken for an undriven DOF, over the largest one measured."""

LOCAL_SHARE, LOCAL_SPREAD, CROSS_SPREAD = 0.5, 1.0, 0.4
"""Local compliance expected beyond the completion, in parts of the typical measured one; standard deviation of the local mode's shape value
at its DOF and at other undriven ones, over that value."""

NEAR, MIDDLE, FAR = 0.3, 0.6, 0.9
"""Frequencies, over the band's end, at which pools must agree with what they stand for: diagonals at the first and the last, columns at the
middle one."""

COLUMN_SPREAD = 0.05
"""Relative standard deviation of the pooled part of the driven columns."""


def settled(idle: ModalModel) -> ModalModel:
    """Idle model whose residual modes are pooled and completed anew at undriven DOFs, with a wide covariance there.

    With few driven DOFs R (all DOFs × all DOFs) is known in its driven columns only; the smallest positive completion is
    R_uu = R_ud·R_dd⁻¹·R_du (Schur complement zero). A local mode at each undriven DOF stands for what it may lack.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass. Undriven DOFs are those with a local mode (a residual mode that moves one DOF only); a model without such
        modes or without covariance is given back as it is.
    """
    terms = idle.terms
    shapes = np.asarray(terms.shapes, float)
    m, n = shapes.shape
    residual = terms.residual
    local = residual & (np.count_nonzero(shapes, axis=0) == 1)
    driven = np.ones(m, bool)
    driven[np.argmax(np.abs(shapes[:, local]), axis=0)] = False
    if not local.any() or not driven.any() or idle.covariance is None or idle.band_hz is None:
        return idle
    omega, top = 2 * np.pi * terms.frequencies_hz, 2 * np.pi * idle.band_hz[1]
    outside = (residual | ~terms.in_band) & ~local
    rms, std = np.sqrt(np.mean(shapes**2, axis=0)), np.sqrt(np.mean(np.asarray(terms.shape_std) ** 2, axis=0))
    typical_rms = float(np.median(rms[~outside & ~local]))
    solid = (np.abs(shapes[driven]).max(axis=0) > SOLID[0] * rms) & (rms < SOLID[1] * typical_rms) & (std < SOLID[2] * typical_rms)
    solid |= ~residual & (std < IDENTIFIED * rms)
    above = outside & (omega > top)
    # Solid pseudo-modes of given frequencies stand for modes just above the band, the others for all beyond: two pools.
    pools, kept_too = [], np.zeros(n, bool)
    for part in (above & solid & residual, above & ~solid):
        found = _pool(shapes, omega, part, driven, top)
        if found is None:
            kept_too |= part
        else:
            pools.append(found)
    if not pools:
        return idle
    kept = np.flatnonzero(~local & (~above | (solid & ~residual) | kept_too))
    completed = np.concatenate([phi for phi, _ in pools], axis=1)
    own = np.concatenate([np.full(phi.shape[1], w) for phi, w in pools])
    middle = MIDDLE * top
    at = lambda phi, w: (phi**2 / (w**2 - middle**2)).sum(axis=1)  # noqa: E731
    compliance = at(shapes[:, kept[omega[kept] > top]], omega[kept[omega[kept] > top]]) + at(completed, own)
    typical = float(np.exp(np.mean(np.log(np.maximum(compliance[driven], 1e-300)))))
    limit = CAP * float(compliance[driven].max())
    completed[~driven] *= np.minimum(1, np.sqrt(limit / compliance[~driven]))[:, None]
    local_omega = 2.0 * top
    amplitude = float(np.sqrt(LOCAL_SHARE * typical * (local_omega**2 - middle**2)))
    rows = np.flatnonzero(~driven)
    extra = np.zeros((m, rows.size))
    extra[rows, np.arange(rows.size)] = amplitude
    q = completed.shape[1]
    hz = np.r_[terms.frequencies_hz[kept], own / 2 / np.pi, np.full(rows.size, local_omega / 2 / np.pi)]
    new = np.concatenate([shapes[:, kept], completed, extra], axis=1)
    size = hz.size
    total = np.zeros((size * (2 + m),) * 2)
    old = np.r_[kept, n + kept, (2 * n + kept[:, None] * m + np.arange(m)).ravel()]
    put = np.r_[: kept.size, size : size + kept.size, 2 * size : 2 * size + kept.size * m]
    total[np.ix_(put, put)] = np.asarray(idle.covariance)[np.ix_(old, old)]
    start = 2 * size + kept.size * m
    ground = np.sqrt(np.mean(completed[driven] ** 2, axis=0))
    std = COLUMN_SPREAD * np.where(driven[:, None], np.abs(completed), np.hypot(completed, ground))
    # A local mode is none of a drive point's; at the other undriven DOFs it stands at zero, and for what couples them unseen.
    local_std = np.where(extra > 0, LOCAL_SPREAD, CROSS_SPREAD) * amplitude * ~driven[:, None]
    spread = np.r_[(std.T**2).ravel(), (local_std.T**2).ravel()]
    total[start + np.arange(spread.size), start + np.arange(spread.size)] = spread
    fill = lambda old_values, value: np.r_[old_values[kept], np.full(q + rows.size, value)]  # noqa: E731
    # Kept modes stay before kept residual terms, and what is new is residual: the order is that of a model.
    modes = int(np.sum(~residual[kept]))
    zeta = fill(terms.damping_ratios, float(np.median(terms.damping_ratios[above])))
    return replace(
        idle,
        frequencies_hz=hz[:modes],
        damping_ratios=zeta[:modes],
        shapes=new[:, :modes],
        residuals=ResidualTerms(hz[modes:], zeta[modes:], new[:, modes:]),
        in_band=terms.in_band[kept][:modes],
        covariance=total,
        std=None,
    )


def _pool(shapes: Real, omega: Real, part: NDArray[np.bool_], driven: NDArray[np.bool_], top: float) -> tuple[Real, float] | None:
    """As many modes of one frequency as DOFs are driven, with the same driven columns, and that frequency; None with nothing to pool."""
    near, middle, far = (share * top for share in (NEAR, MIDDLE, FAR))
    columns = [(shapes[:, part] / (omega[part] ** 2 - s**2)) @ shapes[driven][:, part].T for s in (near, middle, far)]
    trace = [float(np.trace(c[driven])) for c in columns]
    if not part.any() or trace[0] <= 0:
        return None
    # Two frequencies in the band fix the pool's own: the driven diagonals must agree at both.
    ratio = min(max(trace[2] / trace[0], 1.01), 2.5)
    own = float(np.sqrt((ratio * far**2 - near**2) / (ratio - 1)))
    return completion(columns[1] * (own**2 - middle**2), driven), own


def completion(column: Real, driven: NDArray[np.bool_]) -> Real:
    """Shapes (m, d) of the smallest positive matrix with the given driven columns: S ≈ shapes·shapesᵀ.

    Parameters
    ----------
    column : (m, d) array
        Columns of a symmetric positive matrix at the driven DOFs.
    driven : (m,) bool array
    """
    block = (column[driven] + column[driven].T) / 2
    values, vectors = np.linalg.eigh(block)
    # Noise in a direction that hardly moves the drive points would be blown up at the others.
    floor = 0.003 * max(float(np.mean(values)), 1e-300)
    half = vectors * np.sqrt(np.maximum(values, floor))
    out = column @ (vectors / np.sqrt(np.maximum(values, floor)))
    out[driven] = half
    return np.asarray(out)
