"""What a diagnosis from check FRFs works on: lines in three sets, the idle model as arrays, candidates; and one step of the search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnose.afar import from_afar
from operando.diagnose.levenberg import effect_dofs, weights
from operando.diagnose.missing_mode import missing_mode_candidate
from operando.diagnose.predict import IdleArrays, Term, channel_maps, predict
from operando.diagnose.refit import (
    POOR,
    Fit,
    foreseen,
    honest,
    mean_misfit,
    model_variance,
    predicted,
    refit,
    settled,
)
from operando.diagnose.scan import COLUMN_DOUBT, Candidate, Reduced, channel_candidates, fit_place, reduce_place, scan_weights
from operando.diagnose.sets import FIT, JUDGE, SELECT, CheckLines
from operando.diagnose.shapes import shape_prior
from operando.threads import each

Array = NDArray[Any]

SHORT_LIST = 14
"""Candidates of the scan that are refitted."""

ELSEWHERE = 4.0
"""The best candidate of a place is on the short list where its scan is within this factor of the best of all."""

CLEAR = 1.5
"""Mean misfit, columns never driven allowed for, below which sizes alone decide what is refitted with its shapes."""

FURTHER = 2
"""The best so many are fitted to the end where sizes alone do not decide."""

REFITTED, NEAR = 5, 15.0
"""At most so many of them are refitted with the shapes at their places, and only within this factor of the best."""

EARNED = 0.10
"""An effect must lower the selection misfit by more than this part (contract, "Verdicts")."""

PARSIMONY = 0.02
"""Within this part of the best selection misfit the fewest parameters win."""


@dataclass(frozen=True)
class Tried:
    """A candidate after its refit with all accepted effects.

    Parameters
    ----------
    term : Term
    fit : Fit
        All effects together, the candidate last.
    selection : float
        Misfit on the select set.
    blocks : (n_blocks,) array
        The same block by block.
    """

    term: Term
    fit: Fit
    selection: float
    blocks: Array


@dataclass
class Problem:
    """Check lines and idle model.

    Parameters
    ----------
    idle : ModalModel
    lines : CheckLines
    own : array like ``lines.data``
        The idle model's own variance (receptance).
    templates : list of Term
        Candidates before anything is fitted.
    say : callable, optional
        Told of progress.
    extra : int
        DOFs at the end of the idle model that nothing was measured at: places between sensors.
    """

    idle: ModalModel
    lines: CheckLines
    own: Array
    templates: list[Term]
    say: Callable[[str], None] | None = None
    extra: int = 0
    arrays: IdleArrays = field(init=False)
    _allowing: dict[int, Problem] = field(init=False, default_factory=dict, repr=False)
    _kept: Fit | None = field(init=False, default=None, repr=False)

    def __post_init__(self) -> None:
        self.arrays = IdleArrays.of(self.idle)
        self.sets = {g: self.lines.where(self.lines.group == g) for g in (FIT, SELECT, JUDGE)}
        self.owns = {g: self.own[self.lines.group == g] for g in (FIT, SELECT, JUDGE)}

    def empty(self) -> Fit:
        """The idle model alone."""
        return Fit((), (), self.arrays.phi, shape_prior(self.idle, np.zeros(0, int)), cost=np.inf)

    def misfit(self, group: int, fit: Fit, spread: bool = False) -> float:
        """Misfit on one set; with what the fit left undetermined in the variance, if wanted."""
        data, extra = predicted(self.arrays, self.sets[group], fit, spread)
        return mean_misfit(self.sets[group], self.owns[group], data, extra)

    def by_block(self, fit: Fit) -> Array:
        """Misfit on each block of the select set."""
        lines, own = self.sets[SELECT], self.owns[SELECT]
        data, _ = predicted(self.arrays, lines, fit)
        w = weights(lines, own)
        value, count = np.sum(w * np.abs(lines.data - data) ** 2, axis=(1, 2)), np.sum(w > 0, axis=(1, 2))
        return np.array([np.sum(value[lines.block == b]) / max(np.sum(count[lines.block == b]), 1) for b in np.unique(lines.block)])

    def joint(
        self, terms: Sequence[Term], q: Sequence[Array], groups: Sequence[int] = (FIT,), start: Fit | None = None, shapes: bool = True
    ) -> Fit:
        """All effects together with the shape values at their DOFs (or their sizes alone)."""
        prior = start.prior if start is not None else shape_prior(self.idle, effect_dofs(terms) if shapes else np.zeros(0, int))
        mask = np.isin(self.lines.group, groups)
        z = start.z if start is not None else None
        return refit(self.arrays, self.lines.where(mask), self.own[mask], terms, q, prior, z, 12 if start is not None else 7, self.idle)

    def settled(self, fit: Fit) -> Fit:
        """The last fit, on the fit and select lines, with the covariance that its errors have."""
        mask = np.isin(self.lines.group, (FIT, SELECT))
        return settled(self.idle, self.arrays, self.lines.where(mask), self.own[mask], fit)

    def allowing(self, fit: Fit) -> Problem:
        """The problem with the own variance of the model with these effects: what is added, or competes, is judged by that."""
        known = self._allowing.get(id(fit))
        if known is None:
            fitted = honest(self.idle, self.arrays, self.sets[FIT], self.owns[FIT], fit)
            own = model_variance(self.idle, self.arrays, self.lines, fitted)
            known = self.with_own(np.maximum(self.own, own))
            self._allowing.clear()
            self._allowing[id(fit)] = known
            self._kept = fit  # the id stays its own as long as this lives
        return known

    def doubting(self, fit: Fit) -> Problem:
        """The problem with the scan's doubt of the columns, a part of what the model with these effects lacks, in the variance."""
        lacks = self.lines.data - predict(self.arrays.with_phi(fit.phi), self.lines, fit.terms, fit.q).data
        return self.with_own(np.maximum(self.own, (COLUMN_DOUBT * np.abs(lacks)) ** 2))

    def with_own(self, own: Array) -> Problem:
        """The same problem judged with another variance of the model."""
        return Problem(self.idle, self.lines, own, self.templates, self.say, self.extra)

    def judged(self) -> Problem:
        """The problem once all is chosen and judged: the judge lines are lines as others."""
        group = np.where(self.lines.group == JUDGE, SELECT, self.lines.group)
        return Problem(self.idle, replace(self.lines, group=group), self.own, self.templates, self.say, self.extra)

    def tried(self, fit: Fit) -> Tried:
        """A fit with its figures on the select set."""
        return Tried(fit.terms[-1], fit, self.misfit(SELECT, fit), self.by_block(fit))


