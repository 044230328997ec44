"""What a search allows to say: the sets of effects the data cannot tell apart, what would have been seen, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from operando.data import Geometry
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import (
    EARNED,
    EXPLAINED,
    LOWERED,
    MOST_CHI_SQUARE,
    ONE_SIDED,
    SET,
    STRAINED,
    SUPPORTED,
    UNUSUAL,
)
from operando.diagnosis.days import unlike_days, untouched
from operando.diagnosis.discrepancy import most_likely
from operando.diagnosis.found import Found
from operando.diagnosis.free_law import free_law_text
from operando.diagnosis.posterior import State, leaves_noise, left_on, on_fitted_lines, on_validation_lines, with_discrepancy
from operando.diagnosis.result import spacing
from operando.diagnosis.rival import fitted_if_can_be, score
from operando.diagnosis.scan import LinearScan
from operando.diagnosis.search import RIVALS
from operando.diagnosis.terms import BY_SLOPE, Term
from operando.diagnosis.unseen import unseen_text
from operando.dof import Dof
from operando.indicators import INTERVAL
from operando.processes import side_by_side
from operando.structure.effects import with_spread

_HALVINGS = 8  # of the range of a discrepancy
_LEAST_POWER = 0.5  # of a size by which it is seen: 1 at first order, 0.6 to 0.9 along the valleys that were looked at
_UNLIKE = "what differs between the measurements is more than between days in a laboratory: it stands for something else"
_MOVED = (
    "gains and positions of sensors are the same, so nothing was touched between the measurements, and yet modes have moved one by one: "
    "the structure has changed, and no effect at one location explains how"
)


@dataclass(frozen=True)
class Verdict:
    """A verdict with its ground.

    ``why`` is empty where nothing stands in the way; ``terms`` are supported effects; ``rivals`` may stand in the place of the best.
    ``least`` is the smallest size of each kind at each place that would have been found in 95 % of tests like this one [SI units].
    """

    name: str
    why: str
    terms: tuple[Term, ...]
    rivals: list[State]
    least: dict[tuple[str, tuple[int, ...]], float]


def others(found: Found) -> list[State]:
    """What may stand in the place of the best: the rest of the 95 % set, without states that only add to it; else what does as well."""
    best = found.best
    if found.as_well:
        return found.as_well
    rivals = [s for s in found.pool.values() if not set(best.key) < set(s.key)]
    weights = np.exp([score(s) - score(best) for s in rivals])
    weights /= weights.sum()
    out, total = [], 0.0
    for i in np.argsort(-weights):
        if total < SET and rivals[i] is not best:
            out.append(rivals[i])
        total += weights[i]
    return out


def detectable(state: State) -> dict[tuple[str, tuple[int, ...]], float]:
    """Smallest size of each kind at each place that would have been found in 95 % of tests like this one, SI units."""
    case = state.case
    places = [t for t in case.candidates(state.terms) if t.kind in BY_SLOPE and not case.idle.midway.keys() & set(t.places)]
    return _found(state, [t.moved((0.0,)) for t in places])


def _found(state: State, places: list[Term]) -> dict[tuple[str, tuple[int, ...]], float]:
    told = zip(places, LinearScan(state).by_slopes(places), strict=True)
    return {place.key: float(_asked(state.case, place.kind) / np.sqrt(max(information, 1e-300))) for place, (information, _) in told}


def _asked(case: Case, kind: str) -> float:
    """Standard deviations of a size that is seen in 95 % of tests."""
    # nats: what a further effect must earn, one of so many places and kinds, and two for its prior's width
    nats = EARNED + np.log(len(case.kinds) * max(case.places(kind), 1)) + 2
    return float(np.sqrt(2 * nats) + ONE_SIDED)


def seen_at_their_size(state: State, least: Mapping[tuple[str, tuple[int, ...]], float]) -> dict[tuple[str, tuple[int, ...]], float]:
    """Sizes that would have been found, raised where a fit with the size held shows that it would not.

    The slope at size zero knows of no other way to make the FRFs of a larger effect. Where modal masses are hardly known, size and
    shapes trade along a bent valley: of each kind the smallest size is held, all else is fitted, and what the likelihood falls by says
    how much larger the sizes of that kind must be.

    The state is without effects; ``least`` is of :func:`detectable`.
    """
    case = state.case
    of_kind: dict[str, tuple[tuple[str, tuple[int, ...]], float]] = {}
    for key, size in least.items():
        if key[0] not in of_kind or size < of_kind[key[0]][1]:
            of_kind[key[0]] = key, size

    def deviations(key: tuple[str, tuple[int, ...]], size: float) -> float:
        """By which a size is seen, from the fall of the likelihood with the size held."""
        term = Term(*key, (float(np.log(size)),), fixed=(0,))
        held = fitted_if_can_be(case, state.carried([term]), state.alpha)
        fall = np.inf if held is None else state.log_evidence - (held.log_evidence - case.log_place(term))
        return float(np.sqrt(2 * max(fall, 0.0)))

    def factor(kind: str) -> float:
        key, size = of_kind[kind]
        asked, seen = _asked(case, kind), deviations(key, size)
        if seen >= asked:
            return 1.0
        more = asked / max(seen, 1.0)
        power = np.log(max(deviations(key, more * size) / max(seen, 1.0), 1 + 1e-9)) / np.log(more)
        return float(more ** (1 / max(power, _LEAST_POWER)))

    first = [kind for kind in of_kind if kind in ("point_mass", "ground_spring")]
    factors = dict(zip(first, side_by_side(factor, first), strict=True))
    others = [kind for kind in of_kind if kind not in first]
    more = [1.0] * len(others) if max(factors.values(), default=1.0) == 1 else side_by_side(factor, others)
    factors |= dict(zip(others, more, strict=True))
    return {key: size * factors[key[0]] for key, size in least.items()}


def unseen(state: State) -> list[float]:
    """Modes in band [Hz] that a mass or a spring to ground can move by a half-power width 2ζf and stay below what would have been found.

    At the sensor where the mode moves most; kinds that were not looked for count as well.
    """
    case, idle = state.case, state.case.idle
    sensors = [i for i in range(len(case.dofs)) if i not in idle.midway]
    modes = [r for r in idle.modes if case.band[0] < idle.f[r] < case.band[1] and r != idle.lacking]
    most = {r: sensors[int(np.argmax(np.abs(idle.phi[sensors, r])))] for r in modes}
    at = sorted(set(most.values()))
    mass = {i: Term("point_mass", next(n for n in case.nodes if i in n), (0.0,)) for i in at}
    spring = {i: Term("ground_spring", (i,), (0.0,)) for i in at}
    least = _found(state, [*{t.key: t for t in mass.values()}.values(), *spring.values()])
    out = []
    for r in modes:
        i, wr = most[r], 2 * np.pi * idle.f[r]
        by_mass = 0.5 * least[mass[i].key] * float(np.sum(idle.phi[list(mass[i].places), r] ** 2))
        by_spring = 0.5 * least[spring[i].key] * float(idle.phi[i, r] ** 2) / wr**2
        if max(by_mass, by_spring) > 2 * idle.zeta[r]:
            out.append(float(idle.f[r]))
    return out


def unlike_neighbours(state: State) -> str:
    """Which effect stands between sensors at a location that would have to move unlike its neighbours; empty where none does.

    By what is added there to the shapes that the neighbours suggest, in standard deviations of these (``BETWEEN_STD``), over the modes in
    band without the worst: a single member may bend between its sensors. An effect on a motion that no sensor shows, such as a rotation,
    fits as an effect at a location whose shapes are made to be that motion.
    """
    idle, n_shape = state.case.forward.idle, state.case.forward.n_shape
    for term in state.terms:
        for i in set(term.places) & idle.midway.keys():
            own = idle.shapes.own[i, idle.modes]
            spread = np.sqrt(np.sum(own**2, axis=1))
            added = np.divide(own @ state.x.own[i, :n_shape], spread, out=np.zeros(len(own)), where=spread > 0)
            power = np.sort(added**2)[:-1]
            if power.size and power.mean() > STRAINED:
                off = f"off by {np.sqrt(power.mean()):.2g} of their standard deviations, rms over the modes"
                return (
                    f"{term.definition.plain} at {state.case.place(i)} would explain the FRFs, but not with the shapes that the sensors "
                    f"beside it suggest ({off}): what is missing acts on a motion that no sensor shows, such as a rotation"
                )
    return ""


def supported(state: State) -> bool:
    """Whether the interval of each effect's size excludes zero."""
    return len(_with_sizes(state)) == len(state.terms)


