"""Which effect more would help: all kinds at all places about a state, by a robust misfit or by the evidence at first order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from operando.diagnosis.arrow import Factor, Information
from operando.diagnosis.between import Outside
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import ROBUST
from operando.diagnosis.eigenmodes import ScannableModes
from operando.diagnosis.forward import Point, Scannable
from operando.diagnosis.posterior import State, linear_evidence
from operando.diagnosis.problem import Problem, Step
from operando.diagnosis.slopes import Slopes
from operando.diagnosis.terms import Term, added, changes
from operando.processes import side_by_side

Array = NDArray[Any]

_AT_ONCE, _PLACES = 128, 8  # responses to trial effects at a time; places whose trial effects are looked at together
_SIZES = 8  # trial sizes
_DAMPING = (0.01, 0.04, 0.1)  # trial damping ratios of an absorber
_OTHER_FREQUENCY = 0.1  # of an absorber, as a logarithm: another start
_TOP, _SLOPES = 24, 12  # candidates that are refined, and those told by their slope
_HELD = 1e12  # precision of a value that stays
_LOOSE_VALUE = 1e-2  # precision of the values of effects that are there, so that one more may change them


@dataclass
class Candidate:
    """A term by its evidence in a scan, and where the unknowns are to start with it."""

    evidence: float
    term: Term
    start: Point


def trials(case: Case, term: Term, count: int, of_absorbers: int = 3) -> list[Term]:
    """Trial values of a kind at a place: so many sizes, at each frequency of an absorber fewer."""
    kind, definition = term.kind, term.definition
    if not definition.parameters:
        return [term]
    if kind.endswith("_gain"):
        return [term.moved((v,)) for v in (-1, -0.3, -0.1, -0.03, 0.03, 0.1, 0.3, 1)]
    if kind.endswith("_delay"):
        unit = 1 / (2 * np.pi * case.band[1])
        return [term.moved((v * unit,)) for v in (-1, -0.3, -0.1, 0.1, 0.3, 1)]
    if kind == "global_damping":
        return [term.moved((v,)) for v in (-0.7, -0.3, -0.1, 0.1, 0.3, 0.7)]
    if kind == "global_stiffness":
        sizes = np.log((0.002, 0.003, 0.005, 0.008, 0.013, 0.02, 0.03, 0.05, 0.08, 0.13))
        return [Term(kind, (), (float(v),), sign) for v in sizes for sign in (1, -1)]
    low, high = case.size_range(kind, term.places)
    if kind == "tuned_absorber":
        at = np.linspace(float(np.log(case.band[0])), float(np.log(case.band[1])), case.lines.frequencies)
        return [term.moved((s, f, z)) for s in np.linspace(low, high, of_absorbers) for f in at for z in np.log((0.01, 0.05))]
    signs = (1, -1) if definition.removable or definition.coordinates == "separate" else (1,)
    further = [np.linspace(m - s, m + s, 3) for m, s in zip(*(v[1:] for v in case.prior(term)), strict=True)]
    rest = [tuple(float(x) for x in row) for row in np.stack(np.meshgrid(*further), -1).reshape(-1, len(further))] if further else [()]
    sizes = np.linspace(low - 0.5, high + 0.5, count)
    return [Term(kind, term.places, (float(s), *more), sign) for s in sizes for more in rest for sign in signs]


def responses(case: Case, x: Point, state: Scannable | ScannableModes, columns: Array | None, terms: Sequence[Term], at: Array) -> Array:
    """Measured FRFs (lines, responses, references, n) with each of some terms of one kind and place more."""
    if isinstance(state, ScannableModes) or columns is None:
        assert isinstance(state, ScannableModes)
        return state.responses(terms)
    first, w, band = terms[0], case.lines.w[at], case.band
    if first.structural:
        patterns, factors = _changes(state, columns, terms, w, band)
        return state.h[..., None] + (patterns @ factors).reshape(*state.h.shape, len(terms))
    out = []
    for term in terms:
        h = state.h.copy()
        rows = [np.flatnonzero(state.order == i) for i in term.places]
        if term.definition.acts == "modal_change":
            more = Point(x.g, x.d, x.own, x.u, (*x.terms, term))
            h = case.forward.predict(more, w, derivatives=False).h
        elif term.kind == "channel_swap":
            # what each channel shows changes places; its gain stays with the sensor
            if all(r.size for r in rows):
                h[:, [rows[0][0], rows[1][0]]] = h[:, [rows[1][0], rows[0][0]]]
        else:
            ratio = np.asarray(term.definition.sensor_map(w / 2 / np.pi, term.sizes(band)))
            if term.definition.group == "force":
                h[:, :, case.forward.references == term.places[0]] /= ratio[:, None, None]
            else:
                h[:, rows[0]] *= ratio[:, None, None]
        out.append(h)
    return np.stack(out, -1)


def _changes(state: Scannable, columns: Array, terms: Sequence[Term], w: Array, band: tuple[float, float]) -> tuple[Array, Array]:
    """As :func:`changes`, as measured: (lines, responses × references, p) and (lines, p, n)."""
    patterns, factors = changes(columns, state.structure, terms, w, band)
    return state.measured(patterns).reshape(w.size, -1, patterns.shape[-1]), factors


def _robust_weights(case: Case, at: Array) -> Array:
    return np.asarray(1 / np.sqrt(case.lines.variance[at] + ROBUST**2 * case.lines.level[at] ** 2))


def robust_cost(case: Case, x: Point) -> float:
    """What a point leaves by the measure of :func:`robust_scan`."""
    at = case.lines.fit[:: case.lines.rough]
    left = (case.lines.h[at] - case.forward.predict(x, case.lines.w[at], derivatives=False).h) * _robust_weights(case, at)
    return float(np.sum(np.log1p(np.abs(left) ** 2)))


def robust_scan(case: Case, x: Point, places: Sequence[Term] | None = None) -> list[tuple[float, Term, bool]]:
    """Candidates by a robust misfit, without freeing anything; once more without what residual masses give between undriven places."""
    at, forward = case.lines.fit[:: case.lines.rough], case.forward
    w, measured = case.lines.w[at], case.lines.h[at]
    state = forward.scannable(x, w)
    root = _robust_weights(case, at)
    left = ((measured - state.h) * root).reshape(w.size, -1, 1).astype(np.complex64)
    variants = [(False, state.columns)]
    below = case.between.below
    if not x.terms and below.size and state.columns is not None:
        idle = case.idle
        w0 = 2 * np.pi * idle.f[below]
        k = 1 / (w0**2 - w[:, None] ** 2 + 2j * idle.zeta[below] * w0 * w[:, None])
        phi = idle.phi[:, below] * forward.undriven[:, None]
        rest = (phi * k[:, None]) @ phi.T
        i = np.arange(forward.n_dofs)
        rest[:, i, i] = -np.sum(phi**2, axis=1) / w[:, None] ** 2
        variants.append((True, state.columns - rest))

    def best(asked: tuple[bool, Array | None, Term]) -> tuple[float, Term, bool]:
        cut, columns, place = asked
        # of one place a mass of an absorber is met as closely as other sizes; of all places that takes too long
        some = trials(case, place, case.lines.sizes, 3 if places is None else case.lines.sizes // 2)
        with np.errstate(all="ignore"):
            if place.structural and columns is not None and isinstance(state, Scannable):
                patterns, factors = _changes(state, columns, some, w, case.band)
                patterns = (patterns * root.reshape(w.size, -1, 1)).astype(np.complex64)
                error = left - patterns @ factors.astype(np.complex64)
            else:
                h = responses(case, x, state, columns, some, at)
                error = (measured[..., None] - h) * root[..., None]
            power = error.real**2
            power += error.imag**2
            power += 1  # its logarithm is four times as fast as log1p, and the power is no more exact
            cost = np.sum(np.log(power), axis=tuple(range(error.ndim - 1)), dtype=float)
            cost = np.nan_to_num(cost, nan=np.inf)
        first = int(np.argmin(cost))
        return -float(cost[first]), some[first], cut

    asked = [
        (cut, columns, place)
        for cut, columns in variants
        for place in (case.candidates(x.terms) if places is None else places)
        if not cut or (place.structural and forward.undriven[list(place.places)].all())
    ]
    out = side_by_side(best, asked)
    return sorted(out, key=lambda row: -row[0])


def _of_the_whole(term: Term) -> bool:
    """Whether a kind changes the whole structure: all stiffness, all damping."""
    return term.definition.acts == "modal_change"


class LinearScan:
    """A state at first order, and what one effect more would add to its evidence.

    By the slope of the response at size zero (score test): where what differs between the days stands for an effect that moves a mode by
    its half-power width, the response to its size as it is does not undo that, but the slope exchanges one for the other where the peaks
    are. Kinds without a size by their response.
    """

    def __init__(self, state: State, x: Point | None = None, held: Term | None = None) -> None:
        """Of a state, or about another point, on fewer lines; values of the effect ``held`` stay as they are."""
        case = self.case = state.case
        self.fitted = state
        self.x = state.x if x is None else x
        self.stride = case.lines.stride if x is None else case.lines.rough
        self.at = case.lines.fit[:: self.stride]
        self.w = case.lines.w[self.at]
        problem = self.problem = Problem(case, self.x.terms, self.at, self.stride)
        packed = self.packed = problem.packed(self.x)
        shared, own = problem.derived(packed)[0].whole()
        self.state = case.forward.scannable(self.x, self.w)
        self.weights = np.sqrt(problem.weights(state.alpha))[..., None]
        self.shared, self.own = shared * self.weights, own * self.weights
        precision = np.array(problem.precision)
        values = slice(problem.values_at, problem.values_at + problem.n_values)
        precision[values] = [_HELD if t is held else _LOOSE_VALUE for t in self.x.terms for _ in t.values]
        told = Information.of(self.shared, self.own)
        without, own = packed.shared.copy(), problem.by_response(packed.own)
        if problem.idle is not None:  # from where the prior, normal about this point, has its mean
            told = told + problem.idle.information
            without, own = Factor.of(problem.idle.information, problem.precision, problem.own_precision).solve(*problem.of_prior(packed))
        self.factor = Factor.of(told, precision, problem.own_precision)
        without[values] = 0
        self.offset = Slopes(lambda at: (self.shared, self.own)).moved(without, own)[..., None]
        self.measured = problem.rows(problem.measured[..., None]) * self.weights

    def residuals(self, terms: Sequence[Term]) -> Array:
        """(responses, rows, n) with each of some terms of one kind and place, everything else as if its prior's mean were the start."""
        with np.errstate(all="ignore"):
            h = responses(self.case, self.x, self.state, self.state.columns, terms, self.at)
        return self.offset + self.measured - self.problem.rows(h) * self.weights

    def whitened(self, rows: Array) -> Array:
        """Factor⁻¹ Jᵀ of rows (responses, rows, n), as columns."""
        shared = np.tensordot(self.shared, rows, ((0, 1), (0, 1)))
        a, b = self.factor.whitened(shared, np.swapaxes(self.own, 1, 2) @ rows)
        return np.concatenate([a, b.reshape(b.shape[0] * b.shape[1], b.shape[2])])

    def costs(self, r: Array) -> Array:
        """½ of what the unknowns leave of the squares of each residual (responses, rows, n)."""
        return np.nan_to_num(0.5 * (np.sum(r**2, (0, 1)) - np.sum(self.whitened(r) ** 2, 0)), nan=np.inf)

    def run(self) -> tuple[list[Candidate], float]:
        """Candidates, best first, and the evidence of none."""
        places = self.case.candidates(self.x.terms)
        r = self.offset + self.measured - self.problem.rows(self.state.h[..., None]) * self.weights
        rq = self.whitened(r)
        none = -0.5 * float(np.sum(r**2) - np.sum(rq**2))
        rows = self._at_size(self._by_slope(places, r, rq, none), none)
        rows += self._by_trials([p for p in places if not p.definition.parameters or (_of_the_whole(p) and not self._differs(p))])
        return _best_of_each(rows), none

    def _differs(self, term: Term) -> bool:
        """Whether a change of the whole is one of what differs between the days: then it comes by promotion."""
        name = {"global_stiffness": "stiffness", "global_damping": "damping"}.get(term.kind)  # a kind of the user's own has none
        part = slice(0, 0) if name is None else self.case.between.shared[name]
        return bool(part.stop > part.start)

    def _at_size(self, rows: Sequence[Candidate], none: float) -> list[Candidate]:
        """Candidates by their evidence at first order about their size, with what is not known at their places.

        The own compliance of an undriven place, which no column tells, counts for nothing at size zero, and for much at a size.
        """
        undriven = self.case.forward.undriven

        def there(row: Candidate) -> float:
            if not (row.term.structural and undriven[list(row.term.places)].any()):
                return -np.inf
            return self._about(self.fitted.carried([*self.x.terms, row.term], row.start))

        before, after = self._about(self.x), side_by_side(there, rows)
        return [replace(row, evidence=max(row.evidence, none + at - before)) for row, at in zip(rows, after, strict=True)]

    def _about(self, x: Point) -> float:
        """Evidence of the model that is linear about a point, but for a constant."""
        problem = Problem(self.case, x.terms, self.at, self.stride)
        packed = problem.packed(x)
        try:
            with np.errstate(all="ignore"):
                slopes, residual = problem.derived(packed)
                evidence = linear_evidence(problem, residual, slopes, packed, self.fitted.alpha)[0]
        except np.linalg.LinAlgError:
            return -np.inf
        return evidence if np.isfinite(evidence) else -np.inf

    def in_place_of(self, term: Term) -> tuple[list[Candidate], float]:
        """What could do the same as an effect that is there and ``held``: what changes the FRFs as it does, once all unknowns follow.

        By the slopes of both about the state with the effect: without it all unknowns would be far from where they belong.

        Candidates are by what each takes over; the number is what the effect itself is worth, at first order [nats].
        """
        r = self._of(term)
        rq = self.whitened(r)
        rest = [t for t in self.x.terms if t is not term]
        places = [p for p in self.case.candidates(rest) if p.key != term.key]
        return self._by_slope(places, r, rq, 0.0, term), 0.5 * float(np.sum(r**2) - np.sum(rq**2))

    def worth(self, term: Term) -> float:
        """What an effect that is there and ``held`` takes off ½ of the squares, at first order and once all unknowns follow [nats]."""
        r = self._of(term)
        return 0.5 * float(np.sum(r**2) - np.sum(self.whitened(r) ** 2))

    def _of(self, term: Term) -> Array:
        """What an effect that is there does to the rows, by its slope, (responses, rows, 1)."""
        at = self.problem.values_at + sum(len(t.values) for t in self.x.terms[: self.x.terms.index(term)])
        return np.asarray(self.shared[..., at : at + 1] * (term.values[0] if term.linear else 1.0))

    def at_trial_sizes(self) -> list[Candidate]:
        """Candidates about a point that was not fitted, by their responses to trial sizes."""
        return _best_of_each(self._by_trials(self.case.candidates(self.x.terms)))

    def _by_trials(self, places: Sequence[Term]) -> list[Candidate]:
        case = self.case

        def best(some: Sequence[Term], score: Array) -> list[tuple[float, Term]]:
            place, order = some[0], np.argsort(-score)
            rows = [(float(score[order[0]]), some[order[0]])]
            if place.kind == "tuned_absorber":  # a second start at another frequency
                far = [j for j in order[1:40] if abs(some[j].values[1] - some[order[0]].values[1]) > _OTHER_FREQUENCY][:1]
                rows += [(float(score[j]), some[j]) for j in far]
            return rows

        def best_of(places: Sequence[Term]) -> list[tuple[float, Term]]:
            tried = [trials(case, place, _SIZES) for place in places]
            left = [self.residuals(some) for some in tried]
            ends = np.cumsum([0, *(len(some) for some in tried)])
            costs = self.costs(np.concatenate(left, -1)) if left else np.zeros(0)
            scores = (case.log_priors(some) - costs[a:b] for some, a, b in zip(tried, ends[:-1], ends[1:], strict=True))
            return [row for some, score in zip(tried, scores, strict=True) for row in best(some, score)]

        found = [row for rows in side_by_side(best_of, [places[i : i + _PLACES] for i in range(0, len(places), _PLACES)]) for row in rows]
        found.sort(key=lambda row: -row[0])
        chosen: list[Term] = []
        of_kind: dict[str, int] = {}
        for _, term in found:
            if len(chosen) < _TOP or of_kind.get(term.kind, 0) < 2:
                chosen.append(term)
                of_kind[term.kind] = of_kind.get(term.kind, 0) + 1
        return [Candidate(*row, self.x) for row in side_by_side(self._refined, chosen)]

    def slopes(self, terms: Sequence[Term]) -> Array:
        """Weighted rows (responses, rows, n) by the size of each term, at size zero."""
        state, w, forward = self.state, self.w, self.case.forward
        if isinstance(state, ScannableModes):
            return self.problem.rows(state.slopes(terms)) * self.weights
        values = np.zeros((*state.h.shape, len(terms)), complex)
        for number, term in enumerate(terms):
            if term.structural:
                b = list(term.places)
                unit = added(term.moved((0.0, *term.values[1:])), w, self.case.band)
                values[..., number] = state.measured(-state.columns[:, :, b] @ (unit @ state.structure[:, b]))
                continue
            by_value = (-1j * w if term.kind.endswith("_delay") else np.ones(w.size))[:, None, None]
            mine = forward.references == term.places[0] if term.definition.group == "force" else (state.order == term.places[0])[:, None]
            sign = -1 if term.definition.group == "force" else 1
            values[..., number] = sign * by_value * state.h * mine
        return self.problem.rows(values) * self.weights

    def by_slopes(self, terms: Sequence[Term], r: Array | float = 0.0, rq: Array | float = 0.0) -> list[tuple[float, float]]:
        """Information of the size of each term, and the gradient of residuals r (whitened: rq) by it, with all unknowns free."""

        def of(some: Sequence[Term]) -> list[tuple[float, float]]:
            rows = self.slopes(some)
            along = self.whitened(rows)
            information = np.sum(rows**2, (0, 1)) - np.sum(along**2, 0)
            gradient = np.sum(rows * r, (0, 1)) - np.sum(along * rq, 0)
            return list(zip(information.tolist(), gradient.tolist(), strict=True))

        return [row for part in side_by_side(of, [terms[i : i + _AT_ONCE] for i in range(0, len(terms), _AT_ONCE)]) for row in part]

    def _by_slope(self, places: Sequence[Term], r: Array, rq: Array, none: float, instead: Term | None = None) -> list[Candidate]:
        """Of residuals r (whitened: rq), or of what the effect does in whose place others are to be."""
        case = self.case
        out: list[tuple[float, Term, float, Term]] = []
        places = [p for p in places if p.definition.parameters and not _of_the_whole(p)]
        terms = [t for p in places for t in grid(case, p)]
        if instead is not None:
            terms += [p.moved((0.0, *instead.values[1:])) for p in places if p.kind == instead.kind and p.values[1:]]
        for term, (information, gradient) in zip(terms, self.by_slopes(terms, r, rq), strict=True):
            if not information > 0:
                continue
            value, there, size = _of_slope(case, term, information, gradient)
            if there is not None:
                out.append((none + value, there, size, term))
        out.sort(key=lambda row: -row[0])
        kept: list[tuple[float, Term, float, Term]] = []
        for row in out:
            same = [k for k in kept if k[1].key == row[1].key]
            if row[1].kind == "tuned_absorber":
                same = [k for k in same if abs(k[1].values[1] - row[1].values[1]) < _OTHER_FREQUENCY]
            if not same and len(kept) < _SLOPES:
                kept.append(row)
        along = self.whitened(self.slopes([term for *_, term in kept])).T if kept else ()
        given = 0.0 if instead is None else rq[:, 0]
        return [Candidate(value, there, self._start(size * one - given)) for (value, there, size, _), one in zip(kept, along, strict=True)]

    def _start(self, along: Array) -> Point:
        """The unknowns less what the slope of an effect takes over from them; the values of the others stay."""
        s = len(self.factor.lower)
        blocks, k, _ = self.factor.inverse.shape
        first = solve_triangular(self.factor.lower, along[:s], lower=True, trans="T", check_finite=False)
        second = np.swapaxes(self.factor.inverse, 1, 2) @ (along[s:].reshape(blocks, k, 1) - (self.factor.across @ first)[..., None])
        values = slice(self.problem.values_at, self.problem.values_at + self.problem.n_values)
        first[values] = 0
        step = Step(first, self.problem.by_dof(second[..., 0]))
        return self.problem.point(self.packed + step * -1)

    def _refined(self, term: Term) -> tuple[float, Term]:
        """The best values of a candidate and its evidence, everything else free at first order."""
        mean, std = self.case.prior(term)
        p, damping = np.array(term.values), 1e-3

        def at(p: Array) -> tuple[Array, Array, float, Term]:
            there = term.moved(p)
            r = self.residuals([there])
            rq = self.whitened(r)
            return r, rq, 0.5 * float(np.sum(r**2) - np.sum(rq**2)) - self.case.log_prior(there), there

        r, rq, cost, now = at(p)
        hessian = np.zeros((p.size, p.size))
        linear = term.kind.endswith("_delay")
        for _ in range(8 if p.size else 0):
            step = 1e-7 if linear else 1e-4
            slopes = np.concatenate([(r - self.residuals([term.moved(p + step * unit)])) / step for unit in np.eye(p.size)], -1)
            along = self.whitened(slopes)
            hessian = np.tensordot(slopes, slopes, ((0, 1), (0, 1))) - along.T @ along
            gradient = np.tensordot(slopes, r[..., 0], ((0, 1), (0, 1))) - along.T @ rq[:, 0] - (p - mean) / std**2
            for _ in range(5):
                move = np.linalg.solve(hessian * (1 + damping * np.eye(p.size)) + np.diag(1 / std**2), gradient)
                if not linear:
                    move *= min(1, 0.5 / np.abs(move).max())
                after = at(p + move)
                if after[2] < cost:
                    break
                damping *= 10
            else:
                break
            gain, p, damping = cost - after[2], p + move, max(damping / 10, 1e-6)
            r, rq, cost, now = after
            if gain < 0.05:
                break
        evidence = -cost
        if p.size:
            evidence += 0.5 * p.size * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(hessian + np.diag(1 / std**2))[1]
        return float(evidence), now


