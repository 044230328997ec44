"""Refit of effects together with what the idle model does not know about their own DOFs.

The undriven columns H0[:, b] of a place b hang on shape values (mostly of residual modes) that no drive point has seen. Their uncertainty is in
the idle model's covariance; here it is the prior under which they are fitted together with the effects' sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnose.predict import IdleArrays, Prediction, Term, by_shapes, predict
from operando.diagnose.sets import CheckLines

Array = NDArray[Any]

KEPT = 1e-10
"""Directions of the prior below this share of the largest variance of one DOF are left out: they are known."""


@dataclass(frozen=True)
class ShapePrior:
    """Shape values that a refit may move.

    Parameters
    ----------
    dofs : (d,) int array
        Rows of the idle model.
    root : (d·n_modes, k) array
        Square root of their covariance; δφ = root @ z with z of unit variance.
    """

    dofs: Array
    root: Array


def shape_prior(idle: ModalModel, dofs: Array) -> ShapePrior:
    """Prior of all modes' shape values at some DOFs, from the idle model's covariance (none without one)."""
    dofs = np.asarray(dofs, int)
    n, m = idle.n_modes, len(idle.dofs)
    if idle.covariance is None or dofs.size == 0:
        return ShapePrior(dofs[:0], np.zeros((0, 0)))
    index = (2 * n + np.arange(n)[None, :] * m + dofs[:, None]).ravel()
    values, vectors = np.linalg.eigh(idle.covariance[np.ix_(index, index)])
    keep = values > KEPT * max(float(values[-1]), 1e-300)
    return ShapePrior(dofs, vectors[:, keep] * np.sqrt(values[keep]))


@dataclass(frozen=True)
class Fit:
    """Effects fitted together.

    Parameters
    ----------
    terms : tuple of Term
    q : tuple of arrays
        Moving numbers of each term.
    phi : (n_dofs, n_modes) array
        Shapes with the refitted values.
    prior : ShapePrior
    z : array
        Refitted shape values in units of their prior.
    covariance : array
        Of [all q, z].
    cost : float
        2·Σ|e|²/var + |z|² on the fitted lines.
    """

    terms: tuple[Term, ...]
    q: tuple[Array, ...]
    phi: Array
    prior: ShapePrior
    z: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cost: float = np.inf

    @property
    def std(self) -> tuple[Array, ...]:
        """Standard deviation of each term's moving numbers on the search scale."""
        diagonal = np.sqrt(np.maximum(np.diag(self.covariance), 0)) if self.covariance.size else np.zeros(sum(v.size for v in self.q))
        out, start = [], 0
        for v in self.q:
            out.append(diagonal[start : start + v.size])
            start += v.size
        return tuple(out)


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
    return tuple(vector[a:b] for a, b in zip(edges[:-1], edges[1:], strict=True))


def jacobian(arrays: IdleArrays, lines: CheckLines, terms: Sequence[Term], q: Sequence[Array], prior: ShapePrior, p: Prediction) -> Array:
    """∂H/∂[q, z] (parameters, lines, responses, references)."""
    rows = []
    for i, term in enumerate(terms):
        low, high = term.bounds()
        for j in range(term.size):
            step = 1e-6 if q[i][j] + 1e-6 <= high[j] else -1e-6
            moved = [v.copy() for v in q]
            moved[i][j] += step
            same = None if term.kind.acts in ("modal_change", "added_mode") else p.kernel
            rows.append((predict(arrays, lines, terms, moved, same).data - p.data) / step)
    own = np.array(rows).reshape(len(rows), *p.data.shape)
    if not prior.dofs.size:
        return own
    modes = np.arange(arrays.phi.shape[1])
    by = by_shapes(p, lines, prior.dofs, modes)
    flat = prior.root.T @ by.reshape(by.shape[0], -1)
    return np.concatenate([own, flat.reshape(-1, *p.data.shape)])


