"""A mass on a spring and damper: the tuned absorber, or a loose part that resonates."""

from __future__ import annotations

import numpy as np

from operando.effects.base import Array, EffectKind, Parameter, Quadratic, Values
from operando.effects.ground import MASS


class TunedAbsorber(EffectKind):
    """Z = m s² (c s + k)/(m s² + c s + k), k = mω², c = 2ζmω."""

    kind = "tuned_absorber"
    plain = "a mass on a spring and damper of its own"
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

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a part that resonates on its own ({size}) hangs on {place}"

    def confirm(self, place: str, values: Values) -> str:
        return (
            f"hold fast or take off what can swing near {float(values['frequency']):.4g} Hz at {place} and measure again: "
            "the split pair of peaks must become one"
        )


KINDS = (TunedAbsorber,)
