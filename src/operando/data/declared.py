"""Whether values are of their declared type: fields of a class, and arguments of public functions where a call has failed."""

from __future__ import annotations

import builtins
import functools
import inspect
import pkgutil
import re
import sys
import types
import typing
from collections import ChainMap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal, Union

import numpy as np
from numpy.typing import ArrayLike

from operando.data.mapped import MappedSamples
from operando.errors import DataError, ObjectError, OperandoError

_DECLARED: dict[Any, Mapping[str, Any]] = {}
_ELSEWHERE = {"Axes": "matplotlib.axes:Axes", "h5py": "h5py"}
"""Where names lie that only type checkers import, of arguments that are checked all the same."""

_ARRAY_LIKE = frozenset(typing.get_args(ArrayLike))


class _Numbers:
    """What ``ArrayLike`` stands for here: whatever makes an array of numbers."""


@typing.runtime_checkable
class Fielded(typing.Protocol):
    """An instance of a dataclass."""

    __dataclass_fields__: typing.ClassVar[dict[str, Any]]


MADE_BY = {
    "TimeRecord": "read(file).records are time records",
    "Frf": "read(file).frfs and estimate_frf(records) give FRFs",
    "ModalModel": "fit_ema(frf) and fit_oma(record) give modes",
    "Geometry": "read(file).geometry is one",
    "Effect": 'parse_effect("point_mass@12+Z=mass:0.2") reads one',
    "Dof": 'Dof.parse("12+Z") reads one',
    "Results": "run(test) returns results, load(folder) reads them",
}
"""Where objects come from that many functions take: the advice of an error."""


class _Names(dict[str, Any]):
    """Names that a declaration may use beside those of its module: what only a type checker imports stands for anything."""

    def __init__(self, known: Mapping[str, Any]) -> None:
        super().__init__()
        self.known = known

    def __missing__(self, name: str) -> Any:
        if name in self.known or hasattr(builtins, name):
            raise KeyError(name)
        return pkgutil.resolve_name(_ELSEWHERE[name]) if name in _ELSEWHERE else Any


def _declared(thing: Any) -> Mapping[str, Any]:
    """Declared type of each field of a class, or of each argument of a function."""
    if thing not in _DECLARED:
        owners = thing.__mro__ if isinstance(thing, type) else (inspect.unwrap(thing),)
        names = ChainMap(*(vars(sys.modules[owner.__module__]) for owner in owners))
        try:
            _DECLARED[thing] = typing.get_type_hints(thing, localns=_Names(names))
        except NameError:  # of a class inside a function
            _DECLARED[thing] = {}
    return _DECLARED[thing]


def _kind_of(value: Any) -> str:
    """What was given, in words."""
    if isinstance(value, str | int | float) and len(repr(value)) <= 60:
        return f"{type(value).__name__} {value!r}"
    inside = f" of {type(value[0]).__name__}" if isinstance(value, tuple | list) and value else ""
    return type(value).__name__ + inside


def listed(value: Any) -> Any:
    """What is listed as a tuple; anything else as it is, for :func:`check_fields` to refuse.

    >>> listed([1, 2]), listed("1, 2")
    ((1, 2), '1, 2')
    """
    return tuple(value) if isinstance(value, Iterable) and not isinstance(value, str | Mapping) else value


def check_fields(made: Fielded) -> None:
    """Refuse a dataclass instance that holds a value of another type than its class declares."""
    declared = _declared(type(made))
    for field in fields(made):
        value = getattr(made, field.name)
        if not is_of(value, declared.get(field.name, Any)):
            name = type(made).__name__
            hint = f"help({type(made).__module__}.{name}) says what each field is"
            raise DataError(f"{field.name!r} of {name} is {_kind_of(value)}, expected {field.type}", hint=hint)


def is_of(value: Any, hint: Any, loose: bool = False) -> bool:
    """Whether a value is of a declared type; what the declaration leaves open is accepted.

    With ``loose``, what functions take as well: a list for a tuple, an iterator for a sequence.
    """
    if hint is Any or hint is object:
        return True
    if hint is None or hint is type(None):
        return value is None
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        if set(parts) >= _ARRAY_LIKE:
            parts = (_Numbers, *(p for p in parts if p not in _ARRAY_LIKE))
        return any(is_of(value, part, loose) for part in parts)
    if origin is Literal:
        return any(isinstance(value, type(part)) and value == part for part in parts)
    if origin is tuple:
        return isinstance(value, (tuple, list, np.ndarray) if loose else tuple) and _tuple_is_of(value, parts, loose)
    if origin in (list, Sequence, Iterable, Collection):
        if loose and not isinstance(value, list | tuple):
            return isinstance(value, Iterable) and not isinstance(value, str | Mapping)  # an iterator cannot be read twice
        return isinstance(value, list | tuple) and all(is_of(item, parts[0], loose) for item in value)
    if origin in (dict, Mapping):
        kind = Mapping if loose else dict
        return isinstance(value, kind) and all(is_of(k, parts[0], loose) and is_of(v, parts[1], loose) for k, v in value.items())
    kind = origin or hint
    if kind in (bool, int, float, complex):
        return _is_number(value, kind)
    if kind is _Numbers:
        return _makes_numbers(value)
    if kind is np.ndarray:
        return isinstance(value, MappedSamples) or (isinstance(value, np.ndarray) and _holds(value.dtype, parts))
    try:
        return isinstance(value, kind) if isinstance(kind, type) else True
    except TypeError:  # a protocol, which says what an object can do
        return True


