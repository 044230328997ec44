"""Searches where effects at sensors leave something: between sensors, and with a mode that the idle model lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from operando.data import Geometry
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import EXPLAINED
from operando.diagnosis.days import no_other_day
from operando.diagnosis.found import Found
from operando.diagnosis.hypotheses import AT_FIRST, Hypotheses, cases_between_sensors
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking_mode import apart, grown_by_a_mode, with_mode
from operando.diagnosis.midway import on_a_sum
from operando.diagnosis.posterior import State
from operando.diagnosis.rival import score
from operando.diagnosis.scan import Say
from operando.diagnosis.search import RIVALS, WAYS, leaders, search
from operando.diagnosis.sizes import with_likely_sizes
from operando.diagnosis.terms import touched

_ANOTHER_DAY = 100.0  # log odds of another day from which no location between sensors is looked for in one set-up

Again = Callable[[Idle], Sequence[Case]]


def search_between_sensors(found: Found, again: Again, geometry: Geometry | None, say: Say, count: int) -> Found:
    """The same search with locations between sensors, where it explains more; else what was found.

    ``again`` gives the same lines with another idle model: on another day and with nothing touched, or as the test states it. At most
    ``count`` effects are looked for, one after the other. Without a geometry there is nothing between the sensors.
    """
    known, odds = found.empty.case.uncompressed, found.odds
    cases = () if geometry is None or not count or known.midway else cases_between_sensors(found.empty.case, again, geometry)
    if not cases:
        return found
    midway = cases[0].idle.midway
    say(f"{len(midway)} locations between sensors:")
    same = len(cases) > 1 and odds is not None and odds > 0
    if count > 1 and len(cases) > 1 and odds is not None and odds > -_ANOTHER_DAY:
        other = Hypotheses(cases[0], cases[1], say, depth=count).run()
    else:  # where effects are found that explain the lines, by the hypothesis that they are of
        known_spreads = count > 1 and (bool(found.best.terms) or found.best.alpha >= EXPLAINED)
        # where no laboratory has such days, one step tells whether an effect between sensors stands in the place of what was found
        one_step = not same and no_other_day(found.best)

        def there(step: Found) -> bool:
            return not one_step or any(midway.keys() & set(touched(state.terms)) for state in leaders(step.pool, RIVALS, len(step.pool)))

        depth = 1 if one_step else count
        other = search(cases[1 if same else 0], say, depth=depth, own_spreads=not known_spreads, go_on=there)
        other = replace(other, odds=odds)
    other = with_likely_sizes(other, say)
    bar = score(found.best)
    if count == 1:  # what is there explains the lines, with shapes that are known: one effect is an answer where it stands for several
        fewer = len(found.best.terms) - len(other.best.terms) if other.best.alpha < EXPLAINED else -1
        bar = bar - WAYS if fewer > 0 else bar if fewer == 0 and on_a_sum(found.best, geometry) else float("inf")
    if any(t.places and t.places[0] in midway for t in other.best.terms):
        return other if score(other.best) > bar else found
    return _at_sensors(other.best, again(known), say, found) if other.best.terms and score(other.best) > score(found.best) else found


def _at_sensors(better: State, cases: Sequence[Case], say: Say, found: Found) -> Found:
    """The search at sensors with effects that it had missed, and that were met on the way to others; else what was found.

    An absorber at a sensor was 230 nats better than the three effects found, and was left: nothing of it was between sensors (frame 10629).
    """
    say("effects at sensors that are more probable than those found:")
    there = search(cases[1 if len(cases) > 1 and better.case.like is not None else 0], say, depth=AT_FIRST, also=better.terms)
    return replace(there, odds=found.odds) if score(there.best) > score(found.best) else found


def search_lacking_mode(found: Found, empty: State, again: Again, say: Say) -> Found:
    """The search with a mode that the idle model lacks, where it explains more than what was found; else that.

    ``empty`` is what the idle model leaves as it is, and as the check moved it: where days differ, peaks aside leave most. ``again`` is as
    for :func:`search_between_sensors`.
    """
    own_spreads = bool(found.best.case.between.log_factors.any())
    for grown in grown_by_a_mode([replace(empty, x=empty.case.forward.start), empty]):
        lacking = with_mode(grown, again, score(found.best), say, own_spreads=own_spreads)
        if lacking is None:
            continue
        ended = search(lacking.best.case, say, start=lacking, depth=AT_FIRST)
        if apart(ended.best):
            return replace(ended, odds=lacking.odds)
    return found
