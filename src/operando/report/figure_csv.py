"""The numbers that a figure draws, as one CSV table."""

from __future__ import annotations

from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from operando.io.csv import cell_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Column = tuple[str, list[str]]


def figure_csv(figure: Figure) -> str:
    """All curves, points, bars and maps of a figure; empty for one without numbers. What is drawn thinned stands there thinned.

    One column of x, then the columns of y that belong to it, and so on for each x that is another.
    """
    columns: list[Column] = []
    for number, axes in enumerate(figure.axes, start=1):
        if axes.name == "3d":
            continue
        columns += _columns(axes, axes.get_title() or axes.get_title("left") or (f"panel {number}" if len(figure.axes) > 1 else ""))
    return table_csv(columns)


def table_csv(columns: list[Column]) -> str:
    """Named columns, of different lengths, as CSV."""
    if not columns:
        return ""
    rows = zip_longest(*(values for _, values in columns), fillvalue="")
    return "\n".join(",".join(cells) for cells in ([cell_text(name) for name, _ in columns], *rows)) + "\n"


def numbers(values: Any, digits: int = 4) -> list[str]:
    """Numbers, nothing where there is none."""
    flat = np.asarray(values, float).ravel().tolist()
    return ["" if word in ("nan", "inf", "-inf") else word for word in (f"%.{digits}g " * len(flat) % tuple(flat)).split()]


def _columns(axes: Axes, title: str) -> list[Column]:
    from matplotlib.collections import PathCollection, PolyCollection, QuadMesh
    from matplotlib.container import BarContainer
    from matplotlib.patches import PathPatch

    head = f"{title}: " if title else ""
    x_name, y_name = f"{head}{axes.get_xlabel() or 'x'}", axes.get_ylabel() or "y"
    out: list[Column] = []
    last: Any = None

    def add(x: Any, y: Any, label: object) -> None:
        nonlocal last
        x, y = np.asarray(x, float), np.asarray(y, float)
        if x.size < 2:
            return
        if last is None or x.shape != last.shape or not np.array_equal(x, last, equal_nan=True):
            out.append((x_name, numbers(x, 6)))
            last = x
        text = str(label)
        out.append((f"{head}{y_name}" + ("" if not text or text.startswith("_") else f"; {text}"), numbers(y)))

    for line in axes.lines:
        x, y = np.asarray(line.get_xdata(orig=True)), np.asarray(line.get_ydata(orig=True))
        if line.get_transform() == axes.transData and x.dtype.kind in "if" and len(x) > 1:
            add(x, y, line.get_label())
    for c in axes.collections:
        if isinstance(c, PathCollection):
            add(*_xy(c.get_offsets()), c.get_label())
        elif isinstance(c, QuadMesh):
            out += _matrix(axes, c, head)
        elif isinstance(c, PolyCollection) and c.get_paths():
            add(*_xy(c.get_paths()[0].vertices), f"{c.get_label()} (outline of the band)".lstrip("_"))
    for p in axes.patches:
        if isinstance(p, PathPatch):
            add(*_xy(np.asarray(p.get_path().vertices)[::2]), "points")
    bars = [p for group in axes.containers if isinstance(group, BarContainer) for p in group.patches]
    return out + (_bars(axes, bars, head) if bars else [])


def _numbers_at(axis: Any) -> list[str]:
    return list(axis.get_major_formatter().format_ticks(axis.get_majorticklocs()))


def _xy(points: Any) -> tuple[Any, Any]:
    x, y = np.asarray(points, float).T
    return x, y


def _bars(axes: Axes, bars: list[Any], head: str) -> list[Column]:
    """Name, start and end of each bar, lying or standing."""
    lying = len({round(b.get_x(), 9) for b in bars}) == 1 and len({round(b.get_y(), 9) for b in bars}) > 1
    axis, label = (axes.yaxis, axes.get_xlabel()) if lying else (axes.xaxis, axes.get_ylabel())
    texts = [" ".join(name.split()) for name in _numbers_at(axis)]
    rest = [(b.get_x(), b.get_x() + b.get_width()) if lying else (b.get_y(), b.get_y() + b.get_height()) for b in bars]
    named = [(f"{head}bar", [cell_text(t) for t in texts])] if len(texts) == len(bars) else []
    return [
        *named,
        (f"{head}{label or 'bar'} from", numbers([a for a, _ in rest])),
        (f"{head}{label or 'bar'} to", numbers([b for _, b in rest])),
    ]


def _matrix(axes: Axes, mesh: Any, head: str) -> list[Column]:
    """A map: names of its rows, then a column for each of its columns."""
    values: Any = np.ma.filled(np.ma.asarray(mesh.get_array(), float), np.nan)
    n, m = np.shape(mesh.get_coordinates())[0] - 1, np.shape(mesh.get_coordinates())[1] - 1
    values = values.reshape(n, m)
    rows, columns = _numbers_at(axes.yaxis), _numbers_at(axes.xaxis)
    rows = rows if len(rows) == n else [str(i) for i in range(n)]
    edges = len(columns) == m + 1
    columns = (
        [f"{columns[i]} to {columns[i + 1]}" for i in range(m)] if edges else columns if len(columns) == m else [str(i) for i in range(m)]
    )
    named = [(f"{head}{axes.get_xlabel()} {name}".strip(), numbers(values[:, i])) for i, name in enumerate(columns)]
    return [(f"{head}{axes.get_ylabel() or 'row'}", [cell_text(r) for r in rows]), *named]
