"""The catalogue of physical effects: kinds behind one interface, effects with place and size, and how they change FRFs."""

from operando.effects.base import EffectKind, Parameter, Quadratic
from operando.effects.effect import Effect
from operando.effects.parse import parse_effect
from operando.effects.places import VirtualShape, participation, place_weights, spline_weights, virtual_shape
from operando.effects.registry import catalogue, kind_of, register, unregister
from operando.effects.running import running_modes
from operando.effects.update import update_variance, woodbury, woodbury_core

__all__ = [
    "Effect",
    "EffectKind",
    "Parameter",
    "Quadratic",
    "VirtualShape",
    "catalogue",
    "kind_of",
    "parse_effect",
    "participation",
    "place_weights",
    "register",
    "running_modes",
    "spline_weights",
    "unregister",
    "update_variance",
    "virtual_shape",
    "woodbury",
    "woodbury_core",
]
