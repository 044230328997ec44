"""Local coordinate systems of UFF 18, in which the nodes of a set 15 may be given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.errors import FormatError
from operando.io.uff.small import body_lines, floats_of

CARTESIAN, CYLINDRICAL = 0, 1


@dataclass(frozen=True)
class System:
    """A coordinate system: kind (0 Cartesian, 1 cylindrical, 2 spherical), origin, and axes as rows, in global Cartesian coordinates."""

    kind: int
    reference: int
    origin: NDArray[np.float64]
    axes: NDArray[np.float64]

    @property
    def is_global(self) -> bool:
        """Whether it is the global Cartesian system itself (to the six digits of the format)."""
        return self.kind == CARTESIAN and not np.any(np.abs(self.origin) > 1e-9) and self.has_global_axes

    @property
    def has_global_axes(self) -> bool:
        """Whether its directions are the global ones."""
        return self.kind == CARTESIAN and bool(np.allclose(self.axes, np.eye(3), atol=2e-5))


def read_systems(raw: bytes) -> dict[int, System]:
    """Systems of a set 18 by number: each from its origin, a point on its x axis, and a point in its xz plane.

    Raises
    ------
    FormatError
        If the set cannot be read.
    """
    lines = body_lines(raw)
    systems: dict[int, System] = {}
    if not lines or len(lines) % 4:
        raise FormatError(f"set 18 has {len(lines)} lines, not four a system")
    for i in range(0, len(lines), 4):
        try:
            number, kind, reference = (int(t) for t in lines[i].split()[:3])
            numbers = [*floats_of(lines[i + 2]), *floats_of(lines[i + 3])]
        except ValueError as error:
            raise FormatError(f"set 18 cannot be read at line {i}: {error}") from error
        if len(numbers) != 9 or not np.all(np.isfinite(numbers)):
            raise FormatError(f"system {number} of set 18 has {len(numbers)} numbers instead of 9")
        origin, on_x, on_xz = np.reshape(np.asarray(numbers, float), (3, 3))
        systems[number] = System(kind, reference, origin, _axes(origin, on_x, on_xz, number))
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
    coordinates: NDArray[np.float64], numbers: Sequence[int], systems: Mapping[int, System]
) -> tuple[NDArray[np.float64], list[int]]:
    """Coordinates in the global Cartesian system.

    Parameters
    ----------
    coordinates : (n, 3) array
        Each in its own system; angles of cylindrical ones in degrees.
    numbers : (n,) ints
        System of each node, 0 is global.
    systems : mapping of number to System

    Returns
    -------
    coordinates : (n, 3) array
    left : list of int
        Numbers of systems that could not be applied (not in the file, spherical, or relative to another one): taken as global.
    """
    out = np.array(coordinates, float)
    owner = np.asarray(numbers)
    left = []
    for number in np.unique(owner[owner != 0]).tolist():
        system = systems.get(number)
        if system is None or system.kind not in (CARTESIAN, CYLINDRICAL) or system.reference != 0:
            left.append(number)
            continue
        rows = owner == number
        local = out[rows]
        if system.kind == CYLINDRICAL:
            angle = np.deg2rad(local[:, 1])
            local = np.column_stack([local[:, 0] * np.cos(angle), local[:, 0] * np.sin(angle), local[:, 2]])
        out[rows] = system.origin + local @ system.axes
    return out, left
