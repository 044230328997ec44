"""Figures of records on the hold-out set: the error by step, the discrepancy, where the model fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.compare.verdict import GOOD
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.run import running_mean
from operando.structure.effects import Effect
from operando.structure.modal_space import Complex

SNR = 100.0
"""Lines whose power is above so many times the variance count for errors in dB."""


def figures(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, float]:
    """Chi-square, error in dB and noise floor of runs with given errors (q, L)."""
    power, count, squares, floor, n = 0.0, 0, 0.0, 0.0, 0
    for w, error in zip(weighted, errors, strict=True):
        run, rest = w.run, w.with_error(error).decayed()
        power += float(np.sum(np.abs(rest) ** 2))
        count += rest.size
        measured = run.responses[:, run.lines]
        model = measured - rest * np.sqrt(run.variance)
        good = np.abs(measured) ** 2 > SNR * run.variance
        ratio = np.abs(model[good]) / np.abs(measured[good])
        squares += float(np.sum((20 * np.log10(np.maximum(ratio, 1e-6))) ** 2))
        floor += float(np.sum((8.686 * np.sqrt(run.variance[good] / 2) / np.abs(measured[good])) ** 2))
        n += int(np.sum(good))
    return {
        "misfit": power / max(count, 1),
        "error_db": float(np.sqrt(squares / n)) if n else float("nan"),
        "floor_db": float(np.sqrt(floor / n)) if n else float("nan"),
    }


def discrepancy(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> float:
    """Part α of the responses to be allowed for, for the reduced chi-square to be good; 0 where it is.

    (α|X|)² stands beside the variance, |X|² the mean over neighbouring lines: a random response dips at single lines for no reason.
    """
    parts = []
    for w, error in zip(weighted, errors, strict=True):
        rest = np.abs(w.with_error(error).decayed()) ** 2
        parts.append((rest, running_mean(np.abs(w.run.responses[:, w.run.lines]) ** 2) / w.run.variance))
    count = sum(rest.size for rest, _ in parts)
    misfit = lambda part: sum(float(np.sum(rest / (1 + part**2 * power))) for rest, power in parts) / max(count, 1)  # noqa: E731
    low, high = 0.0, 1.0
    if misfit(low) < GOOD:
        return 0.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if misfit(middle) < GOOD else (middle, high)
    return high


def step_row(step: int, added: Effect | None, case: RecordsCase, weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, Any]:
    """One row of the error table: all runs of a case, and its hold-out set."""
    everything, held = (figures(weighted[part], errors[part]) for part in (slice(None), case.held_out()))
    number = lambda v: float(v) if np.isfinite(v) else None  # noqa: E731
    return {
        "step": step,
        "added": None if added is None else added.to_dict(),
        "error_db": number(everything["error_db"]),
        "heldout_error_db": number(held["error_db"]),
        "misfit": number(everything["misfit"]),
        "heldout_misfit": number(held["misfit"]),
        "noise_floor_db": number(held["floor_db"]),
    }


def judged_on(case: RecordsCase) -> dict[str, Any]:
    """State, level and lines of the figures of the steps on the hold-out set."""
    runs = case.runs[case.held_out()]
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
    part = case.held_out()
    by_row: dict[int, list[float]] = {}
    edges = np.geomspace(max(case.band[0], 1e-3), case.band[1], 9)
    bands: list[list[float]] = [[] for _ in range(8)]
    for w, error in zip(weighted[part], errors[part], strict=True):
        run, rest = w.run, np.abs(w.with_error(error).decayed()) ** 2
        for row, power in zip(run.rows, rest, strict=True):
            by_row.setdefault(int(row), []).append(float(np.mean(power)))
        which = np.clip(np.digitize(run.hz, edges) - 1, 0, 7)
        for k in np.unique(which):
            bands[k].append(float(np.mean(rest[:, which == k])))
    return {
        "by_dof": [{"dof": str(case.idle.dofs[i]), "error_db": None, "misfit": float(np.mean(v))} for i, v in sorted(by_row.items())],
        "by_band": [
            {"band_hz": [float(edges[k]), float(edges[k + 1])], "error_db": None, "misfit": float(np.mean(v)) if v else None}
            for k, v in enumerate(bands)
        ],
        "by_mode": [],
    }
