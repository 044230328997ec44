"""Errors of FRFs that all responses to one force share: the noise of the force signal, in proportion to the FRFs.

Each FRF is told with a variance of its own, and a fit takes the errors of its responses for independent. Those made by the noise of the
force are not: at a resonance, where little else is left, they move the pole as one response alone would.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.posterior import State

Array = NDArray[Any]


def common_variance(state: State) -> Array:
    """Variance of the relative error that all responses to a force share, (references,), from what a state leaves of all lines.

    On each line the responses tell it with a variance u of their own; the mean of what is left, each line weighed by 1/u² (a moment
    estimate of a variance component: DerSimonian & Laird, Controlled Clinical Trials 7, 1986, 177–188).
    """
    lines = state.case.lines
    _, h, variance, _ = lines.every
    predicted = state.case.forward.predict(state.x, lines.w_all, derivatives=False).h
    weight = np.where(lines.there, np.abs(predicted) ** 2 / variance, 0)
    total = np.maximum(weight.sum(axis=1), 1e-300)
    shared = np.where(lines.there, predicted.conj() * (h - predicted) / variance, 0).sum(axis=1) / total
    responses = total**2 / np.maximum(np.sum(weight**2, axis=1), 1e-300)  # that count: of one alone nothing is common
    excess = np.sum(total**2 * (np.abs(shared) ** 2 - 1 / total), axis=0)
    return np.asarray(np.maximum(excess / np.maximum(np.sum(total**2 * (1 - 1 / responses), axis=0), 1e-300), 0))


def moved_by_force_noise(state: State) -> tuple[Array, Array]:
    """Standard deviations by which such errors move the unknowns of a state without effects, in the units of its posterior.

    (g, n) and (DOFs, k, n), columns of unit variance: a sandwich covariance (White, Econometrica 50, 1982, 1–25) has their products beside
    the posterior's own.
    """
    problem, forward, lines = state.problem, state.case.forward, state.case.lines
    packed, weights = problem.packed(state.x), problem.weights(state.alpha)
    slopes, _ = problem.derived(packed)
    h, basis = problem.predict(packed, False).h, lines.basis(problem.at)[0]
    alike = np.linalg.cholesky(lines.alike(problem.at))
    shared: list[Array] = []
    own: list[Array] = []
    count = 2 * basis.shape[2]  # rows of a pair
    for reference, variance in enumerate(common_variance(state)):
        mine = slice(reference * count, (reference + 1) * count)

        def rows(at: slice, reference: int = reference, mine: slice = mine) -> Array:
            error = basis[at, reference] * h[:, at, reference].T[:, None]  # of each line by itself, and by i
            both = np.stack([np.concatenate([error.real, -error.imag], 2), np.concatenate([error.imag, error.real], 2)], 2)
            return np.asarray(both.reshape(len(error), count, -1) * weights[at, mine, None])

        for moved, out in zip(state.factor.whitened(*slopes.along(rows, mine)), (shared, own), strict=True):
            parts = np.split(moved, 2, axis=-1)
            out.append(np.sqrt(variance / 2) * np.concatenate([part @ alike for part in parts], axis=-1))
    every = np.concatenate(own, axis=-1)
    by_dof = np.zeros((forward.n_dofs, *every.shape[1:]))
    by_dof[problem.order] = every
    return np.concatenate(shared, axis=-1), by_dof
