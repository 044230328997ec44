"""Effects between two places: spring and damper."""

from __future__ import annotations

from operando.effects.base import EffectKind, Values
from operando.effects.ground import GroundDamper, GroundSpring


class CouplingSpring(GroundSpring):
    """f = k·(x₁ − x₂)."""

    kind = "coupling_spring"
    plain = "a spring between two points"
    places = 2

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a spring of {size} {'is missing' if removed else 'acts'} between {place}"

    def confirm(self, place: str, values: Values) -> str:
        return f"part what joins {place}, or clamp a known spring in parallel, and measure again: the stiffness must change by just that"


class CouplingDamper(GroundDamper):
    """f = c·(v₁ − v₂)."""

    kind = "coupling_damper"
    plain = "a damper between two points"
    places = 2

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"a viscous damper of {size} {'is missing' if removed else 'acts'} between {place}"

    def confirm(self, place: str, values: Values) -> str:
        return f"measure at half the level: a viscous damper between {place} keeps its size, dry friction would seem twice as strong"


KINDS: tuple[type[EffectKind], ...] = (CouplingSpring, CouplingDamper)
