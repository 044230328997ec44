"""Kinds that turn into simpler ones for some of their values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.case import Case
from operando.diagnosis.terms import Term, added

Array = NDArray[Any]
_LINES = 50  # on which laws are compared


def contained(case: Case, term: Term) -> list[Term]:
    """Simpler kinds that a kind turns into for some of its values, at the same place: a heavy absorber far above its resonance is a
    spring or a damper to ground, far below it a mass; a spring with little or much loss is a spring or a damper."""
    if not (term.structural and term.values[1:]):
        return []
    size, f = float(np.exp(term.values[0])), np.sqrt(case.band[0] * case.band[1])
    if term.kind == "tuned_absorber":
        wa, zeta = 2 * np.pi * float(np.exp(term.values[1])), float(np.exp(term.values[2]))
        sizes = {"point_mass": size, "ground_spring": size * wa**2, "ground_damper": 2 * zeta * size * wa}
    else:
        z = abs(complex(added(term, np.array([2 * np.pi * f]), case.band)[0, 0, 0]))
        sizes = {"ground_spring": z, "ground_damper": z / (2 * np.pi * f), "ground_hysteretic_spring": z}
    out = []
    for kind, value in sizes.items():
        if kind in case.kinds and kind != term.kind:
            places = next(node for node in case.nodes if term.places[0] in node) if kind == "point_mass" else term.places
            further = tuple(float(v) for v in case.prior(Term(kind, places))[0][1:])
            out.append(Term(kind, places, (float(np.log(value)), *further), term.sign))
    return out


def turned_into(case: Case, term: Term) -> list[Term]:
    """The simpler kind that a term beyond its range has turned into: whose dynamic stiffness is nearest to its own over the band."""
    w = 2 * np.pi * np.linspace(*case.band, _LINES)

    def law(one: Term) -> Array:
        return np.asarray(added(one, w, case.band)[:, 0, 0])

    return sorted(contained(case, term), key=lambda one: float(np.linalg.norm(law(one) - law(term))))[:1]
