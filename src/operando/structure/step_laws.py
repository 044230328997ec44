"""Force laws solved for at the end of each step of a closed loop; cases run side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from operando.structure.force_law import ForceLaw, raw_force
from operando.structure.modal_space import Real

NEWTON, SOLVED = 12, 1e-4
"""Steps at most, and the change of v/v₀ that ends them: each squares the error."""


def step_law(laws: Sequence[ForceLaw], step: float, memory: Real) -> StepLaw:
    """Laws of one kind, one a case, as one; ``memory`` is the state that those that remember begin with."""
    first = laws[0]
    values = {name: np.array([law.values[name] for law in laws]) for name in first.values}
    if first.remembers:
        return MemoryLaw(first, values, memory)
    if first.kind == "coulomb_friction":
        speed = values.get("slip_speed", np.zeros(len(laws)))
        return SlipLaw(values["force"], speed) if np.all(speed > 0) else FrictionLaw(values["force"])
    kind, side = first.definition, first.side
    return StepLaw(lambda x, v: side * raw_force(kind, side * x, side * v, values, step))


class StepLaw:
    """A restoring force (x, v) → s, each (cases,); must not fall with x or v by more than the structure can bear."""

    def __init__(self, force: Callable[[Real, Real], Real]) -> None:
        self.force = force

    def begin(self, x: Real, v: Real) -> Real:
        """Force at the first sample."""
        self._last = np.asarray(self.force(x, v), float)
        return self._last

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> Real:
        """s with s = force(x − near_x·s, v − near_v·s): substitutions from the last force, kept for the next step by ``commit``."""
        # A short step leaves little to solve: two substitutions usually do; secant steps where the contact is stiff for the step.
        a = self.force(x - near_x * self._last, v - near_v * self._last)
        b = self.force(x - near_x * a, v - near_v * a)
        if np.abs(b - a).max() > 1e-4 * (np.abs(b).max() + 1e-300):
            b = self._bracketed(x, v, near_x, near_v)
        if commit:
            self._last = b
        return b

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
    """Dry friction F·sign(v), F (cases,) [N]: sticks where the force needed to hold is below F."""

    def __init__(self, level: Real) -> None:
        super().__init__(lambda x, v: level * np.sign(v))
        self.level = level

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> Real:
        return np.clip(v / near_v, -self.level, self.level)


class SlipLaw(StepLaw):
    """Dry friction F·tanh(v/v₀), F [N] and v₀ [m/s] (cases,)."""

    def __init__(self, level: Real, speed: Real) -> None:
        super().__init__(lambda x, v: level * np.tanh(v / speed))
        self.level, self.speed = level, speed

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> Real:
        # u = v/v₀ of the root of u + a·tanh(u) = w: concave for w > 0, so Newton's steps from below never pass it.
        size, a = np.abs(v) / self.speed, near_v * self.level / self.speed
        u = np.maximum(size / (1 + a), size - a)
        for _ in range(NEWTON):
            t = np.tanh(u)
            step = (size - u - a * t) / (1 + a * (1 - t * t))
            u = u + step
            if step.max() < SOLVED:
                break
        return np.copysign(self.level * np.tanh(u), v)


class MemoryLaw(StepLaw):
    """Bouc–Wen hysteresis with its internal z, by the displacement's step (rate-independent)."""

    def __init__(self, law: ForceLaw, values: dict[str, Real], start: Real) -> None:
        ratio = values["ratio"]
        self.after, self.force_of_z = ratio * values["stiffness"], (1 - ratio) * values["yield_force"]
        self.per_reach, self.exponent = values["stiffness"] / values["yield_force"], values["exponent"]
        self.slope = law.definition.slope  # type: ignore[attr-defined]
        self.z = np.array(start, float)
        super().__init__(lambda x, v: self.after * x + self.force_of_z * self._next(x))

    def begin(self, x: Real, v: Real) -> Real:
        self.x = np.array(x)
        return super().begin(x, v)

    def _next(self, x: Real) -> Real:
        h = (x - self.x) * self.per_reach
        first = h * self.slope(self.z, h, self.exponent)
        return np.clip(self.z + 0.5 * (first + h * self.slope(np.clip(self.z + first, -1, 1), h, self.exponent)), -1, 1)

    def solve(self, x: Real, v: Real, near_x: float, near_v: float, commit: bool = True) -> Real:
        b = super().solve(x, v, near_x, near_v, commit)
        if commit:
            at = x - near_x * b
            self.z, self.x = self._next(at), at
        return b