def full_receptance(arrays: IdleArrays, lines: CheckLines, fit: Fit) -> tuple[Array, Array, Array]:
    """Of the structure with the accepted effects: between all DOFs; at the measured pairs as the channels see it; data put right."""
    here = arrays.with_phi(fit.phi)
    m = arrays.phi.shape[0]
    every = replace(
        lines,
        responses=np.arange(m),
        references=np.arange(m),
        data=np.zeros((lines.hz.size, m, m), complex),
        variance=np.ones((lines.hz.size, m, m)),
    )
    structural = [(t, v) for t, v in zip(fit.terms, fit.q, strict=True) if t.kind.acts != "sensor_map"]
    full = predict(here, every, [t for t, _ in structural], [v for _, v in structural]).data
    seen = predict(here, lines, fit.terms, fit.q).data
    factor, order = channel_maps(lines, fit.terms, [t.values(v) for t, v in zip(fit.terms, fit.q, strict=True)])
    data = lines.data if factor is None else lines.data / factor
    right = np.empty_like(data)
    right[:, order] = data
    return full, seen, right


def scan(problem: Problem, fit: Fit) -> list[Candidate]:
    """All kinds at all places beside the accepted effects, ranked by their error on the fit lines, model error allowed for."""
    lines, own = problem.sets[FIT], problem.owns[FIT]
    full, _, data = full_receptance(problem.arrays, lines, fit)
    right = replace(lines, data=data)
    model = full[np.ix_(np.arange(lines.hz.size), lines.responses, lines.references)]
    weight = scan_weights(right, model, own)
    have = {t.key for t in fit.terms}
    fresh = [t for t in problem.templates if t.key not in have]
    reduced: dict[bytes, Reduced] = {}
    out: list[Candidate] = []
    for t in fresh:
        if t.kind.acts != "dynamic_stiffness":
            continue
        key = t.rows.tobytes()
        if key not in reduced:
            reduced[key] = reduce_place(full, t.rows, right, data, weight)
        found = fit_place(t, reduced[key], right)
        if found is not None:
            out.append(found)
    out += channel_candidates([t for t in fresh if t.kind.acts == "sensor_map"], right, model, data, weight)
    out += [c for t in fresh if t.kind.acts == "modal_change" for c in [global_candidate(problem, t, fit, lines, weight)] if c]
    for t in fresh:
        if t.kind.acts == "added_mode":
            one = missing_mode_candidate(t, problem.arrays.phi.shape[0], right, data - model, weight)
            out += [one] if one else []
    return sorted(out, key=lambda c: c.cost)


def global_candidate(problem: Problem, term: Term, fit: Fit, lines: CheckLines, weight: Array) -> Candidate | None:
    """A change of the whole structure: coarse search over its one number, then finer ones round the best."""
    if term.size != 1:
        return None
    low, high = (float(v[0]) for v in term.bounds())
    here = problem.arrays.with_phi(fit.phi)

    def cost(v: float) -> float:
        data = predict(here, lines, [*fit.terms, term], [*fit.q, np.array([v])]).data
        return float(np.sum(weight * np.abs(lines.data - data) ** 2) / max(int(np.sum(weight > 0)), 1))

    grid = np.unique(np.r_[-np.geomspace(1e-3, -low, 14), np.geomspace(1e-3, high, 18)]) if low < 0 else np.linspace(low, high, 30)
    best = float(grid[int(np.argmin([cost(float(v)) for v in grid]))])
    width = 0.3 * abs(best) + 1e-4
    for _ in range(14):
        trio = [float(np.clip(v, low, high)) for v in (best - width, best, best + width)]
        j = int(np.argmin([cost(v) for v in trio]))
        best = trio[j]
        if j == 1:
            width /= 2
    return Candidate(term, np.array([best]), cost(best))


