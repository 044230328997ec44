"""Two modes that stand within a part of one bandwidth: told from each other by the rank of their residues, or kept as a pair.

With free residues in each pair two poles are known by their mean and by how much the FRFs bend beyond one pole; how far apart they are
is lost where that drowns in noise, and each then takes a part of both shapes. Known well are the sum of the residues, S = ΣR, and their
first moment, D = ΣλR. By R = φφᵀ both have the same shapes, S = ΦΦᵀ and D = ΦΛΦᵀ, so that the pencil (D, S) gives poles and shapes, as
the two matrices of a subspace method do (Van Overschee & De Moor, Subspace Identification, 1996). It needs two references.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from operando.ema.choose import SAME_WIDTHS
from operando.ema.linear import MAX_DAMPING, LinearFit
from operando.ema.pairs import Complex, Real
from operando.ema.projection import basis
from operando.ema.residue_matrix import MIN_RANK_SHARE, best_shape, rank_share, residue_matrix

APART_STD = 3.0
"""Poles closer than so many standard deviations of their distance are one pole with two shapes."""

RULES = 0.5
"""A pole of two shapes is a pair of modes where it has half of the modes' power at its own resonance, of all pairs together (of two local
modes few pairs hold much): a background or a part of another mode, whose residues make no one shape either, has not (doubts.HALF)."""


def separated(fit: LinearFit) -> LinearFit:
    """The fit with each pole, or two close poles, of two shapes as two poles of one shape each.

    Where the frequencies of the two are not told apart both stand at their mean, and the weaker is in ``second_shapes``.
    """
    k = 0
    while k < fit.n_modes:
        close = k + 1 < fit.n_modes and fit.poles.hz[k + 1] - fit.poles.hz[k] < SAME_WIDTHS * min(
            (fit.poles.zeta * fit.poles.hz)[k : k + 2]
        )
        which = (k, k + 1) if close else (k,)
        if (close or rank_share(fit, k) < MIN_RANK_SHARE) and _two_of(fit, which):
            fit = _parted(fit, which)
            k += 2
        else:
            k += 1
    return fit


def _two_of(fit: LinearFit, which: tuple[int, ...]) -> bool:
    """Whether the residues of these poles together are of rank two, and rule at their resonance."""
    together, weights = residue_matrix(fit, *which)
    if min(together.shape) < 2:
        return False
    share, left, right = best_shape(together, weights)
    rest = together - np.outer(left, right)
    second = best_shape(rest, weights)[0]
    if share >= MIN_RANK_SHARE or (1 - share) * (1 - second) > 1 - MIN_RANK_SHARE:
        return False
    hz = fit.poles.hz[list(which)].mean(keepdims=True)
    g, h = (column[:, 0] for column in basis(hz, fit.poles, fit.pairs.window_rate)[:2])
    field = fit.projection.a * g + fit.projection.b * h
    own = np.sum(np.abs(field[:, list(which)].sum(axis=1)) ** 2)
    others = np.sum(np.abs(np.delete(field, which, axis=1)) ** 2)
    return bool(own >= RULES * (own + others))


@dataclass(frozen=True)
class _Pair:
    """Two poles f(−ζ + i√(1 − ζ²)) [Hz], their residue matrices, and how uncertain each pole is beside the mean of both."""

    poles: Complex
    residues: tuple[Complex, Complex]
    std: Real


def _pencil(fit: LinearFit, which: tuple[int, ...]) -> _Pair | None:
    """Poles and residues of two close poles as of two modes; None where the data give none."""
    hz, zeta = fit.poles.hz[list(which)], fit.poles.zeta[list(which)]
    at = hz * (-zeta + 1j * np.sqrt(1 - zeta**2))
    n, k = fit.n_modes, list(which)
    total, weights = residue_matrix(fit, *which)
    # shifts from pair to pair stand for a part of the moment
    moved = fit.projection.shifted[:, k] + 1j * fit.projection.shifted[:, [n + i for i in k]]
    moment = np.zeros_like(total)
    i, j = (np.unique(side, return_inverse=True)[1] for side in fit.pairs.grid.T)
    moment[i, j] = fit.residues()[:, k] @ (at - at.mean()) + moved @ at
    u, size, vh = np.linalg.svd(total, full_matrices=False)
    v = vh[:2].conj().T
    inner = (u[:, :2].conj().T @ moment @ v) / size[:2, None]
    values, turn = np.linalg.eig(inner)
    if np.linalg.cond(turn) > 1e6:
        return None
    lefts, rights = total @ v @ turn, np.linalg.inv(turn) @ v.conj().T
    back, x = np.linalg.pinv(lefts), v @ turn
    # the residues of the two err against each other: by their distance that is the error of the moment
    error = np.where(weights > 0, 1 / np.maximum(weights, 1e-300), 0.0) * fit.correlation * abs(at[1] - at[0]) ** 2
    std = np.sqrt(np.einsum("ko,oi,ik->k", np.abs(back) ** 2, error, np.abs(x) ** 2))
    poles = at.mean() + values
    order = np.argsort(np.abs(poles))
    both = tuple(np.outer(lefts[:, k], rights[k]) for k in order)
    return _Pair(poles[order], (both[0], both[1]), std[order])


def _parted(fit: LinearFit, which: tuple[int, ...]) -> LinearFit:
    """The fit with two poles of one shape each in the place of these; one is doubled."""
    first = which[0]
    pair = _pencil(fit, which) if len(which) == 2 else None
    mean = np.array([np.mean(fit.poles.hz[list(which)]), np.mean(fit.poles.zeta[list(which)])])
    apart, bent = False, 0.0
    hz, zeta, extra = np.full(2, mean[0]), np.full(2, mean[1]), np.zeros(2)
    if pair is not None:
        found = np.abs(pair.poles), -pair.poles.real / np.abs(pair.poles)
        distance, std = float(found[0][1] - found[0][0]), float(np.hypot(*pair.std))
        apart = distance > APART_STD * std and bool(np.all((found[1] > 0) & (found[1] < MAX_DAMPING)))
        # further apart two poles are as broad as closer ones of more damping: three quarters of 1/(x + iζ)³ is 1/(x + iζ)²
        bent = 0.75 * ((np.diff(fit.poles.hz[list(which)])[0] / mean[0]) ** 2 - (distance / mean[0]) ** 2) / 4 / mean[1]
        if apart:
            (hz, zeta), extra = found, pair.std
        else:
            hz[:] = found[0].mean()
            extra = np.full(2, 0.5 * (distance + std))
        zeta = zeta + bent
    together, weights = residue_matrix(fit, *which)
    if apart and pair is not None:
        residues = pair.residues
    else:
        residues = _by_strength(fit, together, weights)
    a_std = fit.projection.a_std[:, list(which)].min(axis=1)
    if len(which) == 2:  # of the sum: the parts err against each other by one over the distance
        a_std = a_std * min(1.0, abs(float(np.diff(fit.poles.hz[list(which)])[0])) / (mean[0] * mean[1]))
    fit = _doubled(fit, first) if len(which) == 1 else fit
    n, pairs = fit.n_modes, np.array([first, first + 1])
    grid = fit.pairs.grid
    i, j = (np.unique(side, return_inverse=True)[1] for side in grid.T)
    p = fit.projection
    fields = {name: getattr(p, name).copy() for name in ("a", "b", "a_std", "shift", "shifted", "slope", "spread_sums")}
    rotated = min(1.0, float(np.hypot(*extra)) / max(abs(hz[1] - hz[0]), 1e-300)) if apart else 0.0
    for own, other, k in zip(residues, residues[::-1], pairs, strict=True):
        fields["a"][:, k], fields["b"][:, k] = own[i, j].real, own[i, j].imag
        fields["a_std"][:, k] = np.hypot(a_std, rotated * np.abs(other[i, j]))
    fields["shift"][:, pairs], fields["shifted"][:, np.concatenate([pairs, n + pairs])] = 0.0, 0.0
    fields["spread_sums"][:, pairs] = 0.0  # shifts of the poles that were say nothing of these
    fields["slope"][:, pairs] = fields["slope"][:, pairs].mean(axis=1, keepdims=True)
    to_mean = np.eye(2 * n)
    for at in (pairs, n + pairs):
        to_mean[np.ix_(at, at)] = 0.5
    covariance = to_mean @ fit.covariance @ to_mean.T
    covariance[pairs, pairs] += (extra / hz) ** 2
    covariance[n + pairs, n + pairs] += ((extra / hz) ** 2 + (bent / 2) ** 2) / zeta**2
    poles = replace(fit.poles, hz=fit.poles.hz.copy(), zeta=fit.poles.zeta.copy())
    poles.hz[pairs], poles.zeta[pairs] = hz, zeta
    second = fit.second_shapes if apart else (*fit.second_shapes, first + 1)
    return replace(fit, poles=poles, projection=replace(p, **fields), covariance=covariance, second_shapes=second)


def _by_strength(fit: LinearFit, together: Complex, weights: Real) -> tuple[Complex, Complex]:
    """Two matrices of rank one that make up the residues, the stronger first.

    Two modes of one frequency have no shapes of their own: any two of the plane that they span do, if their products are reciprocal. These
    are by the drive points; without them as much as possible is in the first.
    """
    _, left, right = best_shape(together, weights)
    rows, columns = (np.unique(side) for side in fit.pairs.grid.T)
    responses = {int(k): int(d) for k, d in zip(fit.pairs.grid[:, 0], fit.pairs.rows, strict=True)}
    references = {int(k): int(d) for k, d in zip(fit.pairs.grid[:, 1], fit.pairs.columns, strict=True)}
    row_dofs, column_dofs = [responses[int(k)] for k in rows], [references[int(k)] for k in columns]
    turned = len(column_dofs) > len(row_dofs)
    matrix, many, few = (together.T, column_dofs, row_dofs) if turned else (together, row_dofs, column_dofs)
    first = np.outer(left, right)
    if set(few) <= set(many):
        driven = matrix[[many.index(d) for d in few]].real
        vectors = np.linalg.eigh(0.5 * (driven + driven.T))[1][:, ::-1]
        by_drive = np.outer(matrix @ vectors[:, 0], vectors[:, 0])
        first = by_drive.T if turned else by_drive
    return first, together - first


def _doubled(fit: LinearFit, k: int) -> LinearFit:
    """The fit with pole ``k`` twice."""
    twice = fit.take(np.insert(np.arange(fit.n_modes), k, k))
    return replace(twice, second_shapes=tuple(i + (i > k) for i in fit.second_shapes))
