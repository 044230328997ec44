"""A plate on three legs, in kind with the experiment of Shen & Lu (2024), Section 4.2, as a finite-element model.

A steel plate of 500 × 500 × 5 mm stands on three legs. At rest two feet are bolted down and the third only stands on the floor; in
operation it is bolted as well. Twelve accelerometers, one of them tri-axial: 14 DOFs. Everything the paper does not print (the legs, where
they and the sensors stand) is this project's own choice, so its frequencies are like those of Table A4, not equal to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from assembly import Assembly, free_dofs, lowest_modes, square_cells
from elements import beam_mass, beam_stiffness, shell_mass, shell_stiffness

Array = np.ndarray

SIDE, THICKNESS, CELLS = 0.5, 0.005, 40
STEEL, POISSON, DENSITY = 210e9, 0.3, 7850.0
LEGS = ((0.05, 0.05), (0.45, 0.0625), (0.3, 0.45))
"""Where the legs stand (x, y) [m]; the third is the one that is bolted in operation only."""
LEG_LENGTH, LEG_DIAMETER, LEG_PARTS = 0.15, 0.025, 4
FLOOR = 4e6
"""Stiffness along x, y and z of the contact of a foot that only stands on the floor, held by friction [N/m]; it may tilt."""
ACCELEROMETERS = {
    1: (0.0, 0.0), 2: (0.2, 0.0), 3: (0.5, 0.0), 4: (0.0, 0.225), 5: (0.225, 0.225), 6: (0.5, 0.25),
    7: (0.0, 0.5), 8: (0.15, 0.4), 9: (0.5, 0.5), 10: (0.375, 0.375), 11: (0.35, 0.125), 12: (0.325, 0.5),
}  # fmt: skip
"""Places of the twelve accelerometers (x, y) [m]."""
TRIAXIAL = 12
DOFS = (*(f"{node}+Z" for node in ACCELEROMETERS), f"{TRIAXIAL}+X", f"{TRIAXIAL}+Y")
EXCITER, PUSH = (0.125, 0.3), (0.35, 0.25, 0.9)
"""Where the exciter acts in operation (x, y) [m], and along which direction: it hangs on a beam, oblique to the plate."""
AT_REST, RUNNING = (0, 1), (0, 1, 2)
"""Feet bolted down."""


@dataclass(frozen=True)
class State:
    """Exact undamped modes of one state.

    Parameters
    ----------
    hz : (n,) array
    shapes : (14, n) array
        At ``DOFS``, unit modal mass [kg^(−1/2)].
    exciter : (n,) array
        At the exciter, along its push.
    total_mass : float
        [kg].
    """

    hz: Array
    shapes: Array
    exciter: Array
    total_mass: float


def node_at(x: float, y: float, cells: int = CELLS) -> int:
    """Index of the plate node at (x, y) [m]."""
    return round(x / SIDE * cells) * (cells + 1) + round(y / SIDE * cells)


def state(bolted: tuple[int, ...], count: int = 60, cells: int = CELLS) -> State:
    """Modes with some feet bolted down; the others stand on the floor."""
    whole, feet = assemble(cells)
    plate = (cells + 1) ** 2
    for foot in range(len(LEGS)):
        if foot not in bolted:
            for axis in range(3):
                whole.spring(6 * feet[foot] + axis, FLOOR)
    fixed = [6 * feet[foot] + k for foot in bolted for k in range(6)]
    free = free_dofs(cells, list(range(plate, plate + len(LEGS) * LEG_PARTS)), fixed)
    hz, shapes = lowest_modes(whole.stiffness(), whole.mass, free, count)
    rows = [6 * node_at(*ACCELEROMETERS[int(label.split("+")[0])], cells) + "XYZ".index(label[-1]) for label in DOFS]
    push = np.array(PUSH) / np.linalg.norm(PUSH)
    at = 6 * node_at(*EXCITER, cells)
    return State(hz, shapes[rows], push @ shapes[at : at + 3], float(whole.mass[2::6].sum()))


def assemble(cells: int = CELLS) -> tuple[Assembly, list[int]]:
    """Plate and legs without any support, and the node of each foot."""
    plate, side = (cells + 1) ** 2, SIDE / cells
    whole = Assembly(plate + len(LEGS) * LEG_PARTS)
    whole.add(square_cells(cells), shell_stiffness(side, THICKNESS, STEEL, POISSON), shell_mass(side, THICKNESS, DENSITY))
    height = -LEG_LENGTH / LEG_PARTS
    for leg, (x, y) in enumerate(LEGS):
        first = plate + leg * LEG_PARTS
        nodes = [node_at(x, y, cells), *range(first, first + LEG_PARTS)]
        ends = (x, y, 0.0), (x, y, height)
        where = np.stack([nodes[:-1], nodes[1:]], axis=1)
        whole.add(where, beam_stiffness(*ends, LEG_DIAMETER, STEEL, POISSON), beam_mass(*ends, LEG_DIAMETER, DENSITY))
    return whole, [plate + (leg + 1) * LEG_PARTS - 1 for leg in range(len(LEGS))]
