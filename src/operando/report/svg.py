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

from operando.plots.style import GREEN, GREY, IDLE, INK, MEASURED, MODEL, ORANGE, PALE, PURPLE, SKY, dots, log_axis, style, thin
from operando.report.figure_csv import figure_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "GREEN", "GREY", "IDLE", "INK", "MEASURED", "MODEL", "ORANGE", "PALE", "PURPLE", "SKY",
    "Drawing", "dots", "drawn", "log_axis", "new_figure", "thin", "to_svg",
]  # fmt: skip

FONT_STACK = "'Helvetica Neue', Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"

_TAG = re.compile(r"<[^<>]+>")  # texts and attributes hold no angle brackets, they are escaped
_ID = re.compile(r' id="([^"]*)"')
_FONT = re.compile(r" ?font-family: '?(?:DejaVu Sans|sans)[^;\"]*;?")
"""Families that the page replaces by its own."""
_PLACES = re.compile(r' (?:d|x|y)="[^"]*"')
_NUMBER = re.compile(r"-?\d+\.\d{3,}")

MORE_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # shipped with matplotlib and wider than the fonts above, so that measured text always fits
    "figure.dpi": 72,
    "axes.titley": 1.0,  # where matplotlib puts it by itself when no labels stand above; to find that out it lays out all labels
}

P = ParamSpec("P")


class Drawing(Markup):
    """An SVG element as markup, with the numbers it draws."""

    csv: str = ""

    @classmethod
    def of(cls, figure: Figure, alt: str, csv: str | None = None) -> Drawing:
        """Draw a figure; its CSV holds the numbers of its axes where none is given."""
        made = cls(to_svg(figure, alt))
        made.csv = figure_csv(figure) if csv is None else csv
        return made


def drawn(function: Callable[P, tuple[Figure, str]]) -> Callable[P, Drawing]:
    """Run a function that makes (figure, text alternative) under the report's style and return SVG."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> Drawing:
        with style(MORE_STYLE), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # the browser has the letters, and what acts is shown by the page
            figure, alt = function(*args, **kwargs)
            return Drawing.of(figure, alt)

    return wrapper


def new_figure(width: float, height: float) -> Figure:
    """Figure of a size in inches, without pyplot and so without any display or global state."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def to_svg(figure: Figure, alt: str) -> str:
    """SVG element for inline use, with a text for readers who do not see it.

    Its ids are unique to this content; coordinates have 0.01 pt; there are no links and no metadata.
    """
    from matplotlib import rc_context

    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "operando", "savefig.bbox": None}):
        figure.savefig(stream, format="svg", dpi="figure", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = stream.getvalue()
    prefix = f"f{hashlib.sha256(text.encode()).hexdigest()[:10]}-"
    used = set(re.findall(r'(?:href="|url\()#([^")]+)', "".join(_TAG.findall(text))))

    def slim(tag: re.Match[str]) -> str:
        if tag[0].startswith(("<!", "<?", "<a ", "</a>")):
            return ""
        kept = _ID.sub(lambda found: f' id="{prefix}{found[1]}"' if found[1] in used else "", tag[0])
        kept = kept.replace('xlink:href="', 'href="').replace('href="#', f'href="#{prefix}').replace("url(#", f"url(#{prefix}")
        kept = _FONT.sub("", kept).replace(": ", ":").replace("; ", ";").replace(" \n", " ")
        return _PLACES.sub(lambda place: _NUMBER.sub(lambda found: f"{round(float(found[0]), 2):.7g}", place[0]), kept)

    body = text[text.index("</defs>") + len("</defs>") : text.rindex("</svg>")]  # the first definitions are matplotlib's style
    body = re.sub("\n +", "\n", _TAG.sub(slim, body))
    width, height = 72 * figure.get_size_inches()
    return (
        f'<svg viewBox="0 0 {width:.7g} {height:.7g}" style="max-width:{width * 96 / 72:.0f}px" role="img" '
        f"aria-label={quoteattr(alt)}><title>{escape(alt)}</title>"
        f'<g font-family={quoteattr(FONT_STACK)} stroke-linejoin="round">{body}</g></svg>'
    )
