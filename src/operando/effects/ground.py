"""Effects at one place against ground or inertia: mass, spring, damper, hysteretic spring, rubber."""

from __future__ import annotations

import numpy as np

from operando.effects.base import Array, EffectKind, Parameter, Quadratic, Values

MASS = Parameter("mass", "kg", 1e-6, 1e6, "log", 0.1, "mass")
STIFFNESS = Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e4, "stiffness")
DAMPING = Parameter("damping", "N s/m", 1e-5, 1e9, "log", 10.0, "viscous damping")
LOSS_FACTOR = Parameter("loss_factor", "", 1e-3, 2.0, "log", 0.1, "loss factor")
EXPONENT = Parameter("exponent", "", 0.08, 0.7, "linear", 0.25, "exponent of frequency")
REFERENCE = Parameter("reference_hz", "Hz", None, None, "linear", None, "frequency at which the stiffness is stated")


def scalar_quadratic(mass: float = 0.0, damping: float = 0.0, stiffness: float = 0.0, size: int = 1) -> Quadratic:
    """m, c, k on each of the place's coordinates."""
    unit = np.eye(size)
    return Quadratic(mass * unit, damping * unit, stiffness * unit)


class PointMass(EffectKind):
    """f = m·a on all measured directions of the node."""

    kind = "point_mass"
    plain = "a mass"
    coordinates = "node"
    parameters = (MASS,)
    moves = "frequencies"
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.asarray(values["mass"] * s**2)

    def quadratic(self, values: Values, size: int = 1) -> Quadratic:
        return scalar_quadratic(mass=values["mass"], size=size)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a mass of {size} {'is missing at' if removed else 'sits on'} {place}"

    def confirm(self, place: str, values: Values) -> str:
        known = max(float(values["mass"]) / 4, 0.005)
        return (
            f"tape a known mass of about {known:.2g} kg to {place} and measure again: the mass found must grow by just that; "
            "or weigh what was put there"
        )


class GroundSpring(EffectKind):
    """f = k·x."""

    kind = "ground_spring"
    plain = "a spring to ground"
    parameters = (STIFFNESS,)
    moves = "frequencies"
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.full(np.shape(s), values["stiffness"], complex)

    def quadratic(self, values: Values, size: int = 1) -> Quadratic:
        return scalar_quadratic(stiffness=values["stiffness"], size=size)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a spring to ground of {size} {'is missing' if removed else 'acts'} at {place}"

    def confirm(self, place: str, values: Values) -> str:
        return f"loosen what holds {place} against its surroundings and measure again: the spring must vanish"


class GroundDamper(EffectKind):
    """f = c·v."""

    kind = "ground_damper"
    plain = "a damper to ground"
    parameters = (DAMPING,)
    moves = "damping"
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.asarray(values["damping"] * s)

    def quadratic(self, values: Values, size: int = 1) -> Quadratic:
        return scalar_quadratic(damping=values["damping"], size=size)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a viscous damper to ground of {size} {'is missing' if removed else 'acts'} at {place}"

    def confirm(self, place: str, values: Values) -> str:
        return f"measure at half the level: a viscous damper at {place} keeps its size, dry friction would seem twice as strong"


class GroundHystereticSpring(EffectKind):
    """Z = k(1 + iη): damping that does not grow with frequency. In the lower half of the s-plane the conjugate."""

    kind = "ground_hysteretic_spring"
    plain = "a spring to ground with hysteretic damping"
    parameters = (STIFFNESS, LOSS_FACTOR)
    contains = ("ground_spring",)
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        side = np.where(np.imag(s) < 0, -1.0, 1.0)
        return np.asarray(values["stiffness"] * (1 + 1j * side * values["loss_factor"]))

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a spring to ground that dissipates the same at every frequency ({size}) {'is missing' if removed else 'acts'} at {place}"

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"measure {place} over a wider band: the loss of a hysteretic spring stays the same from the lowest to the highest mode, "
            "that of a viscous damper grows with frequency"
        )


class GroundRubber(EffectKind):
    """Z = k·(s/ω_0)^α, ω_0 at ``reference_hz``: stiffness and loss both rise with frequency (a fractional derivative)."""

    kind = "ground_rubber"
    plain = "a rubber mount to ground"
    parameters = (STIFFNESS, EXPONENT)
    constants = (REFERENCE,)
    contains = ("ground_spring", "ground_hysteretic_spring")
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * (np.asarray(s, complex) / (2 * np.pi * values["reference_hz"])) ** values["exponent"])

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a rubber-like spring to ground ({size}) {'is missing' if removed else 'acts'} at {place}"

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"measure {place} again warmer or colder: the stiffness of rubber changes with temperature; "
            "or load the mount alone at two frequencies an octave apart"
        )


KINDS = (PointMass, GroundSpring, GroundDamper, GroundHystereticSpring, GroundRubber)
