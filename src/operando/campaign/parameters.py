"""Parameters of the tests of a campaign: values, units, and their places on an axis."""

from __future__ import annotations

import csv
import datetime
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

from operando.config import text_of
from operando.errors import ConfigError

Value = float | str
"""A parameter: a number, or a text (dates stand as ISO texts)."""

_UNIT = re.compile(r"^\s*(.*?)\s*\[\s*([^\]]*?)\s*\]\s*$")
_DAY = re.compile(r"^\d{4}-\d{2}-\d{2}([T ]\d{2}:\d{2}(:\d{2}(\.\d+)?)?)?$")


@dataclass(frozen=True)
class Row:
    """One row of the parameter table."""

    test: str | None = None  # test file of the row, where it gives one
    name: str | None = None
    parameters: Mapping[str, Value] = field(default_factory=dict)  # name → value
    texts: Mapping[str, str] = field(default_factory=dict)  # name → value as it stands in the table, for ``{name}`` in a template
    changes: tuple[str, ...] = ()  # entries of the test file this row changes, as ``--set`` takes them


def value_of(text: str, decimal_comma: bool = False) -> Value:
    """A number where the text is one, else the text."""
    stripped = text.strip()
    try:
        number = float(stripped.replace(",", ".") if decimal_comma else stripped)
    except ValueError:
        return stripped
    return number if isfinite(number) else stripped


def row_of(entry: Any, where: str) -> Row:
    """A row given in campaign.toml: ``{speed = 600, name = "slow"}``; a table in it holds entries of that section of the test file."""
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{entry!r:.200} is no row", where=where, hint="write for example rows = [{speed = 600}, {speed = 900}]")
    given: dict[str, str | None] = {"test": None, "name": None}
    parameters: dict[str, Value] = {}
    texts: dict[str, str] = {}
    changes: list[str] = []
    for key, value in entry.items():
        if key in given:
            if not isinstance(value, str) or not value.strip():
                raise ConfigError(f"{key} is {value!r:.200}, expected a text", where=where)
            given[key] = value.strip()
        elif isinstance(value, Mapping):
            changes += [f"{key}.{name}={_toml(inner, where)}" for name, inner in value.items()]
        elif "." in key:
            changes.append(f"{key}={_toml(value, where)}")
        elif isinstance(value, datetime.date | datetime.datetime):
            parameters[key] = texts[key] = value.isoformat()
        elif isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ConfigError(f"{key} is {value!r:.200}, expected a number, a text or a date", where=where)
        else:
            texts[key] = value.strip() if isinstance(value, str) else f"{value:.12g}"
            parameters[key] = value_of(texts[key])
    return Row(given["test"], given["name"], parameters, texts, tuple(changes))


def _toml(value: Any, where: str) -> str:
    """A value as TOML text, on one line."""
    try:
        return json.dumps(value, ensure_ascii=False)
    except TypeError:
        raise ConfigError(f"{value!r:.200} cannot stand in a row", where=where, hint="give numbers, texts, or lists of them") from None


def read_table(path: Path) -> tuple[list[Row], dict[str, str]]:
    """Rows and units of a CSV table with a header line ``name [unit]``; separators ``,``, ``;`` (with decimal comma) and tab."""
    try:
        lines = [line for line in text_of(path).splitlines() if line.strip() and not line.lstrip().startswith("#")]
    except IsADirectoryError:
        raise ConfigError("is a folder, expected a table", where=str(path)) from None
    if len(lines) < 2:
        raise ConfigError("holds no rows", where=str(path), hint="a header line such as speed [rpm],load [N], then one line a test")
    separator = max(";\t,", key=lambda mark: (lines[0].count(mark), mark == ";"))
    head, *body = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    names: list[str] = []
    units: dict[str, str] = {}
    for cell in head:
        match = _UNIT.match(cell)
        name = match[1] if match else cell.strip()
        if not name or name in names:
            raise ConfigError(
                f"column {len(names) + 1} has {'no name' if not name else f'the name {name!r} again'}", where=f"{path}, line 1"
            )
        names.append(name)
        if match:
            units[name] = match[2]
    rows = []
    for number, cells in enumerate(body, 2):
        if len(cells) != len(names):
            raise ConfigError(f"row {number - 1} has {len(cells)} cells, expected {len(names)}", where=str(path), hint="one cell a column")
        rows.append(_row_of_cells(dict(zip(names, (c.strip() for c in cells), strict=True)), separator == ";"))
    return rows, units


def _row_of_cells(cells: Mapping[str, str], decimal_comma: bool) -> Row:
    plain = {k: v for k, v in cells.items() if k not in ("test", "name") and "." not in k and v}
    changes = tuple(f"{k}={v}" for k, v in cells.items() if "." in k and v)
    parameters = {k: value_of(v, decimal_comma) for k, v in plain.items()}
    return Row(cells.get("test") or None, cells.get("name") or None, parameters, plain, changes)


def shown(name: str, value: Value | None, units: Mapping[str, str] | None = None) -> str:
    """``speed 600 rpm``; a dash where there is no value."""
    if value is None:
        return f"{name} –"
    text = value if isinstance(value, str) else f"{value:.6g}"
    unit = (units or {}).get(name, "")
    return f"{name} {text}" + (f" {unit}" if unit else "")


@dataclass(frozen=True)
class Axis:
    """What results are shown over."""

    label: str  # name with unit
    kind: str  # number, date, or order (texts, or values missing: the tests stand as in the table)
    places: tuple[float, ...]  # one a test; of dates, days since the first


def axis_of(name: str | None, parameters: Sequence[Mapping[str, Value]], units: Mapping[str, str]) -> Axis:
    """Places of tests by one of their parameters."""
    values = [p.get(name) if name is not None else None for p in parameters]
    if name is not None and values:
        if all(isinstance(v, float) for v in values):
            unit = f" [{units[name]}]" if units.get(name) else ""
            return Axis(name + unit, "number", tuple(float(v) for v in values if v is not None))
        if all(isinstance(v, str) and _DAY.match(v) for v in values):
            times = [datetime.datetime.fromisoformat(str(v)).replace(tzinfo=None) for v in values]
            return Axis(
                f"{name} [days since {min(times):%Y-%m-%d}]", "date", tuple((t - min(times)).total_seconds() / 86400 for t in times)
            )
    return Axis("test number", "order", tuple(float(i) for i in range(len(parameters))))