def shortlist(found: Sequence[Candidate], count: int = SHORT_LIST) -> list[Candidate]:
    """The best of the scan, and the best of each kind and at each place that is not far off."""
    if not found:
        return []
    out = list(found[:count])
    kinds = {c.term.kind.kind for c in out}
    places = {c.term.dofs for c in out}
    for c in found[count:]:
        new = c.term.kind.kind not in kinds or (
            c.term.kind.places == 1 and c.term.dofs not in places and c.cost < ELSEWHERE * found[0].cost
        )
        if new and c.cost < 30 * found[0].cost + 1:
            kinds.add(c.term.kind.kind)
            places.add(c.term.dofs)
            out.append(c)
    return [c for c in out if c.cost < 100 * found[0].cost + 10]


def step(problem: Problem, fit: Fit) -> tuple[list[Tried], Problem]:
    """One more effect: scan, refit the short list with all accepted ones, rank by the select set.

    Sizes are refitted first on the idle model's shapes; only what then comes near the best is refitted with its shapes.

    Returns
    -------
    tried : list of Tried
    judged_by : Problem
        That with the variance by which all of them were judged.
    """
    found = scan(problem, fit)
    first = each(lambda c: problem.joint([*fit.terms, c.term], [*fit.q, c.q], shapes=False), shortlist(found))
    lines, own = problem.sets[FIT], problem.owns[FIT]
    first.sort(key=lambda f: f.cost)
    clear = not first or first[0].cost < 2 * CLEAR * lines.data.size
    if not clear:
        # Nothing fits with the columns as they are: which could, if what the idle model leaves open about its place were free?
        costs = each(lambda f: foreseen(problem.arrays, lines, own, f, shape_prior(problem.idle, effect_dofs(f.terms))), first)
        first = sorted((replace(f, cost=cost) for f, cost in zip(first, costs, strict=True)), key=lambda f: f.cost)
    near = [f for k, f in enumerate(first[:REFITTED]) if k < 2 or f.cost < NEAR * first[0].cost]
    tried = [problem.tried(f) for f in (*each(lambda f: with_shapes(problem, f), near), *first[len(near) :])]
    if not tried:
        return [], problem
    best = min(tried, key=lambda t: t.selection)
    if not clear and best.term.kind.places == 1:
        # Kinds at one place differ by little where its column is hardly known: each gets its chance there.
        have = {t.term.kind.kind for t in tried if t.term.dofs == best.term.dofs and t.fit.prior.size}
        same = [c for c in found if c.term.dofs == best.term.dofs and c.term.kind.places == 1 and c.term.kind.kind not in have]
        tried = [t for t in tried if t.term.dofs != best.term.dofs or t.term.kind.kind in have]
        tried += [problem.tried(with_shapes(problem, problem.joint([*fit.terms, c.term], [*fit.q, c.q], shapes=False))) for c in same]
    ranked, here = by_the_best(problem, tried)
    if clear:
        return ranked, here
    if ranked[0].selection > POOR and not fit.terms:
        more = [problem.tried(f) for f in from_afar(problem, found)]
        if more:
            again = {t.term.key for t in more}
            ranked, here = by_the_best(problem, [*more, *(t for t in tried if t.term.key not in again)])
    poor = ranked[0].selection > POOR
    if poor:
        # None of them is all that is missing. What the lines known best say of a model that lacks something ranks nothing.
        here = here.doubting(fit)
        ranked = sorted((here.tried(t.fit) for t in tried), key=lambda t: t.selection)
    # Far from where they started, the best few may not have come to the end of their fit.
    weighing = here if poor else problem
    for k, t in enumerate(ranked[:FURTHER]):
        ranked[k] = min(t, here.tried(weighing.joint(t.fit.terms, t.fit.q, start=t.fit)), key=lambda t: t.selection)
    ranked.sort(key=lambda t: t.selection)
    return ranked, here


def by_the_best(problem: Problem, tried: Sequence[Tried]) -> tuple[list[Tried], Problem]:
    """All by one variance, that of the model with the best of them: the idle model's own says too little of columns never driven."""
    here = problem.allowing(min(tried, key=lambda t: t.selection).fit)
    return sorted((here.tried(t.fit) for t in tried), key=lambda t: t.selection), here


def with_shapes(problem: Problem, fit: Fit) -> Fit:
    """A fit of sizes refitted with the shapes at its places."""
    if problem.say:
        problem.say(f"refit {fit.terms[-1].kind.kind} at {', '.join(map(str, fit.terms[-1].dofs)) or 'no place'}")
    return problem.joint(fit.terms, fit.q)


def choose(tried: Sequence[Tried]) -> Tried:
    """Parsimony: within 2 % of the best the fewest parameters, then a fault of the measurement before physics."""
    near = [t for t in tried if t.selection <= (1 + PARSIMONY) * tried[0].selection]
    return min(near, key=lambda t: (t.term.size, t.term.kind.group == "structure", t.selection))
