"""How figures look: colours, one style, thinned curves, many dots as one path, readable logarithmic axes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.errors import ObjectError
from operando.printable import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe & Ito's colours, told apart with every common colour vision deficiency; line styles differ as well.
INK = "#1f2933"
MEASURED = "#444c56"
MODEL = "#0072b2"
IDLE = "#d55e00"
GREEN = "#00805c"
SKY = "#56b4e9"
ORANGE = "#e69f00"
PURPLE = "#aa4e86"
GREY = "#8a949e"
PALE = "#d5dbe1"
OUTSIDE = "#eef1f4"
"""Shade of what lies outside the analysis band."""

CYCLE = (MEASURED, IDLE, MODEL, GREEN, PURPLE, ORANGE, SKY, GREY)
"""Colours of curves drawn one after the other."""

DASHES: tuple[Any, ...] = ("-", (0, (4, 2)), (0, (1, 1)), (0, (6, 2, 1, 2)))
"""Line styles of curves drawn one after the other."""

YELLOW_BROWN = ("#ffffe5", "#fff0b4", "#fed06b", "#fb9f33", "#e56a12", "#bf4503", "#8a3104", "#5c2006")
"""Pale yellow to brown, for sizes (after ColorBrewer's YlOrBr)."""

WHITE_BLUE = ("#f7fbff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08519c", "#08306b")
"""White to blue, for shares (ColorBrewer's Blues)."""

ORANGE_PURPLE = (
    "#7f3b08", "#b35806", "#e08214", "#fdb863", "#fee0b6", "#f7f7f7", "#d8daeb", "#b2abd2", "#8073ac", "#542788", "#2d004b",
)  # fmt: skip
"""Orange through white to purple, for signed values (ColorBrewer's PuOr)."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # shipped with matplotlib
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": "#5b6670",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "grid.color": "#e3e7eb",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.1,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "text.parse_math": False,
    "axes.unicode_minus": True,
}


_styled = ContextVar("styled", default=False)


@contextmanager
def style(more: Mapping[str, Any] | None = None) -> Iterator[None]:
    """The look of all figures with ``more`` settings of matplotlib, while something is drawn; inside of itself it changes nothing."""
    import matplotlib

    settings = ({} if _styled.get() else STYLE) | dict(more or {})
    token = _styled.set(True)
    try:
        with matplotlib.rc_context(settings) if settings else nullcontext():  # type: ignore[arg-type]
            yield
    finally:
        _styled.reset(token)


SOLID = (0.0, 0.07, 0.97, 0.93)
"""Part of a figure (left, bottom, width, height) given to axes in three dimensions: their words stand to the right and below."""


def new_axes(width: float = 8.0, height: float = 4.0, projection: str | None = None) -> Axes:
    """Axes of a new figure of a size in inches, made by pyplot, so that a notebook or ``pyplot.show`` shows it."""
    import matplotlib.pyplot as plt
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    # in three dimensions the layout does not know how far the words at the axes reach
    room = ConstrainedLayoutEngine(rect=SOLID if projection == "3d" else (0, 0, 1, 1))
    figure = plt.figure(figsize=(width, height), layout=room)
    return figure.add_subplot(projection=projection)


def new_stack(heights: Sequence[float], labels: Sequence[str], width: float = 8.0, height: float = 5.0) -> list[Axes]:
    """Axes below one another on one frequency axis, of a new figure; the last one bears the numbers below."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(width, height), layout="constrained")
    grid = figure.add_gridspec(len(heights), 1, height_ratios=list(heights))
    out: list[Axes] = []
    for k, label in enumerate(labels):
        out.append(figure.add_subplot(grid[k], sharex=out[0] if out else None, label=label))
        out[-1].tick_params(labelbottom=k == len(labels) - 1)
    return out


def stack_of(axes: Axes, labels: Sequence[str]) -> dict[str, Axes]:
    """The axes that :func:`new_stack` made together with these, by their labels; these alone where it did not."""
    if not callable(getattr(axes, "get_figure", None)):
        raise ObjectError(f"a figure is drawn on matplotlib Axes, not {type(axes).__name__}", hint="leave them out, or axes = other.plot()")
    figure: Figure | None = axes.get_figure(root=True)
    top = str(axes.get_label())
    if figure is None or top not in labels:
        return {labels[0]: axes}
    shared = axes.get_shared_x_axes()
    found = {str(other.get_label()): other for other in figure.axes if other is axes or shared.joined(axes, other)}
    return {name: found[name] for name in labels if name in found}


def thin(x: ArrayLike, y: ArrayLike, count: int = 700) -> NDArray[np.intp]:
    """Indices that keep the look of a curve: the least and the greatest value in each of ``count`` equal intervals of x.

    x increases, y may hold NaN; all indices where there are fewer than 2·count points.
    """
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if xs.size <= 2 * count:
        return np.arange(xs.size)
    bins = np.minimum(((xs - xs[0]) / (xs[-1] - xs[0]) * count).astype(int), count - 1)
    starts = np.r_[0, np.flatnonzero(np.diff(bins)) + 1]
    part = np.cumsum(np.r_[False, np.diff(bins) > 0])
    keep = [np.array([0, xs.size - 1])]
    for extreme, missing in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        filled = np.where(np.isnan(ys), missing, ys)
        best = extreme.reduceat(filled, starts)
        hits = np.flatnonzero((filled == best[part]) & ~np.isnan(ys))
        keep.append(hits[np.unique(part[hits], return_index=True)[1]])
    return np.unique(np.concatenate(keep)).astype(np.intp)


def dots(axes: Axes, x: ArrayLike, y: ArrayLike, color: str, size: float, label: str | None = None) -> None:
    """Many round dots as one path (zero-length strokes with round caps): a tenth of the size of markers in SVG."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if xs.size:
        vertices = np.repeat(np.column_stack([xs, ys]), 2, axis=0)
        path = Path(vertices, np.tile([Path.MOVETO, Path.LINETO], xs.size))
        path.should_simplify = False  # simplification drops strokes of no length
        # as add_patch does it, which goes through every stroke for the limits
        axes.add_artist(PathPatch(path, facecolor="none", edgecolor=color, linewidth=size, capstyle="round", zorder=3))
        axes.update_datalim(vertices)
    if label is not None:
        axes.add_line(Line2D([], [], linestyle="none", marker="o", markersize=size, color=color, label=label, markeredgewidth=0))


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

NARROW = 20.0
"""Ratio of the limits of a logarithmic axis below which 2 and 5 are numbered, too: else it may bear one number only."""


def log_axis(axis: Any) -> None:
    """Tick labels of a logarithmic axis as 0.1, 1, 10 or 10⁻³, without mathematics typesetting. Its limits are set before."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    def label(value: float, _: Any) -> str:
        if value <= 0:
            return ""
        exponent = int(np.floor(np.log10(value) + 1e-9))
        if -2 <= exponent <= 3:
            return f"{value:g}"
        first = round(value / 10.0**exponent)
        return ("" if first == 1 else f"{first}·") + "10" + str(exponent).translate(_SUPERSCRIPT)

    low, high = axis.get_view_interval()
    few = 0 < low < high < NARROW * low
    axis.set_major_locator(LogLocator(10, subs=(1, 2, 5) if few else (1,), numticks=7))
    axis.set_major_formatter(FuncFormatter(label))
    axis.set_minor_locator(NullLocator())  # minor ticks cost a third of the drawing time


def colormap(colors: Sequence[str]) -> Any:
    """Colour map through a row of colours, evenly."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("operando", list(colors))


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, in plain notation where that is readable."""
    if not np.isfinite(value) or value == 0:
        return "–" if not np.isfinite(value) else "0"
    if not 1e-4 <= abs(value) < 1e6:
        exponent = int(np.floor(np.log10(abs(value))))
        return f"{value / 10.0**exponent:.{max(digits - 1, 0)}f}·10{str(exponent).translate(_SUPERSCRIPT)}".replace("-", "−")
    exponent = int(np.floor(np.log10(abs(value))))
    return f"{value:.{max(digits - 1 - exponent, 0)}f}".replace("-", "−")


def short_name(name: str) -> str:
    """The name of a file without the folders it lies in; other names as they are, without what acts on a screen."""
    return printable(PurePath(name).name if PurePath(name).suffix else name)


def frequency_axis(axes: Axes, low: float, high: float, band: Sequence[float] | None = None, label: bool = True) -> None:
    """Limits, grid and words of a frequency axis; what lies outside the analysis band is shaded."""
    axes.set_xlim((low, high) if high > low else (low - 0.5, low + 0.5))
    axes.grid(True)
    if band is not None:
        for a, b in ((low, band[0]), (band[1], high)):
            if b > a:
                axes.axvspan(a, b, color=OUTSIDE, zorder=0, linewidth=0)
    if label:
        axes.set_xlabel("Frequency [Hz]")
    else:
        axes.tick_params(labelbottom=False)


def mode_numbers(axes: Axes, modes: ArrayLike, low: float, high: float) -> None:
    """Mode numbers (from 0) above the frame, raised where neighbours would overlap."""
    last, level = -np.inf, 0
    for k, f in enumerate(np.asarray(modes, float)):
        if not low <= f <= high:
            continue
        level = 1 - level if f - last < 0.014 * (high - low) else 0
        last = float(f)
        where, shift = (float(f), 1.0), (0, 2 + 9 * level)
        axes.annotate(
            str(k), where, shift, xycoords=("data", "axes fraction"), textcoords="offset points", ha="center", fontsize=7.5, color=IDLE
        )
