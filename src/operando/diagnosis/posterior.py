"""One state: unknowns, effects and a discrepancy; its Laplace evidence, the way to it, and its validation lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.diagnosis.arrow import Factor, Information
from operando.diagnosis.case import Case
from operando.diagnosis.criteria import (
    CORRELATED_LINES,
    EXPLAINED,
    FIT_LINES,
    LEAST_DISCREPANCY,
    MOST_CHI_SQUARE,
    MOST_DISCREPANCY,
    REST_DISCREPANCY,
    REST_LINES,
)
from operando.diagnosis.descent import Descent
from operando.diagnosis.forward import Point
from operando.diagnosis.idle import Idle
from operando.diagnosis.idle_lines import FittedAtRest
from operando.diagnosis.poles import with_straight_poles
from operando.diagnosis.problem import Problem, Step
from operando.diagnosis.products import Rows
from operando.diagnosis.slopes import Slopes
from operando.diagnosis.spreads import WIDER, likely_spreads, log_prior, rescaled
from operando.diagnosis.terms import Term

Array = NDArray[Any]

_TURNS = 18  # of a fit; twice as many where spreads are estimated, and again where it goes on closely
_GAIN = 0.3  # nats that a turn takes off the objective, below which a fit ends; a tenth of them closely
_COARSE = 8  # steps of the grid of discrepancies (a factor of 2.2) that are skipped at first
_APPROACH = (0.1, 0.05, 0.02)  # discrepancies of the robust way to a state
NEAR = 2.0  # nats that a turn of that way takes off its cost, below which it ends: a fit goes on, and ways are told apart by ten times that
_SETTLED = 1.0  # nats that a turn takes off the objective, below which its unknowns tell how wide their spreads are
_SPREADS_AT = 0.2  # nats that a further turn promises, below which spreads are estimated
_STEP = 0.3  # nats that half of the discrepancy must add
_OUTSIDE = 3  # turns in a row that end with values of an effect out of their range, after which they do not come back
_FAR = 60.0  # nats below the best state at which a fit is left where a turn does not take a quarter of them


@dataclass
class State:
    """A fitted state."""

    x: Point
    alpha: float
    log_evidence: float
    factor: Factor
    problem: Problem = field(repr=False)
    sizes: Mapping[int, tuple[float, Array]] = field(default_factory=dict)  # variance of sizes held, and how all values follow each
    scanned: bool = False
    robustly: bool = False
    own_spreads: State | None = field(default=None, init=False, repr=False)  # what a fit from here ends with that estimates its spreads
    likely: tuple[float, float | None] | None = field(default=None, init=False, repr=False)  # its discrepancy, once it is estimated
    least_change: float | None = field(default=None, init=False, repr=False)  # of the FRFs by one of its effects, once it is asked for
    _validated: tuple[float, float] | None = field(default=None, init=False, repr=False)
    _fitted: float | None = field(default=None, init=False, repr=False)

    @property
    def case(self) -> Case:
        return self.problem.case

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.x.terms

    @property
    def key(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        return tuple(sorted(t.key for t in self.terms))

    @property
    def covariance(self) -> Array:
        """Of the effects' values on the search scale."""
        first, size = self.problem.values_at, self.problem.n_values
        out = self.factor.shared_covariance(first)[:size, :size]
        for variance, moves in self.sizes.values():
            out = out + variance * np.outer(moves, moves)
        return out

    def carried(self, terms: Sequence[Term], x: Point | None = None) -> Point:
        """Its unknowns where other effects act: the same u at the same places, zero at new ones."""
        x = x or self.x
        forward = self.case.forward
        known = {(o.place, o.other, o.below): v for o, v in zip(forward.outside(x.terms), x.u, strict=True)}
        u = np.array([known.get((o.place, o.other, o.below), 0.0) for o in forward.outside(terms)])
        return replace(x, u=u, terms=tuple(terms))

    def std(self) -> tuple[Array, Array]:
        """Posterior standard deviations of d and of the own unknowns of each DOF, in units of their priors."""
        shared, own = self.factor.variances()
        forward = self.case.forward
        out = np.ones((forward.n_dofs, forward.n_own))
        out[self.problem.order] = np.sqrt(own)
        for dof, at, among_shared in self.problem.reaching:
            out[dof, at] = np.sqrt(shared[among_shared])
        return np.sqrt(shared[forward.n_g : forward.n_g + forward.n_d]), out

    def differences(self) -> Iterator[tuple[str, bool, Array, Array, tuple[Any, ...]]]:
        """Groups of what differs between the days: name, shared or own, values and standard deviations in spreads, and where."""
        std_d, std_own = self.std()
        own, std_own = (v[:, self.case.forward.n_shape :] for v in (self.x.own, std_own))
        for name, shared, where in self.case.between.groups:
            values, std = (self.x.d, std_d) if shared else (own, std_own)
            yield name, shared, values[where].ravel(), std[where].ravel(), where


