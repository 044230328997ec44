"""A poor idle model: what it leaves of the idle FRFs is an error of the operating measurement as well, and one effect is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import ABOVE_ERROR, LOWERED
from operando.diagnosis.forward import Point
from operando.diagnosis.found import Found
from operando.diagnosis.posterior import State, approach, fit, names
from operando.diagnosis.rival import fitted_if_can_be, score, started
from operando.diagnosis.scan import Say, robust_scan
from operando.diagnosis.search import Search
from operando.diagnosis.terms import Term
from operando.diagnosis.verdict import supported
from operando.dof import Dof

Array = NDArray[Any]

_WIDE = 0.1  # of a frequency, to each side: of so many half-power widths peaks are no more than single lines
_STRETCHES = 200
_LEAST_LINES = 9
_TRIED = 8  # leaders of the scan that are approached
_FROM = 0.1  # discrepancy that fits begin with


def with_what_is_left(frf: Frf, rest: State) -> Frf:
    """FRFs whose variance is at least what the idle model leaves of the idle FRFs, pair by pair.

    An offset under a window, hits beside their place and the like leave an error that is smooth over frequency: no average and no
    coherence knows of it, and between the peaks it may be as large as the FRF. Its median over a stretch leaves the peaks out, where the
    error is a share of the FRF: that is the discrepancy.

    ``frf`` is of the idle or of the operating measurement, ``rest`` the idle model on the idle FRFs. The FRFs returned are receptances;
    pairs that were not measured idle have the median of those that were.
    """
    case, frf = rest.case, frf.to_quantity("receptance")
    hz, h, _, _ = case.lines.every
    left = np.abs(h - case.forward.predict(rest.x, case.lines.w_all, derivatives=False).h) ** 2
    middles = np.geomspace(max(hz[0], 1e-3 * hz[-1]), hz[-1], _STRETCHES)
    around, half = np.searchsorted(hz, middles), _LEAST_LINES // 2
    first = np.minimum(np.searchsorted(hz, middles * (1 - _WIDE)), np.maximum(around - half, 0))
    last = np.maximum(np.searchsorted(hz, middles * (1 + _WIDE)), around + half)
    # the squared modulus of a complex normal deviate is exponential
    power = np.array([np.median(left[a:b], axis=0) for a, b in zip(first, last, strict=True)]) / np.log(2)
    dofs, there = case.dofs, case.lines.there

    def at(dof: Dof) -> list[list[int]]:
        """Where a DOF stands among the responses and references of the idle FRFs."""
        sides = case.forward.responses, case.forward.references
        return [[k for k, r in enumerate(side) if dofs[r].same_axis(dof)] for side in sides]

    other, variance = np.median(power[:, there], axis=1), np.empty(frf.data.shape)
    for i, response in enumerate(frf.responses):
        rows = at(response)
        for j, reference in enumerate(frf.references):
            columns = at(reference)
            pairs = [(a, k) for a in rows[0] for k in columns[1] if there[a, k]]
            pairs += [(a, k) for a in columns[0] for k in rows[1] if there[a, k]]  # the same FRF at rest
            variance[i, j] = np.interp(frf.frequencies_hz, middles, power[:, *pairs[0]] if pairs else other)
    return replace(frf, variance=variance if frf.variance is None else np.maximum(variance, frf.variance))


def one_effect(cases: Sequence[Case], say: Say) -> Found:
    """No effect or one, of the robust scan about the idle model as it is: on another day, and where nothing was touched.

    With all unknowns free, or a second effect beside the first, the errors of such a model become effects: on a plate whose modes drifted
    while the hammer roved, absorbers of 10 mg with thousands of nats. For the same reason no evidence tells the hypotheses apart, and
    each is told of the size by its own share of the shifted modes: the size is their mean, with half of their difference in its interval.
    What lowers the error as far is stated as one that may stand in its place. The scan, for which the idle model is exact, must name the
    same effect as the fit, for which it may adapt: fitted to a spring of 100 kN/m on the plate clamped again, the adapted model has a mass
    of 22 g removed.

    The cases are another day, and that nothing was touched; one where the test states what differs.
    """
    day, case = cases[0], cases[-1]
    search, start = Search(case, say), case.forward.start
    empty, search.pool[()] = (fit(one, approach(one, one.forward.start)[1], _FROM) for one in (day, case))
    rows = robust_scan(case, start)[:_TRIED]
    say("robust scan: " + ", ".join(f"{names(case, [term])[0]} {value:.0f}" for value, term, _ in rows))
    search.nearest(case, [replace(start, terms=(term,), u=np.zeros(len(case.forward.outside((term,))))) for _, term, _ in rows])
    best = max(search.pool.values(), key=score)
    nothing = Found(empty, empty, search.pool | {empty.key: empty})
    if not best.terms or not same_effect(best.terms[0], rows[0][1]) or not lowered_alone(best):
        return nothing
    # no evidence tells these apart either
    as_well = [s for s in search.pool.values() if s.terms and not same_effect(s.terms[0], best.terms[0]) and lowered_alone(s)]
    found = Found(best, search.pool[()], search.pool, as_well=as_well)
    if day is case:
        return found
    other = fitted_if_can_be(day, approach(day, started(day, best.terms))[1], _FROM)
    # what is no more than days in a laboratory differ, as a plate clamped again, is told as no effect
    both = _between_sizes(best, other) if other is not None and score(other) > score(empty) else None
    return nothing if both is None or not supported(both) else replace(found, best=both, pool=found.pool | {both.key: both})


def same_effect(one: Term, other: Term) -> bool:
    """Whether two effects are at one location and of one kind, or of kinds of which one contains the other."""
    one_kind = one.kind in (other.kind, *other.definition.contains) or other.kind in one.definition.contains
    return one_kind and one.places == other.places and one.sign == other.sign


def _between_sizes(state: State, other: State) -> State | None:
    """A state with its size half-way to that of another hypothesis; None where the two have opposite signs."""
    one, its = state.terms[0], other.terms[0]
    if one.sign != its.sign or not one.values:
        return state if not one.values else None
    size, half = 0.5 * (one.values[0] + its.values[0]), 0.5 * (one.values[0] - its.values[0])
    held = replace(one, values=(size, *one.values[1:]), fixed=(0,))
    made = fitted_if_can_be(state.case, replace(state.x, terms=(held,)), state.alpha)
    if made is None:
        return None
    variance = 0.5 * float(state.covariance[0, 0] + other.covariance[0, 0]) + half**2
    return replace(made, log_evidence=state.log_evidence, sizes={0: (variance, np.eye(len(one.values))[0])})


def lowered_alone(state: State) -> bool:
    """Whether effects take away the share of the error that "partial" asks for, with nothing else different between the measurements.

    On lines that were not fitted, where an FRF stands above its error. With differences between the days freed beside them, effects
    would be given what these explain.
    """
    case = state.case
    at, n_shape = case.lines.validation, case.forward.n_shape
    telling = case.lines.there & (np.abs(case.lines.h[at]) ** 2 > ABOVE_ERROR * case.lines.variance[at])

    def squares(x: Point) -> float:
        own = np.concatenate([x.own[:, :n_shape], 0 * x.own[:, n_shape:]], axis=1)
        h = case.forward.predict(replace(x, d=0 * x.d, own=own), case.lines.w[at], derivatives=False).h
        return float(np.sum(np.log(np.abs(h[telling] / case.lines.h[at][telling])) ** 2))

    return squares(state.x) < (1 - LOWERED) * squares(case.forward.start)
