"""Stiffness and mass matrices of the three finite elements the paper's structure needs, in SI units.

Six DOFs a node: u, v, w, θx, θy, θz, right-handed. Masses are lumped on the diagonal.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray

GAUSS = 1 / np.sqrt(3)
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
SHEAR_CORRECTION = 5 / 6
DRILLING = 1e-5
"""Stiffness that ties θz to the rotation of the membrane, as a part of the shear stiffness: just enough to leave no mechanism."""


def shape_functions(xi: float, eta: float, side: float) -> tuple[Array, Array, Array]:
    """Bilinear functions of a square of a given side [m] and their derivatives along x and y."""
    x, y = CORNERS.T
    n = (1 + xi * x) * (1 + eta * y) / 4
    return n, x * (1 + eta * y) / 4 * 2 / side, y * (1 + xi * x) / 4 * 2 / side


def shell_stiffness(side: float, thickness: float, young: float, poisson: float, drilling: float = DRILLING) -> Array:
    """Flat square shell (24, 24): MITC4 plate bending (Bathe & Dvorkin 1985), Q4 membrane with incompatible modes (Wilson; Taylor 1976).

    Nodes counter-clockwise from the corner of least x and y.
    """
    k = np.zeros((24, 24))
    plane = young / (1 - poisson**2) * np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, (1 - poisson) / 2]])
    shear = young / (2 * (1 + poisson))
    area = side**2 / 4
    membrane = np.zeros((12, 12))
    tie_xz = {e: _shear_rows(0, e, side)[0] for e in (-1, 1)}
    tie_yz = {e: _shear_rows(e, 0, side)[1] for e in (-1, 1)}
    for xi in (-GAUSS, GAUSS):
        for eta in (-GAUSS, GAUSS):
            n, nx, ny = shape_functions(xi, eta, side)
            bending = np.zeros((3, 24))
            bending[0, 4::6], bending[1, 3::6] = nx, -ny
            bending[2, 4::6], bending[2, 3::6] = ny, -nx
            k += area * thickness**3 / 12 * bending.T @ plane @ bending
            gamma = np.array([(1 + eta) / 2 * tie_xz[1] + (1 - eta) / 2 * tie_xz[-1], (1 + xi) / 2 * tie_yz[1] + (1 - xi) / 2 * tie_yz[-1]])
            k += area * thickness * SHEAR_CORRECTION * shear * gamma.T @ gamma
            strain = np.zeros((3, 12))
            strain[0, :8:2], strain[1, 1:8:2] = nx, ny
            strain[2, :8:2], strain[2, 1:8:2] = ny, nx
            # Incompatible modes 1 − ξ² (columns 8, 9) and 1 − η² (columns 10, 11) let the membrane bend in its plane.
            dx, dy = -2 * xi * 2 / side, -2 * eta * 2 / side
            strain[0, 8], strain[2, 9] = dx, dx
            strain[2, 10], strain[1, 11] = dy, dy
            membrane += area * thickness * strain.T @ plane @ strain
            drill = np.zeros((1, 24))
            drill[0, 5::6], drill[0, 0::6], drill[0, 1::6] = n, ny / 2, -nx / 2
            k += area * thickness * drilling * shear * drill.T @ drill
    inner = membrane[:8, :8] - membrane[:8, 8:] @ np.linalg.solve(membrane[8:, 8:], membrane[8:, :8])
    at = np.array([6 * node + axis for node in range(4) for axis in range(2)])
    k[np.ix_(at, at)] += inner
    return k


def _shear_rows(xi: float, eta: float, side: float) -> Array:
    """Transverse shear strains γxz = w,x + θy and γyz = w,y − θx at a point."""
    n, nx, ny = shape_functions(xi, eta, side)
    rows = np.zeros((2, 24))
    rows[0, 2::6], rows[0, 4::6] = nx, n
    rows[1, 2::6], rows[1, 3::6] = ny, -n
    return rows


def shell_mass(side: float, thickness: float, density: float) -> Array:
    """Lumped masses (24,) of a square shell: a quarter a node, rotary inertia of the thickness, none about the normal."""
    m = density * thickness * side**2 / 4
    return np.tile([m, m, m, m * thickness**2 / 12, m * thickness**2 / 12, 0], 4)


def beam_stiffness(start: Array, end: Array, diameter: float, young: float, poisson: float) -> Array:
    """Euler–Bernoulli beam (12, 12) of circular section between two points."""
    d = np.asarray(end, float) - np.asarray(start, float)
    length = float(np.linalg.norm(d))
    area, inertia = np.pi * diameter**2 / 4, np.pi * diameter**4 / 64
    axial, twist = young * area / length, young / (2 * (1 + poisson)) * 2 * inertia / length
    b = young * inertia / length**3
    k = np.zeros((12, 12))
    for i, value in ((0, axial), (3, twist)):
        k[np.ix_([i, i + 6], [i, i + 6])] = value * np.array([[1, -1], [-1, 1]])
    part = b * np.array(
        [
            [12, 6 * length, -12, 6 * length],
            [6 * length, 4 * length**2, -6 * length, 2 * length**2],
            [-12, -6 * length, 12, -6 * length],
            [6 * length, 2 * length**2, -6 * length, 4 * length**2],
        ]
    )
    k[np.ix_([1, 5, 7, 11], [1, 5, 7, 11])] = part
    turn = np.diag([1.0, -1, 1, -1])  # a rotation about local y is −dw/dx
    k[np.ix_([2, 4, 8, 10], [2, 4, 8, 10])] = turn @ part @ turn
    x = d / length
    side = np.cross([0.0, 0, 1] if abs(x[2]) < 0.9 else [1.0, 0, 0], x)
    y = side / np.linalg.norm(side)
    rotation = np.kron(np.eye(4), np.array([x, y, np.cross(x, y)]))
    return rotation.T @ k @ rotation


def beam_mass(start: Array, end: Array, diameter: float, density: float) -> Array:
    """Lumped masses (12,): half the beam at each end, translations only."""
    half = density * np.pi * diameter**2 / 4 * float(np.linalg.norm(np.asarray(end, float) - np.asarray(start, float))) / 2
    return np.tile([half, half, half, 0, 0, 0], 2)


def bush_stiffness(start: Array, end: Array, stiffness: tuple[float, float, float]) -> Array:
    """Spring (12, 12) along global x, y, z that acts at mid-length with rigid lever arms to both nodes: it transmits moments."""
    arm = (np.asarray(end, float) - np.asarray(start, float)) / 2

    def seen_from(a: Array) -> Array:
        """Displacement u + θ×a as a (3, 6) matrix."""
        return np.hstack([np.eye(3), np.array([[0, a[2], -a[1]], [-a[2], 0, a[0]], [a[1], -a[0], 0]])])

    gap = np.hstack([-seen_from(arm), seen_from(-arm)])
    return gap.T @ np.diag(stiffness) @ gap
