"""Steps towards the most probable unknowns of a state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Factor, Information
from operando.diagnosis.problem import Problem, Step
from operando.diagnosis.slopes import Slopes

Array = NDArray[Any]

_TRIES, _CHORDS = 12, 5  # steps tried in a turn, and further ones with the same factor
_DAMPING, _PART = 3.0, 0.2  # by how much the damping grows, and falls at most; the part of a step along which its bend is measured
_NOTHING = 1e-3  # nats: a turn that gains less has ended at the minimum, and its damping says nothing of the way from another point
_ALIKE = 0.1  # share of the damping that all unknowns get, in units of their priors; with 0.01 a hopeless fit ends farther off


class Descent:
    """Lowers what a state leaves of the lines, a turn at a time: Gauss–Newton steps, damped along what bends and bent to second order.

    The damping is that of Levenberg and Marquardt in the metric of :meth:`Problem.bends`, the second-order step the geodesic acceleration
    of Transtrum & Sethna (arXiv:1201.5885, 2012): what an effect does is a product of three unknowns, and the valley that a product
    makes is followed by no straight step.
    """

    def __init__(self) -> None:
        self.damping = 0.0

    def turn(
        self, problem: Problem, x: Step, rows: tuple[Slopes, Array], alpha: float, factor: Factor, information: Information
    ) -> tuple[Step, Array, float, float]:
        """From a point with its derivatives, residual and information: where it leads, the residual and the objective there, the gain."""
        slopes, left = rows
        variance = problem.variance(alpha)
        weights = 2 / variance

        def cost(h: Array, x: Step) -> float:
            return problem.objective(h, x, variance)

        begun = now = float(np.sum(left**2 / variance)) + problem.penalty(x)
        gradient = problem.gradient(slopes, left * weights, x)
        metric, damped, harder = None, factor, _DAMPING
        for _ in range(_TRIES):
            if self.damping:
                if metric is None:
                    metric = problem.bends(x)
                there = Information(information.shared + self.damping * metric, information.across, information.own)
                more = 1 + _ALIKE * self.damping
                damped = Factor.of(there, more * problem.precision, more * problem.own_precision)
            step = problem.limited(problem.solved(damped, gradient))
            h, new = problem.tried(x + step, cost)
            if self.damping or not new < now:
                part = problem.residual(problem.tried(x + step * _PART, cost)[0])
                bend = (part - left + problem.spread(slopes, step) * _PART) / _PART**2
                second = problem.solved(damped, problem.bent(slopes, bend * weights, x, step, _PART))
                bent, its = problem.tried(x + step + second, cost)
                if its < new:
                    h, new, step = bent, its, step + second
            if new < now:
                break
            self.damping = max(self.damping, 1.0) * harder
            harder *= 2
        else:
            self.damping = 0.0
            return x, left, now, 0.0
        gain, now, x, left = now - new, new, x + step, problem.residual(h)
        if self.damping:
            along = problem.by_response(step.own)
            promised = float(gradient.shared @ step.shared + np.sum(gradient.own * along))
            promised -= 0.5 * (information.quadratic(step.shared, along) + float(problem.precision @ step.shared**2 + np.sum(along**2)))
            kept = min(gain / max(promised, gain), 1.0)
            easier = max(1 / _DAMPING, 1 - (2 * kept - 1) ** 3)
            self.damping = self.damping * easier if self.damping > 1 else 0.0
        for _ in range(_CHORDS):  # the same factor again
            if gain < 0.02 * max(1, 0.02 * now):
                break
            step = problem.limited(problem.solved(damped, problem.gradient(slopes, left * weights, x)))
            h, new = problem.tried(x + step, cost)
            if not new < now:
                break
            gain, now, x, left = now - new, new, x + step, problem.residual(h)
        if begun - now < _NOTHING:
            self.damping = 0.0
        return x, left, now, begun - now
