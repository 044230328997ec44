"""One state: idle parameters, nuisance, effects and a discrepancy; its Laplace evidence, the way to it, and its validation lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from kinds import Effect, moved
from model import Case
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dsyrk

LEAST, MOST = 5e-4, 1.0  # discrepancy, as a share of the level
STEP = 0.7  # of a value on its search scale, at most
APPROACH = (0.1, 0.05, 0.02)  # discrepancies of the robust way to a state
FIXED_SPREADS = ("force", "stiffness", "late", "own_above", "own_below", "row_above", "row_below")  # too few numbers to estimate from
PRIOR_COUNT, SPREAD_FACTOR = 5.0, (0.3, 3.0)


@dataclass
class State:
    """A fitted state; ``x`` holds z, d and the effects' values, ``factor`` the Cholesky factor of its information."""

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
    def covariance(self) -> np.ndarray:
        """Of the effects' values on the search scale."""
        first = self.case.n_z + self.case.n_d
        return np.linalg.inv(np.tril(self.factor) @ np.tril(self.factor).T)[first:, first:]

    def std(self, part: str) -> np.ndarray:
        """Posterior standard deviations of a part of d, in its spreads."""
        inverse = solve_triangular(np.tril(self.factor), np.eye(self.x.size), lower=True)
        return np.sqrt(np.sum(inverse**2, axis=0))[self.case.n_z :][self.case.parts[part]]


def real(values: np.ndarray) -> np.ndarray:
    """Real over imaginary parts, one row a value, further axes kept after the first three."""
    flat = values.reshape(-1, *values.shape[3:])
    return np.concatenate([flat.real, flat.imag])


@dataclass
class Problem:
    """Fit lines of a case with some effects."""

    case: Case
    effects: list[Effect]
    at: np.ndarray

    def __post_init__(self) -> None:
        case = self.case
        self.fixed = case.n_z + case.n_d
        means, stds = zip(*(case.prior(e) for e in self.effects), strict=True) if self.effects else ((), ())
        self.mean = np.concatenate([np.zeros(self.fixed), *means])
        self.precision = np.concatenate([np.ones(self.fixed), *(1 / s**2 for s in stds)])

    def start(self, z: np.ndarray | None, d: np.ndarray | None) -> np.ndarray:
        z = np.zeros(self.case.n_z) if z is None else z
        d = np.zeros(self.case.n_d) if d is None else d
        return np.concatenate([z, d, *(np.array(e.values) for e in self.effects)])

    def with_values(self, x: np.ndarray) -> list[Effect]:
        return moved(self.effects, x[self.fixed :])

    def predict(self, x: np.ndarray, derivatives: bool = True):
        n = self.case.n_z
        return self.case.predict(x[:n], x[n : self.fixed], self.with_values(x), self.at, derivatives=derivatives)

    def noise(self, alpha: float) -> np.ndarray:
        case, at = self.case, self.at
        return case.count[at] * (case.variance[at] + alpha**2 * case.level[at] ** 2)

    def penalty(self, x: np.ndarray) -> float:
        return float(0.5 * x[: self.fixed] @ x[: self.fixed] - sum(self.case.log_prior(e) for e in self.with_values(x)))

    def objective(self, h: np.ndarray, x: np.ndarray, noise: np.ndarray) -> float:
        return float(np.sum(np.abs(self.case.h[self.at] - h) ** 2 / noise)) + self.penalty(x)

    def limited(self, step: np.ndarray) -> np.ndarray:
        return step * min(1.0, STEP / max(float(np.abs(step[self.fixed :]).max(initial=0.0)), 1e-9))


def weights_of(noise: np.ndarray) -> np.ndarray:
    weights = np.sqrt(2 / noise).ravel()
    return np.concatenate([weights, weights])


def linear_evidence(problem: Problem, residual: np.ndarray, jacobian: np.ndarray, x: np.ndarray, alpha: float):
    """Log evidence of the model r(x + s) = r − J s, where its maximum lies, and the Cholesky factor of its information."""
    noise = problem.noise(alpha)
    count = problem.case.count[problem.at]
    weights = weights_of(noise)
    j, r = jacobian * weights[:, None], residual * weights
    information = dsyrk(1.0, j, trans=1, lower=1)
    information[np.diag_indices_from(information)] += problem.precision
    factor = cholesky(information, lower=True, check_finite=False)
    step = cho_solve((factor, True), j.T @ r - problem.precision * (x - problem.mean), check_finite=False)
    left, best = r - j @ step, x + step
    values = x.size - problem.fixed
    evidence = -0.5 * left @ left - problem.penalty(best) - np.sum(np.log(np.diag(factor))) + 0.5 * values * np.log(2 * np.pi)
    return float(evidence - np.sum(np.log(noise / count) / count)), best, factor


