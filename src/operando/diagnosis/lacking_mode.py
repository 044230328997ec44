"""States of an idle model with the mode that it lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from operando.diagnosis.case import Case
from operando.diagnosis.criteria import ALIKE_CURVES, EARNED
from operando.diagnosis.found import Found
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import with_lacking
from operando.diagnosis.posterior import State, approach, fit
from operando.diagnosis.rival import fitted_if_can_be, score
from operando.diagnosis.scan import Say
from operando.processes import side_by_side


def grown_by_a_mode(states: Sequence[State]) -> list[Idle]:
    """Idle models with a mode more, each at the pole that takes most from what a state leaves; one for states that agree on it."""
    out: list[Idle] = []
    for state in states:
        grown = None if state.case.idle.lacking is not None else with_lacking(state)
        if grown is not None and not any(_same_pole(grown, other) for other in out):
            out.append(grown)
    return out


def _same_pole(grown: Idle, other: Idle) -> bool:
    """Whether the modes that two models have more are within their half-power width."""
    (f, zeta), (its, its_zeta) = ((float(m.f[m.lacking]), float(m.zeta[m.lacking])) for m in (grown, other))
    return abs(f / its - 1) < zeta + its_zeta


def with_mode(
    grown: Idle,
    again: Callable[[Idle], Sequence[Case]],
    bar: float,
    say: Say,
    untouched: bool = False,
    own_spreads: bool = False,
) -> Found | None:
    """States of an idle model with the mode that it lacks, where one lifts the score above a bar.

    ``grown`` is a model with a mode more, ``lacking``; ``again`` gives the same check with another idle model. ``untouched`` asks for a
    state where nothing was touched, plainly more probable than another day. ``own_spreads`` says that the bar is of a state whose spreads
    were estimated: then it is reached with these estimated, too.
    """
    say(f"a mode missing in the idle model, near {grown.f[grown.lacking]:.4g} Hz:")
    cases = again(grown)

    def fitted(case: Case, floor: float = -np.inf) -> State:
        return fit(case, approach(case, replace(case.forward.start, terms=grown.lacking_term))[1], 0.03, floor=floor)

    floor = -np.inf if own_spreads else bar
    starts = [fitted(cases[-1], floor)] if untouched else side_by_side(lambda case: fitted(case, floor), cases)
    first = max(starts, key=score)
    reached = fitted_if_can_be(first.case, first.x, first.alpha, own_spreads=True, floor=bar) if own_spreads else first
    say(f"  with it alone {(reached or first).log_evidence:.1f}, discrepancy {first.alpha:.4f}")
    if reached is None or score(reached) <= bar or not apart(first):
        return None
    # the fit of one hypothesis was not asked for yet, or left off far below the bar; the odds ask for its end
    those = [None] * (len(cases) - len(starts)) + starts
    starts = [fitted(c) if s is None or score(s) <= floor else s for s, c in zip(those, cases, strict=True)]
    if untouched and score(first) < score(starts[0]) + EARNED:
        return None
    empty = fit(first.case, first.case.forward.start, 0.1)
    odds = None if len(starts) < 2 else score(starts[1]) - score(starts[0])
    return Found(first, empty, {s.key: s for s in (empty, first)}, odds=odds)


def apart(state: State) -> bool:
    """Whether a mode that was lacking is no other one that differs: the curve of no mode is nearer to its own than half-power widths apart.

    Curves 1/(iω − λ) have the squared correlation 4 σ₁σ₂ / ((σ₁ + σ₂)² + (ω₁ − ω₂)²) with σ = ζω over all frequencies: ½ for modes of one
    damping that are apart by their half-power width. A sharp peak on the hump of a mode that is damped six times as much is below that.
    """
    idle = state.case.idle
    others = [r for r in idle.modes if r != idle.lacking]
    mode = next((t for t in state.terms if t.kind == "missing_mode"), None)
    if mode is None:
        return True
    f, zeta = (float(np.exp(v)) for v in mode.values)
    loss, others_loss = zeta * f, idle.zeta[others] * idle.f[others]
    alike = 4 * loss * others_loss / ((loss + others_loss) ** 2 + (idle.f[others] - f) ** 2)
    return bool(np.all(alike < ALIKE_CURVES))
