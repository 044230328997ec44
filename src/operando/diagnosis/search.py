"""Which effects are missing: scans, moves, and what the search ends with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry
from operando.diagnosis.between import SPREAD_FACTOR
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import CONTAINING, EARNED, EXPLAINED, HOPELESS, LOOSE, MOST_CHI_SQUARE, PROMOTED, STRAINED, UNUSUAL
from operando.diagnosis.forward import Point
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import with_lacking
from operando.diagnosis.midway import with_midway
from operando.diagnosis.posterior import State, approach, fit, names, on_validation_lines
from operando.diagnosis.scan import Candidate, LinearScan, Say, robust_scan, without_rest
from operando.diagnosis.terms import Term, added

Array = NDArray[Any]

_FITTED, _APPROACHED, _BEAM, _DEPTH = 3, 6, 3, 5
_OTHERS = 5  # of what may stand in the place of an effect: so many are fitted
_ANOTHER_DAY = 100.0  # log odds of another day from which no place between sensors is looked for in one set-up
_SHORT = 20.0  # nats below what its scan promises from which a fit counts as lost on its way
_LITTLE = 0.75  # of what is missing to another hypothesis, left by the best single effect, from which no pair of effects makes up for it
_RIVALS = 40.0  # nats below the best state up to which others are compared with it again


@dataclass
class Found:
    """What a search ends with.

    Attributes
    ----------
    best, empty : State
        The most probable state, and the one without effects.
    pool : dict
        All fitted states, by kinds and places.
    """

    best: State
    empty: State
    pool: dict[tuple[tuple[str, tuple[int, ...]], ...], State]


def strained(state: State) -> bool:
    """Whether a part of what differs between the days is far beyond the spread stated for it: it may stand for something else."""
    between, n_shape = state.case.between, state.case.forward.n_shape
    power: dict[str, list[Array]] = {}
    for (name, shared, where), factor in zip(between.groups, np.exp(between.log_factors), strict=True):
        values = state.x.d[where] if shared else state.x.own[:, n_shape:][where]
        power.setdefault(name, []).append((factor * values.ravel()) ** 2)
    return any(float(np.mean(v)) > STRAINED for v in map(np.concatenate, power.values()) if v.size > 1)


def score(state: State) -> float:
    """Log probability of a state but for a constant: a further effect must earn its place."""
    # all stiffness or all damping that differs far beyond two days is an effect by another name
    wholes = [state.case.between.shared[name] for name in ("stiffness", "damping_whole")]
    beyond = sum(part.stop > part.start and abs(state.x.d[part.start]) > PROMOTED for part in wholes)
    containing = sum(bool(t.definition.contains) for t in state.terms)
    return state.log_evidence - EARNED * (len(state.terms) + beyond) - CONTAINING * containing


def search(case: Case, say: Say = lambda text: None, rival: float = -np.inf, start: Found | None = None) -> Found:
    """To the first state that explains the lines; then with spreads estimated in each state.

    Parameters
    ----------
    case : Case
    say : callable
        Told each step.
    rival : float
        Score of another hypothesis: the search ends where a step does not halve what is missing to it.
    start : Found, optional
        States to begin with.
    """
    found = _Search(case, say, start, rival=rival).run()
    if score(found.best) < rival - EARNED or found.best.alpha >= EXPLAINED:
        return found
    say("with the spreads of what differs estimated:")
    return _Search(case, say, found, own_spreads=True).run()


def unlike_days(state: State) -> bool:
    """Whether an estimated spread of what differs is beyond what laboratories have: it stands for something else."""
    return bool((state.case.between.log_factors > UNUSUAL * SPREAD_FACTOR).any())


def search_both(days: Case, one_set_up: Case, say: Say = lambda text: None, at_rest: float = 0.0) -> tuple[Found, float]:
    """The better of two hypotheses: that nothing was touched between the measurements, and that it was another day.

    The first is a special case of the second: where it leaves nothing but noise, the second is not searched. Where the idle model
    explains the check as well as the FRFs at rest, and neither (``at_rest`` is the discrepancy there), nothing is searched.

    Returns
    -------
    Found
    float
        Log odds that nothing was touched.
    """
    alone = fit(days, days.forward.start)
    say(f"two days and no effect: {alone.log_evidence:.1f}, discrepancy {alone.alpha:.4f}")
    if at_rest > EXPLAINED and alone.alpha < HOPELESS * at_rest:
        say("no search: what the idle model leaves of the check it leaves of the FRFs at rest")
        return Found(alone, alone, {alone.key: alone}), -np.inf
    say("with nothing touched between the measurements:")
    same = search(one_set_up, say, score(alone))
    few = len(same.best.terms) <= 1  # several may stand for what the stricter hypothesis leaves out
    if few and same.best.alpha < LOOSE and score(same.best) > score(alone) and on_validation_lines(same.best)[0] < MOST_CHI_SQUARE:
        rival = fit(days, days_point(days, same.best), same.best.alpha) if same.best.terms else alone
        odds = score(same.best) - max(score(rival), score(alone))
        if odds > EARNED:
            return same, odds
    say("on another day:")
    found = search(days, say)
    odds = -np.inf if _remounted(same.best) else score(same.best) - score(found.best)
    return (same if odds > 0 else found), odds


def _remounted(state: State) -> bool:
    """Whether more than one channel has changed: then something was touched."""
    return sum(t.definition.acts == "sensor_map" for t in state.terms) > 1


def search_elsewhere(
    found: Found, odds: float | None, again: Callable[[Idle], Sequence[Case]], geometry: Geometry | None, places: bool, say: Say
) -> tuple[Found, float | None, Geometry | None]:
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
    places : bool
        Whether places between sensors are looked at.
    say : callable

    Returns
    -------
    Found
    float or None
    Geometry
        With the places between sensors, where one was needed.
    """
    best, known = found, geometry
    wider = None if geometry is None or not places else with_midway(found.empty.case.uncompressed, geometry)
    if wider is not None:
        say(f"{len(wider[0].midway)} places between sensors:")
        cases = again(wider[0])
        its_odds = odds
        if len(cases) > 1 and odds is not None and odds > -_ANOTHER_DAY:
            other, its_odds = search_both(cases[0], cases[1], say)
        else:
            other = search(cases[0], say)
        if score(other.best) > score(best.best) and any(t.places and t.places[0] in wider[0].midway for t in other.best.terms):
            best, known, odds = other, wider[1], its_odds
    # what the idle model leaves as it is, and as the check moved it: where days differ, peaks aside leave most
    for state in (replace(found.empty, x=found.empty.case.forward.start), found.empty):
        grown = with_lacking(state)
        if grown is None:
            continue
        say(f"a mode that the idle model lacks, near {grown.f[grown.lacking]:.4g} Hz:")
        cases = again(grown)
        starts = [fit(c, approach(c, replace(c.forward.start, terms=grown.lacking_term))[1], 0.03) for c in cases]
        first = max(starts, key=score)
        say(f"  with it alone {first.log_evidence:.1f}, discrepancy {first.alpha:.4f}")
        if score(first) > score(best.best) and _apart(first):
            pool = {s.key: s for s in (fit(first.case, first.case.forward.start, 0.1), first)}
            best, known = search(first.case, say, start=Found(first, pool[()], pool)), geometry
            odds = None if len(starts) < 2 else score(starts[1]) - score(starts[0])
            break
    return best, odds, known


