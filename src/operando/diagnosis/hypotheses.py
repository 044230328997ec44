"""Hypotheses of what differs between two measurements, and of what the idle model lacks: which of them a diagnosis goes by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from operando.data import Geometry
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import AS_AT_REST, EARNED, EXPLAINED, LEAST_DISCREPANCY, LOOSE, PROMOTED
from operando.diagnosis.days import no_other_day, promotions, untouched
from operando.diagnosis.free_law import of_a_kind, with_free_law
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import with_lacking
from operando.diagnosis.midway import midway, with_midway
from operando.diagnosis.posterior import State, approach, fit, leaves_noise, names
from operando.diagnosis.rival import Rival, fitted_if_can_be, score, started
from operando.diagnosis.scan import Say, robust_cost, robust_scan
from operando.diagnosis.search import DEPTH, WAYS, Found, remounted, search
from operando.diagnosis.sizes import with_likely_sizes
from operando.diagnosis.suggested import begun_with
from operando.diagnosis.terms import Term
from operando.diagnosis.unseen import with_unseen_motion
from operando.diagnosis.verdict import supported
from operando.processes import side_by_side

AT_FIRST = 2  # effects looked for at sensors before places between these and lacking modes are, and there
_SOME = 1.0  # spreads of a difference between days from which the effect of its name is tried where nothing was touched
_ROUGH = 0.05  # discrepancy that such a fit begins with
# Of a robust cost, below which a place between sensors goes before two effects, and above which a lacking mode does: 0.2 to 0.5 of the best
# sensor where the effect was between sensors, 1 where a mode was lacking (``benchmarks/hidden_effects``).
_HALF = 0.5
_HALVED = 0.5  # of the discrepancy that effects leave, above which a force law of no kind is no answer: differences of days may leave it
_ALSO = 2  # first effects of one set-up that are tried on another day: the right one was the first of them, and not in the scan of that day
_ANOTHER_DAY = 100.0  # log odds of another day from which no place between sensors is looked for in one set-up


def search_both(
    days: Case,
    one_set_up: Case,
    say: Say = lambda text: None,
    at_rest: float = 0.0,
    again: Callable[[Idle], Sequence[Case]] | None = None,
    depth: int = DEPTH,
    geometry: Geometry | None = None,
    suggested: Callable[[], Sequence[Term]] = tuple,
) -> tuple[Found, float]:
    """The better of two hypotheses: that nothing was touched between the measurements, and that it was another day.

    The first is a special case of the second: where it leaves nothing but noise, the second is not searched. A place between sensors
    (``geometry``: where these stand; ``at_rest`` is the discrepancy of the idle FRFs) and a mode that the idle model lacks spare the search
    of days where they explain the check (``again``: see :func:`search_elsewhere`). Effects that something else suggests (``suggested``)
    are begun with where what was searched from the FRFs alone does not explain these.

    Returns
    -------
    Found
    float
        Log odds that nothing was touched.
    """
    start = days.forward.start
    alone = fit(days, start)
    say(f"two days and no effect: {alone.log_evidence:.1f}, discrepancy {alone.alpha:.4f}")
    say("with nothing touched between the measurements:")
    rival = Rival(days, alone)
    mode = None
    if again is not None and not days.elsewhere and alone.alpha >= LOOSE:  # a mode that was measured, and stands for none predicted
        mode = max((m for g in grown_by_a_mode([alone]) if (m := with_mode(g, again, rival.score, say))), key=_of_best, default=None)
        rival.score = max(rival.score, -np.inf if mode is None else score(mode.best))
    before_two: list[tuple[Found, float]] = []

    def simpler() -> bool:
        """An effect at a place between sensors or a mode that is lacking, where one effect at sensors explains little."""
        if again is not None and days.elsewhere:
            there = instead_of_two(one_set_up, alone, rival, at_rest, again, geometry, say)
            before_two.extend([there] if there is not None else [])
        return bool(before_two)

    same = search(one_set_up, say, rival, depth=depth, simpler=simpler)
    if before_two:
        return before_two[0]
    best = same.best
    known = [alone]
    if not _explains(best, alone) and (terms := suggested()):
        say("what the operational modes suggest: " + ", ".join(names(days, terms)))
        here, other_day = (begun_with(case, terms) for case in (one_set_up, days))
        if other_day is not None:
            say(f"  on another day {names(days, other_day.terms)} {other_day.log_evidence:.1f}, discrepancy {other_day.alpha:.4f}")
            known.append(other_day)
            rival.score = max(rival.score, score(other_day))
        if here is not None and score(here) > max(score(best), rival.score - EARNED):
            same = search(one_set_up, say, rival, start=Found(here, same.empty, same.pool | {here.key: here}), depth=depth)
            best = same.best
    if not _explains(best, alone):
        # a difference between days that no laboratory has may be an effect where nothing was touched
        likely = max(known, key=score)
        back = back_to_one_set_up(one_set_up, likely, max(likely.log_evidence, best.log_evidence)) if promotions(likely) else None
        if back is not None and score(back) > max(score(best), score(likely)):
            say(f"its differences beyond those of laboratories as effects, with nothing touched: {back.log_evidence:.1f}")
            same = search(one_set_up, say, rival, start=Found(back, same.empty, same.pool | {back.key: back}), depth=depth)
            best = same.best
    if mode is not None and _explains(mode.best, alone) and not (_explains(best, alone) and supported(best)):
        # of what swings on its own operational modes tell no mass: as light as one likes, it brings its mode, and stays a second answer
        answer, swinging = search(mode.best.case, say, start=mode), same.pool if _explains(best, alone) else {}
        return replace(answer, pool=answer.pool | {k: s for k, s in swinging.items() if _explains(s, alone)}), mode.odds or 0.0
    if _explains(best, alone) and not remounted(best):
        # the same effects on another day, and each left to what differs between days
        fewer = {best.terms, *(tuple(t for t in best.terms if t is not one) for one in best.terms)} - {()}
        odds = score(best) - rival.asked(sorted(fewer, key=len), best.alpha, best.log_evidence)
        if odds > EARNED:
            return same, odds
    # where kinds or locations were asked for by name (no ``again``), what has none of them is no answer
    if again is not None and not _explains(best, alone):
        other = no_effect_at_a_sensor(same, alone, rival, one_set_up, again, geometry, say) if days.elsewhere else None
        if other is not None:
            return other
        there = mode_with_nothing_touched(same, alone, rival, again, geometry, say)
        if there is not None:
            return there
    say("on another day:")
    found = as_channels_were(known, say) or search(days, say, depth=depth, known=known, also=first_effects(same, _ALSO))
    # what was found with less to explain it, where nothing was touched; a difference between days may be an effect there
    back = back_to_one_set_up(one_set_up, found.best, max(found.best.log_evidence, best.log_evidence), _SOME)
    if back is not None and score(back) > max(score(found.best), score(best)):
        say(f"the same with nothing touched: {back.log_evidence:.1f}, discrepancy {back.alpha:.4f}")
        same = search(one_set_up, say, start=Found(back, same.empty, {s.key: s for s in (same.empty, back)}))
        best = same.best
    odds = -np.inf if remounted(best) else score(best) - score(found.best)
    beside = between_sensors(found.best, geometry)
    if odds <= 0 and again is not None and geometry is not None and days.elsewhere and (beside or untouched(found.best)):
        there = with_nothing_touched(same, alone, again, geometry, say, score(found.best if beside else alone))
        if there is not None:
            return there
    return (same if odds > 0 else found), odds


def as_channels_were(known: Sequence[State], say: Say) -> Found | None:
    """The likeliest state of another day, where it explains the lines and says, with its spreads estimated, that nothing was touched.

    No further effect makes channels differ that do not: on another day nothing is searched.
    """
    likely = max(known, key=score)
    state = fitted_if_can_be(likely.case, likely.x, likely.alpha, own_spreads=True) if likely.alpha < LOOSE else None
    if state is None or state.alpha >= LOOSE or not untouched(state):
        return None
    say("  channels are as they were, as on no other day: no search")
    return Found(state, known[0], {known[0].key: known[0]} | {state.key: state})


def first_effects(found: Found, count: int) -> list[Term]:
    """The effects that explain most on their own, at different places: what else differs on another day, at first order may hide them."""
    alone = sorted((state for state in found.pool.values() if len(state.terms) == 1), key=lambda state: -state.log_evidence)
    by_places: dict[tuple[int, ...], Term] = {}
    for state in alone:
        by_places.setdefault(state.key[0][1], state.terms[0])
    return list(by_places.values())[:count]


def _of_best(found: Found) -> float:
    return score(found.best)


def back_to_one_set_up(case: Case, state: State, floor: float, beyond: float = PROMOTED) -> State | None:
    """The best fit with nothing touched of the effects of another day, and of these with a difference beyond so many spreads as one."""
    sets = [terms for terms in (state.terms, *(x.terms for x in promotions(state, beyond))) if terms]
    tried = side_by_side(lambda terms: fitted_if_can_be(case, started(case, terms), _ROUGH, floor=floor), sets)
    return max((one for one in tried if one is not None), key=score, default=None)


def _explains(state: State, alone: State) -> bool:
    """Whether a state leaves nothing but noise, and is more probable than two days and no effect."""
    return state.alpha < LOOSE and score(state) > score(alone) and leaves_noise(state)


def no_effect_at_a_sensor(
    found: Found,
    alone: State,
    rival: Rival,
    case: Case,
    again: Callable[[Idle], Sequence[Case]],
    geometry: Geometry | None,
    say: Say,
) -> tuple[Found, float] | None:
    """What explains the lines with nothing touched where effects at sensors do not, with its log odds against another day.

    In this order: an effect at a place between sensors, a force law at sensors (told as the kind that has it, else of no kind in the
    catalogue), a law on motions that no sensor shows.
    """
    best = found.best
    there = None if geometry is None else with_nothing_touched(found, alone, again, geometry, say)
    if there is not None:
        return there
    floor = max(alone.log_evidence, best.log_evidence)
    law = with_free_law(case, floor, say)
    kind = None if law is None else of_a_kind(law, say)
    if kind is not None:
        named = search(case, say, rival, start=Found(kind, found.empty, found.pool | {kind.key: kind}), depth=AT_FIRST)
        odds = score(named.best) - rival.asked([named.best.terms], named.best.alpha, named.best.log_evidence)
        if _explains(named.best, alone) and odds > EARNED:
            return named, odds
    if law is not None and law.alpha < _HALVED * best.alpha:  # else small differences between days may be what both leave
        odds = score(law) - max(score(best), rival.asked([best.terms] if best.terms else [], best.alpha))
        if odds > EARNED:
            return replace(found, unnamed=law), odds
    hidden = with_unseen_motion(case, again, floor, say)
    if hidden is None:
        return None
    if geometry is not None and len(hidden.terms) == 1:  # it may be that of a place between sensors, whose shapes are nearly known
        there = with_nothing_touched(found, alone, again, geometry, say, score(hidden))
        if there is not None:
            return there
    odds = score(hidden) - max(score(best), rival.score)
    return (replace(found, unnamed=hidden), odds) if odds > EARNED else None


def instead_of_two(
    case: Case,
    alone: State,
    rival: Rival,
    at_rest: float,
    again: Callable[[Idle], Sequence[Case]],
    geometry: Geometry | None,
    say: Say,
) -> tuple[Found, float] | None:
    """What explains the lines as one, where nothing was touched and no effect at a sensor does, with its log odds; None where nothing does.

    An effect at a place between sensors where that leaves no half of what the best sensor does, robustly and with nothing else freed, and
    no more than the idle model leaves at rest; a mode that is lacking where the best sensor leaves more than half of what there is.
    """
    about, sensors = case.forward.start, case.at_rest.robust
    if not sensors:
        return None
    empty = fit(case, about, 0.1)
    nothing = Found(empty, empty, {empty.key: empty})
    if geometry is not None:
        there = with_nothing_touched(nothing, alone, again, geometry, say, part=_HALF)
        if there is not None and there[0].best.alpha <= AS_AT_REST * max(at_rest, LEAST_DISCREPANCY):
            return there
    if -sensors[0][0] > _HALF * robust_cost(case, about):
        return mode_with_nothing_touched(nothing, alone, rival, again, geometry, say, at_once=True)
    return None


def mode_with_nothing_touched(
    found: Found,
    alone: State,
    rival: Rival,
    again: Callable[[Idle], Sequence[Case]],
    geometry: Geometry | None,
    say: Say,
    at_once: bool = False,
) -> tuple[Found, float] | None:
    """A mode that the idle model lacks where that explains the lines, with its log odds against another day; None where it does not.

    At the pole that takes most from what the idle model leaves as it is, or as another day has it. What acts as an absorber at a place
    between sensors makes a mode, too. With no other effect where it is asked to be so ``at_once``, or where another day leaves little,
    which may explain that with an effect.
    """
    bar = max(rival.score, score(found.best))
    sure = at_once or alone.alpha < LOOSE
    case = found.empty.case
    known = case.at_rest.grown = case.at_rest.grown or grown_by_a_mode([replace(found.empty, x=case.forward.start), alone])
    short = case.at_rest.no_mode
    able: list[Lacking] = []
    for grown in known:
        if sure and any(one is grown and its <= bar for one, its in short):
            continue
        lacking = with_mode(grown, again, bar, say, sure)
        if lacking is None or (sure and not _explains(lacking.best, alone)):
            short += [(grown, bar)] if sure else []
        elif lacking.best.alpha < LOOSE:
            able.append(lacking)
            if _explains(lacking.best, alone):
                break
    for lacking in sorted(able, key=_of_best, reverse=True):
        there = None if geometry is None else with_nothing_touched(found, alone, again, geometry, say, score(lacking.best))
        if there is not None:
            return there
        ended = search(lacking.best.case, say, start=lacking, depth=AT_FIRST)
        if _apart(ended.best):
            return ended, lacking.odds or 0.0
        say("  the mode that was missing has become one of the others")
    return None


def with_nothing_touched(
    found: Found,
    alone: State,
    again: Callable[[Idle], Sequence[Case]],
    geometry: Geometry,
    say: Say,
    bar: float | None = None,
    part: float = 1.0,
) -> tuple[Found, float] | None:
    """One effect at a place between sensors where nothing was touched, with its log odds; None where none explains the lines.

    It has to score more than a ``bar``; without one it is searched only where such a place leaves less than a ``part`` of what all sensors
    do, robustly and with nothing else freed.
    """
    lowest, in_vain = -np.inf if bar is None else bar, found.empty.case.at_rest
    asked = max(score(alone), lowest)
    known = asked >= in_vain.no_location
    wider = None if known else with_midway(found.empty.case.uncompressed, geometry)
    if wider is None:
        return None
    days, one_set_up = again(wider)
    scanned = one_set_up.at_rest.robust = robust_scan(one_set_up, one_set_up.forward.start)
    if not scanned:
        return None
    if bar is None:
        least = {True: np.inf, False: np.inf}  # of places between sensors, and of sensors
        for value, term, _ in scanned:
            there = bool(wider.midway.keys() & set(term.places))
            least[there] = min(least[there], -value)
        if not least[True] < part * least[False]:
            return None
    say(f"{len(wider.midway)} locations between sensors, with nothing touched:")
    rival = Rival(days, alone)
    rival.score = asked
    found = search(one_set_up, say, rival, depth=1)
    if found.best.alpha >= LOOSE:
        in_vain.no_location = asked
    if score(found.best) < lowest - WAYS:
        return None
    found = with_likely_sizes(found, say)
    best = found.best
    if not _explains(best, alone) or score(best) < lowest or not wider.midway.keys() & {i for t in best.terms for i in t.places}:
        return None
    odds = score(best) - rival.asked([best.terms], best.alpha, best.log_evidence)
    return (found, odds) if odds > EARNED else None


def search_elsewhere(
    found: Found,
    odds: float | None,
    again: Callable[[Idle], Sequence[Case]],
    geometry: Geometry | None,
    say: Say,
    places: int,
    modes: bool,
) -> tuple[Found, float | None]:
    """What explains more than effects at sensors: one at a place between them, or a mode that the idle model lacks.

    Parameters
    ----------
    found : Found
        What the places with sensors came to.
    odds : float, optional
        Of that, that nothing was touched between the measurements.
    again : callable
        The same check with another idle model: on two days and with nothing touched, or as the test states it.
    geometry : Geometry, optional
        Positions of the sensors; without it there are no places between them.
    say : callable
    places : int
        Effects to look for at places between sensors too; none where it is 0.
    modes : bool
        Whether modes that the idle model lacks are looked for.

    Returns
    -------
    Found
    float or None
        Log odds that nothing was touched.
    """
    best = found
    known = found.empty.case.uncompressed
    wider = None if geometry is None or not places or known.midway else with_midway(known, geometry)
    if wider is not None:
        say(f"{len(wider.midway)} locations between sensors:")
        cases, its_odds = again(wider), odds
        same = len(cases) > 1 and odds is not None and odds > 0
        if places > 1 and len(cases) > 1 and odds is not None and odds > -_ANOTHER_DAY:
            other, its_odds = search_both(cases[0], cases[1], say, depth=places)
        else:  # where effects are found that explain the lines, by the hypothesis that they are of
            known_spreads = places > 1 and (bool(found.best.terms) or found.best.alpha >= EXPLAINED)
            # where no laboratory has such days, one step tells whether an effect between sensors stands in the place of what was found
            depth = 1 if not same and no_other_day(found.best) else places
            other = search(cases[1 if same else 0], say, depth=depth, own_spreads=not known_spreads)
        other = with_likely_sizes(other, say)
        bar = score(best.best)
        if places == 1:  # what is there explains the lines, with shapes that are known: one effect is an answer where it stands for several
            fewer = len(best.best.terms) - len(other.best.terms) if other.best.alpha < EXPLAINED else -1
            bar = bar - WAYS if fewer > 0 else bar if fewer == 0 and on_a_sum(best.best, geometry) else np.inf
        if score(other.best) > bar and any(t.places and t.places[0] in wider.midway for t in other.best.terms):
            best, odds = other, its_odds
    if modes:
        # what the idle model leaves as it is, and as the check moved it: where days differ, peaks aside leave most
        empty = found.empty
        for grown in grown_by_a_mode([replace(empty, x=empty.case.forward.start), empty]):
            lacking = with_mode(grown, again, score(best.best), say, own_spreads=bool(best.best.case.between.log_factors.any()))
            if lacking is None:
                continue
            ended = search(lacking.best.case, say, start=lacking, depth=AT_FIRST)
            if _apart(ended.best):
                best, odds = ended, lacking.odds
                break
    return best, odds


@dataclass
class Lacking(Found):
    """With a mode that the idle model lacks; the log odds that nothing was touched, where both hypotheses were tried."""

    odds: float | None = None


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
) -> Lacking | None:
    """States of an idle model with the mode that it lacks, where one lifts the score above a bar.

    Parameters
    ----------
    grown : Idle
        With a mode more, ``lacking``.
    again : callable
        The same check with another idle model.
    bar : float
    say : callable
    untouched : bool
        Whether it has to be one where nothing was touched, plainly more probable than another day.
    own_spreads : bool
        Whether the bar is of a state whose spreads were estimated: then it is reached with these estimated, too.
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
    if reached is None or score(reached) <= bar or not _apart(first):
        return None
    # the fit of one hypothesis was not asked for yet, or left off far below the bar; the odds ask for its end
    those = [None] * (len(cases) - len(starts)) + starts
    starts = [fitted(c) if s is None or score(s) <= floor else s for s, c in zip(those, cases, strict=True)]
    if untouched and score(first) < score(starts[0]) + EARNED:
        return None
    empty = fit(first.case, first.case.forward.start, 0.1)
    return Lacking(first, empty, {s.key: s for s in (empty, first)}, odds=None if len(starts) < 2 else score(starts[1]) - score(starts[0]))


