"""Fit of effect sizes to operating modes: Gauss–Newton on the exact eigenproblem, with the idle shapes at the effect's places floating."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.output_only_forward import Action, Basis, Modes, floating_change, pole_derivatives, solve, stiffness_change
from operando.diagnosis.output_only_residuals import (
    ZETA_FLOOR,
    Target,
    compress,
    compress_slope,
    fit_scale,
    model_variance,
    residuals,
    shared,
    whiteners,
)

Real = NDArray[np.float64]

FOLDS = 4
"""Folds of modes of the selection misfit."""

PASSES = 4
"""Fits one after the other at most, each with the idle model's own variance at the solution of the one before."""

LEAP = 1.5
"""Largest move of a floating shape value in one step, in standard deviations: a shape value of either sign is the same mode, and a longer
move could end on the wrong side."""

SAMPLED = 1.25
"""Factor on standard deviations of sizes: weights from a sample covariance of less than a hundred blocks fit its own errors."""

LOST = 2
"""Shape residuals a mode loses to its free complex scale."""


@dataclass(frozen=True)
class Prior:
    """Idle shape values that may move: ``phi[dofs] + (root @ η)``, η standard normal.

    Parameters
    ----------
    dofs : (d,) int array
    root : (d·n, q) array
        Square root of their covariance, all modes of the first DOF, then of the next.
    """

    dofs: NDArray[np.int_]
    root: Real

    @classmethod
    def of(cls, basis: Basis, actions: Sequence[Action]) -> Prior:
        """Of the DOFs that the actions take hold of."""
        touched = np.zeros(basis.shapes.shape[0], bool)
        for action in actions:
            touched |= np.any(action.rows != 0, axis=0)
        dofs = np.flatnonzero(touched)
        n = basis.omega.size
        if basis.covariance is None or not dofs.size:
            return cls(dofs[:0], np.zeros((0, 0)))
        block = basis.covariance[np.ix_(dofs, dofs)].transpose(0, 2, 1, 3).reshape(dofs.size * n, dofs.size * n)
        values, vectors = np.linalg.eigh((block + block.T) / 2)
        # Directions known a hundred times better than the shapes themselves move nothing that operating modes could show.
        keep = values > (1e-3 * np.sqrt(np.mean(basis.shapes**2))) ** 2
        return cls(dofs, vectors[:, keep] * np.sqrt(values[keep]))

    def shapes(self, basis: Basis, eta: Real) -> Real:
        """The idle shapes, moved."""
        if not eta.size:
            return basis.shapes
        phi = basis.shapes.copy()
        phi[self.dofs] += (self.root @ eta).reshape(self.dofs.size, -1)
        return phi


@dataclass(frozen=True)
class Fit:
    """Sizes that fit, and how well.

    Parameters
    ----------
    actions : tuple of Action
    sizes : (k,) array
    std : (k,) array
        From the Jacobian at the end, floating shapes included.
    eta : (q,) array
        Standardised moves of the floating idle shapes.
    prior : Prior
        Which idle shapes floated.
    covariance : (k + q, k + q) array
        Of sizes and moves, from the Jacobian at the end; empty where it was not asked for.
    residuals : (n, per_mode) array
        Compressed, standardised.
    selection : float
        Mean squared residual of modes left out in turn, over the rows used.
    by_mode : (n,) array
        Its numerator by mode.
    misfit : float
        Mean squared residual over the rows used, moves of the floating shapes included.
    modes : Modes
    index : (n,) int array
        Pole of each operating mode, −1 for none.
    """

    actions: tuple[Action, ...]
    sizes: Real
    std: Real
    eta: Real
    prior: Prior
    covariance: Real
    residuals: Real
    selection: float
    by_mode: Real
    misfit: float
    modes: Modes
    index: NDArray[np.int_]


def counts(use: NDArray[np.bool_]) -> Real:
    """Degrees of freedom of each mode's rows in use: shape rows stand for two fewer than they are."""
    return np.asarray(use[:, 0].astype(float) + use[:, 1] + np.where(use[:, 2], use.shape[1] - 2 - LOST, 0))


def mean_square(r: Real, use: NDArray[np.bool_]) -> float:
    """Mean squared residual over the rows in use."""
    return float(np.sum(r[use] ** 2) / max(counts(use).sum(), 1.0))


