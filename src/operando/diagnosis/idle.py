"""The idle model as the diagnosis moves it: real modes, what makes them complex, residual terms, and what is not known of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnosis.arrow import Factor
from operando.diagnosis.terms import Term
from operando.dof import Dof

Array = NDArray[Any]

FREQUENCY_LOOSE, DAMPING_LOOSE, SHAPE_LOOSE, BETWEEN_LOOSE, LAG_LOOSE = 0.01, 0.3, 0.3, 0.5, 0.1
"""Standard deviations of a loose model, relative; of damping between modes as a share of the most there can be."""

RESIDUAL_DAMPING = 1.0
"""Standard deviation of the logarithm of what the damping ratio of residual terms was assumed to be, 1 %: structures measured in
laboratories have 0.2 % (bolted steel) to 5 % (on rubber). FRFs at rest tell it little; all damping three times as large, they do."""

NEAR = np.sqrt(2)
"""Terms that stand outside the band by no more than this factor move twice as much at its end as they do slowly (1/(1 − 1/2)), so that what
ties a mode to them is no lag of its shape; the others follow (benchmarks/hidden_effects/runs.md, three shakers)."""


@dataclass(frozen=True)
class Moves:
    """How far shapes (or lags of shapes) move: by the unknowns g that all share, and by those of each DOF, all of unit variance."""

    shared: Array  # (DOFs, terms, g)
    own: Array  # (DOFs, terms, e)

    def scale(self, phi: Array, driven: Array, exact: bool = False) -> Array:
        """By how much, relatively, g moves the shape of each term at the driven DOFs as a whole, (terms, g).

        ``exact``ly it is a scale as far as the others follow in inverse proportion. Damping that ties a mode to a driven one lets it be
        seen though no force drives it: then its driven values are unknown beside known other ones.
        """
        power = np.sum(phi[driven] ** 2, axis=0)
        along = np.einsum("dt,dtg->tg", phi[driven], self.shared[driven])
        scale = np.divide(along, power[:, None], out=np.zeros_like(along), where=power[:, None] > 0)
        if not exact:
            return np.asarray(scale)
        others = np.sum(phi[~driven] * np.einsum("dtg,tg->dt", self.shared[~driven], scale), axis=0)
        inverse = np.sum(phi[~driven] ** 2, axis=0) * np.sum(scale**2, axis=1)
        follow = np.divide(-others, inverse, out=np.ones_like(inverse), where=inverse > 0)
        return np.asarray(np.clip(follow, 0, 1)[:, None] * scale)

    def ways(self, base: Array, scale: Array, exact: bool = False) -> tuple[Array, Array, Array]:
        """How far values (DOFs, terms) about a base follow their scale, how g moves its logarithm, and what else g adds to each.

        What is measured are products of a driven and another DOF: where the driven value is larger, the other one is smaller by the same
        factor e^t. By sums alone their product would be wrong by t², far beyond its own standard deviation where a reference hardly
        moves in a mode. The factor is log-normal, with the relative standard deviation σ of the scale: t has √ln(1 + σ²). Each value
        follows it as far as its regression on the scale says (1: in proportion, −1: inversely), and moves on its own with the rest.
        ``exact``ly so by g at zero.
        """
        variance = np.sum(scale**2, axis=1)
        along, against = np.einsum("dtg,tg->dt", self.shared, scale), base * variance
        most = np.maximum(np.abs(along), np.abs(against))  # no value follows more than in proportion
        follows = np.divide(along * np.sign(against), most, out=np.zeros_like(base), where=most > 0)
        relative = np.sqrt(variance)
        by_log = np.divide(np.sqrt(np.log1p(variance)), relative, out=np.ones_like(relative), where=(relative > 0) & (not exact))
        return follows, by_log[:, None] * scale, self.shared - (follows * base)[..., None] * scale

    def at(self, base: Array, ways: tuple[Array, Array, Array], g: Array, own: Array) -> tuple[Array, Moves]:
        """Values (DOFs, terms) at g and own (DOFs, e) by their :meth:`ways`, and how they move from there."""
        follows, within, shared = ways
        grown = np.exp(follows * (within @ g))
        values = (base + shared @ g + (self.own @ own[..., None])[..., 0]) * grown
        return values, Moves(grown[..., None] * shared + (follows * values)[..., None] * within, grown[..., None] * self.own)


@dataclass(frozen=True)
class Idle:
    """The structure at rest.

    Poles, shapes at the driven DOFs and what they share are one set of unknowns g; given these, the shape values of each other DOF
    were estimated from its own FRFs alone, so what is not known of them is independent from DOF to DOF. Damping that ties a mode to
    what lies outside the band makes its shape φ − iω·lag, exact to first order where those modes only follow; damping between modes
    in band makes them complex by itself.

    Parameters
    ----------
    f, zeta : (terms,) arrays
        Hz, ratio; of modes and residual terms.
    phi : (DOFs, terms) array
        Unit modal mass.
    residual : (terms,) bool array
    dofs : tuple of Dof
    between : (pairs of modes,) array
        Damping between two modes, over 2 √(ζ_r ω_r ζ_s ω_s).
    lag : (DOFs, modes) array [s]
    f_root, zeta_root, between_root : (terms or pairs, g) arrays
        How g of unit variance moves them.
    residual_damping : (g,) array
        How g moves the logarithm of the damping ratio of terms that are ``assumed``.
    shapes, lags : Moves
    driven : (DOFs,) bool array
        Driven at rest.
    midway : dict
        DOF between sensors → its position [m]; None of a motion that no sensor shows, which has none.
    lacking : int, optional
        A mode that the idle model lacks, there only with an effect of that kind.
    bend : (2, bent, g, g) array, optional
        How g moves ``f_root`` and ``zeta_root`` of the terms ``bent`` themselves: where damping ties modes, a straight way of the poles
        is a bent one of these (:func:`operando.diagnosis.poles.with_straight_poles`).
    first_order : bool
        Whether what residual terms add is linear in their changes δ: b bᵀ + b δᵀ + δ bᵀ. Their products were measured and are known well,
        where the shapes b are not, and the squares of these make a valley that fits crawl along. At places between sensors no product was
        measured: those are of the shapes as they are.
    exact : bool
        Whether lines of the idle FRFs stand beside the unknowns (:mod:`operando.diagnosis.idle_lines`) and hold the products of shapes:
        then the unknowns move it as they did in its fit.
    """

    f: Array
    zeta: Array
    phi: Array
    residual: Array
    dofs: tuple[Dof, ...]
    between: Array
    lag: Array
    f_root: Array
    zeta_root: Array
    between_root: Array
    residual_damping: Array
    shapes: Moves
    lags: Moves
    driven: Array
    midway: dict[int, tuple[float, float, float] | None] = field(default_factory=dict)
    lacking: int | None = None
    bend: Array | None = None
    bent: Array = field(default_factory=lambda: np.zeros(0, int))
    first_order: bool = True
    exact: bool = False

    @cached_property
    def modes(self) -> Array:
        return np.flatnonzero(~self.residual)

    @cached_property
    def assumed(self) -> Array:
        """Residual terms whose poles were assumed: with the day and with g they move only all together, (terms,) bool."""
        return np.asarray(self.residual & ~(self.f_root.any(axis=1) | self.zeta_root.any(axis=1)))

    @cached_property
    def complex(self) -> bool:
        """Whether shapes lag, or could."""
        return bool(self.lag.any() or self.lags.shared.any() or self.lags.own.any())

    def with_dofs(
        self, dofs: Sequence[Dof], weights: Array, phi: Array, own: Array, positions: Sequence[tuple[float, float, float] | None]
    ) -> Idle:
        """With DOFs that no sensor shows (``midway``), at nodes of their own, with shape values ``phi`` (new, terms); positions in m.

        ``weights`` (new, DOFs) say how they follow the sensors, in what is not known of these and in lag; ``own`` (new, terms, e) is what
        is not known beside that.
        """

        def wider(moves: Moves, own: Array) -> Moves:
            most = max(moves.own.shape[2], own.shape[2])
            grown = [np.concatenate([v, np.zeros((*v.shape[:2], most - v.shape[2]))], 2) for v in (moves.own, own)]
            return Moves(np.concatenate([moves.shared, np.tensordot(weights, moves.shared, (1, 0))]), np.concatenate(grown))

        return replace(
            self,
            phi=np.concatenate([self.phi, phi]),
            dofs=(*self.dofs, *dofs),
            lag=np.concatenate([self.lag, weights @ self.lag]),
            shapes=wider(self.shapes, own),
            lags=wider(self.lags, np.zeros((len(dofs), self.modes.size, own.shape[2]))),
            driven=np.concatenate([self.driven, np.zeros(len(dofs), bool)]),
            midway={**self.midway, **{len(self.dofs) + i: position for i, position in enumerate(positions)}},
        )

    @property
    def lacking_term(self) -> tuple[Term, ...]:
        """The effect with which the mode that is lacking is there."""
        if self.lacking is None:
            return ()
        return (Term("missing_mode", (), (float(np.log(self.f[self.lacking])), float(np.log(self.zeta[self.lacking])))),)

    @property
    def tied(self) -> bool:
        """Whether damping that is no modal one stands between modes, or in their shapes."""
        return bool(self.between.any() or self.lag.any())

    @classmethod
    def of(cls, model: ModalModel, band: tuple[float, float], driven: Sequence[Dof]) -> Idle:
        """Of a fitted model, with the damping that ties its modes where it has one, as known. A residual term in band, or tied, is a mode.

        Frequencies and damping ratios are those of the diagonals of the modal matrices; where modes are tied poles have others.

        The model is of unit modal mass and has no residual terms that are taken away; without a covariance it counts as exact. ``driven``
        are the references at rest.
        """
        model.sums_of_squares("a diagnosis")
        terms = model.terms
        f, zeta, phi = (np.array(v, float) for v in (terms.frequencies_hz, terms.damping_ratios, np.real(terms.shapes)))
        if terms.coupling is not None:
            damping, stiffness = (np.diag(a) for a in terms.quadratic)
            f = np.sqrt(stiffness) / 2 / np.pi
            zeta = damping / (4 * np.pi * f)
        residual = np.asarray(terms.residual) & ~((f > band[0]) & (f < band[1]))
        if terms.coupling is not None:
            residual &= ~(terms.coupling.damping - np.diag(np.diag(terms.coupling.damping))).any(axis=0)
        t, d, m = f.size, phi.shape[0], int((~residual).sum())
        at = np.array([i for i, dof in enumerate(terms.dofs) if any(dof.same_axis(o) for o in driven)], int)
        covariance = np.zeros((2 * t + t * d,) * 2) if model.covariance is None else np.asarray(model.covariance)
        shape_at = 2 * t + np.arange(t) * d  # of DOF 0; θ has shapes term by term
        shared = np.concatenate([np.arange(2 * t), (shape_at + at[:, None]).ravel()])
        root, inverse = _root(covariance[np.ix_(shared, shared)])
        shape_shared = np.zeros((d, t, root.shape[1]))
        shape_own = np.zeros((d, t, t))
        shape_shared[at] = root[2 * t :].reshape(at.size, t, root.shape[1])
        for i in np.setdiff1d(np.arange(d), at):
            mine = shape_at + i
            given = covariance[np.ix_(mine, shared)] @ inverse.T
            shape_shared[i] = given
            own, _ = _root(covariance[np.ix_(mine, mine)] - given @ given.T)
            shape_own[i, :, : own.shape[1]] = own
        residual_damping = np.zeros(root.shape[1])
        if model.covariance is not None and (residual & ~root[: 2 * t].any(axis=1).reshape(2, t).any(axis=0)).any():
            root, shape_shared = (np.concatenate([v, np.zeros((*v.shape[:-1], 1))], -1) for v in (root, shape_shared))
            residual_damping = np.append(residual_damping, RESIDUAL_DAMPING)
        pairs = m * (m - 1) // 2
        between, lag = np.zeros(pairs), np.zeros((d, m))
        if model.coupling is not None:
            modes, (first, second) = np.flatnonzero(~residual), np.triu_indices(m, 1)
            loss = 2 * zeta * 2 * np.pi * f
            lag = np.array(model.coupling.lag[:, modes])
            between = model.coupling.damping[modes[first], modes[second]] / np.sqrt(loss[modes[first]] * loss[modes[second]])
        none = Moves(np.zeros((d, m, root.shape[1])), np.zeros((d, m, t)))
        was_driven = np.zeros(d, bool)
        was_driven[at] = True
        return cls(
            f, zeta, phi, residual, tuple(terms.dofs), between, lag,
            root[:t], root[t : 2 * t], np.zeros((pairs, root.shape[1])), residual_damping, Moves(shape_shared, shape_own), none,
            was_driven,
        )  # fmt: skip

    def diagonals(self, g: Array) -> tuple[Array, Array, Array, Array]:
        """Frequencies [Hz] and damping ratios of the terms at g, and how g moves them from there, (terms, g)."""
        by_f, by_zeta = self.f_root, self.zeta_root
        f, zeta = self.f + by_f @ g, self.zeta + by_zeta @ g
        if self.bend is not None:
            by_f, by_zeta = by_f.copy(), by_zeta.copy()
            for values, slopes, turn in zip((f, zeta), (by_f, by_zeta), self.bend @ g, strict=True):
                values[self.bent] += turn @ g / 2
                slopes[self.bent] += turn
        assumed = self.assumed
        zeta = np.where(assumed, self.zeta * np.exp(self.residual_damping @ g), zeta)
        return f, zeta, by_f, np.where(assumed[:, None], zeta[:, None] * self.residual_damping, by_zeta)

    @cached_property
    def _ways(self) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
        """Of shapes and of lags, which scale as these do."""
        scale = self.shapes.scale(self.phi, self.driven, self.exact)
        lags = self.lags.ways(self.lag, scale[self.modes], self.exact)
        scale[self.residual if self.exact else self.linear] = 0
        return self.shapes.ways(self.phi, scale, self.exact), lags

    def shape(self, g: Array, own: Array) -> tuple[Array, Moves]:
        """Shapes at g and own (DOFs, e), and how they move from there."""
        return self.shapes.at(self.phi, self._ways[0], g, own)

    @cached_property
    def linear(self) -> Array:
        """Numbers of the terms that are linear in their changes."""
        return np.flatnonzero(self.residual) if self.first_order else np.zeros(0, int)

    def late(self, g: Array, own: Array, times: float = 1.0) -> tuple[Array, Moves]:
        """Lags of shapes; so many times as large as at rest."""
        lag, moves = self.lags.at(self.lag, self._ways[1], g, own)
        return times * lag, Moves(times * moves.shared, times * moves.own)

    def with_near(self, band: tuple[float, float], fitted: bool = False) -> Idle:
        """With the residual terms near the band [Hz] as modes, which damping may tie to others: no peak, but more than a flank is there.

        ``fitted``: those alone whose frequencies were fitted, which are modes of the structure; others stand at assumed ones.
        """
        near = self.residual & (self.f > band[0] / NEAR) & (self.f < band[1] * NEAR)
        if fitted:
            near &= self.f_root.any(axis=1)
        if not near.any():
            return self
        residual = self.residual & ~near
        now = np.flatnonzero(~residual)
        was = np.searchsorted(now, self.modes)
        first, second = np.triu_indices(now.size, 1)
        pairs = np.flatnonzero(np.isin(first, was) & np.isin(second, was))

        def wider(values: Array, at: Array, size: int, axis: int) -> Array:
            shape = list(values.shape)
            shape[axis] = size
            out = np.zeros(shape)
            out[(slice(None),) * axis + (at,)] = values
            return out

        return replace(
            self,
            residual=residual,
            between=wider(self.between, pairs, first.size, 0),
            between_root=wider(self.between_root, pairs, first.size, 0),
            lag=wider(self.lag, was, now.size, 1),
            lags=Moves(wider(self.lags.shared, was, now.size, 1), wider(self.lags.own, was, now.size, 1)),
        )

    def loose(self, driven: Array, band: tuple[float, float], complex_modes: bool = True) -> Idle:
        """With variances that only say of which order the parameters are; ``driven`` are numbers of DOFs.

        Poles outside the band [Hz] stay: only flanks are seen of them, which shapes can follow. What makes modes complex stays as it is
        where ``complex_modes`` is False.
        """
        rms = np.sqrt(np.mean(self.phi**2, axis=0))
        shape = np.where(self.residual, 1.0, SHAPE_LOOSE) * rms
        idle = self.with_near(band) if complex_modes else self
        modes, t, d, pairs = idle.modes, idle.f.size, len(idle.dofs), idle.between.size
        m = modes.size
        ties = 1.0 if complex_modes else 0.0
        lag = ties * LAG_LOOSE * rms[modes] / (2 * np.pi * idle.f[modes])
        stays = idle.residual | (idle.f < band[0]) | (idle.f > band[1])
        std = [
            np.where(stays, 0, FREQUENCY_LOOSE * idle.f),
            np.where(stays, 0, DAMPING_LOOSE * idle.zeta),
            np.full(pairs, ties * BETWEEN_LOOSE),
            np.tile(shape, driven.size),
            np.tile(lag, driven.size),
            np.array([RESIDUAL_DAMPING]),
        ]
        root = np.diag(np.concatenate(std))
        f, zeta, between, shapes, lags, (residual_damping,) = np.split(root, np.cumsum([len(v) for v in std[:-1]]))
        shape_shared, lag_shared = np.zeros((d, t, len(root))), np.zeros((d, m, len(root)))
        shape_shared[driven], lag_shared[driven] = shapes.reshape(-1, t, len(root)), lags.reshape(-1, m, len(root))
        shape_own, lag_own = np.zeros((d, t, t + m)), np.zeros((d, m, t + m))
        passive = np.setdiff1d(np.arange(d), driven)
        shape_own[passive, :, :t], lag_own[passive, :, t:] = np.diag(shape), np.diag(lag)
        return replace(
            idle,
            f_root=f,
            zeta_root=zeta,
            between_root=between,
            residual_damping=residual_damping,
            shapes=Moves(shape_shared, shape_own),
            lags=Moves(lag_shared, lag_own),
            bend=None,
            first_order=False,
        )

    def along(self, shared: Array, own: Array) -> Idle:
        """With other unknowns: g = shared @ g', and own (DOFs, e, e') @ e' at each DOF."""

        def turned(moves: Moves) -> Moves:
            return Moves(moves.shared @ shared, moves.own @ own)

        return replace(
            self,
            f_root=self.f_root @ shared,
            zeta_root=self.zeta_root @ shared,
            between_root=self.between_root @ shared,
            residual_damping=self.residual_damping @ shared,
            shapes=turned(self.shapes),
            lags=turned(self.lags),
            bend=None if self.bend is None else shared.T @ self.bend @ shared,
        )

    def moved(self, g: Array, own: Array, factor: Factor) -> Idle:
        """With g and own added, and what a fit left open (its factor: g shared, the unknowns of each DOF its own)."""
        root = np.linalg.inv(factor.lower).T  # of the covariance of g
        turned = np.swapaxes(factor.inverse, 1, 2)
        follow = -turned @ factor.across @ root  # of each DOF's unknowns, as g moves
        f, zeta, by_f, by_zeta = self.diagonals(g)
        first, second = np.triu_indices(self.modes.size, 1)
        loss = np.abs(zeta * f / (self.zeta * self.f))[self.modes]
        scale = 1 / np.sqrt(loss[first] * loss[second])  # it is told over the damping of its modes
        phi, shapes = self.shape(g, own)
        lag, lags = self.late(g, own)

        def after(moves: Moves) -> Moves:
            return Moves(moves.shared @ root + moves.own @ follow, moves.own @ turned)

        return replace(
            self,
            f=f,
            zeta=zeta,
            phi=phi,
            between=(self.between + self.between_root @ g) * scale,
            lag=lag,
            f_root=by_f @ root,
            zeta_root=np.where(self.assumed[:, None], 0, by_zeta @ root),
            residual_damping=self.residual_damping @ root,
            between_root=scale[:, None] * (self.between_root @ root),
            shapes=after(shapes),
            lags=after(lags),
            bend=None if self.bend is None else root.T @ self.bend @ root,
            first_order=True,
        )


def _root(covariance: Array) -> tuple[Array, Array]:
    """A root of a covariance, without directions of no variance, and its pseudo-inverse."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0))
    on = scale > 0
    values, vectors = np.linalg.eigh(covariance[np.ix_(on, on)] / np.outer(scale[on], scale[on]))
    keep = values > 1e-9 * values.max(initial=1e-300)
    if not keep.any():  # exact: one direction that moves nothing
        return np.zeros((scale.size, 1)), np.zeros((1, scale.size))
    root, inverse = np.zeros((scale.size, int(keep.sum()))), np.zeros((int(keep.sum()), scale.size))
    root[on] = scale[on][:, None] * vectors[:, keep] * np.sqrt(values[keep])
    inverse[:, on] = (vectors[:, keep] / np.sqrt(values[keep])).T / scale[on]
    return root, inverse
