"""Which effects are missing: scans, moves, and what the search ends with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from kinds import GLOBAL, LINEAR_SCALE, STRUCTURAL, Effect, candidates, with_one
from model import Case, Scannable
from posterior import State, approach, fit, names, real, update_spreads, weights_of
from scipy.linalg import cholesky, solve_triangular

ROBUST_ALPHA, ROBUST = 0.02, 0.05
"""Above this discrepancy of a state the scan is robust, and about the idle model as it is: under a loose one a linear scan absorbs all."""
EXPLAINED_ALPHA = 0.03  # below, spreads of the nuisance are estimated and further effects on_validation_lines
STRAINED = 4.0
"""Mean square of a part of the nuisance, in its spreads, from which it stands for something else: that state teaches no spreads."""
FITTED, APPROACHED, BEAM = 3, 6, 3
PROMOTED = 3.0  # standard deviations of a nuisance from which the effect of its name is tried
EXTRA, EXTRA_OF_DISCREPANCY = 5.0, 150.0
"""Nats that a further effect must earn: five where noise is all, and more where the discrepancy is, whose values are alike over the pairs
and lines of a resonance (2200 values, of which some 80 are independent)."""


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


def robust_scan(case: Case, effects: list[Effect], z: np.ndarray, d: np.ndarray) -> list[tuple[float, Effect, bool]]:
    """Candidates by a robust misfit, without freeing anything; once more without what residual masses give between undriven places."""
    at = case.fit_lines
    w, measured = case.w[at], case.h[at]
    state = case.scannable(z, d, effects, at)
    noise = case.variance[at] + ROBUST**2 * case.level[at] ** 2

    def score(h: np.ndarray) -> float:
        return -float(np.sum(np.log1p(np.abs(measured - h) ** 2 / noise) / case.count[at]))

    variants = [(False, state.columns)]
    if not effects and case.below.size:
        rest = case.rest_columns(case.below, list(range(case.n_dofs)), w) * case.undriven
        own = np.zeros_like(rest)
        i = np.arange(case.n_dofs)
        own[:, i, i] = -np.sum(case.phi0[:, case.below] ** 2, axis=1) * case.undriven / w[:, None] ** 2
        variants.append((True, state.columns - rest - own))
    out = []
    for cut, columns in variants:
        for kind, places in candidates(case.n_dofs, effects):
            if cut and not (kind in STRUCTURAL and case.undriven[list(places)].all()):
                continue
            best = (-np.inf, Effect(kind, places))
            for effect in at_size(case, kind, places, 24):
                with np.errstate(all="ignore"):
                    h = with_effect(case, state, columns, effect, w)
                    h = case.predict(z, d, [*effects, effect], at, derivatives=False).h if h is None else h
                    value = score(h)
                if value > best[0]:
                    best = value, effect
            out.append((*best, cut))
    return sorted(out, key=lambda row: -row[0])


def linear_scan(case: Case, state: State, stride: int = 2, top: int = 24) -> tuple[list[tuple[float, Effect]], float]:
    """Candidates by the evidence of one more effect with everything else free at first order, and the same of none."""
    at = case.fit_lines[::stride]
    w, measured = case.w[at], case.h[at]
    prediction = case.predict(state.z, state.d, state.effects, at)
    scannable = case.scannable(state.z, state.d, state.effects, at)
    noise = case.count[at] * (case.variance[at] + state.alpha**2 * case.level[at] ** 2) / stride
    weights = weights_of(noise)
    jacobian = real(prediction.jacobian) * weights[:, None]
    information = jacobian.T @ jacobian
    fixed = case.n_z + case.n_d
    information[np.diag_indices_from(information)] += np.concatenate([np.ones(fixed), np.full(state.x.size - fixed, 1e-2)])
    q = solve_triangular(cholesky(information, lower=True), jacobian.T, lower=True)
    base = real(measured[..., None])[:, 0] * weights + jacobian[:, :fixed] @ state.x[:fixed]
    single = q.astype(np.float32)

    def residual(effect: Effect) -> np.ndarray:
        with np.errstate(all="ignore"):
            h = with_effect(case, scannable, scannable.columns, effect, w)
            h = case.predict(state.z, state.d, [*state.effects, effect], at, derivatives=False).h if h is None else h
        return base - real(h[..., None])[:, 0] * weights

    def costs(effects: list[Effect]) -> np.ndarray:
        r = np.stack([residual(e) for e in effects], 1)
        return np.nan_to_num(0.5 * (np.sum(r**2, 0) - np.sum((single @ r.astype(np.float32)).astype(float) ** 2, 0)), nan=np.inf)

    found: list[tuple[float, Effect]] = []
    for kind, places in candidates(case.n_dofs, state.effects):
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
    refined = sorted((_refined(case, effect, residual, q) for effect in chosen), key=lambda row: -row[0])
    r = base - real(scannable.h[..., None])[:, 0] * weights
    return refined, -0.5 * float(r @ r - np.sum((q @ r) ** 2))


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
    mean = float(state.d[s["damping"]].mean())
    if abs(mean) > 1 and "global_damping" not in have:
        d = state.d.copy()
        d[s["damping"]] -= mean
        out.append(([*state.effects, Effect("global_damping", (), (mean * float(case.spread[s["damping"]][0]),))], d))
    for i in np.flatnonzero(np.abs(state.d[s["sensor"]]) > PROMOTED):
        at, d = s["sensor"].start + i, state.d.copy()
        d[at] = 0
        out.append(([*state.effects, Effect("sensor_gain", (int(i),), (float(state.d[at] * case.spread[at]),))], d))
    return out


def strained(case: Case, state: State) -> bool:
    """Whether a part of the nuisance is far beyond its spread."""
    return any(float(np.mean(state.d[part] ** 2)) > STRAINED for part in case.parts.values() if part.stop - part.start > 1)


def needed(case: Case, state: State) -> float:
    """Nats that one effect more than this state has must earn."""
    discrepancy = state.alpha**2 * case.level[case.fit_lines] ** 2
    return EXTRA + EXTRA_OF_DISCREPANCY * float(np.median(discrepancy / (discrepancy + case.variance[case.fit_lines])))


def search(case: Case, say: Callable[[str], None] = lambda text: None) -> Found:
    """To the first state that explains the lines; then with the spreads that it teaches."""
    found = _searched(case, say)
    if found.best.alpha < EXPLAINED_ALPHA and not strained(case, found.best):
        best = found.best
        for _ in range(2):
            d, factors = update_spreads(case, best)
            best = fit(case, best.effects, best.z, d, best.alpha)
        say(f"spreads × {factors}, discrepancy {best.alpha:.4f}")
        case.priors = {}
        found = _searched(case, say, best)
    return found


def _searched(case: Case, say: Callable[[str], None], start: State | None = None, depth: int = 5) -> Found:
    pool: dict[tuple, State] = {}
    tried: set[tuple] = set()

    def best() -> State:
        return max(pool.values(), key=lambda s: s.log_evidence)

    def put(effects: list[Effect], z: np.ndarray, d: np.ndarray, alpha: float) -> State | None:
        try:
            state = fit(case, effects, z, d, alpha, floor=best().log_evidence if pool else -np.inf)
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
        put([], start.z, start.d, start.alpha)
    else:
        put([], zero_z, zero_d, 0.1)
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
                    put(effects, state.z, d, state.alpha)
            found, none = linear_scan(case, state)
            say(f"scan of {names(case, state.effects)}: " + ", ".join(f"{names(case, [e])[0]} {v - none:+.0f}" for v, e in found[:4]))
            for value, effect in found[: FITTED if rank == 0 else 1]:
                if value > none - 20 and once([*state.effects, effect]):
                    put([*state.effects, effect], state.z, state.d, state.alpha)
        now = best()
        if len(now.effects) > 1:
            for effect in now.effects:
                rest = [e for e in now.effects if e is not effect]
                if once(rest):
                    put(rest, now.z, now.d, now.alpha)
        grown = len(best().effects) > len(was.effects)
        if best() is was or (grown and best().log_evidence < was.log_evidence + needed(case, was)):
            break
        if start is None and best().alpha < EXPLAINED_ALPHA and not strained(case, best()):
            break
    now = best()
    for state in sorted(pool.values(), key=lambda s: -s.log_evidence)[:4]:  # the leaders again, from the best: no evidence by its path
        if state is not now and state.log_evidence > now.log_evidence - 40:
            put(state.effects, now.z, now.d, now.alpha)
    return Found(_fewest(case, pool, best()), empty, pool)


def _robust_stage(case: Case, state: State, put: Callable[..., State | None], say: Callable[[str], None]) -> None:
    """The robust scan and the neighbourhoods of its leaders; the nearest are fitted."""
    z, d = (state.z, state.d) if state.effects else (np.zeros(case.n_z), np.zeros(case.n_d))
    rows = robust_scan(case, state.effects, z, d)
    say("robust scan: " + ", ".join(f"{names(case, [e])[0]}{' (cut)' if cut else ''} {v:.0f}" for v, e, cut in rows[:6]))
    near = []
    for _, effect, cut in rows[:APPROACHED]:
        start = d.copy()
        for i in effect.places if cut else ():
            for name in ("own_below", "row_below"):
                start[case.parts[name].start + i] = -1
        near.append(approach(case, [*state.effects, effect], z, start))
    near.sort(key=lambda row: row[0])
    for cost, there, d_there, effects in near[:FITTED]:
        if cost < 1.5 * near[0][0] + 20:
            put(effects, there, d_there, 0.03)


def _fewest(case: Case, pool: dict[tuple, State], best: State) -> State:
    """The best state without effects that earn less than they must; a stiffness of the whole stands for a nuisance beyond its spread."""
    for state in sorted(pool.values(), key=lambda s: -s.log_evidence):
        extra = set(best.key) - set(state.key)
        beyond = ("global_stiffness", ()) in extra and abs(state.d[case.parts["stiffness"].start]) > PROMOTED
        fewer = set(state.key) < set(best.key) and not beyond
        if fewer and state.log_evidence > best.log_evidence - needed(case, state) * len(extra):
            return _fewest(case, pool, state)
    return best
