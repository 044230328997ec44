"""Where an effect acts, in modal coordinates; between sensors by a spline of each shape through the sensor positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Geometry, ModalModel
from operando.dof import Dof, match_dofs
from operando.effects.effect import Effect
from operando.errors import DataError, DofError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VirtualShape:
    """Shapes at a place without a sensor.

    Parameters
    ----------
    values : (n_modes,) array
        Interpolated shape values, in the sense of the direction.
    std : (n_modes,) array
        Root mean square error of leaving one sensor out and interpolating it from the others.
    weights : (n_dofs,) array
        ``values = weights @ idle.terms.shapes``.
    """

    values: Array
    std: Array
    weights: Array


def _kernel(r: Array, dimension: int) -> Array:
    """Polyharmonic spline: r³ on a line, r² ln r on a surface, r in space."""
    if dimension == 1:
        return r**3
    if dimension == 2:
        return np.where(r > 0, r**2 * np.log(np.maximum(r, 1e-300)), 0.0)
    return r


def _frame(points: Array) -> tuple[Array, Array, Array, float]:
    """Centre, axes (3, d) spanned by the points, and their size: a line, a plane, or space."""
    centre = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - centre, full_matrices=False)
    span = sizes > 1e-6 * max(float(sizes[0]), 1e-300)
    return centre, axes[span].T, sizes[span], float(sizes[0] / np.sqrt(len(points)))


def spline_weights(points: ArrayLike, targets: ArrayLike) -> tuple[Array, Array]:
    """Weights that interpolate values at ``points`` to ``targets`` by a polyharmonic spline with a linear part.

    The spline is that of the dimension the points span (cubic on a line, thin-plate on a plane, biharmonic in space); what
    lies off that line or plane is dropped.

    Parameters
    ----------
    points : (n, 3) array
    targets : (k, 3) array

    Returns
    -------
    weights : (k, n) array
    leave_one_out : (n, n) array
        ``leave_one_out @ values`` is the error at each point when it is left out (Rippa 1999).

    Raises
    ------
    DataError
        If there are too few points for their dimension.
    """
    x, t = np.atleast_2d(np.asarray(points, float)), np.atleast_2d(np.asarray(targets, float))
    centre, axes, _, size = _frame(x)
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
    inverse = np.linalg.inv(system)
    basis = np.c_[_kernel(np.linalg.norm(v[:, None] - u[None], axis=2), d), np.ones(len(v)), v]
    own = np.diag(inverse)[:n]
    with np.errstate(divide="ignore", invalid="ignore"):
        left_out = np.where(np.abs(own[:, None]) > 1e-12, inverse[:n, :n] / own[:, None], 0.0)
    return basis @ inverse[:, :n], left_out


def virtual_shape(idle: ModalModel, geometry: Geometry, position: ArrayLike, direction: str) -> VirtualShape:
    """Shapes at a place without a sensor, through the sensors of the same axis.

    Parameters
    ----------
    idle : ModalModel
    geometry : Geometry
        Positions of the sensors.
    position : (3,) array
        Place [m].
    direction : str
        Sense and axis, such as "+Z".

    Returns
    -------
    VirtualShape

    Raises
    ------
    DofError
        If no sensor measures that axis.
    DataError
        If there are too few sensors to interpolate.
    """
    wanted = Dof.parse(f"0{direction}")
    rows, points, signs = [], [], []
    for i, dof in enumerate(idle.dofs):
        at = geometry.position(dof.node)
        if dof.axis == wanted.axis and at is not None:
            rows.append(i)
            points.append(at)
            signs.append(dof.sign * wanted.sign)
    if not rows:
        raise DofError(f"no sensor with a known position measures along {direction}", hint="give the geometry, or another direction")
    weights, left_out = spline_weights(np.array(points), np.asarray(position, float)[None])
    values = np.asarray(idle.terms.shapes)[rows] * np.array(signs)[:, None]
    full = np.zeros(len(idle.dofs))
    full[rows] = weights[0] * np.array(signs)
    return VirtualShape(weights[0] @ values, np.sqrt(np.mean((left_out @ values) ** 2, axis=0)), full)


def place_weights(effect: Effect, idle: ModalModel, geometry: Geometry | None = None) -> Array:
    """The place's coordinates as weights of the measured DOFs: x = W @ displacements.

    Returns
    -------
    (n_coordinates, n_dofs) array
        One row for a DOF or a difference, two for a skew kind, one for each measured direction of a node.

    Raises
    ------
    DofError
        If a DOF is not measured.
    DataError
        If a place without a sensor has no geometry.
    """
    definition = effect.definition
    if effect.position is not None:
        known = _dof_there(effect, idle, geometry)
        if known is not None:
            return known[None]
        if geometry is None:
            raise DataError(f"{effect.kind} at {effect.place} needs the positions of the sensors", hint="give a geometry")
        return virtual_shape(idle, geometry, effect.position, effect.direction).weights[None]
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


def _dof_there(effect: Effect, idle: ModalModel, geometry: Geometry | None) -> Array | None:
    """The row of a DOF of this axis at this very position, if the model has one."""
    wanted = Dof.parse(f"0{effect.direction}")
    for i, dof in enumerate(idle.dofs):
        at = None if geometry is None or dof.axis != wanted.axis else geometry.position(dof.node)
        if at is not None and effect.position is not None and np.linalg.norm(at - np.array(effect.position)) < 1e-9:
            return np.asarray(np.eye(len(idle.dofs))[i] * dof.sign * wanted.sign)
    return None


def participation(effect: Effect, idle: ModalModel, geometry: Geometry | None = None) -> Array:
    """Shape values at the place's coordinates (n_coordinates, n_modes): see :func:`place_weights`."""
    return np.asarray(place_weights(effect, idle, geometry) @ idle.terms.shapes)
