"""Three families of structures, drawn at random: a frame of beams, a rotor on bearings and a foundation, and a panel hung up on soft
springs. Shares no code with operando.

``draw(family, seed)`` gives a Structure: the modal model of the finite elements that is the truth of a case, its sensors, its band.
A draw is repeated until the modes in band are a fair test: no two within 1.2 % (panel: 0.4 %), and each one moves the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from beams import AXES, Mesh, Section

KEPT_MODES = 60  # the truth is the model of these modes, the highest far above the band
FAMILIES = ("frame", "rotor", "panel")
IN_PLANS = FAMILIES[:2]
CLOSEST = {"frame": 1.012, "rotor": 1.012, "panel": 1.004}
DAMPING = {"frame": (0.004, 0.011), "rotor": (0.004, 0.011), "panel": (0.004, 0.02)}
HUNG = {"panel": 3}  # modes of the suspension, below the band
SUSPENSION_DAMPING = 0.03


@dataclass(frozen=True)
class Sensor:
    """An accelerometer: its label, the mesh node, axis 0 to 2, and the sense it is glued on with."""

    label: int
    node: int
    axis: int
    sense: int

    @property
    def name(self) -> str:
        return f"{self.label}{'+' if self.sense > 0 else '-'}{AXES[self.axis]}"


@dataclass(frozen=True)
class Structure:
    """The structure at rest, q'' + diag(2ζω) q' + diag(ω²) q = Φᵀf, and where it is measured."""

    family: str
    points: np.ndarray  # (nodes, 3) m
    hz: np.ndarray
    zeta: np.ndarray
    shapes: np.ndarray  # (3 nodes, kept): translations only, unit modal mass
    sensors: tuple[Sensor, ...]
    gaps: tuple[tuple[int, int], ...]  # (node, axis) between two sensors of a line, without a sensor
    wires: tuple[tuple[int, ...], ...]  # labels along the lines, for the drawing
    pairs: tuple[tuple[int, int], ...]  # sensors at one node in two directions
    band: tuple[float, float]
    turning: dict[int, np.ndarray]  # rotations (3, kept) of the sensors' nodes
    parts: dict[str, np.ndarray] = field(default_factory=dict)  # modal stiffness (kept, kept) of each part; together diag(ω²)
    dashpot: np.ndarray | None = None  # modal damping (kept, kept) of a local damper that stands there in every state

    @property
    def rows(self) -> np.ndarray:
        """Modal rows (sensors, kept), in the sense of each sensor."""
        return np.array([s.sense * self.shapes[3 * s.node + s.axis] for s in self.sensors])

    @property
    def spacing(self) -> float:
        """Median distance [m] from a sensor to its nearest neighbour at another node."""
        places = np.unique([self.points[s.node] for s in self.sensors], axis=0)
        distance = np.linalg.norm(places[:, None] - places[None], axis=2) + np.where(np.eye(len(places)), np.inf, 0)
        return float(np.median(distance.min(axis=1)))

    @property
    def in_band(self) -> np.ndarray:
        return (self.hz > self.band[0]) & (self.hz < self.band[1])


