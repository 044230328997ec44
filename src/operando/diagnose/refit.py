"""Refit of effects together with what the idle model does not know about their own DOFs.

The undriven columns H0[:, b] of a place b hang on shape values of modes outside the band that no drive point has seen. Their
uncertainty is in the idle model's covariance; here it is the prior under which they are fitted together with the effects' sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnose.levenberg import effect_dofs, inverse, jacobian, levenberg, solve, split, unobservable, weights
from operando.diagnose.predict import IdleArrays, Prediction, Term, by_poles, predict
from operando.diagnose.scan import scan_weights
from operando.diagnose.sets import CheckLines
from operando.diagnose.shapes import ShapePrior, by_directions, own_compliances, told_by

Array = NDArray[Any]

COMPLIANCES = (0.0, 2.0, 3.5)
"""Further starts of the shape values that make up the own compliance of a place, over that expected."""

BEGIN = 1.5
"""Further starts of a size that fits poorly: so much larger and smaller on a logarithmic scale."""

ASTRAY = 8.0
"""A last fit that needs shapes to move by so many times more than they were expected to has lost its way."""

POOR = 2.5
"""Misfit, what the idle model may not know allowed for, above which something more is missing."""


@dataclass(frozen=True)
class Learnt:
    """Effects and idle model after the lines told what they could of all parameters.

    Parameters
    ----------
    q : tuple of arrays
        Moving numbers of each term.
    idle : ModalModel
        Moved frequencies, damping ratios and shapes.
    joint : (n_parameters + n_q, n_parameters + n_q) array
        Covariance of θ = [f (Hz), ζ, shapes mode by mode] and all q.
    excess : float
        What the variances of the numbers are told larger by: the square of the misfit by the noise alone, where that is above 1.
    """

    q: tuple[Array, ...]
    idle: ModalModel
    joint: Array
    excess: float


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
    excess : float
        Misfit of the last fit where it is above 1: what the numbers' variances are told larger by, the covariance not.
    learnt : Learnt, optional
        Sizes and idle model after the lines told what they could of all parameters (:func:`operando.diagnose.learn.learn`).
    untold : bool array
        Of [all q, z]: numbers that the lines do not tell, whose standard deviation is infinite; empty where all are told.
    """

    terms: tuple[Term, ...]
    q: tuple[Array, ...]
    phi: Array
    prior: ShapePrior
    z: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cost: float = np.inf
    excess: float = 1.0
    learnt: Learnt | None = None
    untold: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    @property
    def sizes(self) -> tuple[Array, ...]:
        """Moving numbers of each term, after all that the lines told."""
        return self.q if self.learnt is None else self.learnt.q

    @property
    def std(self) -> tuple[Array, ...]:
        """Standard deviation of each term's moving numbers (:attr:`sizes`) on the search scale; infinite where nothing tells them."""
        count = sum(v.size for v in self.q)
        variance, excess = np.zeros(count), self.excess
        if self.learnt is not None:
            variance, excess = np.diag(self.learnt.joint)[-count:], self.learnt.excess
        elif self.covariance.size:
            variance = np.diag(self.covariance)[:count]
        if self.untold.size:
            variance = np.where(self.untold[:count], np.inf, variance)
        return split(np.sqrt(np.maximum(variance, 0) * excess), self.terms)


