"""Figures of the diagnosis: the error by step, chi-square by mode, dynamic stiffness at the place found, places ranked."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.plots.location import marks, plot_location
from operando.report.svg import GREEN, GREY, IDLE, INK, MEASURED, MODEL, PALE, PURPLE, SKY, dots, drawn, log_axis, new_figure, thin
from operando.report.text import fixed, number
from operando.report.words_diagnosis import BY_HAND, EffectWords, ErrorByStep
from operando.units import engineering_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from operando.data import Geometry

BADGE = {"good": "#00664a", "fair": "#7a5200", "poor": "#a33a00", "none": "#4b5762"}
"""Colours of the verdict, as in the page."""


@drawn
def steps_figure(ladder: ErrorByStep, verdict: str, grade: str) -> tuple[Figure, str]:
    """SVG: the error at each step, idle model first, each column with what was added, against the noise floor; the verdict as a badge."""
    rows = ladder.rows
    values = np.array([r.heldout for r in rows])
    n, slots = len(rows), max(len(rows), 2) + 0.4
    labels = [_column_label(r.effect, max(12, round(116 / slots))) for r in rows]
    foot = 0.2 + 0.165 * max(label.count("\n") + 1 for label in labels)
    width, plot, head = 10.2, 2.55, 0.42
    height = head + plot + foot
    figure = new_figure(width, height)
    axes = figure.add_axes((0.075, foot / height, 0.91, plot / height))
    bottom = _steps_scale(axes, ladder, values)
    x = np.arange(n)
    axes.bar(
        x,
        values - bottom,
        bottom=bottom,
        width=0.56,
        color=[IDLE] + [{"unexplained": GREY, BY_HAND[0]: MODEL}.get(verdict, GREEN)] * (n - 1),
        zorder=2,
    )
    lines = [(i, r.everything) for i, r in enumerate(rows) if ladder.on_hold_out and np.isfinite(r.everything) and r.everything > 0]
    if lines:
        axes.plot(*np.transpose(lines), ls="none", marker="o", ms=5, mfc="white", mec=INK, mew=0.9, zorder=4)
    floor = ladder.shown_floor
    if floor is not None and floor > bottom:
        axes.axhspan(bottom, floor, color=PALE, alpha=0.55, lw=0, zorder=1)
        axes.axhline(floor, color=INK, lw=1.1, ls=(0, (4, 2)), zorder=3)
        words = f"noise floor {ladder.text(floor)}" if ladder.decibel else "1: as good as the noise allows"
        axes.annotate(words, (1, floor), (-3, 3), ("axes fraction", "data"), "offset points", ha="right", va="bottom", fontsize=8.5)
    for i, v in enumerate(values):
        axes.annotate(
            ladder.text(v), (i, _clear_of(v, rows[i].everything if lines else np.nan, axes)), (0, 5), textcoords="offset points",
            ha="center", fontsize=11, fontweight="bold", zorder=5, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    for i in range(1, n):
        _fall(axes, i, values[i - 1], values[i], ladder)
    axes.set_xticks(x, labels, fontsize=9, linespacing=1.2)
    axes.get_xticklabels()[0].set_fontweight("bold")
    axes.set_xlim(-0.5, slots - 0.5)
    axes.tick_params(axis="x", length=0)
    box = {"boxstyle": "square,pad=0.4", "facecolor": BADGE.get(grade, BADGE["none"]), "edgecolor": "none"}
    word = verdict.replace("_", " ")
    at = (0.985 - 0.0055 * len(word), 1.0 + 0.14 / plot)  # in the middle: the reader's font is narrower than the one measured with
    axes.text(*at, word, transform=axes.transAxes, ha="center", va="bottom", color="white", fontsize=10.5, fontweight="bold", bbox=box)
    steps = [f"idle model {ladder.text(values[0])}"]
    steps += [f"with {r.effect.label if r.effect else 'effect'} {ladder.text(v)}" for r, v in zip(rows[1:], values[1:], strict=True)]
    steps += [] if floor is None else [f"noise floor {ladder.text(floor)}"]
    return figure, f"Error by step, verdict {verdict.replace('_', ' ')}: {'; '.join(steps)}"


def _steps_scale(axes: Axes, ladder: ErrorByStep, values: NDArray[np.float64]) -> float:
    """Set the axis of the errors; the value its columns stand on."""
    top = float(np.max([*values, *(r.everything for r in ladder.rows if np.isfinite(r.everything)), ladder.shown_floor or 0.0]))
    kind = "Hold-out" if ladder.on_hold_out else "Error on all data:"
    if ladder.decibel:
        axes.set_ylim(0, 1.2 * max(top, 1e-9))
        axes.set_ylabel(f"{kind} level error, rms [dB]")
        return 0.0
    low = float(np.min([*values[values > 0], 1.0])) if np.any(values > 0) else 1.0
    bottom = 0.3 * low
    axes.set_yscale("log")
    axes.set_ylim(bottom, max(top, 1.0) * (max(top, 1.0) / bottom) ** 0.2)
    axes.set_ylabel(f"{kind} reduced χ² [1 = noise]")
    log_axis(axes.yaxis)
    return bottom


def _clear_of(value: float, circle: float, axes: Axes) -> float:
    """Where the words of a column stand: on it, or on the circle where that would cross them."""
    scale = axes.transData.transform
    height = scale((0, circle))[1] - scale((0, value))[1] if np.isfinite(circle) and circle > 0 else -1.0
    return circle if 0 <= height < 24 * axes.figure.dpi / 72 else value


def _column_label(effect: EffectWords | None, width: int) -> str:
    if effect is None:
        return "idle model"
    parts = [f"+ {effect.name}{' (taken away)' if effect.removed else ''}", effect.place, *effect.size.split(", ")]
    return "\n".join(line for part in parts if part for line in textwrap.wrap(part, width))


def _fall(axes: Axes, i: int, before: float, after: float, ladder: ErrorByStep) -> None:
    """Arrow from the height of one column to that of the next, with the change."""
    worse = after > before
    color = BADGE["poor"] if worse else MEASURED
    axes.plot([i - 0.72, i - 0.5], [before, before], color=color, lw=0.9, ls=(0, (2, 2)), zorder=3)
    arrow = {"arrowstyle": "-|>", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (i - 0.5, after), (i - 0.5, before), arrowprops=arrow)
    axes.plot([i - 0.5, i - 0.28], [after, after], color=color, lw=0.9, ls=(0, (2, 2)), zorder=3)
    if ladder.decibel:
        words, middle = f"{fixed(after - before, 2, sign=True)} dB", (before + after) / 2
    else:
        ratio = (after if worse else before) / max(before if worse else after, 1e-300)
        words, middle = (
            f"{'×' if worse else '÷'}{number(float(f'{ratio:.2g}'), 2)}",
            float(np.sqrt(max(before, 1e-300) * max(after, 1e-300))),
        )
    if abs(after - before) < 0.05 * max(before, after):
        return
    ends = axes.transData.transform([(0, before), (0, after)])[:, 1]
    short = abs(ends[1] - ends[0]) < 16 * axes.figure.dpi / 72
    lift = 9.0 + 36 * (ends.max() - ends.mean()) / axes.figure.dpi if short else 0.0
    axes.annotate(
        words, (i - 0.5, middle), (0 if short else 5, lift), textcoords="offset points", color=color, fontsize=8.5, zorder=5,
        ha="center" if short else "left", va="bottom" if short else "center",
    )  # fmt: skip


@drawn
def location_figure(found: Mapping[str, Any], geometry: Geometry) -> tuple[Figure, str]:
    """SVG: the machine with the effects of ``diagnosis.json`` marked."""
    figure = new_figure(7.0, 4.0)
    axes = figure.add_axes((0.0, -0.1, 1.0, 1.14), projection="3d")
    plot_location(found, geometry, axes).legend(loc="upper left", bbox_to_anchor=(0.01, 0.955), fontsize=9)  # inside the page
    return figure, "The machine with the location of " + "; ".join(m.name for m in marks(found.get("effects") or (), geometry))


@drawn
def mode_errors(frequencies_hz: ArrayLike, idle: ArrayLike, added: ArrayLike | None) -> tuple[Figure, str]:
    """SVG: chi-square of each operational mode by the idle model and by the model with the effects, against 1, the noise.

    NaN stands where it is not known.
    """
    hz = np.asarray(frequencies_hz, float)
    figure = new_figure(10.2, 2.7)
    axes = figure.add_axes((0.075, 0.24, 0.91, 0.6))
    rows = [("idle model", np.asarray(idle, float), IDLE)]
    if added is not None:
        rows.append(("idle model with the effects", np.asarray(added, float), GREEN))
    everything = np.concatenate([v for _, v, _ in rows])
    positive = everything[np.isfinite(everything) & (everything > 0)]
    bottom = 0.5 * min(float(positive.min()) if positive.size else 1.0, 1.0)
    axes.set_yscale("log")
    step = 0.8 / len(rows)
    for k, (name, values, color) in enumerate(rows):
        tall = np.where(np.isfinite(values), np.maximum(values, bottom), bottom)
        axes.bar(np.arange(hz.size) - 0.4 + step * (k + 0.5), tall - bottom, bottom=bottom, width=0.92 * step, color=color, label=name)
    axes.axhline(1.0, color=INK, lw=1.1, ls=(0, (4, 2)), label="noise (1)")
    axes.set_ylim(bottom, 1.6 * max(float(positive.max()) if positive.size else 1.0, 1.0))
    axes.set_xticks(np.arange(hz.size), [number(f, 4) for f in hz], fontsize=7.5, rotation=90 if hz.size > 16 else 0)
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel("Operational mode [Hz]")
    axes.set_ylabel("Reduced χ² [1 = noise]")
    log_axis(axes.yaxis)
    figure.legend(loc="upper left", ncols=3, bbox_to_anchor=(0.065, 1.02))
    with_effects = "" if added is None else " and with the effects"
    return figure, f"Reduced chi-square of {hz.size} operational modes by the idle model{with_effects}"


@drawn
def stiffness_figure(pictures: Sequence[Mapping[str, Any]], titles: Sequence[str]) -> tuple[Figure, str]:
    """SVG: dynamic stiffness δz(ω) that the check asks for at each place, real and imaginary part, with the fitted law.

    Each picture has ``frequency_hz``, ``real``, ``imag``, ``law_real``, ``law_imag`` (may be missing) and ``unit``.
    """
    row, top = 2.75, 0.28
    height = row * len(pictures) + top
    figure = new_figure(10.2, height)
    for k, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        hz = np.asarray(picture["frequency_hz"], float)
        spans = [stiffness_span(picture.get(part), picture.get(f"law_{part}")) for part in ("real", "imag")]
        factor, unit = engineering_unit(max(abs(end) for span in spans for end in span), str(picture.get("unit") or "N/m"))
        spans = [(low / factor, high / factor) for low, high in spans]
        both = max(high - low for low, high in spans)
        for j, (part, word) in enumerate((("real", "Real part"), ("imag", "Imaginary part"))):
            axes = figure.add_axes((0.085 + 0.495 * j, (height - top - row * (k + 1) + 0.5) / height, 0.4, (row - 0.85) / height))
            values, law = _values(picture.get(part), hz) / factor, _values(picture.get(f"law_{part}"), hz) / factor
            middle = sum(spans[j]) / 2
            low, high = middle - both / 2, middle + both / 2  # one span for both parts: what is small looks small
            inside = np.isfinite(values) & (values > low) & (values < high)
            axes.axhline(0, color=GREY, lw=0.8)
            dots(axes, hz[inside], values[inside], SKY, 2.2, "from the validation measurement, line by line")
            smooth = running_median(values)
            axes.plot(hz, np.clip(smooth, low, high), color=MEASURED, lw=1.1, label="running median")
            axes.plot(hz, law, color=IDLE, lw=1.8, ls=(0, (4, 2)), label="force law fitted")
            axes.set_xlim(hz.min(), hz.max())
            axes.set_ylim(low, high)
            axes.set_ylabel(f"{word} of δz [{unit}]")
            axes.set_xlabel("Frequency [Hz]")
            axes.set_title(title if j == 0 else "", fontsize=9.5)
            axes.grid(True)
            if k == 0 and j == 0:
                figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=3, bbox_to_anchor=(0.985, 1.01))
    return figure, "Dynamic stiffness, real and imaginary part with the fitted force law: " + "; ".join(titles)


def _values(given: Any, hz: NDArray[np.float64]) -> NDArray[np.float64]:
    values = np.array([np.nan if v is None else float(v) for v in given or ()])
    return values if values.size == hz.size else np.full(hz.size, np.nan)


def stiffness_span(values: Any, law: Any) -> tuple[float, float]:
    """Axis limits that show the law and nine tenths of the lines: between resonances a few lines know nothing and lie far off."""
    points = np.array([np.nan if v is None else float(v) for v in values or ()])
    points = points[np.isfinite(points)]
    ends = [0.0, *(float(v) for v in law or () if v is not None and np.isfinite(v))]
    if points.size:
        smooth = running_median(points)
        ends += [float(v) for v in np.quantile(smooth, [0.03, 0.97])] + [float(v) for v in np.quantile(points, [0.15, 0.85])]
    low, high = min(ends), max(ends)
    margin = 0.15 * (high - low) or 1.0
    return low - margin, high + margin


def running_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median over 15 neighbouring lines; fewer at the ends."""
    half = min(7, max((values.size - 1) // 2, 0))
    if half == 0:
        return values
    padded = np.r_[np.full(half, np.nan), values, np.full(half, np.nan)]
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    good = np.isfinite(windows).any(axis=1)
    out = np.full(values.size, np.nan)
    out[good] = np.nanmedian(windows[good], axis=1)
    return out


@drawn
def places_figure(places: Sequence[Mapping[str, Any]], found: Sequence[frozenset[str]], most: int = 10) -> tuple[Figure, str]:
    """SVG: part of the idle model's error that one free force at each place explains, best first, without asking what kind of effect.

    Each place has ``location`` (DOF labels) and ``remains`` (share of the error that is left); the bars of those found stand out.
    """
    places = list(places)[:most]
    n = len(places)
    height = 0.65 + 0.2 * n
    figure = new_figure(7.6, height)
    axes = figure.add_axes((0.19, 0.45 / height, 0.72, (height - 0.5) / height))
    share = 100 * (1 - np.array([float(p["remains"]) for p in places]))
    names = [" and ".join(str(d) for d in p["location"]) for p in places]
    mine = [frozenset(str(d) for d in p["location"]) in found for p in places]
    axes.barh(np.arange(n), share, color=[GREEN if m else MODEL for m in mine], height=0.7)
    for i, v in enumerate(share):
        axes.text(v, i, f" {v:.1f} %", va="center", fontsize=8, fontweight="bold" if mine[i] else "normal")
    axes.set_yticks(np.arange(n), names, fontsize=8.5)
    axes.invert_yaxis()
    axes.set_xlim(0, 112)
    axes.set_xlabel("Part of the idle model's error that a force at this location explains [%]")
    axes.tick_params(axis="y", length=0)
    best = ", ".join(f"{name} {v:.1f} %" for name, v in list(zip(names, share, strict=True))[:3])
    return figure, f"Locations ranked by what a force there explains of the idle model's error: {best}"


@drawn
def routes_figure(frequencies_hz: ArrayLike, difference_db: NDArray[np.float64], names: Sequence[str]) -> tuple[Figure, str]:
    """SVG: how far two sets of FRFs lie apart at each line [dB], rms over the responses, one curve a reference.

    ``difference_db`` (n_references, n_lines) is NaN where no response stands clear of the noise.
    """
    hz = np.asarray(frequencies_hz, float)
    figure = new_figure(10.2, 2.6)
    axes = figure.add_axes((0.075, 0.18, 0.91, 0.68))
    styles: tuple[tuple[str, Any], ...] = ((MODEL, "-"), (IDLE, (0, (4, 2))), (GREEN, (0, (1, 1))), (PURPLE, "-."))
    for k, (name, values) in enumerate(zip(names, difference_db, strict=True)):
        color, dash = styles[k % len(styles)]
        keep = thin(hz, values, 420)
        axes.plot(hz[keep], values[keep], color=color, ls=dash, lw=1.1, label=name)
    good = difference_db[np.isfinite(difference_db)]
    axes.set_ylim(0, 1.1 * max(float(np.quantile(good, 0.998)) if good.size else 1.0, 0.1))
    axes.set_xlim(hz.min(), hz.max())
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel("Difference, rms [dB]")
    axes.grid(True)
    figure.legend(loc="upper left", ncols=4, bbox_to_anchor=(0.065, 1.02))
    return figure, f"Difference of the two routes to the operational FRFs in dB: {'; '.join(names)}"