def _apart(state: State) -> bool:
    """Whether a mode that was lacking lies beyond the half-power widths of all others: nearer, it may be one of them that differs."""
    idle = state.case.idle
    others = [r for r in idle.modes if r != idle.lacking]
    f, zeta = (float(np.exp(v)) for v in next(t for t in state.terms if t.kind == "missing_mode").values)
    return bool(np.all(np.abs(idle.f[others] / f - 1) > 2 * np.maximum(idle.zeta[others], zeta)))


def days_point(days: Case, state: State) -> Point:
    """Where a search with nothing touched has ended, as a start for two days."""
    start = days.forward.start
    return replace(start, u=np.zeros(len(days.forward.outside(state.terms))), terms=state.terms)


def promotions(state: State) -> list[Point]:
    """The effects of whose name a difference between the days far beyond its spread is, in its place."""
    case, x = state.case, state.x
    between, n_shape = case.between, case.forward.n_shape
    have, out, shared = {t.kind for t in x.terms}, [], between.shared

    def put(term: Term, d: np.ndarray, own: np.ndarray | None = None) -> None:
        if term.kind in case.kinds:
            out.append(replace(state.carried([*x.terms, term]), d=d, own=x.own if own is None else own))

    if shared["stiffness"].stop > shared["stiffness"].start:
        at = shared["stiffness"].start
        if abs(x.d[at]) > PROMOTED and "global_stiffness" not in have:
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
        if abs(x.d[whole]) > PROMOTED or abs(mean) > between.shared_spread[each].mean():
            d = x.d.copy()
            d[each] -= mean / between.shared_spread[each]
            value = mean + float(d[whole] * between.shared_spread[whole])
            d[whole] = 0
            put(Term("global_damping", (), (value,)), d)
    part = between.own["sensor"]
    if part.stop > part.start:
        column = n_shape + part.start
        for i in np.flatnonzero(np.abs(x.own[:, column]) > PROMOTED):
            own = x.own.copy()
            own[i, column] = 0
            put(Term("sensor_gain", (int(i),), (float(x.own[i, column] * between.own_spread[i, part.start]),)), x.d, own)
    for number, at in enumerate(range(shared["force"].start, shared["force"].stop)):
        if abs(x.d[at]) > PROMOTED:
            d = x.d.copy()
            d[at] = 0  # H is divided by the gain of the force
            put(Term("force_gain", (int(case.forward.references[number]),), (-float(x.d[at] * between.shared_spread[at]),)), d)
    return out


