"""The search for effects: one after the other, from several first ones, each exchanged in turn, the simplest that does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare.verdict import GOOD
from operando.data import Geometry
from operando.diagnose.afar import on_few_lines
from operando.diagnose.learn import all_but_the_idle_model
from operando.diagnose.levenberg import effect_dofs
from operando.diagnose.predict import Term
from operando.diagnose.problem import EARNED, PARSIMONY, Problem, Tried, choose, scan, step
from operando.diagnose.refit import POOR, Fit, refit
from operando.diagnose.sets import FIT, SELECT
from operando.diagnose.shapes import shape_prior
from operando.diagnose.verdict import one_mode, separates
from operando.effects import catalogue

Array = NDArray[Any]
History = list[tuple[Tried, list[Tried]]]

MAX_EFFECTS = 3

SWAPPED = 0.03
"""What replaces an accepted effect must lower the selection misfit by more than this part."""

DONE = 1.2
"""Selection misfit at which the data allow no better and nothing more is looked for."""

NEARLY = 0.05
"""Part of the misfit without it up to which the first effect may leave errors of the idle model alone."""

FIRSTS = 4
"""First effects from which the search starts again where it ends poorly."""

EXCUSED = 10.0
"""Misfit by the idle model's own variance above which that of the model with effects, where larger, does not count."""

AGAIN = 2
"""Times that a fit which begins far from its end is taken up again."""

NO_EXCHANGE = 10.0
"""Selection misfit with as many effects as are looked for above which exchanging one of them cannot make them good."""


@dataclass
class Search:
    """Effects accepted one after the other.

    Parameters
    ----------
    fits : list of Fit
        The start, then one a step.
    history : list
        Accepted candidate and all tried, a step each.
    before : list of float
        Selection misfit before each step and after the last, by the variance of the model then.
    last : list of Tried
        Candidates of the last step tried.
    further : float
        Selection misfit with the best further candidate over that without it.
    elsewhere : tuple, optional
        Problem, geometry and search in which a place between sensors explains the data.
    corrected : bool
        Whether the data agree with the effects once the idle model is corrected by them.
    """

    fits: list[Fit]
    history: History
    before: list[float]
    last: list[Tried] = field(default_factory=list)
    further: float = 1.0
    elsewhere: tuple[Problem, Geometry, Search] | None = None
    corrected: bool = False

    @property
    def done(self) -> bool:
        """Whether the data allow no better."""
        return self.before[-1] < DONE


def search(
    problem: Problem,
    most: int = MAX_EFFECTS,
    elsewhere: Callable[[Search], tuple[Problem, Geometry, Search] | None] | None = None,
) -> Search:
    """The effects that explain the lines best, at most so many.

    Parameters
    ----------
    problem : Problem
    most : int
    elsewhere : callable, optional
        Asked for a place between sensors before more than one effect, or one at another place, is thought of.
    """
    if one_mode(problem.idle):
        most = 1  # two effects on one mode are one
    found = greedy(problem, problem.empty(), 1)
    alone = found.fits[-1]
    nearly = bool(found.history) and not found.done and found.before[-1] < NEARLY * found.before[0]
    if nearly and all_but_the_idle_model(problem, alone):
        # What the idle model is wrong by must not be made up for by further, small effects.
        return replace(simplified(problem, found), corrected=True)
    if elsewhere is not None and found.before[-1] > POOR:
        there = elsewhere(found)
        if there is not None:
            return replace(found, elsewhere=there)
    if most > 1 and found.history:
        found = greedy(problem, problem.empty(), most, found)
    if not found.history or most < 2:
        return simplified(problem, found)
    if found.before[-1] > POOR:
        found = from_others(problem, found, most)
    last = found.fits[-1]
    excused = not found.done and problem.misfit(SELECT, last) > EXCUSED
    asked = nearly and last is alone  # and answered no
    if found.before[-1] > POOR or (excused and (asked or not all_but_the_idle_model(problem, last))):
        found = from_everywhere(problem, found, most)
    hopeless = len(found.history) == most and found.before[-1] > NO_EXCHANGE
    if len(found.history) > 1 and not hopeless:
        fits, history = swap(problem, found.fits, found.history)
        found = replace(found, fits=fits, history=history)
    return simplified(problem, found)


def greedy(problem: Problem, start: Fit, most: int, found: Search | None = None) -> Search:
    """Add the best effect as long as each earns its place, from the start or from what was found."""
    fit = start if found is None else found.fits[-1]
    here = problem.allowing(fit) if fit.terms else problem
    if found is None:
        found = Search([fit], [], [here.misfit(SELECT, fit)])
    while len(fit.terms) < most:
        if fit.terms and found.done:
            break
        tried, judged = step(here, fit)
        found.last = tried
        if not tried:
            break
        best = choose(tried)
        now = judged.misfit(SELECT, fit)
        found.further = best.selection / now
        if not separates(best.selection, now, EARNED) or not earns(judged, fit, best):
            found.further = max(found.further, 1 - EARNED)
            break
        found.history.append((best, tried))
        fit, found.further = best.fit, 1.0
        found.fits.append(fit)
        here = problem.allowing(fit)
        found.before.append(here.misfit(SELECT, fit))
    return found


