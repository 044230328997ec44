"""Which effects are missing: scans, moves, and what the search ends with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from kinds import GLOBAL, LINEAR_SCALE, ONE_PLACE, STRUCTURAL, TWO_PLACES, Effect, candidates, with_one
from model import Case, Scannable
from posterior import Problem, State, approach, fit, names, update_spreads
from scipy.linalg import cholesky, solve_triangular

ROBUST_ALPHA, ROBUST = 0.02, 0.05
"""Above this discrepancy of a state the scan is robust, and about the idle model as it is: under a loose one a linear scan absorbs all."""
EXPLAINED_ALPHA = 0.03  # below, spreads of the nuisance are estimated and further effects tested
STRAINED = 4.0
"""Mean square of a part of the nuisance, in its spreads, from which it stands for something else: that state teaches no spreads."""
FITTED, APPROACHED, BEAM = 3, 6, 3
PROMOTED = 3.0  # standard deviations of a nuisance from which the effect of its name is tried
EXTRA = 5.0  # nats that a further effect must earn
SIMPLE = (*ONE_PLACE, *TWO_PLACES)
SMALL = 6.0  # e-folds below the least size of a kind where the slope of its response is taken
OTHERS, CLOSE = 5, 10.0  # of what may stand in the place of an effect: so many are fitted, where their scan is within so many nats


@dataclass
class Found:
    """What a search ends with."""

    best: State
    empty: State
    pool: dict[tuple, State]


def at_size(case: Case, kind: str, places: tuple[int, ...], count: int) -> list[Effect]:
    """Trial sizes of a kind at a place."""
    if kind in ("channel_swap", "sensor_polarity"):
        return [Effect(kind, places)]
    if kind == "sensor_gain":
        return [Effect(kind, places, (v,)) for v in (-1, -0.3, -0.1, -0.03, 0.03, 0.1, 0.3, 1)]
    if kind == "sensor_delay":
        unit = 1 / (2 * np.pi * case.band[1])
        return [Effect(kind, places, (v * unit,)) for v in (-1, -0.3, -0.1, 0.1, 0.3, 1)]
    if kind == "global_damping":
        return [Effect(kind, places, (v,)) for v in (-0.7, -0.3, -0.1, 0.1, 0.3, 0.7)]
    if kind == "global_stiffness":
        sizes = (0.002, 0.003, 0.005, 0.008, 0.013, 0.02, 0.03, 0.05, 0.08, 0.13)
        return [Effect(kind, places, (float(np.log(v)),), sign) for v in sizes for sign in (1, -1)]
    low, high = case.size_range(kind, places)
    if kind == "tuned_absorber":
        at = np.linspace(*np.log(case.band), 40)
        return [Effect(kind, places, (s, f, z)) for s in np.linspace(low, high, 4) for f in at for z in np.log((0.01, 0.05))]
    return [Effect(kind, places, (s,), sign) for s in np.linspace(low - 0.5, high + 0.5, count) for sign in (1, -1)]


def with_effect(case: Case, state: Scannable, columns: np.ndarray, effect: Effect, w: np.ndarray) -> np.ndarray | None:
    """FRFs with one effect more; None for those of the whole structure, which a low-rank update does not give."""
    if effect.kind in STRUCTURAL:
        return state.seen(with_one(columns, state.structure, effect, w))
    if effect.kind in GLOBAL:
        return None
    h = state.h.copy()
    at = [int(np.flatnonzero(state.order == i)[0]) for i in effect.places]
    if effect.kind == "channel_swap":
        h[:, at] = h[:, at[::-1]]
    else:
        factor = {"sensor_gain": lambda: np.exp(effect.values[0]), "sensor_polarity": lambda: -1.0}
        h[:, at[0]] *= factor[effect.kind]() if effect.kind in factor else np.exp(-1j * w * effect.values[0])[:, None]
    return h


def robust_scan(case: Case, effects: list[Effect], z: np.ndarray, d: np.ndarray, u: np.ndarray) -> list[tuple[float, Effect, bool]]:
    """Candidates by a robust misfit, without freeing anything; once more without what residual masses give between undriven places."""
    at = case.lines.fit
    w, measured = case.lines.w[at], case.lines.h[at]
    state = case.scannable(z, d, u, effects, at)
    noise = case.lines.variance[at] + ROBUST**2 * case.lines.level[at] ** 2

    def score(h: np.ndarray) -> float:
        return -float(np.sum(np.log1p(np.abs(measured - h) ** 2 / noise)))

    variants = [(False, state.columns)]
    if not effects and case.below.size:
        rest = case.rest_columns(case.below, list(range(case.n_dofs)), w) * case.undriven
        own = np.zeros_like(rest)
        i = np.arange(case.n_dofs)
        own[:, i, i] = -np.sum(case.phi0[:, case.below] ** 2, axis=1) * case.undriven / w[:, None] ** 2
        variants.append((True, state.columns - rest - own))
    out = []
    for cut, columns in variants:
        for kind, places in candidates(case.nodes, effects):
            if cut and not (kind in STRUCTURAL and case.undriven[list(places)].all()):
                continue
            best = (-np.inf, Effect(kind, places))
            for effect in at_size(case, kind, places, 24):
                with np.errstate(all="ignore"):
                    h = with_effect(case, state, columns, effect, w)
                    h = case.predict(z, d, u, [*effects, effect], at, derivatives=False).h if h is None else h
                    value = score(h)
                if value > best[0]:
                    best = value, effect
            out.append((*best, cut))
    return sorted(out, key=lambda row: -row[0])


@dataclass
class Candidate:
    """An effect by its evidence in a scan, and where z, d and u are to start with it."""

    evidence: float
    effect: Effect
    fixed: np.ndarray


def linear_scan(case: Case, state: State, *, fitted: bool = True, stride: int = 2, top: int = 24) -> tuple[list[Candidate], float]:
    """Candidates by the evidence of one more effect with everything else free at first order, and the same of none.

    Masses, springs, dampers and gyroscopic coupling by the slope of the response at size zero (score test): where nuisance stands for an
    effect that moves a mode by its half-power width, the response to its size as it is does not undo that, but the slope exchanges one for
    the other where the peaks are. Others by their responses to trial sizes, as all are about a state that was not fitted.
    """
    at = case.lines.fit[::stride]
    w, measured = case.lines.w[at], case.lines.h[at]
    prediction = case.predict(state.z, state.d, state.u, state.effects, at)
    scannable = case.scannable(state.z, state.d, state.u, state.effects, at)
    problem = Problem(case, state.effects, at)
    weights = np.sqrt(2 * stride / problem.variance(state.alpha))
    jacobian = problem.rows(prediction.jacobian) * weights[:, None]
    information = jacobian.T @ jacobian
    fixed = state.fixed
    information[np.diag_indices_from(information)] += np.concatenate([np.ones(fixed), np.full(state.x.size - fixed, 1e-2)])
    lower = cholesky(information, lower=True)
    q = solve_triangular(lower, jacobian.T, lower=True)
    base = problem.rows(measured) * weights + jacobian[:, :fixed] @ state.x[:fixed]
    single = q.astype(np.float32)

    def residual(effect: Effect) -> np.ndarray:
        with np.errstate(all="ignore"):
            h = with_effect(case, scannable, scannable.columns, effect, w)
            h = case.predict(state.z, state.d, state.u, [*state.effects, effect], at, derivatives=False).h if h is None else h
        return base - problem.rows(h) * weights

    def costs(effects: list[Effect]) -> np.ndarray:
        r = np.stack([residual(e) for e in effects], 1)
        return np.nan_to_num(0.5 * (np.sum(r**2, 0) - np.sum((single @ r.astype(np.float32)).astype(float) ** 2, 0)), nan=np.inf)

    found: list[tuple[float, Effect]] = []
    for kind, places in candidates(case.nodes, state.effects):
        if fitted and kind in SIMPLE:
            continue
        grid = at_size(case, kind, places, 8)
        score = [case.log_prior(e) for e in grid] - costs(grid)
        order = np.argsort(-score)
        found.append((float(score[order[0]]), grid[order[0]]))
        if kind == "tuned_absorber":  # a second start at another frequency
            far = [j for j in order[1:40] if abs(grid[j].values[1] - grid[order[0]].values[1]) > 0.1][:1]
            found += [(float(score[j]), grid[j]) for j in far]
    found.sort(key=lambda row: -row[0])
    chosen, of_kind = [], {}
    for _, effect in found:
        if len(chosen) < top or of_kind.get(effect.kind, 0) < 2:
            chosen.append(effect)
            of_kind[effect.kind] = of_kind.get(effect.kind, 0) + 1
    refined = [Candidate(*_refined(case, effect, residual, q), state.x[:fixed]) for effect in chosen]
    r = base - problem.rows(scannable.h) * weights
    rq = q @ r
    none = -0.5 * float(r @ r - rq @ rq)
    slopes = []
    for kind, places in candidates(case.nodes, state.effects):
        if not fitted or kind not in SIMPLE:
            continue
        low, high = case.size_range(kind, places)
        unit = np.exp(low - SMALL)
        h = with_effect(case, scannable, scannable.columns, Effect(kind, places, (low - SMALL,)), w)
        slope = problem.rows(h - scannable.h) * weights / unit
        along = q @ slope
        information, gradient = float(slope @ slope - along @ along), float(slope @ r - along @ rq)
        size = gradient / information if information > 0 else 0.0
        if not low - 1 < np.log(abs(size) + 1e-300) < high + 1:
            continue
        effect = Effect(kind, places, (float(np.log(abs(size))),), int(np.sign(size)))
        value = none + 0.5 * gradient**2 / information + case.log_prior(effect)
        value += 0.5 * np.log(2 * np.pi) - 0.5 * np.log(information * size**2 + 1 / float(case.prior(effect)[1][0]) ** 2)
        slopes.append((value, effect, size * along))
    slopes.sort(key=lambda row: -row[0])
    for value, effect, along in slopes[: top // 2]:
        step = solve_triangular(lower, along, lower=True, trans="T")
        refined.append(Candidate(float(value), effect, state.x[:fixed] - step[:fixed]))
    best: dict[tuple, Candidate] = {}
    for row in refined:
        key = (*row.effect.key, round(row.effect.values[1], 1)) if row.effect.kind == "tuned_absorber" else row.effect.key
        if key not in best or row.evidence > best[key].evidence:
            best[key] = row
    return sorted(best.values(), key=lambda row: -row.evidence), none


def _refined(case: Case, effect: Effect, residual: Callable[[Effect], np.ndarray], q: np.ndarray) -> tuple[float, Effect]:
    """The best values of a candidate and its evidence, everything else free at first order."""
    mean, std = case.prior(effect)
    p, damping = np.array(effect.values), 1e-3

    def at(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, Effect]:
        there = replace(effect, values=tuple(p))
        r = residual(there)
        rq = q @ r
        return r, rq, 0.5 * float(r @ r - rq @ rq) - case.log_prior(there), there

    r, rq, cost, now = at(p)
    hessian = np.zeros((p.size, p.size))
    for _ in range(8 if p.size else 0):
        step = 1e-7 if effect.kind in LINEAR_SCALE else 1e-4
        slopes = np.stack([(r - residual(replace(effect, values=tuple(p + step * unit)))) / step for unit in np.eye(p.size)], 1)
        along = q @ slopes
        hessian = slopes.T @ slopes - along.T @ along
        gradient = slopes.T @ r - along.T @ rq - (p - mean) / std**2
        for _ in range(5):
            move = np.linalg.solve(hessian * (1 + damping * np.eye(p.size)) + np.diag(1 / std**2), gradient)
            if effect.kind not in LINEAR_SCALE:
                move *= min(1, 0.5 / np.abs(move).max())
            r2, rq2, cost2, there = at(p + move)
            if cost2 < cost:
                break
            damping *= 10
        else:
            break
        gain, p, r, rq, cost, now, damping = cost - cost2, p + move, r2, rq2, cost2, there, max(damping / 10, 1e-6)
        if gain < 0.05:
            break
    evidence = -cost
    if p.size:
        evidence += 0.5 * p.size * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(hessian + np.diag(1 / std**2))[1]
    return float(evidence), now


def promotions(case: Case, state: State) -> list[tuple[list[Effect], np.ndarray]]:
    """The effects of whose name a nuisance far beyond its spread is, in its place."""
    have, out, s = {e.kind for e in state.effects}, [], case.parts
    at = s["stiffness"].start
    if abs(state.d[at]) > PROMOTED and "global_stiffness" not in have:
        value, d = state.d[at] * case.spread[at], state.d.copy()
        d[at] = 0
        out.append(([*state.effects, Effect("global_stiffness", (), (float(np.log(abs(value))),), int(np.sign(value)))], d))
    whole, each = s["damping_whole"].start, s["damping"]
    mean = float((state.d[each] * case.spread[each]).mean())
    if (abs(state.d[whole]) > PROMOTED or abs(mean) > case.spread[each].mean()) and "global_damping" not in have:
        d = state.d.copy()
        d[each] -= mean / case.spread[each]
        out.append(([*state.effects, Effect("global_damping", (), (mean + float(d[whole] * case.spread[whole]),))], d))
        d[whole] = 0
    for i in np.flatnonzero(np.abs(state.d[s["sensor"]]) > PROMOTED):
        at, d = s["sensor"].start + i, state.d.copy()
        d[at] = 0
        out.append(([*state.effects, Effect("sensor_gain", (int(i),), (float(state.d[at] * case.spread[at]),))], d))
    return out


def strained(case: Case, state: State) -> bool:
    """Whether a part of the nuisance is far beyond its spread."""
    return any(float(np.mean(state.d[part] ** 2)) > STRAINED for part in case.parts.values() if part.stop - part.start > 1)


def search(case: Case, say: Callable[[str], None] = lambda text: None) -> Found:
    """To the first state that explains the lines; then with the spreads that it teaches."""
    found = _searched(case, say)
    if found.best.alpha < EXPLAINED_ALPHA and not strained(case, found.best):
        best = found.best
        for _ in range(2):
            d, factors = update_spreads(case, best)
            best = fit(case, best.effects, best.z, d, best.u, best.alpha)
        say(f"spreads × {factors}, discrepancy {best.alpha:.4f}")
        case.priors = {}
        found = _searched(case, say, best)
    return found


def _searched(case: Case, say: Callable[[str], None], start: State | None = None, depth: int = 5) -> Found:
    pool: dict[tuple, State] = {}
    tried: set[tuple] = set()

    def best() -> State:
        return max(pool.values(), key=lambda s: s.log_evidence)

    def put(effects: list[Effect], z: np.ndarray, d: np.ndarray, u: np.ndarray | None, alpha: float) -> State | None:
        try:
            state = fit(case, effects, z, d, u, alpha, floor=best().log_evidence if pool else -np.inf)
        except np.linalg.LinAlgError:
            return None
        if np.isfinite(state.log_evidence) and (state.key not in pool or state.log_evidence > pool[state.key].log_evidence):
            pool[state.key] = state
        say(f"  {names(case, state.effects)} {state.log_evidence:.1f}, discrepancy {state.alpha:.4f}")
        return state

    def once(effects: list[Effect]) -> bool:
        key = tuple(sorted(e.key for e in effects))
        new = key not in tried
        tried.add(key)
        return new

    zero_z, zero_d = np.zeros(case.n_z), np.zeros(case.n_d)
    if start is not None and not start.effects:
        put([], start.z, start.d, None, start.alpha)
    else:
        put([], zero_z, zero_d, None, 0.1)
    empty = best()
    if start is not None and start.effects:
        pool[start.key] = start
        empty.scanned = empty.robustly = True
    for _ in range(depth):
        was = best()
        if (was.alpha > ROBUST_ALPHA or strained(case, was)) and not was.robustly:
            was.robustly = True
            _robust_stage(case, was, put, say)
        for rank, state in enumerate(sorted(pool.values(), key=lambda s: -s.log_evidence)[:BEAM]):
            if state.scanned or state.log_evidence < best().log_evidence - 30:
                continue
            state.scanned = True
            for effects, d in promotions(case, state):
                if once(effects):
                    put(effects, state.z, d, state.carried(effects), state.alpha)
            found, none = linear_scan(case, state)
            say(
                f"scan of {names(case, state.effects)}: "
                + ", ".join(f"{names(case, [c.effect])[0]} {c.evidence - none:+.0f}" for c in found[:4])
            )
            for row in found[: FITTED if rank == 0 else 1]:
                if row.evidence > none - 20 and once([*state.effects, row.effect]):
                    _put_candidate(put, state, row)
        now = best()
        if len(now.effects) > 1:
            for effect in now.effects:
                rest = [e for e in now.effects if e is not effect]
                if once(rest):
                    put(rest, now.z, now.d, now.carried(rest), now.alpha)
        grown = len(best().effects) > len(was.effects)
        if best() is was or (grown and best().log_evidence < was.log_evidence + EXTRA):
            break
        if start is None and best().alpha < EXPLAINED_ALPHA and not strained(case, best()):
            break
    now = best()
    for state in sorted(pool.values(), key=lambda s: -s.log_evidence)[:4]:  # the leaders again, from the best: no evidence by its path
        if state is not now and state.log_evidence > now.log_evidence - 40:
            put(state.effects, now.z, now.d, now.carried(state.effects), now.alpha)
    if start is not None:
        _others(case, max(pool.values(), key=score), put, once, say)
    return Found(max(pool.values(), key=score), empty, pool)


def score(state: State) -> float:
    """Log probability of a state but for a constant: a further effect must earn its place."""
    beyond = abs(state.d[state.case.parts["stiffness"].start]) > PROMOTED if state.case.parts["stiffness"].stop else False
    return state.log_evidence - EXTRA * (len(state.effects) + beyond)


def _others(case: Case, best: State, put: Callable[..., State | None], once: Callable[..., bool], say: Callable[[str], None]) -> None:
    """What could stand in the place of each effect: scanned about the state that has it, fitted where the scan is close."""
    for effect in best.effects:
        rest = [e for e in best.effects if e is not effect]
        values = [v for e in rest for v in e.values]
        about = replace(best, effects=rest, x=np.concatenate([best.z, best.d, best.carried(rest), values]))
        found, _ = linear_scan(case, about, fitted=False)
        say(
            f"in the place of {names(case, [effect])[0]}: " + ", ".join(f"{names(case, [c.effect])[0]} {c.evidence:.0f}" for c in found[:6])
        )
        for simpler in contained(effect):
            more = [*rest, simpler]
            if once(more):
                put(more, best.z, best.d, best.carried(more), best.alpha)
        own = max((c.evidence for c in found if c.effect.key == effect.key), default=found[0].evidence)
        for row in found[:OTHERS]:
            if row.evidence > own - CLOSE and once([*rest, row.effect]):
                _put_candidate(put, about, row)


def contained(effect: Effect) -> list[Effect]:
    """What a heavy absorber far above its resonance is: a spring or a damper to ground. (Far below it a mass, which the scan has.)"""
    if effect.kind != "tuned_absorber":
        return []
    mass, wa, zeta = np.exp(effect.values[0]), 2 * np.pi * np.exp(effect.values[1]), np.exp(effect.values[2])
    sizes = {"ground_spring": mass * wa**2, "ground_damper": 2 * zeta * mass * wa}
    return [Effect(kind, effect.places, (float(np.log(size)),)) for kind, size in sizes.items()]


def _listed(case: Case, rows: list[Candidate], zero: float) -> str:
    return ", ".join(f"{names(case, [c.effect])[0]} {c.evidence - zero:+.0f}" for c in rows)


def _put_candidate(put: Callable[..., State | None], state: State, row: Candidate) -> None:
    """The fit of a state with a candidate more, from where the scan puts it."""
    more = [*state.effects, row.effect]
    start = replace(state, x=np.concatenate([row.fixed, state.x[state.fixed :]]))
    put(more, start.z, start.d, start.carried(more), state.alpha)


def _robust_stage(case: Case, state: State, put: Callable[..., State | None], say: Callable[[str], None]) -> None:
    """The robust scan and the neighbourhoods of its leaders; the nearest are fitted."""
    z, d = (state.z, state.d) if state.effects else (np.zeros(case.n_z), np.zeros(case.n_d))
    rows = robust_scan(case, state.effects, z, d, state.u)
    say("robust scan: " + ", ".join(f"{names(case, [e])[0]}{' (cut)' if cut else ''} {v:.0f}" for v, e, cut in rows[:6]))
    near = []
    for _, effect, cut in rows[:APPROACHED]:
        effects = [*state.effects, effect]
        u = state.carried(effects) + (case.without_rest(effects, effect.places) if cut else 0)
        near.append(approach(case, effects, z, d, u))
    near.sort(key=lambda row: row[0])
    for cost, there, d_there, u_there, effects in near[:FITTED]:
        if cost < 1.5 * near[0][0] + 20:
            put(effects, there, d_there, u_there, 0.03)
