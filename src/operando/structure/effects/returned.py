"""What a method of a user's own kind gives back: whether it is of the form that is due."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from operando.data import ModalModel
from operando.errors import ConfigError
from operando.structure.effects.base import EffectKind, Quadratic


def checked(
    definition: EffectKind, name: str, method: Callable[..., Any], found: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> Any:
    """What the method ``name`` gave to these arguments; one number stands for the same at all frequencies or samples.

    NaN and infinite numbers pass: a fit goes around the values that give them.
    """
    given = [*args, *kwargs.values()]
    wrong = lambda due: _wrong(definition, name, method, found, due)  # noqa: E731
    if name in ("modal_change", "added_mode"):
        if not isinstance(found, ModalModel):
            raise wrong("a ModalModel")
        return found
    if name in ("explain", "confirm"):
        if not isinstance(found, str):
            raise wrong("a text")
        return found
    if name == "quadratic":
        if found is not None and not (isinstance(found, Quadratic) and _is_form(found, given[1] if len(given) > 1 else 1)):
            raise wrong("a Quadratic of three real square matrices of one size, at least that of the coordinates, or None")
        return found
    try:
        numbers = np.asarray(found)
    except ValueError:  # lists of unlike lengths
        numbers = np.asarray(None)
    due = np.shape(given[0])
    if name == "matrix":
        due += (given[2] if len(given) > 2 else 1,) * 2
    elif name in ("pseudo_force", "over_steps"):  # values may be arrays there
        due = np.broadcast_shapes(due, np.shape(given[1]), *map(np.shape, given[2].values()))
    if numbers.dtype.kind not in ("biuf" if name in ("pseudo_force", "over_steps") else "biufc"):
        raise wrong(f"numbers of shape {due}")
    if numbers.shape == due:
        return found if isinstance(found, np.ndarray) else numbers
    if numbers.size == 1 and (name != "matrix" or due[-1] == 1):
        return np.full(due, numbers.reshape(()))
    if name == "matrix" and numbers.shape == due[-2:]:
        return np.broadcast_to(numbers, due).copy()
    raise wrong(f"numbers of shape {due}, or one number")


def _is_form(form: Quadratic, size: int) -> bool:
    parts = [np.asarray(part) for part in (form.mass, form.damping, form.stiffness)]
    rows = len(parts[0]) if parts[0].ndim else 0
    return rows >= size and all(part.shape == (rows, rows) and part.dtype.kind in "biuf" for part in parts)


def _wrong(definition: EffectKind, name: str, method: Callable[..., Any], found: Any, due: str) -> ConfigError:
    code = getattr(method, "__code__", None)
    shape = np.shape(found) if isinstance(found, np.ndarray) else ()
    text = f"an array of {found.dtype} and shape {shape}" if isinstance(found, np.ndarray) else f"{found!r:.60}"
    return ConfigError(
        f"{name} of {definition.kind}, a kind of your own, returned {text}, expected {due}",
        where=None if code is None else f"{code.co_filename}, line {code.co_firstlineno}",
        hint="correct it there",
    )
