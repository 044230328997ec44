"""Reading an effect from one line of text, as the command line writes it."""

from __future__ import annotations

import math
import re
from typing import Any

from operando.dof import parse_dofs
from operando.errors import ConfigError, DofError
from operando.structure.effects.base import EffectKind, Parameter
from operando.structure.effects.effect import Effect
from operando.structure.effects.registry import kind_of

_HOW = "write KIND[@PLACE][=name:value,…], as in point_mass@272+Z=mass:0.2; PLACE is DOF, DOF,DOF or x,y,z:+Z"


def parse_effect(text: str, band_hz: tuple[float, float] | None = None, fixed: bool = False) -> Effect:
    """Read ``KIND[@PLACE][=name:value,…]``.

    Parameters
    ----------
    text : str
        Such as ``point_mass@272+Z=mass:0.2``, ``gyroscopic@3+Z,7+Z``, ``ground_spring@0.3,0.1,0:+Z``, ``global_stiffness``.
    band_hz : (float, float), optional
        Analysis band [Hz], for values that start at its centre.
    fixed : bool
        Hold the given values in a fit.

    Returns
    -------
    Effect

    Raises
    ------
    ConfigError
        If the text cannot be read, or the kind, place or a name is unknown.
    DofError
        If a DOF label cannot be read.

    Examples
    --------
    >>> import operando
    >>> operando.parse_effect("ground_spring@3+Z=stiffness:1e6").size
    '1 MN/m'
    """
    try:
        if not isinstance(text, str):
            raise ConfigError(f"an effect is read from a text, not {type(text).__name__}", hint=_HOW)
        return _parsed(text, band_hz, fixed)
    except (ConfigError, DofError) as error:
        raise type(error)(error.message, where=f"effect {text!r:.200}", hint=error.hint) from None


def _parsed(text: str, band_hz: tuple[float, float] | None, fixed: bool) -> Effect:
    head, equals, tail = text.strip().partition("=")
    kind, at, place = (part.strip() for part in head.partition("@"))
    if not kind or (at and not place) or (equals and not tail.strip()):
        raise ConfigError(f"{text!r} is no effect", hint=_HOW)
    definition = kind_of(kind)
    values: dict[str, Any] = {}
    for item in filter(None, (part.strip() for part in tail.split(","))):
        name, colon, number = (part.strip() for part in item.partition(":"))
        if not colon:
            raise ConfigError(f"{item!r} in {text!r} is no name:value", hint=_HOW)
        parameter = definition.parameter(name)
        if name in values:
            raise ConfigError(f"{name} of {kind} is given twice", hint="give it once")
        try:
            numbers = tuple(float(v) for v in number.split(";"))
        except ValueError:
            raise ConfigError(f"{number!r} in {text!r} is no number", hint=_HOW) from None
        values[name] = numbers if definition.acts == "excitation" else numbers[0]
        _check_range(definition, parameter, numbers)
        if len(numbers) > 1 and definition.acts != "excitation":
            raise ConfigError(f"{name} of {kind} takes one value, got {len(numbers)}")
    held = tuple(n for n in values if n in definition.names) if fixed else ()
    spot = re.fullmatch(r"([^:]+):\s*([+-]?R?[XYZ])", place, re.IGNORECASE)
    if spot is None:
        return Effect(kind, parse_dofs(place), values, fixed=held, band_hz=band_hz)
    try:
        x, y, z = (float(v) for v in spot.group(1).split(","))
    except ValueError:
        raise ConfigError(f"{place!r} is no position", hint="write x,y,z:+Z in metres, as in 0.3,0.1,0:+Z") from None
    return Effect(kind, (), values, position=(x, y, z), direction=spot.group(2), fixed=held, band_hz=band_hz)


def _check_range(definition: EffectKind, parameter: Parameter, values: tuple[float, ...]) -> None:
    """Values within the range that a fit may move in: it would take the nearest end without a word."""
    low, high = parameter.low, parameter.high
    removable = definition.removable and parameter.name == definition.names[0]
    for value in values:
        size = abs(value) if removable else value
        if not math.isfinite(value) or (parameter.transform == "log" and size <= 0):
            continue  # the effect itself refuses it
        if (low is not None and not size >= low) or (high is not None and not size <= high):
            ends = f"{'-inf' if low is None else f'{low:g}'} to {'inf' if high is None else f'{high:g}'} {parameter.unit}".strip()
            nearest = min(max(size, low if low is not None else size), high if high is not None else size)
            hint = f"values are in SI; did you mean {math.copysign(nearest, value) if removable else nearest:g}?"
            raise ConfigError(f"{parameter.name} of {definition.kind} is {value:g}, expected {ends}", hint=hint)
