"""Figures of records on the hold-out set: the error by step, the discrepancy, where the model fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from operando.compare.measures import Lines, band_edges, error_db, misfit, noise_floor_db
from operando.diagnosis.lines import changes
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.run import running_mean
from operando.indicators import INTERVAL
from operando.structure.effects import Effect
from operando.structure.modal_space import Complex, Real

DISCREPANCY = 0.03
"""Part of the responses by which a law may be off (contract, ``explained``): forces follow from a motion whose errors no covariance
carries, those of contacts above all."""

_ALIKE = 2.0  # widths over which FRFs change, in one stretch of frequency: what neighbours share is seen, and most bands have twenty


def lines_of(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> Lines:
    """All responses of runs with given errors (q, L), as lines that are compared."""
    rest = [w.with_error(error).decayed() / w.root for w, error in zip(weighted, errors, strict=True)]
    measured = np.concatenate([w.run.responses[:, w.run.lines].ravel() for w in weighted])
    variance = np.concatenate([w.run.variance.ravel() for w in weighted])
    rows = np.concatenate([np.repeat(w.run.rows, w.run.hz.size) for w in weighted])
    hz = np.concatenate([np.tile(w.run.hz, w.run.rows.size) for w in weighted])
    return Lines(measured - np.concatenate([r.ravel() for r in rest]), measured, variance, np.zeros_like(variance), rows, hz)


@dataclass(frozen=True)
class Discrepancy:
    """What a model leaves of responses, weighed, and their power over its variance, (q, L) of each run.

    (α|X|)² stands beside the variance, |X|² the mean over neighbouring lines: a random response dips at single lines for no reason.
    ``stretches`` number the lines (L,) of each run by where a discrepancy stays alike.
    """

    left: list[Real]
    power: list[Real]
    stretches: list[NDArray[np.int_]]

    @classmethod
    def of(cls, case: RecordsCase, weighted: Sequence[Weighted], errors: Sequence[Complex]) -> Discrepancy:
        """Of runs of a case with given errors (q, L)."""
        left = [np.abs(w.with_error(error).decayed()) ** 2 for w, error in zip(weighted, errors, strict=True)]
        power = [running_mean(np.abs(w.run.responses[:, w.run.lines]) ** 2) / w.run.variance for w in weighted]
        modes = case.idle.frequencies_hz, case.idle.damping_ratios
        return cls(left, power, [(changes(w.run.hz, case.band, *modes) / _ALIKE).astype(int) for w in weighted])

    def chi_square(self, alpha: float) -> float:
        """Reduced chi-square where this part of the responses is allowed for."""
        total = sum(float(np.sum(rest / (1 + alpha**2 * power))) for rest, power in zip(self.left, self.power, strict=True))
        return total / max(sum(rest.size for rest in self.left), 1)

    def to_dict(self) -> dict[str, float]:
        """Part α of the responses that makes the reduced chi-square one, 0 where it is less without; and its standard deviation.

        The scatter of what stretches of frequency have beyond one, neighbours together (Newey & West, Econometrica 55, 1987, 703–708), says
        how well that mean is known: errors of one force law are alike at all responses and over a resonance. It says so of α²; the
        standard deviation of α is that of the wider side of its 95 % interval.
        """
        if self.chi_square(0.0) <= 1:
            alpha = 0.0
        else:
            alpha = 1.0 if self.chi_square(1.0) >= 1 else float(brentq(lambda part: self.chi_square(part) - 1, 0.0, 1.0))
        beyond, slope = np.zeros(1 + max(int(at.max(initial=0)) for at in self.stretches)), 0.0
        for rest, power, at in zip(self.left, self.power, self.stretches, strict=True):
            total = 1 + alpha**2 * power
            beyond += np.bincount(at, weights=(rest / total - 1).sum(axis=0), minlength=beyond.size)
            slope += float(np.sum(power / total))
        scatter = float(np.sqrt((beyond @ beyond + beyond[1:] @ beyond[:-1]) * beyond.size / max(beyond.size - 1, 1)))
        low, high = (np.sqrt(max(alpha**2 + side * INTERVAL * scatter / slope, 0.0)) for side in (-1, 1))
        return {"value": alpha, "std": float(max(alpha - low, high - alpha) / INTERVAL)}


def step_row(step: int, added: Effect | None, case: RecordsCase, weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, Any]:
    """One row of the error table: all runs of a case, and its hold-out set."""
    everything, held = (lines_of(weighted[part], errors[part]) for part in (slice(None), case.hold_out()))
    return {
        "step": step,
        "added": None if added is None else added.to_dict(),
        "error_db": error_db(everything),
        "heldout_error_db": error_db(held),
        "misfit": misfit(everything),
        "heldout_misfit": misfit(held),
        "noise_floor_db": noise_floor_db(held),
    }


def judged_on(case: RecordsCase) -> dict[str, Any]:
    """State, level and lines of the figures of the steps on the hold-out set."""
    runs = case.runs[case.hold_out()]
    levels = sorted({float(run.force_level) for run in runs})
    return {
        "state": "operating",
        "measured": "spectra of records",
        "runs": [run.name for run in runs],
        "level": levels[0],
        "unit": "N",
        "level_name": " … ".join(dict.fromkeys(f"{v:.4g}" for v in (levels[0], levels[-1]))) + " N rms",
        "band_hz": [float(v) for v in case.band],
        "n_lines": int(sum(run.rows.size * run.lines.size for run in runs)),
        "whole_run": bool(case.validation),
    }


def where_it_fails(case: RecordsCase, weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, Any]:
    """``by_dof`` and ``by_band`` of the idle model on the validation runs."""
    part = case.hold_out()
    lines = lines_of(weighted[part], errors[part])
    edges = band_edges(max(case.band[0], 1e-3), case.band[1])
    bands = np.clip(np.digitize(lines.frequency_hz, edges) - 1, 0, edges.size - 2)
    return {
        "by_dof": [
            {"dof": str(case.idle.dofs[i]), "error_db": None, "misfit": misfit(lines.where(lines.response == i))}
            for i in np.unique(lines.response)
        ],
        "by_band": [
            {"band_hz": [float(low), float(high)], "error_db": None, "misfit": misfit(lines.where(bands == k))}
            for k, (low, high) in enumerate(pairwise(edges))
        ],
        "by_mode": [],
    }
