"""Figures of records: residuals, the error by step, where the model fails, the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.compare.verdict import GOOD
from operando.effects import Effect
from operando.nonlinear.laws import Motion
from operando.nonlinear.place import Weighted
from operando.nonlinear.run import Complex, running_mean

if TYPE_CHECKING:
    from operando.nonlinear.search import Case

SNR = 100.0
"""Lines whose power is above so many times the variance count for errors in dB."""


def residual(motion: Motion, force: Complex) -> Complex:
    """Weighted error (q, L) that a restoring force (L,) and the free decays leave."""
    along = motion.along
    w = along.weighted
    return decayed(w.with_error(w.error / w.root + along.h * force))


def decayed(weighted: Weighted) -> Complex:
    """Weighted error without the free decays."""
    run = weighted.run
    amplitudes, _ = weighted.ringing()
    return np.asarray(weighted.error - (run.decay_shapes @ (amplitudes[:, None] * run.decays)) * weighted.root)


def figures(weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, float]:
    """Chi-square, error in dB and noise floor of runs with given errors (q, L)."""
    power, count, squares, floor, n = 0.0, 0, 0.0, 0.0, 0
    for w, error in zip(weighted, errors, strict=True):
        run, rest = w.run, decayed(w.with_error(error))
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
        rest = np.abs(decayed(w.with_error(error))) ** 2
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


def step_row(step: int, added: Effect | None, weighted: Sequence[Weighted], fitted: int, errors: Sequence[Complex]) -> dict[str, Any]:
    """One row of the error table: all runs, and the hold-out set, which stand behind the ``fitted`` ones (all where there is one level)."""
    everything = figures(weighted, errors)
    held = figures(weighted[fitted:], errors[fitted:]) if len(weighted) > fitted else everything
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


def judged_on(case: Case) -> dict[str, Any]:
    """State, level and lines of the figures of the steps on the hold-out set."""
    runs = case.validation or case.fitted
    levels = sorted({float(run.force_level) for run in runs})
    return {
        "state": "operating",
        "measured": "spectra of records",
        "runs": [run.name for run in runs],
        "level": " … ".join(dict.fromkeys(f"{v:.4g}" for v in (levels[0], levels[-1]))) + " N rms",
        "band_hz": [float(v) for v in case.band],
        "n_lines": int(sum(run.rows.size * run.lines.size for run in runs)),
        "whole_run": bool(case.validation),
    }


def where_it_fails(case: Case, weighted: Sequence[Weighted], errors: Sequence[Complex]) -> dict[str, Any]:
    """``by_dof`` and ``by_band`` of the idle model on the validation runs."""
    n = len(case.fitted)
    pairs = list(zip(weighted, errors, strict=True))
    pairs = pairs[n:] or pairs
    by_row: dict[int, list[float]] = {}
    edges = np.geomspace(max(case.band[0], 1e-3), case.band[1], 9)
    bands: list[list[float]] = [[] for _ in range(8)]
    for w, error in pairs:
        run, rest = w.run, np.abs(decayed(w.with_error(error))) ** 2
        for row, power in zip(run.rows, rest, strict=True):
            by_row.setdefault(int(row), []).append(float(np.mean(power)))
        which = np.clip(np.digitize(run.hz, edges) - 1, 0, 7)
        for k in range(8):
            if np.any(which == k):
                bands[k].append(float(np.mean(rest[:, which == k])))
    return {
        "by_dof": [{"dof": str(case.idle.dofs[i]), "error_db": None, "misfit": float(np.mean(v))} for i, v in sorted(by_row.items())],
        "by_band": [
            {"band_hz": [float(edges[k]), float(edges[k + 1])], "error_db": None, "misfit": float(np.mean(v)) if v else None}
            for k, v in enumerate(bands)
        ],
        "by_mode": [],
    }
