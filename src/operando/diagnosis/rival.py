"""What a state is worth, and another hypothesis of the same lines that a search is held against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from operando.diagnosis.case import Case
from operando.diagnosis.criteria import CONTAINING, EARNED, LEAST_CHANGE, PROMOTED
from operando.diagnosis.forward import Point
from operando.diagnosis.joints import no_more_than_days
from operando.diagnosis.lines import Lines
from operando.diagnosis.posterior import State, fit
from operando.diagnosis.terms import Term
from operando.processes import side_by_side


def score(state: State) -> float:
    """Log probability of a state but for a constant: a further effect must be worth it, and more than what days differ by."""
    if any(no_more_than_days(state.case, t, state.x.d) for t in state.terms) or changes_too_little(state):
        return -np.inf
    # all stiffness or all damping that differs far beyond two days is an effect by another name
    wholes = [state.case.between.shared[name] for name in ("stiffness", "damping_whole")]
    beyond = sum(part.stop > part.start and abs(state.x.d[part.start]) > PROMOTED for part in wholes)
    containing = sum(bool(t.definition.contains) for t in state.terms)
    return state.log_evidence - EARNED * (len(state.terms) + beyond) - CONTAINING * containing


def changes_too_little(state: State) -> bool:
    """Whether one of several effects changes the FRFs by less than ``LEAST_CHANGE``."""
    case, x = state.case, state.x
    if len(x.terms) < 2 or not isinstance(case.lines, Lines):
        return False
    if state.least_change is None:
        w = case.lines.w[case.lines.fit[:: case.lines.stride]]

        def logarithms(point: Point) -> Any:
            return np.log(np.where(case.lines.there, case.forward.predict(point, w, derivatives=False).h, 1.0))

        with np.errstate(all="ignore"):
            whole = logarithms(x)
            changes = [logarithms(state.carried([o for o in x.terms if o is not t])) - whole for t in x.terms]
        sizes = [np.hypot(c.real, np.remainder(c.imag + np.pi, 2 * np.pi) - np.pi) for c in changes]
        state.least_change = float(min(np.sqrt(np.mean(s[:, case.lines.there] ** 2)) for s in sizes))
    return state.least_change < LEAST_CHANGE


def started(case: Case, terms: tuple[Term, ...]) -> Point:
    """Effects with everything else as at rest."""
    return replace(case.forward.start, u=np.zeros(len(case.forward.outside(terms))), terms=terms)


def fitted_if_can_be(case: Case, x: Point, alpha: float, **how: Any) -> State | None:
    """As :func:`fit`; None where a start leads to numbers that cannot be."""
    try:
        with np.errstate(all="ignore"):
            return fit(case, x, alpha, **how)
    except np.linalg.LinAlgError:
        return None


class Rival:
    """Another hypothesis of the same lines, more general than the one searched: the best ``score`` so far with the same effects."""

    def __init__(self, case: Case, state: State) -> None:
        self.case, self.score = case, score(state)

    def asked(self, sets: Sequence[tuple[Term, ...]], alpha: float, floor: float = -np.inf) -> float:
        """The best score, with some sets of effects tried as well."""

        def one(terms: tuple[Term, ...]) -> float:
            state = fitted_if_can_be(self.case, started(self.case, terms), alpha, floor=floor)
            more = () if state is None else tuple(t for t in state.terms if not no_more_than_days(state.case, t, state.x.d))
            return -np.inf if state is None else score(state) if len(more) == len(terms) else one(more)

        self.score = max([self.score, *side_by_side(one, sets)])
        return self.score