def from_others(problem: Problem, found: Search, most: int) -> Search:
    """Search again from other first effects: what mends most while everything else is missing may only have stood in for several."""
    best, then = found, problem.misfit(SELECT, found.fits[-1])
    last = found.fits[-1]
    most = min(most, max(2, len(last.terms)))
    # While something else is missing, another law may look better than the right one at the right place.
    there = [t for t in found.history[0][1] if t.term.dofs == found.history[0][0].term.dofs and t.term.kind.places == 1]
    starts = [(t.term, t.fit.q[-1]) for t in there if t.term.kind.kind == "tuned_absorber"]
    starts += [(t, q) for t, q in zip(last.terms[1:], last.q[1:], strict=True)]
    seen = {found.history[0][0].term.dofs, *(t.dofs for t, _ in starts)}
    for other in found.history[0][1]:
        if len(starts) < FIRSTS and other.term.dofs not in seen:
            seen.add(other.term.dofs)
            starts.append((other.term, other.fit.q[-1]))
    for term, q in starts:
        first = problem.tried(problem.joint([term], [q]))
        again = greedy(problem, first.fit, most)
        now = problem.misfit(SELECT, again.fits[-1])
        # One more effect must earn its place here as anywhere.
        more = len(again.fits[-1].terms) - len(best.fits[-1].terms)
        if separates(now, then, max(SWAPPED, EARNED * more)):
            then = now
            history = [(first, found.history[0][1]), *again.history]
            best = Search([problem.empty(), *again.fits], history, [found.before[0], *again.before], again.last, again.further)
            if best.done:
                break
    if best is found:
        return found
    fits, history = in_order(problem, best.fits[-1], {t.term.key: tried for t, tried in best.history})
    return replace(best, fits=fits, history=history)


def from_everywhere(problem: Problem, found: Search, most: int) -> Search:
    """Search again with every candidate of the scan fitted: where a strong effect meets columns known poorly the scan ranks nothing."""
    candidates = [c for c in scan(problem, problem.empty()) if c.term.kind.acts == "dynamic_stiffness"]
    if problem.say:
        problem.say(f"nothing explains the lines: fit {len(candidates)} candidates")
    fits = on_few_lines(problem, candidates)
    for _ in range(AGAIN):
        fits = [problem.joint(f.terms, f.q, start=f) for f in fits]
    tried = sorted((problem.tried(f) for f in fits), key=lambda t: t.selection)
    if not tried or not separates(tried[0].selection, problem.misfit(SELECT, found.fits[-1]), SWAPPED):
        return found
    first = tried[0].fit
    start = Search([problem.empty(), first], [(tried[0], tried)], [found.before[0], problem.allowing(first).misfit(SELECT, first)])
    if all_but_the_idle_model(problem, first):
        return replace(start, corrected=True)
    return greedy(problem, problem.empty(), most, start)


def swap(problem: Problem, fits: list[Fit], history: History) -> tuple[list[Fit], History]:
    """Take each effect out in turn and look what fits best in its stead; then drop what no longer earns its place.

    The first effect of several was found while the others were still missing, so it is the likeliest to be wrong.
    """
    best = problem.tried(fits[-1])
    alternatives = {t.term.key: tried for t, tried in history}
    changed = False
    for _ in range(2):
        moved = False
        for k in range(len(best.fit.terms)):
            rest = problem.joint(*without(best.fit, k))
            tried, _ = step(problem, rest)
            raw = [problem.tried(t.fit) for t in tried[:1]]
            if raw and raw[0].term.key != best.fit.terms[k].key and separates(raw[0].selection, best.selection, SWAPPED):
                best = raw[0]
                alternatives[best.term.key] = tried
                moved = changed = True
                break
        if not moved:
            break
    for k in reversed(range(len(best.fit.terms))):
        if len(best.fit.terms) < 2:
            break
        rest = problem.joint(*without(best.fit, k))
        if not separates(best.selection, problem.misfit(SELECT, rest), EARNED):
            best, changed = problem.tried(rest), True
    return in_order(problem, best.fit, alternatives) if changed else (fits, history)


