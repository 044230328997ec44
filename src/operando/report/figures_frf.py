"""Figures of FRFs: measured against synthesised with coherence, and operational FRFs against the check and the idle model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from operando.data import Frf
from operando.plots import plot_frf, plot_frf_rms, plot_ofrf
from operando.report.svg import drawn, new_figure
from operando.report.text import listing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HOLD_OUT = "#fdf3d8"

Pair = tuple[int, int, str]


@drawn
def frf_pairs(measured: Frf, model: Frf | None, pairs: Sequence[Pair], band: Sequence[float] | None = None) -> tuple[Figure, str]:
    """SVG: magnitude, phase and coherence of some measured FRFs with the synthesised ones, their difference and the noise.

    The model is on the same lines and pairs. Each pair has the index of its response, of its reference, and why it is shown.
    """
    columns = min(2, len(pairs))
    rows = -(-len(pairs) // columns)
    width, cell, top, bottom = 10.2, 4.1, 0.28, 0.5
    height = rows * cell + top
    figure = new_figure(width, height)
    left, gap = 0.68, 0.75
    panel = (width - left - 0.15 - gap * (columns - 1)) / columns
    with_coherence = measured.coherence is not None
    for k, (i, j, why) in enumerate(pairs):
        x0 = left + (k % columns) * (panel + gap)
        y0 = height - top - (k // columns + 1) * cell + bottom
        heights = {"coherence": 0.5, "phase": 0.55} if with_coherence else {"phase": 0.65}
        box = lambda y, h, x0=x0: figure.add_axes((x0 / width, y / height, panel / width, h / height))  # noqa: E731
        y, stack = y0, []
        for high in heights.values():
            stack.append(box(y, high))
            y += high + 0.1
        main = box(y, cell - bottom - 0.35 - (y - y0))
        parts = ("magnitude", *reversed(heights))
        pair = ((measured.responses[i],), (measured.references[j],))
        frfs = [f.select(*pair) for f in (measured, model) if f is not None]
        words = ("measured", "synthesised")[: len(frfs)]
        plot_frf(
            frfs, [main, *reversed(stack)], band=None if band is None else (band[0], band[1]), labels=words,
            noise=True, difference=model is not None, parts=parts, legend=False,
        )  # fmt: skip
        main.set_title(f"{measured.responses[i]} from {measured.references[j]} ({why})")
        if k == 0:
            figure.legend(handles=main.get_legend_handles_labels()[0], loc="upper left", ncols=4, bbox_to_anchor=(left / width - 0.01, 1.0))
    names = listing(f"{measured.responses[i]} from {measured.references[j]}" for i, j, _ in pairs)
    return figure, f"Measured and synthesised frequency response functions with phase{' and coherence' if with_coherence else ''}: {names}"


@drawn
def ofrf_pairs(
    check: Frf,
    ofrf: Frf | None,
    idle: Frf | None,
    pairs: Sequence[Pair],
    band: Sequence[float] | None = None,
    label: str = "operational FRF",
    on_hold_out: Sequence[tuple[float, float]] = (),
) -> tuple[Figure, str]:
    """SVG: magnitudes of operational FRFs with their 95 % band, the check measurement and the idle model, one panel a pair.

    All are on the same lines and pairs. Of a check whose data are NaN only lines and labels are drawn; the variance of ``ofrf`` gives the
    band. Frequency ranges on the hold-out set [Hz] are set off: nothing was fitted to their lines.
    """
    columns = min(2, len(pairs))
    rows = -(-len(pairs) // columns)
    width, cell = 10.2, 3.0
    height = rows * cell + 0.25
    figure = new_figure(width, height)
    left, gap = 0.68, 0.75
    panel = (width - left - 0.15 - gap * (columns - 1)) / columns
    for k, (i, j, why) in enumerate(pairs):
        x0 = left + (k % columns) * (panel + gap)
        y0 = height - 0.25 - (k // columns + 1) * cell + 0.5
        axes = figure.add_axes((x0 / width, y0 / height, panel / width, (cell - 0.8) / height))
        response, reference = check.responses[i], check.references[j]
        plot_ofrf(
            ofrf, check, idle, axes, response=response, reference=reference, band=band, label=label, parts=("magnitude",), legend=False
        )
        for n, (low, high) in enumerate(on_hold_out):
            axes.axvspan(low, high, color=HOLD_OUT, lw=0, zorder=0, label=None if n else "hold-out lines")
        axes.set_title(f"{check.responses[i]} from {check.references[j]} ({why})")
        if k == 0:
            handles, labels = axes.get_legend_handles_labels()
            figure.legend(handles, labels, loc="upper left", ncols=5, bbox_to_anchor=(left / width - 0.01, 1.0))
    names = listing(f"{check.responses[i]} from {check.references[j]}" for i, j, _ in pairs)
    if label != "operational FRF":
        return figure, f"Frequency response functions of the {label} with 95 % band against validation measurement and idle model: {names}"
    return figure, f"Operational frequency response functions with 95 % band against validation measurement and idle model: {names}"


@drawn
def frf_overview(measured: Frf, model: Frf | None, band: Sequence[float] | None = None) -> tuple[Figure, str]:
    """SVG: root mean square over all pairs, measured and synthesised, with their difference and the noise level."""
    figure = new_figure(10.2, 3.4)
    plot_frf_rms(measured, model, figure.add_axes((0.067, 0.14, 0.918, 0.77)), band=band, legend=False)
    figure.legend(loc="upper left", ncols=4, bbox_to_anchor=(0.057, 1.01))
    return figure, "Root mean square of all measured and synthesised frequency response functions, with difference and noise level"
