"""The machine frame of the example: a ribbed steel plate on four rubber mounts with a motor, a gearbox and a pump on it.

A small finite-element model of its own: non-conforming rectangular plate elements of twelve degrees of freedom
(Kirchhoff theory), Euler-Bernoulli ribs, lumped masses with rotary inertia, springs to ground. It shares no code with
operando, so that what operando finds can be held against it. SI units throughout; z is normal to the plate;
accelerance = Σ −ω²φφᵀ/(ω_r² − ω² + 2iζ_rω_rω) with unit modal mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import eig, eigh

LENGTH, WIDTH, THICKNESS = 1.5, 0.9, 0.0105  # m
YOUNG, POISSON, DENSITY = 208e9, 0.3, 7850.0
CELLS_X, CELLS_Y = 20, 12
KEPT_MODES = 90  # the truth is the model of these modes, the highest far above the band

# Ribs along a grid line: (direction, position of the line [m], from [m], to [m], width [m], height [m])
RIBS = (("y", 0.450, 0.0, 0.9, 0.012, 0.040), ("y", 1.050, 0.0, 0.9, 0.010, 0.035))
# Lumped masses: (x, y, mass [kg], rotary inertia about x and y [kg m²])
MASSES = ((0.450, 0.525, 20.0, 0.12), (1.050, 0.375, 8.0, 0.05), (1.275, 0.225, 5.0, 0.02))
MOTOR = (0.450, 0.525)
# Mounts: (x, y, stiffness to ground [N/m])
MOUNTS = ((0.075, 0.075, 98e3), (1.425, 0.150, 86e3), (0.150, 0.825, 121e3), (1.350, 0.825, 74e3))

# Accelerometers: node label as on the drawing -> (x, y, direction). 9 is glued below the plate and points down.
SENSORS = {
    1: (0.000, 0.000, 1), 2: (0.525, 0.000, 1), 3: (0.975, 0.000, 1), 4: (1.500, 0.000, 1),
    5: (0.000, 0.450, 1), 6: (0.450, 0.375, 1), 7: (1.050, 0.375, 1), 8: (1.500, 0.525, 1),
    9: (0.000, 0.900, -1), 10: (0.525, 0.900, 1), 11: (1.050, 0.900, 1), 12: (1.500, 0.900, 1),
    13: (0.750, 0.600, 1),
}  # fmt: skip
REFERENCES = (3, 9, 12)  # hammer and shaker points, each at a sensor

# What only this script knows: a pipe support that touches the frame when the machine is warm.
HIDDEN = {"kind": "ground_spring", "node": 2, "stiffness": 1.5e5}


@dataclass(frozen=True)
class State:
    """One state of the frame in the coordinates of its kept idle modes: q'' + C q' + K q = Φᵀ f."""

    shapes: np.ndarray  # (nodes of the mesh, kept modes), unit modal mass of the idle state, displacement in +z
    damping: np.ndarray  # (kept, kept)
    stiffness: np.ndarray  # (kept, kept)

    def poles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Natural frequencies |λ|/2π [Hz], damping ratios, and the complex mode shapes at the sensors (unit norm), sorted."""
        values, left, _ = self._partial_fractions(sensor_rows(self.shapes), self.shapes[:1])
        keep = np.flatnonzero(values.imag > 0)
        keep = keep[np.argsort(np.abs(values[keep]))]
        shapes = left[:, keep] / np.linalg.norm(left[:, keep], axis=0)
        return np.abs(values[keep]) / 2 / np.pi, -values[keep].real / np.abs(values[keep]), shapes

    def accelerance(self, hz: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Exact accelerance [(m/s²)/N] between modal rows (p, kept) and columns (q, kept): (p, q, lines)."""
        values, left, right = self._partial_fractions(rows, columns)
        gain = _gain(hz, values)
        return np.moveaxis((left[None] * gain.T[:, None, :]) @ right, 0, -1)

    def respond(self, hz: np.ndarray, forces: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Spectra of acceleration (p, lines) to spectra of forces (q, lines)."""
        values, left, right = self._partial_fractions(rows, columns)
        return left @ (_gain(hz, values) * (right @ forces))

    def _partial_fractions(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poles λ and factors: receptance = Σ left_k right_k / (iω − λ_k)."""
        n = len(self.stiffness)
        values, vectors = eig(np.block([[np.zeros((n, n)), np.eye(n)], [-self.stiffness, -self.damping]]))
        return values, rows @ vectors[:n], np.linalg.inv(vectors)[:, n:] @ columns.T


def _gain(hz: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """−ω²/(iω − λ), (poles, lines)."""
    omega = 2 * np.pi * np.asarray(hz, float)
    return -(omega**2) / (1j * omega - poles[:, None])


def grid() -> np.ndarray:
    """Coordinates of the mesh nodes (n, 2), x running fastest."""
    x, y = np.linspace(0, LENGTH, CELLS_X + 1), np.linspace(0, WIDTH, CELLS_Y + 1)
    return np.array([(a, b) for b in y for a in x])


def node_at(x: float, y: float) -> int:
    """The mesh node at a place; the place must be one."""
    distance = np.hypot(*(grid() - (x, y)).T)
    if distance.min() > 1e-9:
        raise ValueError(f"({x}, {y}) is no node of the mesh")
    return int(distance.argmin())


def sensor_rows(shapes: np.ndarray) -> np.ndarray:
    """Modal rows of the accelerometers, in the order and sense of SENSORS."""
    return np.array([sense * shapes[node_at(x, y)] for x, y, sense in SENSORS.values()])


def _plate_element(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass (12, 12) of an a × b plate; DOFs w, ∂w/∂x, ∂w/∂y at (0,0), (a,0), (a,b), (0,b)."""
    powers = np.array([(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3), (3, 1), (1, 3)])

    def terms(x: float, y: float, dx: int = 0, dy: int = 0) -> np.ndarray:
        row = np.empty(12)
        for i, (p, q) in enumerate(powers):
            factor = np.prod([p - k for k in range(dx)], dtype=float) * np.prod([q - k for k in range(dy)], dtype=float)
            row[i] = factor * x ** max(p - dx, 0) * y ** max(q - dy, 0) if factor else 0.0
        return row

    corners = ((0, 0), (a, 0), (a, b), (0, b))
    at_nodes = np.array([terms(x, y, *d) for x, y in corners for d in ((0, 0), (1, 0), (0, 1))])
    bending = YOUNG * THICKNESS**3 / 12 / (1 - POISSON**2) * np.array([[1, POISSON, 0], [POISSON, 1, 0], [0, 0, (1 - POISSON) / 2]])
    points, weights = np.polynomial.legendre.leggauss(4)
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    for xi, wx in zip(points, weights, strict=True):
        for eta, wy in zip(points, weights, strict=True):
            x, y, area = a * (xi + 1) / 2, b * (eta + 1) / 2, wx * wy * a * b / 4
            curvature = np.array([terms(x, y, 2, 0), terms(x, y, 0, 2), 2 * terms(x, y, 1, 1)])
            stiffness += area * curvature.T @ bending @ curvature
            mass += area * DENSITY * THICKNESS * np.outer(terms(x, y), terms(x, y))
    inverse = np.linalg.inv(at_nodes)
    return inverse.T @ stiffness @ inverse, inverse.T @ mass @ inverse


def _beam_element(length: float, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Rib element (6, 6): w, slope along the rib, twist at both ends; the rib bends about the plate's middle surface."""
    inertia = width * height**3 / 12 + width * height * ((height + THICKNESS) / 2) ** 2
    torsion = height * width**3 / 3
    area, ell = width * height, length
    scale = np.array([1, ell, 1, ell])
    bend = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]) * np.outer(scale, scale)
    move = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) * np.outer(scale, scale)
    stiffness, mass = np.zeros((6, 6)), np.zeros((6, 6))
    flex, twist = np.ix_([0, 1, 3, 4], [0, 1, 3, 4]), np.ix_([2, 5], [2, 5])
    stiffness[flex], mass[flex] = YOUNG * inertia / ell**3 * bend, DENSITY * area * ell / 420 * move
    stiffness[twist] = YOUNG / 2 / (1 + POISSON) * torsion / ell * np.array([[1, -1], [-1, 1]])
    mass[twist] = DENSITY * (inertia + height * width**3 / 12) * ell / 6 * np.array([[2, 1], [1, 2]])
    return stiffness, mass


