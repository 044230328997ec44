"""Kind-free localisation and the picture of the dynamic stiffness at a place.

With e = H0·f − x, one force s(ω) at a place b explains s = bᴴH0ᴴWe/(bᴴH0ᴴWH0b) of it, line by line; places are ranked by what remains.
δz(ω) = s/(bᵀx) is the dynamic stiffness a linear effect there would have: flat for a spring, −ω² for a mass, iω for a damper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.places import term_of
from operando.diagnose.problem import Problem, full_receptance
from operando.diagnose.refit import Fit
from operando.diagnose.scan import scan_weights
from operando.effects import Effect

Array = NDArray[Any]


def explained_part(full: Array, rows: Array, error: Array, weight: Array, responses: Array) -> tuple[Array, Array]:
    """Force spectrum of one place (lines, references) and what remains of the weighted error on each line."""
    u = (full[:, responses, :] @ rows)[:, :, None]
    power = np.sum(weight * np.abs(u) ** 2, axis=1)
    force = np.sum(weight * np.conj(u) * error, axis=1) / np.maximum(power, 1e-300)
    return force, np.sum(weight * np.abs(error - u * force[:, None, :]) ** 2, axis=(1, 2))


def localise(problem: Problem, effects: Sequence[Effect], fit: Fit) -> dict[str, Any]:
    """Places ranked by what a force of any kind there leaves of the error; δz(ω) at the accepted effect (else at the best place)."""
    lines, own = problem.lines, problem.own
    empty = problem.empty()
    full, _, _ = full_receptance(problem.arrays, lines, empty)
    model = full[np.ix_(np.arange(lines.hz.size), lines.responses, lines.references)]
    weight = scan_weights(lines, model, own)
    error = model - lines.data
    total = float(np.sum(weight * np.abs(error) ** 2))
    m = problem.arrays.phi.shape[0]
    places: list[tuple[tuple[int, ...], Array]] = [((i,), np.eye(m)[i]) for i in lines.responses]
    places += [((i, j), np.eye(m)[i] - np.eye(m)[j]) for i, j in combinations(lines.responses, 2)]
    ranked = []
    for index, row in places:
        _, rest = explained_part(full, row, error, weight, lines.responses)
        ranked.append({"location": [str(problem.idle.dofs[i]) for i in index], "remains": float(np.sum(rest) / max(total, 1e-300))})
    ranked.sort(key=lambda r: r["remains"])  # type: ignore[arg-type,return-value]
    return {"places": ranked[:20], "dynamic_stiffness": [p for e in effects for p in [_picture(problem, e, effects, fit)] if p]}


def _picture(problem: Problem, effect: Effect, effects: Sequence[Effect], fit: Fit) -> dict[str, Any] | None:
    """δz(ω) at one effect's place with the others in the model, and the fitted law."""
    k = list(effects).index(effect)
    term = fit.terms[k]
    if term.kind.acts != "dynamic_stiffness" or term.kind.coordinates == "separate" or term.position is not None:
        return None
    others = replace(
        fit,
        terms=tuple(t for i, t in enumerate(fit.terms) if i != k),
        q=tuple(v for i, v in enumerate(fit.q) if i != k),
        covariance=np.zeros((0, 0)),
    )
    lines = problem.lines
    full, _, data = full_receptance(problem.arrays, lines, others)
    model = full[np.ix_(np.arange(lines.hz.size), lines.responses, lines.references)]
    right = replace(lines, data=data)
    weight = scan_weights(right, model, problem.own)
    row = term.rows[0]
    force, _ = explained_part(full, row, model - data, weight, lines.responses)
    x = np.tensordot(data, row[lines.responses], axes=(1, 0))
    u = full[:, lines.responses, :] @ row
    gain = np.sum(weight * np.abs(u[:, :, None]) ** 2, axis=1)
    z = np.sum(gain * np.conj(x) * force, axis=1) / np.maximum(np.sum(gain * np.abs(x) ** 2, axis=1), 1e-300)
    law = term.stiffness(1j * lines.omega, term.values(fit.q[k]))[:, 0, 0]
    order = np.argsort(lines.hz)
    return {
        "location": [str(d) for d in term.dofs],
        "frequency_hz": lines.hz[order].tolist(),
        "real": z.real[order].tolist(),
        "imag": z.imag[order].tolist(),
        "law_real": law.real[order].tolist(),
        "law_imag": law.imag[order].tolist(),
        "unit": "N/m",
    }


__all__ = ["explained_part", "localise", "term_of"]