def likely_alpha(
    problem: Problem, residual: np.ndarray, weighted: np.ndarray, factor: np.ndarray, weights: np.ndarray, now: float
) -> float:
    """Discrepancy that residuals and posterior variance of the prediction ask for (expectation maximisation), faster downwards."""
    spread = np.sum(solve_triangular(factor, weighted.T, lower=True, check_finite=False) ** 2, axis=0) / weights**2
    power = residual**2 + spread
    power = power[: power.size // 2] + power[power.size // 2 :]
    case, at = problem.case, problem.at
    count = np.broadcast_to(case.count[at], case.variance[at].shape).ravel()
    grid = np.exp(np.linspace(np.log(LEAST), 0, 80))
    total = case.variance[at].ravel()[:, None] + grid**2 * case.level[at].ravel()[:, None] ** 2
    new = float(grid[np.argmin(((power / count)[:, None] / total + np.log(total) / count[:, None]).sum(0))])
    return new * min(1, new / now) if new < now else new


def best_alpha(problem: Problem, residual: np.ndarray, jacobian: np.ndarray, x: np.ndarray, alpha: float) -> float:
    """Discrepancy of the highest evidence, by every second line."""
    size = int(np.prod(problem.case.h.shape[1:]))
    part = Problem(problem.case, problem.effects, problem.at[::2])
    r = residual.reshape(2, problem.at.size, size)[:, ::2].reshape(-1)
    j = jacobian.reshape(2, problem.at.size, size, -1)[:, ::2].reshape(r.size, -1)
    known: dict[float, float] = {}

    def evidence(log_alpha: float) -> float:
        key = round(log_alpha, 3)
        if key not in known:
            known[key] = linear_evidence(part, r, j, x, float(np.exp(log_alpha)))[0]
        return known[key]

    here, width, ends = float(np.log(alpha)), 1.2, (np.log(LEAST), np.log(MOST))
    while width >= 0.25:
        best = max((here, max(here - width, ends[0]), min(here + width, ends[1])), key=evidence)
        if best == here:
            width /= 2
        here = float(best)
    return float(np.exp(here))


def fit(
    case: Case,
    effects: list[Effect],
    z: np.ndarray | None = None,
    d: np.ndarray | None = None,
    alpha: float = 0.1,
    turns: int = 18,
    floor: float = -np.inf,
) -> State:
    """Damped Gauss–Newton over z, d and values, in the metric of the prior; the discrepancy between the turns, fivefold a turn at most."""
    problem = Problem(case, effects, case.fit_lines)
    x, damping, done = problem.start(z, d), 0.0, False
    scale = 1 / np.sqrt(problem.precision)
    measured = case.h[problem.at]
    for turn in range(turns):
        prediction = problem.predict(x)
        jacobian, residual = real(prediction.jacobian), real((measured - prediction.h)[..., None])[:, 0]
        evidence, linear, factor = linear_evidence(problem, residual, jacobian, x, alpha)
        if done:
            break
        noise = problem.noise(alpha)
        weights = weights_of(noise)
        weighted = jacobian * weights[:, None]
        if turn == 0 and alpha > 0.02:  # nothing is known of the discrepancy yet: from the linear model
            alpha = max(likely_alpha(problem, residual - jacobian @ (linear - x), weighted, factor, weights, alpha), alpha / 4)
            evidence, linear, factor = linear_evidence(problem, residual, jacobian, x, alpha)
            noise = problem.noise(alpha)
            weights = weights_of(noise)
            weighted = jacobian * weights[:, None]
        start = now = problem.objective(prediction.h, x, noise)
        lower = np.tril(factor)
        values, vectors = np.linalg.eigh((lower @ lower.T) * scale[:, None] * scale)
        left = residual
        for chord in range(6):
            gradient = vectors.T @ (scale * (weighted.T @ (left * weights) - problem.precision * (x - problem.mean)))
            tries = [damping * 10.0**i for i in range(12)] if damping else [0.0, *(1e-2 * 10.0**i for i in range(12))]
            for mu in tries if chord == 0 else tries[:1]:
                there = x + problem.limited(scale * (vectors @ (gradient / (values + mu))))
                h = problem.predict(there, False).h
                new = problem.objective(h, there, noise)
                if new < now:
                    break
            else:
                break
            if chord == 0:
                damping = 0.0 if mu <= 1e-2 else mu / 10
            gain, now, x = now - new, new, there
            left = real((measured - h)[..., None])[:, 0]
            if gain < 0.02 * max(1, 0.02 * now) or mu > 0:
                break
        if turn >= 2 and evidence < floor - 60 * (1 if turn > 3 else 10):
            break
        before = alpha
        alpha = min(max(likely_alpha(problem, left, weighted, factor, weights, alpha), alpha / 5, LEAST), MOST)
        change, last = abs(np.log(alpha / before)), turn == turns - 2
        done = last or (start - now < 0.3 and change < 0.1)
        done = done or (start - now < 3e-3 * now and alpha > 0.02 and change < 0.2 and turn > 1)
        if done:  # the last word on the discrepancy has the evidence itself
            alpha = best_alpha(problem, left, jacobian, x, alpha)
            done = last or abs(np.log(alpha / before)) < 0.35
    return State(problem.with_values(x), x, alpha, evidence, factor, case)


def approach(
    case: Case, effects: list[Effect], z: np.ndarray | None = None, d: np.ndarray | None = None, turns: int = 4
) -> tuple[float, np.ndarray, np.ndarray, list[Effect]]:
    """Robust way from a start to the neighbourhood of a fit: Student weights, damped steps. Cost, z, d, effects."""
    problem = Problem(case, effects, case.fit_lines[::2])
    x, damping = problem.start(z, d), 1.0
    scale = 1 / np.sqrt(problem.precision)
    measured = case.h[problem.at]
    for alpha in APPROACH:
        noise = problem.noise(alpha)

        def cost(h: np.ndarray, x: np.ndarray, noise: np.ndarray = noise) -> float:
            return float(np.sum(np.log1p(np.abs(measured - h) ** 2 / noise))) + problem.penalty(x)

        for _ in range(turns):
            prediction = problem.predict(x)
            residual = measured - prediction.h
            weights = weights_of(noise + np.abs(residual) ** 2)
            jacobian = real(prediction.jacobian) * weights[:, None]
            matrix = dsyrk(1.0, jacobian * scale, trans=1, lower=1)
            matrix = np.tril(matrix) + np.tril(matrix, -1).T + np.eye(x.size)
            values, vectors = np.linalg.eigh(matrix)
            right = jacobian.T @ (real(residual[..., None])[:, 0] * weights)
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
    first = case.n_z
    return cost(problem.predict(x, False).h, x), x[:first], x[first : problem.fixed], problem.with_values(x)


def update_spreads(case: Case, state: State) -> tuple[np.ndarray, dict[str, float]]:
    """One turn of empirical Bayes over the spreads of the nuisance; d in the new ones, and their factors."""
    d, factors = state.d.copy(), {}
    inverse = solve_triangular(np.tril(state.factor), np.eye(state.x.size), lower=True)
    variance = np.sum(inverse**2, axis=0)[case.n_z :]
    for name, part in case.parts.items():
        if name not in FIXED_SPREADS:
            total = np.sum(d[part] ** 2 + variance[part]) + PRIOR_COUNT
            factor = float(np.clip(np.sqrt(total / (d[part].size + PRIOR_COUNT)), *SPREAD_FACTOR))
            case.spread[part] *= factor
            d[part] /= factor
            factors[name] = round(factor, 2)
    return d, factors


def on_validation_lines(case: Case, state: State) -> tuple[float, float]:
    """Reduced chi-square of the validation lines under noise, discrepancy and posterior, per independent value; their error in dB (rms)."""
    problem = Problem(case, state.effects, case.validation_lines)
    prediction = problem.predict(state.x)
    weights = weights_of(problem.noise(state.alpha))
    jacobian = real(prediction.jacobian) * weights[:, None]
    residual = real((case.h[problem.at] - prediction.h)[..., None])[:, 0] * weights
    spread = solve_triangular(np.tril(state.factor), jacobian.T, lower=True)
    along = spread @ residual
    chi = residual @ residual - along @ np.linalg.solve(np.eye(along.size) + spread @ spread.T, along)
    independent = np.sum(1 / np.broadcast_to(case.count[problem.at], prediction.h.shape)) * 2
    db = 20 * np.log10(np.abs(prediction.h) / np.abs(case.h[problem.at]))
    return float(chi / independent), float(np.sqrt(np.mean(db**2)))


def names(case: Case, effects: Sequence[Effect]) -> list[str]:
    """The effects in words."""
    return [f"{e.kind}@{','.join(str(case.dofs[i]) for i in e.places)}" + ("" if e.size is None else f"={e.size:.6g}") for e in effects]
