"""Force over displacement of one device moved to and fro: friction and play told from the loops.

A damper on a test machine has no modes: its displacement is imposed and its force measured. What it is shows in how the force goes on after
each reversal: a spring and a damper answer at once, dry friction is a plateau that only the direction decides, play is a part of the travel
without force before the plateau is reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.contrib.signals import checked_signals
from operando.data.objects import Short, counted
from operando.errors import DataError
from operando.indicators import INTERVAL
from operando.structure.effects import with_spread

Real = NDArray[np.float64]

IMPROVES = 0.10
"""A part of the law lowers the error on strokes that were not fitted by more than this part."""

SHORTEST = 0.08
"""Strokes shorter than this part of the longest are left out."""

FOLDS = 3
POINTS = 200
"""Points of a stroke that are compared, evenly spread over its travel."""


@dataclass(frozen=True, repr=False, eq=False)
class LoopFit(Short):
    """What the loops of force over displacement show.

    Parameters
    ----------
    kinds : tuple of str
        ``coulomb_friction`` and ``clearance`` where each lowers the error on strokes that were not fitted; empty where spring and damper
        say as much.
    values : dict
        ``force`` (mean slip force), ``force_forward``, ``force_backward``, ``stiffness`` (on the way to the plateau) and ``gap`` (half the
        play), in the units of the signals; those of the kinds named.
    std : dict
        Standard deviations of the same, from leaving strokes out.
    errors : dict
        Mean absolute error over mean absolute force on strokes that were not fitted: ``linear``, ``coulomb_friction``, ``clearance``
        (friction with play).
    strokes : int
        Strokes used.
    dissipated : float
        Work the device took over that of the same strokes at full plateau: 1 is dry friction without play or elasticity.
    """

    kinds: tuple[str, ...]
    values: dict[str, float]
    std: dict[str, float]
    errors: dict[str, float]
    strokes: int
    dissipated: float

    def facts(self) -> dict[str, str]:
        """What the short form says; sizes are in the units of the signals."""
        sizes = [f"{name.replace('_', ' ')} {with_spread(v, INTERVAL * self.std[name])}" for name, v in self.values.items()]
        return {
            "Laws": " and ".join(k.replace("_", " ") for k in self.kinds) or "spring and damper",
            "Values": ", ".join(sizes),
            "Units": "in the units of the signals, ± 95 %",
            "Error": f"error {100 * min(self.errors.values()):.2g} % of the force on strokes that were not fitted",
            "Strokes": counted(self.strokes, "stroke"),
        }


@dataclass(frozen=True)
class Stroke:
    """One way between two reversals."""

    sense: float  # 1 towards larger displacement, −1 back
    travel: Real  # way gone since the reversal (P,)
    force: Real
    displacement: Real
    velocity: Real
    start: float  # force at the reversal


def fit_loop(displacement: ArrayLike, force: ArrayLike, sampling_hz: float) -> LoopFit:
    """Friction and play of a device from its displacement and its force.

    The law over the way gone since a reversal: from the force at the reversal back to zero with the stiffness of the device, zero over the
    play, up again with the same stiffness to the slip force of the new direction, and that from there on. Fitted and compared by absolute
    errors: play ends in a blow that rings.

    Parameters
    ----------
    displacement, force : (N,) arrays
        Any units; the values found have them.
    sampling_hz : float
        Samples a second.

    Returns
    -------
    LoopFit

    Raises
    ------
    DataError
        If a sample is not finite, the signals differ in length, or hold fewer than six strokes.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(2000) / 500
    >>> way = 0.02 * np.sin(np.pi * time / 4) * np.sin(4 * np.pi * time)
    >>> fit_loop(way, 800 * np.sign(np.gradient(way)), 500.0).kinds
    ('coulomb_friction',)
    """
    x, f = checked_signals(sampling_hz, displacement=displacement, force=force)
    strokes = strokes_of(x, f, sampling_hz)
    if len(strokes) < 2 * FOLDS:
        raise DataError(
            f"{len(strokes)} strokes to and fro are too few to identify a force law", hint="six at least; move the device more often"
        )
    fold = np.arange(len(strokes)) * FOLDS // len(strokes)
    size = float(np.mean(np.abs(np.concatenate([s.force for s in strokes]))))
    errors = dict.fromkeys(MODELS, 0.0)
    parts: dict[str, list[Real]] = {name: [] for name in MODELS}
    for k in range(FOLDS):
        fitted = [s for s, i in zip(strokes, fold, strict=True) if i != k]
        validation = [s for s, i in zip(strokes, fold, strict=True) if i == k]
        for name, (fit, predict) in MODELS.items():
            values = fit(fitted)
            parts[name].append(values)
            errors[name] += _apart(validation, [predict(s, values) for s in validation]) / FOLDS / size
    kinds: list[str] = []
    best = "linear"
    for name in ("coulomb_friction", "clearance"):
        if errors[name] < (1 - IMPROVES) * errors[best]:
            kinds.append(name)
            best = name
    if "clearance" in kinds and "coulomb_friction" not in kinds:
        kinds.insert(0, "coulomb_friction")
    values = MODELS[best][0](strokes)
    spread = np.sqrt((FOLDS - 1) / FOLDS * np.sum((np.array(parts[best]) - np.mean(parts[best], axis=0)) ** 2, axis=0))
    stated, std = _named(best, values, spread)
    level = 0.5 * (stated.get("force_forward", size) + stated.get("force_backward", size))
    work = sum(float(np.trapezoid(s.sense * s.force, s.travel)) for s in strokes)
    return LoopFit(tuple(kinds), stated, std, errors, len(strokes), work / (level * sum(float(s.travel[-1]) for s in strokes)))


def strokes_of(x: Real, f: Real, sampling_hz: float) -> list[Stroke]:
    """The way between reversals, stroke by stroke; the reversals are those of the displacement without what is faster than a
    thirtieth of the longest stroke's duration."""
    smooth = _smoothed(x)
    v = np.gradient(smooth) * sampling_hz
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0) + 1
    turns = np.concatenate([[0], turns, [x.size - 1]])
    longest = max((abs(smooth[b] - smooth[a]) for a, b in pairwise(turns)), default=0.0)
    out = []
    for a, b in pairwise(turns):
        way = smooth[b] - smooth[a]
        if b - a < 16 or abs(way) < SHORTEST * longest:
            continue
        sense = float(np.sign(way))
        travel = np.maximum.accumulate(sense * (smooth[a : b + 1] - smooth[a]))
        at = np.linspace(0, travel[-1], POINTS)
        # Means over the way, not samples: a blow that rings is many samples of one place.
        edges = np.searchsorted(travel, np.append(at - 0.5 * at[1], travel[-1] + at[1]))
        parts = [slice(max(low, 0), max(high, low + 1)) for low, high in pairwise(edges)]
        own = [np.array([np.mean(signal[a : b + 1][p]) if signal[a : b + 1][p].size else np.nan for p in parts]) for signal in (f, x, v)]
        good = np.isfinite(own[0])
        out.append(Stroke(sense, at[good], own[0][good], own[1][good], own[2][good], float(np.mean(f[max(a - 2, 0) : a + 3]))))
    return out


