"""Text of what ``operando inspect`` found."""

from __future__ import annotations

from typing import Any


def inspection_text(document: dict[str, Any]) -> str:
    """One block a file: format, sets, channels, findings."""
    import json

    return json.dumps(document, indent=1, default=str)