def refit(
    arrays: IdleArrays,
    lines: CheckLines,
    own: Array,
    terms: Sequence[Term],
    q: Sequence[Array],
    prior: ShapePrior,
    z: Array | None = None,
    steps: int = 12,
) -> Fit:
    """Levenberg–Marquardt over all effects' numbers and the shape values at their DOFs, on the given lines.

    Parameters
    ----------
    arrays : IdleArrays
    lines : CheckLines
        Lines to fit.
    own : array like ``lines.data``
        The idle model's own variance, added to that of the measurement.
    terms, q : sequences
        Effects and start of their moving numbers.
    prior : ShapePrior
    z : array, optional
        Start of the shape values.
    """
    root_w = np.sqrt(weights(lines, own))
    n_q = sum(t.size for t in terms)
    k = prior.root.shape[1]
    x = np.r_[np.concatenate([np.zeros(0), *q]), np.zeros(k) if z is None else z]
    bounds = [t.bounds() for t in terms]
    low = np.r_[np.concatenate([np.zeros(0), *(b[0] for b in bounds)]), np.full(k, -np.inf)]
    high = np.r_[np.concatenate([np.zeros(0), *(b[1] for b in bounds)]), np.full(k, np.inf)]
    base = arrays.kernel(lines.hz)
    shift = np.zeros_like(arrays.phi)

    def state(x: Array) -> tuple[Prediction, Array, float]:
        if k:
            moved = arrays.phi.copy()
            moved[prior.dofs] += (prior.root @ x[n_q:]).reshape(prior.dofs.size, -1)
            here = arrays.with_phi(moved)
        else:
            here = arrays
        p = predict(here, lines, terms, split(x[:n_q], terms), base)
        error = root_w * (lines.data - p.data)
        return p, error, 2 * float(np.sum(np.abs(error) ** 2)) + float(x[n_q:] @ x[n_q:])

    p, error, cost = state(x)
    damping = 1e-6
    normal = np.zeros((x.size, x.size))
    for _ in range(steps):
        here = arrays.with_phi(p.phi[:, : arrays.phi.shape[1]])
        jac = jacobian(here, lines, terms, split(x[:n_q], terms), prior, p) * root_w
        flat = jac.reshape(x.size, -1)
        stacked = np.concatenate([flat.real, flat.imag], axis=1)
        normal = 2 * stacked @ stacked.T
        slope = 2 * stacked @ np.concatenate([error.real.ravel(), error.imag.ravel()])
        normal[np.arange(n_q, x.size), np.arange(n_q, x.size)] += 1
        slope[n_q:] -= x[n_q:]
        for _ in range(7):
            try:
                move = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-300), slope)
            except np.linalg.LinAlgError:
                damping = max(damping * 10, 1e-8)
                continue
            tried = np.clip(x + move, low, high)
            p_new, error_new, cost_new = state(tried)
            if cost_new < cost:
                break
            damping = max(damping * 10, 1e-6)
        else:
            break
        gain = cost - cost_new
        x, p, error, cost, damping = tried, p_new, error_new, cost_new, damping / 10
        if gain < 1e-4 + 1e-5 * cost:
            break
    del shift
    inverse = np.linalg.pinv(normal, hermitian=True) if x.size else np.zeros((0, 0))
    phi = p.phi[:, : arrays.phi.shape[1]]
    return Fit(tuple(terms), split(x[:n_q], terms), phi, prior, x[n_q:], inverse, cost)


def predicted(arrays: IdleArrays, lines: CheckLines, fit: Fit, variance: bool = False) -> tuple[Array, Array | None]:
    """Receptance on other lines, and (if wanted) the variance left by what the fit could not determine."""
    here = arrays.with_phi(fit.phi)
    p = predict(here, lines, fit.terms, fit.q)
    if not variance or not fit.covariance.size:
        return p.data, None
    jac = jacobian(here, lines, fit.terms, fit.q, fit.prior, p).reshape(fit.covariance.shape[0], -1)
    spread = np.real(np.sum(np.conj(jac) * (fit.covariance @ jac), axis=0))
    return p.data, np.maximum(spread, 0).reshape(p.data.shape)


def mean_misfit(lines: CheckLines, own: Array, data: Array, extra: Array | None = None) -> float:
    """Mean of |H_model − H_measured|²/var_total."""
    w = weights(lines, own if extra is None else own + extra)
    return float(np.sum(w * np.abs(lines.data - data) ** 2) / max(int(np.sum(w > 0)), 1))
