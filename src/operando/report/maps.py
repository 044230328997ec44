"""Maps of numbers as SVG written by hand: a matplotlib figure of a few hundred cells takes a quarter of a second, this a millisecond."""

from __future__ import annotations

from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from numpy.typing import NDArray

from operando.report.svg import FONT_STACK, INK

_RAMP = ("#ffffe5", "#fff0b4", "#fed06b", "#fb9f33", "#e56a12", "#bf4503", "#8a3104", "#5c2006")
"""Pale yellow to brown, even steps of lightness (after ColorBrewer's YlOrBr)."""

EMPTY = "#ffffff"


def ramp(share: float) -> str:
    """Colour of a share between 0 and 1."""
    at = float(np.clip(share, 0, 1)) * (len(_RAMP) - 1)
    k = min(int(at), len(_RAMP) - 2)
    one, two = ([int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in (_RAMP[k], _RAMP[k + 1]))
    return "#" + "".join(f"{round(a + (at - k) * (b - a)):02x}" for a, b in zip(one, two, strict=True))


def _text(x: float, y: float, words: str, size: float, anchor: str = "middle", extra: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}"{extra}>{escape(words)}</text>'


def _upright(x: float, y: float, words: str, size: float) -> str:
    return f'<text transform="translate({x:.1f} {y:.1f}) rotate(-90)" font-size="{size:g}" text-anchor="middle">{escape(words)}</text>'


def value_maps(
    maps: Sequence[tuple[str, NDArray[np.float64]]],
    rows: Sequence[str],
    limits: Sequence[str],
    scale: str,
    axes: tuple[str, str],
    alt: str,
    least_top: float = 0.5,
) -> str:
    """SVG: one or more maps of numbers side by side on one colour scale, each number written in its cell.

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
    width, left, gap, head = 979.0, 62.0, 58.0, 26.0
    cell = float(np.clip(400 / max(n, 1), 12, 25))
    foot = 46.0
    panel = (width - left - 70 - gap * (max(len(maps), 2) - 1)) / max(len(maps), 2)
    step = panel / m
    height = head + n * cell + foot
    size = min(9.5, 0.5 * cell, 0.36 * step) if n <= 40 else 0.0
    out = []
    for k, (title, values) in enumerate(maps):
        x0 = left + k * (panel + gap)
        out.append(_text(x0, head - 10, title, 13.3, "start", ' font-weight="bold"'))
        for i in range(n):
            y = head + i * cell
            out.append(_text(x0 - 5, y + cell / 2 + 3.5, rows[i], 10, "end") if n <= 40 or i % (n // 40) == 0 else "")
            for j in range(m):
                v = float(values[i, j])
                known = np.isfinite(v)
                fill = ramp(v / top) if known else EMPTY
                out.append(f'<rect x="{x0 + j * step:.1f}" y="{y:.1f}" width="{step - 0.7:.1f}" height="{cell - 0.7:.1f}" fill="{fill}"/>')
                if size:
                    light = ' fill="#fff"' if known and v > 0.55 * top else ""
                    out.append(
                        _text(
                            x0 + (j + 0.5) * step,
                            y + cell / 2 + 0.35 * size,
                            ("–" if not known else f"{v:.1f}" if v < 99.95 else f"{v:.0f}"),
                            size,
                            extra=light,
                        )
                    )
        base = head + n * cell
        out += [_text(x0 + j * step, base + 13, words, min(9.5, 0.3 * step)) for j, words in enumerate(limits)]
        out.append(_text(x0 + panel / 2, base + 33, axes[0], 12))
    out.append(_upright(12, head + n * cell / 2, axes[1], 12))
    out += _scale(width - 52, head, n * cell, top, scale)
    return (
        f'<svg viewBox="0 0 {width:g} {height:.1f}" style="max-width:{width:g}px" role="img" aria-label={quoteattr(alt)}>'
        f'<title>{escape(alt)}</title><g fill="{INK}" font-family={quoteattr(FONT_STACK)}>{"".join(out)}</g></svg>'
    )


def _scale(x: float, y: float, height: float, top: float, words: str) -> list[str]:
    """Colour bar with its ends and middle."""
    steps = 32
    out = []
    for k in range(steps):
        fill = ramp((k + 0.5) / steps)
        out.append(
            f'<rect x="{x:.1f}" y="{y + height * (1 - (k + 1) / steps):.2f}" width="12" height="{height / steps + 0.3:.2f}" fill="{fill}"/>'
        )
    out += [_text(x + 16, y + height * (1 - s) + 3.5, f"{s * top:.3g}", 10, "start") for s in (0.0, 0.5, 1.0)]
    out.append(_upright(x + 48, y + height / 2, words, 11))
    return out