def _with_sizes(state: State) -> list[Term]:
    """Effects whose size has an interval that excludes zero."""
    std, at, out = np.sqrt(np.diag(state.covariance)) if state.terms else np.zeros(0), 0, []
    for term in state.terms:
        if not term.values or std[at] <= (abs(term.values[0]) / 2 if term.linear else SUPPORTED):
            out.append(term)
        at += len(term.values)
    return out


def with_sizes(found: Found) -> Found:
    """With the effects alone whose sizes are known, where the most probable state has others beside them.

    An effect whose size may be none takes nothing from one that is sure. That something is likely beside it is then said by the verdict.
    """
    keys = {t.key for t in _with_sizes(found.best)}
    if not keys or len(keys) == len(found.best.terms):
        return found
    state = next((s for key, s in found.pool.items() if set(key) == keys), None)
    if state is None or not supported(state) or score(state) < score(found.empty) + RIVALS:
        return found
    return replace(found, best=state)


def with_validation(found: Found) -> Found:
    """With effects of known sizes and the most likely discrepancy, or the one that the validation lines ask for where that is more.

    A model that is not exact follows the lines it is fitted to, and its intervals are too narrow: the share of an FRF that no
    parameter explains is the one on lines that were never fitted.
    """
    found = with_sizes(found)
    found = _with_best(found, most_likely(found.best))
    best = found.best
    if best.alpha >= EXPLAINED or on_validation_lines(best)[0] < MOST_CHI_SQUARE:
        return found

    def left(alpha: float) -> float:
        return left_on(best.case, best.x, alpha, best.case.lines.validation)[0]

    low, high = np.log((best.alpha, EXPLAINED))
    if left(EXPLAINED) > 1:
        return found
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(float(np.exp(middle))) > 1 else (low, middle)
    return _with_best(found, with_discrepancy(best, float(np.exp(high))))


