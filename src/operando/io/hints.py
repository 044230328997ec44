"""Whether a value is of the type its field is declared with."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal, Union

import numpy as np

from operando.data import MappedSamples
from operando.errors import FormatError

_DECLARED: dict[Any, Mapping[str, Any]] = {}


def _declared(kind: Any) -> Mapping[str, Any]:
    """Declared type of each field of a class; none where a name of the declaration is not there when the program runs."""
    if kind not in _DECLARED:
        try:
            _DECLARED[kind] = typing.get_type_hints(kind)
        except NameError:
            _DECLARED[kind] = {}
    return _DECLARED[kind]


def check_fields(made: Any, where: str) -> None:
    """Refuse an object that holds a value of another type than its class declares.

    Parameters
    ----------
    made : dataclass instance
        The object.
    where : str
        File and place in it, for the message.

    Raises
    ------
    FormatError
        If a field is of another type.

    Examples
    --------
    >>> from operando.dof import Dof
    >>> check_fields(Dof(3, "Z"), "model.h5")
    """
    declared = _declared(type(made))
    for field in fields(made):
        value = getattr(made, field.name)
        if not is_of(value, declared.get(field.name, Any)):
            found = type(value).__name__ + (" of other things" if isinstance(value, tuple | list | dict) else "")
            raise FormatError(
                f"{field.name!r} of {type(made).__name__} is {found}, expected {field.type}", where=where, hint="the file is damaged"
            )


def is_of(value: Any, hint: Any) -> bool:
    """Whether a value is of a declared type; what the declaration leaves open is accepted."""
    if hint is Any:
        return True
    if hint is None or hint is type(None):
        return value is None
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return any(is_of(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if origin is tuple:
        return isinstance(value, tuple) and _tuple_is_of(value, parts)
    if origin in (list, Sequence, Iterable):
        return isinstance(value, list | tuple) and all(is_of(item, parts[0]) for item in value)
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(is_of(k, parts[0]) and is_of(v, parts[1]) for k, v in value.items())
    kind = origin or hint
    if kind is float:
        return isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if kind is complex:
        return isinstance(value, int | float | complex | np.number) and not isinstance(value, bool)
    if kind is np.ndarray:
        return isinstance(value, np.ndarray | MappedSamples)
    return isinstance(value, kind) if isinstance(kind, type) else True


def _tuple_is_of(value: tuple[Any, ...], parts: tuple[Any, ...]) -> bool:
    if len(parts) == 2 and parts[1] is Ellipsis:
        return all(is_of(item, parts[0]) for item in value)
    return len(value) == len(parts) and all(is_of(item, part) for item, part in zip(value, parts, strict=True))