def contained(case: Case, term: Term) -> list[Term]:
    """Simpler kinds that a kind turns into for some of its values, at the same place: a heavy absorber far above its resonance is a
    spring or a damper to ground, far below it a mass; a spring with little or much loss is a spring or a damper."""
    if not (term.structural and term.values[1:]):
        return []
    size, f = float(np.exp(term.values[0])), np.sqrt(case.band[0] * case.band[1])
    if term.kind == "tuned_absorber":
        wa, zeta = 2 * np.pi * float(np.exp(term.values[1])), float(np.exp(term.values[2]))
        sizes = {"point_mass": size, "ground_spring": size * wa**2, "ground_damper": 2 * zeta * size * wa}
    else:
        z = abs(complex(added(term, np.array([2 * np.pi * f]), case.band)[0, 0, 0]))
        sizes = {"ground_spring": z, "ground_damper": z / (2 * np.pi * f), "ground_hysteretic_spring": z}
    out = []
    for kind, value in sizes.items():
        if kind in case.kinds and kind != term.kind:
            places = next(node for node in case.nodes if term.places[0] in node) if kind == "point_mass" else term.places
            further = tuple(float(v) for v in case.prior(Term(kind, places))[0][1:])
            out.append(Term(kind, places, (float(np.log(value)), *further), term.sign))
    return out


