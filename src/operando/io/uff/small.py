"""The small sets of UFF: 15, 82, 151, 164, 2411 through pyuff; 55 and 2412, which pyuff reads only in part, here."""

from __future__ import annotations

import re
import tempfile
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import FormatError
from operando.io.quantities import UnitSystem
from operando.io.uff.header58 import decode
from operando.io.uff.increments import parse_float

THROUGH_PYUFF = (15, 82, 151, 164, 2411)
_D_EXPONENT = re.compile(r"(?<=[0-9.])[Dd](?=[+-]?[0-9])")
_GLUED = re.compile(r"(?<=[0-9])(?=[+-][0-9]*\.)")
_TEXT_LINES = {82: (1,), 151: range(100), 164: (0,)}
_RODS = {11, 21, 22, 23, 24}


@dataclass(frozen=True)
class NodeSet:
    """Nodes of UFF 15 or 2411, in the units of the file, with the numbers of the systems of their coordinates and directions."""

    numbers: tuple[int, ...]
    coordinates: NDArray[np.float64]
    definition: tuple[int, ...]
    displacement: tuple[int, ...]


@dataclass(frozen=True)
class ModeSet:
    """One set 55: a shape with its pole.

    ``values`` is (n_nodes, n_per_node), real or complex; ``kind`` the analysis type (2 normal mode, 3 and 7 complex mode).
    """

    kind: int
    nodes: tuple[int, ...]
    values: NDArray[Any]
    frequency_hz: float
    damping_ratio: float
    mode: int
    quantity_code: int
    ids: tuple[str, ...]
    extra: dict[str, complex] = field(default_factory=dict)


