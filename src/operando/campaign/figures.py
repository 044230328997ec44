"""Figures of a campaign over its parameter: frequency, damping, scale, error, and which effects are missing where."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.indicators import INTERVAL
from operando.report.svg import GREEN, GREY, IDLE, INK, MEASURED, MODEL, ORANGE, PURPLE, SKY, drawn, new_figure
from operando.report.text import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = (MODEL, IDLE, GREEN, PURPLE, ORANGE, SKY, MEASURED)
DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))
MOST_BARS = 400
"""Points of a figure that still get a 95 % bar and a dot each; more would hide one another."""

Value = Callable[[Mapping[str, Any]], tuple[float | None, float | None]]


def frequency(point: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Frequency [Hz] and its standard deviation."""
    return point["frequency_hz"], point["frequency_std_hz"]


def damping(point: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Damping [%] and its standard deviation."""
    std = point["damping_ratio_std"]
    return 100 * point["damping_ratio"], None if std is None else 100 * std


def scale(point: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Scale of the shape and its standard deviation."""
    value, std = point.get("scale"), point.get("scale_std")
    return value, None if value is None or std is None else value * std


@drawn
def mode_figure(
    tracks: Sequence[Mapping[str, Any]], value: Value, over: str, label: str, log: bool = False, baseline: float | None = None
) -> tuple[Figure, str]:
    """SVG: a value of every tracked mode over the parameter, with 95 % intervals; the modes are named at the right.

    With ``log`` values that spread over more than a factor of five stand on a logarithmic axis.
    """
    height = min(max(3.0, 0.33 * len(tracks) + 1.2), 7.5)
    figure = new_figure(10.2, height)
    axes = figure.add_axes((0.075, 0.5 / height, 0.8, 1 - 0.75 / height))
    crowded = sum(len(t["points"]) for t in tracks) > MOST_BARS
    ends = []
    for t in tracks:
        color, dash = COLORS[t["track"] % len(COLORS)], DASHES[t["track"] // len(COLORS) % len(DASHES)]
        found = [(p["place"], *value(p)) for p in t["points"]]
        found = [f for f in found if f[1] is not None]
        if not found:
            continue
        x, y = np.array([f[0] for f in found], float), np.array([f[1] for f in found], float)
        axes.plot(x, y, color=color, ls=dash, lw=1.2, marker="" if crowded and len(x) > 1 else "o", ms=3.2)
        if not crowded and (spread := np.array([INTERVAL * (f[2] or 0.0) for f in found])).any():
            axes.errorbar(x, y, spread, fmt="none", ecolor=color, elinewidth=0.9, capsize=2)
        ends.append((x[-1], y[-1], t["track"], color))
    values = [v for t in tracks for p in t["points"] if (v := value(p)[0]) is not None and v > 0]
    if log and values and max(values) > 5 * min(values):
        axes.set_yscale("log")
        _plain_log(axes)
    if baseline is not None:
        axes.axvline(baseline, color=GREY, lw=0.9, ls=(0, (4, 2)))
        axes.annotate(
            "baseline", (baseline, 1), (2, -2), ("data", "axes fraction"), "offset points", fontsize=7.5, color=MEASURED, va="top"
        )
    axes.set_xlabel(over)
    axes.set_ylabel(label)
    axes.grid(True)
    _names(axes, ends)
    return figure, f"{label} of {len(ends)} modes over {over}"


def _plain_log(axes: Axes) -> None:
    """1, 2, 5 at the ticks of a logarithmic axis, as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _names(axes: Axes, ends: Sequence[tuple[float, float, int, str]]) -> None:
    """Numbers of the modes at the right, pushed apart where their lines end close together."""
    if not ends:
        return
    to_axes = axes.transAxes.inverted()
    heights = [float(to_axes.transform(axes.transData.transform((x, y)))[1]) for x, y, _, _ in ends]
    order = np.argsort(heights)
    gap = 11 / 72 / (axes.get_position().height * axes.figure.get_figure(root=True).get_size_inches()[1])
    placed: list[float] = []
    for i in order:
        placed.append(max(heights[i], placed[-1] + gap) if placed else heights[i])
    over = max(0.0, placed[-1] - 1.0)
    for k in range(len(placed) - 1, -1, -1):  # pushed back below the top
        limit = 1.0 if k == len(placed) - 1 else placed[k + 1] - gap
        placed[k] = min(placed[k], limit) if over else placed[k]
    for i, y in zip(order, placed, strict=True):
        _, value, track, color = ends[i]
        axes.annotate(
            f"mode {track}: {number(value, 4)}", (1.0, heights[i]), (1.035, y), "axes fraction", "axes fraction", color=color, fontsize=8,
            va="center", arrowprops={"arrowstyle": "-", "color": color, "lw": 0.6, "shrinkA": 0, "shrinkB": 0}, annotation_clip=False,
        )  # fmt: skip


@drawn
def error_figure(series: Mapping[str, Sequence[tuple[float, float]]], over: str) -> tuple[Figure, str]:
    """SVG: error in dB of each model over the parameter; ``series`` are name of the model → (place, error)."""
    figure = new_figure(10.2, 3.0)
    axes = figure.add_axes((0.075, 0.17, 0.9, 0.68))
    for k, (name, points) in enumerate(series.items()):
        x, y = np.array([p[0] for p in points]), np.array([max(p[1], 1e-3) for p in points])
        many = len(points) > MOST_BARS
        axes.plot(x, y, color=(IDLE, MODEL, GREEN)[k % 3], ls=DASHES[k % 3], lw=1.3, marker="" if many else "o", ms=3.2, label=name)
    axes.set_yscale("log")
    _plain_log(axes)
    axes.set_xlabel(over)
    axes.set_ylabel("Error [dB]")
    axes.grid(True)
    figure.legend(loc="upper left", ncols=3, bbox_to_anchor=(0.065, 1.0))
    return figure, f"Error of {', '.join(series)} over {over}"


@drawn
def effect_figure(rows: Sequence[tuple[str, Sequence[float], Sequence[float]]], over: str, known: Sequence[float]) -> tuple[Figure, str]:
    """SVG: which effect is missing in which state.

    Each row has a name, the places where the effect is missing, and those where the diagnosis does not show it; ``known`` are all places.
    """
    height = 0.34 * len(rows) + 0.95
    figure = new_figure(10.2, height)
    axes = figure.add_axes((0.3, 0.55 / height, 0.67, 1 - 0.85 / height))
    for i, (_, shown, absent) in enumerate(rows):
        axes.plot(absent, [i] * len(absent), ls="none", marker="o", ms=4, mfc="none", mec=GREY, mew=0.8, zorder=2)
        axes.plot(shown, [i] * len(shown), ls="none", marker="s", ms=6, color=COLORS[i % len(COLORS)], zorder=3)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=8.5, color=INK)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if known:
        margin = 0.03 * (max(known) - min(known)) or 0.5
        axes.set_xlim(min(known) - margin, max(known) + margin)
    axes.set_xlabel(over)
    axes.grid(True)
    return figure, f"Where {len(rows)} effects are missing over {over}"
