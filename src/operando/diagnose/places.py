"""Which kinds are looked for, and where: the candidates before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from operando.data import Geometry, ModalModel
from operando.diagnose.predict import Term
from operando.dof import Dof, match_dofs
from operando.effects import Effect, catalogue, place_weights


def term_of(effect: Effect, idle: ModalModel, band_hz: tuple[float, float], geometry: Geometry | None = None) -> Term:
    """An effect as the fit sees it."""
    kind = effect.definition
    if kind.acts == "dynamic_stiffness":
        rows = place_weights(effect, idle, geometry)
    else:
        rows = np.zeros((0, len(idle.dofs)))
    index = tuple(match_dofs(effect.location, idle.dofs)[0]) if kind.acts == "sensor_map" else ()
    constants = {p.name: float(effect.values[p.name]) for p in kind.constants if np.isscalar(effect.values[p.name])}
    fixed = {name: float(effect.values[name]) for name in effect.fixed}
    return Term(
        kind,
        effect.location,
        rows,
        int(effect.sign),
        band_hz,
        constants,
        fixed,
        index,
        effect.position,
        effect.direction or None,
    )


def candidates(
    idle: ModalModel,
    responses: Sequence[Dof],
    references: Sequence[Dof],
    band_hz: tuple[float, float],
    kinds: Sequence[str] | None = None,
    places: Sequence[Dof] | None = None,
) -> list[Term]:
    """Every kind of the catalogue at every place it can take.

    Parameters
    ----------
    idle : ModalModel
    responses, references : sequences of Dof
        Measured in the check, in the idle model's senses.
    band_hz : (float, float)
    kinds : sequence of str, optional
        Only these kinds.
    places : sequence of Dof, optional
        Only at these DOFs (pairs: both among them).
    """
    known = {(d.node, d.axis): d for d in idle.dofs}
    seen = tuple(known[(d.node, d.axis)] for d in responses)
    if places is not None:
        wanted = {(d.node, d.axis) for d in places}
        seen = tuple(d for d in seen if (d.node, d.axis) in wanted)
    out: list[Term] = []
    for name, kind in catalogue().items():
        if (kinds is not None and name not in kinds) or kind.level_dependent or kind.acts == "excitation":
            continue
        if kind.kind == "sensor_mass":
            continue  # one run cannot tell it from a mass on the structure: weighed at the end
        if kind.group == "force":
            spots: list[tuple[Dof, ...]] = [(known[(d.node, d.axis)],) for d in references]
        elif kind.places == 0:
            spots = [()]
        elif kind.places == 1:
            if kind.coordinates == "node":
                spots = [(d,) for d in {d.node: d for d in reversed(seen)}.values()]
            else:
                spots = [(d,) for d in seen]
        else:
            spots = list(combinations(seen, 2))
        out += [term_of(Effect(name, spot, band_hz=band_hz), idle, band_hz) for spot in spots]
    return out
