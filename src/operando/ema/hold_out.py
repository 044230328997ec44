"""Reduced chi-square on lines the fit did not use."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operando.ema.normal import Information
from operando.ema.order import refine
from operando.ema.polish import Outside, Polished, run_misfit
from operando.ema.polish_model import Real
from operando.ema.spectra import RunSpectra

N_BLOCKS = 18


def hold_out_masks(runs: Sequence[RunSpectra]) -> list[NDArray[np.bool_]]:
    """Lines kept away from the fit: one third of 18 contiguous blocks, other blocks in each run.

    Where several runs excite different references, what one run does not show the fit another one does, so no mode is lost.
    With one run the blocks are narrow, so that each resonance keeps lines on both sides.
    """
    masks = []
    for i, run in enumerate(runs):
        lines = run.frequencies_hz.size
        blocks = N_BLOCKS if len(runs) > 1 else max(N_BLOCKS, lines // 5)
        number = (np.arange(lines) * blocks) // lines
        masks.append((number + i) % 3 == 0)
    return masks


def heldout_misfit(
    runs: Sequence[RunSpectra], n_dofs: int, fit: Polished, band: tuple[float, float], terms: Outside, known: Information | None = None
) -> tuple[float, Real, float]:
    """Refit without the hold-out lines, from the final values, and evaluate it there by the measurement variance alone.

    Mean |e|²/var over hold-out lines within the band, responses and runs: of the modes with the residual ``terms`` of the model, the same
    by row (M,), and with what lies outside free in each run, as it is fitted. ``known`` is the normal matrix of the fit without the
    hold-out lines, where it is that of these runs.
    """
    masks = hold_out_masks(runs)
    kept = [run.lines(~mask) for run, mask in zip(runs, masks, strict=True)]
    theta = fit.parameters
    partial = refine(kept, n_dofs, theta.hz, theta.zeta, lower=False, start=theta, max_iterations=6, tolerance=0.5, known=known)
    seen = [mask & (run.frequencies_hz >= band[0]) & (run.frequencies_hz <= band[1]) for run, mask in zip(runs, masks, strict=True)]
    return *run_misfit(runs, partial.parameters, seen, terms), run_misfit(runs, partial.parameters, seen)[0]
