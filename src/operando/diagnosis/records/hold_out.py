"""Figures of records on the hold-out set: the error by step, the discrepancy, where the model fails."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import brentq

from operando.compare.measures import Lines, band_edges, error_db, misfit, noise_floor_db
from operando.compare.verdict import GOOD
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.run import running_mean
from operando.structure.effects import Effect
from operando.structure.modal_space import Complex


def lines_of(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> Lines:
    """All responses of runs with given errors (q, L), as lines that are compared."""
    rest = [w.with_error(error).decayed() / w.root for w, error in zip(weighted, errors, strict=True)]
    measured = np.concatenate([w.run.responses[:, w.run.lines].ravel() for w in weighted])
    variance = np.concatenate([w.run.variance.ravel() for w in weighted])
    rows = np.concatenate([np.repeat(w.run.rows, w.run.hz.size) for w in weighted])
    hz = np.concatenate([np.tile(w.run.hz, w.run.rows.size) for w in weighted])
    return Lines(measured - np.concatenate([r.ravel() for r in rest]), measured, variance, np.zeros_like(variance), rows, hz)


def discrepancy(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> float:
    """Part α of the responses to be allowed for, for the reduced chi-square to be good; 0 where it is.

    (α|X|)² stands beside the variance, |X|² the mean over neighbouring lines: a random response dips at single lines for no reason.
    """
    parts = []
    for w, error in zip(weighted, errors, strict=True):
        rest = np.abs(w.with_error(error).decayed()) ** 2
        parts.append((rest, running_mean(np.abs(w.run.responses[:, w.run.lines]) ** 2) / w.run.variance))
    count = sum(rest.size for rest, _ in parts)
    left = lambda part: sum(float(np.sum(rest / (1 + part**2 * power))) for rest, power in parts) / max(count, 1) - GOOD  # noqa: E731
    if left(0.0) < 0:
        return 0.0
    return 1.0 if left(1.0) >= 0 else float(brentq(left, 0.0, 1.0))


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
