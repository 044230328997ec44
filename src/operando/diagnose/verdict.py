"""What the data cannot tell apart (contract, "Verdicts")."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from operando.data import Geometry, ModalModel
from operando.diagnose.predict import Term
from operando.diagnose.refit import POOR
from operando.diagnose.sets import SELECT

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem, Tried
    from operando.diagnose.refit import Fit

FURTHER_PART = 0.8
"""A further candidate that brings the selection misfit below this part of it says that something is still missing."""

ALIKE, ALIKE_Z, ALIKE_AT_MOST = 0.02, 2.0, 0.15
"""Alike: selection misfit within 2 %, or paired-block z below 2 and within 15 %."""


HOPELESS = 100.0
"""Selection misfit with all effects found above which it is idle to ask which of them could be exchanged."""

ONE_MODE = 0.1
"""With one mode in band kinds differ only by what lies outside of it, which is known least: whatever explains all but this part, or is no
poor fit, counts as alike."""


def separates(new: float, old: float, part: float) -> bool:
    """Whether ``new`` lies below ``old`` by more than ``part`` of it."""
    return new < (1 - part) * old


def paired_z(one: np.ndarray, other: np.ndarray) -> float:
    """Mean difference of two sets of block misfits over its standard error."""
    d = other - one
    error = float(np.std(d, ddof=1) / np.sqrt(d.size)) if d.size > 1 else np.inf
    return float(np.mean(d) / error) if error > 0 else (0.0 if np.allclose(d, 0) else np.inf)


def alike(best: Tried, other: Tried) -> bool:
    """Whether the select set cannot tell two candidates apart."""
    ratio = other.selection / best.selection - 1
    return ratio < ALIKE or (ratio < ALIKE_AT_MOST and paired_z(best.blocks, other.blocks) < ALIKE_Z)


def same_place(a: Term, b: Term) -> bool:
    """Whether two terms act at the same DOFs, or at the same place between sensors."""
    return a.position == b.position and {(d.node, d.axis) for d in a.dofs} == {(d.node, d.axis) for d in b.dofs}


def nested(a: Term, b: Term) -> bool:
    """Whether one kind contains the other at the same place: then it fits as well without saying anything else."""
    return same_place(a, b) and (a.kind.kind in b.kind.contains or b.kind.kind in a.kind.contains)


def spacing(geometry: Geometry | None) -> float:
    """Median distance from a sensor to its nearest neighbour [m]; 0 without geometry."""
    if geometry is None or len(geometry.nodes) < 2:
        return 0.0
    x = geometry.coordinates
    d = np.linalg.norm(x[:, None] - x[None], axis=2)
    np.fill_diagonal(d, np.inf)
    near = d.min(axis=1)
    return float(np.median(near[near > 0])) if np.any(near > 0) else 0.0


def distance(a: Term, b: Term, geometry: Geometry | None) -> float:
    """Largest way between the places of two terms of one kind, paired as is nearest [m]; infinite where it is not known."""
    if same_place(a, b):
        return 0.0
    if geometry is None:
        return np.inf
    one, two = _points(a, geometry), _points(b, geometry)
    if one is None or two is None or len(one) != len(two):
        return np.inf
    ways = [max(float(np.linalg.norm(p - q)) for p, q in zip(one, order, strict=True)) for order in permutations(two)]
    return min(ways, default=0.0)


def _points(term: Term, geometry: Geometry) -> list[np.ndarray] | None:
    """Where a term acts [m], or None where that is not known."""
    if term.position is not None:
        return [np.array(term.position)]
    points = [geometry.position(d.node) for d in term.dofs]
    known = [p for p in points if p is not None]
    return known if len(known) == len(points) else None


def one_mode(idle: ModalModel) -> bool:
    """Whether no more than one mode lies in the band."""
    return int(np.sum(np.asarray(idle.in_band))) <= 1


def in_the_end(problem: Problem, final: Fit, accepted: Tried, other: Tried) -> tuple[Tried, Tried]:
    """All effects together, and the same with another candidate in the stead of an accepted one, judged alike."""
    k = next((i for i, t in enumerate(final.terms) if t.key == accepted.term.key), len(final.terms) - 1)
    terms, q = list(final.terms), list(final.q)
    terms[k], q[k] = other.term, other.fit.q[-1]
    judged = problem.allowing(final)
    return judged.tried(final), judged.tried(problem.joint(terms, q))


def ambiguous_with(problem: Problem, history: Sequence[tuple[Tried, list[Tried]]], geometry: Geometry | None) -> tuple[list[Tried], bool]:
    """Candidates as good as an accepted one, and whether one of them is another kind or more than a sensor spacing away."""
    out, other = [], False
    idle = problem.idle
    alone = one_mode(idle)
    start = problem.misfit(SELECT, problem.empty()) if alone else 0.0
    limit = spacing(geometry) * 1.05
    accepted = [best.term.key for best, _ in history]
    final = history[-1][0]
    hopeless = len(history) > 1 and problem.allowing(final.fit).misfit(SELECT, final.fit) > HOPELESS
    for best, tried in history:
        for t in tried:
            as_good = alike(best, t) or (alone and t.selection < max(ONE_MODE * start, POOR))
            if t.term.key in accepted or not as_good or nested(best.term, t.term):
                continue
            if len(history) > 1 and best is not final and (hopeless or not alike(*in_the_end(problem, final.fit, best, t))):
                continue  # as good only as long as the effects found later were missing
            out.append(t)
            if t.term.kind.kind != best.term.kind.kind or distance(best.term, t.term, geometry) > limit:
                other = True
    return out, other
