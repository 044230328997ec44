"""Linear effects on the structure: mass, springs and dampers to ground or between two points, absorber, skew couplings of a rotor."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from operando.structure.effects.base import Array, EffectKind, Parameter, Quadratic, Values

MASS = Parameter("mass", "kg", 1e-6, 1e6, "log", 0.1, "mass")
STIFFNESS = Parameter("stiffness", "N/m", 1e-2, 1e13, "log", 1e4, "stiffness")
DAMPING = Parameter("damping", "N s/m", 1e-5, 1e9, "log", 10.0, "viscous damping")
LOSS_FACTOR = Parameter("loss_factor", "", 1e-3, 2.0, "log", 0.1, "loss factor")
EXPONENT = Parameter("exponent", "", 0.08, 0.7, "linear", 0.25, "exponent of frequency")
REFERENCE = Parameter("reference_hz", "Hz", None, None, "linear", None, "frequency at which the stiffness is stated")


class Element(EffectKind):
    """Its one value times sⁿ, n the ``order``: 0 a stiffness, 1 a damping, 2 a mass; ``pattern`` couples the coordinates of the place."""

    order: ClassVar[int] = 0
    pattern: ClassVar[Array | None] = None
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.asarray(values[self.parameters[0].name] * np.asarray(s, complex) ** self.order)

    def matrix(self, s: Array, values: Values, size: int = 1) -> Array:
        pattern = np.eye(size) if self.pattern is None else self.pattern
        return np.asarray(self.dynamic_stiffness(s, values)[..., None, None] * pattern)

    def quadratic(self, values: Values, size: int = 1) -> Quadratic:
        pattern = np.eye(size) if self.pattern is None else self.pattern
        parts = [np.zeros_like(pattern)] * 3
        parts[self.order] = values[self.parameters[0].name] * pattern
        stiffness, damping, mass = parts
        return Quadratic(mass, damping, stiffness)


class PointMass(Element):
    """f = m·a on all measured directions of the node."""

    kind = "point_mass"
    plain = "a mass"
    says = "a mass of {size} sits on {location}"
    says_removed = "a mass of {size} is missing at {location}"
    order = 2
    coordinates = "node"
    parameters = (MASS,)
    moves = "frequencies"

    def confirm(self, place: str, values: Values) -> str:
        known = max(float(values["mass"]) / 4, 0.005)
        return (
            f"tape a known mass of about {known:.2g} kg to {place} and measure again: the mass found must grow by just that; "
            "or weigh what was put there"
        )


class GroundSpring(Element):
    """f = k·x."""

    kind = "ground_spring"
    plain = "a spring to ground"
    says = "a spring to ground of {size} acts at {location}"
    says_removed = "a spring to ground of {size} is missing at {location}"
    confirms = "loosen what holds {location} against its surroundings and measure again: the spring must vanish"
    parameters = (STIFFNESS,)
    moves = "frequencies"


class GroundDamper(Element):
    """f = c·v."""

    kind = "ground_damper"
    plain = "a damper to ground"
    says = "a viscous damper to ground of {size} acts at {location}"
    says_removed = "a viscous damper to ground of {size} is missing at {location}"
    confirms = "measure at half the level: a viscous damper at {location} keeps its size, dry friction would seem twice as strong"
    order = 1
    parameters = (DAMPING,)
    moves = "damping"


class GroundHystereticSpring(EffectKind):
    """Z = k(1 + iη): damping that does not grow with frequency. In the lower half of the s-plane the conjugate."""

    kind = "ground_hysteretic_spring"
    plain = "a spring to ground with hysteretic damping"
    says = "a spring to ground that dissipates the same at every frequency ({size}) acts at {location}"
    says_removed = "a spring to ground that dissipates the same at every frequency ({size}) is missing at {location}"
    confirms = (
        "measure {location} over a wider band: the loss of a hysteretic spring stays the same from the lowest to the highest mode, "
        "that of a viscous damper grows with frequency"
    )
    parameters = (STIFFNESS, LOSS_FACTOR)
    contains = ("ground_spring",)
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        side = np.where(np.imag(s) < 0, -1.0, 1.0)
        return np.asarray(values["stiffness"] * (1 + 1j * side * values["loss_factor"]))


class GroundRubber(EffectKind):
    """Z = k·(s/ω_0)^α, ω_0 at ``reference_hz``: stiffness and loss both rise with frequency (a fractional derivative)."""

    kind = "ground_rubber"
    plain = "a rubber mount to ground"
    says = "a rubber-like spring to ground ({size}) acts at {location}"
    says_removed = "a rubber-like spring to ground ({size}) is missing at {location}"
    confirms = (
        "measure {location} again warmer or colder: the stiffness of rubber changes with temperature; "
        "or load the mount alone at two frequencies an octave apart"
    )
    parameters = (STIFFNESS, EXPONENT)
    constants = (REFERENCE,)
    contains = ("ground_spring", "ground_hysteretic_spring")
    removable = True

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        return np.asarray(values["stiffness"] * (np.asarray(s, complex) / (2 * np.pi * values["reference_hz"])) ** values["exponent"])


class CouplingSpring(GroundSpring):
    """f = k·(x₁ − x₂)."""

    kind = "coupling_spring"
    plain = "a spring between two points"
    says = "a spring of {size} acts between {location}"
    says_removed = "a spring of {size} is missing between {location}"
    confirms = "part what joins {location}, or clamp a known spring in parallel, and measure again: the stiffness must change by just that"
    places = 2


class CouplingDamper(GroundDamper):
    """f = c·(v₁ − v₂)."""

    kind = "coupling_damper"
    plain = "a damper between two points"
    says = "a viscous damper of {size} acts between {location}"
    says_removed = "a viscous damper of {size} is missing between {location}"
    confirms = "measure at half the level: a viscous damper between {location} keeps its size, dry friction would seem twice as strong"
    places = 2


class TunedAbsorber(EffectKind):
    """Z = m s² (c s + k)/(m s² + c s + k), k = mω², c = 2ζmω."""

    kind = "tuned_absorber"
    plain = "a mass on a spring and damper of its own"
    says = "a part that resonates on its own ({size}) hangs on {location}"
    confirms = (
        "hold fast or take off what can swing near {values[frequency]:.4g} Hz at {location} and measure again: "
        "the split pair of peaks must become one"
    )
    parameters = (
        MASS,
        Parameter("frequency", "Hz", None, None, "log", None, "its own natural frequency"),
        Parameter("damping_ratio", "", 1e-4, 0.25, "log", 0.03, "its own damping ratio"),
    )
    contains = ("point_mass", "ground_spring")

    def dynamic_stiffness(self, s: Array, values: Values) -> Array:
        m, w, z = float(values["mass"]), 2 * np.pi * float(values["frequency"]), float(values["damping_ratio"])
        elastic = 2 * z * w * s + w**2
        return np.asarray(m * s**2 * elastic / (s**2 + elastic))

    def quadratic(self, values: Values, size: int = 1) -> Quadratic:
        m, w, z = float(values["mass"]), 2 * np.pi * float(values["frequency"]), float(values["damping_ratio"])
        between = np.kron(np.array([[1.0, -1.0], [-1.0, 1.0]]), np.eye(size))
        inertia = np.diag(np.r_[np.zeros(size), np.full(size, m)])
        return Quadratic(inertia, 2 * z * w * m * between, w**2 * m * between)


class SkewElement(Element):
    """An element that pushes at one place by the motion of the other, with opposite signs."""

    places = 2
    coordinates = "separate"
    pattern = np.array([[0.0, 1.0], [-1.0, 0.0]])
    symmetric = False
    removable = False


class Gyroscopic(SkewElement):
    """C += c·(b₁b₂ᵀ − b₂b₁ᵀ)."""

    kind = "gyroscopic"
    plain = "gyroscopic coupling"
    says = "a spinning part couples {location} gyroscopically ({size})"
    confirms = (
        "measure at another speed: the coefficient between {location} grows in proportion to it, and turning the machine backwards "
        "turns its sign"
    )
    order = 1
    parameters = (Parameter("coefficient", "N s/m", -1e7, 1e7, "signed_log", 10.0, "gyroscopic coefficient"),)
    moves = "frequencies"


class Circulatory(SkewElement):
    """K += c·(b₁b₂ᵀ − b₂b₁ᵀ)."""

    kind = "circulatory"
    plain = "circulatory (follower) coupling"
    says = "a follower force (seal, journal bearing, internal friction of a rotor) couples {location} ({size})"
    confirms = (
        "change the oil, seal or load that could push across between {location} and measure again; it moves damping up in one mode and "
        "down in another, which no damper does"
    )
    parameters = (Parameter("coefficient", "N/m", -1e10, 1e10, "signed_log", 1e3, "circulatory coefficient"),)
    moves = "damping"


KINDS = (
    PointMass, GroundSpring, GroundDamper, GroundHystereticSpring, GroundRubber, CouplingSpring, CouplingDamper, TunedAbsorber, Gyroscopic,
    Circulatory,
)  # fmt: skip
