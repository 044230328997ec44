"""Effects that dissipate in a nonlinear way: damping with the square of velocity, dry friction, hysteresis."""

from __future__ import annotations

import math
from functools import lru_cache

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


SATURATED = 18.0
"""v/v₀ from which tanh differs from one by less than rounding."""


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
    out = np.sign(u)
    # tanh is one to all digits beyond: most of a fast motion.
    slow = np.nonzero(np.abs(u) - half < SATURATED)
    high, low = u[slow] + half[slow], u[slow] - half[slow]
    log_cosh = lambda a: np.abs(a) + np.log1p(np.exp(-2 * np.abs(a)))  # noqa: E731
    out[slow] = (log_cosh(high) - log_cosh(low)) / (high - low)
    return np.asarray(out)


def _one_memory(x: Array, reach: float, exponent: float, start: float) -> Array:
    """:meth:`Hysteresis.memory` of one displacement, from reversal to reversal.

    On one way z follows the displacement alone: back to zero it falls with it, and out it grows as dz/dy = 1 − zⁿ, y = |x|/reach.
    So only the values at reversals follow from each other; all samples between are looked up.
    """
    table, even, way_to = _way_out(exponent)
    ways_to, per = way_to.tolist(), 1 / float(even[1])
    last = len(ways_to) - 2
    y = x / reach
    change = np.diff(y)
    up = change > 0
    still = change == 0
    if still.any():
        # A rest belongs to the way before it.
        up = up[np.maximum.accumulate(np.where(still, 0, np.arange(up.size)))]
    begins = np.concatenate([[0], np.flatnonzero(up[1:] != up[:-1]) + 1])
    sense = np.where(up[begins], 1.0, -1.0)
    out_of, most = table.tolist(), table.size - 2
    # z seen along the way that begins, so its sign turns with each way; and how far out from zero each begins.
    z, starts = start * float(sense[0]), []
    for way in np.abs(np.diff(np.append(y[begins], y[-1]))).tolist():
        if z < 0:
            starts.append(z)
            out = way + z
            if out <= 0:
                z = -out
                continue
        else:
            at = -math.log1p(-z) * per if z < 1 else last
            i = int(at) if at < last else last
            starts.append(ways_to[i] + (at - i) * (ways_to[i + 1] - ways_to[i]))
            out = way + starts[-1]
        at = out / WAY
        i = int(at)
        z = -(out_of[i] + (at - i) * (out_of[i + 1] - out_of[i]) if i < most else out_of[-1])
    counts = np.diff(np.append(begins, y.size - 1))
    senses = np.repeat(sense, counts)
    gone = np.repeat(np.array(starts) - sense * y[begins], counts) + senses * y[1:]
    ahead = np.clip(gone / WAY, 0, table.size - 1)
    index = np.minimum(ahead.astype(np.intp), most)
    outward = table[index] + (ahead - index) * np.diff(table)[index]
    return np.concatenate([[start], senses * np.where(gone <= 0, gone, outward)])


WAY, LONGEST = 0.002, 24.0
"""Steps and end of the way out that is tabulated, in reaches; at its end z is one."""


@lru_cache(maxsize=8)
def _way_out(exponent: float) -> tuple[Array, Array, Array]:
    """z at even steps of the way out from zero; even steps of −ln(1 − z), and the way gone at them."""
    # Even in q = −ln(1 − z), where the way is nearly straight.
    q = np.linspace(0, LONGEST * max(exponent, 1.0), 6001)
    z = -np.expm1(-q)
    middle = -np.expm1(-0.5 * (q[1:] + q[:-1]))
    slope = np.append(1.0, (1 - z[1:]) / np.maximum(1 - z[1:] ** exponent, 1e-300))
    slope[z >= 1] = 1 / exponent
    inner = (1 - middle) / np.maximum(1 - middle**exponent, 1e-300)
    inner[middle >= 1] = 1 / exponent
    way = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1] + 4 * inner) / 6 * np.diff(q))])
    table = np.interp(WAY * np.arange(int(LONGEST / WAY) + 1), way, z)
    return table, q, way


KINDS: tuple[type[EffectKind], ...] = (QuadraticDamping, CoulombFriction, Hysteresis)
