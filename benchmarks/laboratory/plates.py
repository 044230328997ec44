"""Thin rectangular plates by Rayleigh–Ritz with Legendre polynomials. Shares no code with operando.

Kirchhoff plate, w(x, y) = Σ q_ij P_i(ξ) P_j(η) on a × b, with the strain energy
D/2 ∫ (w_xx² + w_yy² + 2ν w_xx w_yy + 2(1−ν) w_xy²); edges and points held by springs, point masses anywhere. Because the functions are
smooth, the shapes hold between mesh points too: a hit beside its point is exact. Checked against the tables of Leissa (NASA SP-160, 1969).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh


def _functions(points: np.ndarray, count: int, derivative: int = 0) -> np.ndarray:
    """Orthonormal Legendre functions (points, count) on [−1, 1], or a derivative of them."""
    coefficients = np.diag(np.sqrt(np.arange(count) + 0.5))
    if derivative:
        coefficients = legendre.legder(coefficients, derivative)
    return legendre.legvander(points, len(coefficients) - 1) @ coefficients


@dataclass
class Plate:
    """A plate of sides a, b [m] and a thickness [m]; ``count`` functions each way."""

    a: float
    b: float
    thickness: float
    young: float = 7.0e10
    density: float = 2700.0
    poisson: float = 0.33
    count: int = 12
    masses: list[tuple[float, float, float]] = field(default_factory=list)  # (x, y, kg), x and y from 0 to a, b
    springs: list[tuple[float, float, float]] = field(default_factory=list)  # (x, y, N/m)
    clamped: float | None = None  # stiffness of the clamp at x = a, in D/a³ a metre (rotations: D/a), None where the edge is free

    @property
    def rigidity(self) -> float:
        """D = E h³ / 12 (1 − ν²) in N·m."""
        return self.young * self.thickness**3 / 12 / (1 - self.poisson**2)

    def basis(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values (points, count²) of the functions at places."""
        first = _functions(2 * np.asarray(x) / self.a - 1, self.count)
        second = _functions(2 * np.asarray(y) / self.b - 1, self.count)
        return (first[:, :, None] * second[:, None, :]).reshape(len(first), -1)

    def matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness and mass (count², count²)."""
        nodes, weights = legendre.leggauss(self.count + 2)
        f = [_functions(nodes, self.count, d) for d in range(3)]
        overlap = {(m, n): f[m].T @ (weights[:, None] * f[n]) for m in range(3) for n in range(3)}
        p, q, nu = 2 / self.a, 2 / self.b, self.poisson
        area = self.a * self.b / 4
        bend = p**4 * np.kron(overlap[2, 2], overlap[0, 0]) + q**4 * np.kron(overlap[0, 0], overlap[2, 2])
        bend += nu * (p * q) ** 2 * (np.kron(overlap[2, 0], overlap[0, 2]) + np.kron(overlap[0, 2], overlap[2, 0]))
        bend += 2 * (1 - nu) * (p * q) ** 2 * np.kron(overlap[1, 1], overlap[1, 1])
        stiffness = self.rigidity * area * bend
        mass = self.density * self.thickness * area * np.eye(self.count**2)
        if self.clamped is not None:
            along = np.eye(self.count) * self.b / 2
            for order, size in ((0, self.clamped * self.rigidity / self.a**3), (1, self.clamped * self.rigidity / self.a)):
                edge = _functions(np.array([1.0]), self.count, order) * p**order
                stiffness += size * np.kron(edge.T @ edge, along)
        for x, y, value in self.springs:
            row = self.basis(np.array([x]), np.array([y]))
            stiffness += value * row.T @ row
        for x, y, value in self.masses:
            row = self.basis(np.array([x]), np.array([y]))
            mass += value * row.T @ row
        return stiffness, mass

    def modes(self, keep: int) -> tuple[np.ndarray, np.ndarray]:
        """Natural frequencies [Hz] and coefficients (count², keep) of shapes of unit modal mass."""
        stiffness, mass = self.matrices()
        values, vectors = eigh(stiffness, mass, subset_by_index=[0, keep - 1])
        return np.sqrt(np.maximum(values, 0)) / 2 / np.pi, vectors
