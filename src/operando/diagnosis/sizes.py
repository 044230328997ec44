"""Sizes of effects between sensors, from the evidence with the size held.

The shape at such a place is hardly known, and an effect moves the FRFs by its size times the shape squared. Along this valley the likeliest
point runs to sizes far too large, with a shape near zero, where the volume of all else that explains the lines is small. How well the
neighbours suggest the shape of one place, all modes together, differs more from place to place than any one spread tells: it is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import logsumexp

from operando.diagnosis.criteria import EXPLAINED, SCALE_BETWEEN, SCALE_BETWEEN_STD
from operando.diagnosis.forward import Point
from operando.diagnosis.found import Found
from operando.diagnosis.midway import TOGETHER
from operando.diagnosis.posterior import State, names
from operando.diagnosis.rival import fitted_if_can_be, score
from operando.diagnosis.scan import Say
from operando.processes import side_by_side

Array = NDArray[Any]
_STEP = float(np.log(2))  # of the logarithm of a size, at most, from one that is held to the next: else one standard deviation
_NEAR, _BESIDE = 10.0, 2  # nats below the best, and number, of states whose sizes are held as well: the scale of errors is worth as much
_MOST = 24  # sizes held
_FALL = 5.0  # nats below the largest evidence at which a side is left: what is beyond moves a standard deviation by some per cent
_FINE, _ROUNDS = 1.2, 3  # standard deviations of a step, above which the sizes are held again in finer ones, so often at most
_WIDEST = 2.0  # standard deviation of the logarithm of a size where no other could be held
_GRID = 400  # sizes between the first and the last held, at which the evidence is summed
# Logarithms of the error of all shapes at a place, in the standard deviations they are given, which errors have at most: middles of steps.
_SCALES = np.linspace(-5.95, -0.05, 60)


def with_likely_sizes(found: Found, say: Say = lambda text: None) -> Found:
    """With states at their mean sizes, where one effect between sensors is in the most probable one: this, and those near it.

    Which location it is, is decided with the errors of its shapes: they are small at the right one, and as large as it takes elsewhere.
    Those near it are no answers where it explains nothing, not with its size held either, which leads on where a fit was caught.
    """
    best = found.best
    if len(_between(best)) != 1:
        return found
    near = [s for s in found.pool.values() if s is not best and s.log_evidence > best.log_evidence - _NEAR and len(_between(s)) == 1]
    held = {}
    for state in [best, *sorted(near, key=lambda s: -s.log_evidence)[:_BESIDE]]:
        held[state.key] = now = at_likely_size(state, *_between(state))
        say(f"  by the evidence with its size held: {names(now.case, now.terms)} {now.log_evidence:.1f}")
        if now.alpha >= EXPLAINED:
            break
    return replace(found, best=max(held.values(), key=score), pool=found.pool | held)


def _between(state: State) -> list[int]:
    """Which effects of a state stand between sensors."""
    midway = state.case.idle.midway.keys()
    return [n for n, t in enumerate(state.terms) if t.structural and t.values and midway & set(t.places)]


def at_likely_size(state: State, number: int) -> State:
    """A state at the mean size of an effect by its evidence with the size held, all else integrated out.

    The size is held at its mean, with its standard deviation, and the evidence is integrated over it. ``number`` is that of the effect
    among the terms of the state.
    """
    case, term = state.case, state.terms[number]
    mean, std = (float(v[0]) for v in case.prior(term))
    between = [place for place in term.places if place in case.idle.midway]
    held: dict[float, State] = {}

    def fitted(size: float) -> State | None:
        near = held[min(held, key=lambda s: abs(s - size))] if held else state
        one = replace(near.terms[number], values=(size, *near.terms[number].values[1:]), fixed=(0,))
        terms = tuple(one if n == number else t for n, t in enumerate(near.terms))
        return fitted_if_can_be(case, replace(_along_valley(near, number, size), terms=terms), near.alpha)

    def hold(sizes: Sequence[float]) -> None:
        new = [size for size in sizes if size not in held]
        held.update((size, made) for size, made in zip(new, side_by_side(fitted, new), strict=True) if made is not None)

    def evidence(size: float) -> float:
        """Of the size on the search scale, with its prior."""
        hold([size])
        if size not in held:
            return -np.inf
        prior = -0.5 * ((size - mean) / std) ** 2 - float(np.log(std)) - 0.5 * float(np.log(2 * np.pi))
        return held[size].log_evidence + by_scale(held[size], between) + prior

    at = _first_values(state)[number]
    free = float(np.sqrt(state.covariance[at, at]))
    likely, step = float(term.values[0]), min(free, _STEP)
    for _ in range(_ROUNDS):
        if not np.isfinite(evidence(likely)):  # the size leads to numbers that cannot be
            return state
        hold([likely - step, likely + step])
        known = _walked(evidence, likely, step)
        likely, spread, whole = _moments(known)
        if step < _FINE * spread or all(one.alpha >= EXPLAINED for one in held.values()):
            break
        step = spread
    if not np.isfinite(evidence(likely)):
        return state
    final = held[likely]
    moves = _moved_by(held, likely, number)
    # errors of neighbouring modes are alike, and the scale counts them as so many: the spread is no less than where none is estimated
    spread = max(spread, min(free, _STEP))
    return replace(final, log_evidence=whole, sizes={number: (spread**2, moves)})


def _walked(evidence: Callable[[float], float], first: float, step: float) -> dict[float, float]:
    """The evidence at sizes in steps to both sides of one, until it has fallen."""
    known = {first: evidence(first)}
    for side in (-1, 1):
        size = first
        while len(known) < _MOST:
            size += side * step
            known[size] = evidence(size)
            if not known[size] > max(known.values()) - _FALL:
                break
    return known


def _moments(known: dict[float, float]) -> tuple[float, float, float]:
    """Mean and standard deviation of a size by the evidence with it held, and the logarithm of the integral of that."""
    sizes = np.array(sorted(size for size, value in known.items() if np.isfinite(value)))
    if sizes.size < 2:
        return float(sizes[0]), _WIDEST, known[float(sizes[0])]
    grid = np.linspace(sizes[0], sizes[-1], _GRID)
    value = PchipInterpolator(sizes, [known[size] for size in sizes])(grid)
    weight = np.exp(value - value.max()) * (grid[1] - grid[0])
    mean = float(weight @ grid / weight.sum())
    std = float(np.sqrt(weight @ (grid - mean) ** 2 / weight.sum()))
    return mean, std, float(value.max() + np.log(weight.sum()))


def by_scale(state: State, places: Sequence[int]) -> float:
    """What the evidence gains where the errors of the shapes at some places have a scale of their own, integrated over it [nats].

    The data tell the unknowns of a place as m with covariance R: their likelihood is that of N(m; 0, P(s) + R) with a scale s, of the
    errors of each shape by itself, in place of N(m; 0, 1 + R). Errors that are small in all modes tell that s is.
    """
    out = 0.0
    for place in places:
        covariance, x, beside = _unknowns_at(state, place)
        v, axes = np.linalg.eigh(covariance)
        v = np.clip(v, 1e-12, 1 - 1e-9)
        r, m, n = v / (1 - v), (axes.T @ x) / (1 - v), axes.T @ beside
        s2 = np.exp(2 * _SCALES)[:, None, None]
        with_scale = s2 * np.eye(v.size) + (1 - s2) * (n @ n.T) + np.diag(r)
        squares = np.linalg.solve(with_scale, np.broadcast_to(m[:, None], (len(s2), m.size, 1)))[..., 0] @ m
        gain = 0.5 * (np.sum(np.log1p(r) + m**2 / (1 + r)) - np.linalg.slogdet(with_scale)[1] - squares)
        prior = -0.5 * ((_SCALES - SCALE_BETWEEN) / SCALE_BETWEEN_STD) ** 2
        out += float(logsumexp(gain + prior) - logsumexp(prior))
    return out


def _unknowns_at(state: State, place: int) -> tuple[Array, Array, Array]:
    """Covariance and values of what is not known of the shapes at a place, and how they follow what the scale is not of.

    That is what moves all shapes together, and those out of the band, which no neighbour tells. The unknowns are directions (terms, e) of
    all that there are (``Case`` leaves off what no FRF could tell), so P(s) is s² + (1 − s²) N Nᵀ.
    """
    forward, idle = state.case.forward, state.case.uncompressed
    ((unknowns, shared),) = ((one, where) for dof, one, where in state.problem.reaching if dof == place)
    at = np.flatnonzero(unknowns < forward.n_shape)
    every, out_of_band = idle.shapes.own[place], np.setdiff1d(np.arange(idle.f.size), idle.modes)
    lower = np.linalg.cholesky(every @ every.T)
    known = np.linalg.solve(lower, forward.idle.shapes.own[place][:, unknowns[at]])
    beside = np.linalg.solve(lower, every[:, np.r_[:TOGETHER, TOGETHER + out_of_band]])
    return state.factor.shared_covariance(shared.start)[np.ix_(at, at)], state.x.own[place, unknowns[at]], known.T @ beside


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


def _moved_by(held: dict[float, State], size: float, number: int) -> Array:
    """How the values of all effects follow the size that is held, by their difference between the nearest ones; one for the size itself."""
    low, high = (min((s for s in held if side * (s - size) > 0), key=lambda s: abs(s - size), default=size) for side in (-1, 1))
    here = held[size]
    values = [np.concatenate([t.values for t in held[s].terms]) for s in (low, high)]
    moves = (values[1] - values[0]) / (high - low) if high > low else np.zeros(here.problem.n_values)
    moves[_first_values(here)[number]] = 1.0
    return np.asarray(moves)
