"""What the check lines tell of the idle model once the effects are known: all its modal parameters, under their covariance.

The search refits what the places of the effects leave open, and no more. Where the idle model knows its driven columns to a few per
cent and the check to a few per mille, the rest of the difference is the idle model's own error; it is common to all lines, and is
taken out here, together with what it did to the sizes of the effects.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.levenberg import inverse, jacobian, solve, split, unobservable, weights
from operando.diagnose.predict import IdleArrays, Prediction, by_poles, predict
from operando.diagnose.refit import Fit, Learnt, mean_misfit, predicted
from operando.diagnose.result import given_shapes, moves_of
from operando.diagnose.sets import FIT, SELECT, CheckLines
from operando.diagnose.shapes import Scales, by_directions

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem

Array = NDArray[Any]

BEYOND_NOISE = 1.2
"""Misfit by the variance of the measurement alone above which the check can tell something of the idle model."""

AGREE = 1.5
"""Misfit by the noise alone up to which lines agree with the prediction."""

KEPT = 1e-9
"""Directions of the idle model's covariance (of each parameter in units of its standard deviation) below this share are left out."""

TOLD = 0.02
"""Directions whose variance the lines would lower by less than about this part stay as they are."""

SURE = 1.2
"""Directions that moved by more than this, in rms of their spread, had been given too small a one."""

LEAST = 1e-3
"""First damping of a step, of the prior's own curvature, after steps without any."""

STEPS, TRIES, ENDED, LAST, ONE_STEP = 25, 9, 5e-3, 2e-3, 1.0
"""Iterations of a stage at most; a step that lowers the cost by less than this part is the last; in the end by this part;
from where other lines have been fitted the first step is."""

EVERY = 4
"""One line in so many shows what the lines tell."""

AT_ONCE = (0.0,)
BY_DOUBT = (0.1, 0.02, 0.003, 0.0)
"""Doubt of the prediction, as a part of what was measured, stage by stage: two ways down."""


def learn(problem: Problem, fit: Fit) -> Fit:
    """Gauss–Newton over the effects' sizes and all modal parameters of the idle model.

    The prior is what the refit of the effects left of the idle model's covariance, with the directions it moved at their places. The
    noise that neighbouring lines share counts: each line weighs as much less. The covariance is that of both measurements together.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        After the last fit.

    Returns
    -------
    Fit
        With ``learnt``; as it was where the idle model has no covariance, the lines agree with it within their noise, or
        nothing gets better.
    """
    if problem.idle.covariance is None or not fit.terms or not fit.covariance.size:
        return fit
    lines = _telling(problem)
    p = predict(problem.arrays.with_phi(fit.phi), lines, fit.terms, fit.q)
    if mean_misfit(lines, np.zeros(p.data.shape), p.data) < BEYOND_NOISE:
        return fit
    state = _Parameters.of(problem, fit, lines)
    ends: list[tuple[_Parameters, Array]] = []
    for stages in (AT_ONCE, BY_DOUBT):  # two ways down
        ends.append(state.settled(stages))
        there, x = ends[-1]
        if there.misfit(x) < AGREE:
            break  # no other way ends lower by much
    there, x = min(((there.on(2), x) for there, x in ends), key=lambda end: end[0].cost(end[1]))
    x = there.descend(x, LAST)
    return there.learnt(x) if there.cost(x) < state.on(2).cost(state.start) else fit


def cost_once_corrected(problem: Problem, fit: Fit) -> tuple[float, float]:
    """2·Σ|e|²/var + |z|² (and the misfit by the noise alone) with the idle model free within its covariance beside the effects.

    Of two sets of effects the difference is twice that of their log posteriors: what the errors of the idle model can make up for tells
    nothing for either.
    """
    state = _Parameters.of(problem, fit, _telling(problem))
    last, ends = state.on(2), []
    for stages in (AT_ONCE, BY_DOUBT):
        x = last.descend(state.found(state.start, stages), LAST)
        ends.append((last.cost(x), last.misfit(x)))
        if ends[-1][1] < AGREE:
            break  # no other way ends lower by much
    return min(ends)


