"""What all nouns can do: show themselves in short, be saved, take the forms of other libraries.

The work is done in packages below this one (io, plots), loaded by name when it is asked for: data imports nothing of them.
"""

from __future__ import annotations

import html
import importlib
from collections.abc import Iterable
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from operando.data.arrays import ByContent
from operando.data.declared import check_fields
from operando.errors import ObjectError
from operando.paths import path_of
from operando.printable import printable

if TYPE_CHECKING:
    import pandas
    import xarray

MOST_NAMES = 4
"""Names shown of a list in the short form of an object."""


@runtime_checkable
class Named(Protocol):
    """An object with a name."""

    @property
    def name(self) -> str:
        """What it is called."""


def plots() -> Any:
    """The package of figures, ``operando.plots``, with matplotlib behind it."""
    return importlib.import_module("operando.plots")


def names_text(names: Iterable[object], most: int = MOST_NAMES) -> str:
    """``1+Z, 2+Z, 3+Z, … (13)``: the first few of a list of names, and how many there are."""
    words = [str(n) for n in names]
    return ", ".join(words) if len(words) <= most else f"{', '.join(words[: most - 1])}, … ({len(words)})"


def common_name(objects: Iterable[Named]) -> str:
    """The ``name`` that all objects have; empty where they differ: what is made of several files is not called after one of them."""
    names = {str(item.name) for item in objects}
    return names.pop() if len(names) == 1 else ""


def counted(n: int, noun: str) -> str:
    """``1 force``, ``3 forces``."""
    return f"{n} {noun}" + ("" if n == 1 else "s")


class Shown(ByContent):
    """Short ``repr``, and a table in notebooks, both from the facts that an object states about itself."""

    def facts(self) -> dict[str, str]:
        """What the short form of the object says: name of each fact → words."""
        return {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {'; '.join(printable(v) for v in self.facts().values() if v)}>"

    def _repr_html_(self) -> str:
        text = lambda value: html.escape(printable(value), quote=True)  # noqa: E731
        rows = "".join(
            f'<tr><th scope="row" style="text-align:left">{text(k)}</th><td style="text-align:left">{text(v)}</td></tr>'
            for k, v in self.facts().items()
            if v
        )
        caption = f'<caption style="text-align:left;font-weight:bold">{text(type(self).__name__)}</caption>'
        return f"<table>{caption}<tbody>{rows}</tbody></table>"


class Short(Shown):
    """Adds ``save`` to a file, and a check of the fields."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __post_init__(self) -> None:
        check_fields(self)

    def save(self, path: str | Path) -> None:
        """Write the object into a file, which appears whole or not at all; :func:`operando.load` gives it back.

        Parameters
        ----------
        path : path
            ``.h5`` keeps everything. ``.uff``, ``.unv``, ``.mat`` and ``.csv`` take what these formats can hold; what they cannot is
            said in a warning.

        Raises
        ------
        FormatError
            If the name tells no format, or the format cannot take such an object.
        """
        importlib.import_module("operando.io.objects").save(self, path_of(path, "an object is saved to a path"))


class Noun(Short):
    """Adds the forms of other libraries to records, FRFs, modal models and geometries."""

    def to_pyuff(self) -> list[dict[str, Any]]:
        """Sets of UFF as the dictionaries of pyuff (:func:`operando.io.uff.dictionaries.dictionaries`)."""
        sets: list[dict[str, Any]] = importlib.import_module("operando.io.uff.dictionaries").dictionaries(self)
        return sets

    def to_dataframe(self) -> pandas.DataFrame:
        """Numbers as a table of pandas, with units in ``.attrs`` (:func:`operando.io.frames.dataframe`).

        Raises
        ------
        MissingError
            If pandas is not installed.
        """
        table: pandas.DataFrame = importlib.import_module("operando.io.frames").dataframe(self)
        return table

    def to_xarray(self) -> xarray.Dataset:
        """Arrays with their labels as a dataset of xarray (:func:`operando.io.frames.dataset`).

        Raises
        ------
        MissingError
            If xarray is not installed.
        """
        made: xarray.Dataset = importlib.import_module("operando.io.frames").dataset(self)
        return made


def several(value: Any, kind: type | tuple[type, ...], what: str, hint: str) -> list[Any]:
    """One object of a kind, or several in a list or tuple, as a list; anything else is refused as by :func:`expect`."""
    items = list(value) if isinstance(value, list | tuple) else [value]
    for item in items:
        expect(item, kind, what, hint)
    return items


def expect(value: Any, kinds: type | UnionType | tuple[type, ...], what: str, hint: str) -> None:
    """Refuse an object of another kind than a function works on, with ``what`` needs it and, as ``hint``, what to give instead."""
    if not isinstance(value, kinds):
        found = f"a list of {type(value[0]).__name__}" if isinstance(value, list | tuple) and value else f"{type(value).__name__}"
        raise ObjectError(f"{what}, not {found}", hint=hint)
