"""Nodes (15, 2411), trace lines (82) and elements (2412) of UFF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.errors import FormatError
from operando.io.uff.lines import body_lines, floats_of, ints_of, said

_RODS = {11, 21, 22, 23, 24}
_LINES = _RODS | {31, 32, 121, 122, 136, 137, 138, 139, 171}
_LINEAR_TRIANGLES, _PARABOLIC_TRIANGLES = {41, 51, 61, 74, 81, 91}, {42, 52, 62, 72, 82, 92}


@dataclass(frozen=True)
class NodeSet:
    """Nodes of UFF 15 or 2411, in the units of the file, with the numbers of the systems of their coordinates and directions."""

    numbers: tuple[int, ...]
    coordinates: NDArray[np.float64]
    definition: tuple[int, ...]
    displacement: tuple[int, ...]
    colors: tuple[int, ...]


@dataclass(frozen=True)
class ElementSet:
    """Lines and faces of a set 2412 with their colours, and how many elements of each descriptor are neither."""

    lines: tuple[tuple[int, ...], ...]
    line_colors: tuple[int, ...]
    faces: tuple[tuple[int, ...], ...]
    face_colors: tuple[int, ...]
    others: dict[int, int]


def read_nodes(number: int, raw: bytes) -> NodeSet:
    """Nodes of a set 15 or 2411."""
    lines = [line for line in body_lines(raw) if line.strip()]
    try:
        words = [value for line in lines for value in floats_of(line)]
    except ValueError as error:
        raise FormatError(f"set {number} holds text that is no number: {error}") from error
    if not words or len(words) % 7:
        raise FormatError(f"{len(words)} numbers do not make rows of 7")
    table = np.reshape(np.asarray(words, float), (-1, 7))
    if not np.all(np.isfinite(table)) or np.any(np.abs(table[:, :4]) > 2**53):
        raise FormatError(f"set {number} holds coordinates or numbers of nodes that are no finite numbers")
    if np.any(table[:, :4] != np.round(table[:, :4])):
        raise FormatError(f"set {number} holds node, system or colour numbers that are not whole")
    numbers, definition, displacement, colors = (tuple(int(v) for v in column) for column in table[:, :4].T)
    if min(numbers) < 0:
        raise FormatError(f"set {number} holds the negative node number {min(numbers)}")
    return NodeSet(numbers, table[:, 4:].copy(), definition, displacement, colors)


def read_traces(raw: bytes) -> tuple[str, int, list[tuple[int, ...]]]:
    """Name, colour and polylines of a set 82: zeros lift the pen."""
    lines = body_lines(raw)
    if len(lines) < 2:
        raise FormatError(f"set 82 has {len(lines)} lines, its header alone has 2")
    _, count, color = ints_of(lines[0], 3, "record 1 of set 82")
    nodes = [n for line in lines[2:] for n in ints_of(line, len(line.split()), "a line of nodes of set 82")]
    # Some programs count the changes of node only: too many are taken, too few are not.
    if len(nodes) < count:
        raise FormatError(f"set 82 states {count} nodes and holds {len(nodes)}")
    if nodes and min(nodes) < 0:
        raise FormatError(f"set 82 holds the negative node number {min(nodes)}")
    traces: list[tuple[int, ...]] = []
    current: list[int] = []
    for node in [*nodes, 0]:
        if node:
            current.append(node)
            continue
        if len(current) > 1:
            traces.append(tuple(current))
        current = []
    return said(lines[1]), color, traces


def read_elements(raw: bytes) -> ElementSet:
    """Lines and faces of a set 2412: rods and beams, triangles and quadrilaterals (corner nodes; solids are counted)."""
    rows = [line for line in body_lines(raw) if line.strip()]
    lines: list[tuple[int, ...]] = []
    line_colors: list[int] = []
    faces: list[tuple[int, ...]] = []
    face_colors: list[int] = []
    others: dict[int, int] = {}
    i = 0
    while i < len(rows):
        label, descriptor, _, _, color, count = ints_of(rows[i], 6, "an element of set 2412")
        i += 2 if descriptor in _RODS else 1
        nodes: list[int] = []
        while len(nodes) < count and i < len(rows):
            nodes += ints_of(rows[i], len(rows[i].split()), f"the nodes of element {label} of set 2412")
            i += 1
        if len(nodes) != count or count < 1:
            raise FormatError(f"element {label} of set 2412 has {len(nodes)} nodes instead of {count}")
        corners = tuple(_corners(descriptor, nodes))
        if len(corners) == 2:
            lines.append(corners)
            line_colors.append(color)
        elif corners:
            faces.append(corners)
            face_colors.append(color)
        else:
            others[descriptor] = others.get(descriptor, 0) + 1
    return ElementSet(tuple(lines), tuple(line_colors), tuple(faces), tuple(face_colors), others)


def _corners(descriptor: int, nodes: list[int]) -> list[int]:
    """Corner nodes of a line or shell element by its descriptor; none for solids and others."""
    if descriptor in _LINES:
        return [nodes[0], nodes[-1]] if len(nodes) > 1 else []
    if not 41 <= descriptor <= 98:
        return []
    if descriptor in _LINEAR_TRIANGLES or len(nodes) == 3:
        corners = nodes[:3]
    elif descriptor in _PARABOLIC_TRIANGLES or len(nodes) == 6:
        corners = nodes[0:6:2]
    else:
        corners = nodes[0:8:2] if len(nodes) == 8 else nodes[:4]
    return corners if len(corners) >= 3 else []
