"""Formulas as MathML, made when the site is built: no JavaScript, no network, and every present browser draws them."""

from __future__ import annotations

import html
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

LOG = logging.getLogger(__name__)
NAMESPACE = "{http://www.w3.org/1998/Math/MathML}"
ACCENTS = "ˆ~¯˙¨→"


def formula(text: str, block: bool = False) -> str:
    """The MathML of a LaTeX formula.

    Raises
    ------
    ValueError
        If the formula uses what is not known, with the formula in the message.
    """
    try:
        drawn = tex2mathml(text, as_block=block)
    except Exception as error:
        raise ValueError(f"the formula {text!r} cannot be drawn: {error}") from error
    tree = ElementTree.fromstring(drawn.replace("&ApplyFunction;", "\u2061"))
    for parent in [*tree.iter()]:
        for place, child in enumerate(parent):
            if _is_accented(child):
                parent[place] = _accented(child)
        if parent.tag == NAMESPACE + "msup" and parent[0].get("class") == "accented":  # a power beside the index, not above it
            (letter, index), power = list(parent[0]), parent[1]
            parent.tag, parent[:] = NAMESPACE + "msubsup", [letter, index, power]
    ElementTree.register_namespace("", NAMESPACE[1:-1])
    return ElementTree.tostring(tree, encoding="unicode")


def _is_accented(node: ElementTree.Element) -> bool:
    return node.tag == NAMESPACE + "munderover" and (node[2].text or "") in ACCENTS


def _accented(node: ElementTree.Element) -> ElementTree.Element:
    """An accented letter with an index: the index stands beside, not below, as the converter has it."""
    base, index, accent = node
    letter = ElementTree.Element(NAMESPACE + "mover", {"accent": "true"})
    letter.extend((base, accent))
    out = ElementTree.Element(NAMESPACE + "msub", {"class": "accented"})
    out.extend((letter, index))
    out.tail = node.tail
    return out


def _drawn(node: nodes.Node, block: bool) -> str:
    try:
        return formula(node.astext(), block)
    except ValueError as error:
        LOG.warning("%s", error, location=node)
        return f"<code>{html.escape(node.astext())}</code>"


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(_drawn(node, block=False))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="formula">{_drawn(node, block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    """Register the renderer under the name ``mathml``."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