def refit(
    arrays: IdleArrays,
    lines: CheckLines,
    own: Array,
    terms: Sequence[Term],
    q: Sequence[Array],
    prior: ShapePrior,
    z: Array | None = None,
    steps: int = 12,
    idle: ModalModel | None = None,
) -> Fit:
    """Levenberg–Marquardt over all effects' numbers and the shapes of the idle model at their DOFs, on the given lines.

    Sizes first, with an allowance for columns that were never driven: far from the answer the shapes must not move to make up for a
    wrong size. Then the directions of the shapes that the lines say something about, first with, then without that allowance. Where
    the shapes move by more than their prior allows on average, the prior was too sure of itself (it is a linearised covariance) and
    is widened by that factor.

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
        Of no direction: sizes alone, with the allowance.
    z : array, optional
        Start of the shapes, in units of the prior as given: then nothing but the last stage is done.
    steps : int
        Iterations at most, of each pass.
    idle : ModalModel, optional
        With its covariance: what is not known of the columns of the places, and not fitted, counts with its variance in the last pass.
    """
    root_w = np.sqrt(weights(lines, own))
    x = np.concatenate([np.zeros(0), *q])
    n_q = x.size
    none = np.zeros(0)
    if z is None:
        soft = np.sqrt(soft_weights(arrays, lines, own))
        x, normal, cost = levenberg(arrays, lines, soft, terms, x, none, prior.bare(), steps, 1e-3)
        if not prior.size:
            return Fit(tuple(terms), split(x, terms), arrays.phi, prior, none, inverse(normal), cost, untold=unobservable(normal))
        most = min(2 * steps, 24)
        other = _from_compliances(arrays, lines, soft, terms, x, cost, prior, steps)
        begins = [np.r_[x, np.zeros(prior.size)], *([] if other is None else [other])]
        found = [_along(arrays, lines, soft, terms, b, prior, most) for b in begins]
        x, near, turn, normal, cost = min(found, key=lambda f: f[4])
        if cost > 2 * POOR * lines.data.size:
            other = _own_first(arrays, lines, soft, terms, found[0][0][:n_q], prior, steps)
            if other is not None:
                found.append(_along(arrays, lines, soft, terms, other, prior, most))
                x, near, turn, normal, cost = min(found, key=lambda f: f[4])
        so_far = Fit(
            tuple(terms), split(x[:n_q], terms), near.moved(x[n_q:]), near, x[n_q:], inverse(normal), cost, untold=unobservable(normal)
        )
        if cost > 2 * POOR * lines.data.size:
            # Something else is missing: the lines known best must not bend the shapes to make up for it.
            return so_far
        if idle is not None:
            # What the columns of the places are not known by counts with its variance as long as it is not fitted.
            p = predict(arrays.with_phi(so_far.phi), lines, terms, so_far.q)
            root_w = np.sqrt(weights(lines, np.maximum(own, carried(idle, arrays, lines, so_far, p)[0])))
        x, prior, _, normal, cost = _along(arrays, lines, root_w, terms, np.r_[x[:n_q], turn @ x[n_q:]], prior, steps)
    else:
        x, normal, cost = levenberg(arrays, lines, root_w, terms, x, z, prior, steps, 1e-4)
    for _ in range(2):
        wide = float(np.sqrt(np.mean(x[n_q:] ** 2))) if x.size > n_q else 0.0
        if wide <= 1.2:
            break
        prior = prior.widened(wide)
        x, normal, cost = levenberg(arrays, lines, root_w, terms, x[:n_q], x[n_q:] / wide, prior, steps, 1e-3 if z is None else 1e-4)
    return Fit(
        tuple(terms), split(x[:n_q], terms), prior.moved(x[n_q:]), prior, x[n_q:], inverse(normal), cost, untold=unobservable(normal)
    )


def _along(
    arrays: IdleArrays, lines: CheckLines, root_w: Array, terms: Sequence[Term], x: Array, prior: ShapePrior, most: int
) -> tuple[Array, ShapePrior, Array, Array, float]:
    """Fit of [q, z] along the directions that the lines tell where it begins: numbers, directions, their turn, normal matrix, cost."""
    n_q = x.size - prior.size
    p = predict(arrays.with_phi(prior.moved(x[n_q:])), lines, terms, split(x[:n_q], terms))
    slope = by_directions(p, lines, prior.root) * root_w
    told, turn = told_by(prior, slope.reshape(prior.size, -1), x[n_q:])
    x, normal, cost = levenberg(arrays, lines, root_w, terms, x[:n_q], turn.T @ x[n_q:], told, most, 1e-3)
    return x, told, turn, normal, cost


