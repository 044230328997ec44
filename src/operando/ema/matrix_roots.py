"""Where a matrix polynomial is singular: eigenvalues of its companion matrix, or simultaneous iteration from roots nearly known.

The denominators of neighbouring model orders have most of their roots nearly in common. From those of the order before, the iteration of
Ehrlich and Aberth on det A(z) (Bini & Noferini, Linear Algebra Appl. 439, 2013, 1130–1149) finds the roots of an order in a tenth of the
time that the QR algorithm takes for 300 of them, and to the same digits. A set that is not complete is seen by its sum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Complex = NDArray[np.complex128]

NEAR = 1e-7
"""A relative correction below which the next one, its third power, is lost in rounding; so are errors of the sum far below its root."""

SWEEPS = 40
"""Three to four times what roots of the order before need; beyond, the companion matrix is asked."""

SUM_ERROR = 1e-9
"""Relative error of the sum of the roots that rounding explains: it stays below 1e-13 on FRFs with 300 poles."""

FEW = 40
"""So many roots are found by the companion matrix in less time."""


def companion_roots(blocks: NDArray[Any]) -> Complex:
    """z where A(z) = Σ α_k z^k is singular, by the companion matrix of the end that is the identity; none at zero or infinity."""
    n, n_in = blocks.shape[0] - 1, blocks.shape[1]
    lowest = _lowest(blocks)
    monic = blocks[1:] if lowest else blocks[-2::-1]
    k = n * n_in
    companion = np.zeros((k, k), blocks.dtype, order="F")
    companion[:n_in] = -monic.transpose(2, 0, 1).reshape(n_in, k)
    companion[np.arange(n_in, k), np.arange(k - n_in)] = 1.0
    roots = linalg.eigvals(companion, overwrite_a=True, check_finite=False)
    roots = roots[np.abs(roots) > 1e-12]
    return np.asarray(1 / roots if lowest else roots, complex)


def roots_near(blocks: NDArray[Any], known: Complex | None) -> Complex:
    """The same of blocks α_0 … α_n (n + 1, n_in, n_in) from the roots of nearly the same polynomial of lower order, where there are such.

    The first or the last block is the identity. Real polynomials are solved by their companion.
    """
    count = (blocks.shape[0] - 1) * blocks.shape[1]
    if known is None or not np.iscomplexobj(blocks) or count <= FEW or known.size < count // 2:
        return companion_roots(blocks)
    found = _iterated(blocks, _with_new(known, count))
    return companion_roots(blocks) if found is None else found


def polynomial_values(blocks: NDArray[Any], z: Complex) -> Complex:
    """A(z) at each z, (k, n_in, n_in); beyond the unit circle z⁻ⁿA(z), which does not overflow."""
    far = np.abs(z) > 1
    powers = _powers(np.where(far, 1 / z, z), blocks.shape[0])
    flat = blocks.reshape(blocks.shape[0], -1)
    return np.where(far[:, None], powers @ flat[::-1], powers @ flat).reshape(-1, *blocks.shape[1:])


def _lowest(blocks: NDArray[Any]) -> bool:
    return bool(np.array_equal(blocks[0], np.eye(blocks.shape[1])))


def _powers(w: Complex, count: int) -> Complex:
    out = np.empty((w.size, count), complex)
    out[:, 0], out[:, 1:] = 1, w[:, None]
    return np.cumprod(out, axis=1, out=out)


def _with_new(known: Complex, count: int) -> Complex:
    """The known roots, and new ones on their typical circle in the widest gaps of angle."""
    angle = np.sort(np.angle(known))
    gap = np.diff(np.append(angle, angle[0] + 2 * np.pi))
    widest = np.argsort(gap)[::-1]
    new = max(0, count - known.size)
    # round and round the gaps where there are more new roots than gaps: later ones take another place in them
    turn, at = np.divmod(np.arange(new), known.size)
    place = angle[widest[at]] + gap[widest[at]] * (0.5 + turn) / (1.5 + new // known.size)
    return np.concatenate([known, float(np.median(np.abs(known))) * np.exp(1j * place)])[:count]


def _logarithmic_derivative(blocks: NDArray[Any], z: Complex) -> Complex:
    """(det A)′/det A = tr(A⁻¹A′) at each z."""
    n, n_in = blocks.shape[0] - 1, blocks.shape[1]
    flat = blocks.reshape(n + 1, -1)
    far = np.abs(z) > 1
    powers = _powers(np.where(far, 1 / z, z), n + 1)
    out = np.empty(z.size, complex)
    order = np.arange(1, n + 1)[:, None]
    for part, of in ((~far, flat), (far, flat[::-1])):
        value = (powers[part] @ of).reshape(-1, n_in, n_in)
        slope = (powers[part, :-1] @ (of[1:] * order)).reshape(-1, n_in, n_in)
        out[part] = np.trace(np.linalg.solve(value, slope), axis1=1, axis2=2)
    # A(z) = zⁿB(1/z)
    out[far] = n * n_in / z[far] - out[far] / z[far] ** 2
    return out


def _iterated(blocks: NDArray[Any], start: Complex) -> Complex | None:
    """All roots by simultaneous iteration, or None where one does not converge or is missing."""
    z = start.copy()
    moving = np.arange(z.size)
    with np.errstate(all="ignore"):
        for _ in range(SWEEPS):
            own = z[moving]
            try:
                slope = _logarithmic_derivative(blocks, own)
            except np.linalg.LinAlgError:
                return None
            apart = own[:, None] - z[None, :]
            apart[np.arange(moving.size), moving] = np.inf
            step = 1 / (slope - np.sum(1 / apart, axis=1))
            z[moving] = own - step
            # Newton's step, too, must be small: next to another approximation the other one is
            moving = moving[~((np.abs(step) < NEAR * np.abs(own)) & (np.abs(slope * own) > 1 / np.sqrt(NEAR)))]
            if not moving.size:
                break
        lowest = _lowest(blocks)
        ends = 1 / z if lowest else z
        total = -np.trace(blocks[1] if lowest else blocks[-2])
        complete = np.abs(ends.sum() - total) < SUM_ERROR * np.abs(ends).sum()
    return z if not moving.size and complete and np.all(np.isfinite(z)) else None