def assemble() -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of the whole frame, three DOFs a node (w, ∂w/∂x, ∂w/∂y)."""
    coordinates = grid()
    size = 3 * len(coordinates)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    a, b, row = LENGTH / CELLS_X, WIDTH / CELLS_Y, CELLS_X + 1
    element_k, element_m = _plate_element(a, b)
    for j in range(CELLS_Y):
        for i in range(CELLS_X):
            corners = np.array([j * row + i, j * row + i + 1, (j + 1) * row + i + 1, (j + 1) * row + i])
            where = (3 * corners[:, None] + np.arange(3)).ravel()
            stiffness[np.ix_(where, where)] += element_k
            mass[np.ix_(where, where)] += element_m
    for direction, line, start, stop, width, height in RIBS:
        step, slope, twist = (a, 1, 2) if direction == "x" else (b, 2, 1)
        along, across = (0, 1) if direction == "x" else (1, 0)
        on_line = np.flatnonzero(
            (np.abs(coordinates[:, across] - line) < 1e-9) & (coordinates[:, along] > start - 1e-9) & (coordinates[:, along] < stop + 1e-9)
        )
        if not on_line.size:
            raise ValueError(f"the rib at {direction} {line} lies on no grid line")
        rib_k, rib_m = _beam_element(step, width, height)
        for first, second in pairwise(on_line):
            where = [3 * first, 3 * first + slope, 3 * first + twist, 3 * second, 3 * second + slope, 3 * second + twist]
            stiffness[np.ix_(where, where)] += rib_k
            mass[np.ix_(where, where)] += rib_m
    for x, y, lump, rotary in MASSES:
        node = 3 * node_at(x, y)
        mass[[node, node + 1, node + 2], [node, node + 1, node + 2]] += (lump, rotary, rotary)
    for x, y, spring in MOUNTS:
        stiffness[3 * node_at(x, y), 3 * node_at(x, y)] += spring
    return stiffness, mass


def idle_state() -> State:
    """The frame at rest: modal damping, 0.8 to 1.2 % on the mounts, 0.4 to 1.0 % above."""
    stiffness, mass = assemble()
    values, vectors = eigh(stiffness, mass, subset_by_index=[0, KEPT_MODES - 1])
    omega = np.sqrt(values)
    rng = np.random.default_rng(20261121)
    zeta = rng.uniform(0.004, 0.010, KEPT_MODES)
    zeta[:3] = (0.0115, 0.0095, 0.0105)  # rubber mounts
    return State(vectors[0::3], np.diag(2 * zeta * omega), np.diag(values))


def operating_state() -> State:
    """The running frame: the same mass and damping forces, and the hidden spring."""
    idle = idle_state()
    x, y, sense = SENSORS[HIDDEN["node"]]
    place = sense * idle.shapes[node_at(x, y)]
    return State(idle.shapes, idle.damping, idle.stiffness + HIDDEN["stiffness"] * np.outer(place, place))
