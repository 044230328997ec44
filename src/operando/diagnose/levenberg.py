"""Levenberg–Marquardt steps over the sizes of effects and the shapes at their places, with closed-form derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.predict import IdleArrays, Prediction, Term, by_size, predict
from operando.diagnose.sets import CheckLines
from operando.diagnose.shapes import ShapePrior, by_directions

Array = NDArray[Any]


def effect_dofs(terms: Sequence[Term]) -> Array:
    """DOFs whose shape values the structural effects lean on."""
    used: set[int] = set()
    for t in terms:
        if t.kind.acts == "dynamic_stiffness" and t.rows.size:
            used |= set(np.flatnonzero(np.any(np.abs(t.rows) > 1e-9, axis=0)).tolist())
    return np.array(sorted(used), int)


def weights(lines: CheckLines, own: Array) -> Array:
    """1/var_total, 0 where not measured."""
    return np.asarray(np.where(np.isfinite(lines.variance), 1 / (lines.variance + own), 0.0))


def split(vector: Array, terms: Sequence[Term]) -> tuple[Array, ...]:
    """Moving numbers term by term."""
    edges = np.cumsum([0, *(t.size for t in terms)])
    return tuple(vector[a:b] for a, b in pairwise(edges))


def jacobian(
    arrays: IdleArrays, lines: CheckLines, terms: Sequence[Term], q: Sequence[Array], prior: ShapePrior, z: Array, p: Prediction
) -> Array:
    """∂H/∂[q, z] (parameters, lines, responses, references)."""
    rows = []
    start = 0
    for i, term in enumerate(terms):
        if term.kind.acts == "dynamic_stiffness":
            rows += [by_size(p, term, q[i], j, lines, start) for j in range(term.size)]
            start += term.rows.shape[0]
            continue
        high = term.bounds()[1]
        for j in range(term.size):
            step = 1e-6 if q[i][j] + 1e-6 <= high[j] else -1e-6
            moved = [v.copy() for v in q]
            moved[i][j] += step
            same = None if term.kind.acts in ("modal_change", "added_mode") else p.kernel
            rows.append((predict(arrays, lines, terms, moved, same).data - p.data) / step)
    own = np.array(rows).reshape(len(rows), *p.data.shape)
    if not prior.size:
        return own
    return np.concatenate([own, by_directions(p, lines, prior.slope(z))])


def levenberg(
    arrays: IdleArrays,
    lines: CheckLines,
    root_w: Array,
    terms: Sequence[Term],
    q: Array,
    z: Array,
    prior: ShapePrior,
    steps: int,
    tolerance: float,
) -> tuple[Array, Array, float]:
    """Minimum of 2·Σ|root_w·e|² + |z|² over [q, z], its normal matrix and cost."""
    n_q, k = q.size, z.size
    bounds = [t.bounds() for t in terms]
    low = np.r_[np.concatenate([np.zeros(0), *(b[0] for b in bounds)]), np.full(k, -np.inf)]
    high = np.r_[np.concatenate([np.zeros(0), *(b[1] for b in bounds)]), np.full(k, np.inf)]
    base = arrays.kernel(lines.hz)
    bare, none = prior.bare(), np.zeros(0)
    x = np.clip(np.r_[q, z], low, high)

    def state(x: Array) -> tuple[IdleArrays, Prediction, Array, float]:
        here = arrays.with_phi(prior.moved(x[n_q:])) if k else arrays
        p = predict(here, lines, terms, split(x[:n_q], terms), base)
        error = root_w * (lines.data - p.data)
        return here, p, error, 2 * float(np.sum(np.abs(error) ** 2)) + float(x[n_q:] @ x[n_q:])

    def corrected(x: Array, now: tuple[IdleArrays, Prediction, Array, float]) -> tuple[Array, tuple[IdleArrays, Prediction, Array, float]]:
        """Sizes alone, once more: they make up for what moved shapes bend, so that the valley of both is followed."""
        here, p, error, cost = now
        jac = (jacobian(here, lines, terms, split(x[:n_q], terms), bare, none, p) * root_w).reshape(n_q, -1)
        move = np.clip(solve(np.real(jac.conj() @ jac.T), np.real(jac.conj() @ error.ravel())), -1, 1)
        trial = np.clip(np.r_[x[:n_q] + move, x[n_q:]], low, high)
        new = state(trial)
        return (trial, new) if new[3] < cost else (x, now)

    here, p, error, cost = state(x)
    normal = np.zeros((x.size, x.size))
    if not x.size:
        return x, normal, cost
    damping = 1e-5
    for _ in range(steps):
        jac = jacobian(here, lines, terms, split(x[:n_q], terms), prior, x[n_q:], p) * root_w
        flat = jac.reshape(x.size, -1)
        stacked = np.concatenate([flat.real, flat.imag], axis=1)
        normal = 2 * stacked @ stacked.T
        slope = 2 * stacked @ np.concatenate([error.real.ravel(), error.imag.ravel()])
        normal[np.arange(n_q, x.size), np.arange(n_q, x.size)] += 1
        slope[n_q:] -= x[n_q:]
        # What stands at a bound and is pushed outwards stays there.
        held = ((x <= low) & (slope < 0)) | ((x >= high) & (slope > 0))
        better = False
        for _ in range(9):
            matrix = normal + damping * np.diag(np.diag(normal) + 1e-300)
            matrix[held] = 0
            matrix[:, held] = 0
            matrix[held, held] = 1
            move = solve(matrix, np.where(held, 0, slope))
            move[:n_q] = np.clip(move[:n_q], -1, 1)
            trial = np.clip(x + move, low, high)
            new = state(trial)
            if k and n_q:
                trial, new = corrected(trial, new)
            if np.isfinite(new[3]) and new[3] < cost:
                better = True
                break
            damping = max(damping * 8, 1e-6)
        if not better:
            break
        gain = cost - new[3]
        x = trial
        here, p, error, cost = new
        damping = max(damping / 8, 1e-12)
        if gain < 1e-4 + tolerance * cost:
            break
    return x, normal, cost


def solve(matrix: Array, right: Array) -> Array:
    """x of matrix·x = right, scaled to a unit diagonal; of least norm where the matrix is singular."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    try:
        return np.asarray(np.linalg.solve(matrix * scale[:, None] * scale, right * scale) * scale)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrix * scale[:, None] * scale, rcond=1e-12) @ (right * scale) * scale)