def _with_best(found: Found, state: State) -> Found:
    """The best state under another discrepancy."""
    best = found.best
    return replace(found, best=state, empty=state if found.empty is best else found.empty, pool=found.pool | {best.key: state})


def explains_lines(state: State) -> bool:
    """Whether a state leaves no more on lines that were not fitted than an explanation may leave."""
    return leaves_noise(state) and state.alpha <= EXPLAINED


def misses_idle_frfs(rest: State) -> bool:
    """Whether the idle model differs from the idle FRFs themselves by more than an explanation may leave."""
    return rest.alpha > EXPLAINED


def verdict(found: Found, rest: State | None) -> Verdict:
    """The verdict with all that is told with it; ``rest`` is the idle model on the idle FRFs, where there are any."""
    best = found.best
    if found.unnamed is not None:
        text = unseen_text if found.unnamed.case.idle.midway else free_law_text
        return Verdict("unexplained", text(found.unnamed), (), [], detectable(best))
    name, why = verdict_and_reason(found, rest, unseen(best))
    terms = best.terms if name not in ("inconclusive", "no_misfit", "unexplained") else ()
    least = detectable(best)
    if name in ("no_misfit", "inconclusive") and not best.terms:
        least = seen_at_their_size(best, least)
    return Verdict(name, why, terms, others(found), least)


def verdict_and_reason(found: Found, rest: State | None, blind: Sequence[float] = ()) -> tuple[str, str]:
    """Name of the verdict and its ground, by the rules of the specification.

    ``rest`` is the idle model on the idle FRFs, where there are any; ``blind`` are modes that could move by a half-power width without
    being seen: what keeps "no_misfit" from being said.
    """
    best = found.best
    chi, db = on_validation_lines(best)
    explained = explains_lines(best)
    far = _UNLIKE if unlike_days(best) else ""
    still = _MOVED if untouched(best) else ""
    if rest is not None and misses_idle_frfs(rest):  # effects were judged where they were looked for (``poor_idle``)
        lost = f"the idle model, one set of shapes for all pairs, differs by {100 * rest.alpha:.1f} % from the idle FRFs themselves"
        return ("partial" if best.terms and supported(best) else "inconclusive"), lost
    if far or still or not explained:
        before = on_validation_lines(found.empty)[1]
        # what differs between the days explains most of the error without an effect as well: there the evidence speaks for it
        by_days = far and not still and explained
        lowered = db**2 < (1 - LOWERED) * before**2 or (by_days and score(best) > score(found.empty) + RIVALS)
        if best.terms and supported(best) and lowered:
            return "partial", still or far or "the effects lower the error, and something remains"
        if still:
            return "unexplained", still
        if far and not best.terms:
            return "inconclusive", far
        lines, chi = max(("validation", chi), ("fitted", on_fitted_lines(best)), key=lambda row: row[1])
        left = f"{lines} lines are left at a chi-square of {chi:.2g} with a discrepancy of {100 * best.alpha:.2g} %"
        return "unexplained", far or left
    if unlike := unlike_neighbours(best):
        return "unexplained", unlike
    sets = [s.terms for s in others(found)]
    if not best.terms:
        if any(sets):
            return "inconclusive", "nothing and an effect are as likely"
        if found.left_out:
            return "inconclusive", found.left_out[-1]
        if blind:
            which = ", ".join(f"{hz:.4g}" for hz in blind)
            return "inconclusive", f"the modes at {which} Hz could have moved by a half-power width without being seen"
        return "no_misfit", ""
    if not supported(best) or not all(sets):
        return "inconclusive", "an effect is likely, but none is as likely"
    if any(set(best.key) < set(s.key) and score(s) > score(best) + EARNED for s in found.pool.values()):
        return "partial", "something more is likely beside the effects, and no size of it is known"
    if sets:
        return "ambiguous", "other effects fit as well"
    return "explained", ""