def unfitted(case: Case, x: Point, alpha: float) -> State:
    """A point as a state, with the factor of the model that is linear about it and no evidence."""
    lines = case.lines
    problem = Problem(case, x.terms, lines.fit[:: lines.stride], lines.stride)
    slopes, _ = problem.derived(problem.packed(x))
    factor = Factor.of(problem.information(slopes, alpha), problem.precision, problem.own_precision)
    return State(x, alpha, -np.inf, factor, problem)


def linear_evidence(
    problem: Problem, residual: Array, slopes: Slopes, x: Step, alpha: float, information: Information | None = None
) -> tuple[float, Step, Factor]:
    """Log evidence of the model r(x + s) = r − J s, where its maximum lies, and its factor (of an information made here if not given)."""
    weights = problem.weights(alpha)
    if information is None:
        information = problem.information(slopes, alpha)
    factor = Factor.of(information, problem.precision, problem.own_precision)
    step = problem.solved(factor, problem.gradient(slopes, residual * weights, x))
    left = residual - problem.spread(slopes, step)
    evidence = -0.5 * np.sum(left**2 * weights) - problem.penalty_of(x, step) - factor.half_log_determinant
    evidence += 0.5 * problem.n_values * np.log(2 * np.pi) - 0.5 * np.sum(np.log(problem.variance(alpha)))
    return float(evidence), x + step, factor


def likely_alpha(problem: Problem, residual: Array, slopes: Slopes, factor: Factor, now: float) -> float:
    """Discrepancy that residuals and posterior variance of the prediction ask for (expectation maximisation), faster downwards."""
    some = problem.case.lines.telling(residual.shape[1])
    power = residual[:, some] ** 2 + slopes.variance(factor, some)
    spread = problem.case.lines.spread(problem.at)[:, some]
    grid = np.exp(np.linspace(np.log(LEAST_DISCREPANCY), 0, 80))

    def least(some: Array) -> int:
        variances = (1 + grid[i] ** 2 * spread for i in some)
        return int(some[np.argmin([np.sum(power / v + 0.5 * np.log(v)) for v in variances])])

    rough = least(np.arange(0, grid.size, _COARSE))  # between two of these it has one minimum: λ of the rows is spread over decades
    new = float(grid[least(np.arange(max(0, rough - _COARSE + 1), min(grid.size, rough + _COARSE)))])
    return new * min(1, new / now) if new < now else new


def most_gain(problem: Problem, residual: Array, slopes: Slopes, x: Step, alpha: float, lower: float, factor: Factor) -> float:
    """What a lower discrepancy can add to the evidence of a linear model at most; ``factor`` is of the one that it has.

    With weights V of the squares, W at the lower one, and r and Λ where the model has its maximum, it adds ½ Σ (log(W/V) − (W − V) r²)
    − ½ log |Λ'Λ⁻¹| + ½ gᵀ Λ'⁻¹ g with g = Jᵀ (W − V) r; and Λ' is no less than Λ, for no weight falls.
    """
    now, then = problem.weights(alpha), problem.weights(lower)
    step = problem.solved(factor, problem.gradient(slopes, residual * now, x))
    left = residual - problem.spread(slopes, step)
    along = problem.projected(slopes, left * (then - now))
    a, b = factor.whitened(along.shared[:, None], along.own[..., None])
    return 0.5 * float(np.sum(np.log(then / now) - (then - now) * left**2) + np.sum(a**2) + np.sum(b**2))


