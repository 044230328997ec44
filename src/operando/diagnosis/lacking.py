"""A mode that the idle model lacks: where one more pole takes most from the error, or a measured mode stands for none; and its shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.criteria import ROBUST
from operando.diagnosis.idle import Idle, Moves
from operando.diagnosis.modes_case import ModesCase
from operando.diagnosis.posterior import State
from operando.synthesis import modal_kernel

Array = NDArray[Any]

_GRID = 240  # frequencies tried in the band before the best is refined
_DAMPING = (0.003, 0.008, 0.02, 0.05)
_WIDE = 2.0  # standard deviation of its shape, over the rms of what is seen: nothing else is known of it


def with_lacking(state: State, hz: float | None = None) -> Idle | None:
    """The idle model with one more mode, at the pole whose free residues take most from what a state leaves; None where none takes any.

    Of operational modes the one that is farthest from what stands for it. With ``hz`` it is looked for within 5 % of that only. The last
    mode of the model that is returned is there only with its effect, ``lacking_term``.
    """
    case, forward = state.case, state.case.forward
    if isinstance(case, ModesCase):
        return _of_modes(state, case, hz)
    lines, measured, variance, level = case.lines.every
    error = measured - forward.predict(state.x, case.lines.w_all, derivatives=False).h
    # a line that one pole cannot explain must not rule
    weight = 1 / (variance + (ROBUST * level) ** 2 + np.abs(error) ** 2)
    flat, w = error.reshape(len(lines), -1), weight.reshape(len(lines), -1)

    def taken(f: Array, zeta: float) -> tuple[Array, Array]:
        g = modal_kernel(lines, f, np.full(f.size, zeta), "receptance")
        cross = g.real @ (w * flat.real) + g.imag @ (w * flat.imag)
        power = np.maximum((np.abs(g) ** 2) @ w, 1e-300)
        return np.sum(cross**2 / power, axis=1), cross / power

    best = (-np.inf, 0.0, 0.0)
    for zeta in _DAMPING:
        f = np.linspace(*(case.band if hz is None else (0.95 * hz, 1.05 * hz)), _GRID)
        for _ in range(3):
            falls = taken(f, zeta)[0]
            k = int(np.argmax(falls))
            best = max(best, (float(falls[k]), float(f[k]), zeta))
            f = np.linspace(f[k] - 2 * (f[1] - f[0]), f[k] + 2 * (f[1] - f[0]), 41)
    fall, at, zeta = best
    residues = taken(np.array([at]), zeta)[1].reshape(error.shape[1:])
    u, s, vh = np.linalg.svd(residues, full_matrices=False)
    shape = np.zeros(forward.n_dofs)
    row = {int(d): i for i, d in enumerate(forward.responses)}
    columns = [i for i, r in enumerate(forward.references) if int(r) in row]
    rows = [row[int(forward.references[i])] for i in columns]
    across = float(u[rows, 0] @ vh[0, columns]) if rows else 0.0
    if not (fall > 0 and across):
        return None
    # a mode adds to its drive points; near a node there, what is left of other modes hides the sign, and the fit decides
    shape[forward.responses] = u[:, 0] * np.sqrt(s[0] * float(vh[0, columns] @ vh[0, columns]) / abs(across))
    return _grown(state, at, zeta, shape)


def _of_modes(state: State, case: ModesCase, hz: float | None) -> Idle | None:
    """One mode more for the measured one without which the others are nearest to predicted ones; its scale is that of the others."""
    modes, forward = case.lines.sets[0], case.forward
    k = forward.alone(state.x) if hz is None else int(np.argmin(np.abs(np.log(modes.f / hz))))
    y = modes.shapes[:, k]
    real = (y * np.exp(-0.5j * np.angle(np.sum(y**2)))).real
    shape = np.zeros(forward.n_dofs)
    others = np.linalg.norm(case.idle.phi[np.ix_(forward.responses, case.idle.modes)], axis=0)
    shape[forward.responses] = real / np.linalg.norm(real) * np.median(others)
    return _grown(state, float(modes.f[k]), float(modes.zeta[k]), shape)


def _grown(state: State, hz: float, zeta: float, shape: Array) -> Idle:
    """One mode more, whose shape at each DOF is that DOF's own."""
    idle = state.case.uncompressed
    dofs, terms = idle.phi.shape
    m = idle.modes.size
    spread = _WIDE * float(np.sqrt(np.mean(shape[state.case.forward.responses] ** 2)))

    def wider(moves: Moves, own: Array) -> Moves:
        column = np.zeros((dofs, 1, moves.shared.shape[2]))
        parts = np.zeros((dofs, moves.own.shape[1] + 1, moves.own.shape[2] + 1))
        parts[:, :-1, :-1] = moves.own
        parts[:, -1, -1] = own
        return Moves(np.concatenate([moves.shared, column], 1), parts)

    old, new = np.triu_indices(m, 1), np.triu_indices(m + 1, 1)
    square = np.zeros((m + 1, m + 1, 1 + idle.between_root.shape[1]))
    square[old] = np.c_[idle.between, idle.between_root]
    between = square[new]
    none = np.zeros((1, idle.f_root.shape[1]))
    return replace(
        idle,
        f=np.append(idle.f, hz),
        zeta=np.append(idle.zeta, zeta),
        phi=np.c_[idle.phi, shape],
        residual=np.append(idle.residual, False),
        between=between[:, 0],
        lag=np.c_[idle.lag, np.zeros(dofs)],
        f_root=np.concatenate([idle.f_root, none]),
        zeta_root=np.concatenate([idle.zeta_root, none]),
        between_root=between[:, 1:],
        shapes=wider(idle.shapes, np.full(dofs, spread)),
        lags=wider(idle.lags, np.zeros(dofs)),
        lacking=terms,
    )
