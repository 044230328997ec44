"""FRF synthesis from modal parameters (Shen & Lu 2024, Eq 4), as one real matrix product over lines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import DataError

_POWER = {"receptance": 0, "mobility": 1, "accelerance": 2}


def modal_kernel(frequencies_hz: ArrayLike, mode_hz: ArrayLike, damping_ratios: ArrayLike, quantity: str) -> NDArray[np.complex128]:
    """(iω)^p / (ω_r² − ω² + 2iζ_r ω_r ω) for each mode and line.

    Returns
    -------
    (n_modes, n_lines) complex array
        p is 0, 1, 2 for receptance, mobility, accelerance.

    Raises
    ------
    DataError
        If the quantity is unknown.
    """
    if quantity not in _POWER:
        raise DataError(f"quantity {quantity!r} is none of {', '.join(_POWER)}")
    w = 2 * np.pi * np.asarray(frequencies_hz, float)[None, :]
    wr = 2 * np.pi * np.asarray(mode_hz, float)[:, None]
    z = np.asarray(damping_ratios, float)[:, None]
    return (1j * w) ** _POWER[quantity] / (wr**2 - w**2 + 2j * z * wr * w)


def synthesise(
    frequencies_hz: ArrayLike,
    mode_hz: ArrayLike,
    damping_ratios: ArrayLike,
    response_shapes: NDArray[Any],
    reference_shapes: NDArray[Any],
    quantity: str = "accelerance",
) -> NDArray[np.complex128]:
    """H = Σ_r (iω)^p φ_r,resp φ_r,ref / (ω_r² − ω² + 2iζ_rω_rω).

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
    mode_hz, damping_ratios : (n_modes,) arrays
    response_shapes : (n_responses, n_modes) real array of unit modal mass
    reference_shapes : (n_references, n_modes) real array of unit modal mass
    quantity : {"accelerance", "mobility", "receptance"}

    Returns
    -------
    (n_responses, n_references, n_lines) complex array
    """
    kernel = modal_kernel(frequencies_hz, mode_hz, damping_ratios, quantity)
    residues = (response_shapes[:, None, :] * reference_shapes[None, :, :]).reshape(
        len(response_shapes) * len(reference_shapes), kernel.shape[0]
    )
    if np.iscomplexobj(residues):
        out = residues @ kernel
    else:
        stacked = residues @ np.concatenate([kernel.real, kernel.imag], axis=1)
        out = stacked[:, : kernel.shape[1]] + 1j * stacked[:, kernel.shape[1] :]
    return out.reshape(response_shapes.shape[0], reference_shapes.shape[0], kernel.shape[1])


def synthesis_variance(
    frequencies_hz: ArrayLike,
    mode_hz: NDArray[np.float64],
    damping_ratios: NDArray[np.float64],
    shapes: NDArray[np.float64],
    covariance: NDArray[np.float64],
    responses: ArrayLike,
    references: ArrayLike,
    quantity: str = "accelerance",
) -> NDArray[np.float64]:
    """Variance E|ΔH|² of synthesised FRFs, to first order in the modal parameters.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
    mode_hz, damping_ratios : (n_modes,) arrays
    shapes : (m, n_modes) real array of unit modal mass
    covariance : (p, p) array
        Of [f (Hz), ζ, shapes mode by mode], p = n_modes·(2 + m).
    responses, references : int arrays
        Rows of ``shapes``.
    quantity : {"accelerance", "mobility", "receptance"}

    Returns
    -------
    (n_responses, n_references, n_lines) array
    """
    n, m = mode_hz.size, shapes.shape[0]
    out_rows, in_rows = np.asarray(responses, int), np.asarray(references, int)
    kernel = modal_kernel(frequencies_hz, mode_hz, damping_ratios, quantity)
    w = 2 * np.pi * np.asarray(frequencies_hz, float)[None, :]
    wr = 2 * np.pi * mode_hz[:, None]
    z = damping_ratios[:, None]
    # ∂/∂p of (iω)^a/D is −kernel/D·∂D/∂p.
    over = -kernel / (wr**2 - w**2 + 2j * z * wr * w)
    by_hz = over * (2 * wr + 2j * z * w) * 2 * np.pi
    by_zeta = over * 2j * wr * w
    mode = np.arange(n)
    result = np.empty((out_rows.size, in_rows.size, w.shape[1]))
    done: dict[tuple[int, int], NDArray[np.float64]] = {}
    for a, i in enumerate(out_rows):
        for b, j in enumerate(in_rows):
            key = (min(i, j), max(i, j))
            if key not in done:
                product = (shapes[i] * shapes[j])[:, None]
                # On a drive point both terms act on the same row: the index stands twice and the terms add up.
                gradient = np.concatenate([product * by_hz, product * by_zeta, shapes[j][:, None] * kernel, shapes[i][:, None] * kernel])
                index = np.concatenate([mode, n + mode, 2 * n + mode * m + i, 2 * n + mode * m + j])
                part = covariance[np.ix_(index, index)]
                value = np.zeros(w.shape[1])
                for g in (gradient.real, gradient.imag):
                    value += np.einsum("kl,kl->l", g, part @ g)
                done[key] = np.maximum(value, 0)
            result[a, b] = done[key]
    return result
