"""Relative model error: where real modes cannot describe the data to their noise, peaks must not rule the fit.

A measured structure is a little nonlinear, a little non-stationary, and its modes are a little complex. Where the noise is far below
that, weighting by noise alone lets the largest peaks force spurious modes. A share of each response is added to its variance then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.ema.polish import residual
from operando.ema.polish_model import Parameters
from operando.ema.spectra import RunSpectra

ACCEPTED_MISFIT = 3.0


def relative_model_error(runs: Sequence[RunSpectra], theta: Parameters) -> float:
    """Share α with mean |e|²/(variance + α²|X|²) = 1, or 0 where the misfit by noise alone is below 3."""
    ratio, power, variance = [], [], []
    for i, run in enumerate(runs):
        state = residual(run, theta, i)
        noise = run.response_variance + np.einsum("kml,kl->ml", np.abs(state.transfer) ** 2, run.force_variance)
        ratio.append((np.abs(state.error) ** 2).ravel())
        variance.append(noise.ravel())
        power.append((np.abs(run.responses) ** 2).ravel())
    e, v, p = np.concatenate(ratio), np.concatenate(variance), np.concatenate(power)
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


def with_model_error(runs: Sequence[RunSpectra], share: float) -> list[RunSpectra]:
    """Runs whose response variance holds a share of the response itself, smoothed over a few lines."""
    if share <= 0:
        return list(runs)
    out = []
    for run in runs:
        power = np.abs(run.responses) ** 2
        kernel = np.ones(5) / 5
        smooth = np.stack([np.convolve(np.pad(row, 2, mode="edge"), kernel, mode="valid") for row in power])
        out.append(replace(run, response_variance=run.response_variance + share**2 * smooth))
    return out
