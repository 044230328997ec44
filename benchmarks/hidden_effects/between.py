"""Shapes between sensors: how far what the neighbouring sensors suggest is off, in the standard deviations that the diagnosis gives it.

    python between.py [--seeds 7000 7030]

At every place of the simulated structures that lies half-way between two sensors and has none; by how high a mode is in the band, and by
whether the suggestion is a straight line or a spline. The ground of ``BETWEEN_STD`` and ``LEAST_BETWEEN_STD``.
"""

from __future__ import annotations

import argparse

import numpy as np
from families import IN_PLANS, Structure, draw

from operando.data import Geometry
from operando.diagnosis.midway import midway, shape_spread
from operando.dof import parse_dofs

PARTS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.01))  # of the band's end


def errors(structure: Structure) -> list[tuple[bool, float, float, float]]:
    """Of each place and mode in band: whether a spline, frequency over the band's end, error over the sensors' rms, and over its std."""
    dofs = parse_dofs([sensor.name for sensor in structure.sensors])
    at = {sensor.label: structure.points[sensor.node] for sensor in structure.sensors}
    modes = np.flatnonzero(structure.in_band)
    hz, phi = structure.hz[modes], structure.rows[:, modes]
    rows = []
    for place in midway(tuple(dofs), Geometry(tuple(at), np.array(list(at.values())))):
        axis = "XYZ".index(place.axis)
        distance = np.linalg.norm(structure.points - np.array(place.position), axis=1)
        node = int(np.argmin(distance))
        if distance[node] > 1e-3 or (node, axis) not in structure.gaps:
            continue
        spline = bool(np.any(place.weights != place.doubt))
        error = structure.shapes[3 * node + axis, modes] - place.weights @ phi
        near, size = (np.sqrt(np.mean(rows**2, axis=0)) for rows in (phi[list(place.ends)], phi))
        std = shape_spread(place, phi, hz, np.arange(hz.size))
        rows += list(zip([spline] * hz.size, hz / structure.band[1], error / np.maximum(near, 0.3 * size), error / std, strict=True))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7000, 7030))
    seeds = range(*parser.parse_args().seeds)
    print(f"{'':14}{'band':>12}{'values':>8}{'error/near rms':>16}{'z rms':>7}{'|z| > 4 %':>11}")
    for family in IN_PLANS:
        table = np.array([row for seed in seeds for row in errors(draw(family, seed))])
        for spline in (False, True):
            for low, high in PARTS:
                some = table[(table[:, 0] == spline) & (table[:, 1] >= low) & (table[:, 1] < high)]
                if len(some):
                    off, z = np.sqrt(np.mean(some[:, 2:] ** 2, axis=0))
                    beyond = 100 * np.mean(np.abs(some[:, 3]) > 4)
                    part = f"{100 * low:.0f}–{min(100 * high, 100):.0f} %"
                    print(f"{family:6} {'spline' if spline else 'line':7}{part:>12}{len(some):8}{off:16.2f}{z:7.2f}{beyond:11.1f}")


if __name__ == "__main__":
    main()
