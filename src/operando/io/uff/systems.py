"""Local coordinate systems of UFF 18 and 2420, in which the nodes of a set 15 may be given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from operando.data import CoordinateSystem
from operando.errors import FormatError
from operando.io.uff.lines import body_lines, floats_of, ints_of, said

CARTESIAN, CYLINDRICAL = 0, 1
MAX_LENGTH = 1e50
"""Larger numbers are no lengths: their squares would leave the range of numbers."""


def read_systems(raw: bytes) -> list[tuple[CoordinateSystem, int]]:
    """Systems of a set 18, each with the number of the system it is given in.

    Each stands there by its origin, a point on its x axis, and a point in its xz plane.
    """
    lines = body_lines(raw)
    systems = []
    if not lines or len(lines) % 4:
        raise FormatError(f"set 18 has {len(lines)} lines, not four a system")
    for i in range(0, len(lines), 4):
        words = ints_of(lines[i], min(4, max(3, len(lines[i].split()))), "record 1 of set 18")
        number, kind, reference = words[:3]
        color = words[3] if len(words) > 3 else 1
        try:
            numbers = [*floats_of(lines[i + 2]), *floats_of(lines[i + 3])]
        except ValueError as error:
            raise FormatError(f"set 18 cannot be read at line {i}: {error}") from error
        if len(numbers) != 9 or not np.all(np.abs(numbers) < MAX_LENGTH):
            raise FormatError(f"system {number} of set 18 has {len(numbers)} numbers instead of 9")
        origin, on_x, on_xz = np.reshape(np.asarray(numbers, float), (3, 3))
        axes = _axes(origin, on_x, on_xz, number)
        systems.append((CoordinateSystem(number, kind, origin, axes, said(lines[i + 1]), color), reference))
    return systems


def read_part_systems(raw: bytes) -> list[tuple[CoordinateSystem, int]]:
    """Systems of a set 2420: three rows with the axes and one with the origin, in global coordinates."""
    lines = body_lines(raw)
    if len(lines) < 2 or (len(lines) - 2) % 6:
        raise FormatError(f"set 2420 has {len(lines)} lines, not two and six a system")
    systems = []
    for i in range(2, len(lines), 6):
        number, kind, color = ints_of(lines[i], 3, "record 3 of set 2420")
        try:
            table = np.asarray([floats_of(line) for line in lines[i + 2 : i + 6]], float)
        except ValueError as error:
            raise FormatError(f"system {number} of set 2420 cannot be read: {error}") from error
        if table.shape != (4, 3) or not np.all(np.abs(table) < MAX_LENGTH):
            raise FormatError(f"system {number} of set 2420 has no four rows of three numbers")
        if not np.allclose(table[:3] @ table[:3].T, np.eye(3), atol=1e-4):
            raise FormatError(f"the axes of system {number} of set 2420 are not at right angles or not of length 1")
        systems.append((CoordinateSystem(number, kind, table[3], table[:3], said(lines[i + 1]), color), 0))
    return systems


def _axes(origin: NDArray[np.float64], on_x: NDArray[np.float64], on_xz: NDArray[np.float64], number: int) -> NDArray[np.float64]:
    x = on_x - origin
    y = np.cross(on_xz - origin, x)
    length_x, length_y = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    if length_x == 0 or length_y <= 1e-9 * length_x * float(np.linalg.norm(on_xz - origin)):
        raise FormatError(f"system {number} of set 18 is given by points on one line")
    x, y = x / length_x, y / length_y
    return np.stack([x, y, np.cross(x, y)])


def to_global(
    coordinates: NDArray[np.float64], numbers: Sequence[int], systems: Mapping[int, CoordinateSystem]
) -> tuple[NDArray[np.float64], list[int]]:
    """Coordinates (n, 3) in the global Cartesian system, and the systems that could not be applied (not known, or spherical).

    Each is given in the system of its number, 0 is global; angles of cylindrical ones in degrees. ``systems`` are defined in the global
    system. What could not be applied is taken as global.
    """
    out = np.array(coordinates, float)
    owner = np.asarray(numbers)
    left = []
    for number in np.unique(owner[owner != 0]).tolist():
        system = systems.get(number)
        if system is None or system.kind not in (CARTESIAN, CYLINDRICAL):
            left.append(number)
            continue
        rows = owner == number
        local = out[rows]
        if system.kind == CYLINDRICAL:
            angle = np.deg2rad(local[:, 1])
            local = np.column_stack([local[:, 0] * np.cos(angle), local[:, 0] * np.sin(angle), local[:, 2]])
        out[rows] = system.origin + local @ system.axes
    return out, left