def jacobian(
    target: Target, basis: Basis, actions: Sequence[Action], sizes: Real, prior: Prior, modes: Modes, index: NDArray[np.int_], white: Real
) -> Real:
    """Derivative of the (not compressed) residuals by sizes and floating shapes, (n, per_mode, k + q)."""
    k, q, n = len(actions), prior.root.shape[1], basis.omega.size
    out = np.zeros((target.n, target.per_mode, k + q))
    phi = modes.shapes
    predicted = (phi[target.rows] * target.signs[:, None]) @ modes.vectors[:, index]
    scales, _, away = fit_scale(target.shapes, predicted, white)
    for i, j in enumerate(index):
        if j < 0:
            continue
        s, u = modes.poles[j], modes.vectors[:, j]
        change = np.stack([stiffness_change(basis, a, phi, s, u) for a in actions], axis=1) if k else np.zeros((n, 0), complex)
        if q:
            change = np.c_[change, floating_change(actions, sizes, phi, prior.dofs, s, u) @ prior.root]
        by_pole, by_vector = pole_derivatives(modes, int(j), change)
        size = abs(s)
        by_log = (by_pole / s).real
        zeta = -s.real / size
        by_zeta = -by_pole.real / size - zeta * by_log
        out[i, 0] = -by_log / target.std_log_hz[i]
        out[i, 1] = -by_zeta / max(zeta, ZETA_FLOOR) / target.std_log_zeta[i] * (zeta > ZETA_FLOOR)
        by_shape = phi @ by_vector
        if q:
            direct = np.zeros((phi.shape[0], q), complex)
            direct[prior.dofs] = np.einsum("drq,r->dq", prior.root.reshape(prior.dofs.size, n, q), u)
            by_shape[:, k:] += direct
        by_shape = by_shape[target.rows] * target.signs[:, None]
        moved = scales[i] * by_shape
        part = white[i] @ np.r_[moved.real, moved.imag]
        # The scale follows the shape (variable projection, Kaufman 1975: the term of the residual's own size is left out).
        out[i, 2:] = -(part - away[i] @ (away[i].T @ part))
    return out


