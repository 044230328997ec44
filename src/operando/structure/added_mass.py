"""Added masses as part of a modal model: what level-dependent effects beside them are simulated and fitted with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from operando.data import ModalModel
from operando.errors import DataError
from operando.structure.effects import Effect, place_weights

Array = NDArray[Any]

_STEP = 0.1  # standard deviations of the idle parameters, for derivatives


def with_masses(idle: ModalModel, effects: Sequence[Effect]) -> tuple[ModalModel, list[Effect]]:
    """The idle model with the point masses among some effects as part of it, and the other effects.

    Modes and residual terms with the mass: K v = ω²(I + Φᵀ m Φ) v. They keep the sum of their damping; that it ties the new modes to each
    other is left out, an error of second order in the damping ratios. Of a residual term that is moved among the modes, the term that
    it was the most part of stays a residual one.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect

    Raises
    ------
    DataError
        If a mass cannot be taken away (less would be left than none), or stands at a position without a sensor; or if residual terms of
        the model are taken away.
    """
    masses = [e for e in effects if e.kind == "point_mass"]
    if not masses:
        return idle, list(effects)
    if np.any(idle.terms.signs < 0):
        raise DataError(
            "the model has residual terms that are taken away, so masses cannot become part of it", hint="begin with idle modes"
        )
    if any(not e.location for e in masses):
        raise DataError("a mass stands at a position without a sensor: not simulated yet", hint="name measured DOFs")
    places = [(e.sign * float(e.values["mass"]), place_weights(e, idle)) for e in masses]
    terms = idle.terms
    start = np.concatenate([terms.frequencies_hz, terms.damping_ratios, np.asarray(terms.shapes).T.ravel()])
    end, part = _moved(start, terms.n, places)
    covariance = None
    if idle.covariance is not None:
        step = _STEP * np.sqrt(np.diag(idle.covariance))
        told = np.flatnonzero(step > 0)
        slopes = np.zeros((start.size, start.size))
        for at in told:
            ends = [_moved(start + side * step[at] * np.eye(start.size)[at], terms.n, places, part)[0] for side in (1, -1)]
            slopes[:, at] = (ends[0] - ends[1]) / (2 * step[at])
        covariance = slopes @ idle.covariance @ slopes.T
    f, zeta, shapes = np.split(end, [terms.n, 2 * terms.n])
    made = idle.with_terms(
        frequencies_hz=f,
        damping_ratios=zeta,
        shapes=shapes.reshape(terms.n, -1).T,
        covariance=covariance,
        std=None,
        coupling=None,
        details=None,
    )
    return made, [e for e in effects if e.kind != "point_mass"]


def _moved(start: Array, n: int, places: Sequence[tuple[float, Array]], like: Array | None = None) -> tuple[Array, Array]:
    """Frequencies, damping ratios and shapes with masses, in the order of the terms that are most part of each; and their parts (n, n)."""
    f, zeta, shapes = start[:n], start[n : 2 * n], start[2 * n :].reshape(n, -1)
    w = 2 * np.pi * f
    mass = np.eye(n)
    for size, weights in places:
        at = weights @ shapes.T
        mass = mass + size * at.T @ at
    try:
        values, vectors = eigh(np.diag(w**2), mass)
    except np.linalg.LinAlgError as error:
        raise DataError("more mass would be taken away than there is", hint="give a smaller mass") from error
    wanted = np.eye(n) if like is None else like
    order, left = np.empty(n, int), np.abs(wanted.T @ vectors)
    for _ in range(n):
        row, column = np.unravel_index(np.argmax(left), left.shape)
        order[row] = column
        left[row], left[:, column] = -1, -1
    vectors = vectors[:, order] * np.sign(np.sum(wanted * vectors[:, order], axis=0))
    new = np.sqrt(np.maximum(values[order], 0))
    damping = np.sum(vectors**2 * (2 * zeta * w)[:, None], axis=0) / np.maximum(2 * new, 1e-300)
    return np.concatenate([new / 2 / np.pi, np.where(new > 0, damping, zeta), (vectors.T @ shapes).ravel()]), vectors
