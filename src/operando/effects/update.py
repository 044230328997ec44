"""The exact change of FRFs by added dynamic stiffness (Sherman–Morrison–Woodbury), for skew additions too."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complexfloating[Any, Any]]


def woodbury_core(z: Complex, h_bb: Complex) -> Complex:
    """(I + δZ·H_bb)⁻¹ δZ, line by line.

    Parameters
    ----------
    z : (n_lines, k, k) array
        Added dynamic stiffness.
    h_bb : (k, k, n_lines) array
        Receptance between the places.

    Returns
    -------
    (k, k, n_lines) array
    """
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


def woodbury(h: Complex, h_ib: Complex, h_bj: Complex, h_bb: Complex, z: Complex) -> Complex:
    """H_ij − H_ib (I + δZ·H_bb)⁻¹ δZ·H_bj in receptance.

    Parameters
    ----------
    h : (n_responses, n_references, n_lines) array
    h_ib : (n_responses, k, n_lines) array
    h_bj : (k, n_references, n_lines) array
    h_bb : (k, k, n_lines) array
    z : (n_lines, k, k) array

    Returns
    -------
    (n_responses, n_references, n_lines) array
    """
    core = woodbury_core(z, h_bb)
    k = core.shape[0]
    out = h
    for a in range(k):
        seen = core[a, 0] * h_bj[0]
        for b in range(1, k):
            seen = seen + core[a, b] * h_bj[b]
        out = out - h_ib[:, a, None, :] * seen[None]
    return out
