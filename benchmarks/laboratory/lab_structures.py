"""Structures of the laboratory family, drawn at random: plates, ladder frames, aircraft-like models, masts with branches.

``draw(rng, points, …)`` gives a Structure: the modal truth, the points where it can be hit and measured, a band with 6 to 20 modes. Some
draws have a close pair. A point knows its shape beside itself, so a hit can miss it. The beams are those of ``../hidden_effects/beams.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from modal import Modal
from plates import Plate

sys.path.append(str(Path(__file__).resolve().parents[1] / "hidden_effects"))
from beams import AXES, Mesh, Section

KEPT_MODES = 48  # the truth is the model of these; those above the band make the residual terms


@dataclass(frozen=True)
class Point:
    """A measurement point: label, place [m], axis 0 to 2 and the sense (+1, −1) of its direction."""

    label: int
    place: tuple[float, float, float]
    axis: int
    sense: int = 1

    @property
    def name(self) -> str:
        return f"{self.label}{'+' if self.sense > 0 else '-'}{AXES[self.axis]}"

    @property
    def direction(self) -> int:
        """UFF 58 code."""
        return self.sense * (self.axis + 1)


@dataclass(frozen=True)
class Structure:
    """A structure, where it can be measured, and the band in which its modes count.

    ``beside(point, shift)`` is the modal row (kept,) of a place ``shift`` (3,) metres away from a point, in the sense of its direction;
    ``tilted(point)`` that of another direction at the same place, for a hit whose direction is wrong.
    """

    kind: str
    modal: Modal
    points: tuple[Point, ...]
    band: tuple[float, float]
    size: float  # m, the longest side
    beside: Callable[[Point, np.ndarray], np.ndarray]
    tilted: Callable[[Point], np.ndarray]
    wires: tuple[tuple[int, ...], ...]

    def rows(self, points: tuple[Point, ...] | list[Point]) -> np.ndarray:
        """Modal rows (points, kept)."""
        nowhere = np.zeros(3)
        return np.array([self.beside(p, nowhere) for p in points])

    @property
    def in_band(self) -> np.ndarray:
        """Indices of the pairs of poles in band."""
        hz = self.modal.frequencies
        return np.flatnonzero((hz > self.band[0]) & (hz < self.band[1]))


def draw(
    rng: np.random.Generator,
    points: int,
    *,
    modes: tuple[int, int] = (6, 20),
    local_dampers: bool = False,
    kind: str | None = None,
    line: float = 0.0,
    top: float | None = None,
) -> Structure:
    """A structure with so many points and modes in band.

    ``top`` is the end of the band in Hz; no half-power width is below 0.8 ``line`` Hz (``plate/`` among the measured sets has 0.8 to 4
    lines within one), for a test whose lines were further apart would be repeated by anybody.
    """
    makers = {"plate": _plate, "ladder": _ladder, "aircraft": _aircraft, "mast": _mast}
    for _ in range(400):
        name = kind or str(rng.choice(list(makers)))
        made = makers[name](rng, points)
        if made is None:
            continue
        hz, sites, beside, tilted, size, wires = made
        count = int(rng.integers(modes[0], modes[1] + 1))
        elastic = int(np.searchsorted(hz, 0.02 * hz[min(count + 6, len(hz) - 1)]))  # suspension modes lie far below the band
        if elastic + count + 2 > len(hz):
            continue
        end = top or float(np.exp(rng.uniform(np.log(60), np.log(1500))))
        hz = hz * end / np.sqrt(hz[elastic + count - 1] * hz[elastic + count])
        band = _band(hz, elastic, count, end)
        if rng.uniform() < 0.4 and not local_dampers:
            hz = _close_pair(rng, hz, elastic, count)
        damping = _damping(rng, hz, elastic, end, line)
        if local_dampers:
            damping = _with_dampers(rng, hz, damping, sites, beside, elastic, count)
            if damping is None:
                continue
        structure = Structure(name, Modal(hz, damping), sites, band, size, beside, tilted, wires)
        if _fair(structure, count, local_dampers):
            return structure
    raise RuntimeError(f"no fair structure with {points} points in 400 draws")


def _band(hz: np.ndarray, elastic: int, count: int, end: float) -> tuple[float, float]:
    """From 0.6 of the lowest elastic mode (above the suspension) to between two modes, rounded as people do."""
    low = 0.6 * hz[elastic]
    if elastic:
        low = max(low, np.sqrt(hz[elastic - 1] * hz[elastic]))
    digits = 1 if end < 300 else 0
    return float(max(round(low, digits), 0.5)), float(round(np.sqrt(hz[elastic + count - 1] * hz[elastic + count]), digits))


def _close_pair(rng: np.random.Generator, hz: np.ndarray, elastic: int, count: int) -> np.ndarray:
    """Two neighbours in band pulled together to 0.4–1.5 % of each other (symmetric machines, round parts)."""
    out = hz.copy()
    i = elastic + int(rng.integers(1, count - 1))
    middle, gap = np.sqrt(hz[i] * hz[i + 1]), rng.uniform(0.004, 0.015)
    out[i], out[i + 1] = middle * (1 - gap / 2), middle * (1 + gap / 2)
    return out


def _damping(rng: np.random.Generator, hz: np.ndarray, elastic: int, end: float, line: float) -> np.ndarray:
    """Modal damping of 0.1–3 %: a level for the structure, a factor of about 1.6 from mode to mode."""
    level = np.exp(rng.uniform(np.log(0.002), np.log(0.012)))
    ratio = np.clip(level * np.exp(0.45 * rng.standard_normal(len(hz))), 0.001, 0.03)
    ratio = np.maximum(ratio, 0.4 * line / np.maximum(hz, 1e-3 * end))
    ratio[:elastic] = rng.uniform(0.02, 0.06, elastic)
    omega = 2 * np.pi * np.maximum(hz, 1e-3 * end)
    return np.diag(2 * ratio * omega)


def _with_dampers(rng, hz, damping, sites, beside, elastic: int, count: int) -> np.ndarray | None:
    """One to three dampers to ground, sized so that the mode that feels each most has 5–10 %."""
    out = damping.copy()
    nowhere = np.zeros(3)
    for i in rng.choice(len(sites), int(rng.integers(1, 4)), replace=False):
        row = beside(sites[i], nowhere)
        share = row[elastic : elastic + count] ** 2 / (4 * np.pi * hz[elastic : elastic + count])
        if share.max() <= 0:
            return None
        out += rng.uniform(0.05, 0.10) / share.max() * np.outer(row, row)
    return out


def _fair(structure: Structure, count: int, local_dampers: bool) -> bool:
    """Modes in band that a test can tell apart: 0.75 half-power widths between neighbours, not all of them crowded; sharp enough shapes."""
    modal, chosen = structure.modal, structure.in_band
    if len(chosen) < count - (1 if local_dampers else 0):
        return False
    hz, ratio = modal.frequencies, modal.ratios
    if local_dampers and (ratio[chosen].max() < 0.045 or ratio[chosen].max() > 0.15):
        return False
    for edge in structure.band:  # nobody lets a band end on a peak
        if np.min(np.abs(hz - edge) / (2 * ratio * hz + 0.005 * hz)) < 1:
            return False
    first = chosen[:-1]
    gaps = (hz[first + 1] - hz[first]) / (ratio[first] * hz[first] + ratio[first + 1] * hz[first + 1])
    return bool(gaps.min() > 0.75 and np.mean(gaps < 1.5) <= 0.2)


def labels(rng: np.random.Generator, count: int) -> list[int]:
    """Node numbers: 1, 2, 3 … or with steps, as point grids are numbered."""
    if rng.uniform() < 0.6:
        return list(range(1, count + 1))
    return list(int(rng.integers(1, 300)) + np.cumsum(rng.integers(1, 8, count)))


def _plate(rng: np.random.Generator, points: int):
    """A plate, one edge clamped elastically, free on soft springs or on four mounts, one to three lumps on it; points on a grid."""
    a = rng.uniform(0.25, 0.9)
    b = a * rng.uniform(0.55, 1.0)
    holding = str(rng.choice(["clamped", "soft", "mounts"]))
    plate = Plate(a, b, a * rng.uniform(0.008, 0.02), clamped=float(rng.uniform(200, 3000)) if holding == "clamped" else None)
    weight = plate.density * plate.thickness * a * b
    plate.masses += [(rng.uniform(0, a), rng.uniform(0, b), weight * rng.uniform(0.01, 0.06)) for _ in range(int(rng.integers(1, 4)))]
    if holding != "clamped":
        stiffness = plate.rigidity / a**2 * (rng.uniform(0.002, 0.006, 4) if holding == "soft" else rng.uniform(20, 150, 4))
        corners = [(0.08, 0.1), (0.93, 0.06), (0.9, 0.92), (0.1, 0.88)]
        plate.springs += [(x * a, y * b, float(k)) for (x, y), k in zip(corners, stiffness, strict=True)]
    hz, coefficients = plate.modes(KEPT_MODES)
    columns = round(np.sqrt(points * a / b))
    grid_x, grid_y = np.linspace(0.0, a, columns), np.linspace(0.0, b, -(-points // columns))
    places = [(float(x), float(y)) for x in grid_x for y in grid_y]
    if holding == "clamped":  # nobody hits the clamp
        places = [(0.94 * x, y) for x, y in places]
    while len(places) > points:
        places.pop(int(rng.integers(len(places))))
    if len(places) < points:
        return None
    names = labels(rng, points)
    sites = tuple(Point(n, (x, y, 0.0), 2) for n, (x, y) in zip(names, places, strict=True))

    def beside(point: Point, shift: np.ndarray) -> np.ndarray:
        x, y = np.clip(point.place[0] + shift[0], 0, a), np.clip(point.place[1] + shift[1], 0, b)
        return point.sense * (plate.basis(np.array([x]), np.array([y])) @ coefficients)[0]

    def tilted(point: Point) -> np.ndarray:
        # A plate has one direction only: the hammer hits a place a tenth of a side away.
        return beside(point, np.array([0.1 * a, -0.1 * b, 0.0]) * (1 if point.place[0] < a / 2 else -1))

    return hz, sites, beside, tilted, a, ()


def _on_mesh(rng: np.random.Generator, mesh: Mesh, lines: list[tuple[list[int], int]], points: int, size: float):
    """Points on the lines of a mesh (nodes, axis), as even as the number asks; None where there are too few."""
    hz, full = mesh.modes(KEPT_MODES)
    candidates = list(dict.fromkeys((node, axis) for nodes, axis in lines for node in nodes))
    if len(candidates) < points:
        return None
    chosen = [candidates[i] for i in np.linspace(0, len(candidates) - 1, points).round().astype(int)]
    nodes = list(dict.fromkeys(node for node, _ in chosen))
    name = dict(zip(nodes, labels(rng, len(nodes)), strict=True))
    node_of = {label: node for node, label in name.items()}
    sites = tuple(Point(name[n], tuple(map(float, mesh.points[n])), a) for n, a in chosen)

    def beside(point: Point, shift: np.ndarray) -> np.ndarray:
        node = node_of[point.label]
        move, turn = full[6 * node : 6 * node + 3], full[6 * node + 3 : 6 * node + 6]
        return point.sense * (move + np.cross(turn.T, shift).T)[point.axis]

    def tilted(point: Point) -> np.ndarray:
        node = node_of[point.label]
        return full[6 * node + (point.axis + 1) % 3] * 0.8 + 0.6 * point.sense * full[6 * node + point.axis]

    wires = tuple(tuple(name[n] for n in nodes if n in name) for nodes, _ in lines)
    return hz, sites, beside, tilted, size, tuple(w for w in dict.fromkeys(wires) if len(w) > 1)


def _ladder(rng: np.random.Generator, points: int):
    """A ladder frame (two rails, cross-members, machines) on four springs or soft bands."""
    length, width = rng.uniform(1.0, 2.5), rng.uniform(0.4, 0.9)
    steps = int(rng.integers(14, 20))
    mesh = Mesh()
    rails = []
    for y in (0.0, width):
        section = Section(*rng.uniform(0.03, 0.06, 2))
        rails.append(mesh.member(mesh.node(0, y, 0), mesh.node(length, y, 0), section, steps))
    cross = []
    for x in sorted({0, steps, *(int(i) for i in rng.integers(2, steps - 1, 3))}):
        cross.append(mesh.member(rails[0][x], rails[1][x], Section(*rng.uniform(0.025, 0.05, 2)), 6))
    for _ in range(int(rng.integers(1, 4))):  # machines on posts: their height couples the directions
        mass, foot = rng.uniform(0.5, 6), int(rng.choice(rails[int(rng.integers(2))]))
        head = mesh.node(*(mesh.points[foot] + np.array([0.0, 0.0, rng.uniform(0.1, 0.25)])))
        mesh.member(foot, head, Section(0.05), 2)
        mesh.lump(head, mass, (0.005 * mass,) * 3)
    stiff = 10 ** rng.uniform(3.0, 3.6) if rng.uniform() < 0.5 else 10 ** rng.uniform(6.0, 6.7)
    for node in (rails[0][1], rails[0][-2], rails[1][1], rails[1][-2]):
        mesh.spring(node, None, tuple(stiff * rng.uniform(0.5, 1.5, 3)))
    return _on_mesh(
        rng, mesh, [(rails[0], 2), *((c[1:-1], 2) for c in cross), (rails[1], 2), (rails[0], 1), (rails[1][::2], 0)], points, length
    )


def _aircraft(rng: np.random.Generator, points: int):
    """After GARTEUR SM-AG19: fuselage, wings, tail and drums on soft springs; its symmetry makes close pairs."""
    length, span = rng.uniform(1.2, 1.8), rng.uniform(1.6, 2.4)
    fine = max(6, -(-points // 8))
    mesh = Mesh()
    nose, end = mesh.node(0, 0, 0), mesh.node(length, 0, 0)
    body = mesh.member(nose, end, Section(0.05, 0.15, 7e10, 2700), 2 * fine)
    root = body[round(0.42 * 2 * fine)]
    wings = []
    uneven = 1 + rng.uniform(-0.02, 0.02)  # a copy of the other side is never exact
    for side, factor in ((-1, 1.0), (1, uneven)):
        tip = mesh.node(mesh.points[root][0] + 0.05, side * span / 2, 0.03)
        wing = mesh.member(root, tip, Section(0.1 * factor, 0.01 * rng.uniform(0.95, 1.6), 7e10, 2700), fine + 2)
        mesh.lump(tip, 0.2 * factor, (1e-3, 2e-3, 2e-3))
        wings.append(wing)
    top = mesh.node(length, 0, rng.uniform(0.25, 0.4))
    fin = mesh.member(end, top, Section(0.1, 0.01, 7e10, 2700), 6)
    tails = [mesh.member(top, mesh.node(length, s * 0.2, mesh.points[top][2]), Section(0.1, 0.01, 7e10, 2700), 4) for s in (-1, 1)]
    for node in (body[2], body[-4], wings[0][1], wings[1][1]):
        mesh.spring(node, None, tuple(rng.uniform(300, 800, 3)))
    lines = [
        (wings[0][1:], 2),
        (wings[1][1:], 2),
        (body[::2], 2),
        (body[1::2], 1),
        (fin[1:], 1),
        (tails[0][1:], 2),
        (tails[1][1:], 2),
        (wings[0][2::2], 0),
        (wings[1][2::2], 0),
        (body[::2], 1),
    ]
    return _on_mesh(rng, mesh, lines, points, span)


def _mast(rng: np.random.Generator, points: int):
    """A clamped trunk with branches, masses on springs at some tips."""
    height = rng.uniform(1.0, 3.0)
    fine = max(10, points // 4)
    mesh = Mesh()
    foot = mesh.node(0, 0, 0)
    thick = height * rng.uniform(0.018, 0.03)
    trunk = mesh.member(foot, mesh.node(0, 0, height), Section(thick, thick * rng.uniform(0.85, 1.15)), fine)
    mesh.clamp(foot)
    branches = []
    for _ in range(int(rng.integers(2, 5))):
        start = trunk[int(rng.integers(fine // 3, fine))]
        angle, reach = rng.uniform(0, 2 * np.pi), height * rng.uniform(0.15, 0.4)
        tip = mesh.node(*(mesh.points[start] + reach * np.array([np.cos(angle), np.sin(angle), 0.3])))
        branch = mesh.member(start, tip, Section(thick * rng.uniform(0.4, 0.8)), max(5, fine // 3))
        mesh.lump(tip, 7850 * thick**2 * height * rng.uniform(0.02, 0.15), (1e-4,) * 3)
        branches.append(branch)
    lines = [
        (trunk[1:], 0),
        (trunk[1:], 1),
        *((b[1:], 2) for b in branches),
        *((b[1:], 0) for b in branches),
        *((b[1:], 1) for b in branches),
    ]
    return _on_mesh(rng, mesh, lines, points, height)
