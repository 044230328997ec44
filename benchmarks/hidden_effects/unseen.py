"""Motions that no sensor shows: whether the law is named, and whether the shares of the modes are within their intervals.

    python unseen.py [--seeds 7100 7112]

Structures of the two families, each with one thing that acts where no sensor looks: rotary inertia at a sensor's node (three rotations), a
mass at a node without sensors (three translations), a spring or a damper there along one axis. The idle model is the true one with the
errors that a test leaves; the check has noise of half a per cent. The ground of the numbers in ``diagnosis/unseen.py``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from families import FAMILIES, IN_PLANS, Structure, draw
from hidden import System, idle

from operando.data import Frf, ModalModel
from operando.diagnosis.case import Case
from operando.diagnosis.idle import Idle
from operando.diagnosis.unseen import unseen_share, with_unseen_motion
from operando.dof import parse_dofs
from operando.threads import one_blas_thread

WHAT = ("inertia", "mass", "spring", "damper")
LAWS = {"inertia": "point_mass", "mass": "point_mass", "spring": "ground_spring", "damper": "ground_damper"}
NOISE, LEVELS = 0.005, (1.0, 4.0)  # of the rms of an FRF; dB by which the FRFs change
STD = {"frequency": 1e-5, "damping": 2e-3, "shape": 1e-3}  # relative, of the idle model


def added(structure: Structure, what: str, size: float, rows: np.ndarray) -> System:
    """The structure with ``size`` on the motions ``rows`` (motions, modes)."""
    system = idle(structure).system
    part = {"point_mass": "mass", "ground_spring": "stiffness", "ground_damper": "damping"}[LAWS[what]]
    return replace(system, **{part: getattr(system, part) + size * rows.T @ rows})


def motions(structure: Structure, what: str, rng: np.random.Generator) -> np.ndarray:
    if what == "inertia":
        return structure.turning[structure.sensors[int(rng.integers(len(structure.sensors)))].node]
    measured = {s.node for s in structure.sensors}
    moving = np.abs(structure.shapes[:, :6]).max(axis=1)
    free = [n for n in range(len(structure.points)) if n not in measured and moving[3 * n : 3 * n + 3].max() > 0.3 * moving.max()]
    node = int(rng.choice(free))
    rows = structure.shapes[3 * node : 3 * node + 3]
    return rows if what == "mass" else rows[[int(np.argmax(moving[3 * node : 3 * node + 3]))]]


def identified(structure: Structure, rng: np.random.Generator) -> ModalModel:
    """The idle model of a structure, with the errors that a test leaves; modes far above the band as residual terms."""
    f, zeta, phi = structure.hz, structure.zeta, structure.rows
    shape = np.repeat(STD["shape"] * np.sqrt(np.mean(phi**2, axis=0)), len(phi))
    std = np.concatenate([STD["frequency"] * f, STD["damping"] * zeta, shape])
    start = np.concatenate([f, zeta, phi.T.ravel()]) + std * rng.standard_normal(std.size)
    values = start[: f.size], start[f.size : 2 * f.size], start[2 * f.size :].reshape(f.size, -1).T
    more = {"residual": f > 1.25 * structure.band[1], "covariance": np.diag(std**2), "band_hz": structure.band}
    return ModalModel.from_terms(*values, tuple(parse_dofs([s.name for s in structure.sensors])), scaling="unit_modal_mass", **more)


def judged(family: str, seed: int, what: str) -> dict[str, object]:
    """One structure: what is found, and the errors of its shares over their standard deviations."""
    structure, rng = draw(family, seed), np.random.default_rng([seed, FAMILIES.index(family), WHAT.index(what)])
    band, hz = structure.band, np.arange(structure.band[0], structure.band[1], 0.05)
    rows, columns = structure.rows, structure.rows[rng.choice(len(structure.rows), 2, replace=False)]
    motion = motions(structure, what, rng)
    before, level = idle(structure).system.accelerance(hz[::8], rows, columns), float(np.exp(rng.uniform(*np.log(LEVELS))))
    low, high = np.log(1e-9), np.log(1e12)
    for _ in range(50):
        middle = 0.5 * (low + high)
        after = added(structure, what, float(np.exp(middle)), motion).accelerance(hz[::8], rows, columns)
        changed = float(np.sqrt(np.mean((20 * np.log10(np.abs(after / before))) ** 2)))
        low, high = (middle, high) if changed < level else (low, middle)
    size = float(np.exp(0.5 * (low + high)))
    h = added(structure, what, size, motion).accelerance(hz, rows, columns)
    noise = NOISE * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    h = h + noise * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    names = [s.name for s in structure.sensors]
    dofs = tuple(parse_dofs(names))
    references = tuple(dofs[int(np.flatnonzero((rows == column).all(axis=1))[0])] for column in columns)
    check = Frf(h, hz, dofs, references, variance=np.broadcast_to(noise**2, h.shape).copy())
    model = identified(structure, rng)

    def again(other: Idle) -> list[Case]:
        return [Case(other, check, band, {}, correlated=1.0)]

    begun = time.process_time()
    case = again(Idle.of(model, band, references))[0]
    with one_blas_thread():
        state = with_unseen_motion(case, again, -np.inf)
    row: dict[str, object] = {"seconds": time.process_time() - begun, "db": level, "law": state and state.terms[0].kind, "motions": 0}
    if state is None:
        return row
    share, its_std = unseen_share(state)
    modes, f, zeta = case.idle.modes, structure.hz, structure.zeta
    unit = {"point_mass": 1.0, "ground_spring": 1 / (2 * np.pi * f[modes]) ** 2, "ground_damper": 1 / (4 * np.pi * zeta[modes] * f[modes])}
    wanted = 100 * size * np.sum(motion[:, modes] ** 2, axis=0) * unit[LAWS[what]]
    inside = f[modes] < band[1]
    return row | {"motions": len(state.terms), "off": ((share - wanted) / its_std)[inside]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7100, 7112))
    seeds = range(*parser.parse_args().seeds)
    for family in IN_PLANS:
        for what in WHAT:
            rows = [judged(family, seed, what) for seed in seeds]
            right = [row for row in rows if row["law"] == LAWS[what]]
            wrong = sum(row["law"] is not None for row in rows) - len(right)
            off = np.concatenate([row["off"] for row in right]) if right else np.zeros(0)
            inside = f"{100 * np.mean(np.abs(off) < 1.96):.0f} % of {off.size}" if off.size else "–"
            seconds = np.median([row["seconds"] for row in rows])
            counts = " ".join(str(row["motions"]) for row in rows)
            found = f"law named {len(right)} of {len(rows)}, wrong {wrong}; motions {counts}"
            print(f"{family:6} {what:8} {found}; 95 % intervals hold {inside}; {seconds:.1f} s")


if __name__ == "__main__":
    main()
