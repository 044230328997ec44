"""Where effects leave the model farther off than it is without them, on the day of the validation measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from operando.compare import gets_worse
from operando.compare.comparison import rows_by_band, rows_by_dof
from operando.compare.measures import Lines, noise_floor_db
from operando.diagnosis.forward import Point
from operando.diagnosis.posterior import State

_AT_ONCE = 500  # lines predicted at a time


def farther_off(state: State) -> str | None:
    """Response or band in which effects raise the error by more than noise and discrepancy do; None where there is none.

    Both models are told on the day of the validation measurement, with all that was found to differ from the idle one: gains,
    positions of sensors, temperature and damping move FRFs by decibels and are no reason to doubt an effect.
    """
    case, x = state.case, state.x
    own = x.own.copy()
    own[:, : case.forward.n_shape] = 0
    without = replace(x, g=0 * x.g, own=own, u=np.zeros(0), terms=())
    told = {name: _rows(state, point) for name, point in (("idle", without), ("effect", x))}
    return gets_worse(told)


def _rows(state: State, x: Point) -> dict[str, object]:
    """Errors by response and by band on all lines, as a comparison has them."""
    case = state.case
    hz, measured, variance, level = case.lines.every
    blocks = np.array_split(2 * np.pi * hz, -(-hz.size // _AT_ONCE))
    h = np.concatenate([case.forward.predict(x, w, derivatives=False).h for w in blocks])
    there = np.broadcast_to(case.lines.there, h.shape)
    row = np.broadcast_to(np.arange(h.shape[1])[:, None], h.shape)
    f = np.broadcast_to(hz[:, None, None], h.shape)
    own = (state.alpha * level) ** 2
    lines = Lines(h[there], measured[there], variance[there], own[there], row[there], f[there])
    dofs = [case.dofs[i] for i in case.forward.responses]
    return {"noise_floor_db": noise_floor_db(lines), "by_dof": rows_by_dof(lines, dofs), "by_band": rows_by_band(lines, *case.band)}
