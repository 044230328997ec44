"""The kinds known by name; a user's own kind joins them by :func:`register`."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

import numpy as np

from operando.errors import ConfigError, OperandoError, UnknownKindError
from operando.structure.effects import channels, hysteresis, level_dependent, linear, whole
from operando.structure.effects.base import EffectKind, Parameter
from operando.structure.effects.returned import checked

_KINDS: dict[str, EffectKind] = {}
_ACTS = {
    "dynamic_stiffness": ("dynamic_stiffness", "matrix"),
    "sensor_map": ("sensor_map",),
    "modal_change": ("modal_change",),
    "added_mode": ("added_mode",),
    "excitation": (),
    "pseudo_force": ("pseudo_force",),
}
_LAWS = (*dict.fromkeys(name for names in _ACTS.values() for name in names), "quadratic", "over_steps", "explain", "confirm")


def register(kind: type[EffectKind]) -> type[EffectKind]:
    """Add a kind to the catalogue (also as a class decorator); a kind of the same name is replaced.

    A kind needs a name, plain words and the one method its ``acts`` names.

    Parameters
    ----------
    kind : subclass of EffectKind
        Not an object of it.

    Returns
    -------
    subclass of EffectKind

    Raises
    ------
    ConfigError
        If the class lacks its name, words or way of acting, or declares places and parameters that cannot be.

    Examples
    --------
    >>> from operando import EffectKind, Parameter, register
    >>> from operando.structure.effects.registry import unregister
    >>> @register
    ... class Inerter(EffectKind):
    ...     kind, plain, places = "inerter_here", "an inerter between two points", 2
    ...     parameters = (Parameter("inertance", "kg", 1e-3, 1e4, "log", 1.0),)
    ...
    ...     def dynamic_stiffness(self, s, values):
    ...         return values["inertance"] * s**2
    >>> unregister("inerter_here")
    """
    if not (isinstance(kind, type) and issubclass(kind, EffectKind)):
        raise ConfigError(f"{kind!r} is no subclass of EffectKind")
    if not kind.kind.isidentifier() or not kind.plain:
        raise ConfigError(f"{kind.__name__} needs a kind (one word) and plain words")
    if kind.acts not in _ACTS:
        raise ConfigError(f"acts of {kind.kind} is {kind.acts!r}", hint="one of " + ", ".join(_ACTS))
    wanted = _ACTS[kind.acts]
    if wanted and all(getattr(kind, name) is getattr(EffectKind, name) for name in wanted):
        raise ConfigError(f"{kind.kind} acts by {wanted[0]}, which it does not define")
    if kind.places not in (0, 1, 2):
        raise ConfigError(f"{kind.kind} takes {kind.places} DOFs", hint="0, 1 or 2")
    if kind.acts == "dynamic_stiffness" and kind.places == 0:
        raise ConfigError(f"{kind.kind} adds stiffness but takes no DOF")
    if kind.coordinates not in ("difference", "separate", "node") or (kind.coordinates == "node" and kind.places != 1):
        raise ConfigError(f"coordinates of {kind.kind} cannot be {kind.coordinates!r} on {kind.places} DOFs")
    for what, given in (("parameters", kind.parameters), ("constants", kind.constants)):
        if not (isinstance(given, tuple | list) and all(isinstance(p, Parameter) for p in given)):
            hint = 'as in parameters = (Parameter("stiffness", "N/m", 1.0, 1e9, "log", 1e4),)'
            raise ConfigError(f"the {what} of {kind.kind} are {given!r:.60}, expected a tuple of Parameter", hint=hint)
    names = [p.name for p in (*kind.parameters, *kind.constants)]
    if len(set(names)) != len(names):
        raise ConfigError(f"{kind.kind} has two parameters of one name")
    definition = kind()
    if is_own(definition):
        for name in _LAWS:
            if getattr(kind, name) is not getattr(EffectKind, name):
                setattr(definition, name, _guarded(definition, name))
    _KINDS[kind.kind] = definition
    return kind


def is_own(definition: EffectKind) -> bool:
    """Whether a kind is one of the user's."""
    return not type(definition).__module__.startswith("operando.")


def _guarded(definition: EffectKind, name: str) -> Callable[..., Any]:
    """A method of the user's whose errors, and results of another form, are named as such; numbers that cannot be are left to the fit."""
    method = getattr(definition, name)

    @functools.wraps(method)
    def called(*args: Any, **kwargs: Any) -> Any:
        try:
            found = method(*args, **kwargs)
        except (OperandoError, np.linalg.LinAlgError, OverflowError, MemoryError):
            raise
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)[1:]
            where = f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else None
            known = ", ".join(p.name for p in (*definition.parameters, *definition.constants)) or "none"
            raise ConfigError(
                f"{name} of {definition.kind}, a kind of your own, failed: {type(error).__name__}: {error}",
                where=where,
                hint=f"correct it there; values has {known}",
            ) from error
        return checked(definition, name, method, found, args, kwargs)

    return called


def unregister(name: str) -> None:
    """Take a kind out of the catalogue."""
    _KINDS.pop(name, None)


def catalogue() -> dict[str, EffectKind]:
    """All kinds of effects that can be looked for, by name.

    Returns
    -------
    dict
        Name → kind (plain words, places, parameters, how it acts).

    Examples
    --------
    >>> import operando
    >>> operando.catalogue()["clearance"].plain
    'a stop with play on both sides'
    """
    return dict(_KINDS)


def kind_of(name: str) -> EffectKind:
    """The kind of this name."""
    if isinstance(name, str) and name in _KINDS:
        return _KINDS[name]
    near = get_close_matches(str(name), _KINDS, 1, 0.5)
    hint = (f"did you mean {near[0]!r}? " if near else "") + "kinds: " + ", ".join(sorted(_KINDS))
    hint += "; a kind of your own is known once its module is imported, or named by --own FILE"
    raise UnknownKindError(f"unknown kind of effect {name!r:.60}", hint=hint)


for _room in (linear, whole, channels, level_dependent, hysteresis):
    for _kind in _room.KINDS:
        register(_kind)