def fit(
    case: Case,
    start: Point,
    alpha: float = 0.1,
    floor: float = -np.inf,
    own_spreads: bool = False,
    closely: bool = False,
    in_range: bool = False,
    enough: float = 0.0,
) -> State:
    """The most probable unknowns near a start; discrepancy and spreads between the turns, by the evidence.

    Parameters
    ----------
    case : Case
    start : Point
    alpha : float
        Discrepancy to start from; it changes fivefold a turn at most.
    floor : float
        Log evidence of a state that this one has to come near to; left off where it plainly does not.
    own_spreads : bool
        Whether the spreads of what differs between the days are estimated with it.
    closely : bool
        To the end of the valley that products of unknowns make: on its way there the evidence still falls by ten nats.
    in_range : bool
        Whether a fit ends once values of an effect have left their range for some turns: it is an effect of another kind.
    enough : float
        Discrepancy below which nothing more is asked of a fit.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a start leads to numbers that cannot be.
    """
    closely = closely and case.idle_lines is None  # with their rows a fit goes along the valley: 3 nats in 50 more turns
    turns = _TURNS * (4 if closely else 2 if own_spreads else 1)
    least, promised_least = (0.1 * v if closely else v for v in (_GAIN, _SPREADS_AT))
    problem, descent = Problem(case, start.terms, case.lines.fit), Descent()
    x, done, reached = problem.packed(start), False, -np.inf
    last, most = np.zeros(case.between.log_factors.size), WIDER  # of the spreads: the step before, and how far the next may go
    outside = 0
    for turn in range(turns):
        slopes, residual = problem.derived(x)
        information = problem.information(slopes, alpha)
        evidence, linear, factor = linear_evidence(problem, residual, slopes, x, alpha, information)
        if done or outside == _OUTSIDE or (turn >= 2 and evidence < floor - _FAR and evidence - reached < 0.25 * (floor - evidence)):
            break
        reached = evidence
        if turn == 0 and alpha > 0.02:  # nothing is known of the discrepancy yet: from the linear model
            left = residual - problem.spread(slopes, linear + x * -1)
            alpha = max(likely_alpha(problem, left, slopes, factor, alpha), alpha / 4)
            information = problem.information(slopes, alpha)
            evidence, linear, factor = linear_evidence(problem, residual, slopes, x, alpha, information)
        x, left, now, gain = descent.turn(problem, x, (slopes, residual), alpha, factor, information)
        before = alpha
        alpha = min(max(likely_alpha(problem, left, slopes, factor, alpha), alpha / 5, LEAST_DISCREPANCY), MOST_DISCREPANCY)
        change = abs(np.log(alpha / before))
        outside = outside + 1 if in_range and not all(t.within_range(case.band) for t in problem.point(x).terms) else 0
        done = turn == turns - 2 or (change < 0.1 and (gain < least or alpha < enough))
        done = done or (not closely and gain < 3e-3 * now and alpha > 0.02 and change < 0.2 and turn > 1)
        if own_spreads and gain < _SETTLED and turn < turns - 2:
            by, promised = likely_spreads(problem, x, factor, most)
            if promised > promised_least:
                most = min(most * (0.5 if last @ by < 0 else 1.5), WIDER)  # too far, or on its way
                last = by
                (problem, x), done = rescaled(problem, x, by), False
                continue
        # expectation maximisation is slow downwards where little is known: a step along the evidence itself
        lower = alpha / 2
        if done and turn < turns - 2 and lower >= LEAST_DISCREPANCY and most_gain(problem, left, slopes, x, alpha, lower, factor) > _STEP:
            here, there = (linear_evidence(problem, left, slopes, x, a)[0] for a in (alpha, lower))
            if there > here + _STEP:
                alpha, done = lower, False
    return State(problem.point(x), alpha, evidence + log_prior(problem), factor, problem)