def body_lines(raw: bytes) -> list[str]:
    """Lines of a set after the line with its number, without separators."""
    lines = [decode_line(line) for line in raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")]
    inner = lines[2:]
    while inner and inner[-1].strip() in ("", "-1"):
        inner.pop()
    return inner


def decode_line(line: bytes) -> str:
    """A line as text with its leading blanks."""
    text = decode(line)
    return " " * (len(line) - len(line.lstrip(b" "))) + text


def read_with_pyuff(number: int, raw: bytes) -> dict[str, Any]:
    """A small set as the dict of pyuff.

    The set is first brought into the form pyuff expects (line ends, exponents with E, blanks between numbers).

    Raises
    ------
    FormatError
        If pyuff cannot read it.
    """
    import pyuff

    lines = body_lines(raw)
    words = _TEXT_LINES.get(number, ())
    clean = [line if i in words else _GLUED.sub(" ", _D_EXPONENT.sub("E", line)) for i, line in enumerate(lines)]
    if number in (15, 2411):
        _check_table(" ".join(clean).split(), 7)
        # pyuff joins the lines of a set 15 without a blank between them.
        clean = [" " + line.strip() for line in clean]
    if number == 151:
        clean += [""] * (7 - len(clean))
    text = "\n".join(["    -1", f"{number:6d}", *clean, "    -1", ""])
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / "set.uff"
        path.write_text(text, encoding="utf-8", newline="\n")
        out, reason = None, "pyuff cannot read it"
        try:
            out = pyuff.UFF(str(path)).read_sets()
        except Exception as error:  # pyuff raises bare exceptions of every kind
            reason = str(error)
    # Raised outside: the error of pyuff would keep its open file alive.
    if not isinstance(out, dict) or out.get("type") != number:
        raise FormatError(f"set {number} cannot be understood: {reason}")
    return out


def _check_table(tokens: list[str], columns: int) -> None:
    if not tokens or len(tokens) % columns:
        raise FormatError(f"{len(tokens)} numbers do not make rows of {columns}")


def read_nodes(number: int, raw: bytes) -> NodeSet:
    """Nodes of a set 15 or 2411.

    Raises
    ------
    FormatError
        If the set cannot be read.
    """
    d = read_with_pyuff(number, raw)
    if len({len(d[key]) for key in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")}) != 1:
        raise FormatError(f"the columns of set {number} have different lengths")
    coordinates = np.column_stack([np.asarray(d[k], float) for k in ("x", "y", "z")])
    numbers = np.asarray(d["node_nums"], float)
    if not np.all(np.isfinite(coordinates)) or not np.all(np.isfinite(numbers)) or np.any(np.abs(numbers) > 2**53):
        raise FormatError(f"set {number} holds coordinates that are no finite numbers")
    systems = [np.asarray(d[key], float) for key in ("def_cs", "disp_cs")]
    if any(not np.all(np.abs(s) < 2**53) for s in systems):
        raise FormatError(f"set {number} holds coordinate systems that are no numbers")
    definition, displacement = (tuple(int(n) for n in s) for s in systems)
    return NodeSet(tuple(int(n) for n in numbers), coordinates, definition, displacement)


def read_traces(raw: bytes) -> list[tuple[int, ...]]:
    """Polylines of a set 82: zeros lift the pen.

    Raises
    ------
    FormatError
        If the set cannot be read.
    """
    values = np.asarray(read_with_pyuff(82, raw)["nodes"], float)
    if not np.all(np.isfinite(values)) or np.any(np.abs(values) > 2**53):
        raise FormatError("set 82 holds node numbers that are no numbers")
    lines: list[tuple[int, ...]] = []
    current: list[int] = []
    for node in [*(int(v) for v in values), 0]:
        if node == 0:
            if len(current) > 1:
                lines.append(tuple(current))
            current = []
        else:
            current.append(node)
    return lines


def read_units(raw: bytes) -> UnitSystem:
    """Unit factors of a set 164.

    Raises
    ------
    FormatError
        If the set cannot be read, or a factor is not positive.
    """
    d = read_with_pyuff(164, raw)
    length, force = float(d["length"]), float(d["force"])
    if not (0 < length < 1e30 and 0 < force < 1e30):
        raise FormatError(f"unit factors {length}, {force} of set 164 are not positive numbers")
    return UnitSystem(length, force, str(d.get("units_description", "")).strip())


def read_elements(raw: bytes) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Lines and faces of a set 2412: rods and beams, triangles and quadrilaterals (corner nodes; solids by none).

    Raises
    ------
    FormatError
        If the set cannot be read.
    """
    rows = [line.split() for line in body_lines(raw)]
    lines: list[tuple[int, ...]] = []
    faces: list[tuple[int, ...]] = []
    i = 0
    try:
        while i < len(rows):
            descriptor, count = int(rows[i][1]), int(rows[i][5])
            i += 2 if descriptor in _RODS else 1
            nodes: list[int] = []
            while len(nodes) < count:
                nodes += [int(t) for t in rows[i]]
                i += 1
            if len(nodes) != count or count < 1:
                raise FormatError(f"an element of set 2412 has {len(nodes)} nodes instead of {count}")
            corners = _corners(descriptor, nodes)
            if len(corners) == 2:
                lines.append(tuple(corners))
            elif len(corners) in (3, 4):
                faces.append(tuple(corners))
    except (ValueError, IndexError) as error:
        raise FormatError(f"set 2412 cannot be read at line {i}: {error}") from error
    return lines, faces


def _corners(descriptor: int, nodes: list[int]) -> list[int]:
    """Corner nodes of a line or shell element by its descriptor; none for solids and others."""
    if descriptor in _RODS or descriptor in (31, 32, 121, 122, 136, 137, 138, 139, 171):
        return [nodes[0], nodes[-1]] if len(nodes) > 1 else []
    if 41 <= descriptor <= 98:
        linear_triangle, quadratic_triangle = {41, 51, 61, 74, 81, 91}, {42, 52, 62, 72, 82, 92}
        if descriptor in linear_triangle or len(nodes) == 3:
            return nodes[:3]
        if descriptor in quadratic_triangle or len(nodes) == 6:
            return nodes[0:6:2]
        return nodes[0:8:2] if len(nodes) == 8 else nodes[:4]
    return []


def read_mode(raw: bytes) -> ModeSet:
    """One set 55: a real normal mode or a complex mode.

    Raises
    ------
    FormatError
        If the set cannot be read, or is of another analysis type than 2, 3, 7.
    """
    lines = body_lines(raw)
    if len(lines) < 8:
        raise FormatError(f"set 55 has {len(lines)} lines, its header alone has 8")
    ids = tuple("" if line.strip().upper() == "NONE" else line.strip() for line in lines[:5])
    try:
        _, kind, _, code, data_type, per_node = (int(t) for t in lines[5].split()[:6])
        record7 = [int(t) for t in lines[6].split()]
        record8 = floats_of(lines[7])
        if kind not in (2, 3, 7):
            raise FormatError(f"set 55 of analysis type {kind} is no mode shape")
        if data_type not in (2, 5) or not 1 <= per_node <= 6:
            raise FormatError(f"set 55 with data type {data_type} and {per_node} values a node is not understood")
        if len(record7) < 4:
            raise FormatError("record 7 of set 55 is incomplete")
        nodes, values = _node_values(lines[8:], per_node * (2 if data_type == 5 else 1))
    except (ValueError, IndexError) as error:
        raise FormatError(f"set 55 cannot be read: {error}") from error
    table: NDArray[Any] = values[:, 0::2] + 1j * values[:, 1::2] if data_type == 5 else values
    if kind == 2:
        frequency, damping = record8[0], record8[2] if len(record8) > 2 else 0.0
        extra = {"modal_mass": complex(record8[1] if len(record8) > 1 else 0.0)}
    else:
        pole = complex(record8[0], record8[1])
        frequency = abs(pole) / (2 * np.pi)
        damping = -pole.real / abs(pole) if pole else 0.0
        extra = {"pole": pole}
    frequency, damping = _exact_pole(ids, frequency, damping)
    if not (np.isfinite(frequency) and frequency >= 0 and np.isfinite(damping)):
        raise FormatError(f"set 55 states a frequency of {frequency} Hz and a damping ratio of {damping}")
    return ModeSet(kind, nodes, table, float(frequency), float(damping), record7[3], code, ids, extra)


def floats_of(line: str) -> list[float]:
    """Numbers of a line: Fortran exponents, numbers without a blank before their sign.

    Raises
    ------
    ValueError
        If a word is no number.
    """
    return [parse_float(t) for t in _GLUED.sub(" ", _D_EXPONENT.sub("E", line)).split()]


def _node_values(lines: list[str], per_node: int) -> tuple[tuple[int, ...], NDArray[np.float64]]:
    nodes: list[int] = []
    rows: list[list[float]] = []
    i = 0
    while i < len(lines):
        if not lines[i].strip():
            i += 1
            continue
        nodes.append(int(lines[i].split()[0]))
        i += 1
        row: list[float] = []
        while len(row) < per_node:
            if i == len(lines):
                raise FormatError(f"set 55 ends after {len(row)} of the {per_node} values of node {nodes[-1]}")
            row += floats_of(lines[i])
            i += 1
        if len(row) != per_node:
            raise FormatError(f"node {nodes[-1]} has {len(row)} values instead of {per_node}")
        rows.append(row)
    if not rows:
        raise FormatError("set 55 holds no node")
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
