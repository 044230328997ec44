"""FRF synthesis from modal parameters (Shen & Lu 2024, Eq 4), as one real matrix product over lines."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import DataError

POWER = {"receptance": 0, "mobility": 1, "accelerance": 2}


_CACHE_VALUES = 4096
"""Complex values worked on at a time (64 kB): temporaries then stay in the cache, which is five to seven times as fast."""


_FORM_VALUES = 1 << 19
"""Products of functions kept at a time (4 MB)."""


_FEW_FORMS = 4
"""Quadratic forms that are cheaper one by one, as matrix products, than by all products of two functions."""


def row_blocks(n_rows: int, n_lines: int) -> Iterator[slice]:
    """Rows of an (n_rows, n_lines) array in blocks that stay in the cache."""
    size = max(1, _CACHE_VALUES // max(n_lines, 1))
    return (slice(start, start + size) for start in range(0, n_rows, size))


def compliance(s: NDArray[np.complex128], w0: NDArray[np.float64], zeta: NDArray[np.float64]) -> NDArray[np.complex128]:
    """1 / (ω₀² + 2ζω₀s + s²) of each mode (rows) and line: in real arithmetic, a complex division costs several times as much."""
    w0, zeta = w0[:, None], zeta[:, None]
    squared = s * s
    real = (w0 * w0 + squared.real) + 2 * zeta * w0 * s.real
    imag = 2 * zeta * w0 * s.imag + squared.imag
    size = real * real + imag * imag
    out = np.empty(real.shape, complex)
    np.divide(real, size, out=out.real)
    np.divide(imag, -size, out=out.imag)
    return out


def combined(weights: NDArray[Any], rows: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Σ_k weights_ik rows_k: for real weights one real product over real and imaginary parts side by side."""
    if np.iscomplexobj(weights):
        return np.asarray(weights @ rows)
    return np.asarray(weights @ np.ascontiguousarray(rows).view(float)).view(complex)


