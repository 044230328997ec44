"""What the idle FRFs say of the unknowns of an idle model beyond second order: their own lines, beside the prior that was made of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.arrow import Information
from operando.diagnosis.between import Between
from operando.diagnosis.forward import Forward, Point
from operando.diagnosis.idle import Idle
from operando.diagnosis.lines import Lines
from operando.diagnosis.products import Rows
from operando.diagnosis.slopes import Slopes

Array = NDArray[Any]


@dataclass(frozen=True)
class FittedAtRest:
    """A fit to the idle FRFs: their lines, the model that was fitted, and the discrepancy it ended with."""

    lines: Lines
    forward: Forward
    alpha: float


class IdleLines:
    """Lines of the idle FRFs, whitened, as an idle model predicts them.

    The prior of its unknowns v is normal: what the fit at rest left open. Of modes that damping ties FRFs are known far better than what
    makes them, and bend within that prior: of draws from it they are off by thousands of nats, and a state that has to move along such a
    bend pays in the wrong unknowns. With rows y(v) of the idle FRFs, y₀ and J₀ theirs at v = 0, the negative logarithm of the prior is
    ½ |v|² + ½ |y(v) − y₀|² − ½ |J₀ v|²: the normal one where y is linear, and else what the idle FRFs themselves say.

    Parameters
    ----------
    idle : Idle
        Fitted to the idle FRFs, its unknowns zero there.
    fitted : FittedAtRest
        That fit.
    """

    def __init__(self, idle: Idle, fitted: FittedAtRest) -> None:
        lines, forward = fitted.lines, fitted.forward
        at = lines.fit
        self.responses = forward.responses
        self.forward = Forward(idle, Between(idle, forward.references, forward.band, {}), self.responses, forward.references, forward.band)
        start = self.forward.start
        self.w, self.lines, self.at = lines.w[at], lines, at
        self.rows, self.weights = Rows(lines.basis(at)[0]), 2 / lines.rows_variance(fitted.alpha, at)
        self.h = self.forward.predict(start, self.w, derivatives=False).h
        self.known = self.slopes(start).information(self.weights)

    def _point(self, x: Point) -> Point:
        return Point(x.g, self.forward.start.d, x.own[:, : self.forward.n_own], self.forward.start.u)

    def moved(self, x: Point) -> Array:
        """How far a point moves the rows, (responses, rows)."""
        h = self.forward.predict(self._point(x), self.w, derivatives=False).h
        return self.lines.rows((h - self.h)[..., None], self.at)[..., 0]

    def slopes(self, x: Point) -> Slopes:
        """How the rows move from a point, by g and by the own unknowns of the responses."""
        made, g = self.forward.derived(self._point(x), self.w, self.rows)[1], self.forward.n_g
        # beyond g stand unknowns of driven DOFs: of a mode that is lacking at rest

        def by_g(at: slice) -> tuple[Array, Array]:
            shared, own = made.make(at)
            return np.ascontiguousarray(shared[..., :g]), own

        return Slopes(by_g, made.blocks)


class Placed:
    """Lines of the idle FRFs among the unknowns of a problem: ``order`` is the DOF of each of its blocks, ``far`` where those stand that
    reach all channels."""

    def __init__(self, idle: IdleLines, order: Array, far: dict[int, int], sizes: tuple[int, int]) -> None:
        self.idle, self.n_shared, self.n_own = idle, *sizes
        block = {int(dof): number for number, dof in enumerate(order)}
        known = list(enumerate(idle.responses.tolist()))
        self.far = [(row, far[dof]) for row, dof in known if dof in far]
        self.near = [(row, block[dof]) for row, dof in known if dof in block and dof not in far]
        self.blocks, self.size = order.size, idle.forward.n_own
        self.without = self._laid(idle.known)
        self._slopes: Slopes | None = None
        self._known: dict[bytes, Array] = {}  # how far points moved the rows since derivatives were made last: each is asked for again
        self.information = Information(*(0 * part for part in (self.without.shared, self.without.across, self.without.own)))

    def _laid(self, part: Information) -> Information:
        g, k = len(part.shared), self.size
        shared = np.zeros((self.n_shared, self.n_shared))
        across, own = np.zeros((self.blocks, self.n_own, self.n_shared)), np.zeros((self.blocks, self.n_own, self.n_own))
        shared[:g, :g] = part.shared
        for row, first in self.far:
            at = slice(first, first + k)
            shared[at, :g], shared[:g, at], shared[at, at] = part.across[row], part.across[row].T, part.own[row]
        for row, block in self.near:
            across[block, :k, :g], own[block, :k, :k] = part.across[row], part.own[row]
        return Information(shared, across, own)

    def _along(self, weighted: Array) -> tuple[Array, Array]:
        """Jᵀ of weighted rows, with the derivatives made last."""
        assert self._slopes is not None
        by_g, by_own = (v[..., 0] for v in self._slopes.along(lambda at: weighted[at, :, None]))
        shared, own = np.zeros(self.n_shared), np.zeros((self.blocks, self.n_own))
        shared[: by_g.size] = by_g
        for row, first in self.far:
            shared[first : first + self.size] = by_own[row]
        for row, block in self.near:
            own[block, : self.size] = by_own[row]
        return shared, own

    def derive(self, x: Point) -> None:
        """Derivatives at a point, and the information beyond that of the normal prior."""
        self._slopes, self._known = self.idle.slopes(x), {}
        there = self._laid(self._slopes.information(self.idle.weights))
        self.information = there + self.without * -1.0

    def _moved(self, x: Point) -> Array:
        key = x.g.tobytes() + x.own.tobytes()
        if key not in self._known:
            self._known[key] = self.idle.moved(x)
        return self._known[key]

    def value(self, x: Point, shared: Array, own: Array) -> float:
        """Beyond the normal prior, of a point whose unknowns are (n,) and (blocks, k)."""
        return 0.5 * (float(np.sum(self._moved(x) ** 2 * self.idle.weights)) - self.without.quadratic(shared, own))

    def gradient(self, x: Point, shared: Array, own: Array) -> tuple[Array, Array]:
        """Of the value, with the derivatives made last."""
        by_shared, by_own = self._along(self._moved(x) * self.idle.weights)
        straight, straight_own = self.without.times(shared, own)
        return by_shared - straight, by_own - straight_own

    def bend(self, x: Point, part_way: Point, step: Array, own: Array, part: float) -> tuple[Array, Array]:
        """Jᵀ of the negative bend of the rows along a step, of g and of the own unknowns by DOF, from the rows a part of it on."""
        assert self._slopes is not None
        straight = self._slopes.moved(step, own[self.idle.responses])
        bend = (self._moved(part_way) - self._moved(x) - part * straight) / part**2
        return self._along(-bend * self.idle.weights)
