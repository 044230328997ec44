"""Tables of time histories: CSV and its relatives (comma, semicolon, tab, blanks; decimal comma)."""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from operando.atomic import replacing
from operando.data import Finding, TimeRecord
from operando.errors import FormatError, UnitError
from operando.io.columns import NODES, TIME, NoHeader, NoMeasurement, NoRate, check_columns, described_structure, propose_columns
from operando.io.content import Content, SetInfo
from operando.io.frf_table import BARE, is_frf_table, read_bare_frf, read_frf_table
from operando.io.node_table import read_node_table
from operando.io.quantities import ChannelSpecs, Units, stated_rate
from operando.io.sep005 import make_record
from operando.io.uff.increments import even_step, tidy_rate
from operando.printable import printable
from operando.units import parse_unit

_TIME_NAMES = re.compile(r"^(t|time|zeit|temps|seconds?|time[ _]?s|timestamp)$", re.IGNORECASE)
_RATE_NAMES = re.compile(r"^(fs|sampling(_?hz|_?rate|_?frequency)?|sample_?rate|rate)$", re.IGNORECASE)
_HEADER_UNIT = re.compile(r"^(.*?)\s*[\[(]([^\[\]()]*(?:\([^()]*\))?[^\[\]()]*)[\])]\s*$")
_UFF_NAMES = (".uff", ".unv", ".uf", ".bunv", ".58")
_NO_UFF = "no UFF file (no line with -1), read as a table"
_UFF_HAS = "a universal file has sets between lines of -1; this file has none"

_BLOCK = 1 << 20
LONGEST_NAME = 1000
"""Most characters of a column name; UFF and TDMS names stay below 256, and a name is shown in every table."""


def read_csv(
    path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None, sampling_hz: float | None = None
) -> Content:
    """Read a table with a header line of ``name [unit]``, one column a channel, or a frequency column and FRFs (``frf_table``).

    A table without a header line is read where ``units["columns"]`` says what its columns are: ``["Hz", "dB", "deg"]``,
    ``["Hz", "magnitude", "deg"]``, ``["Hz", "real", "imag"]``, ``["Hz", "dB"]``, or ``["s", "g", "N"]``: time, then the unit of
    each channel.

    A table with a column of nodes and the columns x, y and z is a geometry (``node_table``).

    The rate comes from a time column (``t``, ``time``, …), a column or comment ``fs``, ``sampling_hz`` or ``units["sampling_hz"]``.

    Parameters
    ----------
    path : path
        File.
    units : Units, optional
        Quantity → unit, where the file does not say.
    channels : ChannelSpecs, optional
        Channel name or DOF → what it is, where the file is silent or wrong.
    sampling_hz : float, optional
        Sampling rate [Hz] of a table without a time column.

    Returns
    -------
    Content

    Raises
    ------
    FormatError
        If there is no header line, no number, no sampling rate, the time is not even, or the table describes lines or directions.

    Examples
    --------
    >>> import tempfile, numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.arange(20.0).reshape(2, 10), 500.0, channels)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_csv(f"{folder}/run.csv", record)
    ...     read_csv(f"{folder}/run.csv").records[0].n_samples
    10
    """
    path = Path(path)
    if path.suffix.lower() not in _UFF_NAMES:
        return _read_table(path, units, channels, sampling_hz)
    try:
        content = _read_table(path, units, channels, sampling_hz)
    except FormatError as error:
        error.message = f"{_NO_UFF}: {error.message}"
        error.hint = _UFF_HAS + (f"; a table: {error.hint}" if error.hint else "")
        raise
    note = Finding("format", _NO_UFF, "info", str(path), action="call it .csv or .txt if it is a table")
    return replace(content, findings=(note, *content.findings))


