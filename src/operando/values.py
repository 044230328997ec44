"""Values of the test file: the type of each, what it must be in words, and one answer to whatever is wrong.

Only reading a file loads pydantic: the types are told to it by :class:`Expected`, which any module may import.
"""

from __future__ import annotations

import datetime
import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

from annotated_types import Ge, Gt, Le, Lt, Predicate
from typing_extensions import TypedDict  # pydantic takes that of typing from Python 3.12 on

from operando.dof import Dof
from operando.entries import Entry
from operando.errors import ConfigError, OperandoError
from operando.limits import IMPACT_WINDOWS, METHODS, WINDOWS
from operando.units import SI_UNIT, parse_unit

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler, TypeAdapter
    from pydantic_core import CoreSchema, ErrorDetails

OTHER_WORDS = {"boxcar": "rectangular", "uniform": "rectangular", "none": "rectangular", "flat": "rectangular", "hanning": "hann"}
"""Names that other programs give to the windows; one thing has one name here, so they are refused with the right one."""
NOT_UNIT = 0.05
"""Largest difference of a direction's length from 1: three components rounded to two decimals keep within 1 %; more is no unit vector."""


def nearest(name: str, known: Iterable[str], shown: int = 12) -> str:
    """What to do about an unknown name: the nearest known one, else the known ones."""
    names = list(known)
    near = difflib.get_close_matches(name, names, 1, 0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return "known: " + ", ".join(names[:shown]) + (f" … {len(names)} in all" if len(names) > shown else "") if names else "there is none"


class _NotExpected(ConfigError):
    """A value is not what it must be; how that is said depends on where it stands."""


@dataclass(frozen=True)
class Expected:
    """What a value must be, for its type's annotation.

    Parameters
    ----------
    words : str
        For errors and the reference; empty where the parts of the value say it.
    check : callable, optional
        What is made of a value of the right type. It raises a ValueError where the words say what is wrong, else an OperandoError of its
        own, whose ``where`` may name the key of a table that is checked as a whole.
    hint : str or callable, optional
        What to write instead of a wrong value.
    first : callable, optional
        What is made of a value before its type is looked at.
    """

    words: str
    check: Callable[[Any], Any] = lambda value: value
    hint: str | Callable[[Any], str | None] | None = None
    first: Callable[[Any], Any] = lambda value: value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import ValidationError, core_schema

        def checked(value: Any, inner: Callable[[Any], Any]) -> Any:
            try:
                return self.check(inner(self.first(value)))
            except OperandoError as error:
                raise ConfigError(error.message, where=error.where, hint=error.hint) from None
            except ValueError as error:
                part = error.errors()[0].get("ctx", {}).get("error") if isinstance(error, ValidationError) else None
                if not self.words or (isinstance(part, ConfigError) and not isinstance(part, _NotExpected)):
                    raise
                hint = self.hint(value) if callable(self.hint) else self.hint
                raise _NotExpected(f"expected {self.words}", hint=hint or getattr(part, "hint", None)) from None

        schema: Any = handler(source)
        if schema["type"] in ("float", "int", "bool"):
            schema["strict"] = True  # no text is taken for a number, and no truth value
        return core_schema.no_info_wrap_validator_function(checked, schema)


_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
_NO_TABLE = ("dict_type", "dataclass_type")


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """pydantic's reader of a kind of table; its ``json_schema()`` is for editors."""
    from pydantic import TypeAdapter

    kind.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # holds for the tables inside, too
    return TypeAdapter(kind)


def read(kind: Any, table: Mapping[str, Any], where: Entry) -> Any:
    """A table of the test file, or all of it, as its kind says.

    Raises
    ------
    ConfigError
        If a key is unknown (the nearest known one is named), or a value is wrong.
    """
    from pydantic_core import ValidationError

    try:
        return adapter(kind).validate_python(dict(table))
    except ValidationError as error:
        found = error.errors(include_url=False)
    raise _said(kind, min(found, key=lambda e: e["type"] not in _UNKNOWN), where)


def _said(kind: Any, error: ErrorDetails, where: Entry) -> ConfigError:
    """An error of pydantic in the words of the test file."""
    loc, value = error["loc"], error["input"]
    names = [where.section] * bool(where.section) + [part for part in loc if isinstance(part, str)]
    here = where.within(names[0]).at("".join(names[1:2]))
    # a list of tables: which of them
    number = next((f", entry {a + 1}" for a, b in pairwise(loc) if isinstance(a, int) and isinstance(b, str)), "")
    if error["type"] in _UNKNOWN:
        return ConfigError(f"unknown key {names[-1]!r}", where=f"{here}{number}", hint=nearest(names[-1], keys_of(kind, *loc[:-1]), 40))
    if error["type"] in _NO_TABLE and len(names) == 1:
        hint = f"write [{names[0]}] on a line of its own"
        return ConfigError(f"{names[0]!r} is a value, expected a table", where=str(where.at(names[0])), hint=hint)
    if error["type"] in _NO_TABLE:
        example = 'write for example {dof = "12+Z", quantity = "acceleration", unit = "g"}'
        return ConfigError(f"{value!r:.200} is no table", where=str(here), hint=example if names[0] == "channels" else None)
    cause: ConfigError = error["ctx"]["error"]
    if cause.where:
        here = here.at(cause.where)
    elif len(names) == 1:  # a key outside all sections
        here = where.at(names[0])
    message = cause.message
    if isinstance(cause, _NotExpected):
        found = f"{value!r:.200} is not allowed;" if len(names) == 2 else f"{names[-1]} is {value!r:.200},"
        message = f"{found} {message}"
    return ConfigError(message, where=f"{here}{number}", hint=cause.hint)


def words_of(kind: Any) -> str:
    """What a value of a kind must be, in words."""
    words = [mark.words for mark in getattr(kind, "__metadata__", ()) if isinstance(mark, Expected)]
    return next(filter(None, words or map(words_of, get_args(kind))), "")


def keys_of(kind: Any, *path: int | str) -> dict[str, Any]:
    """Keys of a kind of table, or of one inside it, each with its type."""
    for part in path:
        kind = get_args(kind)[-1] if get_args(kind) else get_type_hints(kind)[str(part)]
    return get_type_hints(kind, include_extras=True)


def choice(choices: tuple[str, ...], other: Mapping[str, str] | None = None) -> Expected:
    """One of the choices, in lower case."""

    def hint(value: Any) -> str | None:
        text = str(value).lower()
        near = [other[text]] if other and text in other else difflib.get_close_matches(text, choices, 1, 0.5)
        return f"did you mean {near[0]!r}?" if near else None  # the choices are in the words

    return Expected(f"one of {', '.join(choices)}", lambda text: choices[choices.index(text.lower())], hint)


def _unit(quantity: str | None = None) -> Expected:
    """A unit, of that quantity if one is named."""
    return Expected("a unit", lambda text: parse_unit(text, quantity) and text, 'write a text such as "g" or "lbf"')


def _numbers(value: Any, count: int) -> bool:
    return isinstance(value, list | tuple) and len(value) == count and all(type(v) in (int, float) for v in value)


def _band_hint(value: Any) -> str:
    swapped = _numbers(value, 2) and 0 <= value[1] < value[0]
    return f"did you mean [{value[1]:g}, {value[0]:g}]?" if swapped else "for example band = [5.0, 220.0]"


def _share_hint(value: Any) -> str | None:
    return f"a share, not per cent: did you mean {value / 100:g}?" if type(value) in (int, float) and 1 < value < 100 else None


def _bands_hint(value: Any) -> str | None:
    return f"write [[{value[0]:g}, {value[1]:g}]]" if _numbers(value, 2) else None


def _hit(text: str) -> str:
    if not re.fullmatch(r".+#\d{1,9}", text):
        raise ConfigError(f"{text!r:.200} names no hit", hint='write FILE#NUMBER, as in "idle/hammer1.uff#3"; numbers from 0')
    return text


def _channel(entry: dict[str, Any]) -> dict[str, Any]:
    quantity = entry.get("quantity")
    if quantity is not None and quantity not in SI_UNIT:
        raise ConfigError(f"unknown quantity {quantity!r:.200}", hint=nearest(quantity, SI_UNIT, 40))
    if "unit" in entry:
        parse_unit(entry["unit"], quantity)
    return entry


def _directions(table: dict[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
    """DOF in its positive sense → vector of unit length."""
    out: dict[str, tuple[float, ...]] = {}
    for label, value in table.items():
        try:
            found = Dof.parse(label)
        except OperandoError as error:
            hint = "write node, sign and a name in lower case, as in 5+a, or the label the file has, as in 7+X"
            raise ConfigError(error.message, where=label, hint=hint) from None
        if found.axis in ("", "RX", "RY", "RZ"):
            raise ConfigError(f"{found} is a {'rotation' if found.axis else 'scalar'}, which has no direction here", where=label)
        length = sum(v * v for v in value) ** 0.5
        if abs(length - 1) > NOT_UNIT:
            raise ConfigError(f"the vector has length {length:.3g}, expected a unit vector", where=label, hint="divide it by its length")
        if str(found.unsigned) in out:
            raise ConfigError(f"the direction of {found.unsigned} is given twice", where=label)
        out[str(found.unsigned)] = tuple(found.sign * v / length for v in value)
    return out


def _columns(value: Any) -> list[str]:
    from operando.io.columns import check_columns

    return list(check_columns(value, ""))


def _record(entry: Any) -> Any:
    if isinstance(entry, str):
        return {"file": entry}
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{entry!r:.200} is no path", hint='write for example ["idle/*.uff"]')
    if "file" not in entry and entry.keys() <= Record.__annotations__.keys():
        raise ConfigError(f"{dict(entry)!r:.200} names no file", hint='write {file = "run1.uff", start_s = 10, stop_s = 70}')
    return entry


def check_kinds(kinds: Iterable[str], where: str) -> None:
    """Raise a ConfigError for the first kind of effect that is not in the catalogue; that may grow by files that the test file names."""
    for kind in kinds:
        from operando.structure.effects import catalogue

        if kind not in (known := catalogue()):
            raise ConfigError(f"unknown kind of effect {kind!r}", where=where, hint=nearest(kind, sorted(known), 40))


def listed(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else [value]


Number = Annotated[float, Expected("a number")]
Positive = Annotated[float, Gt(0), Expected("a positive number")]
Share = Annotated[float, Ge(0), Lt(1), Expected("a number from 0 to below 1", hint=_share_hint)]
Mac = Annotated[float, Gt(0), Le(1), Expected("a MAC value above 0 and up to 1")]
Spread = Annotated[float, Ge(0), Le(1), Expected("a standard deviation from 0 to 1")]
Time = Annotated[float, Expected("a time in s")]
Order = Annotated[int, Ge(2), Le(100_000), Expected("a whole number of at least 2")]
Count = Annotated[int, Ge(1), Expected("a whole number of at least 1")]
Flag = Annotated[bool, Expected("true or false")]
Text = Annotated[str, Expected("a text")]
Name = Annotated[str, Predicate(str.strip), Expected("a text", str.strip)]
Length = Annotated[str, _unit("displacement")]
Band = Annotated[
    tuple[Number, Number],
    Predicate(lambda band: 0 <= band[0] < band[1]),
    Expected("two frequencies [low, high] in Hz with 0 <= low < high", hint=_band_hint),
]
Bands = Annotated[tuple[Band, ...], Expected("a list of [low, high] in Hz with 0 <= low < high", hint=_bands_hint)]
Frequencies = Annotated[tuple[Positive, ...], Expected("a list of frequencies in Hz")]
Texts = Annotated[tuple[Text, ...], Expected("a list of texts")]
Dofs = Annotated[tuple[Annotated[str, Expected("a text", lambda text: str(Dof.parse(text)))], ...], Expected("a list of texts")]
Hits = Annotated[tuple[Annotated[str, Expected("a text", _hit)], ...], Expected("a list of texts")]
HitChoice = Annotated[str, choice(("auto", "all", "off"))]
Window = Annotated[str, choice(tuple(dict.fromkeys((*WINDOWS, *IMPACT_WINDOWS))), OTHER_WORDS)]
Estimator = Annotated[str, choice(("auto", "h1", "h2", "hv", "lrm", "periodic"))]
EmaAnswer = Annotated[str, choice(("auto", "linear", "polished"))]
Scaling = Annotated[str, choice(("auto", *METHODS))]
Line = Annotated[
    list[str | datetime.date], Expected("a text, a date or a list of them", lambda parts: ", ".join(map(str, parts)), first=listed)
]
Path = Annotated[str, Predicate(bool), Expected("a path", hint='write for example "idle/*.uff"')]
Paths = Annotated[list[Path], Expected("a list of paths", hint='write for example ["idle/*.uff"]', first=listed)]


class Record(TypedDict, total=False):
    """Files and the part of each that counts."""

    file: Path
    start_s: Time
    stop_s: Time


class StateFiles(TypedDict, total=False):
    """A section such as [idle]."""

    records: Annotated[list[Annotated[Record, Expected("", first=_record)]], Expected("", first=listed)]
    frfs: Paths


class GeometryFile(TypedDict, total=False):
    """The section [geometry]."""

    file: Path
    units: Length


Units = TypedDict(  # type: ignore[misc]  # of the quantities that are known
    "Units",
    {quantity: Annotated[str, _unit(quantity)] for quantity in SI_UNIT}
    | {"length": Length, "sampling_hz": Positive, "frequency_step_hz": Positive, "columns": Annotated[Any, Expected("", _columns)]},
    total=False,
)
"""The section [units]."""


class ChannelEntry(TypedDict, total=False):
    """A channel in [channels]."""

    dof: Annotated[Any, Expected("", lambda label: Dof.parse(label) and label)]
    quantity: Text
    unit: Annotated[str, _unit()]
    sensitivity: Annotated[float, Predicate(bool), Expected("a number other than 0")]
    exclude: Flag
    reason: Text


Channel = Annotated[ChannelEntry, Expected("", _channel)]
Directions = Annotated[dict[str, Annotated[tuple[Number, Number, Number], Expected("three numbers")]], Expected("", _directions)]


class Between(TypedDict, total=False):
    """What may differ between two measurements: all relative, offsets as a share of a shape, the skew in seconds."""

    sensor_gain: Spread
    force_gain: Spread
    stiffness: Spread
    damping: Spread
    offset: Spread
    skew: Spread


class TitleBlock(TypedDict, total=False):
    """Lines of the title block of the report; a list is joined by commas, a date of TOML is written as one."""

    object: Line
    date: Line
    operator: Line
    sensors: Line
    comments: Line


class OwnEffects(TypedDict, total=False):
    """The section [effects]."""

    modules: Annotated[list[Name], Expected("a list of Python files", hint='for example modules = ["my_laws.py"]')]
