"""Bouc–Wen hysteresis: the one kind that remembers, and its internal state along a displacement."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from operando.structure.effects.base import Array, EffectKind, Parameter, Values
from operando.structure.effects.level_dependent import NonlinearKind

WAY, LONGEST = 0.002, 24.0
"""Steps and end of the way out that is tabulated, in reaches; at its end z is one."""


class Hysteresis(NonlinearKind):
    """f = r·k·x + (1−r)·F_y·z with ż = (k/F_y)·(v − ½(|v|·|z|^(n−1)·z + v·|z|^n)).

    Bouc (1967), Wen (1976), of unit amplitude: k is the stiffness before it slips, F_y the yield force, r the ratio of the stiffness
    after to that before, n how sharply it yields.
    """

    kind = "hysteresis"
    plain = "a spring that slips and dissipates (hysteresis)"
    confirms = "push {location} slowly to and fro and record force over deflection: the loop must close at {sizes[yield_force]}"
    parameters = (
        Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e5, "stiffness before it slips"),
        Parameter("yield_force", "N", 1e-9, 1e9, "log", 1.0, "yield force"),
        Parameter("exponent", "", 0.5, 10.0, "log", 1.0, "exponent"),
        Parameter("ratio", "", 0.0, 0.95, "linear", 0.1, "stiffness after over before it slips"),
    )
    shape_names = ("yield_force", "exponent", "ratio")
    uses_velocity = True
    has_state = True
    contains = ("coulomb_friction", "ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        """Force along a displacement (N,) that begins with z = 0; rate-independent, so the steps may be of any length."""
        return self._force(x, self.memory(x, values), values)

    def over_steps(self, x: Array, v: Array, values: Values, step: float) -> Array:
        """The same where the motion turns round between samples, too."""
        return self._force(x, self.memory(x, values, v * step), values)

    @staticmethod
    def _force(x: Array, z: Array, values: Values) -> Array:
        return np.asarray(values["ratio"] * values["stiffness"] * x + (1 - values["ratio"]) * values["yield_force"] * z)

    def memory(self, x: Array, values: Values, rise: Array | None = None) -> Array:
        """z (N,) along a displacement, from reversal to reversal, zero at the first sample.

        On one way z follows the displacement alone: back to zero it falls with it, and out it grows as dz/dy = 1 − zⁿ, y = |x|/reach.
        So only the values at reversals follow from each other; all samples between are looked up. ``rise`` (N,) is velocity times step:
        with it the reversals lie where the motion turns round, not at the samples next to them.
        """
        if rise is not None:
            between, turned = turning_points(x, rise)
            own = np.arange(x.size) + np.searchsorted(between, np.arange(x.size))
            return self.memory(np.insert(x, between + 1, turned), values)[own]
        table, even, way_to = _way_out(float(values["exponent"]))
        ways_to, per = way_to.tolist(), 1 / float(even[1])
        last = len(ways_to) - 2
        y = np.asarray(x, float) / float(values["yield_force"] / values["stiffness"])
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
        z, starts = 0.0, []
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
        return np.concatenate([[0.0], senses * np.where(gone <= 0, gone, outward)])

    @staticmethod
    def slope(z: Array, step: Array, exponent: Array) -> Array:
        """dz/d(x/reach): 1 on the way back, 1 − |z|^n on the way out."""
        return np.asarray(np.where(z * step > 0, 1 - np.abs(z) ** exponent, 1.0))


def turning_points(x: Array, rise: Array) -> tuple[Array, Array]:
    """Samples after which a motion (N,) turns round before the next, and its displacement there; ``rise`` is velocity times step.

    Extremum of the cubic through displacement and velocity at both samples. A way that ends at a sample is too short by up to an
    eighth of the acceleration times the step squared: at eight samples a period this moved exponents by 3 %.
    """
    at = np.flatnonzero(rise[:-1] * rise[1:] < 0)
    way, first, last = x[at + 1] - x[at], rise[at], rise[at + 1]
    # x(t) = x₀ + t·(first + t·(bend + t·twist)), 0 < t < 1; the root of its derivative by the form that does not cancel.
    bend, twist = 3 * way - 2 * first - last, first + last - 2 * way
    root = np.sqrt(np.maximum(bend**2 - 3 * twist * first, 0))
    q = -(bend + np.copysign(root, bend))
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = first / q, q / (3 * twist)
    t = np.where((one >= 0) & (one <= 1), one, np.clip(np.nan_to_num(other), 0, 1))
    return at, x[at] + t * (first + t * (bend + t * twist))


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


KINDS: tuple[type[EffectKind], ...] = (Hysteresis,)