def in_order(problem: Problem, fit: Fit, alternatives: dict[Any, list[Tried]]) -> tuple[list[Fit], History]:
    """The ladder in the order in which each effect lowers the misfit most."""
    terms, q = list(fit.terms), list(fit.q)
    ordered: list[Fit] = [problem.empty()]
    told: History = []
    while terms:
        options = [problem.joint([*ordered[-1].terms, t], [*ordered[-1].q, v]) for t, v in zip(terms, q, strict=True)]
        k = int(np.argmin([problem.misfit(SELECT, f) for f in options]))
        ordered.append(options[k])
        one = problem.tried(options[k])
        told.append((one, alternatives.get(one.term.key, [one]) if len(terms) == 1 else [one]))
        del terms[k], q[k]
    return ordered, told


def other_orders(problem: Problem, fit: Fit, history: History) -> Iterator[tuple[list[Fit], History]]:
    """The same effects, found in every other order: fits of each step and what was tried."""
    alternatives = {t.term.key: tried for t, tried in history}
    for order in permutations(range(len(fit.terms))):
        if order == tuple(range(len(order))):
            continue
        fits: list[Fit] = [problem.empty()]
        told: History = []
        for k in order:
            fits.append(problem.joint([*fits[-1].terms, fit.terms[k]], [*fits[-1].q, fit.q[k]]))
            one = problem.tried(fits[-1])
            told.append((one, alternatives.get(one.term.key, [one]) if len(fits) == len(fit.terms) + 1 else [one]))
        yield fits, told


def simplified(problem: Problem, found: Search) -> Search:
    """Each effect as the simplest kind it contains that does as well, and none of no size: a spring without loss is a spring."""
    fit = found.fits[-1]
    while len(fit.terms) > 1:
        small = [k for k, (t, q) in enumerate(zip(fit.terms, fit.q, strict=True)) if vanished(t, q)]
        if not small:
            break
        fit = problem.joint(*without(fit, small[0]))
    for k, term in enumerate(fit.terms):
        for name in term.kind.contains:
            kind = catalogue().get(name)
            if kind is None or len(kind.parameters) >= term.size:
                continue
            simple = replace(term, kind=kind, constants={}, fixed={})
            values = term.values(fit.q[k])
            if any(p.name not in values for p in kind.parameters):
                continue
            terms = [simple if i == k else t for i, t in enumerate(fit.terms)]
            q = [simple.inward(values) if i == k else v for i, v in enumerate(fit.q)]
            here = problem.allowing(fit)
            other = problem.joint(terms, q, start=fit)
            now, then = here.misfit(SELECT, other), here.misfit(SELECT, fit)
            if now <= (1 + PARSIMONY) * then or (now < GOOD and idle_parameter(term, fit.q[k])):
                fit = other
                break
    if fit is found.fits[-1]:
        return found
    was = {t.dofs: (best, tried) for (best, tried), t in zip(found.history, found.fits[-1].terms, strict=True)}
    fits, history = [found.fits[0]], []
    for k, term in enumerate(fit.terms):
        fits.append(problem.joint(fit.terms[: k + 1], fit.q[: k + 1]) if k + 1 < len(fit.terms) else fit)
        best, tried = was[term.dofs]
        if best.term.key != term.key:
            best = problem.tried(fits[-1])
            tried = [best, *tried]
        history.append((best, tried))
    return replace(found, fits=fits, history=history)


def idle_parameter(term: Term, q: Array) -> bool:
    """Whether a parameter beside the size stands at its lower bound: the kind says no more than a simpler one."""
    return bool(np.any(q[1 : len(term.moving)] <= term.bounds()[0][1 : len(term.moving)] + 0.01))


def vanished(term: Term, q: Array) -> bool:
    """Whether the size of an effect stands at its lower bound."""
    first = term.kind.parameters[0] if term.kind.parameters else None
    if first is None or first.name not in term.moving or first.transform != "log":
        return False
    return bool(q[term.moving.index(first.name)] <= term.bounds()[0][term.moving.index(first.name)] + 0.1)


def without(fit: Fit, k: int) -> tuple[list, list]:
    """Terms and sizes of a fit without one of its effects."""
    return [t for i, t in enumerate(fit.terms) if i != k], [v for i, v in enumerate(fit.q) if i != k]


def earns(problem: Problem, fit: Fit, best: Tried) -> bool:
    """Whether the effect itself lowers the misfit, and not the shape values that were freed with it."""
    # The same shapes and other effects without this one: if that is as good, the shapes did it.
    without = Fit(best.fit.terms[:-1], best.fit.q[:-1], best.fit.phi, best.fit.prior)
    if not separates(best.selection, problem.misfit(SELECT, without), EARNED):
        return False
    if best.selection < 0.5 * problem.misfit(SELECT, fit):
        return True
    prior = shape_prior(problem.idle, effect_dofs(best.fit.terms))
    freed = refit(problem.arrays, problem.sets[FIT], problem.owns[FIT], fit.terms, fit.q, prior)
    return separates(best.selection, problem.misfit(SELECT, freed), EARNED)
