"""Tables without a header line: what their columns are is stated in the test file, and proposed from the numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, complex_of
from operando.errors import ConfigError, FormatError, UnitError
from operando.printable import first_few
from operando.units import parse_unit

FREQUENCY, TIME = ("Hz", "rad/s"), ("s", "ms")
LEVELS = ("dB", "magnitude", "real")
ANGLES = ("deg", "rad", "imag")


class NoHeader(FormatError):
    """A table without a header line; ``guess`` says what its columns may be, as for :func:`check_columns` (empty: no guess)."""

    def __init__(self, where: str, guess: Sequence[str]) -> None:
        hint = 'say in the test file what the columns are: [units] columns = ["Hz", "dB", "deg"] or ["s", "g", "N"]'
        proposal = f"; by the numbers perhaps {json.dumps(list(guess))}" if guess else ""
        super().__init__("the table has no header line", where=where, hint=hint + proposal)
        self.guess = tuple(guess)


class NoLines(FormatError):
    """FRFs of so many lines whose frequencies nobody states."""

    def __init__(self, lines: int, where: str = "") -> None:
        super().__init__(
            f"FRFs of {lines} lines, and no frequencies: no frequency vector (f) and no sampling rate (fs) beside them", where=where,
            hint="give [units] frequency_step_hz in the test file, or save f beside the data",
        )  # fmt: skip
        self.lines = lines


class NoRate(FormatError):
    """Time histories whose sampling rate nobody states."""

    def __init__(
        self,
        where: str,
        message: str = "no time column and no sampling rate",
        hint: str = "give the rate of the recorder in the test file, [units] sampling_hz (for example 1024, in Hz)",
    ) -> None:
        super().__init__(message, where=where, hint=hint)


class NoMeasurement(FormatError):
    """A table that describes the structure or the sensors: lines between nodes, directions."""

    def __init__(self, what: str, heads: Sequence[str], where: str) -> None:
        hint = "directions belong in [directions] of the test file"
        if "directions" not in what:
            hint = 'operando.Geometry(nodes, coordinates, lines).save("geometry.uff") makes a file with lines, which [geometry] takes'
        names = first_few(heads, 5)
        super().__init__(f"a table of {what} ({names}), no measurement", where=where, hint=hint)


_NODE = re.compile(r"^(node|point|knoten)s?([ _.-]?(name|number|no|nr|num|id|label|index))?s?\.?$", re.IGNORECASE)
_ENDS = re.compile(
    r"^((from|to|start|end|first|second)([ _-]?node)?|node[ _-]?(from|to|start|end|(name|number|no|nr|id|label)?[ _-]?[12ijab]))$",
    re.IGNORECASE,
)
_DIRECTION = re.compile(r"^(azimuth|elevation|direction)([ _-]?(deg|rad))?s?$", re.IGNORECASE)


NODES = "nodes and coordinates"
"""What a table is called whose nodes have x, y and z: a geometry."""


def is_node_column(name: str) -> bool:
    """Whether a column is called as one of nodes: ``Node``, ``point no``, ``node_name``."""
    return _NODE.match(name) is not None


def described_structure(heads: Sequence[str], numbers: NDArray[np.float64] | None = None) -> str:
    """What a table describes of the structure: ``NODES``, ``nodes and directions``, ``lines between nodes``; empty where it may be none.

    A column of nodes beside x, y, z or a direction is enough. Two columns of ends may be channels of two nodes as well: their ``numbers``
    (n_rows, n_columns) decide, whole and positive, and no row twice the same.
    """
    names = {head.lower() for head in heads}
    if any(is_node_column(name) for name in names) and not names & {"t", "time"}:
        if {"x", "y", "z"} <= names:
            return NODES
        if any(_DIRECTION.match(name) for name in names):
            return "nodes and directions"
    if numbers is None or len(names) != 2 or numbers.shape[1] != 2 or not all(_ENDS.match(name) for name in names):
        return ""
    whole = np.all(np.isfinite(numbers)) and np.all(numbers == np.round(numbers)) and np.all(numbers > 0)
    return "lines between nodes" if whole and np.all(numbers[:, 0] != numbers[:, 1]) else ""


def check_columns(columns: Any, where: str) -> tuple[str, ...]:
    """``[units] columns`` of a test file, checked.

    ``["Hz", "dB", "deg"]``: a frequency (Hz or rad/s), a level (dB, magnitude, or real) and the phase (deg or rad) or imag; or
    ``["s", "g", "N"]``: a time (s or ms) and the unit of each channel, empty where it is not known.
    """
    expected = 'write ["Hz", "dB", "deg"], ["Hz", "magnitude", "deg"], ["Hz", "real", "imag"], or ["s", "g", "N"] for time histories'
    if not isinstance(columns, list | tuple) or len(columns) < 2 or not all(isinstance(c, str) for c in columns):
        raise ConfigError(f"{columns!r} says nothing of columns", where=where, hint=expected)
    if columns[0] in TIME:
        for text in columns[1:]:
            try:
                parse_unit(text) if text else None
            except UnitError as error:
                raise ConfigError(error.message, where=where, hint=error.hint) from error
        return tuple(columns)
    pair = tuple(columns[1:3])
    good = columns[0] in FREQUENCY and len(columns) <= 3 and columns[1] in LEVELS
    good = good and (len(columns) == 2 or (columns[1] == "real") == (pair[1] == "imag")) and (len(columns) == 2 or columns[2] in ANGLES)
    if not good or (columns[1] == "real" and len(columns) == 2):
        raise ConfigError(f"{list(columns)!r} says nothing of columns", where=where, hint=expected)
    return tuple(columns)


def propose_columns(table: NDArray[Any]) -> tuple[str, ...]:
    """A guess of what the columns (n_columns, n_rows) are, from the numbers alone; empty where they tell nothing."""
    if table.shape[0] < 2 or table.shape[1] < 3 or not np.all(np.diff(table[0]) > 0):
        return ()
    # a record starts at 0 and is sampled faster than 100 Hz; lines closer than 0.01 Hz would need a record of more than 100 s
    step = float(np.median(np.diff(table[0])))
    if table.shape[0] > 3 or (step < 0.01 and table[0][0] == 0):
        return ("s", *("",) * (table.shape[0] - 1))
    if table.shape[0] == 2:
        return ("Hz", "magnitude") if np.all(table[1] >= 0) else ("s", "")
    level, angle = table[1], table[2]
    widest = float(np.max(np.abs(angle)))
    if np.all(level >= 0):
        return ("Hz", "magnitude", "rad" if widest <= 2 * np.pi + 1e-6 else "deg")
    # real and imaginary parts are of one size and change sign; levels in dB and degrees do neither
    alike = 0.2 < np.std(level) / max(float(np.std(angle)), 1e-300) < 5
    changes = 0.02 < np.mean(level > 0) < 0.98 and abs(float(np.mean(level))) < 2 * float(np.std(level))
    return ("Hz", "real", "imag") if alike and changes and widest < 30 else ("Hz", "dB", "deg" if widest > 2 * np.pi + 1e-6 else "rad")


def complex_lines(table: NDArray[Any], columns: Sequence[str], where: str) -> tuple[NDArray[Any], NDArray[Any], list[Finding]]:
    """Frequencies [Hz], complex values, and what is wrong with them."""
    if table.shape[0] != len(columns):
        raise FormatError(
            f"{table.shape[0]} columns of numbers, but [units] columns names {len(columns)}", where=where, hint=f"columns = {list(columns)}"
        )
    frequencies = table[0] / (2 * np.pi) if columns[0] == "rad/s" else table[0]
    if not np.all(np.isfinite(frequencies)) or not np.all(np.diff(frequencies) > 0) or frequencies[0] < 0:
        raise FormatError("the first column is no frequency: it does not increase from row to row", where=where)
    if columns[1] == "real":
        return frequencies, complex_of(table[1], table[2]), []
    with np.errstate(over="ignore", invalid="ignore"):  # levels of a damaged file
        size = 10.0 ** (table[1] / 20) if columns[1] == "dB" else table[1]
        if len(columns) > 2:
            angle = np.deg2rad(table[2]) if columns[2] == "deg" else table[2]
            return frequencies, complex_of(size * np.cos(angle), size * np.sin(angle)), []
    note = Finding(
        "missing_phase", "magnitudes without phase: the phase is taken as 0", "error", where,
        consequence="levels can be compared; modes and scaling made from it are wrong", action="export the phase, too",
    )  # fmt: skip
    return frequencies, size.astype(complex), [note]
