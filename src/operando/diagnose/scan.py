"""Candidate kinds at all places: a law fitted to what each place shows, channel faults, and changes of the whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnose.localise import Columns, PlaceFit
from operando.diagnose.predict import IdleArrays, Term, predict
from operando.diagnose.refit import Fitted
from operando.diagnose.sets import CheckLines
from operando.effects import Effect, EffectKind

Array = NDArray[Any]

GRID_HZ = 30
"""Frequencies tried for a law that resonates."""


@dataclass(frozen=True)
class Start:
    """A candidate before its refit.

    Parameters
    ----------
    term : Term
    q : array
        Start of its moving numbers.
    score : float
        Mean weighted square a line on the lines scanned; lower is better.
    """

    term: Term
    q: Array
    score: float


def scan_places(
    places: Sequence[PlaceFit],
    index: Sequence[tuple[int, ...]],
    kinds: Sequence[EffectKind],
    idle: ModalModel,
    lines: CheckLines,
    count: int,
    band: tuple[float, float],
) -> list[Start]:
    """Laws δz(ω; values) fitted to the kind-free t(ω) of each place.

    Parameters
    ----------
    places : sequence of PlaceFit
    index : sequence of tuple of int
        DOFs of each place.
    kinds : sequence of EffectKind
        Those that act by a dynamic stiffness on one coordinate.
    idle, lines : ModalModel, CheckLines
    count : int
        Complex values in the weighted sums, to make means of them.
    band : (float, float)
    """
    out: list[Start] = []
    s = 1j * lines.omega
    for place, dofs in zip(places, index, strict=True):
        for kind in kinds:
            if kind.acts != "dynamic_stiffness" or kind.places != len(dofs) or kind.coordinates == "separate":
                continue
            best = _fit_law(place, kind, s, band)
            if best is None:
                continue
            sign, values, cost = best
            effect = Effect(kind.kind, tuple(idle.dofs[d] for d in dofs), values, removed=sign < 0, band_hz=band)
            term = Term.of(effect, idle, band)
            extra = place.score * count - float(place.rest.sum())
            out.append(Start(term, term.inward(effect.values), (float(place.rest.sum()) + cost + extra) / count))
    return out


def _fit_law(place: PlaceFit, kind: EffectKind, s: Array, band: tuple[float, float]) -> tuple[int, dict[str, float], float] | None:
    """Sign, values and cost Σ pull·|t − t_best|² of the best law, or None where only an impossible sign fits."""
    z, g = place.stiffness, place.inner
    weight = place.pull * np.abs(1 - place.t * g) ** 4
    values = kind.defaults(band)
    first, *others = kind.parameters
    grids = [_grid(kind, p.name, band) for p in others]
    found: list[tuple[float, int, dict[str, float]]] = []
    for combination in product(*grids):
        trial = dict(values) | {p.name: v for p, v in zip(others, combination, strict=True)}
        unit = kind.dynamic_stiffness(s, trial | {first.name: 1.0})
        size = float(np.real(np.sum(weight * np.conj(unit) * z)) / max(float(np.sum(weight * np.abs(unit) ** 2)), 1e-300))
        # The weight belongs to the right z; a start from the measured motion is less sure of itself but less blind.
        for amount in (size, 0.3 * size, 3 * size):
            if not np.isfinite(amount) or amount == 0 or (amount < 0 and not kind.removable):
                continue
            t = amount * unit / (1 + amount * unit * g)
            cost = float(np.sum(place.pull * np.abs(t - place.t) ** 2))
            found.append((cost, 1 if amount > 0 else -1, trial | {first.name: abs(amount)}))
    if not found:
        return None
    found.sort(key=lambda item: item[0])
    results = [_polish_law(place, kind, s, sign, trial, band) for _, sign, trial in found[: 1 if not others else 3]]
    return min(results, key=lambda item: item[2])


def _grid(kind: EffectKind, name: str, band: tuple[float, float]) -> list[float]:
    p = kind.parameter(name)
    low, high = p.bounds(band)
    if p.unit == "Hz":
        return list(np.geomspace(low * 1.02, high * 0.98, GRID_HZ))
    a, b = p.inward(low), p.inward(high)
    return [p.outward(v) for v in a + (b - a) * np.array([0.35, 0.65, 0.9])]


def _polish_law(
    place: PlaceFit, kind: EffectKind, s: Array, sign: int, values: dict[str, float], band: tuple[float, float]
) -> tuple[int, dict[str, float], float]:
    """A few damped Gauss–Newton steps of t(values) on the kind-free t."""
    low, high = kind.bounds(band)
    root = np.sqrt(place.pull)
    constants = {p.name: values[p.name] for p in kind.constants}

    def law(q: Array) -> Array:
        z = sign * kind.dynamic_stiffness(s, kind.outward(q) | constants)
        return root * (z / (1 + z * place.inner) - place.t)

    q = np.clip(kind.inward(values), low, high)
    e = law(q)
    cost, damping = float(np.vdot(e, e).real), 1e-3
    for _ in range(15):
        j = np.array([(law(q + 1e-5 * np.eye(q.size)[i]) - e) / 1e-5 for i in range(q.size)])
        normal, gradient = np.real(j.conj() @ j.T), np.real(j.conj() @ e)
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-30 * np.eye(q.size), gradient)
        trial = np.clip(q - np.clip(step, -1, 1), low, high)
        e_new = law(trial)
        new = float(np.vdot(e_new, e_new).real)
        if new < cost:
            done = cost - new < 1e-4 * cost
            q, e, cost, damping = trial, e_new, new, damping / 5
            if done:
                break
        else:
            damping *= 10
            if damping > 1e4:
                break
    return sign, kind.outward(q) | constants, cost


def scan_skew(
    columns: Columns,
    weight: Array,
    pairs: Sequence[tuple[int, ...]],
    kinds: Sequence[EffectKind],
    idle: ModalModel,
    lines: CheckLines,
    band: tuple[float, float],
) -> list[Start]:
    """Kinds on two coordinates with one coefficient: linear in it by the motion measured at the places (equation error)."""
    out: list[Start] = []
    skew = [k for k in kinds if k.acts == "dynamic_stiffness" and k.coordinates == "separate" and len(k.parameters) == 1]
    if not skew:
        return out
    s = 1j * lines.omega
    row_of = {int(d): i for i, d in enumerate(lines.responses)}
    count = max(int(np.count_nonzero(weight)), 1)
    variance = np.where(weight > 0, 1 / np.maximum(weight, 1e-300), np.inf)
    for place in pairs:
        if any(d not in row_of for d in place):
            continue
        x = lines.data[:, [row_of[d] for d in place], :]
        h = columns.into[:, :, list(place)]
        doubt = columns.doubt_into[:, :, list(place)]
        for kind in skew:
            name = kind.parameters[0].name
            unit = kind.matrix(s, {name: 1.0}, 2)
            force = unit @ x
            a = h @ force
            w = weight
            for _ in range(2):
                size = -float(np.sum(w * np.real(np.conj(a) * columns.residual)) / max(float(np.sum(w * np.abs(a) ** 2)), 1e-300))
                spread = size**2 * np.einsum("lok,lkj->loj", doubt, np.abs(force) ** 2)
                w = np.where(np.isfinite(variance), 1 / (variance + spread), 0.0)
            good = w > 0
            logs = float(np.sum(-np.log(w[good] / weight[good])))
            score = (float(np.sum(w * np.abs(columns.residual + size * a) ** 2)) + logs) / count
            effect = Effect(kind.kind, tuple(idle.dofs[d] for d in place), {name: size or 1e-9}, band_hz=band)
            term = Term.of(effect, idle, band)
            out.append(Start(term, term.inward(effect.values), score))
    return out


def scan_channels(
    arrays: IdleArrays, weight: Array, fitted: Fitted, kinds: Sequence[EffectKind], idle: ModalModel, lines: CheckLines, band: tuple[float, float]
) -> list[Start]:
    """Sensor and force faults: gain and delay of each channel from its own rows or columns, and swapped pairs."""
    out: list[Start] = []
    p = fitted.predict(arrays, lines)
    e = np.abs(lines.data - p.data) ** 2 * weight
    count, total = max(int(np.count_nonzero(weight)), 1), float(e.sum())
    w = lines.omega[:, None]

    def add(kind: EffectKind, dofs: tuple[int, ...], values: dict[str, float], cost: float) -> None:
        effect = Effect(kind.kind, tuple(idle.dofs[d] for d in dofs), values, band_hz=band)
        term = Term.of(effect, idle, band)
        out.append(Start(term, term.inward(effect.values), cost / count))

    for kind in kinds:
        if kind.acts != "sensor_map":
            continue
        if kind.places == 2:
            for i, a in enumerate(lines.responses):
                for k in range(i + 1, lines.responses.size):
                    swapped = weight[:, i] * np.abs(lines.data[:, i] - p.data[:, k]) ** 2
                    swapped = swapped + weight[:, k] * np.abs(lines.data[:, k] - p.data[:, i]) ** 2
                    add(kind, (int(a), int(lines.responses[k])), {}, total - float((e[:, i] + e[:, k]).sum()) + float(swapped.sum()))
            continue
        force = kind.group == "force"
        for i, dof in enumerate(lines.references if force else lines.responses):
            x, h, own = (lines.data[:, :, i], p.data[:, :, i], weight[:, :, i]) if force else (lines.data[:, i], p.data[:, i], weight[:, i])
            before = float((e[:, :, i] if force else e[:, i]).sum())
            if not kind.parameters:
                values: dict[str, float] = {}
                after = x + h
            elif kind.parameters[0].name == "gain":
                gain = float(np.sum(own * np.real(np.conj(h) * x)) / max(float(np.sum(own * np.abs(h) ** 2)), 1e-300))
                if gain <= 0.02:
                    continue
                values = {"gain": 1 / gain if force else gain}
                after = x - gain * h
            elif kind.parameters[0].name == "delay":
                # A coarse grid first: the phase wraps.
                grid = np.linspace(-1, 1, 81) / max(4 * lines.hz.max() / 10, 1e-9) / 2
                costs = [float(np.sum(own * np.abs(x - h * np.exp(-1j * w * d)) ** 2)) for d in grid]
                delay = float(grid[int(np.argmin(costs))])
                for _ in range(6):
                    turned = h * np.exp(-1j * w * delay)
                    slope = -1j * w * turned
                    delay += float(np.sum(own * np.real(np.conj(slope) * (x - turned))) / max(float(np.sum(own * np.abs(slope) ** 2)), 1e-300))
                values = {"delay": -delay if force else delay}
                after = x - h * np.exp(-1j * w * delay)
            else:
                values = kind.defaults(band)
                after = x - h
            add(kind, (int(dof),), values, total - before + float(np.sum(own * np.abs(after) ** 2)))
    return out


def scan_whole(
    arrays: IdleArrays, weight: Array, fitted: Fitted, kinds: Sequence[EffectKind], idle: ModalModel, lines: CheckLines, band: tuple[float, float]
) -> list[Start]:
    """Changes of the whole structure, from a coarse line search (their size moves every peak)."""
    out: list[Start] = []
    count = max(int(np.count_nonzero(weight)), 1)
    moved = arrays.with_phi(fitted.nuisance.phi(arrays.phi, fitted.v)) if fitted.nuisance.size else arrays
    for kind in kinds:
        if kind.acts != "modal_change" or len(kind.parameters) != 1:
            continue
        name = kind.parameters[0].name
        tried = []
        for change in (-0.5, -0.3, -0.2, -0.12, -0.07, -0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.7, 1.5):
            term = Term.of(Effect(kind.kind, (), {name: change}, band_hz=band), idle, band)
            q = term.inward({name: change})
            p = predict(moved, lines, (*fitted.terms, term), (*fitted.q, q))
            tried.append(Start(term, q, float(np.sum(weight * np.abs(lines.data - p.data) ** 2)) / count))
        out.append(min(tried, key=lambda start: start.score))
    return out
