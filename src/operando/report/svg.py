"""From matplotlib figures to small inline SVG: unique ids, no external reference. Colours and style are those of all figures."""

from __future__ import annotations

import functools
import hashlib
import io
import re
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ParamSpec
from xml.sax.saxutils import escape, quoteattr

from markupsafe import Markup

from operando.plots.style import GREEN, GREY, IDLE, INK, MEASURED, MODEL, ORANGE, PALE, PURPLE, SKY, dots, log_axis, thin
from operando.plots.style import STYLE as HOUSE_STYLE
from operando.report.figure_csv import figure_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "GREEN", "GREY", "IDLE", "INK", "MEASURED", "MODEL", "ORANGE", "PALE", "PURPLE", "SKY",
    "STYLE", "Drawing", "dots", "drawn", "log_axis", "new_figure", "thin", "to_svg",
]  # fmt: skip

FONT_STACK = "'Helvetica Neue', Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"
_FONT = "DejaVu Sans"  # shipped with matplotlib and wider than the fonts above, so that measured text always fits

STYLE: dict[str, Any] = HOUSE_STYLE | {
    "svg.fonttype": "none",
    "svg.hashsalt": "operando",
    "font.family": _FONT,
    "figure.dpi": 72,
    "savefig.dpi": 144,
    "axes.titley": 1.0,  # where matplotlib puts it by itself when no labels stand above; to find that out it lays out all labels
}

LONG_PATH = 400
"""Characters from which a path is a curve and no mark: a tenth of a point is less than a seventh of its line's width on paper."""

P = ParamSpec("P")


class Drawing(Markup):
    """An SVG element as markup, with the numbers it draws."""

    csv: str = ""

    @classmethod
    def of(cls, figure: Figure, alt: str, csv: str | None = None) -> Drawing:
        """Draw a figure.

        Parameters
        ----------
        figure : matplotlib Figure
        alt : str
            Text alternative.
        csv : str, optional
            The numbers; default: those of its axes.
        """
        import matplotlib

        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "operando"}):
            made = cls(to_svg(figure, alt))
        made.csv = figure_csv(figure) if csv is None else csv
        return made


def drawn(function: Callable[P, tuple[Figure, str]]) -> Callable[P, Drawing]:
    """Run a function that makes (figure, text alternative) under the report's style and return SVG."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> Drawing:
        import matplotlib

        with matplotlib.rc_context(STYLE), warnings.catch_warnings():  # type: ignore[arg-type]
            warnings.filterwarnings("ignore", "Glyph .* missing")  # the browser has the letters, and what acts is shown by the page
            figure, alt = function(*args, **kwargs)
            return Drawing.of(figure, alt)

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
        ``<svg …>…</svg>`` whose ids are unique to this content, with coordinates of 0.01 pt (0.1 pt in long paths) and no metadata.
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
    body = _without_ballast(body.replace("xlink:href=", "href="))
    prefix = "f" + hashlib.sha256(body.encode()).hexdigest()[:10]
    body = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', body)
    body = body.replace("url(#", f"url(#{prefix}-").replace('href="#', f'href="#{prefix}-')
    body = re.sub(r"\n\s*", "\n", body)
    size = box.group(1) if box else "0 0 100 100"
    width = float(size.split()[2]) * 96 / 72
    return (
        f'<svg viewBox="{size}" style="max-width:{width:.0f}px" role="img" aria-label={quoteattr(alt)}>'
        f"<title>{escape(alt)}</title><g font-family={quoteattr(FONT_STACK)}>{body}</g></svg>"
    )


def _without_ballast(body: str) -> str:
    """What matplotlib writes for every element and the drawing does not need: ids nobody refers to, the font, turns by nothing."""
    body = re.sub(rf" font-family: '{_FONT}'[^;\"]*;?", "", body)
    body = re.sub(r' transform="rotate\(-?0 [^"]*"', "", body)
    used = set(re.findall(r'href="#([^"]+)"', body)) | set(re.findall(r"url\(#([^)]+)\)", body))
    body = re.sub(r' id="([^"]+)"', lambda m: m.group(0) if m.group(1) in used else "", body)
    body = re.sub(r'(style="[^"]*")', lambda m: m.group(1).replace("; ", ";").replace(": ", ":").replace(';"', '"'), body)
    empty, alone = r"<g/>|<g>\s*</g>|<defs>\s*</defs>", r"<g>\s*(<(?:use|path|image)[^>]*/>|<text[^>]*>[^<]*</text>)\s*</g>"
    while (shorter := re.sub(alone, r"\1", re.sub(empty, "", body))) != body:
        body = shorter
    return re.sub(r'(?:<use [^>]*?style="([^"]*)"/>\s*)(?:<use [^>]*?style="\1"/>\s*)+', _one_style, body)


def _one_style(run: re.Match[str]) -> str:
    """A run of marks of one look, with the look said once."""
    return f'<g style="{run.group(1)}">' + re.sub(r' style="[^"]*"', "", run.group(0)) + "</g>"


def _short_path(d: str) -> str:
    digits = 1 if len(d) > LONG_PATH else 2
    short = re.sub(r"-?\d+\.\d+", lambda m: f"{float(m.group(0)):.{digits}f}".rstrip("0").rstrip("."), d)
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", re.sub(r"\s+", " ", short)).strip()
