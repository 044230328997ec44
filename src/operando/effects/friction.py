"""Effects that dissipate in a nonlinear way: damping with the square of velocity, dry friction, hysteresis."""

from __future__ import annotations

import numpy as np

from operando.effects.base import Array, EffectKind, Parameter, Values
from operando.effects.nonlinear import NonlinearKind

SQUARE = Parameter("coefficient", "N s2/m2", 1e-6, 1e15, "log", 100.0, "quadratic damping")
FRICTION = Parameter("force", "N", 1e-9, 1e9, "log", 1.0, "friction force")
STIFFNESS = Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e5, "stiffness before it slips")
YIELD = Parameter("yield_force", "N", 1e-9, 1e9, "log", 1.0, "yield force")
EXPONENT = Parameter("exponent", "", 0.5, 10.0, "log", 1.0, "exponent")
RATIO = Parameter("ratio", "", 0.0, 0.95, "linear", 0.1, "stiffness after over before it slips")
SLIP_SPEED = Parameter("slip_speed", "m/s", 0.0, 10.0, "linear", 0.0, "speed below which friction is smoothed")


class QuadraticDamping(NonlinearKind):
    """f = c·v·|v|."""

    kind = "quadratic_damping"
    plain = "damping that grows with the square of velocity"
    parameters = (SQUARE,)
    uses_velocity = True
    moves = "damping"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * v * np.abs(v))

    def confirm(self, place: str, values: Values) -> str:
        return f"measure at half the level: the damping added to the modes that move {place} must halve"


class CoulombFriction(NonlinearKind):
    """f = F·sign(v), smoothed to F·tanh(v/v₀) where a speed v₀ is stated."""

    kind = "coulomb_friction"
    plain = "dry friction"
    parameters = (FRICTION,)
    constants = (SLIP_SPEED,)
    uses_velocity = True
    moves = "damping"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        speed = values.get("slip_speed", 0.0)
        return np.asarray(values["force"] * (np.tanh(v / speed) if speed > 0 else np.sign(v)))

    def over_steps(self, x: Array, v: Array, values: Values, step: float) -> Array:
        return np.asarray(values["force"] * mean_sign(v, values.get("slip_speed", 0.0)))

    def confirm(self, place: str, values: Values) -> str:
        return f"measure at twice the level: the damping added to the modes that move {place} must halve"


class Hysteresis(NonlinearKind):
    """f = r·k·x + (1−r)·F_y·z with ż = (k/F_y)·(v − ½(|v|·|z|^(n−1)·z + v·|z|^n)).

    Bouc (1967), Wen (1976), of unit amplitude: k is the stiffness before it slips, F_y the yield force, r the ratio of the stiffness
    after to that before, n how sharply it yields.
    """

    kind = "hysteresis"
    plain = "a spring that slips and dissipates (hysteresis)"
    parameters = (STIFFNESS, YIELD, EXPONENT, RATIO)
    shape_names = ("yield_force", "exponent", "ratio")
    uses_velocity = True
    has_state = True
    contains = ("coulomb_friction", "ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values, step: float | None = None, start: Array | float = 0.0) -> Array:
        """Force over a segment (…, N) sampled at ``step`` [s]; ``start`` is z at the first sample."""
        if step is None:
            raise ValueError("hysteresis remembers: it needs the sampling step")
        z = self.memory(np.asarray(x, float), values, start)
        k, force, ratio = values["stiffness"], values["yield_force"], values["ratio"]
        return np.asarray(ratio * k * np.asarray(x) + (1 - ratio) * force * z)

    def over_steps(self, x: Array, v: Array, values: Values, step: float) -> Array:
        return self.pseudo_force(x, v, values, step)

    def memory(self, x: Array, values: Values, start: Array | float = 0.0) -> Array:
        """z (…, N) along a displacement: rate-independent, so only the steps of x count; parameters may be arrays of the leading shape."""
        reach = np.asarray(values["yield_force"] / values["stiffness"], float)
        exponent = np.asarray(values["exponent"], float)
        if x.ndim == 1 and reach.ndim == exponent.ndim == np.ndim(start) == 0:
            return _one_memory(x, float(reach), float(exponent), float(start))
        steps = np.moveaxis(np.diff(x, axis=-1), -1, 0) / reach
        z = np.broadcast_to(np.asarray(start, float), steps.shape[1:]).copy()
        out = np.empty((steps.shape[0] + 1, *steps.shape[1:]))
        out[0] = z
        for i, d in enumerate(steps):
            # Two half steps of Heun's rule are exact enough: |dz| is at most |dx|/reach, and z stays within ±1.
            for _ in range(2):
                h = 0.5 * d
                first = h * self._slope(z, h, exponent)
                z = np.clip(z + 0.5 * (first + h * self._slope(np.clip(z + first, -1, 1), h, exponent)), -1, 1)
            out[i + 1] = z
        return np.asarray(np.moveaxis(out, 0, -1))

    @staticmethod
    def _slope(z: Array, step: Array, exponent: Array) -> Array:
        """dz/d(x/reach): 1 on the way back, 1 − |z|^n on the way out."""
        return np.asarray(np.where(z * step > 0, 1 - np.abs(z) ** exponent, 1.0))

    def rate(self, v: Array, z: Array, values: Values) -> Array:
        """ż, for an integrator."""
        reach = values["yield_force"] / values["stiffness"]
        return np.asarray(v / reach * self._slope(z, v, np.asarray(values["exponent"], float)))

    def confirm(self, place: str, values: Values) -> str:
        return f"push {place} slowly to and fro and record force over deflection: the loop must close at {values['yield_force']:.2g} N"


def mean_sign(v: Array, speed: float) -> Array:
    """tanh(v/v₀) (sign where v₀ is 0) in the mean over a step around each sample, the velocity taken as straight in it.

    Between two samples the velocity of a shaken structure changes by more than any speed over which friction is smoothed: taken
    sample by sample its jumps would lie anywhere within a step.
    """
    change = np.abs(np.gradient(v, axis=-1)) if v.shape[-1] > 1 else np.zeros_like(v)
    if speed <= 0:
        return np.asarray(np.clip(2 * v / np.maximum(change, 1e-300), -1, 1))
    half = np.maximum(0.5 * change / speed, 1e-4)
    u = v / speed
    log_cosh = lambda a: np.abs(a) + np.log1p(np.exp(-2 * np.abs(a)))  # noqa: E731
    return np.asarray((log_cosh(u + half) - log_cosh(u - half)) / (2 * half))


def _one_memory(x: Array, reach: float, exponent: float, start: float) -> Array:
    """:meth:`Hysteresis.memory` of one displacement in plain numbers: twenty times faster than arrays of one."""
    z, out = start, [start]
    for half in (0.5 * np.diff(x) / reach).tolist():
        for _ in (0, 1):
            one = half * (1 - abs(z) ** exponent) if z * half > 0 else half
            ahead = min(max(z + one, -1.0), 1.0)
            two = half * (1 - abs(ahead) ** exponent) if ahead * half > 0 else half
            z = min(max(z + 0.5 * (one + two), -1.0), 1.0)
        out.append(z)
    return np.array(out)


KINDS: tuple[type[EffectKind], ...] = (QuadraticDamping, CoulombFriction, Hysteresis)
