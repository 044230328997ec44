"""Covariance of poles and shapes: the scatter of the correlations between blocks, propagated through SSI to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import stdtrit

from operando.oma.correlation import BlockCorrelations, block_hankel
from operando.oma.subspace import Factors, Poles, Realisation

CACHE_VALUES = 1 << 17
"""Values of the blocks' products worked on at a time: a megabyte."""

NORMAL_95 = 1.959964
"""Standard deviations of the normal distribution that hold 95 % on both sides."""


@dataclass(frozen=True)
class Perturbations:
    """First-order change of poles λ [rad/s] (n_blocks, p) and shapes (n_blocks, r, p) by each block's correlations replacing the mean.

    Shapes are those of ``poles_of_order``, not normalised.
    """

    lam: NDArray[np.complex128]
    shapes: NDArray[np.complex128]


@dataclass(frozen=True)
class BlockProducts:
    """Each block's change of the weighted Hankel matrix ΔH by the singular vectors: what the perturbations of all orders share.

    ``right`` (n_blocks, a, n) is Lf⁻¹ΔH Lp⁻ᵀ V without the Lf⁻¹, ``inside`` (n_blocks, n, n) Uᵀ Lf⁻¹ΔH Lp⁻ᵀ V.
    """

    right: NDArray[np.float32]
    inside: NDArray[np.float32]


def block_products(correlations: BlockCorrelations, factors: Factors, rows: int) -> BlockProducts:
    """Products of each block's change of the Hankel matrix with all singular vectors kept."""
    if correlations.blocks is None:
        raise ValueError("correlations of blocks are needed")
    wl, vr = factors.left, factors.right
    if factors.left_factor is not None and factors.right_factor is not None:
        wl = solve_triangular(factors.left_factor, wl, lower=True, trans="T", check_finite=False)
        vr = solve_triangular(factors.right_factor, vr, lower=True, trans="T", check_finite=False)
    wl32, vr32 = wl.astype(np.float32), vr.astype(np.float32)
    mean = correlations.mean.astype(np.float32)
    right = np.empty((correlations.blocks.shape[0], wl.shape[0], vr.shape[1]), np.float32)
    for y, block in zip(right, correlations.blocks, strict=True):
        np.matmul(block_hankel(block - mean, rows, rows), vr32, out=y)
    return BlockProducts(right, wl32.T @ right)


