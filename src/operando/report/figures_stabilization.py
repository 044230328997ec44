"""Stabilisation diagrams with what was selected and rejected, and singular values of operating spectra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from operando.plots import plot_singular_values, plot_stabilization
from operando.report.svg import drawn, new_figure
from operando.report.text import count
from operando.stabilization import Stabilization

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@drawn
def stabilization_diagram(
    stabilization: Stabilization,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike | None = None,
    harmonics_hz: Sequence[float] = (),
    indicator_name: str = "CMIF",
) -> tuple[Figure, str]:
    """SVG: poles by model order over the mode indicator, modes taken as lines, rejected candidates as crosses below."""
    table = stabilization.table
    modes = np.asarray(stabilization.selected_hz if modes_hz is None else modes_hz, float)
    figure = new_figure(10.2, 4.9)
    axes = plot_stabilization(
        stabilization, figure.add_axes((0.06, 0.105, 0.875, 0.765)), band=band, modes_hz=modes, harmonics_hz=harmonics_hz,
        indicator_name=indicator_name, legend=False,
    )  # fmt: skip
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper left", ncols=5, bbox_to_anchor=(0.05, 1.005), handletextpad=0.3, columnspacing=1.1)
    low, high = axes.get_xlim()
    top = int(table.order.max()) if table.order.size else 1
    alt = f"Stabilisation diagram from {low:.1f} to {high:.1f} Hz up to order {top}: {count(modes.size, 'mode')} taken, "
    alt += f"{count(len(stabilization.rejected), 'candidate')} rejected"
    return figure, alt


@drawn
def singular_values(
    frequencies_hz: ArrayLike,
    values: ArrayLike,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike = (),
    harmonics_hz: Sequence[float] = (),
    unit: str = "(m/s²)²/Hz",
) -> tuple[Figure, str]:
    """SVG: singular values of the operating spectra (n_curves, lines), the greatest first, with modes and harmonics marked."""
    figure = new_figure(10.2, 3.6)
    axes = plot_singular_values(
        frequencies_hz, values, figure.add_axes((0.067, 0.13, 0.918, 0.72)), band=band, modes_hz=modes_hz, harmonics_hz=harmonics_hz,
        unit=unit, legend=False,
    )  # fmt: skip
    low, high = axes.get_xlim()
    figure.legend(loc="upper left", ncols=5, bbox_to_anchor=(0.057, 1.01))
    return figure, f"Singular values of the operating spectra from {low:.1f} to {high:.1f} Hz"
