"""Relative model error: where real modes cannot describe the data to their noise, peaks must not rule the fit.

A measured structure is a little nonlinear, a little non-stationary, and its modes are a little complex. Where the noise is far below
that, weighting by noise alone lets the largest peaks force spurious modes. A share of what each mode adds counts as variance then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.ema.normal import residual
from operando.ema.polish_model import Parameters, Real, run_model
from operando.ema.spectra import RunSpectra
from operando.synthesis import combined, power_of

ACCEPTED_MISFIT = 3.0


def contributions(run: RunSpectra, theta: Parameters, index: int) -> Real:
    """Σ over the modes of |φ_jr Q_r|², and |outside part|², (m, L).

    A model error is a share of what each mode adds, not of the sum: at an antiresonance large terms cancel, and so do not their errors.
    """
    model = run_model(run, theta, index, run.forces)
    phi = theta.shapes[run.response_rows]
    local = theta.local[index]
    return np.asarray(phi**2 @ power_of(model.modal) + power_of(combined(local, model.local)))


def relative_model_error(runs: Sequence[RunSpectra], theta: Parameters) -> float:
    """Share α with median |e|²/(variance + α²·contributions) at that of noise; 0 where the reduced chi-square by noise alone is below 3."""
    error, power, variance = [], [], []
    for i, run in enumerate(runs):
        state = residual(run, theta, i)
        error.append(power_of(state.error).ravel())
        variance.append((state.variance / run.correlated_lines).ravel())
        power.append(contributions(run, theta, i).ravel())
    e, v, p = np.concatenate(error), np.concatenate(variance), np.concatenate(power)
    # Medians: a mode still missing from the candidates is no reason to distrust the rest.
    level = np.log(2.0)
    if float(np.median(e / v)) < ACCEPTED_MISFIT * level:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if float(np.median(e / (v + middle**2 * p))) > level:
            low = middle
        else:
            high = middle
    return high


def with_model_error(runs: Sequence[RunSpectra], theta: Parameters, share: float) -> list[RunSpectra]:
    """Runs whose response variance holds a share of what the modes of ``theta`` add (``theta`` fitted on other lines of these runs)."""
    if share <= 0:
        return list(runs)
    return [
        replace(run, response_variance=run.response_variance + share**2 * run.correlated_lines * contributions(run, theta, i))
        for i, run in enumerate(runs)
    ]
