"""Figures of the comparison: error of each model, error by DOF and band, frequency and height by mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.plots import plot_changes, plot_error_map, plot_errors
from operando.plots.errors import error_scale, error_top
from operando.report.svg import drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@drawn
def error_bars(names: Sequence[str], keys: Sequence[str], error_db: ArrayLike, noise_floor_db: float | None) -> tuple[Figure, str]:
    """SVG: rms error of each model [dB] as a bar, with the noise floor as a line: what noise and model uncertainty explain."""
    values = np.asarray(error_db, float)
    height = 0.62 + 0.3 * values.size
    figure = new_figure(7.6, height)
    axes = figure.add_axes((0.36, 0.42 / height, 0.56, (height - 0.58) / height))
    plot_errors(
        names, values, axes, keys=keys, noise_floor_db=noise_floor_db, label="Level error against the validation measurement, rms [dB]"
    )
    return figure, "Error of each model in dB: " + ", ".join(f"{n} {v:.2f}" for n, v in zip(names, values, strict=True))


@drawn
def error_maps(
    maps: Sequence[tuple[str, NDArray[np.float64]]], rows: Sequence[str], edges: ArrayLike, measure: str = "Level error, rms [dB]"
) -> tuple[Figure, str]:
    """SVG: error by response DOF (rows) and frequency band (columns, between edges in Hz), one map a model, one colour scale.

    NaN stands where no line stands clear of the noise.
    """
    n, k = max(len(rows), 1), max(len(maps), 2)
    cell = float(np.clip(4.2 / n, 0.13, 0.26))
    foot, left, gap, width = 0.5, 0.68, 0.62, 10.2
    height = n * cell + foot + 0.3
    panel = (width - left - 0.85 - gap * (k - 1)) / k
    figure = new_figure(width, height)
    top = error_top([values for _, values in maps])
    for i, (title, values) in enumerate(maps):
        axes = figure.add_axes(((left + i * (panel + gap)) / width, foot / height, panel / width, n * cell / height))
        plot_error_map(values, rows, edges, axes, top=top, measure=measure, title=title)
        if i:
            axes.set_ylabel("")
    beside = figure.add_axes(((width - 0.7) / width, foot / height, 0.125 / width, n * cell / height))
    error_scale(figure.colorbar(axes.collections[0], cax=beside), measure)
    return figure, "Error by response DOF and frequency band: " + ", ".join(title for title, _ in maps)


@drawn
def frequency_changes(
    labels: Sequence[str], frequency_percent: ArrayLike, damping_percent: ArrayLike, frequency_std: ArrayLike, damping_std: ArrayLike
) -> tuple[Figure, str]:
    """SVG: change of frequency and of damping ratio [%] from idle to operating for each paired mode, with 95 % intervals.

    Standard deviations [%] are NaN where not known.
    """
    figure = new_figure(10.2, 2.5)
    for left, values, std, title in (
        (0.06, frequency_percent, frequency_std, "Frequency, operating against idle"),
        (0.56, damping_percent, damping_std, "Damping ratio, operating against idle"),
    ):
        plot_changes(labels, values, std, figure.add_axes((left, 0.3, 0.43, 0.57)), title=title)
    return figure, "Change of frequency and damping ratio of each mode from idle to operating"
