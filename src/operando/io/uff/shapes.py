"""Shapes at the nodes: data at nodes (55) and analysis data (2414) of UFF, real normal modes and complex modes."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import complex_of
from operando.errors import FormatError
from operando.io.uff.lines import body_lines, checked_floats, ints_of, said

NORMAL_MODE = 2
COMPLEX_MODES = (3, 7)
_COMPLEX_DATA = (5, 6)


@dataclass(frozen=True)
class ModeSet:
    """One set 55 or 2414: a shape (n_nodes, n_per_node) with its pole; ``kind`` is the analysis type (2 normal, 3 and 7 complex mode)."""

    kind: int
    nodes: tuple[int, ...]
    values: NDArray[Any]
    frequency_hz: float
    damping_ratio: float
    mode: int
    ids: tuple[str, ...]
    extra: dict[str, complex] = field(default_factory=dict)


def read_mode(raw: bytes) -> ModeSet:
    """One set 55: a real normal mode or a complex mode."""
    lines = body_lines(raw)
    if len(lines) < 8:
        raise FormatError(f"set 55 has {len(lines)} lines, its header alone has 8")
    ids = tuple(said(line) for line in lines[:5])
    _, kind, _, _, data_type, per_node = ints_of(lines[5], 6, "record 6 of set 55")
    number = ints_of(lines[6], 4, "record 7 of set 55")[3]
    numbers = checked_floats(lines[7], "record 8 of set 55")
    _check_kind(55, kind, data_type, per_node)
    if len(numbers) < 2:
        raise FormatError(f"record 8 of set 55 has {len(numbers)} numbers, expected the frequency or the pole: {lines[7].strip()[:80]!r}")
    if kind == NORMAL_MODE:
        frequency, damping = numbers[0], numbers[2] if len(numbers) > 2 else 0.0
        extra = {"modal_mass": complex(numbers[1])}
    else:
        frequency, damping, extra = _of_pole(complex(numbers[0], numbers[1]))
    frequency, damping = _exact_pole(ids, frequency, damping)
    return _mode(55, lines[8:], kind, data_type, per_node, frequency, damping, number, ids, extra)


def read_analysis(raw: bytes) -> ModeSet:
    """One set 2414 with data at nodes: a real normal mode or a complex mode."""
    lines = body_lines(raw)
    if len(lines) < 13:
        raise FormatError(f"set 2414 has {len(lines)} lines, its header alone has 13")
    if ints_of(lines[2], 1, "record 3 of set 2414")[0] != 1:
        raise FormatError("set 2414 holds data that are not at nodes")
    ids = (said(lines[1]), *(said(line) for line in lines[3:7]))
    _, kind, _, _, data_type, per_node = ints_of(lines[8], 6, "record 9 of set 2414")
    _check_kind(2414, kind, data_type, per_node)
    number = ints_of(lines[9], 6, "record 10 of set 2414")[5]
    numbers = [*checked_floats(lines[11], "record 12 of set 2414"), *checked_floats(lines[12], "record 13 of set 2414")]
    if len(numbers) < 8:
        raise FormatError(f"records 12 and 13 of set 2414 have {len(numbers)} numbers, expected 12")
    if kind == NORMAL_MODE:
        frequency, damping, extra = numbers[1], numbers[4], {"modal_mass": complex(numbers[3])}
    else:
        frequency, damping, extra = _of_pole(complex(numbers[6], numbers[7]))
    return _mode(2414, lines[13:], kind, data_type, per_node, frequency, damping, number, ids, extra)


def _check_kind(name: int, kind: int, data_type: int, per_node: int) -> None:
    if kind != NORMAL_MODE and kind not in COMPLEX_MODES:
        raise FormatError(f"set {name} of analysis type {kind} is no mode shape")
    if data_type not in (2, 4, *_COMPLEX_DATA) or not 1 <= per_node <= 6:
        raise FormatError(f"set {name} with data type {data_type} and {per_node} values a node is not understood")


def _of_pole(pole: complex) -> tuple[float, float, dict[str, complex]]:
    return abs(pole) / (2 * np.pi), -pole.real / abs(pole) if pole else 0.0, {"pole": pole}


def _mode(
    name: int, rows: list[str], kind: int, data_type: int, per_node: int, frequency: float, damping: float, number: int,
    ids: tuple[str, ...], extra: dict[str, complex],
) -> ModeSet:  # fmt: skip
    is_complex = data_type in _COMPLEX_DATA
    nodes, values = _node_values(rows, per_node * (2 if is_complex else 1), name)
    if not np.all(np.isfinite(values)):
        raise FormatError(f"set {name} holds values that are no finite numbers")
    table: NDArray[Any] = complex_of(values[:, 0::2], values[:, 1::2]) if is_complex else values
    if not (np.isfinite(frequency) and frequency >= 0 and np.isfinite(damping)):
        raise FormatError(f"set {name} states a frequency of {frequency} Hz and a damping ratio of {damping}")
    return ModeSet(kind, nodes, table, float(frequency), float(damping), number, ids, extra)


def _node_values(lines: list[str], per_node: int, name: int = 55) -> tuple[tuple[int, ...], NDArray[np.float64]]:
    nodes: list[int] = []
    rows: list[list[float]] = []
    i = 0
    while i < len(lines):
        if not lines[i].strip():
            i += 1
            continue
        nodes += ints_of(lines[i], 1, f"a node number of set {name}")
        if len(lines[i].split()) > 1:
            raise FormatError(f"set {name} has {lines[i].strip()[:80]!r} where a node number should stand")
        i += 1
        row: list[float] = []
        while len(row) < per_node:
            if i == len(lines):
                raise FormatError(f"set {name} ends after {len(row)} of the {per_node} values of node {nodes[-1]}")
            row += checked_floats(lines[i], f"a line of values of set {name}")
            i += 1
        if len(row) != per_node:
            raise FormatError(f"node {nodes[-1]} has {len(row)} values instead of {per_node}")
        rows.append(row)
    if not rows:
        raise FormatError(f"set {name} holds no node")
    return tuple(nodes), np.asarray(rows, float)


def _exact_pole(ids: tuple[str, ...], frequency: float, damping: float) -> tuple[float, float]:
    """The exact values operando writes into an ID line, where they agree with the six printed digits."""
    for line in ids:
        match = re.search(r"frequency_hz=(\S+) damping_ratio=(\S+)", line)
        if match is not None:
            try:
                exact = float(match[1]), float(match[2])
            except ValueError:
                return frequency, damping
            if abs(exact[0] - frequency) <= 2e-5 * abs(frequency) + 1e-12 and abs(exact[1] - damping) <= 1e-4 * abs(damping) + 1e-5:
                return exact
    return frequency, damping