def _from_compliances(
    arrays: IdleArrays, lines: CheckLines, root_w: Array, terms: Sequence[Term], q: Array, least: float, prior: ShapePrior, steps: int
) -> Array | None:
    """Start of [q, z] from less or more own compliance of the places, if sizes fit better there than at the cost they have as expected.

    That compliance is the square of what no drive point saw; from the wrong side of it the way down is flat.
    """
    best: Array | None = None
    rows = effect_dofs(terms)
    alone = (np.count_nonzero(prior.base, axis=0) == 1) & np.any(prior.base[rows] != 0, axis=0)
    for factor in COMPLIANCES if alone.any() else ():
        change = np.where(alone, prior.base * (factor - 1), 0.0)
        z = change.T.ravel() @ prior.told
        x, _, cost = levenberg(arrays.with_phi(prior.moved(z)), lines, root_w, terms, q, np.zeros(0), prior.bare(), steps, 1e-3)
        cost += float(z @ z)
        if cost < least:
            best, least = np.r_[x, z], cost
    return best


def _own_first(
    arrays: IdleArrays, lines: CheckLines, root_w: Array, terms: Sequence[Term], q: Array, prior: ShapePrior, steps: int
) -> Array | None:
    """Start of [q, z] from a fit of sizes and the own compliances of their places alone; None where no place has such a one.

    Those compliances are what no drive point saw, and what sizes hang on most. From far away all directions together lead astray.
    """
    own = own_compliances(prior, effect_dofs(terms))
    if not own.shape[1]:
        return None
    alone = prior.turned(own)
    best, least = None, np.inf
    for size in _begins(terms, q):
        x, _, cost = levenberg(arrays, lines, root_w, terms, size, np.zeros(own.shape[1]), alone, 2 * steps, 1e-3)
        if cost < least:
            best, least = np.r_[x[: q.size], own @ x[q.size :]], cost
    return best


def _begins(terms: Sequence[Term], q: Array) -> list[Array]:
    """Sizes to begin with: as they are, and the last effect's smaller and larger."""
    term = terms[-1]
    first = q.size - term.size
    if not term.moving or term.kind.parameter(term.moving[0]).transform != "log":
        return [q]
    low, high = (float(b[0]) for b in term.bounds())
    out = []
    for move in (0.0, -BEGIN, BEGIN):
        other = q.copy()
        other[first] = np.clip(other[first] + move, low, high)
        out.append(other)
    return out


def foreseen(arrays: IdleArrays, lines: CheckLines, own: Array, fit: Fit, prior: ShapePrior) -> float:
    """What the cost of a fit of sizes alone would fall to with the shapes at its places, to first order.

    Lines are weighted as in the fit of sizes, with the allowance for columns that were never driven.
    """
    p = predict(arrays, lines, fit.terms, fit.q)
    root = np.sqrt(soft_weights(arrays, lines, own))
    error = root * (lines.data - p.data)
    bare = jacobian(arrays, lines, fit.terms, fit.q, prior.bare(), np.zeros(0), p)
    both = np.concatenate([bare, by_directions(p, lines, prior.root)]) * root
    if not len(both):
        return fit.cost
    flat = both.reshape(len(both), -1)
    normal = 2 * np.real(flat.conj() @ flat.T)
    n_q = len(bare)
    normal[np.arange(n_q, len(both)), np.arange(n_q, len(both))] += 1
    slope = 2 * np.real(flat.conj() @ error.ravel())
    return 2 * float(np.sum(np.abs(error) ** 2)) - float(slope @ solve(normal, slope))


def soft_weights(arrays: IdleArrays, lines: CheckLines, own: Array) -> Array:
    """Weights with an allowance for columns that were never driven, by what the idle model lacks there."""
    return scan_weights(lines, predict(arrays, lines, (), ()).data, own)


