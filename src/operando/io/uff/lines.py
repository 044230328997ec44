"""Lines of the text sets of UFF: cutting, numbers in Fortran's writing, dates."""

from __future__ import annotations

import re
from datetime import datetime
from functools import lru_cache

from operando.errors import FormatError
from operando.io.uff.increments import parse_float

_D_EXPONENT = re.compile(r"(?<=[0-9.])[Dd](?=[+-]?[0-9])")
_GLUED = re.compile(r"(?<=[0-9.])(?=[+-][0-9]*\.)")
_DATE = re.compile(r"\b(\d{1,2})-([A-Za-z]{3})-(\d{4}|\d{2})\s+(\d{1,2}):(\d{2})(?::(\d{2}))?")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
OWN_LINES = ("H = response/force, e^(+i w t)", "sqrt(E|dH|^2) of each complex line", "operando time record")
"""Beginnings of the second ID line of the functions that operando writes: FRFs and coherences, standard deviations, records."""

_CENTURY = 70
"""Two digits of a year from here on are of the last century: the format is of 1970 and later."""


def decode(raw: bytes) -> str:
    """Text of a header field: UTF-8 where it is, else Latin-1; blanks and line ends taken off."""
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return text.strip(" \t\r\n\x00\x1a")


def said(text: str) -> str:
    """A text field; empty where it holds NONE."""
    clean = text.strip()
    return "" if clean.upper() == "NONE" else clean


def body_lines(raw: bytes) -> list[str]:
    """Lines of a set after the line with its number, without separators."""
    lines = [_line(line) for line in raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")]
    first = next((i for i, line in enumerate(lines) if line.strip() not in ("", "-1", "\ufeff-1")), len(lines))
    inner = lines[first + 1 :]
    while inner and inner[-1].strip() in ("", "-1"):
        inner.pop()
    return inner


def _line(line: bytes) -> str:
    text = decode(line)
    return " " * (len(line) - len(line.lstrip(b" "))) + text


def floats_of(line: str) -> list[float]:
    """Numbers of a line: Fortran exponents, numbers without a blank before their sign."""
    return [parse_float(t) for t in _GLUED.sub(" ", _D_EXPONENT.sub("E", line)).split()]


def checked_floats(line: str, what: str) -> list[float]:
    """The same, or an error that says of what the line is."""
    try:
        return floats_of(line)
    except ValueError as error:
        raise FormatError(f"{what} cannot be read: {line.strip()[:80]!r}") from error


def ints_of(line: str, count: int, what: str) -> list[int]:
    """The first whole numbers of a line, at least so many."""
    words = line.split()
    try:
        numbers = [int(word) for word in words[:count]]
    except ValueError as error:
        raise FormatError(f"{what} cannot be read: {line.strip()[:80]!r}") from error
    if len(numbers) < count:
        raise FormatError(f"{what} has {len(numbers)} of {count} numbers: {line.strip()[:80]!r}")
    return numbers


@lru_cache(maxsize=256)
def parse_date(text: str) -> str:
    """Date and time of a header line such as ``17-Nov-26 09:15:00`` in the form of ISO 8601; empty where there is none."""
    match = _DATE.search(text)
    if match is None or match[2].lower() not in _MONTHS:
        return ""
    year = int(match[3]) if len(match[3]) == 4 else int(match[3]) + (1900 if int(match[3]) >= _CENTURY else 2000)
    try:
        when = datetime(year, _MONTHS.index(match[2].lower()) + 1, int(match[1]), int(match[4]), int(match[5]), int(match[6] or 0))
    except ValueError:
        return ""
    return when.isoformat()


def in_uff(text: str) -> str:
    """A date of ISO 8601 as UFF writes it; any other text as it is."""
    try:
        return print_date(text)
    except ValueError:
        return text


def print_date(iso: str) -> str:
    """A date as UFF writes it, ``17-Nov-26 09:15:00``; empty where there is none."""
    if not iso:
        return ""
    when = datetime.fromisoformat(iso)
    return f"{when.day:02d}-{_MONTHS[when.month - 1].capitalize()}-{when.year % 100:02d} {when:%H:%M:%S}"
