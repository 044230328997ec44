"""Shapes between sensors: how far what the neighbouring sensors suggest is off, in the standard deviations that the diagnosis gives it.

    python between.py [--seeds 7000 7030]

At every place of the simulated structures that lies half-way between two sensors and has none; by how high a mode is in the band, and by
whether the suggestion is a straight line or a spline. The ground of ``BETWEEN_STD`` and ``LEAST_BETWEEN_STD``. Then place by place: the
scale of the errors of all modes (``SCALE_BETWEEN``), and the factor that all shapes have in common over what is suggested
(``COMMON_BETWEEN``).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
from families import IN_PLANS, Structure, draw

from operando.data import Geometry
from operando.diagnosis.midway import midway, shape_spread
from operando.dof import parse_dofs

PARTS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.01))  # of the band's end


def places(structure: Structure) -> Iterator[tuple[bool, np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Of each place: whether a spline; frequency over the band's end, error over the sensors' rms and over its std, and shape over that."""
    dofs = parse_dofs([sensor.name for sensor in structure.sensors])
    at = {sensor.label: structure.points[sensor.node] for sensor in structure.sensors}
    modes = np.flatnonzero(structure.in_band)
    hz, phi = structure.hz[modes], structure.rows[:, modes]
    for place in midway(tuple(dofs), Geometry(tuple(at), np.array(list(at.values())))):
        axis = "XYZ".index(place.axis)
        distance = np.linalg.norm(structure.points - np.array(place.position), axis=1)
        node = int(np.argmin(distance))
        if distance[node] > 1e-3 or (node, axis) not in structure.gaps:
            continue
        spline = bool(np.any(place.weights != place.doubt))
        shape = structure.shapes[3 * node + axis, modes]
        error = shape - place.weights @ phi
        near, size = (np.sqrt(np.mean(rows**2, axis=0)) for rows in (phi[list(place.ends)], phi))
        std = shape_spread(place, phi, hz, np.arange(hz.size))
        yield spline, hz / structure.band[1], error / np.maximum(near, 0.3 * size), error / std, shape / std


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7000, 7030))
    seeds = range(*parser.parse_args().seeds)
    print(f"{'':14}{'band':>12}{'values':>8}{'error/near rms':>16}{'z rms':>7}{'|z| > 4 %':>11}")
    every = {family: [row for seed in seeds for row in places(draw(family, seed))] for family in IN_PLANS}
    for family, found in every.items():
        table = np.array([row for spline, *columns, _ in found for row in zip([spline] * len(columns[0]), *columns, strict=True)])
        for spline in (False, True):
            for low, high in PARTS:
                some = table[(table[:, 0] == spline) & (table[:, 1] >= low) & (table[:, 1] < high)]
                if len(some):
                    off, z = np.sqrt(np.mean(some[:, 2:] ** 2, axis=0))
                    beyond = 100 * np.mean(np.abs(some[:, 3]) > 4)
                    part = f"{100 * low:.0f}–{min(100 * high, 100):.0f} %"
                    print(f"{family:6} {'spline' if spline else 'line':7}{part:>12}{len(some):8}{off:16.2f}{z:7.2f}{beyond:11.1f}")
    print(f"\n{'':14}{'places':>8}{'log scale':>16}{'common factor, rms':>20}")
    for family, found in every.items():
        for spline in (False, True):
            some = [(z, shape) for of_spline, _, _, z, shape in found if of_spline == spline]
            if some:
                scale = np.log([np.sqrt(np.mean(z**2)) for z, _ in some])
                common = np.sqrt(np.mean([(z @ shape / (shape @ shape)) ** 2 for z, shape in some]))
                print(f"{family:6} {'spline' if spline else 'line':7}{len(some):8}{scale.mean():9.2f} ± {scale.std():4.2f}{common:20.3f}")


if __name__ == "__main__":
    main()
