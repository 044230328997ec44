"""Entries of the test file: file, section, key, and the line or option that gave them, for messages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

_SECTION = re.compile(r"^\s*\[\s*([^\[\]=]+?)\s*\]\s*(?:#.*)?$")
_KEY = re.compile(r"""^\s*((?:"(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+)(?:\s*\.\s*(?:"(?:[^"\\]|\\.)*"|'[^']*'|[A-Za-z0-9_-]+))*)\s*=""")
_PART = re.compile(r"""\s*("(?:[^"\\]|\\.)*"|'[^']*'|[^\s."']+)\s*\.?""")

Given = Mapping[tuple[str, str], str]
"""(section, key) → what gave it in words: ``line 12`` or ``--set``."""


@dataclass(frozen=True)
class Entry:
    """An entry of the test file, in words by ``str``."""

    file: str
    section: str = ""  # empty for the file as a whole, and of a key outside all sections
    key: str = ""  # empty for the section as a whole
    given: Given = field(default_factory=dict, repr=False)  # which line or option gave each key

    def at(self, key: str) -> Entry:
        """A key of this section."""
        return replace(self, key=key)

    def within(self, section: str) -> Entry:
        """A section of this file."""
        return replace(self, section=section, key="")

    def __str__(self) -> str:
        by = self.given.get((self.section, self.key))
        name = f"[{self.section}] {self.key}".strip() if self.section else self.key
        return self.file + (f", {by}" if by else "") + (f", {name}" if name else "")


def lines_of(text: str) -> dict[tuple[str, str], str]:
    """The line of each section and key of a TOML text, for messages; what spans several lines has its first."""
    found: dict[tuple[str, str], str] = {}
    section: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if (match := _SECTION.match(line)) is not None:
            section = _parts(match[1])
        elif (match := _KEY.match(line)) is not None:
            path = [*section, *_parts(match[1])]
            names = (path[0], path[1]) if len(path) > 1 else ("", path[0])
            found.setdefault(names, f"line {number}")
            continue
        else:
            continue
        found.setdefault((section[0], section[1] if len(section) > 1 else ""), f"line {number}")
    return found


def _parts(dotted: str) -> list[str]:
    return [part.strip("\"'") for part in _PART.findall(dotted)]
