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
    residues = (response_shapes[:, None, :] * reference_shapes[None, :, :]).reshape(-1, kernel.shape[0])
    if np.iscomplexobj(residues):
        out = residues @ kernel
    else:
        stacked = residues @ np.concatenate([kernel.real, kernel.imag], axis=1)
        out = stacked[:, : kernel.shape[1]] + 1j * stacked[:, kernel.shape[1] :]
    return out.reshape(response_shapes.shape[0], reference_shapes.shape[0], -1)