def model_variance(idle: ModalModel, arrays: IdleArrays, lines: CheckLines, fit: Fit) -> Array:
    """Variance E|ΔH|² of the predicted receptance, the idle model's own and that of what was refitted.

    The refitted numbers carry their covariance after the fit; all other modal parameters that of the idle model given the refitted
    directions of the shapes, carried through the exact update (first order).

    Returns
    -------
    (lines, responses, references) array
    """
    here = arrays.with_phi(fit.phi)
    p = predict(here, lines, fit.terms, fit.q)
    total, _ = carried(idle, arrays, lines, fit, p)
    if fit.covariance.size and idle.covariance is not None:
        jac = jacobian(here, lines, fit.terms, fit.q, fit.prior, fit.z, p).reshape(fit.covariance.shape[0], -1)
        total += np.real(np.sum(np.conj(jac) * (fit.covariance @ jac), axis=0)).reshape(total.shape)
    return np.maximum(total, 0)


def carried(
    idle: ModalModel, arrays: IdleArrays, lines: CheckLines, fit: Fit, p: Prediction, weighted: Array | None = None
) -> tuple[Array, Array]:
    """Variance of the predicted receptance from what the fit left of the idle model's uncertainty, and how it reaches a fit.

    Parameters
    ----------
    idle : ModalModel
    arrays : IdleArrays
    lines : CheckLines
    fit : Fit
    p : Prediction
        Of the fit on these lines.
    weighted : (k, lines, responses, references) array, optional
        Derivatives of the receptance times the weights of a fit.

    Returns
    -------
    variance : (lines, responses, references) array
    reach : (k, n_parameters) array
        2 Re Σ conj(weighted)·∂H/∂θ: what an error of θ does to the gradient of the fit; empty without ``weighted``.
    """
    total = np.zeros(p.data.shape)
    n, m = idle.terms.n, len(idle.dofs)
    reach = np.zeros((0 if weighted is None else len(weighted), idle.n_parameters))
    if idle.covariance is None:
        return total, reach
    from operando.diagnose.result import given_shapes

    covariance = given_shapes(idle, fit)
    changed = arrays.model
    for t, q in zip(fit.terms, fit.q, strict=True):
        if t.kind.acts == "modal_change":
            changed = t.kind.modal_change(changed, t.values(q))
    hz, zeta = by_poles(p, changed, lines)
    at = effect_dofs(fit.terms)
    modes = np.arange(n)
    for a, i in enumerate(lines.responses[p.order]):
        for b, j in enumerate(lines.references):
            dofs = np.unique(np.r_[at, i, j]).astype(int)
            gradient = np.concatenate([hz[:n, :, a, b], zeta[:n, :, a, b], _by_shapes_of_pair(p, lines, dofs, n, a, b)])
            index = np.concatenate([modes, n + modes, (2 * n + modes[None, :] * m + dofs[:, None]).ravel()])
            block = covariance[np.ix_(index, index)]
            for g in (gradient.real, gradient.imag):
                total[:, a, b] += np.einsum("kl,kl->l", g, block @ g)
            if weighted is not None:
                reach[:, index] += 2 * np.real(np.conj(weighted[:, :, a, b]) @ gradient.T)
    return np.maximum(total, 0), reach


def settled(idle: ModalModel, arrays: IdleArrays, lines: CheckLines, own: Array, fit: Fit) -> Fit:
    """The last fit: lines weighted by what the model with its effects is worth there, and the covariance that its errors have."""
    if not fit.terms:
        return fit
    if fit.prior.size:
        own, _ = carried(idle, arrays, lines, fit, predict(arrays.with_phi(fit.phi), lines, fit.terms, fit.q))
    begun, begun_own = fit, own
    for turn in range(2):
        if turn:
            own, _ = carried(idle, arrays, lines, fit, predict(arrays.with_phi(fit.phi), lines, fit.terms, fit.q))
        fit = refit(arrays, lines, own, fit.terms, fit.q, fit.prior, fit.z)
        if fit.prior.scale > ASTRAY * begun.prior.scale:
            # The way down was lost, and shapes make up for wrong sizes: rather the fit as it was.
            return honest(idle, arrays, lines, begun_own, begun)
    return honest(idle, arrays, lines, own, fit)


