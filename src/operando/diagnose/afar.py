"""Candidates where the idle model hardly knows the columns of the places: no scan can rank them, each is fitted on a few lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.levenberg import effect_dofs
from operando.diagnose.predict import predict
from operando.diagnose.refit import Fit, refit
from operando.diagnose.scan import Candidate
from operando.diagnose.sets import FIT, CheckLines
from operando.diagnose.shapes import by_directions, shape_prior
from operando.threads import each

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem

Array = NDArray[Any]

HARDLY = 0.15
"""Relative standard deviation of a column above which a scan says little of its place (0.05 at most with three references)."""

LINES = 24
"""Lines that each candidate is fitted on."""

STEPS = 8
"""Iterations of each pass of these fits."""

KEPT = 3
"""Candidates of the lowest cost that are fitted on all lines."""


def hardly_known(problem: Problem, dofs: Array) -> Array:
    """DOFs whose columns the idle model knows worse than a scan can bear, of those given."""
    lines = _few(problem)[0]
    out = []
    for dof in dofs:
        prior = shape_prior(problem.idle, np.array([dof]))
        shape = (lines.hz.size, lines.responses.size, 1)
        column = replace(lines, references=np.array([dof]), data=np.zeros(shape, complex), variance=np.ones(shape))
        p = predict(problem.arrays, column, (), ())
        spread = float(np.sum(np.abs(by_directions(p, column, prior.root)) ** 2)) if prior.size else 0.0
        if spread > HARDLY**2 * float(np.sum(np.abs(p.data) ** 2)):
            out.append(int(dof))
    return np.array(out, int)


def from_afar(problem: Problem, found: Sequence[Candidate]) -> list[Fit]:
    """The best of all candidates at places hardly known, fitted together with what is not known of these, as the first effect.

    Parameters
    ----------
    problem : Problem
    found : sequence of Candidate
        All candidates of a scan.

    Returns
    -------
    list of Fit
        On all lines of the fit set; none where the columns of all places are known well enough for a scan.
    """
    structural = [c for c in found if c.term.kind.acts == "dynamic_stiffness"]
    unknown = set(hardly_known(problem, effect_dofs([c.term for c in structural])).tolist())
    there = [c for c in structural if unknown & set(effect_dofs([c.term]).tolist())]
    if not there:
        return []
    if problem.say:
        problem.say(f"{len(there)} candidates at {len(unknown)} places that the idle model hardly knows")
    return on_few_lines(problem, there)


def on_few_lines(problem: Problem, candidates: Sequence[Candidate]) -> list[Fit]:
    """The best of these as the first effect, each fitted on a few lines together with what is not known of its places.

    Parameters
    ----------
    problem : Problem
    candidates : sequence of Candidate

    Returns
    -------
    list of Fit
        On all lines of the fit set, at most three.
    """
    lines, own = _few(problem)

    def roughly(c: Candidate) -> Fit:
        return refit(problem.arrays, lines, own, [c.term], [c.q], shape_prior(problem.idle, effect_dofs([c.term])), steps=STEPS)

    rough = sorted(each(roughly, candidates), key=lambda f: f.cost)
    out = []
    for f in rough[:KEPT]:
        both = (problem.joint(f.terms, f.q), problem.joint(f.terms, f.q, start=f))
        out.append(min(both, key=lambda g: g.cost))
    return out


def _few(problem: Problem) -> tuple[CheckLines, Array]:
    """A few lines of the fit set, and the idle model's own variance there."""
    lines, own = problem.sets[FIT], problem.owns[FIT]
    every = np.zeros(lines.hz.size, bool)
    every[:: max(1, lines.hz.size // LINES)] = True
    return lines.where(every), own[every]
