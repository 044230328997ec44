"""Stabilisation diagrams with what was selected and rejected, and singular values of operating spectra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.report.svg import GREY, IDLE, INK, MODEL, ORANGE, PALE, PURPLE, SKY, dots, drawn, log_axis, new_figure, thin
from operando.report.text import count
from operando.stabilization import Stabilization

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CLASSES = (
    (4, "not physical", "#d3d9df", 1.6),
    (0, "new", "#b4bdc6", 2.0),
    (1, "frequency stable", ORANGE, 2.6),
    (2, "and damping stable", SKY, 3.0),
    (3, "and vector stable", MODEL, 3.4),
)


def stabilization_diagram(
    stabilization: Stabilization,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike | None = None,
    harmonics_hz: Sequence[float] = (),
    indicator_name: str = "CMIF",
) -> str:
    """SVG: poles by model order over the mode indicator, modes taken as lines, rejected candidates as crosses below.

    Parameters
    ----------
    stabilization : Stabilization
    band : (float, float), optional
        Analysis band [Hz].
    modes_hz : array, optional
        Final frequencies of the modes (after refinement); default: those selected in the diagram.
    harmonics_hz : sequence of float
        Harmonics of rotation [Hz], dashed.
    indicator_name : str
        What is drawn behind the poles.
    """
    return _stabilization_diagram(stabilization, band, modes_hz, harmonics_hz, indicator_name)


@drawn
def _stabilization_diagram(
    stabilization: Stabilization, band: Sequence[float] | None, modes_hz: ArrayLike | None, harmonics_hz: Sequence[float], name: str
) -> tuple[Figure, str]:
    table = stabilization.table
    modes = np.asarray(stabilization.selected_hz if modes_hz is None else modes_hz, float)
    low, high = _limits(table.frequency_hz, band)
    figure = new_figure(10.2, 4.9)
    place = (0.06, 0.105, 0.875, 0.785)
    behind = figure.add_axes(place)
    axes = figure.add_axes(place, frameon=False, label="poles")
    _indicator(behind, stabilization.indicator_hz, stabilization.indicator, low, high, name)
    inside = (table.frequency_hz >= low) & (table.frequency_hz <= high)
    top = int(table.order.max()) if table.order.size else 1
    bottom = int(table.order.min()) if table.order.size else 0
    foot = bottom - 0.09 * (top - bottom + 1)
    for code, label, color, size in _CLASSES:
        rows = inside & (table.status == code)
        if rows.any():
            dots(axes, table.frequency_hz[rows], table.order[rows], color, size, label)
    for f in modes[(modes >= low) & (modes <= high)]:
        axes.axvline(f, color=IDLE, lw=0.8, zorder=2, alpha=0.85)
    _mode_numbers(axes, modes, low, high)
    rejected = np.array([r.frequency_hz for r in stabilization.rejected if low <= r.frequency_hz <= high])
    if rejected.size:
        axes.plot(
            rejected, np.full(rejected.size, foot), ls="none", marker="x", ms=4.5, mew=1.0, color=PURPLE, label="rejected (see table)"
        )
    for k, f in enumerate(h for h in harmonics_hz if low <= h <= high):
        axes.axvline(f, color=INK, lw=0.9, ls=(0, (2, 2)), zorder=1, label="harmonic" if k == 0 else None)
    axes.plot([], [], color=IDLE, lw=1.2, label="mode taken")
    axes.set_xlim(low, high)
    axes.set_ylim(foot - 0.06 * (top - bottom + 1), top + 0.03 * (top - bottom + 1))
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel("Model order [poles]")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper left", ncols=8, bbox_to_anchor=(0.05, 1.005), handletextpad=0.3, columnspacing=1.1)
    alt = f"Stabilisation diagram from {low:.1f} to {high:.1f} Hz up to order {top}: {count(modes.size, 'mode')} taken, "
    alt += f"{count(len(stabilization.rejected), 'candidate')} rejected"
    return figure, alt


def _limits(frequencies: NDArray[Any], band: Sequence[float] | None) -> tuple[float, float]:
    if band is not None:
        margin = 0.08 * (band[1] - band[0])
        return max(float(band[0]) - margin, 0.0), float(band[1]) + margin
    good = frequencies[np.isfinite(frequencies)]
    return (float(good.min()), float(good.max()) * 1.02) if good.size and good.max() > good.min() else (0.0, 1.0)


def _mode_numbers(axes: Axes, modes: NDArray[np.float64], low: float, high: float) -> None:
    """Mode numbers above the frame, raised where neighbours would overlap."""
    last, level = -np.inf, 0
    for k, f in enumerate(modes):
        if not low <= f <= high:
            continue
        level = 1 - level if f - last < 0.014 * (high - low) else 0
        last = f
        axes.annotate(
            str(k),
            (f, 1.0),
            (0, 2 + 9 * level),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            color=IDLE,
        )


def _indicator(axes: Axes, hz: ArrayLike | None, curves: ArrayLike | None, low: float, high: float, name: str) -> None:
    axes.yaxis.tick_right()
    axes.yaxis.set_label_position("right")
    axes.set_xlim(low, high)
    axes.tick_params(labelbottom=False, bottom=False)
    axes.spines["right"].set_visible(True)
    if hz is None or curves is None:
        axes.set_yticks([])
        return
    f, values = np.asarray(hz, float), np.atleast_2d(np.asarray(curves, float))
    shown = (f >= low) & (f <= high)
    if shown.sum() < 2:
        axes.set_yticks([])
        return
    axes.set_yscale("log")
    first = None
    for row in values[: min(4, values.shape[0])]:
        y = row[shown]
        ok = np.isfinite(y) & (y > 0)
        if not ok.any():
            continue
        keep = thin(f[shown][ok], np.log(y[ok]), 600)
        axes.plot(f[shown][ok][keep], y[ok][keep], color="#9fabb6" if first is None else PALE, lw=1.0 if first is None else 0.8)
        first = y[ok] if first is None else first
    if first is not None:
        axes.set_ylim(max(first.min() * 0.3, first.max() * 1e-8), first.max() * 3)
    axes.set_ylabel(name, color="#5b6670")
    axes.tick_params(axis="y", colors="#5b6670")
    log_axis(axes.yaxis)


def singular_values(
    frequencies_hz: ArrayLike,
    values: ArrayLike,
    band: Sequence[float] | None = None,
    modes_hz: ArrayLike = (),
    harmonics_hz: Sequence[float] = (),
    unit: str = "(m/s²)²/Hz",
) -> str:
    """SVG: singular values of the operating spectra with modes and harmonics marked.

    Parameters
    ----------
    frequencies_hz : (k,) array
    values : (n_curves, k) array
        Positive, the greatest first.
    """
    return _singular_values(frequencies_hz, values, band, modes_hz, harmonics_hz, unit)


@drawn
def _singular_values(
    frequencies_hz: ArrayLike,
    values: ArrayLike,
    band: Sequence[float] | None,
    modes_hz: ArrayLike,
    harmonics_hz: Sequence[float],
    unit: str,
) -> tuple[Figure, str]:
    f, curves = np.asarray(frequencies_hz, float), np.atleast_2d(np.asarray(values, float))
    if curves.shape[0] == f.size and curves.shape[1] != f.size:
        curves = curves.T
    low, high = _limits(f, band)
    figure = new_figure(10.2, 3.6)
    axes = figure.add_axes((0.067, 0.13, 0.918, 0.72))
    axes.set_yscale("log")
    shown = (f >= low) & (f <= high)
    modes = np.asarray(modes_hz, float)
    for k, m in enumerate(modes[(modes >= low) & (modes <= high)]):
        axes.axvline(m, color=IDLE, lw=0.8, alpha=0.85, zorder=1, label="mode taken" if k == 0 else None)
    for k, h in enumerate(h for h in harmonics_hz if low <= h <= high):
        axes.axvline(h, color=INK, lw=1.0, ls=(0, (2, 2)), zorder=1, label="harmonic" if k == 0 else None)
    colors = (MODEL, SKY, GREY)
    for k, row in enumerate(curves[:6]):
        y = row[shown]
        ok = np.isfinite(y) & (y > 0)
        if ok.sum() < 2:
            continue
        keep = thin(f[shown][ok], np.log(y[ok]), 700)
        label = ("first", "second", "third and on")[k] if k < 3 else None
        axes.plot(f[shown][ok][keep], y[ok][keep], color=colors[min(k, 2)], lw=1.2 if k == 0 else 0.8, label=label)
    axes.set_xlim(low, high)
    axes.grid(True)
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel(f"Singular value [{unit}]")
    log_axis(axes.yaxis)
    _mode_numbers(axes, modes, low, high)
    figure.legend(loc="upper left", ncols=5, bbox_to_anchor=(0.057, 1.01))
    return figure, f"Singular values of the operating spectra from {low:.1f} to {high:.1f} Hz"