def _read_table(path: Path, units: Units | None, channels: ChannelSpecs | None, sampling_hz: float | None) -> Content:
    from operando.io.uff.reader import open_file, provenance_of

    where = str(path)
    with open_file(path) as stream:
        text = _decoded(stream.read(), where)
    head = _head(text, where)
    comments = head.comments
    what = described_structure(head.heads)
    if what == NODES:
        return _nodes(text, head, path, units)
    if what:
        raise NoMeasurement(what, head.heads, where)
    names, texts, table = _table(text, head, where, units)
    del text
    if is_frf_table(names):
        return read_frf_table(names, texts, table, comments, path, units, channels)
    if names[:1] == [BARE]:
        return read_bare_frf(table, texts, path, units, channels)
    infos: list[SetInfo] = []
    rate = sampling_hz or stated_rate(units, comments)
    keep: list[int] = []
    start, time_column = 0.0, None
    for i, name in enumerate(names):
        column = table[i]
        finite = int(np.count_nonzero(np.isfinite(column)))
        if finite and _RATE_NAMES.match(name):
            rate = rate or float(column[np.isfinite(column)][0])
            infos.append(SetInfo(i, 0, f"column {name}", "used", "sampling rate"))
        elif time_column is None and _TIME_NAMES.match(name):
            time_column = i
            infos.append(SetInfo(i, 0, f"column {name}", "used", "time"))
        elif finite < 0.5 * table.shape[1]:
            infos.append(SetInfo(i, 0, f"column {name or i}", "ignored", f"{finite} of {table.shape[1]} rows hold a number"))
        else:
            keep.append(i)
    if time_column is not None:
        found, start = _rate_of_time(table[time_column], texts[time_column], where)
        rate = rate or found
    if not rate:
        raise NoRate(where)
    if not keep:
        raise FormatError("no column with data beside the time", where=where)
    provenance = provenance_of(path)
    record = make_record(
        table[keep], float(rate), [names[i] or f"ch{i + 1}" for i in keep], [texts[i] for i in keep], start_s=start, units=units,
        channels=channels, source=where, provenance=provenance,
    )  # fmt: skip
    used = {c.name for c in record.channels}
    for i in keep:
        name = names[i] or f"ch{i + 1}"
        infos.append(
            SetInfo(i, 0, f"column {name}", "used" if name in used else "ignored", "" if name in used else "excluded by [channels]")
        )
    findings: list[Finding] = list(record.findings)
    gaps = int(np.count_nonzero(~np.isfinite(record.data)))
    if gaps:
        findings.append(
            Finding("nan", f"{gaps} cells of the table hold no number", "warning", where, consequence="they are NaN in the record")
        )
    return Content(where, "csv", (record,), sets=tuple(sorted(infos, key=lambda s: s.index)), findings=tuple(findings))


