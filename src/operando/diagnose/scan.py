"""Candidate kinds at all places before any refit: laws fitted to what each place shows, and faults of the channels.

At a place with rows B the residual E = measured − model must be −(H Bᵀ)·T·(B H), T = (I + δZ·BHBᵀ)⁻¹ δZ. For one coordinate the best
complex t(ω) of each line follows from least squares and a law is fitted to it; for more, the coefficient starts from the motion
measured there (equation error), then is fitted to the exact update.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnose.predict import Term
from operando.diagnose.sets import CheckLines
from operando.effects import EffectKind

Array = NDArray[Any]

GRID_HZ = 30
"""Frequencies tried for a law that resonates."""

COLUMN_DOUBT = 0.05
"""Part of an effect's trace that the undriven columns of the idle model may have wrong (3–13 % seen)."""


@dataclass(frozen=True)
class Candidate:
    """A kind at a place with start values.

    Parameters
    ----------
    term : Term
    q : array
        Its moving numbers.
    cost : float
        Mean weighted square of what remains on the lines scanned.
    """

    term: Term
    q: Array
    cost: float


@dataclass(frozen=True)
class Reduced:
    """What the lines say about one place.

    Parameters
    ----------
    into : (lines, responses, k) array
        Receptance from the place to the responses.
    seen : (lines, k, references) array
        Receptance at the place from the references.
    between : (lines, k, k) array
    motion : (lines, k, references) array
        Motion at the place per force, measured where it is measured, else the model's.
    error, weight : (lines, responses, references) arrays
        Measured minus model, and 1/variance.
    t, pull, rest : (lines,) arrays
        One coordinate only: best t, its weight, and the weighted square that no t explains (else empty).
    """

    into: Array
    seen: Array
    between: Array
    motion: Array
    error: Array
    weight: Array
    t: Array
    pull: Array
    rest: Array

    @property
    def count(self) -> int:
        """Complex values that count."""
        return max(int(np.count_nonzero(self.weight)), 1)


def scan_weights(lines: CheckLines, model: Array, own: Array) -> Array:
    """1/variance of each line, with the idle model's own variance and the doubt about columns that were never driven."""
    error = np.abs(lines.data - model)
    return np.asarray(1 / (lines.variance + own + (COLUMN_DOUBT * error) ** 2))


def reduce_place(full: Array, rows: Array, lines: CheckLines, data: Array, weight: Array) -> Reduced:
    """What one place (rows over the idle DOFs) means for the lines.

    Parameters
    ----------
    full : (lines, n_dofs, n_dofs) array
        Receptance of the present model between all DOFs.
    rows : (k, n_dofs) array
    lines : CheckLines
    data : (lines, responses, references) array
        Measured receptance, channel faults put right.
    weight : array like ``data``
    """
    into = full[:, lines.responses] @ rows.T
    seen = rows @ full[:, :, lines.references]
    between = rows @ full @ rows.T
    model = full[np.ix_(np.arange(lines.hz.size), lines.responses, lines.references)]
    error = data - model
    used = np.flatnonzero(np.any(rows != 0, axis=0))
    at = {int(d): i for i, d in enumerate(lines.responses)}
    motion = seen
    if all(int(d) in at for d in used) and np.all(np.isfinite(lines.variance[:, [at[int(d)] for d in used]])):
        motion = rows[:, used] @ data[:, [at[int(d)] for d in used]]
    empty = np.zeros(0)
    if rows.shape[0] != 1:
        return Reduced(into, seen, between, motion, error, weight, empty, empty, empty)
    a = into * seen
    pull = np.sum(weight * np.abs(a) ** 2, axis=(1, 2))
    cross = np.sum(weight * np.conj(a) * error, axis=(1, 2))
    t = -cross / np.maximum(pull, 1e-300)
    rest = np.sum(weight * np.abs(error) ** 2, axis=(1, 2)) - np.abs(cross) ** 2 / np.maximum(pull, 1e-300)
    return Reduced(into, seen, between, motion, error, weight, t, pull, np.maximum(rest, 0))


def fit_place(term: Term, reduced: Reduced, lines: CheckLines) -> Candidate | None:
    """Best values of a kind at a place, in either sign where the kind can be taken away; None where only an impossible sign fits."""
    s = 1j * lines.omega
    if reduced.t.size:
        return _fit_scalar(term, reduced, s)
    return _fit_coefficient(term, reduced, s) if len(term.moving) == 1 else None