def on_all_lines(problem: Problem, fit: Fit) -> Fit:
    """The last fit once more, with the lines that judged, too: when nothing is left to choose, a mode among them is known by them as well.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        As it was judged: with ``learnt`` where that proved itself, else as it was settled.
    """
    every = problem.judged()
    if fit.learnt is None:
        again = every.settled(fit)
        return replace(again, excess=max(again.excess, fit.excess))  # no surer than the lines that judged alone let it be
    state = _Parameters.of(every, replace(fit, learnt=None), _telling(every)).on(2)
    return state.learnt(state.descend(state.at(fit.learnt), ONE_STEP))


def _telling(problem: Problem) -> CheckLines:
    """The lines that may be fitted."""
    return problem.lines.where(np.isin(problem.lines.group, (FIT, SELECT)))


def all_but_the_idle_model(problem: Problem, fit: Fit) -> bool:
    """Whether these effects leave nothing but errors of the idle model: once it is corrected, the lines agree within their noise."""
    corrected = learn(problem, problem.settled(fit))
    if corrected.learnt is None:
        return False
    lines = problem.sets[SELECT]
    return mean_misfit(lines, np.zeros(lines.data.shape), predicted(problem.arrays, lines, corrected)[0]) < AGREE


def _thinned(lines: CheckLines, every: int) -> tuple[CheckLines, Array]:
    """One line in so many, as far as they share their noise, and 1/std of each; what lines still share weighs them down."""
    step = max(1, min(every, int(lines.shared / 2)))
    keep = np.zeros(lines.hz.size, bool)
    keep[step // 2 :: step] = True
    few = lines.where(keep)
    return few, np.sqrt(weights(few, np.zeros(few.data.shape)) / max(lines.shared / step, 1.0))


@dataclass(frozen=True)
class _Parameters:
    """x: the effects' moving numbers, then directions of all parameters that the lines tell something about, of unit variance before.

    ``told``: all lines that tell; ``lines``: those in use, with 1/std of each; ``alike``: the curvature by which steps are damped.
    """

    problem: Problem
    fit: Fit
    told: CheckLines
    lines: CheckLines
    root_w: Array
    poles: Array
    moves: Array
    scales: Scales
    start: Array
    rest: Array
    alike: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(cls, problem: Problem, fit: Fit, lines: CheckLines) -> _Parameters:
        idle = problem.idle
        n, m = idle.terms.n, len(idle.dofs)
        assert idle.covariance is not None
        unit = np.sqrt(np.maximum(np.diag(idle.covariance), 1e-300))
        size, vectors = np.linalg.eigh(given_shapes(idle, fit, driven=True) / unit[:, None] / unit)
        keep = size > KEPT * max(float(size[-1]), 1e-300)
        # What the refit moved stays a direction of its own, with where it stands; everything else is counted from there.
        root = np.c_[moves_of(idle, fit), unit[:, None] * vectors[:, keep] * np.sqrt(size[keep])]
        stands = np.r_[fit.z, np.zeros(root.shape[1] - fit.z.size)]
        moves = np.ascontiguousarray(root[2 * n :].reshape(n, m, -1).transpose(1, 0, 2))
        q = np.concatenate(fit.q)
        few, root_w = _thinned(lines, EVERY)
        made = cls(problem, fit, lines, few, root_w, root[: 2 * n], moves, Scales.of(idle), np.r_[q, stands], root)
        slope = made.slope(made.start)[q.size :]
        information = 2 * slope @ slope.T
        told, turn = np.linalg.eigh(information)
        turn = turn[:, told > TOLD]
        rest = root - (root @ turn) @ turn.T
        alike = (turn.T * (1 + np.diag(information))) @ turn
        return replace(
            made,
            poles=made.poles @ turn,
            moves=moves @ turn,
            start=np.r_[q, turn.T @ stands],
            rest=rest,
            alike=alike,
        )

    def at(self, known: Learnt) -> Array:
        """x of what was learnt before, as far as the directions hold it."""
        idle = self.problem.idle
        then, here = known.idle.terms, idle.terms
        gone = np.r_[then.frequencies_hz - here.frequencies_hz, then.damping_ratios - here.damping_ratios]
        move = self.scales.move(self.fit.phi, np.asarray(then.shapes))
        assert idle.covariance is not None
        unit = np.sqrt(np.maximum(np.diag(idle.covariance), 1e-300))
        directions = np.concatenate([self.poles, self.moves.transpose(1, 0, 2).reshape(-1, self.moves.shape[2])])
        z = np.linalg.lstsq(directions / unit[:, None], np.r_[gone, move.T.ravel()] / unit, rcond=1e-9)[0]
        return np.r_[np.concatenate(known.q), self.start[self.n_q :] + z]

    def on(self, every: int) -> _Parameters:
        """The same on one in so many of the lines that tell."""
        few, root_w = _thinned(self.told, every)
        return replace(self, lines=few, root_w=root_w)

    def settled(self, stages: tuple[float, ...]) -> tuple[_Parameters, Array]:
        """The minimum; with a wider prior where that was too sure of itself."""
        x = self.found(self.start, stages)
        wide = float(np.sqrt(np.mean(x[self.n_q :] ** 2))) if x.size > self.n_q else 0.0
        if wide <= SURE:
            return self, x
        other = self.widened(wide)
        return other, other.found(np.r_[x[: self.n_q], x[self.n_q :] / wide], AT_ONCE)

    def found(self, x: Array, stages: tuple[float, ...]) -> Array:
        """The minimum, reached with less and less doubt of the prediction.

        A peak beside the one measured is pulled there only where lines are not weighed as if the prediction had to meet their noise.
        """
        here = self.on(EVERY)
        for doubt in stages:
            loose = here.root_w / np.sqrt(1 + (doubt * np.abs(here.lines.data) * here.root_w) ** 2)
            x = replace(here, root_w=loose).descend(x)
        return x

    @property
    def n_q(self) -> int:
        return sum(v.size for v in self.fit.q)

    def widened(self, by: float) -> _Parameters:
        """Directions of larger spread."""
        start = np.r_[self.start[: self.n_q], self.start[self.n_q :] / by]
        return replace(self, poles=self.poles * by, moves=self.moves * by, start=start)

    def q(self, x: Array) -> tuple[Array, ...]:
        return split(x[: self.n_q], self.fit.terms)

    def arrays(self, x: Array) -> IdleArrays:
        """Modal parameters moved from where the refit left them."""
        idle, n, gone = self.problem.arrays.model, self.problem.idle.terms.n, self._gone(x)
        poles = self.poles @ gone
        phi = self.scales.moved(self.fit.phi, self.moves @ gone)
        hz = np.maximum(idle.terms.frequencies_hz + poles[:n], 0.5 * idle.terms.frequencies_hz)
        zeta = np.maximum(idle.terms.damping_ratios + poles[n:], 0.1 * idle.terms.damping_ratios)
        return IdleArrays(idle.with_terms(frequencies_hz=hz, damping_ratios=zeta), phi)

    def _gone(self, x: Array) -> Array:
        return x[self.n_q :] - self.start[self.n_q :]

    def shape_slope(self, x: Array) -> Array:
        """∂φ/∂x, (n_dofs, n_modes, ·)."""
        return self.scales.slope(self.fit.phi, self.moves, self.moves @ self._gone(x))

    def slope(self, x: Array, p: Prediction | None = None) -> Array:
        """∂(weighted H)/∂x, real and imaginary parts side by side, (x.size, 2·lines)."""
        here, q, n, terms = self.arrays(x), self.q(x), self.problem.idle.terms.n, self.fit.terms
        p = p or predict(here, self.lines, terms, q)
        changed = here.model
        for t, v in zip(terms, q, strict=True):
            if t.kind.acts == "modal_change":
                changed = t.kind.modal_change(changed, t.values(v))
        both = np.concatenate([by[:n] for by in by_poles(p, changed, self.lines)]).astype(np.complex64)
        own = by_directions(p, self.lines, self.shape_slope(x))
        own += np.tensordot(self.poles.T.astype(np.float32), both, 1)
        sizes = jacobian(here, self.lines, terms, q, self.fit.prior.bare(), np.zeros(0), p)
        flat = (np.concatenate([sizes, own]) * self.root_w).reshape(x.size, -1)
        return np.concatenate([flat.real, flat.imag], axis=1)

    def _state(self, x: Array) -> tuple[Prediction, Array, float]:
        p = predict(self.arrays(x), self.lines, self.fit.terms, self.q(x))
        error = (self.root_w * (self.lines.data - p.data)).ravel()
        error = np.concatenate([error.real, error.imag])
        return p, error, 2 * float(error @ error) + float(x[self.n_q :] @ x[self.n_q :])

    def misfit(self, x: Array) -> float:
        """Mean of |e|²/var on the lines in use."""
        data = predict(self.arrays(x), self.lines, self.fit.terms, self.q(x)).data
        return mean_misfit(self.lines, np.zeros(data.shape), data)

    def cost(self, x: Array) -> float:
        """2·Σ|e|²/var + |z|²."""
        return self._state(x)[2]

    def descend(self, x: Array, ended: float = ENDED) -> Array:
        """Gauss–Newton steps from x, damped where they fail by Marquardt's diagonal in the covariance's own directions.

        Apart from ``levenberg``: the damping is of another basis than x, and begins at none.
        """
        bounds = [t.bounds() for t in self.fit.terms]
        low, high = (np.concatenate([b[side] for b in bounds]) for side in (0, 1))
        damping = 0.0
        alike = np.zeros((x.size, x.size))
        alike[self.n_q :, self.n_q :] = self.alike
        for _ in range(STEPS):
            p, error, cost = self._state(x)
            slope = self.slope(x, p)
            down = 2 * slope @ error
            down[self.n_q :] -= x[self.n_q :]
            normal = self._normal(slope)
            first = True
            for _ in range(TRIES):
                new = x + solve(normal + damping * alike, down)
                new[: self.n_q] = np.clip(new[: self.n_q], low, high)
                reached = self.cost(new)
                if np.isfinite(reached) and reached < cost:
                    break
                damping, first = max(10 * damping, LEAST), False
            else:
                break
            gain, x, cost = cost - reached, new, reached
            if first:
                damping = damping / 10 if damping > LEAST else 0.0
            if gain < ended * cost:
                break
        return x

    def _normal(self, slope: Array) -> Array:
        normal = 2 * slope @ slope.T
        k = np.arange(self.n_q, len(normal))
        normal[k, k] += 1
        return np.asarray(normal)

    def learnt(self, x: Array) -> Fit:
        """The fit there, with the covariance of what was told and what was not."""
        idle, fit, k = self.problem.idle, self.fit, self.n_q
        here = self.arrays(x)
        normal = self._normal(self.slope(x))
        known = inverse(normal)
        moves = self.shape_slope(x)
        told = np.concatenate([self.poles, moves.transpose(1, 0, 2).reshape(-1, x.size - k)])
        own = told @ known[k:, k:] @ told.T + self.rest @ self.rest.T
        across = told @ known[k:, :k]
        moved = idle.with_terms(
            frequencies_hz=here.model.terms.frequencies_hz,
            damping_ratios=here.model.terms.damping_ratios,
            shapes=here.phi,
            covariance=None,
            std=None,
        )
        joint = np.block([[own, across], [across.T, known[:k, :k]]])
        now = predict(here, self.lines, fit.terms, self.q(x)).data
        misfit = mean_misfit(self.lines, np.zeros(now.shape), now)
        # What is left is alike on all lines of a peak: it moves the sizes as it stands, not as its mean over many lines.
        excess = max(misfit, 1.0) ** 2
        return replace(fit, learnt=Learnt(self.q(x), moved, (joint + joint.T) / 2, excess), untold=unobservable(normal))
