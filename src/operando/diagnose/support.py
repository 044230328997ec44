"""What the effects found stand on: the search for one more, and intervals that leave zero out."""

from __future__ import annotations

import numpy as np

from operando.compare.verdict import GOOD
from operando.diagnose.learn import BEYOND_NOISE, cost_once_corrected
from operando.diagnose.problem import EARNED, Problem, Tried, scan, shortlist, step, with_shapes
from operando.diagnose.refit import Fit, mean_misfit, predicted
from operando.diagnose.result import effects_of
from operando.diagnose.search import History, Search, in_order, without
from operando.diagnose.sets import JUDGE

LOOKED = 3
"""Best candidates beside the accepted effects that are held against the errors of the idle model: each takes a fit of all its modes."""


def one_more(problem: Problem, found: Search) -> Tried | None:
    """An effect beside those found that lowers what is left by more than the idle model's own errors could; None where none does.

    The misfit by the variance of the model hides a weak effect that is smaller than what the idle model may be off by. These errors are
    the same on all lines, so they are fitted here, within their covariance, with and without the candidate.
    """
    fit = problem.settled(found.fits[-1])
    if problem.idle.covariance is None or not fit.covariance.size:
        return None
    if problem.say:
        problem.say("look for one more effect")
    now, left = cost_once_corrected(problem, fit)
    best, least = None, (1 - EARNED) * now
    for one in _candidates(problem, found, left > BEYOND_NOISE)[:LOOKED]:
        cost, _ = cost_once_corrected(problem, problem.settled(one.fit))
        if cost < least:
            best, least = one, cost
    return best


def _candidates(problem: Problem, found: Search, thorough: bool) -> list[Tried]:
    """The best candidates beside the effects found: of the search where it looked, else of a step, or where little is left of the scan."""
    last = found.fits[-1]
    have = [t.key for t in last.terms]
    if found.last and [t.key for t in found.last[0].fit.terms[:-1]] == have:
        return found.last
    here = problem.allowing(last)
    if thorough:
        return step(here, last)[0]
    few = shortlist(scan(here, last))[:LOOKED]
    return [here.tried(with_shapes(here, here.joint([*last.terms, c.term], [*last.q, c.q], shapes=False))) for c in few]


def noise_alone(problem: Problem, fit: Fit) -> bool:
    """Whether the validation lines keep no more than the noise of the measurement, whatever the model may be off by."""
    lines = problem.sets[JUDGE]
    data, _ = predicted(problem.arrays, lines, fit)
    return mean_misfit(lines, np.zeros(data.shape), data) < GOOD


def further(problem: Problem, found: Search, most: int) -> tuple[Search, str | None]:
    """The effects found and what a search for more adds; why something may be missing still, or None."""
    while found.history:
        if len(found.history) >= most:
            return found, f"no search for more than {most} effects is made"
        again = one_more(problem, found)
        if again is None:
            return found, None
        fits, history = in_order(problem, again.fit, {t.term.key: tried for t, tried in found.history})
        found = Search(fits, history, found.before, found.last, 1.0, corrected=found.corrected)
    return found, None


def weakest(fit: Fit) -> int | None:
    """The effect whose 95 % interval reaches zero by most; None where none does."""
    effects = effects_of(fit)
    weak = [k for k, e in enumerate(effects) if not e.supported]
    if not weak:
        return None
    spread = [max(float(s) / max(abs(float(effects[k].values[n])), 1e-300) for n, s in effects[k].std.items()) for k in weak]
    return weak[int(np.argmax(spread))]


def taken_out(problem: Problem, fits: list[Fit], history: History, k: int) -> tuple[list[Fit], History]:
    """The search without one of its effects, the others fitted again."""
    if len(fits[-1].terms) < 2:
        return fits[:1], []
    return in_order(problem, problem.joint(*without(fits[-1], k)), {t.term.key: tried for t, tried in history})
