"""The catalogue of physical effects: kinds behind one interface, and effects with place and size."""

from operando.structure.effects.base import EffectKind, Parameter, Quadratic
from operando.structure.effects.effect import Effect, place_words, with_spread
from operando.structure.effects.parse import parse_effect
from operando.structure.effects.places import place_weights, position_weights, spline_weights
from operando.structure.effects.registry import catalogue, kind_of, register, unregister

__all__ = [
    "Effect",
    "EffectKind",
    "Parameter",
    "Quadratic",
    "catalogue",
    "kind_of",
    "parse_effect",
    "place_weights",
    "place_words",
    "position_weights",
    "register",
    "spline_weights",
    "unregister",
    "with_spread",
]
