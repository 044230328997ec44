"""What no driven column tells of the FRFs between DOFs that were not driven."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.modal_terms import ModalTerms

BETWEEN, OWN = 0.4, 2.0
"""Standard deviation of the compliance from above the band between two undriven DOFs, over the root of the product of what the model has
of each, and of that of one DOF over its own: with these the 95 % bands of 72 simulated idle models hold the exact FRFs on 94 % of lines
(``benchmarks/README.md``, "Bands of undriven pairs")."""


def undriven_variance(terms: ModalTerms, rows: ArrayLike, columns: ArrayLike, known: ArrayLike = ()) -> NDArray[np.float64]:
    """Variance E|ΔH|² [m²/N²] (rows, columns) of receptances for what lies above the band, on any line; 0 where a DOF was driven.

    The residual terms are fitted to the driven columns, and where they go on to other columns they are a guess: of each undriven DOF a
    term of its own holds a compliance that was seen nowhere, and nothing says how those of two DOFs go together. Such an error has the
    sense of the FRF or the opposite, so it counts twice as much as a circular one. Of ``known`` DOFs a validation measurement told this.
    """
    shapes, residual = np.asarray(terms.shapes), np.flatnonzero(terms.residual)
    alone = [r for r in residual if np.count_nonzero(shapes[:, r]) == 1 < len(terms.dofs)]
    own = np.zeros(len(terms.dofs))
    if alone:
        top = terms.frequencies_hz[~terms.residual].max(initial=0.0)
        above = residual[terms.frequencies_hz[residual] > top]
        compliance = (np.abs(shapes[:, above]) ** 2 * terms.signs[above] / (2 * np.pi * terms.frequencies_hz[above]) ** 2).sum(axis=1)
        undriven = np.setdiff1d(np.nonzero(shapes[:, alone])[0], np.asarray(known, int))
        own[undriven] = np.maximum(compliance[undriven], 0)
    rows, columns = np.asarray(rows, int), np.asarray(columns, int)
    share = np.where(rows[:, None] == columns, OWN, BETWEEN)
    return np.asarray(2 * share**2 * own[rows][:, None] * own[columns])