def _smoothed(x: Real) -> Real:
    """Without fast noise: a raised-cosine mean over a hundredth of the time between crossings of the mean."""
    crossings = np.flatnonzero(np.diff(np.sign(x - np.mean(x))) != 0)
    stroke = float(np.median(np.diff(crossings))) if crossings.size > 2 else x.size / 10
    width = max(3, int(stroke / 30) | 1)
    window = np.sin(np.pi * (np.arange(width) + 0.5) / width) ** 2
    return np.asarray(np.convolve(np.pad(x, width // 2, mode="edge"), window / window.sum(), mode="valid"))


def _apart(strokes: Sequence[Stroke], predicted: Sequence[Real]) -> float:
    return float(np.mean(np.concatenate([np.abs(s.force - p) for s, p in zip(strokes, predicted, strict=True)])))


# Spring, damper and mean force


def _fit_linear(strokes: Sequence[Stroke]) -> Real:
    """k, c and a constant by iteratively reweighted least squares (absolute errors)."""
    table = np.concatenate([np.stack([s.displacement, s.velocity, np.ones_like(s.force)], axis=1) for s in strokes])
    force = np.concatenate([s.force for s in strokes])
    scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    weight = np.ones(force.size)
    values = np.zeros(3)
    for _ in range(30):
        root = np.sqrt(weight)
        values = np.linalg.lstsq(table / scale * root[:, None], force * root, rcond=None)[0] / scale
        rest = np.abs(force - table @ values)
        weight = 1 / np.maximum(rest, 1e-3 * np.mean(np.abs(force)) + 1e-300)
    return np.asarray(values)


def _linear(stroke: Stroke, values: Real) -> Real:
    return np.asarray(values[0] * stroke.displacement + values[1] * stroke.velocity + values[2])


# Friction behind a spring, with and without play


def _after_reversal(stroke: Stroke, values: Real) -> Real:
    """Forward and backward slip force, stiffness, half the play."""
    forward, backward, stiffness, gap = values
    level = forward if stroke.sense > 0 else backward
    # Seen in the direction of the stroke: from −held up to the level of this direction.
    held = max(-stroke.sense * stroke.start, 0.0)
    ahead = max(stroke.sense * stroke.start, 0.0)
    back = held / stiffness
    away = stroke.travel - back
    free = 2 * gap if held > 0 or ahead == 0 else 0.0
    p = np.where(away < 0, stiffness * away, np.clip(stiffness * (away - free) + ahead, min(ahead, level), level))
    p = np.where((away >= 0) & (away < free), 0.0, p)
    return np.asarray(stroke.sense * p)


def _fit_slip(strokes: Sequence[Stroke], with_play: bool) -> Real:
    from scipy.optimize import minimize

    plateau = {s: [st.sense * np.median(st.force[st.travel > 0.5 * st.travel[-1]]) for st in strokes if st.sense == s] for s in (1.0, -1.0)}
    levels = [max(float(np.median(p)), 1e-12) if p else 1e-12 for p in plateau.values()]
    longest = max(float(s.travel[-1]) for s in strokes)
    size = float(np.mean(levels))

    def cost(moved: Real) -> float:
        values = np.exp(np.append(moved, [] if with_play else [-700.0]))
        return _apart(strokes, [_after_reversal(s, values) for s in strokes])

    # The way to the plateau and the play are short or long: the misfit has a valley for each.
    ways = (0.01, 0.04, 0.15)
    starts = [[*levels, size / (reach * longest), 0.5 * play * longest] for reach in ways for play in (ways if with_play else (1.0,))]
    found = [
        minimize(
            cost, np.log(start[: 4 if with_play else 3]), method="Nelder-Mead", options={"maxfev": 300, "xatol": 1e-3, "fatol": 1e-6 * size}
        )
        for start in starts
    ]
    return np.exp(np.append(min(found, key=lambda f: f.fun).x, [] if with_play else [-700.0]))


MODELS = {
    "linear": (_fit_linear, _linear),
    "coulomb_friction": (lambda strokes: _fit_slip(strokes, False), _after_reversal),
    "clearance": (lambda strokes: _fit_slip(strokes, True), _after_reversal),
}


NAMES = {
    "linear": ("stiffness", "damping", "offset"),
    "coulomb_friction": ("force_forward", "force_backward", "stiffness"),
    "clearance": ("force_forward", "force_backward", "stiffness", "gap"),
}


def _named(model: str, values: Real, spread: Real) -> tuple[dict[str, float], dict[str, float]]:
    """Values and standard deviations by name."""
    stated, std = (dict(zip(NAMES[model], map(float, row), strict=False)) for row in (values, spread))
    if model == "linear":
        return stated, std
    force = 0.5 * (stated["force_forward"] + stated["force_backward"])
    return {"force": force} | stated, {"force": 0.5 * float(np.hypot(std["force_forward"], std["force_backward"]))} | std
