"""The discrepancy that makes the evidence of a state largest, and how well its lines tell it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor
from operando.diagnosis.criteria import LEAST_DISCREPANCY, MOST_DISCREPANCY
from operando.diagnosis.posterior import State, linear_evidence, with_discrepancy
from operando.diagnosis.problem import Step

Array = NDArray[Any]

_STEP = 0.02  # of its logarithm, for the curvature: a standard deviation is as much or more
_NEAR = 0.3  # of its logarithm from that of a fit, within which the most likely one is looked for first


def most_likely(state: State) -> State:
    """The same state under the discrepancy that makes its evidence largest: a fit ends within ten per cent of it."""
    alpha, std = likely_discrepancy(state)
    out = state if std is None else with_discrepancy(state, alpha)
    out.likely = alpha, std
    return out


def discrepancy_row(state: State) -> dict[str, float | None]:
    """``discrepancy`` of ``diagnosis.json``: value and standard deviation; of the least one, which is assumed, no deviation.

    Where the value is not the most likely one of the fitted lines (validation lines asked for more), it is known no better than the two
    differ: that difference counts.
    """
    likely, std = state.likely or likely_discrepancy(state)
    if std is None:
        return {"value": state.alpha, "std": None if state.alpha <= LEAST_DISCREPANCY * (1 + 1e-9) else state.alpha - likely}
    return {"value": state.alpha, "std": float(np.hypot(likely * std, state.alpha - likely))}


def likely_discrepancy(state: State) -> tuple[float, float | None]:
    """Discrepancy of the largest evidence about a state, and the standard deviation of its logarithm; none at the least one.

    The curvature of the evidence alone takes the discrepancy of all pairs for independent and its correlation over lines for known. What
    one error leaves on many pairs is counted once by the scatter of the score between stretches of frequency over which a discrepancy
    changes (White, Econometrica 50, 1982, 1–25); the larger of the two counts.
    """
    from scipy.optimize import minimize_scalar  # a tenth of a second, which only a result needs

    problem = state.problem
    x = problem.packed(state.x)
    slopes, residual = problem.derived(x)

    @lru_cache
    def model(log: float) -> tuple[float, Step, Factor]:
        return linear_evidence(problem, residual, slopes, x, float(np.exp(log)))

    def evidence(log: float) -> float:
        return model(log)[0]

    low, high = np.log(LEAST_DISCREPANCY), np.log(MOST_DISCREPANCY)
    ended = state.alpha <= LEAST_DISCREPANCY * (1 + 1e-9)
    if ended and evidence(low + _STEP) <= evidence(low):  # the evidence has one maximum
        return LEAST_DISCREPANCY, None
    for a, b in ((max(low, np.log(state.alpha) - _NEAR), min(high, np.log(state.alpha) + _NEAR)), (low, high)):
        log = float(minimize_scalar(lambda v: -evidence(float(v)), bounds=(a, b), method="bounded", options={"xatol": 1e-3}).x)
        if (a == low or log > a + _STEP) and (b == high or log < b - _STEP):
            break
    around = [evidence(log + step) for step in (-_STEP, 0, _STEP)]
    curvature = -(around[0] - 2 * around[1] + around[2]) / _STEP**2
    alpha = float(np.exp(log))
    if log - low < _STEP or curvature <= 0:
        return alpha, None
    _, best, factor = model(log)
    left = residual - problem.spread(slopes, best + x * -1)
    score = problem.case.lines.by_stretch(_score(state, alpha, left, slopes.variance(factor, slice(None))), problem.at)
    return alpha, float(np.sqrt(max(1 / curvature, np.sum(score**2) / curvature**2)))


def _score(state: State, alpha: float, left: Array, variance: Array) -> Array:
    """Derivative of the log evidence by the logarithm of the discrepancy, as a sum over lines: (lines,).

    ½ tr[(E[r rᴴ]·V⁻¹ − 1)·∂V·V⁻¹] line by line, with E[r rᴴ] of what is left and of what is not known of the unknowns.
    """
    problem = state.problem
    basis = problem.case.lines.basis(problem.at)[0]
    basis = basis.reshape(*problem.case.lines.there.shape, *basis.shape[-2:])
    rows = (*basis.shape[:3], -1)
    part = alpha**2 * problem.case.lines.spread(problem.at).reshape(rows)
    total = 1 + part
    back = np.linalg.inv(basis)
    weighted = left.reshape(rows) / total
    by_line = np.swapaxes(basis, -1, -2) @ weighted * (back @ (part * weighted))
    own = (part * (variance.reshape(rows) / total - 0.5) / total).sum(axis=-1)
    shared = np.einsum("rflk,rfkl,rfk->rfl", back, basis, own)
    return np.asarray(2 * (by_line.sum(axis=-1) + shared).sum(axis=(0, 1)))
