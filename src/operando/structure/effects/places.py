"""Where an effect acts, in modal coordinates; between sensors by a spline of each shape through the sensor positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Geometry, ModalModel
from operando.dof import Dof, match_dofs
from operando.errors import DataError, DofError
from operando.structure.effects.effect import Effect

Array = NDArray[np.float64]


def _kernel(r: Array, dimension: int) -> Array:
    """Polyharmonic spline: r³ on a line, r² ln r on a surface, r in space."""
    if dimension == 1:
        return r**3
    if dimension == 2:
        return np.where(r > 0, r**2 * np.log(np.maximum(r, 1e-300)), 0.0)
    return r


def _frame(points: Array) -> tuple[Array, Array, float]:
    """Centre, axes (3, d) spanned by the points, and their size: a line, a plane, or space."""
    centre = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - centre, full_matrices=False)
    span = sizes > 1e-6 * max(float(sizes[0]), 1e-300)
    return centre, axes[span].T, float(sizes[0] / np.sqrt(len(points)))


def spline_weights(points: ArrayLike, targets: ArrayLike) -> Array:
    """Weights (k, n) that interpolate values at ``points`` to ``targets`` by a polyharmonic spline with a linear part.

    The spline is that of the dimension the points span (cubic on a line, thin-plate on a plane, biharmonic in space); what
    lies off that line or plane is dropped.
    """
    x, t = np.atleast_2d(np.asarray(points, float)), np.atleast_2d(np.asarray(targets, float))
    centre, axes, size = _frame(x)
    d, n = axes.shape[1], len(x)
    if d == 0 or n < d + 2:
        raise DataError(f"{n} sensors are too few to interpolate shapes between them", hint="name a measured DOF instead")
    size = max(size, 1e-300)
    u, v = (x - centre) @ axes / size, (t - centre) @ axes / size
    between = _kernel(np.linalg.norm(u[:, None] - u[None], axis=2), d)
    polynomial = np.c_[np.ones(n), u]
    system = np.block([[between, polynomial], [polynomial.T, np.zeros((d + 1, d + 1))]])
    if np.linalg.cond(system) > 1e13:
        raise DataError("two sensors lie at one position, or all on one line but one: shapes cannot be interpolated")
    basis = np.c_[_kernel(np.linalg.norm(v[:, None] - u[None], axis=2), d), np.ones(len(v)), v]
    return np.asarray((basis @ np.linalg.inv(system))[:, :n])


def position_weights(idle: ModalModel, geometry: Geometry, position: ArrayLike, direction: str) -> Array:
    """Weights (n_dofs,) of the sensors of one axis that give the motion at a position [m] in a direction such as "+Z"."""
    wanted = Dof.parse(f"0{direction}")
    there = {i: at for i, d in enumerate(idle.dofs) if d.axis == wanted.axis and (at := geometry.position(d.node)) is not None}
    if not there:
        raise DofError(f"no sensor with a known position measures along {direction}", hint="give the geometry, or another direction")
    rows = list(there)
    signs = np.array([idle.dofs[i].sign * wanted.sign for i in rows])
    at = np.asarray(position, float)
    own = np.flatnonzero(np.linalg.norm(np.array(list(there.values())) - at, axis=1) < 1e-9)
    weights = np.zeros(len(idle.dofs))
    weights[rows] = (np.eye(len(rows))[own[0]] if own.size else spline_weights(list(there.values()), at[None])[0]) * signs
    return weights


def place_weights(effect: Effect, idle: ModalModel, geometry: Geometry | None = None) -> Array:
    """The place's coordinates as weights of the measured DOFs (n_coordinates, n_dofs): x = W @ displacements.

    One row for a DOF or a difference, two for a skew kind, one for each measured direction of a node.
    """
    definition = effect.definition
    if effect.position is not None:
        if geometry is None:
            raise DataError(f"{effect.kind} at {effect.place} needs the positions of the sensors", hint="give a geometry")
        return position_weights(idle, geometry, effect.position, effect.direction)[None]
    index, signs = match_dofs(effect.location, idle.dofs)
    rows = np.zeros((len(index), len(idle.dofs)))
    rows[np.arange(len(index)), index] = signs
    if definition.coordinates == "difference" and len(index) == 2:
        return rows[:1] - rows[1:]
    if definition.coordinates == "node":
        first = effect.location[0]
        turning = first.axis.startswith("R")
        same = [i for i, d in enumerate(idle.dofs) if d.node == first.node and d.axis.startswith("R") == turning]
        return np.eye(len(idle.dofs))[same]
    return rows
