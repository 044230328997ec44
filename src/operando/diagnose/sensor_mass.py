"""Whether a mass found in the check sat there in the operating record too, or came and went with a sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.diagnose.model import Model
from operando.diagnose.refit import Fit
from operando.diagnose.result import effects_of
from operando.diagnose.verdict import one_mode
from operando.effects import catalogue

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem

Array = NDArray[Any]

NEAR = 0.15
"""An operational mode stands for a predicted one within this part of its frequency."""

CLEARLY = 9.0
"""How much less the squared frequency errors over their variances must be without the mass (three standard deviations)."""

HZ_FLOOR = 3e-4
"""Relative frequency error that operational modes are never trusted beyond."""


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
        near = np.flatnonzero(np.abs(model.terms.frequencies_hz / f - 1) < NEAR)
        if not near.size:
            continue
        a = operating.shapes[ours, r] * signs
        b = model.terms.shapes[np.ix_(theirs, near)]
        mac = np.abs(np.conj(a) @ b) ** 2 / np.maximum(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2, axis=0), 1e-300)
        k = int(near[int(np.argmax(mac))])
        total += float((model.terms.frequencies_hz[k] - f) ** 2 / (std[r] ** 2 + (HZ_FLOOR * f) ** 2))
    return total


def of_a_sensor(problem: Problem, fit: Fit, operating: ModalModel | None, geometry: Geometry | None) -> list[int]:
    """Which of the accepted effects are masses that the operating record knows nothing of.

    The check was measured with every sensor in place; the operational modes tell the structure without what was there in the check
    alone. A mass whose removal brings the predicted frequencies to the operational ones is a sensor's.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        Accepted effects.
    operating : ModalModel or None
        Operational modes.
    geometry : Geometry or None
    """
    if operating is None or not operating.n_modes or one_mode(problem.idle):
        return []  # one frequency may err, and the mass with it
    out = []
    effects = effects_of(fit, problem.idle.dofs)
    updated = problem.idle.with_terms(shapes=fit.phi, covariance=None, std=None)
    for k, effect in enumerate(effects):
        if effect.kind != "point_mass" or effect.sign < 0:
            continue
        others = tuple(e for i, e in enumerate(effects) if i != k)
        without = frequency_misfit(Model(updated, others, geometry).modes(), operating)
        including = frequency_misfit(Model(updated, tuple(effects), geometry).modes(), operating)
        if without + CLEARLY < including and without < 0.5 * including:
            out.append(k)
    return out


def renamed(fit: Fit, which: list[int]) -> Fit:
    """The fit with these masses told as masses of sensors."""
    kind = catalogue()["sensor_mass"]
    return replace(fit, terms=tuple(replace(t, kind=kind) if i in which else t for i, t in enumerate(fit.terms)))
