"""Figures of the paper's report as inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from exact import LINES
from tripod import CLAMPED, FOOT, POINTS, SOFT_LEG, Modes

from operando.report.svg import GREEN, IDLE, INK, MODEL, ORANGE, PURPLE, drawn, new_figure, thin

Array = np.ndarray

CURVES = {
    "exact": (INK, "-", 1.6),
    "idle": (IDLE, ":", 1.0),
    "idle_shapes": (ORANGE, "-.", 1.0),
    "msf_all": (PURPLE, "--", 1.0),
    "paper": (GREEN, "--", 1.2),
    "auto": (MODEL, "-", 1.1),
    "from_b": (PURPLE, "--", 1.0),
}
"""Colour, line and width of each model."""

NAMES = {
    "exact": "exact, target",
    "idle": "exact, at rest",
    "idle_shapes": "idle shapes, operational poles",
    "msf_all": "MSF of all shapes",
    "paper": "the paper's choice",
    "auto": "operando, auto",
    "from_b": "operando, auto, from B",
}


@drawn
def operational_frfs(
    curves: Mapping[str, Array], outputs: Sequence[str], source: str, band: tuple[float, float], lines: Array = LINES
) -> tuple[object, str]:
    """Accelerance of some outputs from one input, dB re 1 (mm/s²)/N as in the paper, and below each the error of each model.

    ``curves``: name → (outputs, lines) in (m/s²)/N on ``lines``, among them ``exact``; without a source the outputs name it.
    """
    columns, rows = 2, -(-len(outputs) // 2)
    height = 3.7 * rows + 0.35
    figure = new_figure(10.4, height)
    for k, output in enumerate(outputs):
        left, bottom = 0.65 + (k % columns) * 5.2, 3.7 * (rows - 1 - k // columns) + 0.5
        upper = figure.add_axes((left / 10.4, (bottom + 1.05) / height, 4.25 / 10.4, 1.8 / height))
        lower = figure.add_axes((left / 10.4, bottom / height, 4.25 / 10.4, 0.95 / height), sharex=upper)
        exact = 20 * np.log10(1000 * np.abs(curves["exact"][k]))
        for name, values in curves.items():
            colour, style, width = CURVES[name]
            level = 20 * np.log10(1000 * np.abs(values[k]))
            keep = thin(lines, level, 350)
            upper.plot(lines[keep], level[keep], style, color=colour, linewidth=width, label=NAMES[name])
            if name not in ("exact", "idle"):
                keep = thin(lines, level - exact, 350)
                lower.plot(lines[keep], (level - exact)[keep], style, color=colour, linewidth=width)
        upper.set_title(f"{output} from {source}" if source else output)
        upper.set_ylabel("dB re 1 (mm/s²)/N")
        upper.tick_params(labelbottom=False)
        lower.set_ylim(-12, 12)
        lower.set_yticks([-10, -5, 0, 5, 10])
        lower.set_ylabel("error [dB]")
        lower.set_xlim(lines[0], lines[-1])
        if k // columns == rows - 1:
            lower.set_xlabel("Frequency [Hz]")
        for axes in (upper, lower):
            axes.grid(True)
            for low, high in ((lines[0], band[0]), (band[1], lines[-1])):
                if high > low:
                    axes.axvspan(low, high, color="#eef1f4", zorder=0, linewidth=0)
        if k == 0:
            handles = upper.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="upper left", ncols=6, bbox_to_anchor=(0.055, 1.0), columnspacing=1.2, handlelength=2.2)
    return (
        figure,
        f"Operational frequency response functions of {', '.join(outputs)}{f' from {source}' if source else ''}, and errors in dB",
    )


@drawn
def banded_frf(lines: Array, exact: Array, model: Array, spread: Array, title: str) -> tuple[object, str]:
    """One OFRF with its 95 % band and the exact one, levels in dB."""
    figure = new_figure(10.4, 3.0)
    axes = figure.add_axes((0.065, 0.165, 0.925, 0.73))
    level = lambda h: 20 * np.log10(1000 * np.maximum(np.abs(h), 1e-12))  # noqa: E731
    axes.fill_between(
        lines, level(np.maximum(np.abs(model) - spread, 1e-3 * np.abs(model))), level(np.abs(model) + spread), color="#cfe3f1", linewidth=0
    )
    axes.plot(lines, level(exact), color=INK, linewidth=1.5, label=NAMES["exact"])
    axes.plot(lines, level(model), color=MODEL, linewidth=1.0, label="operando, auto, with its 95 % band")
    axes.set_xlim(lines[0], lines[-1])
    axes.set_ylim(np.min(level(exact)) - 6, np.max(level(exact)) + 6)
    axes.grid(True)
    axes.set_xlabel("Frequency [Hz]")
    axes.set_ylabel("dB re 1 (mm/s²)/N")
    axes.set_title(title)
    axes.legend(loc="lower right", ncols=2)
    return figure, title


@drawn
def plate_shapes(modes: Sequence[tuple[str, Modes, int]]) -> tuple[object, str]:
    """Contour maps of the plate's deflection w, with the measured points, the clamps and the foot of the mass."""
    figure = new_figure(10.4, 3.7)
    for k, (title, source, index) in enumerate(modes):
        axes = figure.add_axes((0.05 + k * 0.95 / len(modes), 0.13, 0.95 / len(modes) - 0.06, 0.74))
        w = source.deflection[:, :, index]
        top = float(np.max(np.abs(w)))
        x = np.linspace(0, 1, w.shape[0])
        axes.contourf(x, x, w.T, levels=np.linspace(-top, top, 15), cmap="RdBu_r")
        axes.contour(x, x, w.T, levels=[0], colors=INK, linewidths=0.7)
        points = np.array(list(POINTS.values()))
        axes.plot(points[:, 0], points[:, 1], "o", color=INK, markersize=3, clip_on=False)
        axes.plot(*np.array(CLAMPED).T, "s", color=IDLE, markersize=6, clip_on=False)
        axes.plot(*FOOT, "^", color=GREEN, markersize=6)
        axes.plot(*POINTS[SOFT_LEG], "o", color=PURPLE, markersize=7, markerfacecolor="none", clip_on=False)
        axes.set_aspect("equal")
        axes.set_xlim(-0.02, 1.02)
        axes.set_ylim(-0.02, 1.02)
        axes.set_title(title)
        axes.set_xlabel("x [m]")
        if k == 0:
            axes.set_ylabel("y [m]")
    return figure, "Deflection of the plate: " + "; ".join(title for title, _, _ in modes)
