"""Tables and words of the pages, in the look of operando's reports."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from markupsafe import Markup, escape

from operando.printable import printable
from operando.report.parts import environment

TABLE = """{% from "parts.html.j2" import table, row with context %}{% call table(head, "", caption, wide) %}
{% for cells in rows %}{{ row(cells, right, loop.index0 in mine) }}{% endfor %}{% endcall %}"""


def esc(value: object) -> Markup:
    """Text safe inside HTML elements and attributes."""
    return escape(printable(value))


def tag(word: str, grade: str) -> Markup:
    """A small framed word."""
    return Markup('<span class="tag {}">{}</span>').format(grade, word)


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], numeric: Iterable[int] = (), caption: str = "", wide: bool = False,
    mine: Iterable[int] = (),
) -> Markup:  # fmt: skip
    """A table; ``numeric`` columns stand to the right, the rows ``mine`` are set off."""
    right = tuple(numeric)
    heads = ["#" * (k in right) + h for k, h in enumerate(head)]
    made = environment().from_string(TABLE).render(head=heads, rows=rows, right=right, caption=caption, wide=wide, mine=tuple(mine))
    return Markup(made)
