"""Whether the force at a place follows the law of its kind: the same law with a factor that bends and turns over frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.predict import Term
from operando.diagnose.problem import EARNED, Problem, Tried
from operando.diagnose.refit import Fit
from operando.diagnose.sets import SELECT
from operando.diagnose.verdict import separates
from operando.effects.base import EffectKind, Parameter

Array = NDArray[Any]

BEND = Parameter("bend", "", -20.0, 20.0, "linear", 0.0, "part that grows with the square of frequency, at the band's centre")
TURN = Parameter("turn", "", -20.0, 20.0, "linear", 0.0, "imaginary part that grows with frequency, at the band's centre")

ASKED = 6
"""First candidates that are asked, law freed, whether they explain alone what several effects were found for."""


class _Freed(EffectKind):
    """δZ of a kind times 1 + bend·(ω/ω_0)² + turn·iω/ω_0."""

    inner: EffectKind
    centre: float

    def matrix(self, s: Array, values: Mapping[str, Any], size: int = 1) -> Array:
        x = np.asarray(s) / (2j * np.pi * self.centre)
        factor = 1 + values["bend"] * x**2 + 1j * values["turn"] * x
        return np.asarray(self.inner.matrix(s, values, size) * factor[..., None, None])


def freed(term: Term) -> Term:
    """The same place with a law that bends and turns over frequency."""
    kind = term.kind
    made = {
        "kind": kind.kind,
        "places": kind.places,
        "coordinates": kind.coordinates,
        "parameters": (*kind.parameters, BEND, TURN),
        "constants": kind.constants,
        "symmetric": kind.symmetric,
        "inner": kind,
        "centre": float(np.mean(term.band_hz)),
    }
    return replace(term, kind=type("Freed", (_Freed,), made)())


def gain_by_free_law(problem: Problem, fit: Fit) -> tuple[float, Term | None]:
    """Selection misfit with the law of one effect freed over that with all laws as they are, least of all effects, and which.

    A distributed support, an inerter or a moment of inertia can pass for a spring or a mass over most of a band; what is left
    of the misfit then falls once the law may bend.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        The effects accepted.
    """
    here = problem.allowing(fit)
    now = here.misfit(SELECT, fit)
    best, which = 1.0, None
    for k, term in enumerate(fit.terms):
        if term.kind.acts != "dynamic_stiffness":
            continue
        free = freed(term)
        terms, q = list(fit.terms), list(fit.q)
        n = len(term.moving)
        terms[k], q[k] = free, np.concatenate([q[k][:n], [0.0, 0.0], q[k][n:]])
        other = here.joint(terms, q, start=fit)
        ratio = here.misfit(SELECT, other) / now
        if ratio < best:
            best, which = ratio, term
    return best, which


def alone_by_free_law(problem: Problem, fit: Fit, firsts: Sequence[Tried]) -> Term | None:
    """One effect of another law that explains about as much as several found: then each further one has not earned its place.

    Parameters
    ----------
    problem : Problem
    fit : Fit
        The effects accepted.
    firsts : sequence of Tried
        Candidates of the first step, best first.

    Returns
    -------
    Term or None
        The kind and place whose law was freed.
    """
    structural = [t for t in fit.terms if t.kind.acts == "dynamic_stiffness"]
    places = {t.dofs for t in structural}
    if len(structural) < 2 or len(structural) < len(fit.terms) or len(places) < 2:
        return None
    here = problem.allowing(fit)
    now = here.misfit(SELECT, fit)
    asked = [t for t in firsts if t.term.kind.acts == "dynamic_stiffness"][:ASKED]
    for one in asked:
        term, q = one.term, one.fit.q[-1]
        n = len(term.moving)
        alone = here.joint([freed(term)], [np.concatenate([q[:n], [0.0, 0.0], q[n:]])])
        if not separates(now, here.misfit(SELECT, alone), EARNED):
            return term
    return None
