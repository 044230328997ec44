"""A drawing as SVG written by hand, for figures of very many simple parts: matplotlib needs a hundred times longer for each of them."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.report.svg import FONT_STACK, INK

YELLOW_BROWN = ("#ffffe5", "#fff0b4", "#fed06b", "#fb9f33", "#e56a12", "#bf4503", "#8a3104", "#5c2006")
"""Pale yellow to brown, for sizes (after ColorBrewer's YlOrBr)."""

WHITE_BLUE = ("#f7fbff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08519c", "#08306b")
"""White to blue, for shares (ColorBrewer's Blues)."""

ORANGE_PURPLE = (
    "#7f3b08", "#b35806", "#e08214", "#fdb863", "#fee0b6", "#f7f7f7", "#d8daeb", "#b2abd2", "#8073ac", "#542788", "#2d004b",
)  # fmt: skip
"""Orange through white to purple, for signed values (ColorBrewer's PuOr)."""

PIXELS = 96.0
"""Pixels an inch."""


def shades(values: ArrayLike, colors: Sequence[str]) -> list[str]:
    """Colours of values between 0 and 1, evenly along a row of colours."""
    at = np.clip(np.asarray(values, float).ravel(), 0, 1) * (len(colors) - 1)
    parts = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colors], float)
    mixed = np.column_stack([np.interp(at, np.arange(len(colors)), parts[:, k]) for k in range(3)])
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.rint(mixed).astype(int).tolist()]


class Canvas:
    """Lines, polygons, dots and words on a sheet; places in inches, y upwards; sizes of words and lines in points.

    Parameters
    ----------
    width, height : float
        Inches.
    """

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self._parts: list[str] = []

    def _xy(self, points: ArrayLike) -> NDArray[np.float64]:
        p = np.asarray(points, float).reshape(-1, 2)
        return np.round(np.column_stack([p[:, 0], self.height - p[:, 1]]) * PIXELS, 1)

    def _path(self, points: ArrayLike) -> str:
        return "M" + "L".join(f"{x:g} {y:g}" for x, y in self._xy(points).tolist())

    def text(
        self, x: float, y: float, words: str, size: float, anchor: str = "start", color: str = INK, bold: bool = False, turn: float = 0.0
    ) -> None:
        """Words with their baseline at y; ``anchor`` is ``start``, ``middle`` or ``end``; turned by degrees, anticlockwise."""
        (px, py), points = self._xy((x, y))[0], size * PIXELS / 72
        more = f' transform="rotate({-turn:g} {px:g} {py:g})"' if turn else ""
        more += ' font-weight="bold"' if bold else ""
        self._parts.append(
            f'<text x="{px:g}" y="{py:g}" font-size="{points:.3g}" text-anchor="{anchor}" fill="{color}"{more}>{escape(words)}</text>'
        )

    def lines(self, lines: Sequence[ArrayLike], color: str, width: float) -> None:
        """Separate lines of one look, each (k, 2)."""
        if len(lines):
            path = "".join(self._path(line) for line in lines)
            self._parts.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="{width * PIXELS / 72:.3g}"/>')

    def polygons(self, corners: Sequence[ArrayLike], colors: Sequence[str], edge: float = 0.0) -> None:
        """Filled polygons, each (k, 2), later ones in front; ``edge`` is the width of an outline of their own colour."""
        outline = f' stroke-width="{edge * PIXELS / 72:.3g}" stroke-linejoin="round"' if edge else ""
        self._parts.append(f"<g{outline}>")
        for points, color in zip(corners, colors, strict=True):
            stroke = f' stroke="{color}"' if edge else ""
            self._parts.append(f'<path d="{self._path(points)}Z" fill="{color}"{stroke}/>')
        self._parts.append("</g>")

    def dots(self, points: ArrayLike, colors: Sequence[str], size: float, edge: float) -> None:
        """Round dots of one diameter with a dark outline."""
        radius = f"{size / 2 * PIXELS / 72:.3g}"
        self._parts.append(f'<g stroke="{INK}" stroke-width="{edge * PIXELS / 72:.3g}">')
        for (x, y), color in zip(self._xy(points).tolist(), colors, strict=True):
            self._parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="{radius}" fill="{color}"/>')
        self._parts.append("</g>")

    def svg(self, alt: str) -> str:
        """The SVG element for inline use, with its text alternative."""
        width, height = self.width * PIXELS, self.height * PIXELS
        return (
            f'<svg viewBox="0 0 {width:.1f} {height:.1f}" style="max-width:{width:.0f}px" role="img" aria-label={quoteattr(alt)}>'
            f"<title>{escape(alt)}</title><g font-family={quoteattr(FONT_STACK)}>{''.join(self._parts)}</g></svg>"
        )
