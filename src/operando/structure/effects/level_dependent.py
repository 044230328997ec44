"""Effects whose force depends on the motion in a nonlinear way: polynomial springs, gaps, contacts, saturation, friction."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from operando.structure.effects.base import Array, EffectKind, Parameter, Values

CUBIC = Parameter("coefficient", "N/m3", 1e-3, 1e22, "log", 1e9, "cubic stiffness")
QUADRATIC = Parameter("coefficient", "N/m2", 1e-3, 1e18, "log", 1e7, "quadratic stiffness")
STIFFNESS = Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e5, "stiffness")
GAP = Parameter("gap", "m", 1e-9, 1.0, "log", 1e-4, "gap")
KNEE = Parameter("knee", "m", 1e-9, 1.0, "log", 1e-4, "knee")
SQUARE = Parameter("coefficient", "N s2/m2", 1e-6, 1e15, "log", 100.0, "quadratic damping")
FRICTION = Parameter("force", "N", 1e-9, 1e9, "log", 1.0, "friction force")
SLIP_SPEED = Parameter("slip_speed", "m/s", 0.0, 10.0, "linear", 0.0, "speed below which friction is smoothed")

SATURATED = 18.0
"""v/v₀ from which tanh differs from one by less than rounding."""


class NonlinearKind(EffectKind):
    """What the level-dependent kinds share: one or two places, a restoring force of motion, words.

    ``shape_names`` are the parameters that bend the law; the first parameter scales it (the law is linear in it). ``odd`` says whether
    f(−x, −v) = −f(x, v): else the side is the sign of the DOF; ``uses_velocity`` whether the force depends on velocity; ``has_state``
    whether it remembers (hysteresis).
    """

    acts = "pseudo_force"
    places = 1
    level_dependent = True
    shape_names: ClassVar[tuple[str, ...]] = ()
    odd: ClassVar[bool] = True
    uses_velocity: ClassVar[bool] = False
    has_state: ClassVar[bool] = False
    alternative_places: ClassVar[tuple[int, ...]] = (2,)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"{self.plain} acts {'between' if ' and ' in place else 'at'} {place} ({size})"


class CubicStiffness(NonlinearKind):
    """f = k·x³."""

    kind = "cubic_stiffness"
    plain = "a spring that stiffens with the cube of its deflection"
    confirms = "measure at half the level: the frequencies that move {location} must shift by a quarter as much"
    parameters = (CUBIC,)
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * x**3)


class QuadraticStiffness(NonlinearKind):
    """f = k·x², towards one side."""

    kind = "quadratic_stiffness"
    plain = "a spring that is stiffer on one side, with the square of its deflection"
    confirms = "shake {location} with one sine: the second harmonic must grow with the square of the level, and the mean position must move"
    parameters = (QUADRATIC,)
    odd = False
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * x**2)


class Clearance(NonlinearKind):
    """f = k(x−g) for x > g, k(x+g) for x < −g, else 0."""

    kind = "clearance"
    plain = "a stop with play on both sides"
    confirms = (
        "measure with deflections at {location} below {sizes[gap]}: the effect must vanish; then shim the play and measure "
        "again: a plain spring must be left"
    )
    parameters = (STIFFNESS, GAP)
    shape_names = ("gap",)
    contains = ("ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * (x - np.clip(x, -values["gap"], values["gap"])))


class OneSidedContact(NonlinearKind):
    """f = k(x−g) for x > g, else 0."""

    kind = "one_sided_contact"
    plain = "a stop on one side"
    confirms = "move the stop at {location} away by {sizes[gap]} and measure again: the contact must come later or vanish"
    parameters = (STIFFNESS, GAP)
    shape_names = ("gap",)
    odd = False
    contains = ("bilinear_stiffness",)

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * np.maximum(x - values["gap"], 0.0))


class BilinearStiffness(NonlinearKind):
    """f = k·x for x > 0, else 0."""

    kind = "bilinear_stiffness"
    plain = "a spring that acts on one side only"
    confirms = (
        "no other level can show it (it scales with the level); shake {location} with one sine and look for even harmonics, "
        "or preload the joint and measure again"
    )
    parameters = (STIFFNESS,)
    odd = False
    contains = ("ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * np.maximum(x, 0.0))


class SaturatingSpring(NonlinearKind):
    """f = k·d·tanh(x/d)."""

    kind = "saturating_spring"
    plain = "a spring that yields to large deflections"
    confirms = "measure with deflections at {location} well below {sizes[knee]}: a plain spring must be left"
    parameters = (STIFFNESS, KNEE)
    shape_names = ("knee",)
    contains = ("ground_spring", "coupling_spring")
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * values["knee"] * np.tanh(x / values["knee"]))


class QuadraticDamping(NonlinearKind):
    """f = c·v·|v|."""

    kind = "quadratic_damping"
    plain = "damping that grows with the square of velocity"
    confirms = "measure at half the level: the damping added to the modes that move {location} must halve"
    parameters = (SQUARE,)
    uses_velocity = True
    moves = "damping"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * v * np.abs(v))


class CoulombFriction(NonlinearKind):
    """f = F·sign(v), smoothed to F·tanh(v/v₀) where a speed v₀ is stated."""

    kind = "coulomb_friction"
    plain = "dry friction"
    confirms = "measure at twice the level: the damping added to the modes that move {location} must halve"
    parameters = (FRICTION,)
    constants = (SLIP_SPEED,)
    uses_velocity = True
    moves = "damping"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        speed = values.get("slip_speed", 0.0)
        return np.asarray(values["force"] * (np.tanh(v / speed) if speed > 0 else np.sign(v)))

    def over_steps(self, x: Array, v: Array, values: Values, step: float) -> Array:
        return np.asarray(values["force"] * mean_sign(v, values.get("slip_speed", 0.0)))


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


KINDS: tuple[type[EffectKind], ...] = (
    CubicStiffness, QuadraticStiffness, Clearance, OneSidedContact, BilinearStiffness, SaturatingSpring, QuadraticDamping, CoulombFriction,
)  # fmt: skip
