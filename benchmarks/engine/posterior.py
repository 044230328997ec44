"""One state: idle parameters, nuisance, effects and a discrepancy; its Laplace evidence, the way to it, and its validation lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from idle import Idle
from kinds import Effect, moved
from lines import CORRELATED
from model import Case
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dsyrk

LEAST, MOST = 5e-4, 1.0  # discrepancy, as a share of the level
STEP = 0.7  # of a value on its search scale, at most
APPROACH = (0.1, 0.05, 0.02)  # discrepancies of the robust way to a state
FIXED_SPREADS = ("force", "force_slope", "force_corner", "stiffness", "late", "damping_whole")  # too few numbers to estimate from
REST_LINES, REST_ALPHA = 160, 0.01
"""Lines at rest; discrepancy there from which the idle model is fitted again: three cases with real modes left 0.05 %, three with complex
ones 10 to 18 %."""
PRIOR_COUNT, SPREAD_FACTOR = 5.0, (0.3, 3.0)


@dataclass
class State:
    """A fitted state; ``x`` holds z, d, u and the effects' values, ``factor`` the Cholesky factor of its information."""

    effects: list[Effect]
    x: np.ndarray
    alpha: float
    log_evidence: float
    factor: np.ndarray
    case: Case = field(repr=False)
    scanned: bool = False
    robustly: bool = False

    @property
    def key(self) -> tuple:
        return tuple(sorted(e.key for e in self.effects))

    @property
    def z(self) -> np.ndarray:
        return self.x[: self.case.n_z]

    @property
    def d(self) -> np.ndarray:
        return self.x[self.case.n_z : self.case.n_z + self.case.n_d]

    @property
    def u(self) -> np.ndarray:
        first = self.case.n_z + self.case.n_d
        return self.x[first : first + len(self.case.outside(self.effects))]

    @property
    def fixed(self) -> int:
        """Number of values before those of the effects."""
        return self.x.size - sum(len(e.values) for e in self.effects)

    def carried(self, effects: list[Effect]) -> np.ndarray:
        """Its u where other effects act: the same values at the same places, zero at new ones."""
        known = {(o.place, o.other, o.below): v for o, v in zip(self.case.outside(self.effects), self.u, strict=True)}
        return np.array([known.get((o.place, o.other, o.below), 0.0) for o in self.case.outside(effects)])

    @property
    def covariance(self) -> np.ndarray:
        """Of the effects' values on the search scale."""
        first = self.fixed
        return np.linalg.inv(np.tril(self.factor) @ np.tril(self.factor).T)[first:, first:]

    def std(self, part: str) -> np.ndarray:
        """Posterior standard deviations of a part of d, in its spreads."""
        inverse = solve_triangular(np.tril(self.factor), np.eye(self.x.size), lower=True)
        return np.sqrt(np.sum(inverse**2, axis=0))[self.case.n_z :][self.case.parts[part]]


