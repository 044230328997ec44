"""What the differences found between two measurements say of these: more than days make, less, or an effect by another name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import SPREAD_FACTOR
from operando.diagnosis.criteria import PROMOTED, STRAINED, UNUSUAL
from operando.diagnosis.forward import Point
from operando.diagnosis.posterior import State
from operando.diagnosis.terms import Term

Array = NDArray[Any]


def strained(state: State) -> bool:
    """Whether a part of what differs between the days is far beyond the spread stated for it: it may stand for something else."""
    between, n_shape = state.case.between, state.case.forward.n_shape
    power: dict[str, list[Array]] = {}
    for (name, shared, where), factor in zip(between.groups, np.exp(between.log_factors), strict=True):
        values = state.x.d[where] if shared else state.x.own[:, n_shape:][where]
        power.setdefault(name, []).append((factor * values.ravel()) ** 2)
    return any(float(np.mean(v)) > STRAINED for v in map(np.concatenate, power.values()) if v.size > 1)


def _by_name(state: State) -> dict[str, tuple[float, float]]:
    """Of each name the mean logarithm of its spreads over those of laboratories, and its standard deviation, in ``SPREAD_FACTOR``.

    Half of the variance is common to the spreads of one name: a sensor where shapes are steep shows more of the same offset than others.
    """
    by_name: dict[str, list[float]] = {}
    for (name, _, _), by in zip(state.case.between.groups, state.case.between.log_factors, strict=True):
        by_name.setdefault(name, []).append(float(by) / SPREAD_FACTOR)
    return {name: (float(np.mean(v)), float(np.sqrt(0.5 + 0.5 / len(v)))) for name, v in by_name.items()}


def unlike_days(state: State) -> bool:
    """Whether the estimated spreads of what differs are beyond what laboratories have: it stands for something else."""
    return any(mean > UNUSUAL * std for mean, std in _by_name(state).values())


def untouched(state: State) -> bool:
    """Whether channels are as they were, as on no other day, and yet modes have moved one by one: the structure has changed.

    By the spreads estimated of gains and positions of sensors and positions of forces, together. Modes have not moved where their shifts
    are as far below those of laboratories, or no more than what is not known of them. What a temperature does moves all modes alike.
    """
    between, known = state.case.between, _by_name(state)
    moved = 0.0
    for (name, _, where), by in zip(between.groups, between.log_factors, strict=True):
        if name == "mode":
            shift, std = state.x.d[where], state.std()[0][where]
            moved = float(np.exp(by) * np.sqrt(np.mean(np.where(np.abs(shift) > UNUSUAL * std, shift, 0.0) ** 2)))
    touched = [known[name] for name in ("sensor", "seen", "driven") if name in known]
    if not touched or moved < np.exp(-UNUSUAL * SPREAD_FACTOR):
        return False
    return bool(sum(mean / std for mean, std in touched) / np.sqrt(len(touched)) < -UNUSUAL)


def no_other_day(state: State) -> bool:
    """Whether two days in a laboratory are no explanation, whatever further effect stands beside them.

    Of 16 tests on two days (``benchmarks/hidden_effects``, plan ``days``) none came to this at the end of a search at sensors.
    """
    return unlike_days(state) or untouched(state)


def remounted(state: State) -> bool:
    """Whether more than one channel has changed: then something was touched."""
    return sum(t.definition.acts == "sensor_map" for t in state.terms) > 1


def promotions(state: State, beyond: float = PROMOTED) -> list[Point]:
    """The effects of whose name a difference between the days far beyond its spread is, in its place."""
    case, x = state.case, state.x
    between, n_shape = case.between, case.forward.n_shape
    have, out, shared = {t.kind for t in x.terms}, [], between.shared

    def put(term: Term, d: np.ndarray, own: np.ndarray | None = None) -> None:
        if term.kind in case.kinds:
            out.append(replace(state.carried([*x.terms, term]), d=d, own=x.own if own is None else own))

    if shared["stiffness"].stop > shared["stiffness"].start:
        at = shared["stiffness"].start
        if abs(x.d[at]) > beyond and "global_stiffness" not in have:
            d, each = x.d.copy(), shared["mode"]
            shift = float((d[each] * between.shared_spread[each]).mean()) if each.stop > each.start else 0.0
            if shift:
                d[each] -= shift / between.shared_spread[each]
            value = float(d[at] * between.shared_spread[at]) + 2 * shift  # all frequencies by half of it
            d[at] = 0
            put(Term("global_stiffness", (), (float(np.log(abs(value))),), int(np.sign(value))), d)
    each = shared["damping"]
    if each.stop > each.start and "global_damping" not in have:
        whole = shared["damping_whole"].start
        mean = float((x.d[each] * between.shared_spread[each]).mean())
        if abs(x.d[whole]) > beyond or abs(mean) > between.shared_spread[each].mean():
            d = x.d.copy()
            d[each] -= mean / between.shared_spread[each]
            value = mean + float(d[whole] * between.shared_spread[whole])
            d[whole] = 0
            put(Term("global_damping", (), (value,)), d)
    part = between.own["sensor"]
    if part.stop > part.start:
        column = n_shape + part.start
        for i in np.flatnonzero(np.abs(x.own[:, column]) > beyond):
            own = x.own.copy()
            own[i, column] = 0
            put(Term("sensor_gain", (int(i),), (float(x.own[i, column] * between.own_spread[i, part.start]),)), x.d, own)
    for number, at in enumerate(range(shared["force"].start, shared["force"].stop)):
        if abs(x.d[at]) > beyond:
            d = x.d.copy()
            d[at] = 0  # H is divided by the gain of the force
            put(Term("force_gain", (int(case.forward.references[number]),), (-float(x.d[at] * between.shared_spread[at]),)), d)
    return out
