"""From matplotlib figures to small inline SVG: unique ids, no external reference. Colours and style are those of all figures."""

from __future__ import annotations

import functools
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

MORE_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # shipped with matplotlib and wider than the fonts above, so that measured text always fits
    "figure.dpi": 72,
    "savefig.dpi": 144,
    "axes.titley": 1.0,  # where matplotlib puts it by itself when no labels stand above; to find that out it lays out all labels
}

P = ParamSpec("P")


class Drawing(Markup):
    """An SVG element as markup, with the numbers it draws."""

    csv: str = ""

    @classmethod
    def of(cls, figure: Figure, alt: str, csv: str | None = None) -> Drawing:
        """Draw a figure, with ``alt`` for readers who do not see it; its numbers are those of its axes where no ``csv`` is given."""
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
    from operando.report.sheet import Sheet

    return Sheet(figsize=(width, height))


def to_svg(figure: Figure, alt: str) -> str:
    """SVG element for inline use, with ``alt`` for readers who do not see it.

    Its ids are unique to this content; coordinates have 0.01 pt (0.1 pt in long paths).
    """
    from matplotlib.backends.backend_mixed import MixedModeRenderer

    from operando.report.renderer import SmallSvg, short

    inches, dpi = figure.get_size_inches(), figure.dpi
    width, height = 72 * inches
    small = SmallSvg(width, height, dpi)
    figure.dpi = 72
    try:
        figure.draw(MixedModeRenderer(figure, inches[0], inches[1], dpi, small))  # type: ignore[arg-type]
    finally:
        figure.dpi = dpi
    return (
        f'<svg viewBox="0 0 {short(width)} {short(height)}" style="max-width:{width * 96 / 72:.0f}px" role="img" '
        f"aria-label={quoteattr(alt)}><title>{escape(alt)}</title>"
        f'<g font-family={quoteattr(FONT_STACK)} stroke-linejoin="round">{small.text()}</g></svg>'
    )