SINGULAR = 1e-13
"""Eigenvalue of a normal matrix of unit diagonal, over the largest, below which rounding (2e-16 times some hundred sums) makes it."""

SHARE = 1e-6
"""Part of a parameter's square in directions that nothing tells, above which it is not observable: its variance would be above
``SHARE``/``SINGULAR``, ten million times what the lines leave of a parameter that they tell."""


def inverse(normal: Array) -> Array:
    """Inverse of a symmetric matrix, scaled to a unit diagonal, over the directions that the data tell.

    A prediction of the same data does not move along the others, so they add nothing to its variance. Of the parameters themselves those
    that :func:`unobservable` names are not known at all.
    """
    if not normal.size:
        return normal
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal * scale[:, None] * scale, rcond=SINGULAR, hermitian=True) * scale[:, None] * scale)


def unobservable(normal: Array) -> NDArray[np.bool_]:
    """Parameters with a part in directions that the data do not tell: their variance is infinite."""
    if not normal.size:
        return np.zeros(len(normal), bool)
    diagonal = np.diag(normal)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-300))
    value, vector = np.linalg.eigh(normal * scale[:, None] * scale)
    untold = value <= SINGULAR * max(float(value[-1]), 0.0)
    return np.asarray((diagonal <= 0) | (np.sum(vector[:, untold] ** 2, axis=1) > SHARE))
