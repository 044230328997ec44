"""A mode that the idle model lacks, as a candidate: where one more pole takes most from the error, and its shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.predict import Term
from operando.diagnose.scan import Candidate
from operando.diagnose.sets import CheckLines
from operando.synthesis import modal_kernel

Array = NDArray[Any]

GRID = 240
"""Frequencies tried in the band before the best is refined."""

DAMPINGS = (0.003, 0.008, 0.02, 0.05)


def missing_mode_candidate(term: Term, n_dofs: int, lines: CheckLines, error: Array, weight: Array) -> Candidate | None:
    """Pole whose free residues take most from the error, with the real shape nearest to them.

    Parameters
    ----------
    term : Term
        Of the kind that adds a mode.
    n_dofs : int
        DOFs of the idle model.
    lines : CheckLines
    error, weight : (lines, responses, references) arrays
        Measured minus model, and 1/variance.
    """
    low, high = term.band_hz
    flat, w = error.reshape(error.shape[0], -1), weight.reshape(error.shape[0], -1)

    def taken(hz: Array, zeta: float) -> tuple[Array, Array]:
        g = modal_kernel(lines.hz, hz, np.full(hz.size, zeta), "receptance")
        cross = g.real @ (w * flat.real) + g.imag @ (w * flat.imag)
        power = np.maximum((np.abs(g) ** 2) @ w, 1e-300)
        return np.sum(cross**2 / power, axis=1), cross / power

    best = (-np.inf, 0.0, 0.0)
    for zeta in DAMPINGS:
        hz = np.linspace(low, high, GRID)
        for _ in range(3):
            fall, _ = taken(hz, zeta)
            k = int(np.argmax(fall))
            best = max(best, (float(fall[k]), float(hz[k]), zeta))
            step = hz[1] - hz[0]
            hz = np.linspace(hz[k] - 2 * step, hz[k] + 2 * step, 41)
    fall_best, hz_best, zeta_best = best
    if not np.isfinite(fall_best) or fall_best <= 0:
        return None
    residues = taken(np.array([hz_best]), zeta_best)[1].reshape(error.shape[1:])
    u, s, vh = np.linalg.svd(residues, full_matrices=False)
    shape = np.zeros(n_dofs)
    row = {int(d): i for i, d in enumerate(lines.responses)}
    at = [row[int(r)] for r in lines.references if int(r) in row]
    columns = [i for i, r in enumerate(lines.references) if int(r) in row]
    across = float(u[at, 0] @ vh[0, columns]) if at else 0.0
    if across <= 0:
        # A mode adds to its drive points: nothing else is one.
        return None
    scale = np.sqrt(s[0] * float(vh[0, columns] @ vh[0, columns]) / across)
    shape[lines.responses] = u[:, 0] * scale
    left = float(np.sum(weight * np.abs(error) ** 2)) - fall_best
    q = term.inward({"frequency": hz_best, "damping_ratio": zeta_best, "shape": shape})
    return Candidate(term, q, left / max(int(np.count_nonzero(weight)), 1))