def with_discrepancy(state: State, alpha: float) -> State:
    """The same state where the discrepancy is known from elsewhere: its unknowns, and what they leave open, under it."""
    problem = state.problem

    x = problem.packed(state.x)
    slopes, residual = problem.derived(x)
    information = problem.information(slopes, alpha)
    factor = Factor.of(information, problem.precision, problem.own_precision)
    x = Descent().turn(problem, x, (slopes, residual), alpha, factor, information)[0]
    slopes, residual = problem.derived(x)
    factor = linear_evidence(problem, residual, slopes, x, alpha)[2]
    return replace(state, x=problem.point(x), alpha=alpha, factor=factor)


@np.errstate(all="ignore")  # far from the data a size may be beyond all numbers: its cost is infinite
def approach(case: Case, start: Point, turns: int = 4) -> tuple[float, Point]:
    """Robust way from a start to the neighbourhood of a fit, on few lines, then more: Student weights, damped steps. Cost and end."""
    lines, damping, now = case.lines, 1.0, np.inf
    for alpha in _APPROACH:
        problem = Problem(case, start.terms, lines.fit[:: lines.stride if alpha == _APPROACH[-1] else lines.rough], straight=True)
        x = problem.packed(start)
        noise = lines.correlated / 2 * lines.variance[problem.at] + alpha**2 * lines.level[problem.at] ** 2

        def cost(h: Array, x: Step, problem: Problem = problem, noise: Array = noise) -> float:
            return float(np.sum(np.log1p(np.abs(problem.measured - h) ** 2 / noise))) + problem.penalty(x)

        h, now = problem.tried(x, cost)
        if not np.isfinite(now):
            return np.inf, start  # no such structure can be
        for _ in range(turns):
            residual = problem.measured - h
            rows = Rows(weights=np.sqrt(2 / (noise + np.abs(residual) ** 2)))
            try:
                slopes = case.forward.derived(problem.point(x), problem.w, rows)[1]
                information = slopes.information()
                factor = Factor.of(information, (1 + damping) * problem.precision, (1 + damping) * problem.own_precision)
            except np.linalg.LinAlgError:  # two poles in one, or derivatives that are no numbers
                return np.inf, start
            gradient = problem.gradient(slopes, rows.flat(residual[..., None])[..., 0], x)
            for _ in range(9):
                there = x + problem.limited(problem.solved(factor, gradient))
                ahead, new = problem.tried(there, cost)
                if new < now:
                    break
                damping = max(damping, 0.1) * 10
                factor = Factor.of(information, (1 + damping) * problem.precision, (1 + damping) * problem.own_precision)
            else:
                break
            x, h, damping, gain, now = there, ahead, damping / 10, now - new, new
            if gain < max(NEAR, 1e-3 * abs(now + gain)):
                break
        start = problem.point(x)
    return now, start


def on_validation_lines(state: State) -> tuple[float, float]:
    """Reduced chi-square of the validation lines under noise, discrepancy and posterior, per independent value; their error."""
    if state._validated is None:
        state._validated = left_on(state.case, state.x, state.alpha, state.case.lines.validation)
    return state._validated


def on_fitted_lines(state: State) -> float:
    """Reduced chi-square of the lines fitted, under noise and discrepancy, per value."""
    if state._fitted is None:
        state._fitted = left_on(state.case, state.x, state.alpha, state.case.lines.fit)[0]
    return state._fitted


def leaves_noise(state: State) -> bool:
    """Whether a state leaves no more than noise of the lines it was fitted to, and of those that validate.

    One narrow peak that the model lacks may stand between lines that validate: it is in those that were fitted alone.
    """
    return max(on_validation_lines(state)[0], on_fitted_lines(state)) < MOST_CHI_SQUARE


