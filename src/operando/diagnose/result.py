"""The model a fit leads to: idle model with refitted shapes, effects, and the covariance of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.levenberg import effect_dofs
from operando.diagnose.model import Model
from operando.diagnose.refit import Fit
from operando.diagnose.shapes import given_driven
from operando.dof import Dof
from operando.effects import Effect

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem

Array = NDArray[Any]


def effects_of(fit: Fit, dofs: Sequence[Dof] = ()) -> list[Effect]:
    """The fitted terms as effects with values and standard deviations; an added mode's shape needs the idle model's DOFs."""
    out = []
    for term, q, spread in zip(fit.terms, fit.sizes, fit.std, strict=True):
        values = term.values(q)
        shape = values.pop("shape", None)
        std = {
            name: float(abs(term.kind.parameter(name).slope(float(values[name])) * s)) for name, s in zip(term.moving, spread, strict=False)
        }
        out.append(
            Effect(
                term.kind.kind,
                term.dofs,
                values,
                std,
                term.position,
                term.direction or "",
                term.sign < 0,
                None if shape is None or not dofs else {str(d): float(v) for d, v in zip(dofs, shape, strict=True)},
                fixed=tuple(term.fixed),
                band_hz=term.band_hz,
            )
        )
    return out


def moves_of(idle: ModalModel, fit: Fit) -> Array:
    """Move of θ for unit z of what was fitted, (n_parameters, k)."""
    n, m = idle.terms.n, len(idle.dofs)
    root = np.zeros((idle.n_parameters, fit.prior.size))
    root[2 * n : 2 * n + n * m] = np.moveaxis(fit.prior.slope(fit.z), 1, 0).reshape(n * m, -1)
    return root


def given_shapes(idle: ModalModel, fit: Fit, driven: bool = False) -> Array:
    """Covariance of θ given the directions of the shapes that were fitted, and (then, or if wanted) what lies outside at driven DOFs."""
    assert idle.covariance is not None
    covariance = np.array(idle.covariance)
    if fit.prior.size or driven:
        covariance[2 * idle.terms.n :, 2 * idle.terms.n :] = given_driven(idle)
    if fit.prior.size:
        across = covariance[:, 2 * idle.terms.n :] @ fit.prior.told
        own = fit.prior.told.T @ across[2 * idle.terms.n :]
        covariance -= across @ np.linalg.pinv(own, rcond=1e-10, hermitian=True) @ across.T
    return covariance


def model_of(problem: Problem, fit: Fit, geometry: Geometry | None = None) -> Model:
    """Idle model with the refitted shape values, the effects, and one covariance of all."""
    idle = problem.idle
    effects = tuple(effects_of(fit, idle.dofs))
    updated = fit.learnt.idle if fit.learnt else idle.with_terms(shapes=fit.phi)
    if idle.covariance is None or not fit.covariance.size:
        return Model(updated, effects, geometry)
    n_q, p = sum(v.size for v in fit.q), idle.n_parameters
    together = fit.learnt.joint if fit.learnt else _joint(idle, fit)
    # Rows of the values: all parameters of each effect, those held with no variance.
    size = sum(len(e.definition.parameters) for e in effects)
    lift = np.zeros((p + size, p + n_q))
    lift[:p, :p] = np.eye(p)
    row, column = p, p
    for term, effect in zip(fit.terms, effects, strict=True):
        for k, number in enumerate(effect.definition.parameters):
            if number.name in term.moving:
                lift[row + k, column + term.moving.index(number.name)] = number.slope(float(effect.values[number.name]))
        row += len(effect.definition.parameters)
        column += term.size
    joint = lift @ together @ lift.T
    return _without_unused(problem, fit, Model(replace(updated, covariance=joint[:p, :p]), effects, geometry, joint))


def _joint(idle: ModalModel, fit: Fit) -> Array:
    """Covariance of θ and the moving numbers: the idle model's own, with what was fitted in the place of what was open."""
    n_q, p = sum(v.size for v in fit.q), idle.n_parameters
    root = moves_of(idle, fit)
    joint = np.zeros((p + n_q, p + n_q))
    joint[:p, :p] = given_shapes(idle, fit) + root @ fit.covariance[n_q:, n_q:] @ root.T
    joint[p:, p:] = fit.covariance[:n_q, :n_q]
    joint[:p, p:] = root @ fit.covariance[n_q:, :n_q]
    joint[p:, :p] = joint[:p, p:].T
    return joint


def _without_unused(problem: Problem, fit: Fit, model: Model) -> Model:
    """The model without the places between sensors at which nothing was found."""
    idle, m = model.idle, len(model.idle.dofs)
    used = set(effect_dofs(fit.terms).tolist())
    keep = np.array([i for i in range(m) if i < m - problem.extra or i in used])
    if keep.size == m or idle.covariance is None or model.covariance is None or model.geometry is None:
        return model
    n = idle.terms.n
    rows = np.r_[np.arange(2 * n), (2 * n + np.arange(n)[:, None] * m + keep[None, :]).ravel()]
    values = np.arange(idle.n_parameters, len(model.covariance))
    gone = {idle.dofs[i].node for i in range(m)} - {idle.dofs[i].node for i in keep}
    nodes = [k for k, node in enumerate(model.geometry.nodes) if node not in gone]
    smaller = idle.with_terms(
        shapes=np.asarray(idle.terms.shapes)[keep], dofs=tuple(idle.dofs[i] for i in keep), covariance=idle.covariance[np.ix_(rows, rows)]
    )
    known = replace(model.geometry, nodes=tuple(model.geometry.nodes[k] for k in nodes), coordinates=model.geometry.coordinates[nodes])
    both = np.r_[rows, values]
    return Model(smaller, model.effects, known, model.covariance[np.ix_(both, both)])
