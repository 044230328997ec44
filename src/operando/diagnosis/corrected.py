"""The idle model as a check leaves it, its effects, and the covariance of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalCoupling, ModalModel
from operando.data.modal_poles import pole_form
from operando.diagnosis.between import Outside
from operando.diagnosis.criteria import tolerated
from operando.diagnosis.posterior import State
from operando.diagnosis.terms import Term
from operando.structure import Model
from operando.structure.effects import Effect

Array = NDArray[np.float64]

_FAR, _FAR_DAMPING = 30.0, 0.01
"""Where terms stand that are constant or fall with 1/f² in band (to 1/900 of themselves): so many times beyond its ends."""


def effects_of(state: State, terms: Sequence[Term] | None = None) -> tuple[Effect, ...]:
    """The terms of a state with units and standard deviations; ``terms`` says which of them.

    A fit takes the discrepancy for independent from line to line. It may as well be one factor on all of them, as that of a calibration:
    a size is known no better than that.
    """
    std = np.sqrt(np.diag(state.covariance)) if state.problem.n_values else np.zeros(0)
    out, at = [], 0
    for number, term in enumerate(state.terms):
        scaled = term.structural or term.kind.endswith("_gain")  # on a logarithmic scale
        if scaled and (0 not in term.fixed or number in state.sizes):
            std[at] = np.hypot(std[at], state.alpha)
        if terms is None or term in terms:
            idle = state.case.idle
            effect = term.effect(state.case.dofs, std[at : at + len(term.values)].tolist(), state.case.band, idle.midway)
            if term.kind == "missing_mode":
                shape = idle.shape(state.x.g, state.x.own[:, : state.case.forward.n_shape])[0][:, idle.lacking]
                effect = replace(effect, shape={str(d): float(v) for d, v in zip(idle.dofs, shape, strict=True)})
            out.append(effect)
        at += len(term.values)
    return tuple(out)


def coupling_of(state: State, more: float, stiffer: float) -> ModalCoupling | None:
    """Damping that ties the terms to each other and to what lies outside the band, as a state has it; None where modes are real.

    All damping is ``more`` times as large as at rest, all stiffness ``stiffer`` times; effects stay out.
    """
    forward, x = state.case.forward, state.x
    idle, known, n, modes = forward.idle, forward.between, forward.idle.f.size, forward.modes
    part = known.shared_parts(x.d)
    between = idle.between + idle.between_root @ x.g + part["damping_between"]
    if not (between.any() or idle.complex):
        return None
    damping, lag = np.zeros((n, n)), np.zeros((len(idle.dofs), n))
    damping[known.first, known.second] = between * known.damping_scale * more
    if idle.complex:
        lag[:, modes] = idle.late(x.g, x.own[:, : forward.n_shape], more / stiffer)[0]
    return ModalCoupling(damping + damping.T, lag)


@dataclass(frozen=True)
class _Signed:
    """Residual terms, with signs, and how their shapes move by the unknowns u (u, DOFs, terms)."""

    hz: Array
    zeta: Array
    shapes: Array
    signs: Array
    by_u: Array


def _at_places(state: State) -> _Signed:
    """What lies outside the band at undriven locations of effects, as residual terms.

    Of a location i with the values v to all DOFs (half of its own) the receptance has e vᵀ + v eᵀ = ½ (a aᵀ − b bᵀ), with a, b = s e ± v/s.
    """
    forward, x, (low, high) = state.case.forward, state.x, state.case.band
    dofs = len(forward.idle.dofs)
    groups: dict[tuple[int, bool], list[tuple[int, Outside]]] = {}
    for number, row in enumerate(forward.outside(x.terms)):
        if row.spread > 0:
            groups.setdefault((row.place, row.below), []).append((number, row))
    hz, shapes, signs, by_u = np.zeros(2 * len(groups)), np.zeros((dofs, 2 * len(groups))), np.ones(2 * len(groups)), []
    zeta = np.full(hz.size, _FAR_DAMPING)
    signs[1::2] = -1
    for k, ((place, below), rows) in enumerate(groups.items()):
        by = np.zeros((x.u.size, dofs))
        for number, row in rows:
            by[number, row.other] = row.spread / (2 if row.other == place else 1)
        size = float(np.linalg.norm(by)) ** 0.5
        both = slice(2 * k, 2 * k + 2)
        hz[both] = high * _FAR
        if below:
            hz[both] = max(rows[0][1].swing / 2 / np.pi, low / _FAR)
            zeta[both] = np.clip(rows[0][1].lag / (2 * np.pi * hz[both]), _FAR_DAMPING, 1.0)
        unit = (1.0 if below else 2 * np.pi * high * _FAR) / np.sqrt(2)
        for term, sign in ((2 * k, 1), (2 * k + 1, -1)):
            shapes[:, term] = unit * sign * (x.u @ by) / size
            shapes[place, term] += unit * size
            by_u.append(unit * sign * by / size)
    return _Signed(hz, zeta, shapes, signs, np.stack(by_u, -1) if by_u else np.zeros((x.u.size, dofs, 0)))


def model_of(idle: ModalModel, state: State, geometry: Geometry | None = None) -> Model:
    """Idle model moved by what the check taught of it, with stiffness and damping of that day, and the effects.

    Gains of channels and places of sensors stay out: they are no structure. So does what ties modes by stiffness from day to day.
    """
    case, forward, x = state.case, state.case.forward, state.x
    moved, between = forward.idle, forward.between
    n, dofs, modes = moved.f.size, len(moved.dofs), moved.modes
    part = between.shared_parts(x.d)
    root = np.sqrt(max(1 + float(part["stiffness"].sum()), 0.05))
    more = float(np.exp(part["damping_whole"].sum()))
    by_mode, by_damping = np.ones(n), np.full(n, more)
    by_mode[modes], by_damping[modes] = np.exp(part["mode"]), more * np.exp(part["damping"])
    f, zeta, by_f, by_zeta = moved.diagonals(x.g)
    f, zeta = f * root * by_mode, zeta / root * by_damping
    phi, shapes = moved.shape(x.g, x.own[:, : forward.n_shape])
    zeta = np.maximum(zeta, 1e-9)
    effects = effects_of(state)
    # a place between sensors stays where something acts there; a mode that was lacking comes with its effect
    used = {i for t in state.terms for i in t.places}
    kept = np.array([i for i in range(dofs) if i not in moved.midway or i in used])
    at_rest = np.array([r for r in range(n) if r != moved.lacking])
    coupling = coupling_of(state, more, float(root**2))
    # b bᵀ + b δᵀ + δ bᵀ = (b + δ)(b + δ)ᵀ − δ δᵀ
    change = phi[:, moved.linear] - moved.phi[:, moved.linear]
    change[[*moved.midway]] = 0
    taken, change = moved.linear[change.any(axis=0)], change[:, change.any(axis=0)]
    every, beside = np.concatenate([at_rest, taken]), _at_places(state)
    if coupling is not None:
        coupling = coupling.select(every).at(kept, np.ones(kept.size))
        for _ in beside.hz:
            coupling = coupling.with_term(len(coupling.beside))
    updated = idle.with_terms(
        frequencies_hz=np.concatenate([f[every], beside.hz]),
        damping_ratios=np.concatenate([zeta[every], beside.zeta]),
        shapes=np.concatenate([phi[:, at_rest], change, beside.shapes], axis=1)[kept],
        signs=np.concatenate([np.ones(at_rest.size), -np.ones(taken.size), beside.signs]),
        dofs=tuple(moved.dofs[i] for i in kept),
        covariance=None,
        std=None,
        coupling=coupling,
    )
    if geometry is not None:
        gone = {moved.dofs[i].node for i in moved.midway if i not in used}
        there = [k for k, node in enumerate(geometry.nodes) if node not in gone]
        if len(there) < len(geometry.nodes):
            geometry = replace(geometry, nodes=tuple(geometry.nodes[k] for k in there), coordinates=geometry.coordinates[there])
    if idle.covariance is None:
        return Model(_with_poles(updated)[0], effects, geometry, discrepancy=tolerated(state.alpha))

    # θ and the values as linear in the unknowns: rows of a matrix whose product with the posterior covariance is theirs
    problem = state.problem
    sizes = [len(e.definition.parameters) for e in effects]
    # behind the shapes of the terms those at the locations, one number that is known, and the values
    count, first_value = beside.hz.size, 2 * n + n * dofs + beside.hz.size * dofs + 1
    rows = first_value + sum(sizes)
    shared = np.zeros((problem.n_shared, rows))
    own = np.zeros((dofs, forward.n_own, rows))
    g = slice(0, forward.n_g)
    shared[g, :n] = (by_f * (root * by_mode)[:, None]).T
    shared[g, n : 2 * n] = (by_zeta * (by_damping / root)[:, None]).T
    slopes = {
        "stiffness": (f / 2 / root**2, -zeta / 2 / root**2),
        "damping_whole": (np.zeros(n), zeta),
        "mode": (np.diag(f)[modes], np.zeros((modes.size, n))),
        "damping": (np.zeros((modes.size, n)), np.diag(zeta)[modes]),
        "damping_local": (np.zeros((dofs, n)), between.local_modes.T @ np.diag(zeta)[modes]),
    }
    for name, (f_slope, zeta_slope) in slopes.items():
        where = between.shared[name]
        if where.stop > where.start:
            at = slice(forward.n_g + where.start, forward.n_g + where.stop)
            spread = between.shared_spread[where][:, None]
            shared[at, :n], shared[at, n : 2 * n] = np.atleast_2d(f_slope) * spread, np.atleast_2d(zeta_slope) * spread
    for i in range(dofs):
        at_shape = 2 * n + np.arange(n) * dofs + i  # θ has shapes term by term
        shared[g, at_shape] = shapes.shared[i].T
        own[i][: forward.n_shape, at_shape] = shapes.own[i].T
    u = slice(problem.values_at - problem.n_u, problem.values_at)
    shared[u, 2 * n + n * dofs : first_value - 1] = np.swapaxes(beside.by_u, 1, 2).reshape(problem.n_u, count * dofs)
    row, column = problem.values_at, first_value
    for term, size in zip(state.terms, sizes, strict=True):
        for number in range(size):
            # what was taken away has its size stated positive; a negative coefficient falls as its logarithm grows
            sign = term.sign if number == 0 and not term.definition.removable else 1
            shared[row + number, column + number] = sign * term.slope(number, case.band)
        row, column = row + size, column + size
    for dof, reaching, at in problem.reaching:
        shared[at] = own[dof][reaching]
        own[dof][reaching] = 0
    by_response = own[problem.order]
    a, b = state.factor.whitened(shared, by_response)
    joint = a.T @ a + np.tensordot(b, b, ((0, 1), (0, 1)))
    known = np.full(count, first_value - 1)
    at_shapes = 2 * n + np.concatenate([every, n + np.arange(count)])[:, None] * dofs + kept
    between_sensors = np.flatnonzero(np.isin(kept, [*moved.midway]))
    at_shapes[at_rest.size : every.size, between_sensors] = first_value - 1  # no change of these is taken away
    theta = np.concatenate([every, known, n + every, known, at_shapes.ravel()])
    both = np.concatenate([theta, np.arange(first_value, rows)])
    updated, turn = _with_poles(updated)
    joint = joint[np.ix_(both, both)]
    joint[: len(turn)] = turn @ joint[: len(turn)]
    joint[:, : len(turn)] = joint[:, : len(turn)] @ turn.T
    return Model(updated.with_terms(covariance=joint[: theta.size, : theta.size]), effects, geometry, joint, tolerated(state.alpha))


def _with_poles(model: ModalModel) -> tuple[ModalModel, Array]:
    """With frequencies and damping ratios of the poles where modes are tied, and how these follow the terms' own (2n, 2n)."""
    form = pole_form(model.terms)
    if form is None:
        return model, np.zeros((0, 0))
    hz, zeta = form.frequencies_hz, form.damping_ratios
    return model.with_terms(frequencies_hz=hz, damping_ratios=zeta, coupling=form.coupling), form.by_terms
