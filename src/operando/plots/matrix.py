"""A matrix of numbers as coloured cells with the number in each: what MAC, error maps and participation are drawn by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from operando.plots.style import INK, WHITE_BLUE, colormap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_NUMBERS = 1600
"""Cells up to which numbers are written."""

LABEL_STEP = 0.125
"""Least distance of two labels [inches]."""

LEAST_SIZE = 4.2
"""Smallest letters [points]: below, numbers are left out."""


def draw_matrix(
    axes: Axes,
    values: ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    colors: Sequence[str] = WHITE_BLUE,
    top: float = 1.15,
    dark: float = 0.6,
    text: Callable[[float], str] = "{:.2f}".format,
    square: bool = True,
    limits: bool = False,
) -> None:
    """Cells from the top left, coloured by value (NaN white with a dash), with the value in each where there is room.

    ``colors`` go from 0 to ``top``; numbers above ``dark`` are white, and empty ``text`` of one leaves it out. With ``limits`` the labels
    of columns, one more than there are, stand at the borders of the cells.
    """
    table = np.asarray(values, float)
    n, m = table.shape
    shown = np.ma.masked_invalid(table)
    axes.pcolormesh(np.arange(m + 1), np.arange(n + 1), shown, cmap=colormap(colors), vmin=0, vmax=top, edgecolors="white", linewidth=0.6)
    axes.set_xlim(0, m)
    axes.set_ylim(n, 0)
    if square:
        axes.set_aspect("equal")
    figure = axes.get_figure(root=True)
    place = axes.get_position()
    wide = place.width * (figure.get_figwidth() if figure else 6.0) / m
    high = place.height * (figure.get_figheight() if figure else 6.0) / n
    cell = min(wide, high) if square else wide
    size = float(min(72 * cell * 0.34, 8.0)) if square else float(min(7.0, 26 * wide, 36 * high))
    if n * m <= MOST_NUMBERS and size >= LEAST_SIZE:
        for (i, j), v in np.ndenumerate(table):
            words = text(float(v)) if np.isfinite(v) else "–"
            if words:
                color = "white" if np.isfinite(v) and v > dark else INK
                axes.text(j + 0.5, i + 0.5, words, ha="center", va="center_baseline", fontsize=size, color=color)
    label = 8.0 if min(n, m) > 8 else 8.5
    every_row, every_column = (max(1, int(np.ceil(LABEL_STEP / s))) for s in (high, wide))
    axes.set_yticks(np.arange(n)[::every_row] + 0.5, list(rows)[::every_row], fontsize=label)
    shift = 0.0 if limits else 0.5
    turned = not limits and max((len(c) for c in columns), default=0) * 0.08 > wide
    axes.set_xticks(
        np.arange(len(columns))[::every_column] + shift, list(columns)[::every_column], fontsize=label, rotation=90 if turned else 0
    )
    axes.tick_params(length=2 if limits else 0)
    for spine in axes.spines.values():
        spine.set_visible(False)
