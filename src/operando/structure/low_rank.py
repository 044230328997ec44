"""The exact change of FRFs by added dynamic stiffness (Sherman–Morrison–Woodbury), for skew additions too."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.synthesis import modal_kernel

Complex = NDArray[np.complexfloating[Any, Any]]


def woodbury_core(z: Complex, h_bb: Complex) -> Complex:
    """(I + δZ·H_bb)⁻¹ δZ (k, k, lines) of an added dynamic stiffness δZ (lines, k, k) and receptances between its places (k, k, lines)."""
    k = z.shape[-1]
    if k == 0:
        return np.zeros_like(h_bb)
    if k == 1:
        d = z[:, 0, 0]
        return np.asarray((d / (1 + d * h_bb[0, 0]))[None, None])
    g = np.moveaxis(h_bb, -1, 0)
    if k == 2:
        # Closed form: a batch of small solves costs ten times as much.
        p = z @ g
        a, b, c, d = 1 + p[:, 0, 0], p[:, 0, 1], p[:, 1, 0], 1 + p[:, 1, 1]
        over = 1 / (a * d - b * c)
        out = np.empty((2, 2, len(z)), complex)
        for j in range(2):
            out[0, j] = over * (d * z[:, 0, j] - b * z[:, 1, j])
            out[1, j] = over * (a * z[:, 1, j] - c * z[:, 0, j])
        return out
    return np.moveaxis(np.linalg.solve(np.eye(k) + z @ g, z), 0, -1)


def update_variance(
    base: ModalModel,
    frequencies_hz: NDArray[np.float64],
    responses: tuple[list[int], list[int]],
    references: tuple[list[int], list[int]],
    weights: NDArray[np.float64],
    left: Complex,
    right: Complex,
    shared: tuple[NDArray[np.float64], Complex] | None = None,
) -> NDArray[np.float64]:
    """Variance E|ΔH|² [m²/N²] of updated receptances (o, j, lines), to first order in the modal parameters, from their covariance.

    With A = I − H0_·B T Bᵀ, T = (I + δZ H_BB)⁻¹ δZ, and A' its mirror image on the right, dH = A dH0 A' exactly: ``left`` (o, k, lines) and
    ``right`` (k, j, lines) are H0_oB T and T H0_Bj. ``shared`` is the covariance (n_parameters, p) of the modal parameters with p other
    numbers, and the derivative (p, o, j, lines) of the receptances by these; it adds the part that both have in common (which can be
    negative: the result is then no variance yet).
    """
    assert base.covariance is not None
    n, m, phi = base.terms.n, len(base.dofs), np.asarray(base.terms.shapes)
    w = 2 * np.pi * np.asarray(frequencies_hz, float)[None, :]
    wr, zeta = 2 * np.pi * base.terms.frequencies_hz[:, None], base.terms.damping_ratios[:, None]
    kernel = modal_kernel(frequencies_hz, base.terms.frequencies_hz, base.terms.damping_ratios, "receptance")
    signs = base.terms.signs[:, None]
    by_hz = -signs * kernel**2 * (2 * wr + 2j * zeta * w) * 2 * np.pi
    by_zeta = -signs * kernel**2 * 2j * wr * w
    kernel = signs * kernel
    at = weights @ phi
    touched = np.flatnonzero(np.any(weights != 0, axis=0))
    spread = np.diag(base.covariance) > 0  # terms of what lies out of band have no spread of their poles, many none of their shapes
    modes = [np.flatnonzero(part) for part in (spread[:n], spread[n : 2 * n])]
    by_hz, by_zeta = by_hz[modes[0]], by_zeta[modes[1]]
    at_dof = {d: np.flatnonzero(spread[2 * n + d :: m]) for d in {*touched.tolist(), *responses[0], *references[0]}}
    (out_rows, out_signs), (in_rows, in_signs) = responses, references
    psi = [s * phi[i][:, None] - at.T @ left[o] for o, (i, s) in enumerate(zip(out_rows, out_signs, strict=True))]
    chi = [s * phi[i][:, None] - at.T @ right[:, j] for j, (i, s) in enumerate(zip(in_rows, in_signs, strict=True))]
    lines = w.shape[1]
    result = np.empty((len(out_rows), len(in_rows), lines))
    for o, i in enumerate(out_rows):
        for j, k in enumerate(in_rows):
            parts = [by * (psi[o][of] * chi[j][of]) for by, of in zip((by_hz, by_zeta), modes, strict=True)]
            index = [modes[0], n + modes[1]]
            seen_o, seen_j = kernel * chi[j], kernel * psi[o]
            for d in sorted({i, k, *touched.tolist()}):
                of = at_dof[d]
                a = (out_signs[o] if d == i else 0.0) - weights[:, d] @ left[o]
                b = (in_signs[j] if d == k else 0.0) - weights[:, d] @ right[:, j]
                parts.append(seen_o[of] * a + seen_j[of] * b)
                index.append(2 * n + of * m + d)
            gradient, where = np.concatenate(parts), np.concatenate(index)
            covariance = base.covariance[np.ix_(where, where)]
            both = np.concatenate([gradient.real, gradient.imag], axis=1)
            value = np.einsum("kl,kl->l", both, covariance @ both)
            result[o, j] = np.maximum(value[:lines] + value[lines:], 0)
            if shared is not None:
                by_others = shared[0][where].T @ both  # real and imaginary parts beside each other
                with_others = by_others[:, :lines] * shared[1][:, o, j].real + by_others[:, lines:] * shared[1][:, o, j].imag
                result[o, j] += 2 * with_others.sum(axis=0)
    return result
