"""Covariance-driven stochastic subspace identification: factorisation of the Hankel matrix, poles of all orders at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular


@dataclass(frozen=True)
class Factors:
    """Leading singular triplets H ≈ U·diag(s)·Vᵀ: left (a, n), s (n,), right (b, n)."""

    left: NDArray[np.float64]
    s: NDArray[np.float64]
    right: NDArray[np.float64]


def factorise(hankel: NDArray[Any], rank: int, seed: int = 0) -> Factors:
    """Leading singular triplets of a matrix.

    Small matrices: exact SVD. Large ones: randomised range finder with power iterations (Halko, Martinsson & Tropp 2011), whose
    error in the leading triplets is far below the statistical one, because singular values of correlations fall fast.

    Parameters
    ----------
    hankel : (a, b) array
    rank : int
    seed : int
        Of the random start; fixed so that results repeat.
    """
    small = min(hankel.shape)
    rank = min(rank, small)
    over = rank + max(20, rank // 4)
    if over * 3 > small:
        u, s, vt = np.linalg.svd(hankel, full_matrices=False)
        return Factors(u[:, :rank], s[:rank], vt[:rank].T)
    start = np.random.default_rng(seed).standard_normal((hankel.shape[1], over))
    basis = np.linalg.qr(hankel @ start)[0]
    for _ in range(4):
        basis = np.linalg.qr(hankel @ np.linalg.qr(hankel.T @ basis)[0])[0]
    u, s, vt = np.linalg.svd(basis.T @ hankel, full_matrices=False)
    return Factors((basis @ u)[:, :rank], s[:rank], vt[:rank].T)


@dataclass(frozen=True)
class Realisation:
    """What all orders share: shift equation R·A = M of the largest order, of which each order is a leading block.

    Parameters
    ----------
    left : (block_rows·r, n) array
        Observability matrix (left singular vectors).
    triangle, product : (n, n) arrays
        R and Qᵀ·(shifted part) of the QR factorisation of all but the last block row.
    n_channels : int
    """

    left: NDArray[np.float64]
    triangle: NDArray[np.float64]
    product: NDArray[np.float64]
    n_channels: int

    def state_matrix(self, order: int) -> NDArray[np.float64]:
        """A of one order (order, order): least-squares shift invariance."""
        return solve_triangular(self.triangle[:order, :order], self.product[:order, :order])


def realise(factors: Factors, n_channels: int) -> Realisation:
    """Prepare the shift equation once for all orders: with U_up = QR, A_n = R_n⁻¹ (Qᵀ U_down)_n for every leading n."""
    up, down = factors.left[:-n_channels], factors.left[n_channels:]
    q, triangle = np.linalg.qr(up)
    return Realisation(factors.left, triangle, q.T @ down, n_channels)


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
