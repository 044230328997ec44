"""Fitting laws of restoring force at one place: regressions on pseudo-forces of the motion across it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.effects import kind_of
from operando.effects.base import EffectKind
from operando.effects.friction import mean_sign
from operando.nonlinear.place import Along, Crossing, settle
from operando.nonlinear.run import Complex, Real
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

MADE = 8
"""Spectra of laws that a motion keeps."""


@dataclass(frozen=True)
class Motion:
    """Motion across a place in one run, and the run seen along it on the lines of one set.

    Parameters
    ----------
    x, v : (N,) arrays
    step : float
    along : Along
    crossing : Crossing
    force : (L,) complex array
        Restoring force without a law, on all lines of the run.
    taken : (L,) array
        How far the data decide about it.
    made : dict
        Spectra on all lines of laws taken along this motion: the sets of lines share it.
    closed : dict
        Spectra on all lines of the record that laws made in the closed loop, by :attr:`LawFit.key`: they stand for the law along the
        motion.
    """

    x: Real
    v: Real
    step: float
    along: Along
    crossing: Crossing
    force: Complex
    taken: Real
    made: dict[Any, Complex] = field(default_factory=dict, compare=False, repr=False)
    closed: Mapping[Any, Complex] = field(default_factory=dict, compare=False, repr=False)

    def settled(self, law: Callable[[Real, Real], Real], turns: int = 12, remembers: bool = False) -> Motion:
        """The motion where the data say nothing as the law has it."""
        x, v = settle(self.along, self.crossing, self.force, self.taken, law, (self.x, self.v), turns, remembers)
        return replace(self, x=x, v=v, made={}, closed={})

    def spectrum(self, law: LawFit) -> Complex:
        """Transform of a law's restoring force on all lines of the record, (N//2+1,)."""
        known = self.closed.get(law.key)
        if known is not None:
            return known
        whole = self.made.get(law.key)
        if whole is None:
            whole = self.crossing.lines(law.force(self.x, self.v, self.step))
            if len(self.made) >= MADE:
                self.made.clear()
            self.made[law.key] = whole
        return whole

    def under(self, law: LawFit) -> Complex:
        """Transform of a law's restoring force (L,) on the lines."""
        return np.asarray(self.spectrum(law)[self.along.run.lines])

    @property
    def coarse(self) -> Motion:
        """The motion at the record's own rate, for comparing laws: what a kink folds back is small beside what tells them apart."""
        fine = self.crossing.fine
        if fine == 1:
            return self
        crossing = replace(self.crossing, fine=1)
        return replace(self, x=self.x[::fine], v=self.v[::fine], step=self.step * fine, crossing=crossing, made={}, closed={})

    def without_fastest(self, law: LawFit, part: float) -> float:
        """Mean weighted square by which the responses change if the law is taken without the motion above a part of the recorded band."""
        n = self.x.size
        slow = sfft.rfftfreq(n, self.step) < part * self.along.run.sampling_hz / 2
        x, v = (sfft.irfft(sfft.rfft(motion) * slow, n) for motion in (self.x, self.v))
        change = self.spectra((law.force(x, v, self.step) - law.force(self.x, self.v, self.step))[None])[0]
        return float(np.sum(np.abs(self.along.gain * change) ** 2) / self.along.weighted.root.size)

    def above_noise(self, part: float) -> float:
        """Power of the acceleration measured across the place above a part of the recorded band, over that of the noise."""
        run = self.along.run
        rows = np.flatnonzero(self.along.b[run.rows])
        weights = self.along.b[run.rows[rows]]
        fast = run.all_hz > part * run.sampling_hz / 2
        noise = float(np.sum(weights**2 * np.median(run.variance[rows], axis=1)))
        return float(np.mean(np.abs(weights @ run.responses[np.ix_(rows, fast)]) ** 2)) / noise

    def spectra(self, forces: Real) -> Complex:
        """Transforms of restoring forces (c, N) on the lines."""
        return np.asarray(sfft.rfft(forces, axis=-1)[..., self.along.run.lines] / self.crossing.fine)


