"""Whether a mass found in the check sat there in the operating record too, or came and went with a sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from operando.data import Geometry, ModalModel
from operando.diagnosis.corrected import model_of
from operando.diagnosis.criteria import WITHOUT_SENSOR
from operando.diagnosis.posterior import State
from operando.structure import Model

_NEAR = 0.15  # an operational mode stands for a predicted one within this part of its frequency
_FLOOR = 3e-4  # relative frequency error that operational modes are never trusted beyond


def frequency_misfit(model: ModalModel, operating: ModalModel) -> float:
    """Sum of squared frequency errors over their variances; each operational mode takes the predicted one of the best MAC nearby."""
    n = operating.n_modes
    std = np.zeros(n) if operating.frequency_std_hz is None else operating.frequency_std_hz
    have = {(d.node, d.axis): i for i, d in enumerate(model.dofs)}
    shared = [(i, have[(d.node, d.axis)]) for i, d in enumerate(operating.dofs) if (d.node, d.axis) in have]
    ours, theirs = np.array([i for i, _ in shared], int), np.array([j for _, j in shared], int)
    signs = np.array([operating.dofs[i].sign * model.dofs[j].sign for i, j in shared])
    total = 0.0
    for r in range(n):
        f = operating.frequencies_hz[r]
        near = np.flatnonzero(np.abs(model.terms.frequencies_hz / f - 1) < _NEAR)
        if not near.size:
            continue
        a = operating.shapes[ours, r] * signs
        b = model.terms.shapes[np.ix_(theirs, near)]
        mac = np.abs(np.conj(a) @ b) ** 2 / np.maximum(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2, axis=0), 1e-300)
        k = int(near[int(np.argmax(mac))])
        total += float((model.terms.frequencies_hz[k] - f) ** 2 / (std[r] ** 2 + (_FLOOR * f) ** 2))
    return total


def of_a_sensor(state: State, idle: ModalModel, operating: ModalModel | None, geometry: Geometry | None) -> State:
    """The state with those masses renamed that the operating record knows nothing of.

    The check was measured with every sensor in place; the operational modes tell the structure without what was there in the check
    alone. A mass whose removal brings the predicted frequencies to the operational ones is a sensor's. One operational mode is not
    enough: it may err, and the mass with it.
    """
    if operating is None or operating.n_modes < 2:
        return state
    model = model_of(idle, state, geometry)
    terms = list(state.terms)
    for k, term in enumerate(terms):
        if term.kind != "point_mass" or term.sign < 0 or term.places[0] in state.case.idle.midway:
            continue
        others = tuple(e for i, e in enumerate(model.effects) if i != k)
        without = frequency_misfit(Model(model.idle, others, model.geometry).modes(), operating)
        including = frequency_misfit(model.modes(), operating)
        if without + WITHOUT_SENSOR < including and without < 0.5 * including:
            terms[k] = replace(term, kind="sensor_mass")
    state.x = replace(state.x, terms=tuple(terms))
    state.problem.terms = tuple(terms)
    return state
