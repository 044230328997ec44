"""Lines of a case with some effects as one problem of least squares: unknowns in one order, residuals, derivatives, and where they bend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor, Information
from operando.diagnosis.case import Case
from operando.diagnosis.forward import Point, Prediction
from operando.diagnosis.idle_lines import Placed
from operando.diagnosis.products import Rows
from operando.diagnosis.slopes import Slopes
from operando.diagnosis.terms import Term, moved, touched

Array = NDArray[Any]

_STEP = 0.7  # of a value on its search scale, at most
_SMALL = 0.1  # least shape value of which a change counts as relative, over the rms of its mode


@dataclass(frozen=True)
class Step:
    """A vector over all unknowns: those that reach all channels, (n,), and those of each DOF, (DOFs, k)."""

    shared: Array
    own: Array

    def __add__(self, other: Step) -> Step:
        return Step(self.shared + other.shared, self.own + other.own)

    def __mul__(self, factor: float) -> Step:
        return Step(factor * self.shared, factor * self.own)


class Problem:
    """Lines of a case with some effects: the unknowns in one order, residuals and derivatives as independent rows.

    Shared unknowns are g, d, u, the values, and those of touched DOFs that reach all channels; the latter are zero among the own ones.
    """

    def __init__(self, case: Case, terms: Sequence[Term], at: Array, stands_for: float = 1.0, straight: bool = False) -> None:
        """Of lines ``at``, each for ``stands_for`` of them; ``straight`` leaves the prior of the idle model normal in any case."""
        self.case, self.at, self.forward = case, at, case.forward
        self.stands_for = stands_for  # so many lines as each of these
        self.terms = tuple(terms)
        self.w = case.lines.w[at]
        self.measured = case.lines.h[at]
        forward = case.forward
        self.n_u = len(forward.outside(terms))
        self.n_values = sum(len(t.values) for t in terms)
        self.values_at = forward.n_g + forward.n_d + self.n_u
        dofs, first, size = forward.reaching_dofs(terms), self.values_at + self.n_values, forward.reaching.size
        # DOF, which of its own unknowns, and where they stand among the shared ones
        self.reaching = [(int(dof), forward.reaching, slice(first + n * size, first + (n + 1) * size)) for n, dof in enumerate(dofs)]
        self.n_shared = first + len(dofs) * size
        self.order = forward.order(terms)
        means, stds = zip(*(case.prior(t) for t in terms), strict=True) if terms else ((), ())
        self.mean = np.zeros(self.n_shared)
        self.precision = np.ones(self.n_shared)
        if self.n_values:
            part = slice(self.values_at, self.values_at + self.n_values)
            self.mean[part], self.precision[part] = np.concatenate(means), np.concatenate(stds) ** -2.0
        self.own_precision = np.ones((self.order.size, forward.n_own))
        self.idle: Placed | None = None
        if case.idle_lines is not None and not straight:
            far = {dof: shared.start for dof, _, shared in self.reaching}
            self.idle = Placed(case.idle_lines, self.order, far, (self.n_shared, forward.n_own))

    def packed(self, x: Point) -> Step:
        """Unknowns of a point; own ones by DOF."""
        own = np.array(x.own)
        far = []
        for dof, at, _ in self.reaching:
            far.append(own[dof, at])
            own[dof, at] = 0
        values = [np.array(t.values) for t in x.terms]
        return Step(np.concatenate([x.g, x.d, x.u, *values, *far]), own)

    def point(self, step: Step) -> Point:
        forward = self.forward
        g, d, u, values, _ = np.split(step.shared, np.cumsum([forward.n_g, forward.n_d, self.n_u, self.n_values]))
        own = np.array(step.own)
        for dof, at, shared in self.reaching:
            own[dof, at] = step.shared[shared]
        return Point(g, d, own, u, tuple(moved(self.terms, values)))

    def by_response(self, own: Array) -> Array:
        """Own unknowns (DOFs, k) in the order of the responses."""
        return own[self.order]

    def by_dof(self, own: Array) -> Array:
        out = np.zeros((self.forward.n_dofs, own.shape[1]))
        out[self.order] = own
        return out

    def predict(self, x: Step, derivatives: bool = True) -> Prediction:
        return self.forward.predict(self.point(x), self.w, derivatives=derivatives)

    def derived(self, x: Step) -> tuple[Slopes, Array]:
        """Derivatives and the residual, as independent rows."""
        point = self.point(x)
        if self.idle is not None:
            self.idle.derive(point)
        h, slopes = self.forward.derived(point, self.w, Rows(self.case.lines.basis(self.at)[0]))
        return slopes, self.residual(h)

    def information(self, slopes: Slopes, alpha: float) -> Information:
        """Of the rows, and what the idle FRFs tell beyond the prior, at the point of these derivatives."""
        told = slopes.information(self.weights(alpha))
        return told if self.idle is None else told + self.idle.information

    def rows(self, values: Array) -> Array:
        """Values (lines, responses, references, k) as independent rows (responses, rows, k)."""
        return self.case.lines.rows(values, self.at)

    def residual(self, h: Array) -> Array:
        return self.rows((self.measured - h)[..., None])[..., 0]

    def variance(self, alpha: float) -> Array:
        """Of the rows, times two."""
        return self.case.lines.rows_variance(alpha, self.at)

    def weights(self, alpha: float) -> Array:
        """Of the squares of the rows, twice as large as in the objective."""
        return np.asarray(2 * self.stands_for / self.variance(alpha))

    def penalty(self, x: Step) -> float:
        idle = 0.0 if self.idle is None else self.idle.value(self.point(x), x.shared, self.by_response(x.own))
        return self._normal(x) + idle

    def penalty_of(self, x: Step, step: Step) -> float:
        """The penalty a step on, of second order about the point of the last derivatives."""
        total = self._normal(x + step)
        if self.idle is not None:
            point, own, along = self.point(x), self.by_response(x.own), self.by_response(step.own)
            by_shared, by_own = self.idle.gradient(point, x.shared, own)
            total += self.idle.value(point, x.shared, own) + float(by_shared @ step.shared + np.sum(by_own * along))
            total += 0.5 * self.idle.information.quadratic(step.shared, along)
        return total

    def _normal(self, x: Step) -> float:
        values = slice(self.values_at, self.values_at + self.n_values)
        known = x.shared @ x.shared - x.shared[values] @ x.shared[values] + np.sum(x.own**2)
        return float(0.5 * known - sum(self.case.log_prior(t) for t in self.point(x).terms))

    def objective(self, h: Array, x: Step, variance: Array) -> float:
        return float(np.sum(self.residual(h) ** 2 / variance)) + self.penalty(x)

    def tried(self, x: Step, cost: Callable[[Array, Step], float]) -> tuple[Array, float]:
        """FRFs and cost where a step leads; infinite where it leads to numbers that cannot be."""
        try:
            with np.errstate(all="ignore"):
                h = self.predict(x, False).h
                value = cost(h, x)
        except (np.linalg.LinAlgError, OverflowError):
            return self.measured, np.inf
        return h, value if np.isfinite(value) else np.inf

    def gradient(self, slopes: Slopes, weighted: Array, x: Step) -> Step:
        """Of −objective: Jᵀ of weighted residuals (responses, rows), and the prior."""
        along = self.projected(slopes, weighted)
        shared, own = self.of_prior(x)
        return Step(along.shared - shared, along.own - own)

    def of_prior(self, x: Step) -> tuple[Array, Array]:
        """Gradient of the penalty, (n,) and (responses, k)."""
        shared, own = self.precision * (x.shared - self.mean), self.by_response(x.own)
        if self.idle is None:
            return shared, own
        by_shared, by_own = self.idle.gradient(self.point(x), x.shared, own)
        return shared + by_shared, own + by_own

    def projected(self, slopes: Slopes, weighted: Array) -> Step:
        """Jᵀ of weighted rows."""
        shared, own = slopes.along(lambda at: weighted[at, :, None])
        return Step(shared[..., 0], own[..., 0])

    def bent(self, slopes: Slopes, weighted: Array, x: Step, step: Step, part: float) -> Step:
        """Jᵀ of weighted bends of the rows along a step, with those of the idle FRFs."""
        along = self.projected(slopes, weighted)
        if self.idle is None:
            return along
        g = step.shared[: self.forward.n_g]
        own = self.point(x + step).own - self.point(x).own
        shared, mine = self.idle.bend(self.point(x), self.point(x + step * part), g, own[:, : self.forward.n_shape], part)
        return Step(along.shared + shared, along.own + mine)

    def solved(self, factor: Factor, gradient: Step) -> Step:
        """Step by DOF from a gradient by response."""
        shared, own = factor.solve(gradient.shared, gradient.own)
        return Step(shared, self._without_reaching(self.by_dof(own)))

    def _without_reaching(self, own: Array) -> Array:
        for dof, at, _ in self.reaching:
            own[dof, at] = 0
        return own

    def limited(self, step: Step) -> Step:
        values = np.abs(step.shared[self.values_at : self.values_at + self.n_values]).max(initial=0.0)
        return step * min(1.0, _STEP / max(float(values), 1e-9))

    def bends(self, x: Step) -> Array:
        """Metric of the shared unknowns in which the FRFs bend: relative changes of shapes where a force acts, and of sizes.

        What an effect does is a product of its size and of two shape values. Where few of these are known by themselves, straight steps
        leave the valley that their product makes.
        """
        forward, point = self.forward, self.point(x)
        made = forward.moved(point)
        rms = np.sqrt(np.mean(made.phi**2, axis=0))
        metric = np.zeros((self.n_shared, self.n_shared))
        values = np.arange(self.values_at, self.values_at + self.n_values)
        metric[values, values] = 1
        far = {dof: (shared.start, at) for dof, at, shared in self.reaching}
        for dof in {*touched(self.terms), *forward.references.tolist()}:
            least = np.maximum(np.abs(made.phi[dof]), _SMALL * rms)
            by = np.zeros((forward.n_terms, self.n_shared))
            by[:, : forward.n_g] = made.shapes.shared[dof]
            if dof in far:
                begin, at = far[dof]
                mine = at < forward.n_shape
                by[:, begin + np.flatnonzero(mine)] = made.shapes.own[dof][:, at[mine]]
            by = np.divide(by, least[:, None], out=np.zeros_like(by), where=least[:, None] > 0)
            metric += by.T @ by
        return metric

    def spread(self, slopes: Slopes, step: Step) -> Array:
        """J step, (responses, rows)."""
        return slopes.moved(step.shared, self.by_response(step.own))
