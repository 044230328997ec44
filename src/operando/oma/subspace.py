"""Covariance-driven stochastic subspace identification: factorisation of the Hankel matrix, poles of all orders at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from operando.errors import IdentificationError
from operando.oma.correlation import block_hankel

REGULARISATION = 1e-3
"""White noise added to covariances that are whitened with, in parts ε of each channel's mean square: bands without energy, as above a
low-pass filter, leave their factor to rounding errors. A part of variance v of a channel keeps v/(v + ε) of its weight: 91 % of what makes
1 % of the mean square. What has no energy at all is raised no more than 1/√ε = 32 times.
"""


@dataclass(frozen=True)
class Factors:
    """Leading singular triplets of the (weighted) Hankel matrix, Lf⁻¹·H·Lp⁻ᵀ ≈ U·diag(s)·Vᵀ.

    ``left`` (a, n) is U, ``right`` (b, n) V; the lower triangles ``left_factor`` and ``right_factor`` are Lf and Lp, None for the identity.
    """

    left: NDArray[np.float64]
    s: NDArray[np.float64]
    right: NDArray[np.float64]
    left_factor: NDArray[np.float64] | None = None
    right_factor: NDArray[np.float64] | None = None

    @property
    def observability(self) -> NDArray[np.float64]:
        """Lf·U: extended observability matrix, any leading columns of it."""
        return self.left if self.left_factor is None else self.left_factor @ self.left


def whitening_factor(correlations: NDArray[Any], rows: int, n_samples: int, past: bool) -> NDArray[np.float64]:
    """Cholesky factor of the block-Toeplitz covariance of stacked outputs, for canonical-variate weights.

    Unbiased correlations (n_lags + 1, r, r) of the stacked channels among themselves are tapered here by (1 − τ/n_samples), which makes
    them positive. The ``past`` is stacked backwards in time instead of forwards.
    """
    r = correlations.shape[1]
    ahead = correlations[:rows] * (1 - np.arange(rows) / n_samples)[:, None, None]
    ahead[0] = (ahead[0] + ahead[0].T) / 2
    if past:
        ahead = ahead.transpose(0, 2, 1)
    both = np.concatenate([ahead[:0:-1].transpose(0, 2, 1), ahead])
    toeplitz = block_hankel(np.concatenate([both[:1], both]), rows, rows).reshape(rows * r, rows, r)[:, ::-1].reshape(rows * r, rows * r)
    power = np.tile(np.diag(ahead[0]), rows)
    for factor in (1, 10, 100):
        try:
            return cholesky(toeplitz + np.diag(REGULARISATION * factor * power), lower=True, check_finite=False)
        except LinAlgError:
            continue
    raise IdentificationError(
        "the covariance matrix of the outputs is singular",
        hint="look for copied or summed channels and exclude them, or use weighting='none'",
    )


def factorise_weighted(
    correlations: NDArray[Any], references: NDArray[np.int_], rows: int, rank: int, n_samples: int, weighting: str = "cva"
) -> Factors:
    """Hankel matrix of the correlations (n_lags + 1, r, q) of a record of ``n_samples``, weighted and factorised to ``rank`` triplets.

    ``cva`` whitens future and past (canonical variates; Van Overschee & De Moor 1996): weak low modes count as much as strong high ones and
    the estimates come near to maximum likelihood; the singular values are canonical correlations between 0 and 1. With fewer references
    than channels only the past is whitened, the future scaled by channel. ``none`` is plain SSI-cov. There are as many block rows as block
    columns; rows used as references increase.
    """
    hankel = block_hankel(correlations, rows, rows)
    if weighting == "none":
        return factorise(hankel, rank)
    past = whitening_factor(correlations[:, references, :], rows, n_samples, True)
    if references.size == correlations.shape[1]:
        future = whitening_factor(correlations, rows, n_samples, False)
    else:
        future = np.diag(np.tile(np.sqrt(np.linalg.norm(correlations[0], axis=1)), rows))
    weighted = solve_triangular(future, hankel, lower=True, check_finite=False)
    weighted = solve_triangular(past, weighted.T, lower=True, check_finite=False).T
    plain = factorise(weighted, rank)
    return Factors(plain.left, plain.s, plain.right, future, past)


def factorise(hankel: NDArray[Any], rank: int) -> Factors:
    """Leading singular triplets of a matrix.

    Small matrices: exact SVD. Large ones: randomised range finder with power iterations (Halko, Martinsson & Tropp 2011), whose
    error in the leading triplets is far below the statistical one, because singular values of correlations fall fast. The random start
    is always the same, so that results repeat.
    """
    small = min(hankel.shape)
    rank = min(rank, small)
    over = rank + max(20, rank // 4)
    if over * 3 > small:
        u, s, vt = np.linalg.svd(hankel, full_matrices=False)
        return Factors(u[:, :rank], s[:rank], vt[:rank].T)
    start = np.random.default_rng(0).standard_normal((hankel.shape[1], over))
    basis = np.linalg.qr(hankel @ start)[0]
    for _ in range(4):
        basis = np.linalg.qr(hankel @ np.linalg.qr(hankel.T @ basis)[0])[0]
    u, s, vt = np.linalg.svd(basis.T @ hankel, full_matrices=False)
    return Factors((basis @ u)[:, :rank], s[:rank], vt[:rank].T)


@dataclass(frozen=True)
class Realisation:
    """What all orders share: shift equation R·A = M of the largest order, of which each order is a leading block.

    ``left`` (block_rows·r, n) is the observability matrix (left singular vectors); ``triangle`` and ``product`` (n, n) are R and
    Qᵀ·(shifted part) of the QR factorisation of all but the last block row, ``basis`` ((block_rows − 1)·r, n) is Q.
    """

    left: NDArray[np.float64]
    triangle: NDArray[np.float64]
    product: NDArray[np.float64]
    n_channels: int
    basis: NDArray[np.float64]

    def state_matrix(self, order: int) -> NDArray[np.float64]:
        """A of one order (order, order): least-squares shift invariance."""
        return solve_triangular(self.triangle[:order, :order], self.product[:order, :order], check_finite=False)

    def left_inverse(self, order: int) -> NDArray[np.float64]:
        """Least-squares inverse of all but the last block row of one order."""
        return solve_triangular(self.triangle[:order, :order], self.basis[:, :order].T, check_finite=False)


def realise(factors: Factors, n_channels: int) -> Realisation:
    """Prepare the shift equation once for all orders: with U_up = QR, A_n = R_n⁻¹ (Qᵀ U_down)_n for every leading n."""
    left = factors.observability
    up, down = left[:-n_channels], left[n_channels:]
    q, triangle = np.linalg.qr(up)
    return Realisation(left, triangle, q.T @ down, n_channels, q)


@dataclass(frozen=True)
class Poles:
    """Poles of one order with positive imaginary part: discrete μ (p,), hz, zeta (p,), shapes (r, p), state vectors (order, p)."""

    order: int
    mu: NDArray[np.complex128]
    hz: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    vectors: NDArray[np.complex128]


def poles_of_order(realisation: Realisation, order: int, sampling_hz: float) -> Poles:
    """Poles and shapes of one model order; real poles and one of each conjugate pair are left out."""
    mu, vectors = np.linalg.eig(realisation.state_matrix(order))
    keep = mu.imag > 1e-12
    mu, vectors = mu[keep], vectors[:, keep]
    lam = np.log(mu) * sampling_hz
    rank = np.argsort(np.abs(lam))
    mu, lam, vectors = mu[rank], lam[rank], vectors[:, rank]
    shapes = realisation.left[: realisation.n_channels, :order] @ vectors
    return Poles(order, mu, np.abs(lam) / 2 / np.pi, -lam.real / np.abs(lam), shapes, vectors)


def poles_of_orders(realisation: Realisation, orders: Sequence[int], sampling_hz: float) -> list[Poles]:
    """``poles_of_order`` for several orders."""
    return [poles_of_order(realisation, n, sampling_hz) for n in orders]
