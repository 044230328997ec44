"""Skew couplings of two places: gyroscopic (in velocity) and circulatory (in displacement)."""

from __future__ import annotations

import numpy as np

from operando.effects.base import Array, EffectKind, Parameter, Quadratic, Values

SKEW = np.array([[0.0, 1.0], [-1.0, 0.0]])


class Gyroscopic(EffectKind):
    """C += c·(b₁b₂ᵀ − b₂b₁ᵀ)."""

    kind = "gyroscopic"
    plain = "gyroscopic coupling"
    places = 2
    coordinates = "separate"
    parameters = (Parameter("coefficient", "N s/m", -1e7, 1e7, "signed_log", 10.0, "gyroscopic coefficient"),)
    symmetric = False
    moves = "frequencies"

    def matrix(self, s: Array, values: Values, size: int = 2) -> Array:
        return np.asarray(values["coefficient"] * np.asarray(s)[..., None, None] * SKEW)

    def quadratic(self, values: Values, size: int = 2) -> Quadratic:
        zero = np.zeros((2, 2))
        return Quadratic(zero, values["coefficient"] * SKEW, zero)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a spinning part couples {place} gyroscopically ({size})"

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"measure at another speed: the coefficient between {place} grows in proportion to it, and turning the machine backwards "
            "turns its sign"
        )


class Circulatory(EffectKind):
    """K += c·(b₁b₂ᵀ − b₂b₁ᵀ)."""

    kind = "circulatory"
    plain = "circulatory (follower) coupling"
    places = 2
    coordinates = "separate"
    parameters = (Parameter("coefficient", "N/m", -1e10, 1e10, "signed_log", 1e3, "circulatory coefficient"),)
    symmetric = False
    moves = "damping"

    def matrix(self, s: Array, values: Values, size: int = 2) -> Array:
        return np.asarray(values["coefficient"] * np.ones(np.shape(s))[..., None, None] * SKEW)

    def quadratic(self, values: Values, size: int = 2) -> Quadratic:
        zero = np.zeros((2, 2))
        return Quadratic(zero, zero, values["coefficient"] * SKEW)

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a follower force (seal, journal bearing, internal friction of a rotor) couples {place} ({size})"

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"change the oil, seal or load that could push across between {place} and measure again; it moves damping up in one mode and "
            "down in another, which no damper does"
        )


KINDS = (Gyroscopic, Circulatory)
