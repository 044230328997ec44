"""Sizes of effects between sensors: how far off they are, in the standard deviations that the diagnosis gives them.

    python between_sizes.py [--seeds 7200 7230] [--cases]

Structures of the two families, each with a mass, a spring or a damper half-way between two sensors, where the shapes are those of the mesh.
The idle model is the true one with the errors that a test leaves, the check has noise of half a per cent; kind and location are given, so
that the size alone is judged. Beside it the size of the plain fit, with its own standard deviation.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from families import FAMILIES, IN_PLANS, Structure, draw
from hidden import Hidden, change_db, hide_between
from unseen import NOISE, identified

from operando.data import Frf, Geometry
from operando.diagnosis.between import SAME_SET_UP
from operando.diagnosis.case import Case
from operando.diagnosis.found import Found
from operando.diagnosis.idle import Idle
from operando.diagnosis.midway import with_midway
from operando.diagnosis.posterior import fit
from operando.diagnosis.rival import started
from operando.diagnosis.sizes import with_likely_sizes
from operando.diagnosis.terms import Term
from operando.threads import one_blas_thread

KINDS = {"point_mass": "mass", "ground_spring": "stiffness", "ground_damper": "damping"}
START = 0.03  # discrepancy that a fit starts from, as in a search


def case_of(structure: Structure, state: Hidden, references: np.ndarray, rng: np.random.Generator) -> tuple[Case, int]:
    """What the diagnosis is given, and the DOF of the place."""
    model = identified(structure, rng)
    hz = np.arange(*structure.band, 0.05)
    h = state.system.accelerance(hz, state.rows, state.rows[references])
    noise = NOISE * np.sqrt(np.mean(np.abs(h) ** 2, axis=2, keepdims=True))
    h = h + noise * (rng.standard_normal(h.shape) + 1j * rng.standard_normal(h.shape)) / np.sqrt(2)
    columns = tuple(model.dofs[i] for i in references)
    check = Frf(h, hz, model.dofs, columns, variance=np.broadcast_to(noise**2, h.shape).copy())
    points = {sensor.label: structure.points[sensor.node] for sensor in structure.sensors}
    wider = with_midway(Idle.of(model, structure.band, columns), Geometry(tuple(points), np.array([*points.values()])))
    (effect,) = state.effects
    for at, position in (wider.midway if wider else {}).items():
        if position and np.allclose(position, effect["position"], atol=1e-3) and wider.dofs[at].axis == effect["direction"][1]:
            return Case(wider, check, structure.band, SAME_SET_UP, correlated=1.0), at
    raise LookupError("the diagnosis has no location there: other sensors are as near")


def judged(family: str, seed: int, kind: str) -> dict[str, object] | None:
    """Logarithm of the size over the true one, and its standard deviation, by the evidence and by the plain fit."""
    structure, rng = draw(family, seed), np.random.default_rng([seed, FAMILIES.index(family), list(KINDS).index(kind), 5])
    references = rng.choice(len(structure.rows), 2, replace=False)
    state = hide_between(kind, structure, tuple(references), rng)
    try:
        case, at = case_of(structure, state, references, rng)
    except LookupError:
        return None
    true = float(np.log(state.effects[0]["parameters"][KINDS[kind]]["value"]))
    begun = time.process_time()
    with one_blas_thread():
        plain = fit(case, started(case, (Term(kind, (at,), (true,)),)), START, closely=True)
        held = with_likely_sizes(Found(plain, plain, {plain.key: plain})).best
    values = [(float(s.terms[0].values[0]) - true, float(np.sqrt(s.covariance[0, 0]))) for s in (held, plain)]
    return {"seconds": time.process_time() - begun, "db": change_db(structure, state, tuple(references)), "sizes": values}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(7200, 7230))
    parser.add_argument("--cases", action="store_true", help="a line for each case")
    options = parser.parse_args()
    for family in IN_PLANS:
        for kind in KINDS:
            rows = []
            for seed in range(*options.seeds):
                row = judged(family, seed, kind)
                if row is None:
                    continue
                rows.append(row)
                if options.cases:
                    each = "; ".join(f"{off:+6.2f} ± {std:4.2f} = {off / std:+5.1f}" for off, std in row["sizes"])
                    print(f"{family:6} {kind:14} {seed} {row['db']:4.1f} dB  {each}  {row['seconds']:.1f} s", flush=True)
            for number, name in enumerate(("evidence", "plain fit")):
                off, std = np.array([row["sizes"][number] for row in rows]).T
                z = off / std
                found = f"{np.sum(np.abs(z) < 1.96)} of {z.size} inside; z {z.mean():+.2f} ± {z.std():.2f}; median std {np.median(std):.3f}"
                print(f"{family:6} {kind:14} {name:9} {found}")


if __name__ == "__main__":
    main()
