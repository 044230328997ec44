"""The plate–tripod–mass structure of Shen & Lu (2024), Section 4.1, as a finite-element model: original and both targets.

The paper's drawing cannot be read; the layout was recovered from its tables of natural frequencies. A 1 m steel plate of 10 mm
shells, clamped at two single nodes, carries a tripod of three thin beams up to P; a mass of 1 kg hangs between plate and P on two springs.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from assembly import Assembly, free_dofs, lowest_modes, square_cells
from elements import DRILLING, beam_mass, beam_stiffness, bush_stiffness, shell_mass, shell_stiffness

Array = np.ndarray

CELLS = 100
"""Shells along a side of the plate; the single-node clamps make frequencies depend on it."""
DENSITY, POISSON = 7850.0, 0.3
STEEL, SOFT = 210e9, 185e9
P, MASS, FOOT = (0.3, 0.5, 0.3), (0.3, 0.5, 0.15), (0.3, 0.5)
MASS_KG = 1.0
CLAMPED = ((0.5, 1.0), (0.0, 0.5))
POINTS = {
    1001: (1.0, 0.0), 1002: (1.0, 0.21), 1003: (1.0, 0.49), 1004: (1.0, 0.78), 1005: (1.0, 1.0), 1006: (0.76, 1.0),
    1007: (0.48, 1.0), 1008: (0.18, 1.0), 1009: (0.0, 1.0), 1010: (0.0, 0.79), 1011: (0.0, 0.48), 1012: (0.0, 0.18),
    1013: (0.0, 0.0), 1014: (0.24, 0.0), 1015: (0.51, 0.0), 1016: (0.79, 0.0),
}  # fmt: skip
"""Output nodes of the plate: (x, y) [m]."""
MASS_NODE = 2000
LEGS = (1005, 1009, 1013)
SOFT_LEG = 1009
"""The leg that changes in the targets."""
CORNERS = (1001, 1005, 1009, 1013)
A, ORIGIN, B, B_BY_TABLE, C, D = 1001, 1013, 1004, 1006, 1007, 1010
DOFS = (*(f"{node}+Z" for node in POINTS), f"{MASS_NODE}+X", f"{MASS_NODE}+Y", f"{MASS_NODE}+Z")
"""The 19 measured DOFs: z at 16 plate points, x, y, z of the mass."""


@dataclass(frozen=True)
class Design:
    """What tells one state of the structure from another.

    Parameters
    ----------
    name : str
    young_part, thick_part : float
        Young's modulus [Pa] and thickness [m] of the plate but for the quarter x > 0.52 m, y > 0.52 m.
    young_leg, thick_leg : float
        Young's modulus [Pa] and diameter [m] of the beam to node 1009.
    spring : tuple of float
        Stiffness of each of the two springs along x, y, z [N/m].
    dashpot : tuple of float
        Printed damping of each spring [N·s/m]; used only to see what it would do to the modes.
    """

    name: str
    young_part: float = STEEL
    thick_part: float = 0.005
    young_leg: float = STEEL
    thick_leg: float = 0.006
    spring: tuple[float, float, float] = (5e5, 1e8, 1e8)
    dashpot: tuple[float, float, float] = (5e3, 1e5, 1e5)


_TARGET = {"young_part": SOFT, "young_leg": SOFT, "spring": (1e6, 8e7, 8e7), "dashpot": (1e4, 8e4, 8e4)}
ORIGINAL = Design("original")
CASE_1 = Design("target, case 1", **_TARGET)
CASE_2 = Design("target, case 2", **_TARGET, thick_part=0.006, thick_leg=0.010)
DESIGNS = {"original": ORIGINAL, "case 1": CASE_1, "case 2": CASE_2}


@dataclass(frozen=True)
class Modes:
    """Exact undamped modes of a design.

    Parameters
    ----------
    hz : (n,) array
    shapes : (19, n) array
        At ``DOFS``, unit modal mass [kg^(−1/2)].
    deflection : (51, 51, n) array
        Plate w on the 20 mm grid, first index x.
    joints : (18, n) array
        Displacements and rotations at the foot of the lower spring, the mass and P.
    ends : (3, 6, n) array
        The same at the feet of the three legs.
    total_mass : float
        [kg].
    """

    hz: Array
    shapes: Array
    deflection: Array
    joints: Array
    ends: Array
    total_mass: float


def node_at(x: float, y: float, cells: int = CELLS) -> int:
    """Index of the plate node at (x, y) [m]."""
    return round(x * cells) * (cells + 1) + round(y * cells)


def assemble(design: Design, cells: int = CELLS, drilling: float = DRILLING) -> tuple[object, Array, Array]:
    """Sparse stiffness (n, n), lumped masses (n,) and free DOFs, in the order of elimination; the mass and P follow the plate nodes."""
    plate, side = (cells + 1) ** 2, 1 / cells
    mass, p, foot = plate, plate + 1, node_at(*FOOT, cells)
    nodes = square_cells(cells)
    i, j = nodes[:, 0] // (cells + 1), nodes[:, 0] % (cells + 1)
    quarter = ((i + 0.5) * side > 0.52) & ((j + 0.5) * side > 0.52)
    whole = Assembly(plate + 2)
    for part, young, thick in ((quarter, STEEL, 0.005), (~quarter, design.young_part, design.thick_part)):
        whole.add(nodes[part], shell_stiffness(side, thick, young, POISSON, drilling), shell_mass(side, thick, DENSITY))
    for leg in LEGS:
        end = (*POINTS[leg], 0.0)
        young, thick = (design.young_leg, design.thick_leg) if leg == SOFT_LEG else (STEEL, 0.006)
        where = np.array([[p, node_at(*POINTS[leg], cells)]])
        whole.add(where, beam_stiffness(P, end, thick, young, POISSON), beam_mass(P, end, thick, DENSITY))
    for start, end, where in (((*FOOT, 0.0), MASS, (foot, mass)), (MASS, P, (mass, p))):
        whole.add(np.array([where]), bush_stiffness(start, end, design.spring), np.zeros(12))
    whole.mass[6 * mass : 6 * mass + 3] += MASS_KG
    fixed = [6 * node_at(*c, cells) + k for c in CLAMPED for k in range(6)] + [6 * mass + 5]
    return whole.stiffness(), whole.mass, free_dofs(cells, [mass, p], fixed)


def modes_of(design: Design, count: int = 72, cells: int = CELLS, drilling: float = DRILLING) -> Modes:
    """The lowest modes of a design; the sign makes the largest plate deflection of each mode positive."""
    k, m, free = assemble(design, cells, drilling)
    hz, shapes = lowest_modes(k, m, free, count)
    plate = (cells + 1) ** 2
    w = shapes[2 : 6 * plate : 6]
    peak = np.take_along_axis(w, np.argmax(np.abs(w), axis=0)[None], axis=0)[0]
    shapes = shapes * np.where(peak < 0, -1.0, 1.0)
    rows = [6 * node_at(*xy, cells) + 2 for xy in POINTS.values()] + [6 * plate + axis for axis in range(3)]
    grid = np.linspace(0, cells, 51).round().astype(int)
    w = shapes[2 : 6 * plate : 6].reshape(cells + 1, cells + 1, count)[grid][:, grid]
    foot = 6 * node_at(*FOOT, cells)
    joints = np.concatenate([shapes[foot : foot + 6], shapes[6 * plate :]])
    ends = np.array([shapes[6 * n : 6 * n + 6] for n in (node_at(*POINTS[leg], cells) for leg in LEGS)])
    total = float(m[2 : 6 * plate : 6].sum() + m[6 * plate + 2] + m[6 * plate + 8])
    return Modes(hz, shapes[rows], w, joints, ends, total)


def exact_modes(name: str, folder: Path | None = None) -> Modes:
    """The 72 lowest modes of a design by name, kept in a folder for the next time."""
    path = None if folder is None else folder / f"modes-{name.replace(' ', '-')}.npz"
    if path is not None and path.exists():
        with np.load(path) as kept:
            return Modes(**{f.name: (float(kept[f.name]) if kept[f.name].ndim == 0 else kept[f.name]) for f in fields(Modes)})
    modes = modes_of(DESIGNS[name])
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{f.name: getattr(modes, f.name) for f in fields(Modes)})
    return modes