def write_csv(path: str | Path, record: TimeRecord) -> None:
    """Write a record as CSV with a time column and a header of ``name [unit]``; all digits are kept.

    Parameters
    ----------
    path : path
        File.
    record : TimeRecord
        One record.

    Raises
    ------
    MissingError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile, numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.arange(20.0).reshape(2, 10), 500.0, channels)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_csv(f"{folder}/run.csv", record)
    ...     Path(folder, "run.csv").read_text().splitlines()[0]
    '# sampling_hz = 500.0'
    """
    heads = ["time [s]"]
    for i, channel in enumerate(record.channels):
        name = cell_text(channel.label or f"ch{i + 1}")
        heads.append(f"{name} [{channel.unit}]" if channel.unit else name)
    digits = 9 if record.data.dtype == np.float32 else 17
    with replacing(path, "w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"# sampling_hz = {record.sampling_hz!r}\n")
        stream.write(",".join(heads) + "\n")
        block = 4096
        time = record.time_s
        line = ",".join(["%.17g"] + [f"%.{digits}g"] * len(record.channels)) + "\n"
        for start in range(0, record.n_samples, block):
            rows = np.column_stack([time[start : start + block], record.data[:, start : start + block].T])
            stream.write((line * len(rows)) % tuple(rows.ravel().tolist()))


def cell_text(name: str) -> str:
    """A name as the head of a column: no mark that divides cells or stands around a unit, nothing that acts, and no formula.

    Spreadsheets take a cell that starts with ``=``, ``+``, ``-`` or ``@`` for a formula; an apostrophe before it says text. Reading
    takes the apostrophe off again.
    """
    clean = printable(name).replace(",", " ").replace(";", " ").replace("[", "(").replace("]", ")")
    return f"'{clean}" if clean.lstrip()[:1] in ("=", "+", "-", "@", "|", "%") else clean


def _decoded(raw: bytes, where: str) -> str:
    for encoding in ("utf-16",) if raw.startswith((b"\xff\xfe", b"\xfe\xff")) else ("utf-8-sig", "latin-1"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise FormatError("the text cannot be decoded", where=where)


class _Head(NamedTuple):
    """What stands above the rows of a table, and where these begin."""

    comments: list[str]
    names: list[str]
    delimiter: str | None
    decimal: str
    position: int
    length: int

    @property
    def heads(self) -> list[str]:
        """Names of the columns without their units."""
        return [_split_name(name)[0] for name in self.names if name]


def _head(text: str, where: str) -> _Head:
    """The header line, and what it and the first rows say of the table."""
    lines = text.split("\n", 60)
    comments: list[str] = []
    position = 0
    head = None
    for line in lines[:50]:
        length = len(line) + 1
        clean = line.strip()
        if not clean or clean.startswith("#") or clean.startswith("%"):
            comments.append(clean)
            position += length
            continue
        head = clean
        position += length
        break
    rest = text[position:]
    rows = [row.strip() for row in rest.split("\n", 50)[:50] if row.strip()]
    first_row = rows[0] if rows else ""
    if head is None or not first_row:
        raise FormatError("no header line and data below it", where=where, hint="the first line names the columns: name [unit]")
    delimiter, decimal = _delimiter(head, rows)
    names = [part.strip().strip("\"'").strip() for part in (head.split(delimiter) if delimiter else head.split())]
    return _Head(comments, names, delimiter, decimal, position, length)


def _nodes(text: str, head: _Head, path: Path, units: Units | None) -> Content:
    """A table of nodes and coordinates, row by row: nodes may be texts."""
    split = [_split_name(name) for name in head.names]
    first = text[: head.position].count("\n") + 1
    rows = [(first + i, row.split(head.delimiter)) for i, row in enumerate(text[head.position :].split("\n")) if _is_row(row)]
    return read_node_table([s[0] for s in split], [s[1] for s in split], rows, head.decimal, path, units)


def _is_row(line: str) -> bool:
    return bool(line.strip()) and line.strip()[0] not in "#%"


def _table(text: str, head: _Head, where: str, units: Units | None) -> tuple[list[str], list[str], NDArray[np.float64]]:
    """Column names, unit texts, (n_columns, n_rows) numbers."""
    names, delimiter, decimal = head.names, head.delimiter, head.decimal
    rest = text[head.position :]
    if all(_is_number(part.replace(",", ".")) for part in names if part):
        return _without_header(_numbers(text[head.position - head.length :], delimiter, decimal, where).T, where, units)
    numbers = _numbers(rest, delimiter, decimal, where)
    if what := described_structure(head.heads, numbers):
        raise NoMeasurement(what, head.heads, where)
    if numbers.shape[1] < len(names) and not any(names[numbers.shape[1] :]):
        names = names[: numbers.shape[1]]
    if not np.any(np.isfinite(numbers[:, len(names) :])):
        numbers = numbers[:, : len(names)]
    if numbers.shape[1] != len(names):
        hint = "name each column once in the header; with decimal commas, separate the columns by semicolons or tabs"
        raise FormatError(f"{numbers.shape[1]} columns of numbers but {len(names)} names", where=where, hint=hint)
    longest = max(names, key=len)
    if len(longest) > LONGEST_NAME:
        raise FormatError(
            f"a column name of {len(longest)} characters: {longest[:20]}…",
            where=where,
            hint=f"a name has at most {LONGEST_NAME} characters; is the header line damaged?",
        )
    filled = [i for i, name in enumerate(names) if name or np.any(np.isfinite(numbers[:, i]))]
    split = [_split_name(names[i]) for i in filled]
    return [s[0] for s in split], [s[1] for s in split], np.ascontiguousarray(numbers[:, filled].T)


def _without_header(table: NDArray[np.float64], where: str, units: Units | None) -> tuple[list[str], list[str], NDArray[np.float64]]:
    """Names, units and numbers of a table whose columns the test file states."""
    stated = (units or {}).get("columns")
    if not stated:
        raise NoHeader(where, propose_columns(table))
    columns = check_columns(stated, "[units] columns")
    if len(columns) != len(table):
        raise FormatError(f"{len(table)} columns of numbers, but [units] columns names {len(columns)}", where=where)
    if columns[0] in TIME:
        return ["time", *(f"ch{i}" for i in range(1, len(columns)))], list(columns), np.ascontiguousarray(table)
    return [BARE, *columns[1:]], list(columns), table


def _split_name(head: str) -> tuple[str, str]:
    """Name and unit of a column head: ``FA [g]``, ``acc (m/s2)``; round brackets count only around a known unit."""
    match = _HEADER_UNIT.match(head)
    if match is None:
        return head, ""
    if "[" not in head:
        try:
            parse_unit(match[2])
        except UnitError:
            return head, ""
    return match[1].strip().strip("\"'"), match[2].strip()


def _delimiter(head: str, rows: list[str]) -> tuple[str | None, str]:
    """Delimiter (None: blanks) and decimal mark, from the head and some rows."""
    sample = "\n".join(rows)
    for delimiter in (";", "\t"):
        if delimiter in rows[0]:
            return delimiter, "," if "," in sample and "." not in sample else "."
    if "," in rows[0]:
        if "," not in head and " " in rows[0]:
            return None, ","
        return ",", "."
    return None, "."


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(text: str, delimiter: str | None, decimal: str, where: str) -> NDArray[np.float64]:
    """(n_rows, n_columns) numbers; empty cells are NaN. Read block by block: cleaned copies of a text take several times its size."""
    parts: list[NDArray[np.float64]] = []
    start = 0
    while start < len(text):
        stop = text.find("\n", start + _BLOCK) + 1 or len(text)
        part = _block_numbers(text[start:stop], delimiter, decimal, where)
        if part.size:
            parts.append(part)
        start = stop
    widths = sorted({part.shape[1] for part in parts})
    if len(widths) != 1:
        raise FormatError(f"rows of {' and '.join(str(w) for w in widths) or 'no'} columns", where=where, hint="remove damaged rows")
    return np.concatenate(parts)


def _block_numbers(text: str, delimiter: str | None, decimal: str, where: str) -> NDArray[np.float64]:
    clean = text.replace("\r", "")
    if decimal == ",":
        clean = clean.replace(",", ".")
    if delimiter is not None:
        mark = re.escape(delimiter)
        clean = re.sub(rf"(?<={mark})[ \t]*(?={mark}|\n|\Z)" if delimiter != "\t" else rf"(?<={mark})(?={mark}|\n|\Z)", "nan", clean)
        clean = re.sub(rf"(?m)^[ ]*(?={mark})", "nan", clean)
    clean = clean.replace('"', "")
    if not clean.strip():
        return np.empty((0, 0))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.loadtxt(io.StringIO(clean), delimiter=delimiter, ndmin=2, comments="#")
    except (ValueError, UserWarning) as error:
        hint = "a table holds one header line such as time [s],1+Z [m/s2], and numbers below it"
        raise FormatError(f"the table cannot be read: {str(error).splitlines()[0]}", where=where, hint=hint) from error


def _rate_of_time(time: NDArray[np.float64], unit: str, where: str) -> tuple[float, float]:
    """Rate [Hz] and start [s] of a time column."""
    factor = 1.0
    if unit:
        try:
            factor = parse_unit(unit, "time")[1]
        except UnitError as error:
            raise FormatError(f"the time column is in {unit!r}: {error.message}", where=where) from error
    seconds = time * factor
    if seconds.size < 2:
        raise FormatError(f"{seconds.size} row of samples tells no sampling rate", where=where, hint="give the whole record")
    if not np.all(np.isfinite(seconds)) or not np.all(np.diff(seconds) > 0):
        raise FormatError("the time column does not increase from row to row", where=where, hint="remove repeated or damaged rows")
    step, off = even_step(seconds)
    if off > 0.5:
        hint = "resample the data at a constant rate"
        raise FormatError(f"the samples are not evenly spaced: up to {off:.3g} samples off", where=where, hint=hint)
    return tidy_rate(step), float(seconds[0])