@lru_cache(maxsize=8)
def draw(family: str, seed: int) -> Structure:
    """A structure of a family."""
    build, hung = {"frame": _frame, "rotor": _rotor, "panel": _panel}[family], HUNG.get(family, 0)
    for attempt in range(300):
        rng = np.random.default_rng([FAMILIES.index(family), seed, attempt])
        mesh, lines = build(rng)
        hz, shapes = mesh.modes(KEPT_MODES)
        # All stiffness scaled by one factor scales the frequencies alone: so many modes as drawn lie below the end of the band.
        end, count, drawn = rng.uniform(115, 140), hung + max(8 + seed % 3 - attempt // 100, 8), hz
        hz = hz * end / np.sqrt(hz[count - 1] * hz[count])
        apart = hz[hung + 1 : count + 2] / hz[hung : count + 1]
        if hz[hung] < 4.5 or np.any(apart < CLOSEST[family]) or hz[count] / hz[count - 1] < 1.03:
            continue
        if hung and hz[hung - 1] > 0.2 * hz[hung]:
            continue
        for _ in range(8):
            structure = _measured(family, mesh, lines, hz, shapes, count, rng)
            if structure is not None:
                scale = (hz[-1] / drawn[-1]) ** 2
                return replace(structure, parts={p: scale * shapes.T @ mesh.assemble(p)[0] @ shapes for p in mesh.parts()})
    raise RuntimeError(f"no fair {family} in 300 draws for seed {seed}")


Line = tuple[list[int], int]  # nodes that may carry a sensor, axis


def _frame(rng: np.random.Generator) -> tuple[Mesh, list[Line]]:
    """A workbench frame: four clamped legs, a ring on top, a brace half-way up, an overhanging arm, machines on top."""
    length, width, height = rng.uniform(1.2, 1.9), rng.uniform(0.6, 1.0), rng.uniform(0.8, 1.3)
    skew = rng.uniform(-0.12, 0.12, (4, 2))
    sizes = rng.uniform(0.028, 0.046, (9, 2))
    lumps = rng.uniform(2, 14, 3)
    arm = rng.uniform(0.4, 0.7)
    leg_of_brace, where = int(rng.integers(4)), [int(rng.integers(1, 4)) for _ in range(3)]

    mesh = Mesh()
    sections = [Section(a, b) for a, b in sizes]
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    feet = [mesh.node(x + dx, y + dy, 0.0) for (x, y), (dx, dy) in zip(corners, skew, strict=True)]
    tops = [mesh.node(x, y, height * (1 + 0.04 * (i % 2))) for i, (x, y) in enumerate(corners)]
    # The lowest sixth of each leg stands for its clamp.
    legs = [mesh.member(f, t, sections[i], 6, "legs", f"foot {i + 1}") for i, (f, t) in enumerate(zip(feet, tops, strict=True))]
    ring = [mesh.member(tops[i], tops[(i + 1) % 4], sections[4 + i], 6 if i % 2 == 0 else 4, "ring") for i in range(4)]
    first, second = legs[leg_of_brace][3], legs[(leg_of_brace + 1) % 4][3]
    brace = mesh.member(first, second, sections[8], 4, "brace")
    tip = mesh.node(length + arm, width * 0.6, height * 1.1)
    cantilever = mesh.member(ring[1][2], tip, sections[8], 3, "arm")
    for foot in feet:
        mesh.clamp(foot)
    for i, mass in enumerate(lumps):
        mesh.lump(ring[i][where[i]], mass, (0.01 * mass, 0.012 * mass, 0.009 * mass))
    lines: list[Line] = []
    for member, across in [(ring[0], (1, 2)), (ring[2], (1, 2)), (ring[1], (0, 2)), (ring[3], (0, 2))]:
        lines += [(member[::2], axis) for axis in across]
    lines += [(leg[2::2], axis) for leg in legs for axis in (0, 1)]
    lines += [(brace[::2], 2), (cantilever[1::2], 2)]
    return mesh, lines


def _rotor(rng: np.random.Generator) -> tuple[Mesh, list[Line]]:
    """A shaft with discs in bearings on pedestals, on a grillage of rails and cross-members, on mounts."""
    length, half, height = rng.uniform(1.3, 1.9), rng.uniform(0.25, 0.40), rng.uniform(0.20, 0.35)
    diameter = rng.uniform(0.032, 0.050)
    rail, cross, post = (Section(*rng.uniform(0.030, 0.055, 2)) for _ in range(3))
    discs = [(4 + int(rng.integers(2)), rng.uniform(4, 12)), (10, rng.uniform(3, 8)), (0, rng.uniform(0.5, 3))]
    bearings = rng.uniform(0.6, 3.0, (2, 2))
    mounts = rng.uniform(0.6, 1.8, (4, 3))
    engine, engine_at = rng.uniform(4, 15), int(rng.integers(2, 7))
    uneven = rng.uniform(0.75, 1.25)

    mesh = Mesh()

    shaft_ends = mesh.node(0, 0, height), mesh.node(length, 0, height)
    shaft = mesh.member(*shaft_ends, Section(diameter), 10, "shaft")
    rails = []
    for side, section in ((-half, rail), (half, Section(rail.width * uneven, rail.height))):
        rails.append(mesh.member(mesh.node(-0.05, side, 0), mesh.node(length + 0.05, side, 0), section, 8, "rails"))
    stations = (2, 8)
    crossing = {2: 2, 8: 6}
    middles = []
    for number, station in enumerate(stations):
        middle = mesh.node(mesh.points[rails[0][crossing[station]]][0], 0, 0)
        for side in rails:
            mesh.member(side[crossing[station]], middle, cross, 2, "cross-members")
        head = mesh.node(mesh.points[middle][0], 0, height)
        mesh.member(middle, head, post, 2, "pedestals")
        ky, kz = bearings[number] * 2e6
        axial = 3e6 if number == 0 else 0.0
        mesh.spring(shaft[station], head, (axial, ky, kz, 4e3 if number == 0 else 0.0), f"bearing {number + 1}")
        middles.append(middle)
    mesh.member(rails[0][0], rails[1][0], cross, 3, "cross-members")
    corners = (rails[0][0], rails[0][-1], rails[1][0], rails[1][-1])
    for number, (node, scale) in enumerate(zip(corners, mounts, strict=True), start=1):
        mesh.spring(node, None, tuple(scale * np.array([0.8e5, 1.0e5, 1.6e5])), f"mount {number}")
    for station, mass in discs:
        mesh.lump(shaft[station], mass, (0.008 * mass, 0.005 * mass, 0.005 * mass))
    mesh.lump(rails[1][engine_at], engine, (0.02 * engine,) * 3)
    lines: list[Line] = [(shaft[::2], 1), (shaft[::2], 2), (rails[0][::2], 2), (rails[1][::2], 2), (rails[0][::2], 1), (rails[1][::4], 0)]
    lines += [([middle], 2) for middle in middles]
    return mesh, lines


def _panel(rng: np.random.Generator) -> tuple[Mesh, list[Line]]:
    """A nearly square grid of flat bars with a machine on it, hung up at its corners, measured across it alone: modes in close pairs."""
    length = rng.uniform(0.8, 1.4)
    width = length * rng.uniform(0.85, 1.0)
    across, along = (Section(rng.uniform(0.04, 0.07), rng.uniform(0.008, 0.012)) for _ in range(2))
    lump, at = rng.uniform(0.2, 2.0), rng.integers(1, 6, 2)
    hangers = rng.uniform(0.7, 1.3, 4)

    mesh = Mesh()
    steps = 6  # elements a side; bars at every other one
    grid: dict[tuple[int, int], int] = {}
    for i in range(0, steps + 1, 2):
        for j in range(0, steps + 1, 2):
            grid[i, j] = mesh.node(length * i / steps, width * j / steps, 0.0)
    for j in range(0, steps + 1, 2):
        for i in range(0, steps, 2):
            grid[i + 1, j] = mesh.member(grid[i, j], grid[i + 2, j], along, 2, "bars along")[1]
    for i in range(0, steps + 1, 2):
        for j in range(0, steps, 2):
            grid[i, j + 1] = mesh.member(grid[i, j], grid[i, j + 2], across, 2, "bars across")[1]
    where = min(grid, key=lambda ij: (ij[0] - at[0]) ** 2 + (ij[1] - at[1]) ** 2)
    mesh.lump(grid[where], lump, (0.002 * lump,) * 3)
    for (i, j), soft in zip(((0, 0), (steps, 0), (steps, steps), (0, steps)), hangers, strict=True):
        # along the panel so stiff that it moves across itself alone
        mesh.spring(grid[i, j], None, (1e9, 1e9, 900.0 * soft), "hangers")
    lines: list[Line] = [([grid[i, j] for i in range(0, steps + 1, 2)], 2) for j in range(0, steps + 1, 2)]
    lines += [([grid[i, j] for j in range(1, steps, 2)], 2) for i in range(0, steps + 1, 2)]
    return mesh, lines


def _measured(
    family: str, mesh: Mesh, lines: list[Line], hz: np.ndarray, full: np.ndarray, count: int, rng: np.random.Generator
) -> Structure | None:
    """Places sensors and the band; None where they do not see the modes apart."""
    points = np.array(mesh.points)
    translations = np.concatenate([full[6 * n : 6 * n + 3] for n in range(len(points))])
    chosen = _place(translations[:, : count + 4], lines, rng)
    if chosen is None:
        return None
    nodes = sorted({node for node, _ in chosen})
    first = int(rng.integers(1, 400))
    label = {node: first + int(step) for node, step in zip(nodes, np.cumsum(rng.integers(1, 30, len(nodes))), strict=True)}
    sensors = tuple(Sensor(label[n], n, a, -1 if rng.uniform() < 0.12 else 1) for n, a in chosen)
    seen = np.abs(np.array([translations[3 * s.node + s.axis, :count] for s in sensors]))
    if np.any(seen.max(axis=0) < 0.2 * np.abs(translations[:, :count]).max(axis=0)) or count >= len(sensors):
        return None
    if np.linalg.cond(_unit_columns(sensors, translations[:, :count])) > 40:
        return None
    at = {(s.node, s.axis): i for i, s in enumerate(sensors)}
    gaps, wires = _between(mesh, lines, at, label)
    pairs = tuple((i, j) for i, a in enumerate(sensors) for j, b in enumerate(sensors) if i < j and a.node == b.node)
    turning = {n: full[6 * n + 3 : 6 * n + 6] for n in nodes}
    zeta = rng.uniform(*DAMPING[family], hz.size)
    hung = HUNG.get(family, 0)
    zeta[:hung] = SUSPENSION_DAMPING
    high = float(np.sqrt(hz[count - 1] * hz[count]))
    band = (round(max(3.0, 0.55 * float(hz[hung])), 1), round(high, 1))
    return Structure(family, points, hz, zeta, translations, sensors, gaps, wires, pairs, band, turning)


def _unit_columns(sensors: tuple[Sensor, ...], shapes: np.ndarray) -> np.ndarray:
    rows = np.array([shapes[3 * s.node + s.axis] for s in sensors])
    return rows / np.linalg.norm(rows, axis=0)


def _place(shapes: np.ndarray, lines: list[Line], rng: np.random.Generator) -> list[tuple[int, int]] | None:
    """10 to 13 sensors along whole lines, no two of which see the same motion; None where too few differ."""
    wanted = int(rng.integers(10, 14))
    weight = 1 / np.sqrt((shapes**2).mean(axis=0))  # every mode counts alike
    chosen: list[tuple[int, int]] = []
    rows: list[np.ndarray] = []
    largest = np.abs(shapes * weight).max()
    for index in rng.permutation(len(lines)):
        nodes, axis = lines[index]
        for node in nodes:
            row = shapes[3 * node + axis] * weight
            size = np.linalg.norm(row)
            if len(chosen) >= wanted or (node, axis) in chosen or size < 0.08 * largest:
                continue
            if all(abs(row @ other) < 0.96 * size * np.linalg.norm(other) for other in rows):
                chosen.append((node, axis))
                rows.append(row)
    return chosen if len(chosen) >= 9 else None


def _between(mesh: Mesh, lines: list[Line], at: dict[tuple[int, int], int], label: dict[int, int]):
    """Nodes without a sensor half-way along a member between two sensors of one axis; and label chains for the drawing."""
    gaps: set[tuple[int, int]] = set()
    wires: list[tuple[int, ...]] = []
    for nodes, axis in lines:
        chain = [n for n in nodes if n in label]
        if len(chain) > 1:
            wires.append(tuple(label[n] for n in chain))
        for first, second in pairwise(nodes):
            if (first, axis) in at and (second, axis) in at:
                middle = (mesh.points[first] + mesh.points[second]) / 2
                distance = np.linalg.norm(np.array(mesh.points) - middle, axis=1)
                node = int(distance.argmin())
                if distance[node] < 1e-6 and (node, axis) not in at and node not in label:
                    gaps.add((node, axis))
    return tuple(sorted(gaps)), tuple(dict.fromkeys(wires))
