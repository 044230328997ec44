"""Effects whose force depends on the displacement in a nonlinear way: polynomial springs, gaps, contacts, saturation."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from operando.effects.base import Array, EffectKind, Parameter, Values

CUBIC = Parameter("coefficient", "N/m3", 1e-3, 1e22, "log", 1e9, "cubic stiffness")
QUADRATIC = Parameter("coefficient", "N/m2", 1e-3, 1e18, "log", 1e7, "quadratic stiffness")
STIFFNESS = Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e5, "stiffness")
GAP = Parameter("gap", "m", 1e-9, 1.0, "log", 1e-4, "gap")
KNEE = Parameter("knee", "m", 1e-9, 1.0, "log", 1e-4, "knee")


class NonlinearKind(EffectKind):
    """What the level-dependent kinds share: one or two places, a restoring force of motion, words.

    Attributes
    ----------
    shape_names : tuple of str
        Parameters that bend the law; the first parameter scales it (the law is linear in it).
    odd : bool
        Whether f(−x, −v) = −f(x, v); else the side is the sign of the DOF.
    uses_velocity, has_state : bool
        Whether the force depends on velocity; whether it remembers (hysteresis).
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
    parameters = (CUBIC,)
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * x**3)

    def confirm(self, place: str, values: Values) -> str:
        return f"measure at half the level: the frequencies that move {place} must shift by a quarter as much"


class QuadraticStiffness(NonlinearKind):
    """f = k·x², towards one side."""

    kind = "quadratic_stiffness"
    plain = "a spring that is stiffer on one side, with the square of its deflection"
    parameters = (QUADRATIC,)
    odd = False
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["coefficient"] * x**2)

    def confirm(self, place: str, values: Values) -> str:
        return f"shake {place} with one sine: the second harmonic must grow with the square of the level, and the mean position must move"


class Clearance(NonlinearKind):
    """f = k(x−g) for x > g, k(x+g) for x < −g, else 0."""

    kind = "clearance"
    plain = "a stop with play on both sides"
    parameters = (STIFFNESS, GAP)
    shape_names = ("gap",)
    contains = ("ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * (x - np.clip(x, -values["gap"], values["gap"])))

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"measure with deflections at {place} below {values['gap']:.2g} m: the effect must vanish; then shim the play and measure "
            "again: a plain spring must be left"
        )


class OneSidedContact(NonlinearKind):
    """f = k(x−g) for x > g, else 0."""

    kind = "one_sided_contact"
    plain = "a stop on one side"
    parameters = (STIFFNESS, GAP)
    shape_names = ("gap",)
    odd = False
    contains = ("bilinear_stiffness",)

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * np.maximum(x - values["gap"], 0.0))

    def confirm(self, place: str, values: Values) -> str:
        return f"move the stop at {place} away by {values['gap']:.2g} m and measure again: the contact must come later or vanish"


class BilinearStiffness(NonlinearKind):
    """f = k·x for x > 0, else 0."""

    kind = "bilinear_stiffness"
    plain = "a spring that acts on one side only"
    parameters = (STIFFNESS,)
    odd = False
    contains = ("ground_spring", "coupling_spring")

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * np.maximum(x, 0.0))

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"no other level can show it (it scales with the level); shake {place} with one sine and look for even harmonics, "
            "or preload the joint and measure again"
        )


class SaturatingSpring(NonlinearKind):
    """f = k·d·tanh(x/d)."""

    kind = "saturating_spring"
    plain = "a spring that yields to large deflections"
    parameters = (STIFFNESS, KNEE)
    shape_names = ("knee",)
    contains = ("ground_spring", "coupling_spring")
    moves = "frequencies"

    def pseudo_force(self, x: Array, v: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * values["knee"] * np.tanh(x / values["knee"]))

    def confirm(self, place: str, values: Values) -> str:
        return f"measure with deflections at {place} well below {values['knee']:.2g} m: a plain spring must be left"


KINDS: tuple[type[EffectKind], ...] = (
    CubicStiffness,
    QuadraticStiffness,
    Clearance,
    OneSidedContact,
    BilinearStiffness,
    SaturatingSpring,
)
