"""What a diagnosis that found nothing would have seen: each mode in band moved by its half-power width."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from operando.compare.verdict import GOOD, floor_reason, shift_reason
from operando.diagnose.levenberg import weights
from operando.diagnose.predict import IdleArrays, predict
from operando.diagnose.sets import JUDGE

if TYPE_CHECKING:
    from operando.diagnose.problem import Problem


def shifts(problem: Problem) -> dict[float, float]:
    """Rise of the reduced chi-square of all lines by each mode in band [Hz] that moves by one half-power width, 2ζf."""
    lines, own = problem.lines, problem.own
    w = weights(lines, own)
    terms = problem.idle.terms
    low, high = float(lines.hz.min()), float(lines.hz.max())
    data = predict(problem.arrays, lines, (), ()).data
    out = {}
    for r in np.flatnonzero(terms.in_band & (terms.frequencies_hz > low) & (terms.frequencies_hz < high)):
        hz = np.array(terms.frequencies_hz)
        hz[r] *= 1 + 2 * terms.damping_ratios[r]
        moved = predict(IdleArrays.of(problem.idle.with_terms(frequencies_hz=hz)), lines, (), ()).data
        out[float(terms.frequencies_hz[r])] = float(np.sum(w * np.abs(moved - data) ** 2) / max(int(np.sum(w > 0)), 1))
    return out


def what_hides(problem: Problem) -> str:
    """Which variance is the larger one on the judge lines, and the measurement that lowers it."""
    lines, own = problem.sets[JUDGE], problem.owns[JUDGE]
    good = np.isfinite(lines.variance)
    if float(np.mean(own[good] / (own[good] + lines.variance[good]))) > 0.5:
        return "the idle model's own uncertainty hides it: measure the FRFs at rest again with more averages, and force at more points"
    return "the noise of the validation measurement hides it: measure again in operation with a larger force or more averages"


def unseen(problem: Problem, noise_floor_db: float | None, now: float) -> tuple[str | None, list[dict[str, Any]]]:
    """Why a change could have passed, and the least frequency shift of each mode that would not have.

    Parameters
    ----------
    problem : Problem
    noise_floor_db : float or None
    now : float
        Reduced chi-square of the idle model on the judge set.
    """
    rise = shifts(problem)
    terms = problem.idle.terms
    width = dict(zip(terms.frequencies_hz.tolist(), (2 * terms.damping_ratios * terms.frequencies_hz).tolist(), strict=True))
    detectable: list[dict[str, Any]] = [
        {
            "kind": "frequency_shift",
            "location": [],
            "parameter": f"mode at {hz:.4g} Hz",
            # the rise goes with the square of the shift
            "value": float(width[hz] * np.sqrt(max(GOOD - now, 0.0) / value)) if value > 0 else None,
            "unit": "Hz",
        }
        for hz, value in rise.items()
    ]
    return floor_reason(noise_floor_db) or shift_reason({hz: now + value for hz, value in rise.items()}), detectable
