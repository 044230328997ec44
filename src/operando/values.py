"""Values of the test file, each checked where it is read; an unknown name is answered by the nearest valid one."""

from __future__ import annotations

import datetime
import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from typing import Any

from operando.dof import Dof
from operando.entries import Entry
from operando.errors import ConfigError, DofError, UnitError
from operando.limits import IMPACT_WINDOWS, METHODS, WINDOWS
from operando.units import SI_UNIT, parse_unit

ESTIMATORS = ("auto", "h1", "h2", "hv", "lrm", "periodic")
HITS = ("auto", "all", "off")
EMA_ANSWERS = ("auto", "linear", "polished")
OTHER_WORDS = {"boxcar": "rectangular", "uniform": "rectangular", "none": "rectangular", "flat": "rectangular", "hanning": "hann"}
"""Names that other programs give to the windows; one thing has one name here, so they are refused with the right one."""
CHANNEL_KEYS = ("dof", "quantity", "unit", "sensitivity", "exclude", "reason")
NOT_UNIT = 0.05
"""Largest difference of a direction's length from 1: three components rounded to two decimals keep within 1 %; more is no unit vector."""


def nearest(name: str, known: Iterable[str], shown: int = 12) -> str:
    """What to do about an unknown name: the nearest known one, else the known ones."""
    names = list(known)
    near = difflib.get_close_matches(name, names, 1, 0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return "known: " + ", ".join(names[:shown]) + (f" … {len(names)} in all" if len(names) > shown else "") if names else "there is none"


def check_keys(table: Mapping[str, Any], known: Iterable[str], where: Entry) -> None:
    """Raise a ConfigError that names the nearest known key for the first unknown one."""
    known = tuple(known)
    for key in table:
        if key not in known:
            here = where.within(key) if not where.section else where if where.key else where.at(key)
            raise ConfigError(f"unknown key {key!r}", where=str(here), hint=nearest(key, known, 40))


def is_number(value: Any) -> bool:
    """Whether a value is a finite number (and no bool)."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    except OverflowError:  # an integer beyond the range of a double
        return False


def expect(value: Any, good: bool, expected: str, where: Entry, hint: str | None = None) -> Any:
    """The value if it is good, else a ConfigError that says what was expected."""
    if not good:
        raise ConfigError(f"{value!r:.200} is not allowed; expected {expected}", where=str(where), hint=hint)
    return value


def one_of(choices: tuple[str, ...], value: Any, where: Entry, other: Mapping[str, str] | None = None) -> str:
    """One of the choices, in lower case."""
    text = value.lower() if isinstance(value, str) else str(value)
    if isinstance(value, str) and text in choices:
        return text
    meant = (other or {}).get(text)
    raise ConfigError(
        f"{value!r:.200} is not allowed; expected one of {', '.join(choices)}",
        where=str(where),
        hint=f"did you mean {meant!r}?" if meant else nearest(text, choices),
    )


def unit(text: Any, quantity: str | None, where: Entry) -> str:
    """A unit, of that quantity if one is named."""
    if not isinstance(text, str):
        raise ConfigError(f"{text!r:.200} is no unit", where=str(where), hint='write a text such as "g" or "lbf"')
    try:
        parse_unit(text, quantity)
    except UnitError as error:
        raise ConfigError(error.message, where=str(where), hint=error.hint) from None
    return text


def units(table: Mapping[str, Any], where: Entry) -> dict[str, Any]:
    """The section [units]."""
    check_keys(table, (*SI_UNIT, "length", "sampling_hz", "frequency_step_hz", "columns"), where)
    out: dict[str, Any] = {}
    for quantity, text in table.items():
        here = where.at(quantity)
        if quantity in ("sampling_hz", "frequency_step_hz"):
            out[quantity] = _positive(text, here)
        elif quantity == "columns":
            from operando.io.columns import check_columns

            out[quantity] = list(check_columns(text, str(here)))
        else:
            out[quantity] = unit(text, "displacement" if quantity == "length" else quantity, here)
    return out


def channels(table: Mapping[str, Any], where: Entry) -> dict[str, dict[str, Any]]:
    """The section [channels]."""
    out: dict[str, dict[str, Any]] = {}
    for name, entry in table.items():
        here = where.at(name)
        if not isinstance(entry, Mapping):
            hint = 'write for example {dof = "12+Z", quantity = "acceleration", unit = "g"}'
            raise ConfigError(f"{entry!r:.200} is no table", where=str(here), hint=hint)
        check_keys(entry, CHANNEL_KEYS, here)
        if "dof" in entry:
            dof(entry["dof"], here)
        quantity = entry.get("quantity")
        if quantity is not None and (not isinstance(quantity, str) or quantity not in SI_UNIT):
            raise ConfigError(f"unknown quantity {quantity!r:.200}", where=str(here), hint=nearest(str(quantity), SI_UNIT, 40))
        if "unit" in entry:
            unit(entry["unit"], quantity, here)
        if "sensitivity" in entry and (not is_number(entry["sensitivity"]) or entry["sensitivity"] == 0):
            raise ConfigError(f"sensitivity is {entry['sensitivity']!r:.200}, expected a number other than 0", where=str(here))
        if not isinstance(entry.get("exclude", False), bool):
            raise ConfigError(f"exclude is {entry['exclude']!r:.200}, expected true or false", where=str(here))
        if not isinstance(entry.get("reason", ""), str):
            raise ConfigError(f"reason is {entry['reason']!r:.200}, expected a text", where=str(here))
        out[name] = dict(entry)
    return out


def directions(table: Mapping[str, Any], where: Entry) -> dict[str, tuple[float, ...]]:
    """The section [directions]: DOF in its positive sense → vector of unit length."""
    out: dict[str, tuple[float, ...]] = {}
    for label, value in table.items():
        here = where.at(label)
        found = dof(label, here, "write node, sign and a name in lower case, as in 5+a, or the label the file has, as in 7+X")
        if found.axis in ("", "RX", "RY", "RZ"):
            raise ConfigError(f"{found} is a {'rotation' if found.axis else 'scalar'}, which has no direction here", where=str(here))
        expect(value, isinstance(value, list | tuple) and len(value) == 3 and all(is_number(v) for v in value), "three numbers", here)
        length = sum(float(v) * float(v) for v in value) ** 0.5
        if abs(length - 1) > NOT_UNIT:
            raise ConfigError(
                f"the vector has length {length:.3g}, expected a unit vector", where=str(here), hint="divide it by its length"
            )
        if str(found.unsigned) in out:
            raise ConfigError(f"the direction of {found.unsigned} is given twice", where=str(here))
        out[str(found.unsigned)] = tuple(found.sign * float(v) / length for v in value)
    return out


BETWEEN = ("sensor_gain", "force_gain", "stiffness", "damping", "offset", "skew")
"""What may differ between two measurements: gains, stiffness and damping relative, offsets as a share of a shape, the skew in seconds."""


def between(table: Mapping[str, Any], where: Entry) -> dict[str, float]:
    """Standard deviations of what may differ between two measurements; 0 for what does not.

    Raises
    ------
    ConfigError
        If a name is unknown or a value is no number from 0 to 1.
    """
    check_keys(table, BETWEEN, where)
    for name, value in table.items():
        expect(value, is_number(value) and 0 <= value <= 1, "a standard deviation from 0 to 1", where.at(name))
    return {name: float(value) for name, value in table.items()}


REPORT = ("object", "date", "operator", "sensors", "comments")
"""Lines of the title block of the report."""


def report(table: Mapping[str, Any], where: Entry) -> dict[str, str]:
    """Lines of the title block; a list is joined by commas, a date of TOML is written as one.

    Raises
    ------
    ConfigError
        If a line is unknown or no text.
    """
    check_keys(table, REPORT, where)
    lines = {}
    for name, value in table.items():
        parts = value if isinstance(value, list) else [value]
        good = all(isinstance(p, str | datetime.date) for p in parts)
        expect(value, good, "a text, a date or a list of them", where.at(name))
        lines[name] = ", ".join(str(p) for p in parts)
    return lines


def declared(channels: Mapping[str, Mapping[str, Any]], directions: Mapping[str, Any], where: Entry) -> None:
    """Every named direction in [channels] must stand in [directions]."""
    for name, entry in channels.items():
        if "dof" in entry and (found := Dof.parse(entry["dof"])).named and str(found.unsigned) not in directions:
            near = difflib.get_close_matches(str(found.unsigned), directions, 1, 0.5)
            raise ConfigError(
                f"direction {found.axis!r} of {found} is not declared",
                where=str(where.at(name)),
                hint=f"did you mean {near[0]!r}?" if near else f'give its unit vector: [directions] "{found.unsigned}" = [0.0, 0.6, 0.8]',
            )


def dof(text: Any, where: Entry, hint: str | None = None) -> Dof:
    """A DOF label."""
    try:
        return Dof.parse(text)
    except DofError as error:
        raise ConfigError(error.message, where=str(where), hint=hint or error.hint) from None


def setting(name: str, value: Any, where: Entry) -> Any:
    """The value of a setting of [analysis]."""
    return SETTINGS[name](value, where)


def _band(value: Any, where: Entry) -> tuple[float, float]:
    good = isinstance(value, list | tuple) and len(value) == 2 and all(is_number(v) for v in value)
    expected = "two frequencies [low, high] in Hz with 0 <= low < high"
    hint = f"did you mean [{value[1]:g}, {value[0]:g}]?" if good and 0 <= value[1] < value[0] else "for example band = [5.0, 220.0]"
    expect(value, good and 0 <= value[0] < value[1], expected, where, hint)
    return float(value[0]), float(value[1])


def _bands(value: Any, where: Entry) -> tuple[tuple[float, float], ...]:
    good = isinstance(value, list | tuple)
    hint = f"write [[{value[0]:g}, {value[1]:g}]]" if good and len(value) == 2 and all(is_number(v) for v in value) else None
    expect(value, good and hint is None, "a list of [low, high] in Hz", where, hint)
    return tuple(_band(v, where) for v in value)


def _numbers(value: Any, where: Entry) -> tuple[float, ...]:
    good = isinstance(value, list | tuple) and all(is_number(v) and v > 0 for v in value)
    return tuple(float(v) for v in expect(value, good, "a list of frequencies in Hz", where))


def _texts(value: Any, where: Entry) -> tuple[str, ...]:
    return tuple(expect(value, isinstance(value, list | tuple) and all(isinstance(v, str) for v in value), "a list of texts", where))


def _dofs(value: Any, where: Entry) -> tuple[str, ...]:
    return tuple(str(dof(text, where)) for text in _texts(value, where))


def _kinds(value: Any, where: Entry) -> tuple[str, ...]:
    from operando.structure.effects import catalogue

    known = catalogue()
    for name in (texts := _texts(value, where)):
        if name not in known:
            raise ConfigError(f"unknown kind of effect {name!r}", where=str(where), hint=nearest(name, sorted(known), 40))
    return texts


def _scaling(value: Any, where: Entry) -> str:
    return one_of(("auto", *METHODS), value, where)


def _window(value: Any, where: Entry) -> str:
    return one_of(tuple(dict.fromkeys((*WINDOWS, *IMPACT_WINDOWS))), value, where, OTHER_WORDS)


def _hits(value: Any, where: Entry) -> tuple[str, ...]:
    texts = _texts(value, where)
    for text in texts:
        if not re.fullmatch(r".+#\d{1,9}", text):
            hint = 'write FILE#NUMBER, as in "idle/hammer1.uff#3"; numbers from 0'
            raise ConfigError(f"{text!r:.200} names no hit", where=str(where), hint=hint)
    return texts


def _positive(value: Any, where: Entry) -> float:
    return float(expect(value, is_number(value) and value > 0, "a positive number", where))


def _overlap(value: Any, where: Entry) -> float:
    hint = f"a share, not per cent: did you mean {value / 100:g}?" if is_number(value) and 1 < value < 100 else None
    return float(expect(value, is_number(value) and 0 <= value < 1, "a number from 0 to below 1", where, hint))


def _order(value: Any, where: Entry) -> int:
    good = isinstance(value, int) and not isinstance(value, bool) and 2 <= value <= 100_000
    return int(expect(value, good, "a whole number of at least 2", where))


def _threshold(value: Any, where: Entry) -> float:
    return float(expect(value, is_number(value) and 0 < value <= 1, "a MAC value above 0 and up to 1", where))


def _flag(value: Any, where: Entry) -> bool:
    return bool(expect(value, isinstance(value, bool), "true or false", where))


def _choice(choices: tuple[str, ...]) -> Callable[[Any, Entry], str]:
    return lambda value, where: one_of(choices, value, where)


SETTINGS: dict[str, Callable[[Any, Entry], Any]] = {
    "band": _band, "block_seconds": _positive, "overlap": _overlap, "window": _window, "estimator": _choice(ESTIMATORS),
    "hits": _choice(HITS), "hits_reject": _hits, "references": _dofs, "max_order": _order, "ema": _choice(EMA_ANSWERS),
    "modes_hz": _numbers, "select_hz": _numbers, "reject_hz": _numbers,
    "threshold": _threshold, "scaling": _scaling, "known_harmonics_hz": _numbers, "exclude_bands": _bands, "kinds": _kinds,
    "places": _dofs, "oma_max_order": _order, "oma_references": _dofs, "oma_select_hz": _numbers, "oma_reject_hz": _numbers,
    "second_opinion": _flag,
}  # fmt: skip
"""The check of each setting of [analysis]."""