def grid(case: Case, place: Term) -> list[Term]:
    """A kind at a place with values of its parameters after the first."""
    means, stds = (v[1:] for v in case.prior(place))
    further: list[tuple[float, ...]] = [()]
    if place.kind == "tuned_absorber":
        low, high = np.log(case.band)
        further = [(float(f), float(z)) for f in np.linspace(low, high, case.lines.frequencies) for z in np.log(_DAMPING)]
    elif means.size:
        further = [tuple(float(v) for v in row) for row in np.stack([means - stds, means, means + stds])]
    return [place.moved((0.0, *values)) for values in further]


def _of_slope(case: Case, term: Term, information: float, gradient: float) -> tuple[float, Term | None, float]:
    """Evidence over none of a term whose response is linear in its size, the term, and its size; None where no such size can be."""
    mean, std = (float(v[0]) for v in case.prior(term))
    size = gradient / information
    if term.kind.endswith(("_gain", "_delay")):
        size = gradient / (information + std**-2)
        there = term.moved((size,))
        at_zero = case.log_prior(term) + 0.5 * np.log(2 * np.pi) + np.log(std)
        return float(0.5 * gradient * size + at_zero - 0.5 * np.log(1 + information * std**2)), there, size
    sign = int(np.sign(size))
    signed = term.definition.removable or term.definition.coordinates == "separate"
    log = float(np.log(abs(size) + 1e-300))
    if abs(log - mean) > 2 * std + 1 or (sign < 0 and not signed):
        return -np.inf, None, 0.0
    there = replace(term.moved((log, *term.values[1:])), sign=sign)
    value = 0.5 * gradient**2 / information + case.log_prior(there)
    value += 0.5 * np.log(2 * np.pi) - 0.5 * np.log(information * size**2 + std**-2)
    # of further values only their prior is known here: they are taken to be told as well as the size
    value += 0.5 * (len(term.values) - 1) * (np.log(2 * np.pi) - np.log(information * size**2))
    return float(value), there, size


def _best_of_each(rows: Sequence[Candidate]) -> list[Candidate]:
    best: dict[tuple[object, ...], Candidate] = {}
    for row in rows:
        key: tuple[object, ...] = row.term.key
        if row.term.kind == "tuned_absorber":
            key = (*key, round(row.term.values[1], 1))
        if key not in best or row.evidence > best[key].evidence:
            best[key] = row
    return sorted(best.values(), key=lambda row: -row.evidence)


def without_rest(case: Case, terms: Sequence[Term], places: tuple[int, ...]) -> Array:
    """Values of ``outside`` that take away what residual masses give places."""

    def given(row: Outside) -> float:
        below = case.between.below
        if not (row.below and row.place in places):
            return 0.0
        return float(case.idle.phi[row.place, below] @ case.idle.phi[row.other, below])

    return np.array([-given(row) / row.spread for row in case.forward.outside(terms)])


Say = Callable[[str], None]
