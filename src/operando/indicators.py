"""Indicators of modal vectors: MAC, MPC, MPD."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.modal import phase_collinearity

__all__ = ["mac", "mean_phase_deviation", "phase_collinearity"]

INTERVAL = 1.96
"""Standard deviations in the 95 % interval, which is what ± stands for wherever people read it."""


def mac(first: ArrayLike, second: ArrayLike | None = None) -> NDArray[np.float64]:
    """Modal assurance criterion |aᴴb|²/((aᴴa)(bᴴb)) (Shen & Lu 2024, Eq 1).

    Parameters
    ----------
    first : (m, n1) array
    second : (m, n2) array, optional
        Default: ``first`` (AutoMAC).

    Returns
    -------
    (n1, n2) array between 0 and 1; 0 where a vector is null.
    """
    a = np.asarray(first)
    a = a[:, None] if a.ndim == 1 else a
    b = a if second is None else np.asarray(second)
    b = b[:, None] if b.ndim == 1 else b
    cross = np.abs(a.conj().T @ b) ** 2
    norm = np.outer(np.sum(np.abs(a) ** 2, axis=0), np.sum(np.abs(b) ** 2, axis=0))
    return np.divide(cross, norm, out=np.zeros_like(norm), where=norm > 0)


def mean_phase_deviation(shape: ArrayLike) -> float:
    """Mean phase deviation [rad] of one shape from its principal axis, weighted by magnitude (Reynders et al. 2012)."""
    v: NDArray[Any] = np.asarray(shape, complex)
    if not np.any(v):
        return 0.0
    axis = np.linalg.svd(np.column_stack([v.real, v.imag]), full_matrices=False)[2][0]
    along = np.abs(v.real * axis[0] + v.imag * axis[1])
    size = np.abs(v)
    angle = np.arccos(np.clip(np.divide(along, size, out=np.ones_like(size), where=size > 0), 0, 1))
    return float(np.sum(size * angle) / np.sum(size))