def perturb(
    correlations: BlockCorrelations,
    factors: Factors,
    realisation: Realisation,
    poles: Poles,
    modes: Sequence[int] | NDArray[np.int_],
    rows: int,
    sampling_hz: float,
    blocks: BlockProducts | None = None,
) -> Perturbations:
    """Poles and shapes of one order (``modes``: columns of ``poles``) perturbed by the correlations of each block.

    The chain Hankel matrix → singular subspace → state matrix → eigenvalues is linearised as by Reynders, Pintelon & De Roeck (2008) and
    Döhler & Mevel (2013), the residual of the shift equation and the coupling to the discarded singular vectors included; whitening factors
    are held fixed (their change acts on the discarded part only). No covariance of the Hankel matrix is formed: each block costs two
    products with the leading singular vectors, shared by all orders (``blocks``), and little for each mode.
    """
    products = block_products(correlations, factors, rows) if blocks is None else blocks
    n, r = poles.order, realisation.n_channels
    columns = np.asarray(modes, int)
    s1, s2 = factors.s[:n], factors.s[n:]
    gap = s1[None, :] ** 2 - s2[:, None] ** 2
    gap = np.maximum(gap, 1e-6 * s1[None, :] ** 2)
    left = realisation.left
    up, down = left[:-r, :n], left[r:, :n]
    state = realisation.state_matrix(n)
    shift_left = realisation.left_inverse(n)
    gram_inverse = shift_left @ shift_left.T
    mu, vectors = np.linalg.eig(state)
    inverse = np.linalg.inv(vectors)
    index = np.array([int(np.argmin(np.abs(mu - poles.mu[c]))) for c in columns], int)
    scale = np.array(
        [poles.vectors[:, c] @ vectors[:, i].conj() / np.vdot(vectors[:, i], vectors[:, i]) for c, i in zip(columns, index, strict=True)]
    )
    psi = vectors[:, index] * scale
    distance = mu[index][None, :] - mu[:, None]
    distance[index, np.arange(index.size)] = np.inf
    # the change of the observability matrix acts on the few vectors wanted only, and on what the shift equation leaves of them
    scaled = psi / s1[:, None]
    rest = (down - up @ state) @ psi
    through = left[:-r].T @ rest
    lam = np.empty((products.inside.shape[0], columns.size), complex)
    shapes = np.empty((lam.shape[0], r, columns.size), complex)
    few = max(1, CACHE_VALUES // products.right[0].size)
    for first in range(0, lam.shape[0], few):
        at = slice(first, first + few)
        own, inside = products.right[at, :, :n].astype(float), products.inside[at].astype(float)
        coupling = (inside[:, n:, :n] * s1 + s2[:, None] * inside[:, :n, n:].transpose(0, 2, 1)) / gap
        turned_in = -_by_real(inside[:, :, :n], scaled)
        turned_in[:, n:] += _by_real(coupling, psi)
        change = _by_real(own, scaled) + _by_real(left, turned_in)
        shifted = change[:, r:] - change[:, :-r] * mu[index]
        back = _by_real(own[:, :-r].transpose(0, 2, 1), rest) - _by_real(inside[:, :, :n].transpose(0, 2, 1), through)
        back = _by_real(coupling.transpose(0, 2, 1), through[n:]) + back / s1[:, None]
        turned = inverse @ (_by_real(shift_left, shifted) + _by_real(gram_inverse, back))
        lam[at] = turned[:, index, np.arange(index.size)] / scale / mu[index] * sampling_hz
        shapes[at] = change[:, :r] + _by_real(left[:r, :n], vectors @ (turned / distance))
    return Perturbations(lam, shapes)


def _by_real(matrix: NDArray[np.float64], vectors: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """A real matrix times a few complex vectors, real and imaginary parts side by side."""
    return np.asarray(matrix @ np.ascontiguousarray(vectors).view(float)).view(complex)


def normalised_changes(
    lam: NDArray[np.complex128], shapes: NDArray[np.complex128], change: Perturbations, derivative: NDArray[np.int_] | None = None
) -> NDArray[np.float64]:
    """Changes of θ = [f, ζ, Re shapes, Im shapes], as in ``ModalModel.covariance``, from changes of poles and raw shapes (r, p).

    Shapes are taken in proportions of displacement (divided by λ [rad/s] to the power ``derivative`` of their channel), then scaled to unit
    norm with the largest component real and positive. One row a block, (n_blocks, 2·p + 2·p·r).
    """
    size = np.abs(lam)
    along = (lam.conj() * change.lam).real
    d_hz = along / size / 2 / np.pi
    d_zeta = -change.lam.real / size + lam.real * along / size**3
    raw, d_raw = shapes, change.shapes
    if derivative is not None and np.any(derivative != derivative[0]):
        power = lam[None, :] ** derivative[:, None]
        d_raw = d_raw / power - derivative[None, :, None] * (raw / power)[None] * (change.lam / lam)[:, None, :]
        raw = raw / power
    d_unit = unit_changes(raw, d_raw)[1]
    flat = d_unit.transpose(0, 2, 1).reshape(d_unit.shape[0], -1)
    return np.concatenate([d_hz, d_zeta, flat.real, flat.imag], axis=1)


def unit_changes(shapes: NDArray[Any], change: NDArray[Any]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Shapes (r, p) and their changes (k, r, p) after scaling to unit norm, the largest component real and positive."""
    top = np.argmax(np.abs(shapes), axis=0), np.arange(shapes.shape[1])
    peak = shapes[top]
    factor = np.abs(peak) / peak / np.linalg.norm(shapes, axis=0)
    unit, d_unit = shapes * factor, change * factor
    turn = d_unit[:, top[0], top[1]].imag / unit[top].real
    d_unit = d_unit - 1j * unit[None] * turn[:, None, :]
    d_unit = d_unit - unit[None] * np.sum(unit.conj()[None] * d_unit, axis=1).real[:, None, :]
    return unit, d_unit


def student_widening(freedom: float) -> float:
    """Factor on a standard deviation of so many degrees of freedom by which ±1.96 of it cover 95 % (Student's t)."""
    return float(stdtrit(freedom, 0.975)) / NORMAL_95


def covariance_of_mean(changes: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of the weighted mean of independent block values, from the deviation (n_blocks, k) of each; weights have the sum 1.

    It is widened so that ±1.96 standard deviations cover 95 % in spite of the finite number of blocks (Student's t with n_blocks − 1
    degrees of freedom).
    """
    nu = weights.size - 1
    scaled = changes * weights[:, None]
    return scaled.T @ scaled * (weights.size / nu) * student_widening(nu) ** 2
