"""The closed loop: modes driven by measured forces and by restoring forces that depend on where they move.

The modes are integrated exactly for forces that run straight between steps (first-order hold); the restoring force at the end of a step is
solved for, not extrapolated, so stiff contacts and dry friction stay stable. Several cases (records, values) run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from operando.nonlinear.run import Complex, Real

BLOCK = 16
"""Steps between two updates of the modal state: inside, the response is a short convolution."""

NEWTON, SOLVED = 12, 1e-4
"""Steps at most, and the change of v/v₀ that ends them: each squares the error."""

Law = Callable[[Real, Real], Real]
"""Restoring force of displacement and velocity, each (cases,)."""


@dataclass(frozen=True)
class Loop:
    """Response across places to forces along them, as modes.

    Parameters
    ----------
    poles : (n,) complex array
        λ [rad/s], one of each conjugate pair.
    shapes : (p, n) array
        Shape values at the places; x_p = Σ shapes[p]·q.
    step : float
        [s].
    """

    poles: Complex
    shapes: Real
    step: float

    def kernels(self) -> tuple[Complex, Complex, Complex]:
        """exp(λh) and the weights of a force at the beginning and the end of a step, straight in between."""
        lh = self.poles * self.step
        e = np.exp(lh)
        small = np.abs(lh) < 1e-4
        safe = np.where(small, 1.0, lh)
        end = np.where(small, 0.5 + lh / 6 + lh**2 / 24, (e - 1 - lh) / safe**2) * self.step
        whole = np.where(small, 1 + lh / 2 + lh**2 / 6, (e - 1) / safe) * self.step
        return np.asarray(e), np.asarray(whole - end), np.asarray(end)


def run_loop(
    loop: Loop,
    x_free: Real,
    v_free: Real,
    laws: Sequence[StepLaw],
) -> tuple[Real, Real, Real]:
    """Restoring forces, displacements and velocities of all cases.

    Parameters
    ----------
    loop : Loop
    x_free, v_free : (p, cases, N) arrays
        Motion across the places under the measured forces alone.
    laws : sequence of StepLaw
        One a place.

    Returns
    -------
    s, x, v : (p, cases, N) arrays
    """
    places, cases, n = x_free.shape
    e, c0, c1 = loop.kernels()
    damped = loop.poles.imag
    # x = Im(z)/ω_d, v = Im(λz)/ω_d for z' = λz + u.
    out_x = loop.shapes / damped
    out_v = out_x * loop.poles
    powers = e[None, :] ** np.arange(1, BLOCK + 1)[:, None]
    # Free motion from the state over a block, and the response to unit samples of force within it.
    state_x = np.stack([np.concatenate([(out_x * p).imag, (out_x * p).real], axis=1) for p in powers])
    state_v = np.stack([np.concatenate([(out_v * p).imag, (out_v * p).real], axis=1) for p in powers])
    drive = loop.shapes
    first_x = np.einsum("pn,qn,jn->jpq", out_x, drive, powers / e * c0).imag
    last_x = np.einsum("pn,qn,jn->jpq", out_x, drive, powers / e * c1).imag
    first_v = np.einsum("pn,qn,jn->jpq", out_v, drive, powers / e * c0).imag
    last_v = np.einsum("pn,qn,jn->jpq", out_v, drive, powers / e * c1).imag
    z = np.zeros((loop.poles.size, cases), complex)
    s_all, x_all, v_all = np.zeros((3, places, cases, n))
    s = np.zeros((places, cases))
    for p, law in enumerate(laws):
        s[p] = law.begin(x_free[p, :, 0], v_free[p, :, 0])
        s_all[p, :, 0], x_all[p, :, 0], v_all[p, :, 0] = s[p], x_free[p, :, 0], v_free[p, :, 0]
    near_x, near_v = last_x[0], last_v[0]
    single = places == 1
    # Within a block: force samples s_0 (block start) … s_j; weights of each at step j.
    block_x = np.zeros((BLOCK + 1, BLOCK + 1, places, places))
    block_v = np.zeros_like(block_x)
    for j in range(1, BLOCK + 1):
        for i in range(1, j + 1):  # force between i−1 and i seen at j
            block_x[j, i - 1] += first_x[j - i]
            block_x[j, i] += last_x[j - i]
            block_v[j, i - 1] += first_v[j - i]
            block_v[j, i] += last_v[j - i]
    done = 0
    gains = np.stack([block_x[:, :, 0, 0], block_v[:, :, 0, 0]])

    @lru_cache(maxsize=2)
    def push(count: int) -> Real:
        """What forces within a block add to the state at its end, real parts above imaginary ones, (2n, (count + 1)·p)."""
        back = powers[count - 1 :: -1] / e
        weights = np.zeros((count + 1, e.size), complex)
        weights[:-1] += back * c0
        weights[1:] += back * c1
        both = (weights[:, None, :] * drive[None]).reshape(-1, e.size).T
        return np.concatenate([both.real, both.imag])

    while done < n - 1:
        count = min(BLOCK, n - 1 - done)
        stacked = np.concatenate([z.real, z.imag])
        xs = x_free[:, :, done + 1 : done + 1 + count].transpose(2, 0, 1) + state_x[:count] @ stacked
        vs = v_free[:, :, done + 1 : done + 1 + count].transpose(2, 0, 1) + state_v[:count] @ stacked
        inside = np.zeros((count + 1, places, cases))
        inside[0] = s
        for j in range(1, count + 1):
            if single:
                x_past, v_past = gains[:, j, :j] @ inside[:j, 0]
                s1, xs[j - 1, 0], vs[j - 1, 0] = laws[0].solve(xs[j - 1, 0] - x_past, vs[j - 1, 0] - v_past, near_x[0, 0], near_v[0, 0])
                inside[j, 0] = s1
                continue
            x = xs[j - 1] - np.einsum("ipq,iqc->pc", block_x[j, :j], inside[:j])
            v = vs[j - 1] - np.einsum("ipq,iqc->pc", block_v[j, :j], inside[:j])
            s_new = inside[j - 1].copy()
            for turn in range(3):
                for p, law in enumerate(laws):
                    others = s_new.copy()
                    others[p] = 0
                    s_new[p], xs[j - 1, p], vs[j - 1, p] = law.solve(
                        x[p] - near_x[p] @ others, v[p] - near_v[p] @ others, near_x[p, p], near_v[p, p], commit=turn == 2
                    )
            inside[j] = s_new
        pushed = push(count) @ inside.reshape(-1, cases)
        z = z * (e**count)[:, None] - (pushed[: e.size] + 1j * pushed[e.size :])
        s = inside[count]
        span = slice(done + 1, done + 1 + count)
        s_all[:, :, span] = inside[1:].transpose(1, 2, 0)
        x_all[:, :, span] = xs.transpose(1, 2, 0)
        v_all[:, :, span] = vs.transpose(1, 2, 0)
        done += count
    return s_all, x_all, v_all


class StepLaw:
    """A restoring force solved for at the end of each step.

    Parameters
    ----------
    force : callable
        (x, v) → s, each (cases,); must not fall with x or v by more than the structure can bear.
    """

    def __init__(self, force: Law) -> None:
        self.force = force
        self._last: Real | None = None

    def begin(self, x: Real, v: Real) -> Real:
        """Force at the first sample."""
        self._last = np.asarray(self.force(x, v), float)
        return self._last

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> tuple[Real, Real, Real]:
        """s with s = force(x − near_x·s, v − near_v·s), and the motion then: secant steps from the last force."""
        assert self._last is not None
        # A short step leaves little to solve: two substitutions usually do; secant steps where the contact is stiff for the step.
        a = self.force(x - near_x * self._last, v - near_v * self._last)
        b = self.force(x - near_x * a, v - near_v * a)
        if np.abs(b - a).max() > 1e-4 * (np.abs(b).max() + 1e-300):
            b = self._bracketed(x, v, near_x, near_v)
        if commit:
            self._last = b
        return b, x - near_x * b, v - near_v * b

    def _bracketed(self, x: Real, v: Real, near_x: float, near_v: float) -> Real:
        """Root of s − force(x − near_x·s, v − near_v·s) between 0 and force(x, v), where it lies for a force that grows with x and v.

        False position with the Illinois rule: a stop stiffer than the structure within a step does not throw it out.
        """
        low = np.zeros_like(x)
        high = np.asarray(self.force(x, v), float)
        f_low, f_high = -high, high - self.force(x - near_x * high, v - near_v * high)
        s = high
        for _ in range(40):
            span = f_high - f_low
            s = np.where(np.abs(span) > 1e-300, low - f_low * (high - low) / np.where(np.abs(span) > 1e-300, span, 1.0), low)
            f = s - self.force(x - near_x * s, v - near_v * s)
            if np.all(np.abs(f) <= 1e-7 * (np.abs(s) + 1e-12 * np.abs(high).max())) or not np.any(low != high):
                break
            same = f * f_high > 0
            # The end that stays counts half.
            f_low = np.where(same, 0.5 * f_low, f_high)
            low = np.where(same, low, high)
            high, f_high = s, f
        return np.asarray(s)


class FrictionLaw(StepLaw):
    """Dry friction F·sign(v): sticks where the force needed to hold is below F.

    Parameters
    ----------
    level : (cases,) array
        F [N].
    """

    def __init__(self, level: Real) -> None:
        super().__init__(lambda x, v: level * np.sign(v))
        self.level = level

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> tuple[Real, Real, Real]:
        b = np.clip(v / near_v, -self.level, self.level)
        return b, x - near_x * b, v - near_v * b


class SlipLaw(StepLaw):
    """Dry friction F·tanh(v/v₀).

    Parameters
    ----------
    level, speed : (cases,) arrays
        F [N] and v₀ [m/s].
    """

    def __init__(self, level: Real, speed: Real) -> None:
        super().__init__(lambda x, v: level * np.tanh(v / speed))
        self.level, self.speed = level, speed

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> tuple[Real, Real, Real]:
        # u = v/v₀ of the root of u + a·tanh(u) = w: concave for w > 0, so Newton's steps from below never pass it.
        size, a = np.abs(v) / self.speed, near_v * self.level / self.speed
        u = np.maximum(size / (1 + a), size - a)
        for _ in range(NEWTON):
            t = np.tanh(u)
            step = (size - u - a * t) / (1 + a * (1 - t * t))
            u = u + step
            if step.max() < SOLVED:
                break
        b = np.copysign(self.level * np.tanh(u), v)
        return b, x - near_x * b, v - near_v * b


class MemoryLaw(StepLaw):
    """Bouc–Wen hysteresis with its internal z, by the displacement's step (rate-independent).

    Parameters
    ----------
    stiffness, yield_force, exponent, ratio : (cases,) arrays
    slope : callable
        (z, step, exponent) → dz/d(x/reach).
    start : (cases,) array
        z at the beginning.
    """

    def __init__(
        self, stiffness: Real, yield_force: Real, exponent: Real, ratio: Real, slope: Callable[[Real, Real, Real], Real], start: Real
    ) -> None:
        super().__init__(lambda x, v: ratio * stiffness * x)
        self.stiffness, self.yield_force, self.exponent, self.ratio, self.slope = stiffness, yield_force, exponent, ratio, slope
        self.start = start
        self.z = np.array(start, float)
        self.x = np.zeros_like(self.z)

    def begin(self, x: Real, v: Real) -> Real:
        self.z, self.x = np.array(self.start, float), np.array(x)
        self._last = self.ratio * self.stiffness * x + (1 - self.ratio) * self.yield_force * self.z
        return self._last

    def _next(self, x: Real) -> Real:
        h = (x - self.x) * self.stiffness / self.yield_force
        first = h * self.slope(self.z, h, self.exponent)
        return np.clip(self.z + 0.5 * (first + h * self.slope(np.clip(self.z + first, -1, 1), h, self.exponent)), -1, 1)

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> tuple[Real, Real, Real]:
        def force(at: Real, _: Real) -> Real:
            return self.ratio * self.stiffness * at + (1 - self.ratio) * self.yield_force * self._next(at)

        self.force = force
        b, x1, v1 = super().solve(x, v, near_x, near_v, commit)
        if commit:
            self.z, self.x = self._next(x1), np.array(x1)
        return b, x1, v1