def fit(
    target: Target,
    basis: Basis,
    actions: Sequence[Action],
    start: Sequence[float],
    use: NDArray[np.bool_],
    *,
    floating: bool = True,
    own_variance: bool = True,
    iterations: int = 12,
    folds: bool = True,
) -> Fit | None:
    """Least squares of the compressed residuals in use plus the prior of the floating shapes, by damped Gauss–Newton.

    Parameters
    ----------
    target : Target
    basis : Basis
    actions : sequence of Action
    start : sequence of float
        Sizes to start from.
    use : (n, per_mode) bool array
        Rows the fit may see.
    floating : bool
        Let the idle shapes at the effect's places move under their prior.
    own_variance : bool
        Count the idle model's own variance of the shapes read out.
    iterations : int
    folds : bool
        Also the selection misfit (modes left out in turn, to first order at the solution).

    Returns
    -------
    Fit or None
        None where the eigenproblem has no solution at the start.
    """
    actions = tuple(actions)
    k = len(actions)
    prior = Prior.of(basis, actions) if floating else Prior(np.zeros(0, int), np.zeros((0, 0)))
    q = prior.root.shape[1]
    sizes, eta = np.array(start, float), np.zeros(q)
    begun = solve(basis, actions, sizes, prior.shapes(basis, eta), derivatives=True)
    if begun is None:
        return None
    modes: Modes = begun
    plain = whiteners(target)

    def cost_of(r: Real, e: Real) -> float:
        return float(np.sum(compress(r[use]) ** 2) + e @ e)

    # The idle model's own variance depends on the solution, so it is taken anew there; within a pass it is held, or the fit would
    # look for the solution of the largest variance.
    for number in range(PASSES if own_variance and k else 1):
        white = plain
        if own_variance:
            _, index, scale = residuals(target, modes, plain)
            white = whiteners(target, model_variance(basis, target, modes, index, scale, prior.dofs))
        raw, index, scale = residuals(target, modes, white)
        before, cost, damping = sizes.copy(), cost_of(raw, eta), 1e-3
        for _ in range(iterations if k else 0):
            j = jacobian(target, basis, actions, sizes, prior, modes, index, white)
            slope = compress_slope(raw)
            scaled_jacobian = (j * slope[..., None])[use]
            h = scaled_jacobian.T @ scaled_jacobian
            g = scaled_jacobian.T @ compress(raw[use])
            h[np.arange(k, k + q), np.arange(k, k + q)] += 1
            g[k:] += eta
            better: Modes | None = None
            for _ in range(6):
                step = -np.linalg.solve(h + damping * np.diag(np.diag(h) + 1e-300), g)
                # Sizes move by a factor of three at most: beyond that the linearisation says nothing.
                limit = np.max(np.abs(step[:k]) / (2.0 * np.abs(sizes) + 1e-300))
                limit = max(limit, float(np.max(np.abs(step[k:]), initial=0.0)) / LEAP)
                step /= max(1.0, limit)
                new_sizes, new_eta = sizes + step[:k], eta + step[k:]
                new_modes = solve(basis, actions, new_sizes, prior.shapes(basis, new_eta), derivatives=True)
                if new_modes is not None:
                    new_raw, new_index, new_scale = residuals(target, new_modes, white)
                    new_cost = cost_of(new_raw, new_eta)
                    if new_cost < cost:
                        better = new_modes
                        break
                damping *= 8
            if better is None:
                break
            gain = cost - new_cost
            sizes, eta, modes, raw, index, scale, cost = new_sizes, new_eta, better, new_raw, new_index, new_scale, new_cost
            damping = max(damping / 5, 1e-9)
            if gain < 1e-2 + 1e-5 * cost:
                break
        if number and np.all(np.abs(sizes - before) < 1e-2 * np.abs(sizes)):
            break
    r = compress(raw)
    covariance = np.zeros((0, 0))
    std, selection, by_mode = np.full(k, np.nan), mean_square(r, use), np.sum(np.where(use, r, 0.0) ** 2, axis=1)
    if folds and k:
        j = jacobian(target, basis, actions, sizes, prior, modes, index, white) * compress_slope(raw)[..., None]
        covariance, left_out = _left_out(r, j, use, eta, k, shared(target, white))
        # Too few modes to leave one out: what is left has to say it.
        by_mode = left_out if len(r) >= FOLDS else by_mode
        # Residuals or moves larger than their standard deviations say: the sizes are wrong by as much more (Birge 1932).
        wider = np.r_[np.full(k, excess(mean_square(r, use)) * excess(float(eta @ eta) / max(q, 1))), np.ones(q)]
        covariance = covariance * wider[:, None] * wider
        std = np.sqrt(np.maximum(np.diag(covariance)[:k], 0))
        # What the floating shapes had to move is paid for: together both are the residual against the marginal covariance.
        by_mode = by_mode + float(eta @ eta) / len(r)
        selection = float(by_mode.sum() / max(counts(use).sum(), 1.0))
    misfit = mean_square(r, use) + float(eta @ eta) / float(max(counts(use).sum(), 1.0))
    return Fit(actions, sizes, std, eta, prior, covariance, r, selection, by_mode, misfit, modes, index)


def excess(misfit: float) -> float:
    """Factor on standard deviations for a mean squared standardised value: its root where it exceeds one."""
    return float(np.sqrt(max(misfit, 1.0)))


def _left_out(r: Real, j: Real, use: NDArray[np.bool_], eta: Real, k: int, common: Real) -> tuple[Real, Real]:
    """Covariance of sizes and moves, and squared residuals of each mode predicted without its fold, to first order.

    The fit weighs modes as independent; their true covariance ``common`` comes in here (sandwich: H⁻¹ (Jᵀ S J + P) H⁻¹), because
    shapes of close modes are wrong together, and would count twice.
    """
    q = eta.size
    prior = np.diag(np.r_[np.zeros(k), np.ones(q)])
    parts = [(j[i][use[i]], r[i][use[i]]) for i in range(len(r))]
    h_all = sum((a.T @ a for a, _ in parts), prior)
    g_all = sum((a.T @ b for a, b in parts), np.r_[np.zeros(k), eta])
    tiny = 1e-12 * np.diag(np.diag(h_all)) + 1e-300 * np.eye(k + q)
    inverse = np.linalg.inv(h_all + tiny)
    flat = j[use]
    spread = flat.T @ common[np.ix_(use.ravel(), use.ravel())] @ flat
    covariance = np.asarray(inverse @ (SAMPLED**2 * spread + prior) @ inverse, float)
    out = np.zeros(len(r))
    for fold in range(FOLDS):
        members = range(fold, len(r), FOLDS)
        h, g = h_all.copy(), g_all.copy()
        for i in members:
            a, b = parts[i]
            h -= a.T @ a
            g -= a.T @ b
        move = -np.linalg.solve(h + tiny + 1e-6 * np.diag(np.diag(h_all)), g)
        for i in members:
            a, b = parts[i]
            out[i] = np.sum((b + a @ move) ** 2)
    return covariance, out
