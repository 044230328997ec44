"""What every section shares: numbering of figures, paragraphs, the sentence where something is missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from operando.report.text import esc
from operando.results import Results


@dataclass(frozen=True)
class Section:
    """Anchor, title and HTML of one section."""

    anchor: str
    title: str
    html: str


class Numbering:
    """Numbers figures through the whole report, and keeps what several sections need and is dear to compute."""

    def __init__(self) -> None:
        self.n = 0
        self._kept: dict[str, Any] = {}

    def once(self, key: str, make: Callable[[], Any]) -> Any:
        """The value under a key, made the first time."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    def figure(self, svg: str, caption: str) -> str:
        """Figure element with a numbered caption."""
        self.n += 1
        return f"<figure>{svg}<figcaption><b>Figure {self.n}.</b> {caption}</figcaption></figure>"


def paragraph(text: str) -> str:
    """One paragraph of plain text."""
    return f"<p>{esc(text)}</p>"


def missing(text: str) -> str:
    """The one sentence that stands where a part is missing."""
    return f'<p class="missing">{esc(text)}</p>'


def left_out(results: Results, stage: str, default: str) -> str:
    """Why a stage is missing, in the pipeline's words if it gave any."""
    reason = results.left_out.get(stage)
    return f"{default.rstrip('.')}: {reason.rstrip('.')}." if reason else f"{default.rstrip('.')}."
