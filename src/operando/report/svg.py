"""From matplotlib figures to small inline SVG: one style, unique ids, no external reference, thinned curves."""

from __future__ import annotations

import functools
import hashlib
import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ParamSpec
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

FONT_STACK = "'Helvetica Neue', Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"
_FONT = "DejaVu Sans"  # shipped with matplotlib and wider than the fonts above, so that measured text always fits

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "operando",
    "font.family": _FONT,
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
    "figure.dpi": 72,
    "savefig.dpi": 144,
    "text.parse_math": False,
    "axes.unicode_minus": True,
}

P = ParamSpec("P")


def drawn(function: Callable[P, tuple[Figure, str]]) -> Callable[P, str]:
    """Run a function that makes (figure, text alternative) under the report's style and return SVG text."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> str:
        import matplotlib

        with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
            figure, alt = function(*args, **kwargs)
            return to_svg(figure, alt)

    return wrapper


def new_figure(width: float, height: float) -> Figure:
    """Figure of a size in inches, without pyplot and so without any display or global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def to_svg(figure: Figure, alt: str) -> str:
    """SVG element for inline use.

    Parameters
    ----------
    figure : matplotlib Figure
    alt : str
        Text alternative for readers who do not see it.

    Returns
    -------
    str
        ``<svg …>…</svg>`` whose ids are unique to this content, with coordinates of 0.01 pt and no metadata.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    stream = io.StringIO()
    FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = stream.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    opening = re.search(r"<svg[^>]*>", text)
    if opening is None:  # pragma: no cover - matplotlib always writes one
        raise RuntimeError("matplotlib wrote no svg element")
    body = text[opening.end() : text.rindex("</svg>")]
    box = re.search(r'viewBox="([^"]+)"', opening.group(0))
    body = re.sub(r' d="([^"]*)"', lambda m: ' d="' + _short_path(m.group(1)) + '"', body)
    body = re.sub(r'(x|y)="(-?\d+\.\d{3,})"', lambda m: f'{m.group(1)}="{float(m.group(2)):.2f}"', body)
    body = body.replace("xlink:href=", "href=").replace(f"'{_FONT}'", FONT_STACK.replace('"', "'"))
    prefix = "f" + hashlib.sha256(body.encode()).hexdigest()[:10]
    body = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', body)
    body = body.replace("url(#", f"url(#{prefix}-").replace('href="#', f'href="#{prefix}-')
    body = re.sub(r"\n\s*", "\n", body)
    size = box.group(1) if box else "0 0 100 100"
    width = float(size.split()[2]) * 96 / 72
    return (
        f'<svg viewBox="{size}" style="max-width:{width:.0f}px" role="img" aria-label={quoteattr(alt)}>'
        f"<title>{escape(alt)}</title>{body}</svg>"
    )


def _short_path(d: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"-?\d+\.\d+", lambda m: f"{float(m.group(0)):.2f}".rstrip("0").rstrip("."), d)).strip()


def thin(x: ArrayLike, y: ArrayLike, count: int = 700) -> NDArray[np.intp]:
    """Indices that keep the look of a curve: the least and the greatest value in each of ``count`` equal intervals of x.

    Parameters
    ----------
    x, y : (k,) arrays
        x increasing; y may hold NaN.
    count : int
        Number of intervals.

    Returns
    -------
    int array, increasing; all indices where there are fewer than 2·count points.
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
        axes.add_patch(PathPatch(path, facecolor="none", edgecolor=color, linewidth=size, capstyle="round", zorder=3))
    if label is not None:
        axes.add_line(Line2D([], [], linestyle="none", marker="o", markersize=size, color=color, label=label, markeredgewidth=0))


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def log_axis(axis: Any) -> None:
    """Tick labels of a logarithmic axis as 0.1, 1, 10 or 10⁻³, without mathematics typesetting."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    def label(value: float, _: Any) -> str:
        if value <= 0:
            return ""
        exponent = round(np.log10(value))
        if -2 <= exponent <= 3:
            return f"{value:g}"
        return "10" + str(exponent).translate(_SUPERSCRIPT)

    axis.set_major_locator(LogLocator(10, numticks=7))
    axis.set_major_formatter(FuncFormatter(label))
    axis.set_minor_locator(NullLocator())  # minor ticks cost a third of the drawing time