def left_on(case: Case, x: Point, alpha: float, at: Array) -> tuple[float, float]:
    """What a point leaves of some lines: reduced chi-square per independent value, and rms error (of FRFs in dB).

    Under noise, a discrepancy, and what the fitted lines leave open of the unknowns; of the fitted lines themselves under the first two.
    """
    problem, known_at = Problem(case, x.terms, at, straight=True), case.lines.known
    packed = problem.packed(x)
    root, h = np.sqrt(2 / problem.variance(alpha)), problem.predict(packed, False).h
    residual = problem.residual(h) * root
    chi = np.sum(residual**2)
    if at is not case.lines.fit:
        fitted, weights = Problem(case, x.terms, known_at), root**2
        slopes = problem.derived(packed)[0]
        its, left = fitted.derived(packed)
        known = fitted.information(its, alpha)
        if known_at is not case.lines.fit:  # the point is that of other values: as these alone have it, at first order
            step = fitted.solved(
                Factor.of(known, fitted.precision, fitted.own_precision), fitted.gradient(its, left * fitted.weights(alpha), packed)
            )
            residual = residual - problem.spread(slopes, step) * root
            chi = np.sum(residual**2)
        factor = Factor.of(known + slopes.information(weights), problem.precision, problem.own_precision)
        a, b = factor.whitened(*slopes.along(lambda at: (residual * root)[at, :, None]))
        chi -= np.sum(a**2) + np.sum(b**2)
    return float(chi / (residual.size * case.lines.there.mean())), case.lines.error(h, at)


@dataclass(frozen=True)
class AtRest:
    """The idle model on the FRFs at rest.

    The noise is alike over ``correlated`` neighbouring lines; ``again`` says whether the model was fitted to the FRFs again, with what
    makes modes complex.
    """

    idle: Idle
    state: State
    correlated: float
    again: bool

    @property
    def fitted(self) -> FittedAtRest | None:
        """The fit of what makes modes complex, where one was made."""
        return FittedAtRest(self.state.case.lines, self.state.case.forward, self.state.alpha) if self.again else None


def at_rest(idle: Idle, frf: Frf, band: tuple[float, float], again: bool = False) -> AtRest:
    """The idle model on the FRFs at rest; where they differ, fitted to them again with what makes modes complex.

    A model whose modes are tied is fitted ``again`` in any case: it does not say how well its ties are known.
    """
    if not (idle.tied or again):
        # noise taken for alike where it is not would count as a misfit, so the lines count as independent first
        state = on_idle_frfs(idle, frf, band, FIT_LINES, CORRELATED_LINES, False, REST_DISCREPANCY)
        if state.alpha < REST_DISCREPANCY:
            return AtRest(idle, state, _correlated(state), False)
    loose = idle.loose(np.flatnonzero(idle.driven), band)
    state = on_idle_frfs(loose, frf, band, REST_LINES, CORRELATED_LINES, True)
    correlated = _correlated(state)
    if correlated > 1.5 * CORRELATED_LINES:
        state = on_idle_frfs(loose, frf, band, REST_LINES, correlated, True)
    case = state.case
    factor = state.factor
    own = np.zeros((case.forward.n_dofs, factor.inverse.shape[1], factor.inverse.shape[1]))
    across = np.zeros((case.forward.n_dofs, *factor.across.shape[1:]))
    own[:] = np.eye(own.shape[1])
    own[state.problem.order], across[state.problem.order] = factor.inverse, factor.across
    g = case.forward.n_g
    after = case.idle.moved(state.x.g, state.x.own, Factor(own, across[:, :, :g], factor.lower[:g, :g]))
    explained = state.alpha <= EXPLAINED  # else nothing is found that would need it
    return AtRest(with_straight_poles(after) if explained else after, state, correlated, True)


def on_idle_frfs(
    idle: Idle, frf: Frf, band: tuple[float, float], number: int, correlated: float, robust: bool, enough: float = 0.0
) -> State:
    """A model on so many lines of the FRFs at rest, whose noise is alike over ``correlated`` neighbours; ``robust`` from far away."""
    case = Case(idle, frf, band, spreads={}, number=number, correlated=correlated, between=True)
    start = case.forward.start
    return fit(case, approach(case, start)[1] if robust else start, alpha=0.02, enough=enough)


def _correlated(state: State) -> float:
    """Neighbouring lines whose noise is alike: what a model leaves that does not fit is no noise, and tells nothing of it."""
    if state.alpha > REST_DISCREPANCY:
        return CORRELATED_LINES
    lines = state.case.lines
    return lines.correlation(state.case.forward.predict(state.x, lines.w_all, derivatives=False).h, state.alpha)


def names(case: Case, terms: Sequence[Term]) -> list[str]:
    """Terms in short words, for progress."""
    return [f"{t.kind}@{','.join(case.place(i) for i in t.places)}" + ("" if t.size is None else f"={t.size:.6g}") for t in terms]