def moved_peaks(rows: Sequence[Mapping[str, float | None]], spreads: Mapping[str, float]) -> list[tuple[float, float, float | None]]:
    """Peaks of the check that lie off those of the idle model by more than days in a laboratory differ and than their half-power width.

    Peaks and shapes were fitted to the lines near them alone: that they moved is seen also where the idle model as a whole is a poor one.

    Each is (Hz, by how much it has moved [%], standard deviation of its frequency [Hz]). ``rows`` are ``by_mode`` of the comparison: each
    measured peak, with the idle model's of the same shape; ``spreads`` are of what differs between the measurements.
    """
    days = UNUSUAL * float(np.hypot(spreads.get("stiffness", 0.0) / 2, spreads.get("mode", 0.0)))
    out = []
    for row in rows:
        hz, zeta, error = row["frequency_hz"], row["damping_ratio"], row["frequency_error_percent"]
        if hz is None or zeta is None or error is None:
            continue
        moved = 1 / (1 + error / 100) - 1
        if abs(moved) > max(days, 2 * zeta):
            out.append((hz, 100 * moved, row.get("frequency_std_hz")))
    return out


def peaks_text(moved: Sequence[tuple[float, float, float | None]], most: int = 4) -> str:
    """Which peaks have moved, those that moved farthest."""
    farthest = sorted(sorted(moved, key=lambda row: -abs(row[1]))[:most])
    by = [f"{'+' if percent > 0 else '−'}{abs(percent):.2g} %" for _, percent, _ in farthest]
    named = ", ".join(f"to {with_spread(hz, INTERVAL * (std or 0.0))} Hz by {off}" for (hz, _, std), off in zip(farthest, by, strict=True))
    known = " (± is the 95 % interval)" if "±" in named else ""
    many = "1 peak has" if len(moved) == 1 else f"{len(moved)} peaks have"
    farthest_of = "" if len(moved) == 1 else "the farthest "
    return f"{many} moved by more than days in a laboratory differ and than their half-power width, {farthest_of}{named}{known}"


def no_other_answer(best: State, rival: State, geometry: Geometry | None) -> bool:
    """Whether a rival only moves effects by no more than a sensor spacing (specification), or has kinds that contain those found."""

    def apart(state: State, other: State) -> list[Term]:
        return sorted((t for t in state.terms if t.key not in {o.key for o in other.terms}), key=lambda t: t.kind)

    mine, theirs = apart(best, rival), apart(rival, best)
    if len(mine) != len(theirs) or any(a.kind not in (b.kind, *b.definition.contains) for a, b in zip(mine, theirs, strict=True)):
        return False
    limit, dofs = spacing(geometry) * 1.05, best.case.dofs

    def near(a: Term, b: Term) -> bool:
        return _distance([dofs[i] for i in a.places], [dofs[i] for i in b.places], geometry) <= limit

    return all(near(a, b) for a, b in zip(mine, theirs, strict=True))


def _distance(one: Sequence[Dof], other: Sequence[Dof], geometry: Geometry | None) -> float:
    """Largest way between places, paired as is nearest [m]; infinite where it is not known."""
    if [d.node for d in one] == [d.node for d in other]:
        return 0.0
    points = [[p for d in dofs if geometry is not None and (p := geometry.position(d.node)) is not None] for dofs in (one, other)]
    if len(points[0]) != len(one) or len(points[1]) != len(one) or len(one) != len(other):
        return float("inf")
    return min(
        max((float(np.linalg.norm(np.subtract(p, q))) for p, q in zip(points[0], order, strict=True)), default=0.0)
        for order in permutations(points[1])
    )