def _fit_scalar(term: Term, r: Reduced, s: Array) -> Candidate | None:
    g = r.between[:, 0, 0]
    z = r.t / (1 - r.t * g)
    weight = r.pull * np.abs(1 - r.t * g) ** 4
    root = np.sqrt(r.pull)

    def law(kind_values: dict[str, float], sign: int) -> Array:
        z_law = sign * term.kind.dynamic_stiffness(s, kind_values)
        return np.asarray(root * (z_law / (1 + z_law * g) - r.t))

    values = term.kind.defaults(term.band_hz) | term.constants | term.fixed
    first, *others = term.kind.parameters
    found: list[tuple[float, int, dict[str, float]]] = []
    for combination in product(*[[term.fixed[p.name]] if p.name in term.fixed else _grid(term.kind, p.name, term.band_hz) for p in others]):
        trial = dict(values) | {p.name: v for p, v in zip(others, combination, strict=True)}
        unit = term.kind.dynamic_stiffness(s, trial | {first.name: 1.0})
        size = float(np.real(np.sum(weight * np.conj(unit) * z)) / max(float(np.sum(weight * np.abs(unit) ** 2)), 1e-300))
        # Equation error with the measured motion: E ≈ −h·δz·x_measured, also where the kind-free t is poor.
        a = r.into * (unit[:, None] * r.motion[:, 0])[:, None, :]
        direct = -float(np.sum(r.weight * np.real(np.conj(a) * r.error)) / max(float(np.sum(r.weight * np.abs(a) ** 2)), 1e-300))
        for amount in (size, direct):
            if not np.isfinite(amount) or amount == 0 or (amount < 0 and not term.kind.removable):
                continue
            sign = 1 if amount > 0 else -1
            start = trial | {first.name: abs(amount) if first.name not in term.fixed else term.fixed[first.name]}
            found.append((float(np.sum(np.abs(law(start, sign)) ** 2)), sign, start))
    if not found:
        return None
    found.sort(key=lambda item: item[0])
    best: Candidate | None = None
    for _, sign, start in found[: 3 if others else 1]:
        here = replace(term, sign=sign)

        def left(x: Array, here: Term = here, sign: int = sign) -> Array:
            return law(here.values(x), sign)

        q, cost = _polish(left, here.inward(start), here)
        cost = (cost + float(r.rest.sum())) / r.count
        if best is None or cost < best.cost:
            best = Candidate(here, q, cost)
    return best


def _fit_coefficient(term: Term, r: Reduced, s: Array) -> Candidate | None:
    """One coefficient on several coordinates."""
    name = term.moving[0]
    k = r.into.shape[2]
    unit = np.asarray(term.kind.matrix(s, term.constants | {name: 1.0}, k))
    a = r.into @ (unit @ r.motion)
    size = -float(np.sum(r.weight * np.real(np.conj(a) * r.error)) / max(float(np.sum(r.weight * np.abs(a) ** 2)), 1e-300))
    if not np.isfinite(size) or size == 0:
        return None
    sign, start = 1, size
    if term.kind.parameter(name).transform == "log":
        if size < 0 and not term.kind.removable:
            return None
        sign, start = (1 if size > 0 else -1), abs(size)
    here = replace(term, sign=sign)
    root = np.sqrt(r.weight)

    def left(x: Array) -> Array:
        z = here.stiffness(s, here.values(x))
        middle = np.linalg.solve(np.eye(k) + z @ r.between, z)
        return np.asarray((root * (r.error + r.into @ middle @ r.seen)).ravel())

    q, cost = _polish(left, here.inward({name: start}), here, 4)
    return Candidate(here, q, cost / r.count)


def _grid(kind: EffectKind, name: str, band: tuple[float, float]) -> list[float]:
    p = kind.parameter(name)
    low, high = p.bounds(band)
    if p.unit == "Hz":
        return [float(v) for v in np.geomspace(low * 1.02, high * 0.98, GRID_HZ)]
    a, b = p.inward(low), p.inward(high)
    return [p.outward(float(v)) for v in a + (b - a) * np.array([0.35, 0.65, 0.9])]