def honest(idle: ModalModel, arrays: IdleArrays, lines: CheckLines, own: Array, fit: Fit) -> Fit:
    """The fit with the covariance that its errors have.

    The fit takes errors of lines for independent. Noise is shared by neighbouring lines, and what the idle model does not know is
    common to all of them; with A the normal matrix, J the derivatives and W the weights the numbers have the covariance
    A⁻¹ (Jᵀ W Σ W J) A⁻¹, Σ that of the lines from noise (its correlation over lines) and from the idle model's parameters.
    """
    if not fit.covariance.size:
        return fit
    here = arrays.with_phi(fit.phi)
    p = predict(here, lines, fit.terms, fit.q)
    jac = jacobian(here, lines, fit.terms, fit.q, fit.prior, fit.z, p)
    w = weights(lines, own)
    _, reach = carried(idle, arrays, lines, fit, p, jac * w)
    size = len(jac)
    flat = jac.reshape(size, -1)
    noise = np.where(w > 0, w**2 * np.where(np.isfinite(lines.variance), lines.variance, 0), 0).ravel()
    n_q = sum(v.size for v in fit.q)
    prior = np.diag(np.r_[np.zeros(n_q), np.ones(size - n_q)])
    normal = 2 * np.real((flat * w.ravel()).conj() @ flat.T) + prior
    back = inverse(normal)
    middle = 2 * lines.shared * np.real((flat * noise).conj() @ flat.T) + prior
    if idle.covariance is not None:
        from operando.diagnose.result import given_shapes

        middle += reach @ given_shapes(idle, fit) @ reach.T
    return replace(fit, covariance=back @ middle @ back, excess=max(1.0, mean_misfit(lines, own, p.data)), untold=unobservable(normal))


def _by_shapes_of_pair(p: Prediction, lines: CheckLines, dofs: Array, n_modes: int, a: int, b: int) -> Array:
    """∂H[a, b]/∂φ[d, r] of one pair, (dofs·modes, lines); row a as the channels give it."""
    o = int(p.order[a])
    at = p.rows @ p.phi
    psi = p.phi[lines.responses[o]][None] - p.left[:, o] @ at
    chi = p.phi[lines.references[b]][None] - p.right[:, :, b] @ at
    left = -(p.left[:, o] @ p.rows[:, dofs]) + (dofs == lines.responses[o])
    right = -(p.right[:, :, b] @ p.rows[:, dofs]) + (dofs == lines.references[b])
    kernel = p.kernel[:, :n_modes]
    out = np.einsum("ld,lr->drl", left, kernel * chi[:, :n_modes]) + np.einsum("ld,lr->drl", right, kernel * psi[:, :n_modes])
    out = out.reshape(dofs.size * n_modes, -1)
    return out if p.factor is None else np.asarray(out * p.factor[:, a, b])


def predicted(arrays: IdleArrays, lines: CheckLines, fit: Fit, variance: bool = False) -> tuple[Array, Array | None]:
    """Receptance on other lines, and (if wanted) the variance left by what the fit could not determine."""
    if fit.learnt is not None:
        return predict(IdleArrays.of(fit.learnt.idle), lines, fit.terms, fit.learnt.q).data, None
    here = arrays.with_phi(fit.phi)
    p = predict(here, lines, fit.terms, fit.q)
    if not variance or not fit.covariance.size:
        return p.data, None
    jac = jacobian(here, lines, fit.terms, fit.q, fit.prior, fit.z, p).reshape(fit.covariance.shape[0], -1)
    spread = np.real(np.sum(np.conj(jac) * (fit.covariance @ jac), axis=0))
    return p.data, np.maximum(spread, 0).reshape(p.data.shape)


def mean_misfit(lines: CheckLines, own: Array, data: Array, extra: Array | None = None) -> float:
    """Mean of |H_model − H_measured|²/var_total."""
    w = weights(lines, own if extra is None else own + extra)
    return float(np.sum(w * np.abs(lines.data - data) ** 2) / max(int(np.sum(w > 0)), 1))