@dataclass
class Problem:
    """Fit lines of a case with some effects."""

    case: Case
    effects: list[Effect]
    at: np.ndarray

    def __post_init__(self) -> None:
        case = self.case
        self.n_u = len(case.outside(self.effects))
        self.fixed = case.n_z + case.n_d + self.n_u
        means, stds = zip(*(case.prior(e) for e in self.effects), strict=True) if self.effects else ((), ())
        self.mean = np.concatenate([np.zeros(self.fixed), *means])
        self.precision = np.concatenate([np.ones(self.fixed), *(1 / s**2 for s in stds)])

    def start(self, z: np.ndarray | None, d: np.ndarray | None, u: np.ndarray | None) -> np.ndarray:
        z = np.zeros(self.case.n_z) if z is None else z
        d = np.zeros(self.case.n_d) if d is None else d
        u = np.zeros(self.n_u) if u is None else u
        return np.concatenate([z, d, u, *(np.array(e.values) for e in self.effects)])

    def with_values(self, x: np.ndarray) -> list[Effect]:
        return moved(self.effects, x[self.fixed :])

    def predict(self, x: np.ndarray, derivatives: bool = True):
        z, d, u, _ = self.split(x)
        return self.case.predict(z, d, u, self.with_values(x), self.at, derivatives=derivatives)

    def split(self, x: np.ndarray) -> list[np.ndarray]:
        """z, d, u, values."""
        n = self.case.n_z
        return np.split(x, [n, n + self.case.n_d, self.fixed])

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Values (lines, sensors, references, …) as independent real ones, of variance ½ each without a discrepancy."""
        basis = self.case.lines.basis(self.at)[0]
        flat = np.moveaxis(values.reshape(self.at.size, basis.shape[0], -1), 0, 1)
        both = np.concatenate([flat.real, flat.imag], -1)
        out = (basis @ both).reshape(*basis.shape[:2], 2, -1)
        return out.reshape(-1, *values.shape[3:])

    def variance(self, alpha: float) -> np.ndarray:
        """Of the rows, times two."""
        return np.repeat(1 + alpha**2 * self.case.lines.basis(self.at)[1].ravel(), 2)

    def penalty(self, x: np.ndarray) -> float:
        return float(0.5 * x[: self.fixed] @ x[: self.fixed] - sum(self.case.log_prior(e) for e in self.with_values(x)))

    def residual(self, h: np.ndarray) -> np.ndarray:
        return self.rows(self.case.lines.h[self.at] - h)

    def objective(self, h: np.ndarray, x: np.ndarray, variance: np.ndarray) -> float:
        return float(np.sum(self.residual(h) ** 2 / variance)) + self.penalty(x)

    def limited(self, step: np.ndarray) -> np.ndarray:
        return step * min(1.0, STEP / max(float(np.abs(step[self.fixed :]).max(initial=0.0)), 1e-9))


def linear_evidence(problem: Problem, residual: np.ndarray, jacobian: np.ndarray, x: np.ndarray, alpha: float):
    """Log evidence of the model r(x + s) = r − J s, where its maximum lies, and the Cholesky factor of its information."""
    variance = problem.variance(alpha)
    weights = np.sqrt(2 / variance)
    j, r = jacobian * weights[:, None], residual * weights
    information = dsyrk(1.0, j, trans=1, lower=1)
    information[np.diag_indices_from(information)] += problem.precision
    factor = cholesky(information, lower=True, check_finite=False)
    step = cho_solve((factor, True), j.T @ r - problem.precision * (x - problem.mean), check_finite=False)
    left, best = r - j @ step, x + step
    values = x.size - problem.fixed
    evidence = -0.5 * left @ left - problem.penalty(best) - np.sum(np.log(np.diag(factor))) + 0.5 * values * np.log(2 * np.pi)
    return float(evidence - 0.5 * np.sum(np.log(variance))), best, factor


def likely_alpha(problem: Problem, residual: np.ndarray, jacobian: np.ndarray, factor: np.ndarray, now: float) -> float:
    """Discrepancy that residuals and posterior variance of the prediction ask for (expectation maximisation), faster downwards."""
    # a quarter of the values tells it as well; those of each pair are in the order of their part of the discrepancy
    some = np.arange(0, residual.size // 2, 4)
    both = np.stack([2 * some, 2 * some + 1], 1)
    spread = solve_triangular(factor, jacobian[both.ravel()].T, lower=True, check_finite=False)
    power = np.sum(residual[both] ** 2, axis=1) + np.sum(spread**2, axis=0).reshape(-1, 2).sum(1)
    grid = np.exp(np.linspace(np.log(LEAST), 0, 80))
    variance = 1 + grid**2 * problem.case.lines.basis(problem.at)[1].reshape(-1, 1)[some]
    new = float(grid[np.argmin((power[:, None] / variance + np.log(variance)).sum(0))])
    return new * min(1, new / now) if new < now else new


def fit(
    case: Case,
    effects: list[Effect],
    z: np.ndarray | None = None,
    d: np.ndarray | None = None,
    u: np.ndarray | None = None,
    alpha: float = 0.1,
    turns: int = 18,
    floor: float = -np.inf,
) -> State:
    """Damped Gauss–Newton over z, d and values, in the metric of the prior; the discrepancy between the turns, fivefold a turn at most."""
    problem = Problem(case, effects, case.lines.fit)
    x, damping, done = problem.start(z, d, u), 0.0, False
    scale = 1 / np.sqrt(problem.precision)
    for turn in range(turns):
        prediction = problem.predict(x)
        jacobian, residual = problem.rows(prediction.jacobian), problem.residual(prediction.h)
        evidence, linear, factor = linear_evidence(problem, residual, jacobian, x, alpha)
        if done or (turn >= 2 and evidence < floor - 60 * (1 if turn > 3 else 10)):
            break
        if turn == 0 and alpha > 0.02:  # nothing is known of the discrepancy yet: from the linear model
            alpha = max(likely_alpha(problem, residual - jacobian @ (linear - x), jacobian, factor, alpha), alpha / 4)
            evidence, linear, factor = linear_evidence(problem, residual, jacobian, x, alpha)
        variance = problem.variance(alpha)
        start = now = problem.objective(prediction.h, x, variance)
        left = residual
        for chord in range(6):
            gradient = jacobian.T @ (left * (2 / variance)) - problem.precision * (x - problem.mean)
            new, mu = np.inf, 0.0
            if not damping:
                there = x + problem.limited(cho_solve((factor, True), gradient, check_finite=False))
                h = problem.predict(there, False).h
                new = problem.objective(h, there, variance)
            if chord == 0 and not new < now:
                lower = np.tril(factor)
                values, vectors = np.linalg.eigh((lower @ lower.T) * scale[:, None] * scale)
                turned = vectors.T @ (scale * gradient)
                for mu in [(damping or 1e-2) * 10.0**i for i in range(12)]:
                    there = x + problem.limited(scale * (vectors @ (turned / (values + mu))))
                    h = problem.predict(there, False).h
                    new = problem.objective(h, there, variance)
                    if new < now:
                        break
            if not new < now:
                break
            if chord == 0:
                damping = 0.0 if mu <= 1e-2 else mu / 10
            gain, now, x = now - new, new, there
            left = problem.residual(h)
            if gain < 0.02 * max(1, 0.02 * now) or mu > 0:
                break
        before = alpha
        alpha = min(max(likely_alpha(problem, left, jacobian, factor, alpha), alpha / 5, LEAST), MOST)
        change = abs(np.log(alpha / before))
        done = turn == turns - 2 or (start - now < 0.3 and change < 0.1)
        done = done or (start - now < 3e-3 * now and alpha > 0.02 and change < 0.2 and turn > 1)
    return State(problem.with_values(x), x, alpha, evidence, factor, case)


def flat(values: np.ndarray) -> np.ndarray:
    """Real over imaginary parts of values (lines, sensors, references, …), one row a value."""
    rows = values.reshape(-1, *values.shape[3:])
    return np.concatenate([rows.real, rows.imag])


def approach(
    case: Case,
    effects: list[Effect],
    z: np.ndarray | None = None,
    d: np.ndarray | None = None,
    u: np.ndarray | None = None,
    turns: int = 4,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, list[Effect]]:
    """Robust way from a start to the neighbourhood of a fit: Student weights, damped steps. Cost, z, d, u, effects."""
    problem = Problem(case, effects, case.lines.fit[::2])
    x, damping = problem.start(z, d, u), 1.0
    scale = 1 / np.sqrt(problem.precision)
    measured = case.lines.h[problem.at]
    for alpha in APPROACH:
        noise = CORRELATED / 2 * case.lines.variance[problem.at] + alpha**2 * case.lines.level[problem.at] ** 2

        def cost(h: np.ndarray, x: np.ndarray, noise: np.ndarray = noise) -> float:
            return float(np.sum(np.log1p(np.abs(measured - h) ** 2 / noise))) + problem.penalty(x)

        for _ in range(turns):
            prediction = problem.predict(x)
            residual = measured - prediction.h
            weights = np.tile(np.sqrt(2 / (noise + np.abs(residual) ** 2)).ravel(), 2)
            jacobian = flat(prediction.jacobian) * weights[:, None]
            matrix = dsyrk(1.0, jacobian * scale, trans=1, lower=1)
            matrix = np.tril(matrix) + np.tril(matrix, -1).T + np.eye(x.size)
            values, vectors = np.linalg.eigh(matrix)
            right = jacobian.T @ (flat(residual[..., None])[:, 0] * weights)
            gradient = vectors.T @ (scale * (right - problem.precision * (x - problem.mean)))
            now = cost(prediction.h, x)
            for _ in range(9):
                there = x + problem.limited(scale * (vectors @ (gradient / (values + damping))))
                new = cost(problem.predict(there, False).h, there)
                if new < now:
                    break
                damping = max(damping, 0.1) * 10
            else:
                break
            x, damping = there, damping / 10
            if now - new < 1e-3 * abs(now):
                break
    z, d, u, _ = problem.split(x)
    return cost(problem.predict(x, False).h, x), z, d, u, problem.with_values(x)


def update_spreads(case: Case, state: State) -> tuple[np.ndarray, dict[str, list[float]]]:
    """One turn of empirical Bayes over the spreads of the nuisance; d in the new ones, and their factors."""
    d, factors = state.d.copy(), {}
    inverse = solve_triangular(np.tril(state.factor), np.eye(state.x.size), lower=True)
    power = d**2 + np.sum(inverse**2, axis=0)[case.n_z : case.n_z + case.n_d]
    for name, groups in case.groups.items():
        if name in FIXED_SPREADS or not groups[0].size:
            continue
        every = np.concatenate(groups)
        common = (power[every].sum() + PRIOR_COUNT) / (every.size + PRIOR_COUNT)
        for group in groups:  # the spread of a channel is drawn to that of all
            factor = float(np.clip(np.sqrt((power[group].sum() + PRIOR_COUNT * common) / (group.size + PRIOR_COUNT)), *SPREAD_FACTOR))
            case.spread[group] *= factor
            d[group] /= factor
            factors.setdefault(name, []).append(round(factor, 2))
    return d, factors


def on_validation_lines(case: Case, state: State) -> tuple[float, float]:
    """Reduced chi-square of the validation lines under noise, discrepancy and posterior, per independent value; their error in dB (rms)."""
    problem = Problem(case, state.effects, case.lines.validation)
    prediction = problem.predict(state.x)
    weights = np.sqrt(2 / problem.variance(state.alpha))
    jacobian, residual = problem.rows(prediction.jacobian) * weights[:, None], problem.residual(prediction.h) * weights
    spread = solve_triangular(np.tril(state.factor), jacobian.T, lower=True)
    along = spread @ residual
    chi = residual @ residual - along @ np.linalg.solve(np.eye(along.size) + spread @ spread.T, along)
    db = 20 * np.log10(np.abs(prediction.h) / np.abs(case.lines.h[problem.at]))
    return float(chi / residual.size), float(np.sqrt(np.mean(db**2)))


def at_rest(idle: Idle, frf: Any, band: tuple[float, float]) -> tuple[Idle, State]:
    """The idle model on the FRFs at rest; where they differ, fitted to them again with what makes modes complex."""
    as_told = fit(Case(idle, frf, band, spreads={}, number=REST_LINES), [], alpha=0.02)
    if as_told.alpha < REST_ALPHA:
        return idle, as_told
    case = Case(idle.loose(), frf, band, spreads={}, number=REST_LINES)
    _, z, d, u, _ = approach(case, [])
    state = fit(case, [], z, d, u, 0.02)
    inverse = solve_triangular(np.tril(state.factor), np.eye(state.x.size), lower=True)
    root = case.root @ inverse.T
    return idle.moved(case.root @ state.z, root @ root.T), state


def names(case: Case, effects: Sequence[Effect]) -> list[str]:
    """The effects in words."""
    return [f"{e.kind}@{','.join(str(case.dofs[i]) for i in e.places)}" + ("" if e.size is None else f"={e.size:.6g}") for e in effects]