def between_sensors(state: State, geometry: Geometry | None) -> bool:
    """Whether one effect between two sensors may stand for what was found: for several at these; for one on their sum."""
    if geometry is None:
        return False
    at_ends = (sum(bool({*t.places} & {*place.ends}) for t in state.terms) for place in midway(state.case.dofs, geometry))
    return any(count > 1 for count in at_ends) or on_a_sum(state, geometry)


def on_a_sum(state: State, geometry: Geometry | None) -> bool:
    """Whether an effect acts on the difference of two neighbouring channels of opposite senses.

    The sum of two motions is twice what lies half-way between them: what acts there changes the FRFs like this, and no spring does.
    """
    if geometry is None:
        return False
    dofs = state.case.dofs
    ends = [set(p.ends) for p in midway(dofs, geometry) if dofs[p.ends[0]].sign != dofs[p.ends[1]].sign]
    return any(t.structural and set(t.places) in ends for t in state.terms)


def _apart(state: State) -> bool:
    """Whether a mode that was lacking lies beyond the half-power widths of all others: nearer, it may be one of them that differs."""
    idle = state.case.idle
    others = [r for r in idle.modes if r != idle.lacking]
    mode = next((t for t in state.terms if t.kind == "missing_mode"), None)
    if mode is None:
        return True
    f, zeta = (float(np.exp(v)) for v in mode.values)
    return bool(np.all(np.abs(idle.f[others] / f - 1) > 2 * np.maximum(idle.zeta[others], zeta)))
