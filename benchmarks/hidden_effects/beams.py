"""Three-dimensional frames of Euler-Bernoulli beams, lumped masses and springs: stiffness, mass, modes. Shares no code with operando.

SI units; six degrees of freedom a node (ux, uy, uz, rx, ry, rz). The beam matrices are the textbook ones (cubic bending, linear
stretching and torsion, consistent mass), checked in tests/test_hidden_effects.py against the closed forms for single beams.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

AXES = "XYZ"


@dataclass(frozen=True)
class Section:
    """Solid cross-section of a member: width along the local y, height along the local z; round where height is 0."""

    width: float
    height: float = 0.0
    young: float = 2.0e11
    density: float = 7850.0
    poisson: float = 0.3

    @property
    def area(self) -> float:
        return self.width * self.height if self.height else np.pi * self.width**2 / 4

    @property
    def inertia(self) -> tuple[float, float]:
        """Second moments (Iy for bending in z, Iz for bending in y)."""
        if not self.height:
            return (np.pi * self.width**4 / 64,) * 2
        return self.width * self.height**3 / 12, self.height * self.width**3 / 12

    @property
    def torsion(self) -> float:
        if not self.height:
            return np.pi * self.width**4 / 32
        short, long = sorted((self.width, self.height))
        return long * short**3 * (1 / 3 - 0.21 * short / long * (1 - (short / long) ** 4 / 12))


def beam_element(length: float, section: Section) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and consistent mass (12, 12) in local axes, x along the beam."""
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    ell, area = length, section.area
    iy, iz = section.inertia
    shear = section.young / 2 / (1 + section.poisson)
    per_metre = section.density * area
    pair = np.array([[1, -1], [-1, 1]])
    linear = np.array([[2, 1], [1, 2]]) / 6
    bend = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], float)
    inert = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420
    stiffness[np.ix_([0, 6], [0, 6])] = section.young * area / ell * pair
    mass[np.ix_([0, 6], [0, 6])] = per_metre * ell * linear
    stiffness[np.ix_([3, 9], [3, 9])] = shear * section.torsion / ell * pair
    mass[np.ix_([3, 9], [3, 9])] = section.density * (iy + iz) * ell * linear
    # Bending in y turns about +z; bending in z turns about −y.
    for dofs, moment, turn in (([1, 5, 7, 11], iz, 1.0), ([2, 4, 8, 10], iy, -1.0)):
        scale = np.array([1, turn * ell, 1, turn * ell])
        stiffness[np.ix_(dofs, dofs)] = section.young * moment / ell**3 * bend * np.outer(scale, scale)
        mass[np.ix_(dofs, dofs)] = per_metre * ell * inert * np.outer(scale, scale)
    return stiffness, mass


@dataclass
class Mesh:
    """Nodes, elements, lumps and springs, assembled on demand."""

    points: list[np.ndarray] = field(default_factory=list)
    _elements: list[tuple[int, int, Section, str]] = field(default_factory=list)
    _lumps: list[tuple[int, float, tuple[float, float, float]]] = field(default_factory=list)
    _springs: list[tuple[int, int | None, np.ndarray, str]] = field(default_factory=list)
    _clamped: set[int] = field(default_factory=set)

    def node(self, *place: float) -> int:
        self.points.append(np.array(place, float))
        return len(self.points) - 1

    def member(self, first: int, second: int, section: Section, count: int, part: str = "", foot: str = "") -> list[int]:
        """A straight member of ``count`` elements between two nodes: its nodes in order; the first element belongs to ``foot`` if named."""
        a, b = self.points[first], self.points[second]
        inner = [self.node(*(a + (b - a) * i / count)) for i in range(1, count)]
        nodes = [first, *inner, second]
        self._elements += [(nodes[i], nodes[i + 1], section, (foot if i == 0 else "") or part) for i in range(count)]
        return nodes

    def lump(self, node: int, mass: float, rotary: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self._lumps.append((node, mass, rotary))

    def spring(self, first: int, second: int | None, stiffness: tuple[float, ...], part: str = "") -> None:
        """Springs along up to six axes from one node to another, or to ground where ``second`` is None."""
        self._springs.append((first, second, np.array([*stiffness, *[0.0] * (6 - len(stiffness))]), part))

    def clamp(self, node: int) -> None:
        self._clamped.add(node)

    def free_dofs(self) -> np.ndarray:
        return np.array([6 * n + d for n in range(len(self.points)) if n not in self._clamped for d in range(6)])

    def parts(self) -> tuple[str, ...]:
        """Names of the parts, in the order they were built."""
        return tuple(dict.fromkeys([*(e[3] for e in self._elements), *(s[3] for s in self._springs)]))

    def assemble(self, part: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness and mass (6 nodes, 6 nodes) of everything, or of one part without lumps; clamps not yet applied."""
        size = 6 * len(self.points)
        stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
        for first, second, section, of in self._elements:
            if part not in (None, of):
                continue
            span = self.points[second] - self.points[first]
            length = float(np.linalg.norm(span))
            element_k, element_m = beam_element(length, section)
            turn = np.kron(np.eye(4), _local_axes(span / length))
            where = np.r_[6 * first : 6 * first + 6, 6 * second : 6 * second + 6]
            stiffness[np.ix_(where, where)] += turn.T @ element_k @ turn
            mass[np.ix_(where, where)] += turn.T @ element_m @ turn
        for node, lump, rotary in self._lumps if part is None else ():
            where = np.arange(6 * node, 6 * node + 6)
            mass[where, where] += (lump, lump, lump, *rotary)
        for first, second, constants, of in self._springs:
            if part not in (None, of):
                continue
            a = np.arange(6 * first, 6 * first + 6)
            stiffness[a, a] += constants
            if second is not None:
                b = np.arange(6 * second, 6 * second + 6)
                stiffness[b, b] += constants
                stiffness[a, b] -= constants
                stiffness[b, a] -= constants
        return stiffness, mass

    def modes(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Natural frequencies [Hz] and shapes (6 nodes, count) of unit modal mass."""
        stiffness, mass = self.assemble()
        free = self.free_dofs()
        values, vectors = eigh(stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], subset_by_index=[0, min(count, free.size) - 1])
        shapes = np.zeros((6 * len(self.points), values.size))
        shapes[free] = vectors
        return np.sqrt(np.maximum(values, 0)) / 2 / np.pi, shapes


def _local_axes(along: np.ndarray) -> np.ndarray:
    """Rows: the local x (given), y and z; the local z points up as far as it can, for uprights along the global x."""
    up = np.array([1.0, 0, 0]) if abs(along[2]) > 0.95 else np.array([0, 0, 1.0])
    z = up - (up @ along) * along
    z /= np.linalg.norm(z)
    return np.array([along, np.cross(z, along), z])