@dataclass(frozen=True)
class LawFit:
    """A law at a place.

    Parameters
    ----------
    kind : str
    side : float
        −1 where a one-sided law acts towards the other side: its place is turned round.
    values : dict
    cost : float
        Σ|weighted error|² with it, on the lines fitted.
    size : int
        Parameters.
    """

    kind: str
    side: float
    values: dict[str, float]
    cost: float
    size: int
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> tuple[Any, ...]:
        """Kind, side and values."""
        return (self.kind, self.side, *self.values.items())

    def force(self, x: Real, v: Real, step: float) -> Real:
        """Restoring force along the place as searched (not turned round)."""
        return self.side * law_force(kind_of(self.kind), self.side * x, self.side * v, self.values, step)


def law_force(kind: EffectKind, x: Real, v: Real, values: Mapping[str, Any], step: float) -> Real:
    """Restoring force of a kind; linear kinds of spring and damper included."""
    if kind.acts == "pseudo_force":
        return np.asarray(kind.over_steps(x, v, values, step))
    if "stiffness" in values:
        return np.asarray(values["stiffness"] * x)
    return np.asarray(values["damping"] * v)


def pooled(motions: Sequence[Motion], forces: Sequence[Real]) -> tuple[Real, Real, float]:
    """Normal equations over runs of restoring forces (c, N) each."""
    return summed(each(lambda pair: pair[0].along.normal(pair[0].spectra(pair[1])), zip(motions, forces, strict=True)))


def summed(parts: Sequence[tuple[Real, Real, float]]) -> tuple[Real, Real, float]:
    """Normal equations of several runs in one."""
    return np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0), float(sum(p[2] for p in parts))


def single_costs(gram: Real, right: Real, total: float) -> tuple[Real, Real]:
    """Best positive factor of each column by itself, and the cost with it."""
    diagonal = np.maximum(np.diag(gram), 1e-300)
    factor = np.maximum(right / diagonal, 0.0)
    return factor, total - factor * right


def fit_law(motions: Sequence[Motion], kind_name: str, side: float = 1.0, rounds: int = 3, near: LawFit | None = None) -> LawFit | None:
    """Best values of one kind; None where no positive size helps.

    Parameters
    ----------
    motions : sequence of Motion
    kind_name : str
        A level-dependent kind, or a spring or damper of one or two places.
    side : float
        −1 turns the place round.
    rounds : int
        Times that the grid over a gap, a knee or a speed is refined.
    near : LawFit, optional
        The law found before, for a motion that differs little: sought about it first.
    """
    kind = kind_of(kind_name)
    if kind_name == "hysteresis":
        return fit_hysteresis(motions, near)
    if kind_name == "coulomb_friction":
        return fit_friction(motions, rounds, near)
    name = kind.parameters[0].name
    # A user's own kind may have any further parameters; those of the catalogue say which of theirs are lengths.
    declared = getattr(kind, "shape_names", None)
    shapes = kind.names[1:] if declared is None else declared

    def columns(values: Sequence[dict[str, float]]) -> tuple[Real, Real, float]:
        return pooled(
            motions, [np.stack([side * law_force(kind, side * m.x, side * m.v, {name: 1.0, **w}, m.step) for w in values]) for m in motions]
        )

    if not shapes:
        factor, cost = single_costs(*columns([{}]))
        return None if factor[0] <= 0 else LawFit(kind_name, side, {name: float(factor[0])}, float(cost[0]), 1)
    if len(shapes) > 1 or declared is None:
        return fit_general(motions, kind, side)
    reach = max(float(np.max(np.abs(m.x))) for m in motions)
    low, high = (reach * r for r in GRID_RANGE)
    best = _search_shape(columns, name, shapes[0], low, high, rounds=rounds, near=near)
    if best is None:
        return None
    size, value, least = best
    return LawFit(kind_name, side, {name: size, shapes[0]: value}, least, 2)


def _search_shape(
    columns: Callable[[Sequence[dict[str, float]]], tuple[Real, Real, float]],
    name: str,
    shape: str,
    low: float,
    high: float,
    first: int = GRID,
    rounds: int = 3,
    near: LawFit | None = None,
) -> tuple[float, float, float] | None:
    """Grid over one shape parameter, refined some times around the best; about a law near where the best lies inside."""
    if near is not None:
        a, b = (float(np.clip(near.values[shape] * f, low, high)) for f in (1 / ABOUT, ABOUT))
        inside = _search_shape(columns, name, shape, a, b, 5, 2) if a < b else None
        if inside is not None and a * EASY < inside[1] < b / EASY:
            return inside
    grid = np.geomspace(low, high, first)
    found: tuple[float, float, float] | None = None
    for _ in range(1 + rounds):
        factor, cost = single_costs(*columns([{shape: float(g)} for g in grid]))
        if not np.any(factor > 0):
            return found
        k = int(np.argmin(np.where(factor > 0, cost, np.inf)))
        if found is None or cost[k] < found[2]:
            found = (float(factor[k]), float(grid[k]), float(cost[k]))
        a, b = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
        grid = np.geomspace(a, b, 7)[1:-1] if a < b else grid[:1]
        grid = np.concatenate([[a], grid, [b]])
    return found


