"""How an operational mode stands to its idle partner, in words: same shape, similar shape, changed, without one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from operando.report.text import finite, fixed

SAME_MAC = 0.9
"""MAC from which paired shapes are called the same: at 0.9 they stand at 18°; the phase collinearity of shapes called real is the same."""

_WORDS = {
    "unchanged": ("same shape", "good"),
    "changed": ("shape changed", "fair"),
    "beyond_idle_band": ("beyond idle band", "fair"),
    "unpaired": ("no idle partner", "poor"),
}


def class_words(row: Mapping[str, Any], percent: float | None = None) -> tuple[str, str]:
    """Words and colour class for a row of ``pairing``; with the change of frequency [%] where that is given.

    The class ``unchanged`` holds from the threshold of the pairing on (0.7 by default); below ``SAME_MAC`` the shapes are similar.
    """
    word, grade = _WORDS.get(str(row.get("class")), ("not paired", "none"))
    if row.get("class") == "unchanged" and not _same(row):
        word, grade = f"similar shape (MAC {fixed(row['mac'], 2)})", "fair"
    return word + (f", frequency {fixed(percent, 1, sign=True)} %" if finite(percent) else ""), grade


def shapes_counted(pairing: Sequence[Mapping[str, Any]]) -> list[str]:
    """How many operational modes stand in each way to the idle ones, in words."""
    alike = [row for row in pairing if row.get("class") == "unchanged"]
    similar = [float(row["mac"]) for row in alike if not _same(row)]
    parts = [f"{len(alike) - len(similar)} with the same shape as idle"]
    if similar:
        parts.append(f"{len(similar)} with a similar shape (MAC {'' if len(similar) == 1 else 'from '}{fixed(min(similar), 2)})")
    words = {"changed": "with a changed shape", "beyond_idle_band": "paired beyond the idle band", "unpaired": "without an idle partner"}
    counts = {kind: sum(row.get("class") == kind for row in pairing) for kind in words}
    return parts + [f"{counts[kind]} {word}" for kind, word in words.items() if counts[kind]]


def _same(row: Mapping[str, Any]) -> bool:
    return not finite(row.get("mac")) or float(row["mac"]) >= SAME_MAC
