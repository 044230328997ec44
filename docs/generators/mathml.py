"""Formulas as MathML, made when the site is built: no JavaScript, no network, and every present browser draws them."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml


def formula(text: str, block: bool = False) -> str:
    """The MathML of a LaTeX formula.

    Raises
    ------
    ValueError
        If the formula uses what is not known, with the formula in the message.
    """
    try:
        return tex2mathml(text, as_block=block)
    except Exception as error:
        raise ValueError(f"the formula {text!r} cannot be drawn: {error}") from error


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(formula(node.astext()))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="formula">{formula(node.astext(), block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    """Register the renderer under the name ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
