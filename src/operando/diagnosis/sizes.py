"""Sizes of effects between sensors, from the evidence with the size held.

The shape at such a place is hardly known, and an effect moves the FRFs by its size times the shape squared. Along this valley the likeliest
point runs to sizes far too large, with a shape near zero, where the volume of all else that explains the lines is small.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.forward import Point
from operando.diagnosis.posterior import State, names
from operando.diagnosis.rival import fitted_if_can_be
from operando.diagnosis.scan import Say
from operando.diagnosis.search import Found

Array = NDArray[Any]
_KNOWN = 0.1  # standard deviation of the logarithm of a size from which it is looked at: known better, there is no such valley
_STEP = float(np.log(2))  # of the logarithm of a size, at most, from one that is held to the next: else one standard deviation
_MOST = 24  # sizes held
_FALL = 2.0  # nats below the largest evidence at which a side is left
_WIDEST = 2.0  # standard deviation of the logarithm of a size whose evidence has no curvature


def with_likely_sizes(found: Found, say: Say = lambda text: None) -> Found:
    """With the most probable state at the size of its largest evidence, where one effect between sensors is in it."""
    best = found.best
    std, first = np.sqrt(np.diag(best.covariance)) if best.terms else np.zeros(0), _first_values(best)
    at = [n for n, t in enumerate(best.terms) if t.structural and t.values and best.case.idle.midway.keys() & set(t.places)]
    if len(at) != 1 or std[first[at[0]]] < _KNOWN:
        return found
    state = at_likely_size(best, at[0])
    say(f"  by the evidence with its size held: {names(state.case, state.terms)} {state.log_evidence:.1f}")
    return replace(found, best=state, pool=found.pool | {state.key: state})


def at_likely_size(state: State, number: int) -> State:
    """A state at the size of an effect for which its evidence, all else integrated out, is largest.

    Parameters
    ----------
    state : State
    number : int
        Of the effect among its terms.

    Returns
    -------
    State
        With the size held, its spread from the curvature of the evidence, and the evidence integrated over it.
    """
    case, term = state.case, state.terms[number]
    mean, std = (float(v[0]) for v in case.prior(term))
    step = min(float(np.sqrt(state.covariance[_first_values(state)[number], _first_values(state)[number]])), _STEP)
    held: dict[float, State] = {}

    def evidence(size: float) -> float:
        """Of the size on the search scale, with its prior."""
        if size not in held:
            near = held[min(held, key=lambda s: abs(s - size))] if held else state
            one = replace(near.terms[number], values=(size, *near.terms[number].values[1:]), fixed=(0,))
            terms = tuple(one if n == number else t for n, t in enumerate(near.terms))
            made = fitted_if_can_be(case, replace(_along_valley(near, number, size), terms=terms), near.alpha)
            if made is None:
                return -np.inf
            held[size] = made
        return held[size].log_evidence - 0.5 * ((size - mean) / std) ** 2 - float(np.log(std)) - 0.5 * float(np.log(2 * np.pi))

    first = float(term.values[0])
    known = {first: evidence(first)}
    for side in (-1, 1):
        size = first
        while len(known) < _MOST:
            size += side * step
            known[size] = evidence(size)
            if not known[size] > max(known.values()) - _FALL:
                break
    best = max(known, key=lambda s: known[s])
    around = [best - step, best, best + step]
    low, top, high = (known[s] if s in known else evidence(s) for s in around)
    if not np.isfinite((low, top, high)).all():  # a size beside it leads to numbers that cannot be
        return state
    curvature = max((2 * top - low - high) / step**2, _WIDEST**-2)
    likely = best + float(np.clip((high - low) / (2 * step) / curvature, -step, step))
    value = evidence(likely)
    final = held.get(likely, held[best])
    variance = 1 / curvature
    moves = _moved_by(held, around, number)
    size = 0.5 * float(np.log(2 * np.pi * variance))
    return replace(final, log_evidence=max(value, top) + size, sizes={number: (variance, moves)})


def _along_valley(state: State, number: int, size: float) -> Point:
    """A point of the same FRFs, nearly, at another size: the shape between sensors changes by the root of what the size does not."""
    idle, x, k = state.case.forward.idle, state.x, state.case.forward.n_shape
    term, own = x.terms[number], x.own.copy()
    shapes, _ = idle.shape(x.g, own[:, :k])
    by = float(np.exp(0.5 * (term.values[0] - size))) - 1
    for place in set(term.places) & idle.midway.keys():
        own[place, :k] += np.linalg.lstsq(idle.shapes.own[place], by * shapes[place], rcond=None)[0]
    return replace(x, own=own)


def _first_values(state: State) -> list[int]:
    """Where the values of each effect begin among those of all."""
    return [sum(len(t.values) for t in state.terms[:n]) for n in range(len(state.terms))]


def _moved_by(held: dict[float, State], around: list[float], number: int) -> Array:
    """How the values of all effects follow the size that is held, by their difference over two steps; one for the size itself."""
    ends = [held.get(s) for s in (around[0], around[2])]
    values = [np.concatenate([t.values for t in s.terms]) for s in ends if s is not None]
    here = held[around[1]]
    moves = (values[1] - values[0]) / (around[2] - around[0]) if len(values) == 2 else np.zeros(here.problem.n_values)
    moves[_first_values(here)[number]] = 1.0
    return np.asarray(moves)
