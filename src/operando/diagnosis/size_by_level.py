"""Whether FRFs of several levels differ, and effects found in them are as large at the lowest as at the highest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, TimeRecord, force_rms, level_groups
from operando.diagnosis.criteria import LEVEL_CHANGE, ONE_SYSTEM, UNUSUAL
from operando.diagnosis.lines import alike_lines
from operando.frf import estimate_frf
from operando.results import CheckRun
from operando.structure import Model
from operando.structure.effects import Effect

Array = NDArray[Any]

_STEP = 1e-3  # of a size, relative: FRFs are smooth in it
_LINES = 300  # of an estimate that can be made at any


@dataclass(frozen=True)
class SizeByLevel:
    """How an effect's size changes from the lowest to the highest level.

    ``levels`` are the least and largest rms force of the two [N]; ``change`` is that of the size, over the size; ``std`` its standard
    deviation.
    """

    effect: Effect
    levels: tuple[float, float]
    change: float
    std: float

    @property
    def changes(self) -> bool:
        """Whether the size is another one: by ``UNUSUAL`` standard deviations, and by more than ``LEVEL_CHANGE`` of it."""
        return abs(self.change) > max(UNUSUAL * self.std, LEVEL_CHANGE)

    def __str__(self) -> str:
        where = f" at {self.effect.place}" if self.effect.place else ""
        (low, high), kind = self.levels, self.effect.kind.replace("_", " ")
        return (
            f"from {low:.3g} to {high:.3g} N rms the size of the {kind}{where} changes by {100 * self.change:+.0f} % of itself "
            f"(standard deviation {100 * self.std:.1g} %)"
        )


def sizes_by_level(model: Model, records: Sequence[TimeRecord], band: tuple[float, float] | None) -> list[SizeByLevel]:
    """By how much the size of each effect on the structure differs between the lowest and the highest level of the records.

    FRFs of all levels together differ from those of one by no more than noise where an effect is faint, and may still tell by many
    standard deviations that it is there: so its size is fitted to the FRFs of each level at first order, beside gains of the forces.
    What the model misses at both levels alike falls out of the difference.

    The records are of the running structure, with forces; the band is in Hz. Empty with records of one level or without effects of a size.
    """
    groups = level_groups([r for r in records if r.force_indices])
    sized = [k for k, e in enumerate(model.effects) if e.definition.group in ("structure", "idle") and _size(e)]
    if len(groups) < 2 or not sized:
        return []
    spacing = None if band is None else (band[1] - band[0]) / _LINES
    fits = [_fitted(model, sized, estimate_frf(group, band=band, line_spacing_hz=spacing)) for group in (groups[0], groups[-1])]
    levels = min(map(force_rms, groups[0])), max(map(force_rms, groups[-1]))
    change, std = fits[1][0] - fits[0][0], np.sqrt(fits[0][1] + fits[1][1])
    return [SizeByLevel(model.effects[k], levels, float(c), float(s)) for k, c, s in zip(sized, change, std, strict=True)]


def _size(effect: Effect) -> float:
    """The first value of an effect, which is its size; 0 where it has none."""
    names = effect.definition.parameters if effect.kind != "missing_mode" else ()
    return effect.values[names[0].name] if names else 0.0


def _fitted(model: Model, sized: Sequence[int], frf: Frf) -> tuple[Array, Array]:
    """What is missing to each size over the size, by the FRFs of a level, and its variance."""
    known = [d for d in frf.responses if any(d.same_axis(o) for o in model.idle.dofs)]
    driven = [d for d in frf.references if any(d.same_axis(o) for o in model.idle.dofs)]
    frf = frf.select(known, driven)
    h, variance = np.moveaxis(frf.data, 2, 0), np.moveaxis(np.asarray(frf.variance), 2, 0)
    good = (np.isfinite(h) & np.isfinite(variance) & (variance > 0)).all(axis=(1, 2))
    alike = alike_lines(h[good].reshape(int(good.sum()), -1), variance[good].reshape(int(good.sum()), -1))
    at = np.flatnonzero(good)
    at = at[:: max(round(alike), 1)]  # lines whose noise is each its own
    hz, weight = frf.frequencies_hz[at], np.sqrt(2 / variance[at])

    def predicted(one: Model) -> Array:
        return np.moveaxis(one.frf(hz, known, driven, frf.quantity, variance=False).data, 2, 0)

    now, columns = predicted(model), []
    for k in sized:
        name, value = model.effects[k].definition.parameters[0].name, _size(model.effects[k])
        columns.append((predicted(model.with_values(k + 1, **{name: value * (1 + _STEP)})) - now) / _STEP)
    for j in range(len(driven)):  # gain and phase of each force
        own = now * (np.arange(len(driven)) == j)
        columns += [own, 1j * own]
    rows = np.stack([np.ascontiguousarray(c * weight).view(float).ravel() for c in columns], axis=1)
    left = np.ascontiguousarray((h[at] - now) * weight).view(float).ravel()
    solution, *_ = np.linalg.lstsq(rows, left, rcond=None)
    noise = max(1.0, float(np.sum((left - rows @ solution) ** 2)) / (left.size - solution.size))
    return solution[: len(sized)], noise * np.diag(np.linalg.pinv(rows.T @ rows))[: len(sized)]


def levels_disagree(check: Sequence[CheckRun], band: tuple[float, float] | None = None) -> bool:
    """Whether runs of different level differ by more than noise: as found when they were estimated, or on the lines of a band."""
    if any(f.kind == "nonlinear" for run in check for f in run.frf.findings):
        return True
    if band is None:
        return False
    for one, other in combinations(check, 2):
        a, b = one.frf.band(*band), other.frf.band(*band)
        alike = a.responses == b.responses and a.references == b.references and np.array_equal(a.frequencies_hz, b.frequencies_hz)
        if one.level == other.level or not alike or a.variance is None or b.variance is None:
            continue
        b = b.to_quantity(a.quantity)
        assert b.variance is not None
        if np.nanmean(np.abs(a.data - b.data) ** 2 / (a.variance + b.variance)) > ONE_SYSTEM:
            return True
    return False
