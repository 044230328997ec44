"""How far two days differ here: spreads of what differs, estimated with each state by its evidence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor
from operando.diagnosis.problem import Problem, Step

Array = NDArray[Any]

WIDER = 0.7  # logarithm of a spread, at most in a step
_LEAST_CURVATURE = 4.0  # of the evidence by the logarithm of a spread: a step is no farther than a quarter of the gradient


def covariance(problem: Problem, factor: Factor) -> tuple[Array, Array, Array]:
    """Posterior covariance (n, n) of d and of the own unknowns of each DOF, in units of their priors; where each of them stands in it.

    The rows of ``d`` are (d,), those of the own unknowns (DOFs, k).
    """
    forward = problem.forward
    root = factor.root()
    n_d, k = forward.n_d, forward.n_own
    first = problem.values_at + problem.n_values
    far = len(factor.lower) - first
    own = problem.order.size * k
    rows = np.zeros((n_d + far + own, root.shape[1]))
    rows[:n_d], rows[n_d : n_d + far] = root[forward.n_g : forward.n_g + n_d], root[first : first + far]
    rows[n_d + far :] = root[len(factor.lower) :]
    at_own = np.full((forward.n_dofs, k), -1)
    at_own[problem.order] = n_d + far + np.arange(own).reshape(-1, k)
    for dof, at, shared in problem.reaching:
        at_own[dof, at] = n_d - first + np.arange(shared.start, shared.stop)
    full = np.eye(len(rows) + 1)  # the last one stands for all that no row shows
    full[:-1, :-1] = rows @ rows.T
    return full, np.arange(n_d), np.where(at_own < 0, len(rows), at_own)


def likely_spreads(problem: Problem, x: Step, factor: Factor, most: float) -> tuple[Array, float]:
    """Step of the logarithms of all spreads towards the largest evidence, of at most so much, and the nats it promises.

    Type-II likelihood (MacKay, Neural Computation 4, 1992, 415–447, section 4) with a prior of each factor. With the mode x and the
    covariance C of the unknowns in units of their spreads, the gradient of the evidence by ln s of group a is Σ(x² + C) − n over its n
    unknowns; its negative second derivative by a and b is 4 xᵀC x + 2 ΣC² over the unknowns of both, taken from 2 Σ(x² + C) where a is b.
    """
    between, n_shape = problem.case.between, problem.forward.n_shape
    point = problem.point(x)
    full, at_d, at_own = covariance(problem, factor)
    values = np.zeros(len(full))
    values[at_own], values[at_d] = point.own, point.d
    on = [number for number, *_ in between.estimated]
    member = np.zeros((len(on), len(full)))
    for row, (_, _, shared, where) in enumerate(between.estimated):
        at = (at_d[where] if shared else at_own[:, n_shape:][where]).ravel()
        member[row, at[at < len(full) - 1]] = 1
    if not on:
        return np.zeros(between.log_factors.size), 0.0
    precision = between.precision_of_factors()[np.ix_(on, on)]
    power = member @ (values**2 + np.diag(full))
    gradient = power - member.sum(axis=1) - precision @ between.log_factors[on]
    both = member @ (4 * np.outer(values, values) * full + 2 * full**2) @ member.T
    curvature, along = np.linalg.eigh(2 * np.diag(power) - both + precision)
    some = along @ (along.T @ gradient / np.maximum(curvature, _LEAST_CURVATURE))
    step = np.zeros(between.log_factors.size)
    step[on] = some * min(1.0, most / max(float(np.abs(some).max()), 1e-9))
    return step, 0.5 * float(gradient @ some)


def rescaled(problem: Problem, x: Step, by: Array) -> tuple[Problem, Step]:
    """The same point where spreads are larger by exp(by)."""
    point, between = problem.point(x), problem.case.between
    d, own = np.array(point.d), np.array(point.own)
    for (_, shared, where), factor in zip(between.groups, np.exp(by), strict=True):
        values = d if shared else own[:, problem.forward.n_shape :]
        values[where] /= factor
    other = Problem(problem.case.widened(by), problem.terms, problem.at)
    return other, other.packed(replace(point, d=d, own=own))


def log_prior(problem: Problem) -> float:
    """Of the logarithms of all spreads, but for a constant."""
    between = problem.case.between
    return -0.5 * float(between.log_factors @ between.precision_of_factors() @ between.log_factors)
