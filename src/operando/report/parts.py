"""From typed values to HTML: the templates with everything they may call, figures numbered through the page, sections."""

from __future__ import annotations

import base64
import functools
import gzip
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from operando.compare.verdict import floor_text
from operando.printable import printable
from operando.report import text

if TYPE_CHECKING:
    from jinja2 import Environment

    from operando.results import Results


@dataclass(frozen=True)
class Section:
    """Anchor, title and HTML of one section."""

    anchor: str
    title: str
    html: Markup


class Numbering:
    """Numbers figures through the whole report, and keeps what several sections need and is dear to compute."""

    def __init__(self) -> None:
        self.n = 0
        self._kept: dict[str, Any] = {}

    def next(self) -> int:
        """The number of the next figure."""
        self.n += 1
        return self.n

    def once(self, key: str, make: Callable[[], Any]) -> Any:
        """The value under a key, made the first time."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]


def render(template: str, page: Numbering | None = None, room: str = "report", /, **values: Any) -> Markup:
    """HTML of a template of a room, or of the report; every value in it that is no ``Markup`` is shown as text."""
    return without_blank_lines(environment(room).get_template(template).render(page=page or Numbering(), **values))


def without_blank_lines(html: str) -> Markup:
    """HTML without the empty lines that the logic of a template leaves."""
    return Markup(re.sub(r"\n\s*\n", "\n", html))


@functools.cache
def environment(room: str = "report") -> Environment:
    """The templates of a room and of the report, which escape everything, stop at an unknown name and call ``report.text``."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    class Unknown(StrictUndefined):
        """What is not there: false where it is asked for, an error where it would be printed."""

        def __bool__(self) -> bool:  # type: ignore[override]
            return False

    made = Environment(
        loader=ChoiceLoader([PackageLoader(f"operando.{room}"), PackageLoader("operando.report")]), autoescape=True, undefined=Unknown,
        lstrip_blocks=True, finalize=shown,
    )  # fmt: skip
    names = ("band_text", "count", "decibel", "finite", "fixed", "listing", "number", "percent", "plain", "plus_minus", "short_names")
    made.globals |= {name: getattr(text, name) for name in names}
    made.globals |= {f.__name__: f for f in (at, left_out, some, capital, words, tail, hz_list, csv_link)}
    made.globals |= {"DASH": text.DASH, "floor_text": functools.partial(floor_text, none=text.DASH)}
    return made


def shown(value: Any) -> Any:
    """A value as a template prints it: nothing for None; control characters and direction marks are shown, overlong words cut."""
    return "" if value is None else value if hasattr(value, "__html__") else printable(value)


def at(values: Any, i: int) -> Any:
    """The i-th of values that may not be there."""
    return None if values is None else values[i]


def some(items: Iterable[object], most: int) -> str:
    """The first items of a list, and how many there are where that is not all."""
    texts = [str(i) for i in items]
    return ", ".join(texts[:most]) + (f", … ({len(texts)})" if len(texts) > most else "")


def capital(sentence: object) -> str:
    """A text that starts with a capital letter."""
    said = str(sentence)
    return said[:1].upper() + said[1:]


def words(key: object) -> str:
    """A key of the files as words."""
    return str(key).replace("_", " ")


def tail(path: object) -> str:
    """The last folder and the name of a path."""
    return "/".join(PurePath(str(path)).parts[-2:])


def hz_list(frequencies_hz: Iterable[Any], digits: int = 5) -> list[str]:
    """Frequencies with their unit."""
    return [f"{text.number(f, digits)} Hz" for f in frequencies_hz if text.finite(f)]


def csv_link(csv: str) -> Markup:
    """Address that holds a CSV text, packed: unpacked it would be most of the page. The script of the page unpacks it on a click.

    Level 6 takes nearly twice the time for 0.8 % of the size.
    """
    return Markup("data:application/gzip;base64," + base64.b64encode(gzip.compress(csv.encode(), 5, mtime=0)).decode())


def left_out(results: Results, stage: str, default: str) -> str:
    """Why a stage is missing, in the pipeline's words if it gave any."""
    reason = results.left_out.get(stage)
    return f"{default.rstrip('.')}: {reason.rstrip('.')}." if reason else f"{default.rstrip('.')}."
