"""What a search allows to say: the sets of effects the data cannot tell apart, what would have been seen, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from kinds import KINDS, Effect, candidates, with_one
from model import Case
from posterior import Problem, State, on_validation_lines
from scipy.linalg import cholesky, solve_triangular
from search import EXTRA, SIMPLE, Found, score

SET = 0.95  # probability that the sets together have
MOST_CHI, MOST_ALPHA = 1.5, 0.03  # of the contract
LOWERED = 0.8  # share of the misfit that supported effects take away, for "partial"
SUPPORTED = 0.5  # standard deviation of a log size at which its 95 % interval reaches a third of the size
ONE_SIDED = 1.64  # standard deviations: 95 % of effects of that size are seen


@dataclass
class Verdict:
    """A verdict with its ground."""

    name: str
    why: str
    effects: list[Effect]
    others: list[list[Effect]]  # sets that may stand in the place of the effects
    probability: float  # of the effects
    chi_square: float
    validation_db: float
    unseen: list[float]  # Hz of modes that could move by a half-power width without being seen


def others(found: Found) -> tuple[list[State], float]:
    """States beside the best that make up the 95 % set, without those that only add to it; the probability of the best."""
    best = found.best
    rivals = [s for s in found.pool.values() if not set(best.key) < set(s.key)]
    weights = np.exp([score(s) - score(best) for s in rivals])
    weights /= weights.sum()
    out, total = [], 0.0
    for i in np.argsort(-weights):
        if total < SET and rivals[i] is not best:
            out.append(rivals[i])
        total += weights[i]
    return out, float(weights[rivals.index(best)])


def detectable(case: Case, state: State) -> dict[tuple[str, tuple[int, ...]], float]:
    """Smallest size of each kind at each place that would have been found in 95 % of tests like this one, SI units."""
    at = case.lines.fit
    problem = Problem(case, state.effects, at)
    prediction = problem.predict(state.x)
    scannable = case.scannable(state.z, state.d, state.u, state.effects, at)
    weights = np.sqrt(2 / problem.variance(state.alpha))
    jacobian = problem.rows(prediction.jacobian) * weights[:, None]
    information = jacobian.T @ jacobian
    information[np.diag_indices_from(information)] += problem.precision
    q = solve_triangular(cholesky(information, lower=True), jacobian.T, lower=True)
    w, out = case.lines.w[at], {}
    for kind, places in candidates(case.nodes, state.effects):
        if kind not in SIMPLE:
            continue
        unit = 1e-6
        h = scannable.seen(with_one(scannable.columns, scannable.structure, Effect(kind, places, (float(np.log(unit)),)), w))
        slope = problem.rows(h - scannable.h) * weights / unit
        along = q @ slope
        # nats asked of it: what a further effect must earn, one of so many places and kinds, and two for its prior's width
        asked = EXTRA + np.log(len(KINDS) * case.places(kind)) + 2
        out[kind, places] = float((np.sqrt(2 * asked) + ONE_SIDED) / np.sqrt(max(slope @ slope - along @ along, 1e-300)))
    return out


def unseen(case: Case, least: dict[tuple[str, tuple[int, ...]], float]) -> list[float]:
    """Modes in band that no detectable mass or spring moves by less than a half-power width 2ζf."""
    out = []
    for r in case.modes:
        if not case.band[0] < case.f0[r] < case.band[1]:
            continue
        moves = []
        for (kind, places), size in least.items():
            power = float(np.sum(case.phi0[list(places), r] ** 2))
            if kind == "point_mass":
                moves.append(0.5 * size * power)
            elif kind == "ground_spring":
                moves.append(0.5 * size * power / (2 * np.pi * case.f0[r]) ** 2)
        if min(moves) > 2 * case.zeta0[r]:
            out.append(float(case.f0[r]))
    return out


def supported(state: State) -> bool:
    """Whether the interval of each effect's size excludes zero."""
    std, at = np.sqrt(np.diag(state.covariance)) if state.effects else np.zeros(0), 0
    for effect in state.effects:
        if effect.values:
            least = abs(effect.values[0]) / 2 if effect.kind in ("sensor_gain", "sensor_delay", "global_damping") else SUPPORTED
            if std[at] > least:
                return False
        at += len(effect.values)
    return True


def verdict(case: Case, found: Found, rest: State) -> Verdict:
    """The verdict of the contract; ``rest`` is the idle model on the FRFs at rest."""
    best = found.best
    chi, db = on_validation_lines(case, best)
    rivals, probability = others(found)
    blind = unseen(case, detectable(case, best))
    fits = chi < MOST_CHI and best.alpha <= MOST_ALPHA
    sets = [s.effects for s in rivals]

    def say(name: str, why: str) -> Verdict:
        return Verdict(name, why, best.effects if name not in ("inconclusive", "no_misfit") else [], sets, probability, chi, db, blind)

    if rest.alpha > MOST_ALPHA:
        return say("inconclusive", f"the idle model differs by {100 * rest.alpha:.1f} % from the FRFs at rest themselves")
    if not fits:
        before = on_validation_lines(case, found.empty)[1]
        if best.effects and supported(best) and db**2 < (1 - LOWERED) * before**2:
            return say("partial", "the effects lower the misfit, and something remains")
        return say("unexplained", f"validation lines are left at a chi-square of {chi:.2f} with a discrepancy of {100 * best.alpha:.1f} %")
    if not best.effects:
        if any(s for s in sets):
            return say("inconclusive", "nothing and an effect are as likely")
        if blind:
            return say("inconclusive", f"{len(blind)} modes could move by a half-power width without being seen")
        return say("no_misfit", "nothing is missing that would have been seen")
    if not supported(best) or any(not s for s in sets):
        return say("inconclusive", "an effect is likely, but none is as likely")
    if sets:
        return say("ambiguous", "other effects fit as well")
    return say("explained", "")
