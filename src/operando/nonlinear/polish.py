"""The last word on an accepted law: all of its values moved together, and how far they can be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.effects import kind_of
from operando.nonlinear.laws import LawFit, Motion, law_cost, summed
from operando.nonlinear.run import Real
from operando.nonlinear.search import Case, settled
from operando.nonlinear.steps import Tried
from operando.threads import each

EASY = 0.01
"""Relative change of a value for a difference quotient."""

TURNS, ENOUGH = 4, 1e-3
"""Gauss–Newton steps at most; relative change that ends them."""

FARTHEST = 0.3
"""Relative change of a value in one step, at most."""

TOGETHER, LEAST = 8.0, 0.0015
"""Errors stay together over so many lines; a value is known to this part at best, as the scale of the idle model is."""

SYSTEMATIC, SHARE = 3.0, 0.5
"""Misfit beyond which what is left is the motion's error and not noise; part of what is then left that may lie along the law."""


def free_names(law: LawFit) -> list[str]:
    """Values that a fit may move: those above zero."""
    return [n for n in law.values if law.values[n] > 0]


def linearised(law: LawFit, motions: Sequence[Motion], names: Sequence[str]) -> tuple[Real, Real, float]:
    """Normal equations of relative changes of the values about the law as it stands, and the cost with it."""

    def part(m: Motion) -> tuple[Real, Real, float]:
        base = m.under(law)
        moved = [m.under(replace(law, values=law.values | {n: law.values[n] * (1 + EASY)})) for n in names]
        gram, right, total = m.along.normal(np.stack([base, *((f - base) / EASY for f in moved)]))
        # The error is total − base's own part: what a small change of each value would still take away.
        return gram[1:, 1:], right[1:] - gram[1:, 0], total - 2 * float(right[0]) + float(gram[0, 0])

    return summed(each(part, motions))


def polished(case: Case, tried: Tried) -> Tried:
    """The law with all its values moved together by Gauss–Newton steps on the lines fitted, each with the motion it makes.

    Grids and alternating regressions stop where one value could make up for another. A step counts if it lowers the cost.
    """
    names = free_names(tried.law)
    if len(names) < 2:
        return tried
    law, spot = tried.law, tried.spot
    for _ in range(TURNS):
        gram, right, cost = linearised(law, spot.fit, names)
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        step = np.linalg.lstsq(gram / np.outer(scale, scale), right / scale, rcond=1e-9)[0] / scale
        largest = float(np.max(np.abs(step)))
        step *= min(1.0, FARTHEST / max(largest, 1e-300))
        taken = None
        for share in (1.0, 0.3):
            one = bounded(
                replace(law, values=law.values | {n: law.values[n] * float(np.exp(share * s)) for n, s in zip(names, step, strict=True)})
            )
            if law_cost(one, spot.fit)[0] < cost:
                taken = one
                break
        if taken is None:
            break
        law, spot = taken, settled(spot, case, taken)
        if largest < ENOUGH:
            break
    select, count = law_cost(law, spot.select)
    if not select / count < tried.selection:
        return tried
    validation, n = law_cost(law, spot.validation)
    return Tried(spot, law, select / count, validation / n)


def bounded(law: LawFit) -> LawFit:
    """The law with its values inside the bounds of its kind."""
    limits = {p.name: (p.low, p.high) for p in kind_of(law.kind).parameters}
    inside = {n: float(np.clip(v, *limits[n])) if n in limits else v for n, v in law.values.items()}
    return replace(law, values=inside)


def std_of(tried: Tried) -> dict[str, float]:
    """Standard deviations, from three sources that add up.

    The curvature of the chi-square, for errors that stay together over some lines. What is wrong with the motion of the idle model is
    common to all lines of a run, so the curvature does not show it. It differs between runs, for another drive point and level moves the
    location otherwise: the scatter of the values of each run by itself, validation runs included. And where much more is left than
    noise, some of it may lie along the law in all runs alike: a part of what is left over what the law explains.
    """
    law = tried.law
    names = free_names(law)
    gram, _, cost = linearised(law, tried.spot.fit, names)
    count = sum(m.along.weighted.error.size for m in tried.spot.fit)
    spread = TOGETHER * np.sqrt(np.maximum(np.diag(np.linalg.pinv(gram)) * cost / count, 0))
    apart = own_values(law, tried.spot.whole, names)
    explained = max(law_cost(None, tried.spot.fit)[0] - cost, 1e-300)
    systematic = SHARE * max(cost - SYSTEMATIC * count, 0.0) / explained
    relative = np.sqrt(spread**2 + apart**2 + LEAST**2 + systematic)
    return {n: float(law.values[n] * r) for n, r in zip(names, relative, strict=True)}


def own_values(law: LawFit, motions: Sequence[Motion], names: Sequence[str]) -> Real:
    """Scatter of the values that each run by itself would have, relative, weighted by how well each run knows them."""
    weights, moves = [], []
    for gram, right, _ in each(lambda m: linearised(law, [m], names), motions):
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)
        weights.append(1 / np.maximum(np.diag(inverse), 1e-300))
        moves.append(np.clip(inverse @ right, -1, 1))
    w, d = np.array(weights), np.array(moves)
    return np.asarray(np.sqrt(np.sum(w * d**2, axis=0) / np.maximum(np.sum(w, axis=0), 1e-300)))
