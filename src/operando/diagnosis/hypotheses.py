"""Hypotheses of what differs between two measurements: which of them a diagnosis goes by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from operando.data import Geometry
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import AS_AT_REST, EARNED, LEAST_DISCREPANCY, LOOSE, PROMOTED
from operando.diagnosis.days import promotions, remounted, untouched
from operando.diagnosis.found import Found
from operando.diagnosis.free_law import of_a_kind, with_free_law
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking_mode import apart, grown_by_a_mode, with_mode
from operando.diagnosis.midway import between_sensors, with_midway
from operando.diagnosis.posterior import State, fit, leaves_noise, names
from operando.diagnosis.rival import Rival, fitted_if_can_be, score, started
from operando.diagnosis.scan import Say, robust_cost, robust_scan
from operando.diagnosis.search import DEPTH, WAYS, search
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


class Hypotheses:
    """That nothing was touched between two measurements, and that it was another day: the better of the two.

    The first is a special case of the second: where it leaves nothing but noise, the second is not searched. A location between sensors and
    a mode that the idle model lacks spare the search of days where they explain the validation measurement.

    ``at_rest`` is the discrepancy of the idle FRFs. ``again`` gives the same lines with another idle model, on another day and with nothing
    touched; without it (kinds or locations were asked for by name) sensors alone are searched, and without a geometry there is nothing
    between them. At most ``depth`` effects are looked for at sensors, one after the other. ``suggested`` makes effects that something else
    suggests: begun with where what was searched from the lines alone does not explain these.
    """

    def __init__(
        self,
        days: Case,
        one_set_up: Case,
        say: Say = lambda text: None,
        at_rest: float = 0.0,
        again: Callable[[Idle], Sequence[Case]] | None = None,
        depth: int = DEPTH,
        geometry: Geometry | None = None,
        suggested: Callable[[], Sequence[Term]] = tuple,
    ) -> None:
        self.days, self.one_set_up, self.say, self.at_rest = days, one_set_up, say, at_rest
        self.again, self.depth, self.geometry, self.suggested = again, depth, geometry, suggested
        self.alone = fit(days, days.forward.start)
        self.rival = Rival(days, self.alone)
        self.known = [self.alone]  # states of another day
        self.instead: Found | None = None  # of two effects at sensors

    def run(self) -> Found:
        """What explains the lines, with the log odds that nothing was touched."""
        self.say(f"two days and no effect: {self.alone.log_evidence:.1f}, discrepancy {self.alone.alpha:.4f}")
        self.say("with nothing touched between the measurements:")
        mode = self.measured_mode()
        same = search(self.one_set_up, self.say, self.rival, depth=self.depth, simpler=self.something_simpler)
        if self.instead is not None:
            return self.instead
        same = self.begun_with_suggested(same)
        same = self.with_differences_as_effects(same)
        # where kinds or locations were asked for by name, what has none of them is no answer
        return (
            self.that_mode(mode, same)
            or self.nothing_touched(same)
            or self.no_effect_at_a_sensor(same)
            or self.mode_alone(same)
            or self.another_day(same)
        )

    def explains(self, state: State) -> bool:
        """Whether a state leaves nothing but noise, and is more probable than two days and no effect."""
        return state.alpha < LOOSE and score(state) > score(self.alone) and leaves_noise(state)

    def search_from(self, state: State, found: Found) -> Found:
        """A search with nothing touched that begins with a state."""
        start = Found(state, found.empty, found.pool | {state.key: state})
        return search(self.one_set_up, self.say, self.rival, start=start, depth=self.depth)

    def measured_mode(self) -> Found | None:
        """Of operational modes: one that was measured, and stands for none predicted."""
        if self.again is None or self.days.elsewhere or self.alone.alpha < LOOSE:
            return None
        tried = (with_mode(grown, self.again, self.rival.score, self.say) for grown in grown_by_a_mode([self.alone]))
        mode = max((found for found in tried if found), key=_of_best, default=None)
        if mode is not None:
            self.rival.score = max(self.rival.score, score(mode.best))
        return mode

    def something_simpler(self) -> bool:
        """Whether an effect between sensors or a lacking mode explains the lines: asked where one effect at sensors explains little."""
        if self.again is not None and self.days.elsewhere:
            self.instead = self.instead_of_two()
        return self.instead is not None

    def begun_with_suggested(self, same: Found) -> Found:
        """The search with nothing touched, from what the operational modes suggest where that is more probable."""
        if self.explains(same.best) or not (terms := self.suggested()):
            return same
        self.say("what the operational modes suggest: " + ", ".join(names(self.days, terms)))
        here, other_day = (begun_with(case, terms) for case in (self.one_set_up, self.days))
        if other_day is not None:
            self.say(
                f"  on another day {names(self.days, other_day.terms)} {other_day.log_evidence:.1f}, discrepancy {other_day.alpha:.4f}"
            )
            self.known.append(other_day)
            self.rival.score = max(self.rival.score, score(other_day))
        if here is None or score(here) <= max(score(same.best), self.rival.score - EARNED):
            return same
        return self.search_from(here, same)

    def with_differences_as_effects(self, same: Found) -> Found:
        """A difference between days that no laboratory has may be an effect where nothing was touched."""
        if self.explains(same.best):
            return same
        likely = max(self.known, key=score)
        if not promotions(likely):
            return same
        back = self.back_to_one_set_up(likely, max(likely.log_evidence, same.best.log_evidence))
        if back is None or score(back) <= max(score(same.best), score(likely)):
            return same
        self.say(f"its differences beyond those of laboratories as effects, with nothing touched: {back.log_evidence:.1f}")
        return self.search_from(back, same)

    def that_mode(self, mode: Found | None, same: Found) -> Found | None:
        """The measured mode, where nothing that is supported explains the lines without."""
        if mode is None or not self.explains(mode.best) or (self.explains(same.best) and supported(same.best)):
            return None
        # of what swings on its own operational modes tell no mass: as light as one likes, it brings its mode, and stays a second answer
        swinging = {k: s for k, s in same.pool.items() if self.explains(s)} if self.explains(same.best) else {}
        answer = search(mode.best.case, self.say, start=mode)
        return replace(answer, pool=answer.pool | swinging, odds=mode.odds or 0.0)

    def nothing_touched(self, same: Found) -> Found | None:
        """Effects at sensors that explain the lines, where another day does not explain them as well."""
        best = same.best
        if not self.explains(best) or remounted(best):
            return None
        # the same effects on another day, and each left to what differs between days
        fewer = {best.terms, *(tuple(t for t in best.terms if t is not one) for one in best.terms)} - {()}
        odds = score(best) - self.rival.asked(sorted(fewer, key=len), best.alpha, best.log_evidence)
        return replace(same, odds=odds) if odds > EARNED else None

    def another_day(self, same: Found) -> Found:
        """The search of another day; what it finds tried with nothing touched as well."""
        best = same.best
        self.say("on another day:")
        found = as_channels_were(self.known, self.say)
        found = found or search(self.days, self.say, depth=self.depth, known=self.known, also=first_effects(same, _ALSO))
        # what was found with less to explain it, where nothing was touched; a difference between days may be an effect there
        back = self.back_to_one_set_up(found.best, max(found.best.log_evidence, best.log_evidence), _SOME)
        if back is not None and score(back) > max(score(found.best), score(best)):
            self.say(f"the same with nothing touched: {back.log_evidence:.1f}, discrepancy {back.alpha:.4f}")
            same = search(self.one_set_up, self.say, start=Found(back, same.empty, {s.key: s for s in (same.empty, back)}))
            best = same.best
        odds = -np.inf if remounted(best) else score(best) - score(found.best)
        beside = between_sensors(found.best, self.geometry)
        if odds <= 0 and self.days.elsewhere and (beside or untouched(found.best)):
            there = self.one_between_sensors(same, score(found.best if beside else self.alone))
            if there is not None:
                return there
        return replace(same if odds > 0 else found, odds=odds)

    def back_to_one_set_up(self, state: State, floor: float, beyond: float = PROMOTED) -> State | None:
        """The best fit with nothing touched of the effects of another day, and of these with a difference beyond so many spreads as one."""
        case = self.one_set_up
        sets = [terms for terms in (state.terms, *(x.terms for x in promotions(state, beyond))) if terms]
        tried = side_by_side(lambda terms: fitted_if_can_be(case, started(case, terms), _ROUGH, floor=floor), sets)
        return max((one for one in tried if one is not None), key=score, default=None)

    def no_effect_at_a_sensor(self, found: Found) -> Found | None:
        """What explains the lines with nothing touched where effects at sensors do not.

        In this order: an effect between sensors, a force law at sensors (told as the kind that has it, else of no kind in the catalogue), a
        law on motions that no sensor shows.
        """
        best, case = found.best, self.one_set_up
        if self.again is None or not self.days.elsewhere or self.explains(best):
            return None
        there = self.one_between_sensors(found)
        if there is not None:
            return there
        floor = max(self.alone.log_evidence, best.log_evidence)
        law = with_free_law(case, floor, self.say)
        kind = None if law is None else of_a_kind(law, self.say)
        if kind is not None:
            start = Found(kind, found.empty, found.pool | {kind.key: kind})
            named = search(case, self.say, self.rival, start=start, depth=AT_FIRST)
            odds = score(named.best) - self.rival.asked([named.best.terms], named.best.alpha, named.best.log_evidence)
            if self.explains(named.best) and odds > EARNED:
                return replace(named, odds=odds)
        if law is not None and law.alpha < _HALVED * best.alpha:  # else small differences between days may be what both leave
            odds = score(law) - max(score(best), self.rival.asked([best.terms] if best.terms else [], best.alpha))
            if odds > EARNED:
                return replace(found, unnamed=law, odds=odds)
        hidden = with_unseen_motion(case, self.again, floor, self.say)
        if hidden is None:
            return None
        if len(hidden.terms) == 1:  # it may be that of a location between sensors, whose shapes are nearly known
            there = self.one_between_sensors(found, score(hidden))
            if there is not None:
                return there
        odds = score(hidden) - max(score(best), self.rival.score)
        return replace(found, unnamed=hidden, odds=odds) if odds > EARNED else None

    def instead_of_two(self) -> Found | None:
        """What explains the lines as one, where nothing was touched and no effect at a sensor does; None where nothing does.

        An effect between sensors where that leaves no half of what the best sensor does, robustly and with nothing else freed, and no more
        than the idle model leaves at rest; a mode that is lacking where the best sensor leaves more than half of what there is.
        """
        case = self.one_set_up
        about, sensors = case.forward.start, case.at_rest.robust
        if not sensors:
            return None
        empty = fit(case, about, 0.1)
        nothing = Found(empty, empty, {empty.key: empty})
        there = self.one_between_sensors(nothing, part=_HALF)
        if there is not None and there.best.alpha <= AS_AT_REST * max(self.at_rest, LEAST_DISCREPANCY):
            return there
        if -sensors[0][0] > _HALF * robust_cost(case, about):
            return self.lacking_mode(nothing, at_once=True)
        return None

    def mode_alone(self, same: Found) -> Found | None:
        """A mode that the idle model lacks, where no effect at a sensor explains the lines."""
        return None if self.again is None or self.explains(same.best) else self.lacking_mode(same)

    def lacking_mode(self, found: Found, at_once: bool = False) -> Found | None:
        """A mode that the idle model lacks where that explains the lines; None where it does not.

        At the pole that takes most from what the idle model leaves as it is, or as another day has it. What acts as an absorber between
        sensors makes a mode, too. With no other effect where it is asked to be so ``at_once``, or where another day leaves little, which
        may explain that with an effect.
        """
        if self.again is None:
            return None
        bar = max(self.rival.score, score(found.best))
        sure = at_once or self.alone.alpha < LOOSE
        case = found.empty.case
        known = case.at_rest.grown = case.at_rest.grown or grown_by_a_mode([replace(found.empty, x=case.forward.start), self.alone])
        short = case.at_rest.no_mode
        able: list[Found] = []
        for grown in known:
            if sure and any(one is grown and its <= bar for one, its in short):
                continue
            lacking = with_mode(grown, self.again, bar, self.say, sure)
            if lacking is None or (sure and not self.explains(lacking.best)):
                short += [(grown, bar)] if sure else []
            elif lacking.best.alpha < LOOSE:
                able.append(lacking)
                if self.explains(lacking.best):
                    break
        for lacking in sorted(able, key=_of_best, reverse=True):
            there = self.one_between_sensors(found, score(lacking.best))
            if there is not None:
                return there
            ended = search(lacking.best.case, self.say, start=lacking, depth=AT_FIRST)
            if apart(ended.best):
                return replace(ended, odds=lacking.odds or 0.0)
            self.say("  the mode that was missing has become one of the others")
        return None

    def one_between_sensors(self, found: Found, bar: float | None = None, part: float = 1.0) -> Found | None:
        """One effect between sensors where nothing was touched; None where none explains the lines.

        It has to score more than a ``bar``; without one it is searched only where such a location leaves less than a ``part`` of what all
        sensors do, robustly and with nothing else freed.
        """
        if self.again is None or self.geometry is None:
            return None
        lowest, in_vain = -np.inf if bar is None else bar, found.empty.case.at_rest
        asked = max(score(self.alone), lowest)
        known = asked >= in_vain.no_location
        wider = () if known else cases_between_sensors(found.empty.case, self.again, self.geometry)
        if not wider:
            return None
        days, one_set_up = wider
        midway = one_set_up.idle.midway
        scanned = one_set_up.at_rest.robust = one_set_up.at_rest.robust or robust_scan(one_set_up, one_set_up.forward.start)
        if not scanned:
            return None
        if bar is None:
            least = {True: np.inf, False: np.inf}  # of locations between sensors, and of sensors
            for value, term, _ in scanned:
                there = bool(midway.keys() & set(term.places))
                least[there] = min(least[there], -value)
            if not least[True] < part * least[False]:
                return None
        self.say(f"{len(midway)} locations between sensors, with nothing touched:")
        rival = Rival(days, self.alone)
        rival.score = asked
        found = search(one_set_up, self.say, rival, depth=1)
        if found.best.alpha >= LOOSE:
            in_vain.no_location = asked
        if score(found.best) < lowest - WAYS:
            return None
        found = with_likely_sizes(found, self.say)
        best = found.best
        if not self.explains(best) or score(best) < lowest or not midway.keys() & {i for t in best.terms for i in t.places}:
            return None
        odds = score(best) - rival.asked([best.terms], best.alpha, best.log_evidence)
        return replace(found, odds=odds) if odds > EARNED else None


def cases_between_sensors(case: Case, again: Callable[[Idle], Sequence[Case]], geometry: Geometry) -> Sequence[Case]:
    """The same lines with locations between sensors; none where there are no such locations. Made once."""
    if case.at_rest.wider is None:
        wider = with_midway(case.uncompressed, geometry)
        case.at_rest.wider = () if wider is None else again(wider)
    return case.at_rest.wider


def as_channels_were(known: Sequence[State], say: Say) -> Found | None:
    """The likeliest state of another day, where it explains the lines and says, with its spreads estimated, that nothing was touched.

    No further effect makes channels differ that do not: on another day nothing is searched.
    """
    likely = max(known, key=score)
    state = fitted_if_can_be(likely.case, likely.x, likely.alpha, own_spreads=True) if likely.alpha < LOOSE else None
    if not likely.terms:  # a search leaves effects off on their way out of their range
        likely.own_spreads = state
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