def real_inner(a: NDArray[np.complex128], b: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Re Σ_l a_il b̄_jl, (i, j), as one real product."""
    return np.asarray(np.ascontiguousarray(a).view(float) @ np.ascontiguousarray(b).view(float).T)


def power_of(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """|values|², without the root that ``abs`` takes."""
    return np.asarray(values.real**2 + values.imag**2)


def modal_kernel(
    frequencies_hz: ArrayLike, mode_hz: ArrayLike, damping_ratios: ArrayLike, quantity: str, rate: float = 0.0
) -> NDArray[np.complex128]:
    """s^p / (ω_r² + 2ζ_r ω_r s + s²) for each mode and line, (n_modes, n_lines); p is 0, 1, 2 for receptance, mobility, accelerance.

    s = iω + β with the ``rate`` β [1/s] of an exponential window.
    """
    if quantity not in POWER:
        raise DataError(f"quantity {quantity!r} is none of {', '.join(POWER)}")
    s = 2j * np.pi * np.asarray(frequencies_hz, float) + rate
    w0, zeta = 2 * np.pi * np.asarray(mode_hz, float), np.asarray(damping_ratios, float)
    top = s ** POWER[quantity]
    out = np.empty((w0.size, s.size), complex)
    for rows in row_blocks(*out.shape):
        np.multiply(compliance(s, w0[rows], zeta[rows]), top, out=out[rows])
    return out


def second_order_poles(
    mass: NDArray[np.float64], damping: NDArray[np.float64], stiffness: NDArray[np.float64]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    """Poles (2n,), right and left vectors (n, 2n) of (M λ² + C λ + K) v = 0 with (M s² + C s + K)⁻¹ = Σ v lᵀ/(s − λ)."""
    n = len(mass)
    inverse = np.linalg.inv(mass)
    state = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ stiffness, -inverse @ damping]])
    poles, vectors = np.linalg.eig(state)
    return poles, vectors[:n], (np.linalg.inv(vectors)[:, n:] @ inverse).T


def kernel_derivatives(
    frequencies_hz: ArrayLike, mode_hz: ArrayLike, damping_ratios: ArrayLike, rate: float = 0.0
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    """The accelerance kernel g of each mode and line and its derivatives by ln f_r and ln ζ_r, each (n_modes, n_lines)."""
    s = 2j * np.pi * np.asarray(frequencies_hz, float) + rate
    w0, zeta = 2 * np.pi * np.asarray(mode_hz, float), np.asarray(damping_ratios, float)
    squared = s * s
    g, by_hz, by_zeta = (np.empty((w0.size, s.size), complex) for _ in range(3))
    for rows in row_blocks(*g.shape):
        inverse = compliance(s, w0[rows], zeta[rows])
        np.multiply(inverse, squared, out=g[rows])
        inverse *= -g[rows]
        np.multiply(inverse, (2 * zeta[rows] * w0[rows])[:, None] * s, out=by_zeta[rows])
        np.multiply(inverse, (2 * w0[rows] ** 2)[:, None], out=by_hz[rows])
        by_hz[rows] += by_zeta[rows]
    return g, by_hz, by_zeta


def synthesise(
    frequencies_hz: ArrayLike,
    mode_hz: ArrayLike,
    damping_ratios: ArrayLike,
    response_shapes: NDArray[Any],
    reference_shapes: NDArray[Any],
    quantity: str = "accelerance",
) -> NDArray[np.complex128]:
    """H = Σ_r (iω)^p φ_r,resp φ_r,ref / (ω_r² − ω² + 2iζ_rω_rω), (n_responses, n_references, n_lines).

    Shapes (n_responses, n_modes) and (n_references, n_modes) are real, of unit modal mass.
    """
    kernel = modal_kernel(frequencies_hz, mode_hz, damping_ratios, quantity)
    residues = (response_shapes[:, None, :] * reference_shapes[None, :, :]).reshape(
        len(response_shapes) * len(reference_shapes), kernel.shape[0]
    )
    return combined(residues, kernel).reshape(response_shapes.shape[0], reference_shapes.shape[0], kernel.shape[1])


def synthesis_variance(
    frequencies_hz: ArrayLike,
    mode_hz: NDArray[np.float64],
    damping_ratios: NDArray[np.float64],
    shapes: NDArray[np.float64],
    covariance: NDArray[np.float64],
    responses: ArrayLike,
    references: ArrayLike,
    quantity: str = "accelerance",
    signs: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Variance E|ΔH|² of synthesised FRFs (n_responses, n_references, n_lines), to first order in the modal parameters.

    ``covariance`` (p, p) is of [f (Hz), ζ, shapes (m, n_modes) mode by mode], p = n_modes·(2 + m); ``responses`` and ``references`` are
    rows of the shapes; ``signs`` (n_modes,) are −1 for terms that are taken away.
    """
    n = mode_hz.size
    out_rows, in_rows = np.asarray(responses, int), np.asarray(references, int)
    kernel = modal_kernel(frequencies_hz, mode_hz, damping_ratios, quantity)
    w = 2 * np.pi * np.asarray(frequencies_hz, float)
    wr = 2 * np.pi * mode_hz[:, None]
    z = damping_ratios[:, None]
    # ∂/∂p of (iω)^a/D is −kernel/D·∂D/∂p.
    over = -kernel * modal_kernel(frequencies_hz, mode_hz, damping_ratios, "receptance")
    base = np.concatenate([over * (2 * wr + 2j * z * w) * 2 * np.pi, over * 2j * wr * w, kernel])
    if signs is not None:
        base *= np.tile(signs, 3)[:, None]
    # H of two DOFs is the same both ways
    pairs = np.sort(np.stack(np.meshgrid(out_rows, in_rows, indexing="ij"), axis=-1).reshape(-1, 2), axis=1)
    keys, index = np.unique(pairs, axis=0, return_inverse=True)
    found = np.zeros((len(keys), w.size))
    few = max(16, 8 * _FORM_VALUES // max(3 * n * (3 * n + 1) // 2, 1))
    for first in range(0, len(keys) if n else 0, few):
        found[first : first + few] = _quadratic_forms(base, _pair_covariances(shapes, covariance, keys[first : first + few]))
    return np.asarray(np.maximum(found, 0)[index.ravel()].reshape(out_rows.size, in_rows.size, w.size))


def _pair_covariances(shapes: NDArray[np.float64], covariance: NDArray[np.float64], keys: NDArray[np.int_]) -> NDArray[np.float64]:
    """Covariance of the amounts of the 3n functions in the FRF of each pair of DOFs, its upper triangle by rows, (pairs, 3n(3n+1)/2)."""
    m, n = shapes.shape
    mode, upper = np.arange(n), np.triu_indices(3 * n)
    out = np.empty((len(keys), upper[0].size))
    for row, (i, j) in zip(out, keys, strict=True):
        product = shapes[i] * shapes[j]
        # On a drive point both terms act on the same row: the index stands twice and the terms add up.
        index = np.concatenate([mode, n + mode, 2 * n + mode * m + i, 2 * n + mode * m + j])
        factor = np.concatenate([product, product, shapes[j], shapes[i]])
        part = covariance[np.ix_(index, index)] * np.outer(factor, factor)
        # both shape values come with the kernel
        part[:, 2 * n : 3 * n] += part[:, 3 * n :]
        part[2 * n : 3 * n] += part[3 * n :]
        row[:] = part[: 3 * n, : 3 * n][upper]
    return out


def _quadratic_forms(functions: NDArray[np.complex128], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Σ_ab C_ab Re(g_a ḡ_b) of each symmetric C on each line, (matrices, lines): of many, products are made once for all of them."""
    count, n_lines = functions.shape
    first, second = np.triu_indices(count)
    if len(triangles) <= _FEW_FORMS:
        full = np.empty((len(triangles), count, count))
        full[:, first, second] = full[:, second, first] = triangles
        parts = functions.real.copy(), functions.imag.copy()
        return np.asarray(sum(np.einsum("mal,al->ml", full @ part, part) for part in parts))
    weights = np.where(first == second, 1, 2) * triangles  # each product of two functions stands twice
    step = max(32, _FORM_VALUES // first.size)
    out = np.empty((triangles.shape[0], n_lines))
    for start in range(0, n_lines, step):
        part = functions[:, start : start + step]
        real, imag = part.real.copy(), part.imag.copy()
        products, end = np.empty((first.size, real.shape[1])), 0
        for a in range(count):
            rows = products[end : (end := end + count - a)]
            np.multiply(real[a], real[a:], out=rows)
            rows += imag[a] * imag[a:]
        out[:, start : start + step] = weights @ products
    return out