def _polish(law: Callable[[Array], Array], q: Array, term: Term, steps: int = 15) -> tuple[Array, float]:
    """A few damped Gauss–Newton steps within the bounds; law gives weighted complex residuals."""
    low, high = term.bounds()
    e = law(q)
    cost, damping = float(np.vdot(e, e).real), 1e-3
    for _ in range(steps if q.size else 0):
        j = np.array([(law(q + 1e-5 * row) - e) / 1e-5 for row in np.eye(q.size)])
        normal, slope = np.real(j.conj() @ j.T), np.real(j.conj() @ e)
        move = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-30), slope)
        tried = np.clip(q - np.clip(move, -1, 1), low, high)
        e_new = law(tried)
        new = float(np.vdot(e_new, e_new).real)
        if new < cost:
            done = cost - new < 1e-4 * cost
            q, e, cost, damping = tried, e_new, new, damping / 5
            if done:
                break
        else:
            damping *= 10
            if damping > 1e4:
                break
    return q, cost


def channel_candidates(terms: Sequence[Term], lines: CheckLines, model: Array, data: Array, weight: Array) -> list[Candidate]:
    """Sensor and force faults: what each channel's own rows or columns say, and pairs exchanged.

    Parameters
    ----------
    terms : sequence of Term
        Kinds that act on channels.
    lines : CheckLines
    model, data : (lines, responses, references) arrays
        Present model, and measurement with accepted faults put right.
    weight : array like ``data``
    """
    out: list[Candidate] = []
    before = weight * np.abs(data - model) ** 2
    total, count = float(before.sum()), max(int(np.count_nonzero(weight)), 1)
    row = {int(d): i for i, d in enumerate(lines.responses)}
    column = {int(d): i for i, d in enumerate(lines.references)}
    for term in terms:
        if term.kind.places == 2:
            i, k = (row[d] for d in term.index)
            after = weight[:, i] * np.abs(data[:, i] - model[:, k]) ** 2 + weight[:, k] * np.abs(data[:, k] - model[:, i]) ** 2
            cost = total - float(before[:, i].sum() + before[:, k].sum()) + float(after.sum())
            out.append(Candidate(term, np.zeros(0), cost / count))
            continue
        force = term.kind.group == "force"
        where = (slice(None), slice(None), column[term.index[0]]) if force else (slice(None), row[term.index[0]], slice(None))
        found = _channel(term, data[where], model[where], weight[where], lines, force)
        if found is not None:
            q, after_sum = found
            out.append(Candidate(term, q, (total - float(before[where].sum()) + after_sum) / count))
    return out


def _channel(term: Term, x: Array, h: Array, w: Array, lines: CheckLines, force: bool) -> tuple[Array, float] | None:
    """Moving numbers of one channel's fault and the weighted square that it leaves."""
    omega = lines.omega[:, None]
    names = term.moving
    if names == ("gain",):
        gain = float(np.sum(w * np.real(np.conj(h) * x)) / max(float(np.sum(w * np.abs(h) ** 2)), 1e-300))
        if gain <= 0.05:
            return None
        return term.inward({"gain": 1 / gain if force else gain}), float(np.sum(w * np.abs(x - gain * h) ** 2))
    if names == ("delay",):
        # A coarse grid first: the phase wraps.
        grid = np.linspace(-2.5, 2.5, 101) / float(lines.hz.max())
        delay = float(grid[int(np.argmin([np.sum(w * np.abs(x - h * np.exp(-1j * omega * d)) ** 2) for d in grid]))])
        for _ in range(8):
            turned = h * np.exp(-1j * omega * delay)
            slope = -1j * omega * turned
            delay += float(np.sum(w * np.real(np.conj(slope) * (x - turned))) / max(float(np.sum(w * np.abs(slope) ** 2)), 1e-300))
        return term.inward({"delay": -delay if force else delay}), float(np.sum(w * np.abs(x - h * np.exp(-1j * omega * delay)) ** 2))
    values = term.kind.defaults(term.band_hz) | term.constants
    factor = np.asarray(term.kind.sensor_map(lines.hz, values))[:, None]
    return term.inward(values), float(np.sum(w * np.abs(x - h * (1 / factor if force else factor)) ** 2))