def fit_friction(motions: Sequence[Motion], rounds: int = 3, near: LawFit | None = None) -> LawFit | None:
    """Dry friction, smoothed over a speed that is found with it."""
    rms = float(np.sqrt(np.mean([np.mean(m.v**2) for m in motions])))

    def columns(values: Sequence[dict[str, float]]) -> tuple[Real, Real, float]:
        return pooled(motions, [np.stack([mean_sign(m.v, v["slip_speed"]) for v in values]) for m in motions])

    best = _search_shape(columns, "force", "slip_speed", rms / SMOOTHINGS[1], rms / SMOOTHINGS[0], 9, rounds, near)
    if best is None:
        return None
    return LawFit("coulomb_friction", 1.0, {"force": best[0], "slip_speed": best[1]}, best[2], 2)


def fit_hysteresis(motions: Sequence[Motion], near: LawFit | None = None) -> LawFit | None:
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
        x = [_on_lines(m, m.x[:: m.crossing.fine]) for m in motions]
        columns = [np.stack(rows) for rows in zip(x, z, *slopes, strict=True)]
        gram, right, _ = summed([m.along.normal(c) for m, c in zip(motions, columns, strict=True)])
        scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        found = np.linalg.lstsq(gram / np.outer(scale, scale), right / scale, rcond=1e-10)[0] / scale
        move = np.clip(found[2:] / (found[1] if found[1] > 0 else force), -0.5, 0.5)
        ends = [(a * float(np.exp(f * move[0])), float(np.clip(n * np.exp(f * move[1]), 0.5, 10))) for f in (1, 0.4)]
        better = next((t for end in ends if (t := _slip_fit(motions, *end)) is not None and t[0] < cost), None)
        if better is None:
            break
        best = better
        if np.max(np.abs(move)) < 0.01:
            break
    cost, a, n, (after, force) = best
    # f = r·k·x + (1−r)·F_y·z with F_y = k·a: after = r·k, force = (1−r)·k·a.
    stiffness = after + force / a
    values = {"stiffness": stiffness, "yield_force": stiffness * a, "exponent": n, "ratio": min(after / stiffness, 0.95)}
    return LawFit("hysteresis", 1.0, {k: float(v) for k, v in values.items()}, cost, 4)


def _memories(motions: Sequence[Motion], reach: float, exponent: float) -> list[Complex]:
    """Transform of the internal z of each run, walked at the record's own rate."""
    kind = kind_of("hysteresis")
    values = {"stiffness": 1.0 / reach, "yield_force": 1.0, "exponent": exponent}
    return each(lambda m: _on_lines(m, kind.memory(m.x[:: m.crossing.fine], values)), motions)  # type: ignore[attr-defined]


def _on_lines(m: Motion, signal: Real) -> Complex:
    """Transform of a signal at the record's own rate, on the lines."""
    return np.asarray(sfft.rfft(signal)[m.along.run.lines])


def _slip_fit(motions: Sequence[Motion], reach: float, exponent: float) -> tuple[float, float, float, tuple[float, float]] | None:
    """Cost, reach, exponent and the two forces' factors; None where the memory would have to push."""
    z = _memories(motions, reach, exponent)
    columns = [np.stack([_on_lines(m, m.x[:: m.crossing.fine]), zm]) for m, zm in zip(motions, z, strict=True)]
    gram, right, total = summed([m.along.normal(c) for m, c in zip(motions, columns, strict=True)])
    both = np.linalg.solve(gram + 1e-12 * np.diag(np.diag(gram)), right)
    if both[0] < 0:
        both = np.array([0.0, right[1] / gram[1, 1]])
    if both[1] <= 0:
        return None
    return total - 2 * float(both @ right) + float(both @ gram @ both), reach, exponent, (float(both[0]), float(both[1]))


