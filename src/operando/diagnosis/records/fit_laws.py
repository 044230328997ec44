"""Fitting force laws at one place: regressions on the restoring forces of the motion across it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from operando.diagnosis.records.motion import Motion
from operando.diagnosis.records.place import Normal, left_by, solved, summed
from operando.structure.effects import EffectKind, kind_of
from operando.structure.effects.level_dependent import mean_sign
from operando.structure.force_law import ForceLaw, raw_force
from operando.structure.modal_space import Complex, Real
from operando.threads import each

GRID = 18
"""Gaps and knees tried first, evenly spaced in their logarithm between these shares of the largest deflection."""

GRID_RANGE = (0.005, 0.93)
SMOOTHINGS = (0.3, 300.0)
"""Rms velocity over the smoothing speed of dry friction, least and most."""

REACHES, EXPONENTS = (0.03, 0.1, 0.25, 0.6), (1.0, 2.5)
SLIP_TURNS, EASY = 4, 1.03
STEP = float(np.log(EASY))
"""Hysteresis: grid over the largest deflection and exponents, Gauss–Newton steps, relative change of a value for a difference quotient."""

ABOUT = 1.5
"""A gap, knee or speed is first sought within this factor of one found before."""

KNOTS, BANDS, RIDGE = 21, 24, 1e-9
"""Knots of a law without a formula, bands of a linear law, and what keeps their regressions regular."""

Shapes = Sequence[dict[str, float]]
"""Values of a law beside its size, one dict a candidate."""


def pooled(motions: Sequence[Motion], forces: Callable[[Motion], Real]) -> Normal:
    """Normal equations over runs of restoring forces (c, N) each."""
    return summed(each(lambda m: m.along.normal(m.spectra(forces(m))), motions))


def single_costs(normal: Normal) -> tuple[Real, Real]:
    """Best positive factor of each column by itself, and the cost with it."""
    gram, right, total = normal
    factor = np.maximum(right / np.maximum(np.diag(gram), 1e-300), 0.0)
    return factor, total - factor * right


def fit_law(motions: Sequence[Motion], kind_name: str, side: float = 1.0, rounds: int = 3, near: ForceLaw | None = None) -> ForceLaw | None:
    """Best values of one kind; None where no positive size helps.

    The kind is a level-dependent one, or a spring or damper of one or two places. ``side`` −1 turns the place round; the grid over a gap, a
    knee or a speed is refined in so many ``rounds``; ``near`` is the law found before, for a motion that differs little: sought about it
    first.
    """
    kind = kind_of(kind_name)
    if kind_name == "hysteresis":
        return _fit_hysteresis(motions, near)
    name = kind.parameters[0].name
    # A user's own kind may have any further parameters; those of the catalogue say which of theirs are lengths.
    declared = getattr(kind, "shape_names", None)
    shapes = kind.names[1:] if declared is None else declared

    def costs(candidates: Shapes) -> tuple[Real, Real]:
        unit = lambda m, w: side * raw_force(kind, side * m.x, side * m.v, {name: 1.0, **w}, m.step)  # noqa: E731
        return single_costs(pooled(motions, lambda m: np.stack([unit(m, w) for w in candidates])))

    def slip_costs(candidates: Shapes) -> tuple[Real, Real]:
        return single_costs(pooled(motions, lambda m: np.stack([mean_sign(m.v, w["slip_speed"]) for w in candidates])))

    if kind_name == "coulomb_friction":
        rms = float(np.sqrt(np.mean([np.mean(m.v**2) for m in motions])))
        found = _search_shape(slip_costs, "slip_speed", rms / SMOOTHINGS[1], rms / SMOOTHINGS[0], 9, rounds, near)
    elif not shapes:
        factor, cost = costs([{}])
        found = None if factor[0] <= 0 else (float(cost[0]), float(factor[0]), {})
    elif len(shapes) > 1 or declared is None:
        found = _search_general(costs, kind)
    else:
        low, high = (max(float(np.max(np.abs(m.x))) for m in motions) * share for share in GRID_RANGE)
        found = _search_shape(costs, shapes[0], low, high, GRID, rounds, near)
    return None if found is None else ForceLaw(kind_name, {name: found[1], **found[2]}, side)


def _search_shape(
    costs: Callable[[Shapes], tuple[Real, Real]], shape: str, low: float, high: float, first: int, rounds: int, near: ForceLaw | None
) -> tuple[float, float, dict[str, float]] | None:
    """Grid over one value, refined some times around the best; about a law near where the best lies inside. Cost, size, value."""
    if near is not None:
        a, b = (float(np.clip(near.values[shape] * f, low, high)) for f in (1 / ABOUT, ABOUT))
        inside = _search_shape(costs, shape, a, b, 5, 2, None) if a < b else None
        if inside is not None and a * EASY < inside[2][shape] < b / EASY:
            return inside
    grid = np.geomspace(low, high, first)
    found: tuple[float, float, dict[str, float]] | None = None
    for _ in range(1 + rounds):
        factor, cost = costs([{shape: float(g)} for g in grid])
        if not np.any(factor > 0):
            return found
        k = int(np.argmin(np.where(factor > 0, cost, np.inf)))
        if found is None or cost[k] < found[0]:
            found = (float(cost[k]), float(factor[k]), {shape: float(grid[k])})
        a, b = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
        grid = np.concatenate([[a], np.geomspace(a, b, 7)[1:-1] if a < b else grid[:1], [b]])
    return found


def _search_general(costs: Callable[[Shapes], tuple[Real, Real]], kind: EffectKind) -> tuple[float, float, dict[str, float]] | None:
    """A user's law of any number of values: the first is taken as its size, the others are moved from their defaults."""
    from scipy.optimize import minimize

    others = kind.parameters[1:]
    values = lambda vector: {p.name: p.outward(float(t)) for p, t in zip(others, vector, strict=True)}  # noqa: E731
    start = np.array([p.inward(p.start()) for p in others])
    options = {"maxfev": 120, "xatol": 1e-3}
    found = minimize(lambda t: float(costs([values(t)])[1][0]), start, method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    factor, cost = costs([values(found.x)])
    return None if factor[0] <= 0 else (float(cost[0]), float(factor[0]), values(found.x))


def _fit_hysteresis(motions: Sequence[Motion], near: ForceLaw | None = None) -> ForceLaw | None:
    """Bouc–Wen: a coarse grid over how far it moves before it slips and how sharply, or from a law near; then Gauss–Newton.

    The forces come by regression.
    """
    if near is None:
        reach = max(float(np.max(np.abs(m.x))) for m in motions)
        starts = [(reach * r, n) for r in REACHES for n in EXPONENTS]
    else:
        starts = [(near.values["yield_force"] / near.values["stiffness"], near.values["exponent"])]
    best = min((f for start in starts if (f := _slip_fit(motions, *start)) is not None), key=lambda f: f[0], default=None)
    if best is None:
        return None
    for _ in range(SLIP_TURNS):
        cost, a, n, (after, force) = best
        z = _memories(motions, a, n)
        slopes = [[(up - now) / STEP for now, up in zip(z, _memories(motions, *v), strict=True)] for v in ((a * EASY, n), (a, n * EASY))]
        columns = [np.stack(rows) for rows in zip([m.unfine(m.own_x) for m in motions], z, *slopes, strict=True)]
        found = solved(summed([m.along.normal(c) for m, c in zip(motions, columns, strict=True)]), 1e-10)
        move = np.clip(found[2:] / (found[1] if found[1] > 0 else force), -0.5, 0.5)
        ends = [(a * float(np.exp(f * move[0])), float(np.clip(n * np.exp(f * move[1]), 0.5, 10))) for f in (1, 0.4)]
        better = next((t for end in ends if (t := _slip_fit(motions, *end)) is not None and t[0] < cost), None)
        if better is None:
            break
        best = better
        if np.max(np.abs(move)) < 0.01:
            break
    _, a, n, (after, force) = best
    # f = r·k·x + (1−r)·F_y·z with F_y = k·a: after = r·k, force = (1−r)·k·a.
    stiffness = after + force / a
    values = {"stiffness": stiffness, "yield_force": stiffness * a, "exponent": n, "ratio": min(after / stiffness, 0.95)}
    return ForceLaw("hysteresis", {k: float(v) for k, v in values.items()})


def _memories(motions: Sequence[Motion], reach: float, exponent: float) -> list[Complex]:
    """Transform of the internal z of each run, walked at the record's own rate."""
    memory = kind_of("hysteresis").memory  # type: ignore[attr-defined]
    values = {"stiffness": 1.0 / reach, "yield_force": 1.0, "exponent": exponent}
    return each(lambda m: m.unfine(memory(m.own_x, values, m.own_rise)), motions)


def _slip_fit(motions: Sequence[Motion], reach: float, exponent: float) -> tuple[float, float, float, tuple[float, float]] | None:
    """Cost, reach, exponent and the two forces' factors; None where the memory would have to push."""
    z = _memories(motions, reach, exponent)
    normal = summed([m.along.normal(np.stack([m.unfine(m.own_x), zm])) for m, zm in zip(motions, z, strict=True)])
    gram, right, _ = normal
    both = np.asarray(np.linalg.solve(gram + 1e-12 * np.diag(np.diag(gram)), right), float)
    if both[0] < 0:
        both = np.array([0.0, right[1] / gram[1, 1]])
    if both[1] <= 0:
        return None
    return left_by(normal, both), reach, exponent, (float(both[0]), float(both[1]))


def law_cost(law: ForceLaw | None, motions: Sequence[Motion]) -> tuple[float, int]:
    """Σ|weighted error|² on other lines or runs with the law as it stands, and how many errors; without a law where None."""
    cost, count = 0.0, 0
    for m in motions:
        count += m.along.weighted.error.size
        some = np.zeros((0, m.along.run.hz.size), complex) if law is None else m.under(law)[None]
        cost += left_by(m.along.normal(some), np.ones(len(some)))
    return cost, count


def misfit(law: ForceLaw | None, motions: Sequence[Motion]) -> float:
    """The same as a mean."""
    cost, count = law_cost(law, motions)
    return cost / count


def _cost_elsewhere(motions: Sequence[Motion], validation: Sequence[Motion], columns: Callable[[Motion], Complex]) -> float:
    """Cost on ``validation`` of a sum of columns fitted on ``motions``."""
    fitted, held = (summed([m.along.normal(columns(m)) for m in part]) for part in (motions, validation))
    return left_by(held, solved(fitted, ridge=RIDGE))


def free_law(motions: Sequence[Motion], validation: Sequence[Motion]) -> float:
    """Cost on ``validation`` of a law without a formula, fitted on ``motions``."""
    v_rms = float(np.sqrt(np.mean([np.mean(m.v**2) for m in motions])))
    reach = max(float(np.max(np.abs(m.x))) for m in motions)
    return _cost_elsewhere(motions, validation, lambda m: m.spectra(free_forces(m.x, m.v, reach, v_rms, KNOTS)))


def free_forces(x: Real, v: Real, reach: float, v_rms: float, knots: int) -> Real:
    """Forces (c, N) whose sums are laws without a formula: piecewise linear in x up to ``reach``, zero at zero, and v, v|v|, sign v."""
    at = reach * np.sign(np.linspace(-1, 1, knots)) * np.abs(np.linspace(-1, 1, knots)) ** 1.5
    hats = [np.interp(x, at, np.eye(knots)[i]) for i in range(knots) if i != knots // 2]
    return np.stack([*hats, v, v * np.abs(v), np.tanh(v / (0.05 * v_rms))])


def linear_law(motions: Sequence[Motion], validation: Sequence[Motion]) -> float:
    """Cost on ``validation`` of any linear law: a complex dynamic stiffness for each of some bands of frequency, fitted on ``motions``."""
    top = max(float(m.along.run.hz[-1]) for m in motions)
    low = min(float(m.along.run.hz[0]) for m in motions)
    edges = np.geomspace(low * 0.999, top * 1.001, BANDS + 1)
    centre = np.sqrt(edges[1:] * edges[:-1])

    def hats(m: Motion) -> Real:
        return np.array([np.interp(np.log(m.along.run.hz), np.log(centre), row) for row in np.eye(centre.size)])

    # A band without fitted lines takes its stiffness from its neighbours.
    centre = centre[np.any([np.any(hats(m) > 0, axis=1) for m in motions], axis=0)]

    def columns(m: Motion) -> Complex:
        # Straight between band centres: real and imaginary part of the stiffness.
        forces = hats(m) * m.spectra(m.x)
        return np.concatenate([forces, 1j * forces])

    return _cost_elsewhere(motions, validation, columns)
