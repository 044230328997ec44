"""Maps of numbers, side by side on one colour scale, each number written in its cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operando.report.canvas import YELLOW_BROWN, Canvas, shades
from operando.report.svg import INK

WIDTH = 10.2
MOST_ROWS = 40
"""Rows up to which numbers are written and all rows named."""


def value_maps(
    maps: Sequence[tuple[str, NDArray[np.float64]]],
    rows: Sequence[str],
    limits: Sequence[str],
    scale: str,
    axes: tuple[str, str],
    alt: str,
    least_top: float = 0.5,
) -> str:
    """SVG: one or more maps of numbers.

    Parameters
    ----------
    maps : sequence of (title, (n_rows, n_columns) array)
        NaN makes a dash.
    rows : sequence of str
    limits : (n_columns + 1,) sequence of str
        Words at the column limits.
    scale : str
        Words at the colour scale.
    axes : (str, str)
        Words under the columns and beside the rows.
    alt : str
        Text alternative.
    least_top : float
        The colour scale reaches at least so far.
    """
    n, m = len(rows), len(limits) - 1
    finite = np.concatenate([np.asarray(v, float)[np.isfinite(v)] for _, v in maps])
    top = max(float(np.max(finite)) if finite.size else 1.0, least_top)
    cell = float(np.clip(4.2 / max(n, 1), 0.13, 0.26))
    foot, left, gap = 0.5, 0.68, 0.62
    panel = (WIDTH - left - 0.75 - gap * (max(len(maps), 2) - 1)) / max(len(maps), 2)
    step = panel / m
    sheet = Canvas(WIDTH, n * cell + foot + 0.3)
    size = min(7.0, 36 * cell, 26 * step)
    for k, (title, values) in enumerate(maps):
        x0 = left + k * (panel + gap)
        sheet.text(x0, foot + n * cell + 0.1, title, 10, bold=True)
        corners, known = [], np.isfinite(values)
        for i in range(n):
            y = foot + (n - 1 - i) * cell
            corners += [_cell(x0 + j * step, y, step - 0.007, cell - 0.007) for j in range(m)]
            if i % max(1, n // MOST_ROWS) == 0:
                sheet.text(x0 - 0.05, y + cell / 2 - 0.035, rows[i], 7.5, "end")
        fills = shades(np.where(known, values, 0) / top, YELLOW_BROWN)
        sheet.polygons(corners, [f if ok else "#ffffff" for f, ok in zip(fills, known.ravel(), strict=True)])
        if n <= MOST_ROWS:
            for (i, j), v in np.ndenumerate(values):
                words = "–" if not known[i, j] else f"{v:.1f}" if v < 99.95 else f"{v:.0f}"
                dark = known[i, j] and v > 0.55 * top
                y = foot + (n - 1 - i) * cell + cell / 2 - 0.35 * size / 72
                sheet.text(x0 + (j + 0.5) * step, y, words, size, "middle", "#ffffff" if dark else INK)
        for j, words in enumerate(limits):
            sheet.text(x0 + j * step, foot - 0.14, words, min(7.0, 22 * step), "middle")
        sheet.text(x0 + panel / 2, foot - 0.36, axes[0], 9, "middle")
    sheet.text(0.13, foot + n * cell / 2, axes[1], 9, "middle", turn=90)
    _scale(sheet, WIDTH - 0.55, foot, n * cell, top, scale)
    return sheet.svg(alt)


def _cell(x: float, y: float, width: float, height: float) -> list[tuple[float, float]]:
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


def _scale(sheet: Canvas, x: float, y: float, height: float, top: float, words: str) -> None:
    """Colour bar with its ends and middle."""
    steps = 32
    corners = [_cell(x, y + height * k / steps, 0.125, height / steps + 0.004) for k in range(steps)]
    sheet.polygons(corners, shades((np.arange(steps) + 0.5) / steps, YELLOW_BROWN))
    for share in (0.0, 0.5, 1.0):
        sheet.text(x + 0.16, y + height * share - 0.035, f"{share * top:.2g}", 7.5)
    sheet.text(x + 0.53, y + height / 2, words, 8.5, "middle", turn=90)
