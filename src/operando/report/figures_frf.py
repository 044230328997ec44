"""Figures of FRFs: measured against synthesised with coherence, and operating FRFs against the check and the idle model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.report.svg import IDLE, INK, MEASURED, MODEL, SKY, drawn, log_axis, new_figure, thin
from operando.report.text import listing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNITS = {"accelerance": "(m/s²)/N", "mobility": "(m/s)/N", "receptance": "m/N"}

HELD_OUT = "#fdf3d8"

Pair = tuple[int, int, str]


def magnitude_label(frf: Frf) -> str:
    """Axis label of a magnitude, honest where units are not known."""
    name = frf.quantity.capitalize()
    return f"{name} [{UNITS[frf.quantity]}]" if frf.si else f"{name} [units of the file]"


def frf_pairs(measured: Frf, model: Frf | None, pairs: Sequence[Pair], band: Sequence[float] | None = None) -> str:
    """SVG: magnitude, phase and coherence of some measured FRFs with the synthesised ones, their difference and the noise.

    Parameters
    ----------
    measured : Frf
    model : Frf or None
        On the same lines and pairs.
    pairs : list of (response index, reference index, why shown)
    band : (float, float), optional
        Analysis band [Hz], shaded outside.
    """
    return _frf_pairs(measured, model, pairs, band)


@drawn
def _frf_pairs(measured: Frf, model: Frf | None, pairs: Sequence[Pair], band: Sequence[float] | None) -> tuple[Figure, str]:
    columns = min(2, len(pairs))
    rows = -(-len(pairs) // columns)
    width, cell, top, bottom = 10.2, 4.1, 0.28, 0.5
    height = rows * cell + top
    figure = new_figure(width, height)
    left, gap = 0.68, 0.75
    panel = (width - left - 0.15 - gap * (columns - 1)) / columns
    shown = _shown(measured, band)
    with_coherence = measured.coherence is not None
    low_axes: list[Axes] = []
    for k, (i, j, why) in enumerate(pairs):
        x0 = left + (k % columns) * (panel + gap)
        y0 = height - top - (k // columns + 1) * cell + bottom
        heights = [0.5, 0.55] if with_coherence else [0.0, 0.65]
        inner = cell - bottom - 0.35
        box = lambda y, h, x0=x0: figure.add_axes((x0 / width, y / height, panel / width, h / height))  # noqa: E731
        y = y0
        if with_coherence:
            axes = box(y, heights[0])
            _coherence(axes, measured, i, j, shown)
            low_axes.append(axes)
            y += heights[0] + 0.1
        phase = box(y, heights[1])
        y += heights[1] + 0.1
        main = box(y, inner - (y - y0))
        _magnitude(main, measured, model, i, j, shown)
        _phase(phase, measured, model, i, j, shown)
        main.set_title(f"{measured.responses[i]} from {measured.references[j]} ({why})")
        stack = [main, phase] + ([low_axes[-1]] if with_coherence else [])
        for axes in stack:
            _frequency_axis(axes, measured, shown, band, label=axes is stack[-1])
        if k == 0:
            figure.legend(handles=main.get_legend_handles_labels()[0], loc="upper left", ncols=4, bbox_to_anchor=(left / width - 0.01, 1.0))
    names = listing(f"{measured.responses[i]} from {measured.references[j]}" for i, j, _ in pairs)
    return figure, f"Measured and synthesised frequency response functions with phase{' and coherence' if with_coherence else ''}: {names}"


def _shown(frf: Frf, band: Sequence[float] | None) -> slice:
    """Lines drawn: the band with a margin of 15 %."""
    if band is None:
        return slice(0, len(frf.axis))
    margin = 0.15 * (band[1] - band[0])
    return frf.axis.band(max(band[0] - margin, 0), band[1] + margin)


def _frequency_axis(axes: Axes, frf: Frf, shown: slice, band: Sequence[float] | None, label: bool) -> None:
    f = frf.frequencies_hz[shown]
    axes.set_xlim(f[0], f[-1])
    axes.grid(True)
    if band is not None:
        for low, high in ((f[0], band[0]), (band[1], f[-1])):
            if high > low:
                axes.axvspan(low, high, color="#eef1f4", zorder=0, linewidth=0)
    if label:
        axes.set_xlabel("Frequency [Hz]")
    else:
        axes.tick_params(labelbottom=False)


def _magnitude(axes: Axes, measured: Frf, model: Frf | None, i: int, j: int, shown: slice) -> None:
    f = measured.frequencies_hz[shown]
    h = np.abs(measured.data[i, j, shown])
    axes.set_yscale("log")
    if measured.variance is not None:
        _curve(axes, f, np.sqrt(measured.variance[i, j, shown]), color=INK, lw=1.0, ls=":", label="noise level (1 σ)", zorder=4)
    if model is not None:
        _curve(axes, f, np.abs(model.data[i, j, shown] - measured.data[i, j, shown]), color=SKY, lw=0.7, label="difference")
    _curve(axes, f, h, color=MEASURED, lw=1.5, label="measured", count=1100)
    if model is not None:
        _curve(axes, f, np.abs(model.data[i, j, shown]), color=IDLE, lw=1.0, ls=(0, (4, 2)), label="synthesised", count=1100)
    axes.set_ylabel(magnitude_label(measured))
    positive = h[np.isfinite(h) & (h > 0)]
    if positive.size:
        axes.set_ylim(max(positive.min() * 1e-2, positive.max() * 1e-6), positive.max() * 2)
    log_axis(axes.yaxis)


def _curve(
    axes: Axes, f: NDArray[Any], y: NDArray[Any], *, color: str, lw: float, label: str, ls: Any = "-", count: int = 700, zorder: float = 2
) -> None:
    with np.errstate(divide="ignore", invalid="ignore"):
        keep = thin(f, np.log(np.maximum(y, 1e-300)), count)
    axes.plot(f[keep], np.where(y[keep] > 0, y[keep], np.nan), color=color, lw=lw, ls=ls, label=label, zorder=zorder)


def _phase(axes: Axes, measured: Frf, model: Frf | None, i: int, j: int, shown: slice) -> None:
    f = measured.frequencies_hz[shown]
    keep = thin(f, np.abs(measured.data[i, j, shown]), 500)
    axes.plot(f[keep], _degrees(measured.data[i, j, shown][keep]), color=MEASURED, lw=1.2)
    if model is not None:
        axes.plot(f[keep], _degrees(model.data[i, j, shown][keep]), color=IDLE, lw=0.9, ls=(0, (4, 2)))
    axes.set_ylim(-200, 200)
    axes.set_yticks([-180, 0, 180])
    axes.set_ylabel("Phase [°]")


def _degrees(h: NDArray[Any]) -> NDArray[np.float64]:
    """Phase [°] with gaps where it wraps, so that no vertical line is drawn."""
    angle = np.degrees(np.angle(h))
    angle = np.where(np.isfinite(h), angle, np.nan)
    jump = np.flatnonzero(np.abs(np.diff(angle)) > 180)
    angle[jump] = np.nan
    return angle


def _coherence(axes: Axes, measured: Frf, i: int, j: int, shown: slice) -> None:
    if measured.coherence is None:
        return
    f, c = measured.frequencies_hz[shown], measured.coherence[i, j, shown]
    keep = thin(f, c, 400)
    axes.plot(f[keep], c[keep], color="#00805c", lw=0.8)
    axes.set_ylim(0, 1.05)
    axes.set_yticks([0, 1])
    axes.set_ylabel("Coh. [–]")


def ofrf_pairs(
    check: Frf,
    ofrf: Frf | None,
    idle: Frf | None,
    pairs: Sequence[Pair],
    band: Sequence[float] | None = None,
    label: str = "operating FRF",
    held_out: Sequence[tuple[float, float]] = (),
) -> str:
    """SVG: magnitudes of operating FRFs with their 95 % band, the check measurement and the idle model, one panel a pair.

    Parameters
    ----------
    check : Frf
        The check measurement; a synthesised Frf of which only lines and labels are drawn where ``data`` is NaN.
    ofrf, idle : Frf or None
        On the same lines and pairs; the variance of ``ofrf`` gives the band.
    pairs : list of (response index, reference index, why shown)
    band : (float, float), optional
    label : str
        What the model with the band is.
    held_out : sequence of (float, float)
        Frequency ranges [Hz] set off, whose lines nothing was fitted to.
    """
    return _ofrf_pairs(check, ofrf, idle, pairs, band, label, held_out)


@drawn
def _ofrf_pairs(
    check: Frf,
    ofrf: Frf | None,
    idle: Frf | None,
    pairs: Sequence[Pair],
    band: Sequence[float] | None,
    label: str,
    held_out: Sequence[tuple[float, float]],
) -> tuple[Figure, str]:
    columns = min(2, len(pairs))
    rows = -(-len(pairs) // columns)
    width, cell = 10.2, 3.0
    height = rows * cell + 0.25
    figure = new_figure(width, height)
    left, gap = 0.68, 0.75
    panel = (width - left - 0.15 - gap * (columns - 1)) / columns
    shown = _shown(check, band)
    for k, (i, j, why) in enumerate(pairs):
        x0 = left + (k % columns) * (panel + gap)
        y0 = height - 0.25 - (k // columns + 1) * cell + 0.5
        axes = figure.add_axes((x0 / width, y0 / height, panel / width, (cell - 0.8) / height))
        ofrf_panel(axes, check, ofrf, idle, i, j, shown, label)
        for n, (low, high) in enumerate(held_out):
            axes.axvspan(low, high, color=HELD_OUT, lw=0, zorder=0, label=None if n else "held-out lines")
        axes.set_title(f"{check.responses[i]} from {check.references[j]} ({why})")
        _frequency_axis(axes, check, shown, band, label=True)
        if k == 0:
            handles, labels = axes.get_legend_handles_labels()
            figure.legend(handles, labels, loc="upper left", ncols=5, bbox_to_anchor=(left / width - 0.01, 1.0))
    names = listing(f"{check.responses[i]} from {check.references[j]}" for i, j, _ in pairs)
    if label != "operating FRF":
        return figure, f"Frequency response functions of the {label} with 95 % band against check and idle model: {names}"
    return figure, f"Operating frequency response functions with 95 % band against check and idle model: {names}"


def ofrf_panel(
    axes: Axes, check: Frf, ofrf: Frf | None, idle: Frf | None, i: int, j: int, shown: slice, label: str = "operating FRF"
) -> None:
    """Draw one pair into given axes."""
    f = check.frequencies_hz[shown]
    axes.set_yscale("log")
    heights = []
    if idle is not None:
        h = np.abs(idle.data[i, j, shown])
        heights.append(h)
        _curve(axes, f, h, color=IDLE, lw=1.0, ls=(0, (4, 2)), label="idle model")
    measured = np.abs(check.data[i, j, shown])
    if np.any(np.isfinite(measured)):
        heights.append(measured)
        _curve(axes, f, measured, color=MEASURED, lw=1.5, label="check (measured running)", count=1000)
    if ofrf is not None:
        h = np.abs(ofrf.data[i, j, shown])
        heights.append(h)
        if ofrf.variance is not None:
            variance = ofrf.variance[i, j, shown]
            known = np.flatnonzero(np.isfinite(variance))  # it is dear, so some lines have none
            keep = known[thin(f[known], np.log(np.maximum(h[known], 1e-300)), 450)] if known.size else known
            half = 1.96 * np.sqrt(np.maximum(variance[keep], 0) / 2)
            low = np.maximum(h[keep] - half, h[keep] * 1e-2)
            axes.fill_between(f[keep], low, h[keep] + half, color=MODEL, alpha=0.25, linewidth=0, label="95 % band")
        _curve(axes, f, h, color=MODEL, lw=1.1, label=label, count=1000)
    axes.set_ylabel(magnitude_label(check))
    all_heights = np.concatenate(heights) if heights else np.ones(1)
    positive = all_heights[np.isfinite(all_heights) & (all_heights > 0)]
    if positive.size:
        axes.set_ylim(max(positive.min() * 0.5, positive.max() * 1e-5), positive.max() * 2)
    log_axis(axes.yaxis)


def frf_overview(measured: Frf, model: Frf | None, band: Sequence[float] | None = None) -> str:
    """SVG: root mean square over all pairs, measured and synthesised, with their difference and the noise level."""
    return _frf_overview(measured, model, band)


@drawn
def _frf_overview(measured: Frf, model: Frf | None, band: Sequence[float] | None) -> tuple[Figure, str]:
    figure = new_figure(10.2, 3.4)
    axes = figure.add_axes((0.067, 0.14, 0.918, 0.77))
    shown = _shown(measured, band)
    f = measured.frequencies_hz[shown]
    rms = lambda values: np.sqrt(np.nanmean(np.abs(values[:, :, shown]) ** 2, axis=(0, 1)))  # noqa: E731
    axes.set_yscale("log")
    if measured.variance is not None:
        _curve(axes, f, rms(np.sqrt(measured.variance)), color=INK, lw=1.1, ls=":", label="noise level (1 σ)", zorder=4)
    if model is not None:
        _curve(axes, f, rms(model.data - measured.data), color=SKY, lw=0.8, label="difference")
    _curve(axes, f, rms(measured.data), color=MEASURED, lw=1.6, label="measured", count=1200)
    if model is not None:
        _curve(axes, f, rms(model.data), color=IDLE, lw=1.0, ls=(0, (4, 2)), label="synthesised", count=1200)
    _frequency_axis(axes, measured, shown, band, label=True)
    axes.set_ylabel(f"rms {magnitude_label(measured)[0].lower()}{magnitude_label(measured)[1:]}")
    log_axis(axes.yaxis)
    figure.legend(loc="upper left", ncols=4, bbox_to_anchor=(0.057, 1.01))
    return figure, "Root mean square of all measured and synthesised frequency response functions, with difference and noise level"
