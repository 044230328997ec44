"""Force laws in time: the restoring force of an effect along its place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from operando.data import ModalModel
from operando.errors import ConfigError
from operando.structure.effects import Effect, EffectKind, kind_of, place_weights
from operando.structure.modal_space import Real

LINEAR = ("ground_spring", "ground_damper", "coupling_spring", "coupling_damper")
"""Linear kinds that are a force of displacement and velocity, as records can be fitted with."""


@dataclass(frozen=True)
class ForceLaw:
    """A kind of restoring force with values; ``side`` is −1 where it acts towards the other side of its place."""

    kind: str
    values: dict[str, float]
    side: float = 1.0

    @property
    def definition(self) -> EffectKind:
        """The kind of effect."""
        return kind_of(self.kind)

    @property
    def remembers(self) -> bool:
        """Whether the force depends on the motion before (hysteresis)."""
        return bool(getattr(self.definition, "has_state", False))

    @property
    def two_sided(self) -> bool:
        """Whether f(−x, −v) = −f(x, v); else the side counts."""
        return bool(getattr(self.definition, "odd", True))

    @property
    def key(self) -> tuple[Any, ...]:
        """Kind, side and values."""
        return (self.kind, self.side, *self.values.items())

    def moved(self, **values: float) -> ForceLaw:
        """The law with other values."""
        return replace(self, values=self.values | values)

    def force(self, x: Real, v: Real, step: float) -> Real:
        """Restoring force along the place, of displacement x and velocity v sampled at ``step`` [s]."""
        return self.side * raw_force(self.definition, self.side * x, self.side * v, self.values, step)


def raw_force(kind: EffectKind, x: Real, v: Real, values: dict[str, Any], step: float) -> Real:
    """Restoring force of a kind; linear kinds of spring and damper included. Values may be arrays."""
    if kind.acts == "pseudo_force":
        return np.asarray(kind.over_steps(x, v, values, step))
    if "stiffness" in values:
        return np.asarray(values["stiffness"] * x)
    return np.asarray(values["damping"] * v)


def has_restoring_force(effect: Effect) -> bool:
    """Whether an effect is a force of displacement and velocity, as records can be fitted with."""
    return effect.definition.acts == "pseudo_force" or effect.kind in LINEAR


def law_of(effect: Effect, idle: ModalModel) -> tuple[ForceLaw, Real]:
    """Force law of an effect, and the weights (m,) of the DOFs along which it acts."""
    if not has_restoring_force(effect):
        raise ConfigError(
            f"{effect.kind} has no restoring force of displacement and velocity, so it cannot be simulated in time",
            hint=f"beside a level-dependent effect can stand others of its sort, point_mass, {', '.join(LINEAR)}: leave one of the two out",
        )
    if not effect.location:
        raise ConfigError(f"{effect.kind} stands at a position without a sensor: not simulated yet", hint="name measured DOFs")
    values = {k: float(v) for k, v in effect.values.items()}
    if effect.removed:
        first = effect.definition.parameters[0].name
        values[first] = -values[first]
    return ForceLaw(effect.kind, values), place_weights(effect, idle)[0]
