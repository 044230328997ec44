"""Poles and complex shapes of the idle modal model under effects, with exact derivatives (state-space eigenproblem)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.effects import Effect, kind_of, place_weights

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

LINEAR_KINDS = (
    "point_mass",
    "ground_spring",
    "ground_damper",
    "coupling_spring",
    "coupling_damper",
    "gyroscopic",
    "circulatory",
    "global_stiffness",
    "global_damping",
)
"""Kinds of one size, in which the added matrices are linear."""


@dataclass(frozen=True)
class Action:
    """What one effect of unit size adds.

    Parameters
    ----------
    effect : Effect
        Kind and place; its size is not used.
    rows : (k, n_dofs) array
        The place's coordinates as weights of the measured DOFs; (0, n_dofs) for a global kind.
    mass, damping, stiffness : (k, k) arrays
        Added at unit size over the coordinates.
    """

    effect: Effect
    rows: Real
    mass: Real
    damping: Real
    stiffness: Real

    @property
    def kind(self) -> str:
        """Name of the kind."""
        return self.effect.kind

    @property
    def name(self) -> str:
        """Name of the one parameter that is the size."""
        return self.effect.definition.parameters[0].name

    def sized(self, size: float) -> Effect:
        """The effect with this size (a negative size of a removable kind is that effect taken away)."""
        return Effect(self.effect.kind, self.effect.location, {self.name: size})


def action_of(effect: Effect, idle: ModalModel) -> Action:
    """The matrices one effect adds at unit size.

    Parameters
    ----------
    effect : Effect
        Of one of ``LINEAR_KINDS``.
    idle : ModalModel

    Raises
    ------
    DofError
        If a DOF is not measured.
    """
    definition = kind_of(effect.kind)
    if definition.places == 0:
        empty = np.zeros((0, 0))
        return Action(effect, np.zeros((0, len(idle.dofs))), empty, empty, empty)
    rows = place_weights(effect, idle)
    unit = definition.quadratic({definition.parameters[0].name: 1.0}, len(rows))
    assert unit is not None
    return Action(effect, np.asarray(rows), np.asarray(unit.mass), np.asarray(unit.damping), np.asarray(unit.stiffness))


@dataclass(frozen=True)
class Basis:
    """Idle modes as plain arrays.

    Parameters
    ----------
    omega, zeta : (n,) arrays
        Natural frequencies [rad/s] and damping ratios.
    shapes : (n_dofs, n) array
        Real, of unit modal mass.
    covariance : (n_dofs, n_dofs, n, n) array or None
        Of the shape values.
    """

    omega: Real
    zeta: Real
    shapes: Real
    covariance: NDArray[np.float64] | None

    @classmethod
    def of(cls, idle: ModalModel) -> Basis:
        """Of an idle model of unit modal mass, residual terms included."""
        n, m = idle.terms.n, len(idle.dofs)
        covariance = None
        if idle.covariance is not None:
            # θ orders the shapes mode by mode; here (DOF, DOF, mode, mode).
            covariance = np.asarray(idle.covariance)[2 * n :, 2 * n :].reshape(n, m, n, m).transpose(1, 3, 0, 2)
        terms = idle.terms
        return cls(2 * np.pi * terms.frequencies_hz, np.asarray(terms.damping_ratios), np.asarray(terms.shapes, float), covariance)

    def kept(self, keep: NDArray[Any]) -> Basis:
        """Some of the modes."""
        covariance = None if self.covariance is None else self.covariance[:, :, keep][:, :, :, keep]
        return Basis(self.omega[keep], self.zeta[keep], self.shapes[:, keep], covariance)

    def involved(self, rows: Real) -> NDArray[np.bool_]:
        """Modes but the local ones (nonzero at one DOF only) that have no part at any of the coordinates.

        Such a mode stays uncoupled: leaving it out changes no other pole.
        """
        local = np.count_nonzero(self.shapes, axis=0) <= 1
        return np.asarray(~local | np.any(np.abs(rows) @ np.abs(self.shapes) > 0, axis=0))

    def touched(self, rows: Real) -> Basis:
        """The basis of the modes involved."""
        keep = self.involved(rows)
        return self if keep.all() else self.kept(keep)


@dataclass(frozen=True)
class Modes:
    """Solution of the eigenproblem.

    Parameters
    ----------
    poles : (2n,) complex array [rad/s]
    vectors : (n, 2n) complex array
        Modal coordinates of each eigenvector.
    left : (2n, n) complex array or None
        Lower half of the left eigenvectors, scaled so that left·right = 1; None where no derivative is wanted.
    inverse_mass : (n, n) array
    shapes : (n_dofs, n) array
        Idle shapes used (moved, where they float).
    """

    poles: Complex
    vectors: Complex
    left: Complex | None
    inverse_mass: Real
    shapes: Real


def solve(
    basis: Basis, actions: Sequence[Action], sizes: Sequence[float] | Real, shapes: Real | None = None, derivatives: bool = False
) -> Modes | None:
    """Poles and modal coordinates of the idle model with effects of the sizes given; None where the mass is not positive.

    Parameters
    ----------
    basis : Basis
    actions : sequence of Action
    sizes : sequence of float
        Of each action, in its own unit.
    shapes : (n_dofs, n) array, optional
        Shapes to use in place of the basis's.
    derivatives : bool
        Also the left eigenvectors.
    """
    phi = basis.shapes if shapes is None else shapes
    n = basis.omega.size
    m, c, k = np.eye(n), np.diag(2 * basis.zeta * basis.omega), np.diag(basis.omega**2)
    for action, size in zip(actions, sizes, strict=True):
        if action.kind == "global_stiffness":
            k[np.diag_indices(n)] += size * basis.omega**2
        elif action.kind == "global_damping":
            c[np.diag_indices(n)] += size * 2 * basis.zeta * basis.omega
        else:
            b = action.rows @ phi
            m += size * b.T @ action.mass @ b
            c += size * b.T @ action.damping @ b
            k += size * b.T @ action.stiffness @ b
    if not (np.all(np.isfinite(m)) and np.all(np.isfinite(k)) and np.all(np.isfinite(c))):
        return None
    try:
        np.linalg.cholesky(m)
        inverse = np.asarray(np.linalg.inv(m), float)
        # Time in units of 1/ω_ref keeps both halves of the state of one size.
        ref = float(np.median(basis.omega))
        a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ k / ref**2, -inverse @ c / ref]])
        poles, v = np.linalg.eig(a)
        # Perturbing the lower half by −M⁻¹ δZ u/ref² moves λ/ref by left·that: one factor 1/ref stays.
        left = np.asarray(np.linalg.inv(v)[:, n:] / ref, complex) if derivatives else None
    except np.linalg.LinAlgError:
        return None
    return Modes(np.asarray(poles * ref, complex), np.asarray(v[:n], complex), left, inverse, phi)


def stiffness_change(basis: Basis, action: Action, phi: Real, s: complex, u: Complex) -> Complex:
    """∂Z/∂size·u at s, in modal coordinates (n,)."""
    if action.kind == "global_stiffness":
        return np.asarray(basis.omega**2 * u)
    if action.kind == "global_damping":
        return np.asarray(s * 2 * basis.zeta * basis.omega * u)
    b = action.rows @ phi
    return np.asarray(b.T @ ((action.mass * s**2 + action.damping * s + action.stiffness) @ (b @ u)))


def pole_derivatives(modes: Modes, k: int, change: Complex) -> tuple[Complex, Complex]:
    """Derivatives of one pole and its modal coordinates for changes of Z·u.

    Parameters
    ----------
    modes : Modes
        With left eigenvectors.
    k : int
        Which pole.
    change : (n, q) complex array
        (∂Z/∂p)·u_k for q parameters.

    Returns
    -------
    by_pole : (q,) array
    by_vector : (n, q) array
        With no part along the eigenvector itself (its scale is free).
    """
    assert modes.left is not None
    c = -(modes.left @ (modes.inverse_mass @ change))
    gap = modes.poles[k] - modes.poles
    gap[np.abs(gap) < 1e-9 * abs(modes.poles[k])] = np.inf
    gap[k] = np.inf
    return c[k], modes.vectors @ (c / gap[:, None])


def floating_change(
    actions: Sequence[Action], sizes: Sequence[float] | Real, phi: Real, dofs: NDArray[np.int_], s: complex, u: Complex
) -> Complex:
    """(∂Z/∂φ_ir)·u at s for the shape values at some DOFs, all modes of the first DOF, then of the next: (n, n_floating·n)."""
    n = u.size
    out = np.zeros((n, dofs.size * n), complex)
    for action, size in zip(actions, sizes, strict=True):
        if not len(action.rows):
            continue
        z = size * (action.mass * s**2 + action.damping * s + action.stiffness)
        b = action.rows @ phi
        behind, ahead = z @ (b @ u), b.T @ z
        for j, dof in enumerate(dofs):
            w = action.rows[:, dof]
            if not np.any(w):
                continue
            block = out[:, j * n : (j + 1) * n]
            block[np.diag_indices(n)] += w @ behind
            block += np.outer(ahead @ w, u)
    return out