class _Search:
    """A beam of states and the moves between them: one more, one less, one promoted, one in the place of another."""

    def __init__(self, case: Case, say: Say, start: Found | None = None, rival: float = -np.inf, own_spreads: bool = False) -> None:
        self.case, self.say, self.start, self.rival, self.own_spreads = case, say, start, rival, own_spreads
        self.pool: dict[tuple[tuple[str, tuple[int, ...]], ...], State] = {}
        self.tried: set[tuple[tuple[str, tuple[int, ...]], ...]] = set()

    def best(self) -> State:
        return max(self.pool.values(), key=lambda s: s.log_evidence)

    def leaders(self, within: float, count: int) -> list[State]:
        """States not far below the best one."""
        ranked = sorted(self.pool.values(), key=lambda s: -s.log_evidence)[:count]
        return [s for s in ranked if s.log_evidence > ranked[0].log_evidence - within]

    def put(self, x: Point, alpha: float, case: Case) -> State | None:
        """Fits; ``case`` has the spreads in which the unknowns are given."""
        try:
            state = fit(case, x, alpha, floor=self.best().log_evidence if self.pool else -np.inf, own_spreads=self.own_spreads)
        except np.linalg.LinAlgError:
            return None
        known = self.pool.get(state.key)
        if np.isfinite(state.log_evidence) and (known is None or state.log_evidence > known.log_evidence):
            self.pool[state.key] = state
        self.say(f"  {names(self.case, state.terms)} {state.log_evidence:.1f}, discrepancy {state.alpha:.4f}")
        return state

    def once(self, terms: Sequence[Term]) -> bool:
        key = tuple(sorted(t.key for t in terms))
        new = key not in self.tried
        self.tried.add(key)
        return new

    def run(self) -> Found:
        if self.start is None:
            self.put(self.case.forward.start, 0.1, self.case)
        else:
            first = self.start
            near = [s for s in first.pool.values() if s.log_evidence > first.best.log_evidence - _RIVALS]
            for state in {s.key: s for s in (first.best, *sorted(near, key=lambda s: -s.log_evidence)[:_BEAM], first.empty)}.values():
                self.once(state.terms)
                if self.own_spreads:
                    self.put(state.x, state.alpha, state.case)
                else:
                    self.pool[state.key] = state
        empty = self.pool.get((), self.best())
        empty.robustly = self.start is not None
        for _ in range(_DEPTH):
            was = self.best()
            if (was.alpha > LOOSE or strained(was)) and not was.robustly:
                was.robustly = True
                self._robust_stage(was)
                if self.rival - score(self.best()) > _LITTLE * (self.rival - score(was)) > 0:
                    break
            self._grow()
            now = self.best()
            if len(now.terms) > 1:
                for term in now.terms:
                    rest = [t for t in now.terms if t is not term]
                    if self.once(rest):
                        self.put(now.carried(rest), now.alpha, now.case)
            best = self.best()
            if self.rival - score(best) > max(0.5 * (self.rival - score(was)), 0.0):
                break
            if np.isfinite(self.rival) and _remounted(best):
                break
            grown = len(best.terms) > len(was.terms)
            if best is was or (grown and best.log_evidence < was.log_evidence + EARNED):
                break
            if not self.own_spreads and best.alpha < EXPLAINED and not strained(best):
                break
        now = self.best()
        for state in self.leaders(_RIVALS, 4) if self.own_spreads else []:
            if state is not now:  # the leaders again, from the best: no evidence by its path
                self.put(now.carried(state.terms), now.alpha, now.case)
        told: set[tuple[tuple[str, tuple[int, ...]], ...]] = set()
        while self.own_spreads and (best := max(self.pool.values(), key=score)).key not in told and score(best) > self.rival - EARNED:
            told.add(best.key)
            self._others(best)
        return Found(max(self.pool.values(), key=score), empty, self.pool)

    def _grow(self) -> None:
        """One effect more about each of the leaders."""
        for rank, state in enumerate(self.leaders(30, _BEAM)):
            if state.scanned:
                continue
            state.scanned = True
            for x in promotions(state):
                if self.once(x.terms):
                    self.put(x, state.alpha, state.case)
            found, none = LinearScan(state).run()
            self.say(f"scan of {names(self.case, state.terms)}: {self._listed(found[:4], none)}")
            for row in found[: _FITTED if rank == 0 else 1]:
                if row.evidence > none - 20 and self.once([*state.terms, row.term]):
                    self._put_candidate(state.terms, row, state, state.log_evidence + row.evidence - none)

    def _put_candidate(self, terms: Sequence[Term], row: Candidate, state: State, promised: float = -np.inf) -> None:
        """The fit from where the scan puts it; from the idle model, robustly, where that ends far below what the scan promises."""
        ended = self.put(state.carried([*terms, row.term], row.start), state.alpha, state.case)
        if promised > self.best().log_evidence - _SHORT and (ended is None or ended.log_evidence < promised - _SHORT):
            start = state.carried([*terms, row.term], self.case.forward.start)
            self.put(approach(state.case, replace(start, u=0 * start.u))[1], 0.03, state.case)

    def _robust_stage(self, state: State) -> None:
        """The neighbourhoods of the leaders of two scans about the idle model; the nearest are fitted.

        One frees nothing and is robust; the other frees all unknowns at first order, which places that the idle model hardly knows need.
        """
        case = state.case
        about = state.x if state.terms else case.forward.start
        known = None if state.terms else case.at_rest.get("robust")
        rows = known or robust_scan(case, about)
        if not state.terms:
            case.at_rest["robust"] = rows
        self.say("robust scan: " + ", ".join(f"{names(case, [t])[0]}{' (cut)' if cut else ''} {v:.0f}" for v, t, cut in rows[:6]))
        free = LinearScan(state, about).exchanged()
        self.say(f"scan with all unknowns free: {self._listed(free[:6], free[0].evidence)}")
        places = [(term, cut) for _, term, cut in rows[:_APPROACHED]]
        there = {term.key for term, _ in places}
        places += [(c.term, False) for c in free[:_APPROACHED] if c.term.key not in there]
        near = []
        for term, cut in places:
            x = state.carried([*state.terms, term], about)
            if cut:
                x = replace(x, u=x.u + without_rest(case, x.terms, term.places))
            near.append(approach(case, x))
        near.sort(key=lambda row: row[0])
        for cost, x in near[:_FITTED]:
            if cost < 1.5 * near[0][0] + 20:
                self.put(x, 0.03, case)

    def _others(self, best: State) -> None:
        """What could stand in the place of each effect: simpler kinds that it contains, and what changes the FRFs as it does."""
        for term in best.terms:
            rest = [t for t in best.terms if t is not term]
            for simpler in contained(self.case, term):
                if self.once([*rest, simpler]):
                    self.put(best.carried([*rest, simpler]), best.alpha, best.case)
            if not term.values:
                continue
            found = LinearScan(best, held=term).in_place_of(term)
            self.say(f"in the place of {names(self.case, [term])[0]}: {self._listed(found[:6], 0.0)}")
            for row in found[:_OTHERS]:
                if row.evidence > 0 and self.once([*rest, row.term]):
                    self.put(best.carried([*rest, row.term], row.start), best.alpha, best.case)

    def _listed(self, rows: Sequence[Candidate], zero: float) -> str:
        return ", ".join(f"{names(self.case, [c.term])[0]} {c.evidence - zero:+.0f}" for c in rows)
