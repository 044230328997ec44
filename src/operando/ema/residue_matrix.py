"""Residues of one mode between all responses and references: how alike those of two poles are, and whether one shape makes them.

The residues of a mode are a product, R_oi = φ_o φ_i. A mode that moves between the pairs takes two poles, with residues w_oi φ_o φ_i and
(1 − w_oi) φ_o φ_i: their sum is of rank one, whatever the w. It is also what the FRFs tell best of two close poles, whose residues may
grow against each other. If its shape differs between responses alone (or references), w_o, each pole's residues are of rank one, too, and
over the side that stays the shape of both is the same. Two close poles are two modes, then, where their sum is of rank two, or each is of
rank one with a shape of its own over responses and over references.
"""

from __future__ import annotations

import numpy as np

from operando.ema.linear import LinearFit
from operando.ema.pairs import Complex, Real

MIN_RANK_SHARE = 0.95
"""Part of the residue matrix that one shape explains: 0.95–1.00 for modes, 0.52–0.93 for others in a roving test of 13 known modes."""

OTHER_MAC = 0.5
"""Shapes less alike than this are two: midway between none and one, as for neighbours of one reference (choose.CLOSE_TWIN_MAC)."""


def residue_mac(fit: LinearFit, i: int, j: int) -> float:
    """MAC of the residues of two modes over all pairs, weighted by their certainty (capped at ten times the median weight)."""
    weight = 1 / np.maximum(np.maximum(fit.projection.a_std[:, i], fit.projection.a_std[:, j]), 1e-300) ** 2
    weight = np.minimum(weight, 10 * np.median(weight))
    x, y = fit.residues()[:, i], fit.residues()[:, j]
    norm = float(np.sum(weight * np.abs(x) ** 2) * np.sum(weight * np.abs(y) ** 2))
    return float(np.abs(np.sum(weight * x * y.conj())) ** 2 / norm) if norm > 0 else 0.0


def rank_share(fit: LinearFit, k: int) -> float:
    """Weighted part of the residue matrix of mode ``k`` that a rank-one matrix explains; 1 where there is one row or column."""
    return best_shape(*residue_matrix(fit, k))[0]


def best_shape(residues: Complex, weights: Real, rounds: int = 60) -> tuple[float, Complex, Complex]:
    """The rank-one matrix that explains most of the residues, by alternating least squares.

    Returns the weighted part that it explains, and the shapes over responses and references whose product it is.
    """
    right: Complex = np.linalg.svd(residues * np.sqrt(weights.mean(axis=1))[:, None], full_matrices=False)[2][0]
    left = np.zeros(residues.shape[0], complex)
    for _ in range(rounds if min(residues.shape) > 1 else 1):
        left = (residues * weights) @ right.conj() / np.maximum(weights @ np.abs(right) ** 2, 1e-300)
        right = (residues * weights).T @ left.conj() / np.maximum(weights.T @ np.abs(left) ** 2, 1e-300)
    if min(residues.shape) == 1:
        return 1.0, left, right
    lost = float(np.sum(weights * np.abs(residues - np.outer(left, right)) ** 2))
    return 1 - lost / max(float(np.sum(weights * np.abs(residues) ** 2)), 1e-300), left, right


def residue_matrix(fit: LinearFit, *modes: int) -> tuple[Complex, Real]:
    """Sum of the residues of some modes and the weight of each, (responses, references) that were measured; 0 where a pair was not."""
    grid = fit.pairs.grid
    rows, i = np.unique(grid[:, 0], return_inverse=True)
    columns, j = np.unique(grid[:, 1], return_inverse=True)
    residues = np.zeros((rows.size, columns.size), complex)
    weights = np.zeros(residues.shape)
    residues[i, j] = fit.residues()[:, list(modes)].sum(axis=1)
    # of two close poles the residues are uncertain, not their sum: from pair to pair all are in proportion to the noise
    weights[i, j] = 1 / np.maximum(fit.projection.a_std[:, list(modes)].min(axis=1), 1e-300) ** 2
    return residues, weights


def two_shapes(fit: LinearFit, i: int, j: int) -> bool:
    """Whether several references tell that two close poles are two modes: no movement of one mode makes such residues."""
    together, weights = residue_matrix(fit, i, j)
    if min(together.shape) < 2:
        return False
    if best_shape(together, weights)[0] < MIN_RANK_SHARE:
        return True
    (share, left, right), (other_share, other_left, other_right) = (best_shape(*residue_matrix(fit, k)) for k in (i, j))
    if min(share, other_share) < MIN_RANK_SHARE:
        return False
    return _mac(left, other_left) < OTHER_MAC and _mac(right, other_right) < OTHER_MAC


def _mac(x: Complex, y: Complex) -> float:
    return float(np.abs(np.vdot(x, y)) ** 2 / max(float(np.vdot(x, x).real * np.vdot(y, y).real), 1e-300))
