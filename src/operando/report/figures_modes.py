"""Mode shapes on the geometry, idle and operating side by side, and MAC matrices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Geometry
from operando.dof import Dof
from operando.io.csv import cell_text
from operando.plots import plot_mac, plot_shares
from operando.plots.mesh import Mesh
from operando.plots.shapes import draw_bars, draw_small
from operando.report.figure_csv import numbers, table_csv
from operando.report.svg import GREY, IDLE, MODEL, drawn, new_figure
from operando.report.text import count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PER_ROW = 3


class ShapePair:
    """One row of the gallery: an idle shape, an operating shape or both, real, with captions."""

    def __init__(
        self, label: str, idle: NDArray[Any] | None, operating: NDArray[Any] | None, idle_text: str = "", operating_text: str = ""
    ) -> None:
        self.label, self.idle, self.operating = label, idle, operating
        self.idle_text, self.operating_text = idle_text, operating_text


@drawn
def mode_shapes(geometry: Geometry | None, dofs: Sequence[Dof], pairs: Sequence[ShapePair]) -> tuple[Figure, str]:
    """SVG: each mode at rest and running, side by side, deformed over the undeformed structure; as bars without a geometry.

    Parameters
    ----------
    dofs : sequence of Dof
        One a row of each shape.
    """
    columns = min(_PER_ROW, max(len(pairs), 1))
    rows = -(-max(len(pairs), 1) // columns)
    width, head, cell = 10.2, 0.34, 1.75
    height = rows * (head + cell) + 0.1
    figure = new_figure(width, height)
    step = width / columns
    dofs = tuple(dofs)
    mesh = None if geometry is None else Mesh(geometry, dofs)
    sides = [any(p.idle is not None for p in pairs), any(p.operating is not None for p in pairs)]
    alone = sum(sides) == 1
    half = (step - 0.1) / (1 if alone else 2)
    word = lambda x, y, text, size, **kw: figure.text(x / width, y / height, text, fontsize=size, **kw)  # noqa: E731
    for k, pair in enumerate(pairs):
        x0, y0 = (k % columns) * step, height - (k // columns + 1) * (head + cell)
        word(x0 + 0.06, y0 + cell + 0.14, pair.label, 9, fontweight="bold")
        both = ((pair.idle, pair.idle_text, IDLE), (pair.operating, pair.operating_text, MODEL))
        for side, (shape, text, color) in enumerate([b for b, there in zip(both, sides, strict=True) if there] if alone else both):
            left = x0 + 0.04 + side * half
            word(left + half / 2, y0 + cell - 0.05, text, 7.5, ha="center", color=color)
            foot = 0.0 if mesh is not None and mesh.drawable else 0.38
            box = (left + 0.05, y0 + foot, half - 0.1, cell - 0.14 - foot)  # [inch]
            if shape is None:
                word(left + half / 2, y0 + cell / 2, "none", 7.5, ha="center", color=GREY)
            elif mesh is None or not mesh.drawable:
                axes = figure.add_axes((box[0] / width, box[1] / height, box[2] / width, box[3] / height))
                draw_bars(axes, dofs, np.asarray(shape, float), color, most=12)
                axes.tick_params(labelsize=5.5)
                axes.set_yticks([])
            else:
                draw_small(figure, box, mesh, np.asarray(shape, float))
    states = " and ".join(name for name, there in zip(("idle", "operating"), sides, strict=True) if there)
    return figure, f"Mode shapes, {states}, {count(len(pairs), 'mode')} side by side"


def shapes_csv(dofs: Sequence[Dof], pairs: Sequence[ShapePair]) -> str:
    """The shapes as drawn: one row a DOF, one column a mode and state."""
    columns = [("DOF", [cell_text(str(d)) for d in dofs])]
    for pair in pairs:
        for shape, state in ((pair.idle, "idle"), (pair.operating, "operating")):
            if shape is not None:
                columns.append((f"{pair.label} {state}", numbers(shape)))
    return table_csv(columns)


@drawn
def mac_matrices(matrices: Sequence[tuple[str, ArrayLike, Sequence[str], Sequence[str], str, str]]) -> tuple[Figure, str]:
    """SVG: MAC matrices side by side with values in the cells.

    Parameters
    ----------
    matrices : sequence of (title, (rows, columns) array, row labels, column labels, row axis name, column axis name)
    """
    width, n = 10.2, len(matrices)
    panel = (width - 0.1) / max(n, 2) - 0.85
    heights = [panel * np.shape(m[1])[0] / max(np.shape(m[1])[1], 1) for m in matrices]
    tall = min(max(heights), 1.3 * panel)
    height = tall + 1.1
    figure = new_figure(width, height)
    for k, (title, values, row_labels, column_labels, row_name, column_name) in enumerate(matrices):
        rows, columns = np.shape(values)
        wide = min(panel, tall * columns / rows)
        high = wide * rows / columns
        x0, y0 = 0.78 + k * (panel + 0.85), height - 0.3 - high
        axes = figure.add_axes((x0 / width, y0 / height, wide / width, high / height))
        plot_mac(values, axes=axes, labels=(row_labels, column_labels), names=(row_name, column_name), title=title)
    return figure, "Modal assurance criterion matrices: " + "; ".join(m[0] for m in matrices)


@drawn
def conditioning(labels: Sequence[str], share: ArrayLike, modes: Sequence[str], mode_share: ArrayLike) -> tuple[Figure, str]:
    """SVG: which sensors are nearly redundant and which combination of modes they barely tell apart, as shares of the weakest direction."""
    figure = new_figure(10.2, 2.3)
    for left, names, values, color, title in (
        (0.06, labels, share, MODEL, "Sensors in the weakest direction"),
        (0.56, modes, mode_share, IDLE, "Idle modes in the weakest direction"),
    ):
        plot_shares(names, values, figure.add_axes((left, 0.33, 0.43, 0.53)), title=title, color=color)
    return figure, "Share of each sensor and each idle mode in the least well conditioned direction of the idle shape matrix"