def _is_number(value: Any, kind: type) -> bool:
    allowed = {bool: (bool, np.bool_), int: (int, np.integer), float: (int, float, np.number), complex: (int, float, complex, np.number)}
    return isinstance(value, allowed[kind]) and (kind in (bool, int) or not isinstance(value, bool))


def _holds(found: np.dtype[Any], parts: tuple[Any, ...]) -> bool:
    """Whether numbers of the dtype found are of the declared one, or become it without a loss of kind."""
    declared = typing.get_args(parts[1])[0] if parts else Any
    declared = typing.get_origin(declared) or declared
    kinds = [kind for kind in (np.bool_, np.int_, np.float64, np.complex128) if isinstance(declared, type) and issubclass(kind, declared)]
    return not kinds or np.can_cast(found, kinds[-1], "same_kind")


def _makes_numbers(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biufc"
    except (TypeError, ValueError, OverflowError):
        return False


def _tuple_is_of(value: Any, parts: tuple[Any, ...], loose: bool) -> bool:
    if len(parts) == 2 and parts[1] is Ellipsis:
        return all(is_of(item, parts[0], loose) for item in value)
    return len(value) == len(parts) and all(is_of(item, part, loose) for item, part in zip(value, parts, strict=True))


def explain_arguments(package: str) -> None:
    """Where a call of a public function or method of a package ends in a bare error, say which argument is of another kind than it takes.

    A call that works costs nothing, and errors with words of their own stay as they are. A package calls it at its end, as
    ``explain_arguments(__name__)``.

    >>> import operando.quality
    >>> operando.quality.check_record("run1.uff")
    Traceback (most recent call last):
    operando.errors.ObjectError: record of check_record is str 'run1.uff', expected TimeRecord (read(file).records are time records)
    """
    module = sys.modules[package]
    for name in module.__all__:
        thing = vars(module).get(name)  # what is loaded when it is asked for is left alone
        if inspect.isclass(thing) and thing.__module__.startswith(package):
            _explain_methods(thing)
        if not inspect.isfunction(thing) or hasattr(thing, "explained"):
            continue
        home = sys.modules[thing.__module__]
        explained = _explaining(thing)
        setattr(module, name, explained)
        if vars(home).get(name) is thing:  # so that other processes, which look for it there, find the same
            setattr(home, name, explained)


def _explain_methods(kind: type) -> None:
    """The same of the public methods that a class defines itself."""
    for name, method in list(vars(kind).items()):
        if name.startswith("_"):
            continue
        if inspect.isfunction(method):
            setattr(kind, name, _explaining(method))
        elif isinstance(method, classmethod):
            setattr(kind, name, classmethod(_explaining(method.__func__)))


def _explaining(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def explained(*args: Any, **options: Any) -> Any:
        try:
            return function(*args, **options)
        except Exception as error:
            inner = isinstance(error, ObjectError) and error.__cause__ is not None  # said of a function that this one calls
            if inner or not isinstance(error, OperandoError):
                _refuse_others(function, args, options, error.__cause__ if inner else error)
            raise

    explained.explained = True  # type: ignore[attr-defined]
    return explained


def _refuse_others(function: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any], error: BaseException | None) -> None:
    """Say which argument is of another kind than declared, if one is."""
    signature = inspect.signature(function)
    try:
        given = signature.bind(*args, **options).arguments
    except TypeError:  # Python says which argument is missing or too much
        return
    hints, plain = _declared(function), inspect.unwrap(function)
    for name, value in given.items():
        parameter = signature.parameters[name]
        if parameter.kind is parameter.VAR_KEYWORD:
            continue
        several = value if parameter.kind is parameter.VAR_POSITIONAL else (value,)
        said = str(parameter.annotation)
        advice = "; ".join(text for kind, text in MADE_BY.items() if re.search(rf"\b{kind}\b", said))
        advice = advice or f"help({plain.__module__}.{plain.__name__}) says what it takes"
        what = f"{name} of {plain.__name__}"
        for one in several:
            if not is_of(one, hints.get(name, Any), loose=True):
                raise ObjectError(f"{what} is {_kind_of(one)}, expected {said}", hint=advice) from error
