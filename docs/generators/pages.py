"""Writes the made pages before Sphinx reads any, and lets docstrings of the code stand as they are."""

from __future__ import annotations

import logging
import re
import shutil
from pathlib import Path
from typing import Any

from generators import api, commands, effects, findings, test_file

MADE, API = "_made", "api"


def make(docs: Path) -> Path:
    """Write everything that comes from the code into ``docs/_made`` and ``docs/api``, anew."""
    out = docs / MADE
    for folder in (out, docs / API):
        shutil.rmtree(folder, ignore_errors=True)
    out.mkdir(parents=True)
    parts = {
        "test_file": test_file.page(),
        "commands": commands.page(),
        "effects": effects.page(out / "effects"),
        "findings": findings.page(),
    }
    for name, text in parts.items():
        (out / f"{name}.inc.md").write_text(text + "\n", encoding="utf-8")
    api.write(docs / API)
    return out


def plain(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings speak of |H|, f* and x_: signs that reStructuredText would read as markup."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``[^`]*``|:[a-z]+:`[^`]*`|`[^`]*`_?)", line)
        if line.lstrip().startswith((":", ".. ")) and not re.match(r"\s*:(param|returns|raises|ivar)", line):
            continue
        lines[i] = "".join(part if n % 2 else re.sub(r"(?<!\\)([|]|(?<=\w)_(?!\w))", r"\\\1", part) for n, part in enumerate(parts))


class _Docstrings(logging.Filter):
    """Warnings about the layout of docstrings are counted and told, but do not stop the site: the pages of the site do."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno >= logging.WARNING and "docstring of" in str(getattr(record, "location", "")):
            self.seen.append(f"{getattr(record, 'location', '')}: {record.getMessage()}")
            return False
        return True


DOCSTRINGS = _Docstrings()


def told(app: Any, exception: Exception | None) -> None:
    """Say what the layout of docstrings lacks."""
    if DOCSTRINGS.seen:
        print(f"{len(DOCSTRINGS.seen)} remarks on the layout of docstrings:")
        print("\n".join(sorted(set(DOCSTRINGS.seen))))


def setup(app: Any) -> dict[str, Any]:
    """Make the pages, then connect."""
    make(Path(app.srcdir))
    for handler in logging.getLogger("sphinx").handlers:
        handler.filters.insert(0, DOCSTRINGS)
    app.connect("autodoc-process-docstring", plain, priority=900)
    app.connect("build-finished", told)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