def fit_general(motions: Sequence[Motion], kind: EffectKind, side: float = 1.0) -> LawFit | None:
    """A user's law of any number of parameters: the first is taken as its size, the others are moved from their defaults."""
    from scipy.optimize import minimize

    first, *others = kind.parameters

    def value(vector: Real) -> tuple[float, float]:
        values = {first.name: 1.0} | {p.name: p.outward(float(t)) for p, t in zip(others, vector, strict=True)}
        gram, right, total = pooled(motions, [(side * law_force(kind, side * m.x, side * m.v, values, m.step))[None] for m in motions])
        factor, cost = single_costs(gram, right, total)
        return float(cost[0]), float(factor[0])

    start = np.array([p.inward(p.start()) for p in others])
    found = minimize(lambda t: value(t)[0], start, method="Nelder-Mead", options={"maxfev": 120, "xatol": 1e-3})  # type: ignore[call-overload]
    cost, factor = value(found.x)
    if factor <= 0:
        return None
    values = {first.name: factor} | {p.name: p.outward(float(t)) for p, t in zip(others, found.x, strict=True)}
    return LawFit(kind.kind, side, values, cost, len(kind.parameters))


def law_cost(fit: LawFit | None, motions: Sequence[Motion]) -> tuple[float, int]:
    """Σ|weighted error|² on other lines or runs with the law as it stands, and how many errors; without a law where None."""
    cost, count = 0.0, 0
    for m in motions:
        count += m.along.weighted.error.size
        if fit is None:
            cost += m.along.weighted.ringing()[1]
            continue
        gram, right, total = m.along.normal(m.under(fit)[None])
        cost += total - 2 * float(right[0]) + float(gram[0, 0])
    return cost, count


def free_law(motions: Sequence[Motion], validation: Sequence[Motion], knots: int = 21) -> float:
    """Cost on ``validation`` of a law without a formula: piecewise linear in x, and v, v|v|, sign v; fitted on ``motions``."""
    x_all = np.concatenate([m.x for m in motions])
    v_rms = float(np.sqrt(np.mean([np.mean(m.v**2) for m in motions])))
    reach = float(np.max(np.abs(x_all)))
    at = reach * np.sign(np.linspace(-1, 1, knots)) * np.abs(np.linspace(-1, 1, knots)) ** 1.5

    def columns(m: Motion) -> Real:
        hats = [np.interp(m.x, at, np.eye(knots)[i]) for i in range(knots) if i != knots // 2]
        return np.stack([*hats, m.v, m.v * np.abs(m.v), np.tanh(m.v / (0.05 * v_rms))])

    gram, right, _ = pooled(motions, [columns(m) for m in motions])
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    system = gram / np.outer(scale, scale)
    theta = np.linalg.solve(system + 1e-9 * np.eye(len(system)), right / scale) / scale
    gram, right, total = pooled(validation, [columns(m) for m in validation])
    return total - 2 * float(theta @ right) + float(theta @ gram @ theta)


def linear_law(motions: Sequence[Motion], validation: Sequence[Motion], blocks: int = 24) -> float:
    """Cost on ``validation`` of any linear law: a complex dynamic stiffness for each of some bands of frequency, fitted on ``motions``."""
    top = max(float(m.along.run.hz[-1]) for m in motions)
    low = min(float(m.along.run.hz[0]) for m in motions)
    edges = np.geomspace(low * 0.999, top * 1.001, blocks + 1)

    def columns(m: Motion) -> Complex:
        run = m.along.run
        x = m.spectra(m.x)
        centre = np.sqrt(edges[1:] * edges[:-1])
        # Straight between band centres: real and imaginary part of the stiffness.
        hats = np.array([np.interp(np.log(run.hz), np.log(centre), row) for row in np.eye(blocks)])
        return np.concatenate([hats * x, 1j * hats * x])

    def normal(part: Sequence[Motion]) -> tuple[Real, Real, float]:
        return summed([m.along.normal(columns(m)) for m in part])

    gram, right, _ = normal(motions)
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    theta = np.linalg.solve(gram / np.outer(scale, scale) + 1e-9 * np.eye(gram.shape[0]), right / scale) / scale
    gram, right, total = normal(validation)
    return total - 2 * float(theta @ right) + float(theta @ gram @ theta)


def turned(fit: LawFit) -> LawFit:
    """The same law seen from the other end of the place."""
    return replace(fit, side=-fit.side)
