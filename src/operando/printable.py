"""Text of measurement files made harmless for terminals, tables and pages: what would act on the reader's screen is shown instead."""

from __future__ import annotations

import re
from collections.abc import Iterable

LONGEST_WORD = 400
"""Most characters without a blank that are shown: whole paths fit, a damaged label does not fill the screen."""

# Control characters (Cc), format characters (Cf: direction marks, zero width, tags), line and paragraph separators (Zl, Zp), surrogates
# (Cs), by the Unicode character database; a test compares the list with it.
_ACTS = (
    "\\x00-\\x1f\\x7f-\\x9f\\xad\\u0600-\\u0605\\u061c\\u06dd\\u070f\\u0890\\u0891\\u08e2\\u180e\\u200b-\\u200f\\u2028-\\u202e\\u2060-\\u206f"
    "\\ud800-\\udfff\\ufeff\\ufff0-\\ufffb\\U000110bd\\U000110cd\\U00013430-\\U0001343f\\U0001bca0-\\U0001bca3\\U0001d173-\\U0001d17a"
    "\\U000e0000-\\U000e007f"
)
_ACTIVE = re.compile(f"[{_ACTS}]")
_ACTIVE_IN_LINES = re.compile(f"(?![\\n\\t])[{_ACTS}]")
_UNUSUAL = re.compile("[\\x00-\\x08\\x0b-\\x1f\\x7f-\\U0010ffff]")  # what may be active; two ranges are found several times as fast
_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


def escaped(character: str) -> str:
    r"""A character as ``\n``, ``\x1b``, ``\u202e`` or ``\U000e0001``."""
    return character.encode("ascii", "backslashreplace").decode("ascii") if ord(character) > 127 else repr(character)[1:-1]


def printable(text: object, lines: bool = False) -> str:
    r"""Text in which nothing acts on a terminal, a page or a table.

    Control characters, terminal escapes and marks that turn the direction of writing appear as ``\x1b`` or ``\u202e``. A word of more
    than ``LONGEST_WORD`` characters is cut in the middle, and how many there were is said. Line ends and tabs are kept in ``lines``: text
    laid out by operando, not a label of a file.
    """
    pattern = _ACTIVE_IN_LINES if lines else _ACTIVE
    return _LONG_WORD.sub(_cut, pattern.sub(lambda m: escaped(m[0]), str(text)))


def without_active(text: str) -> str:
    """A finished page with every active character shown (no words are cut: drawings hold long ones)."""
    return _UNUSUAL.sub(lambda m: escaped(m[0]) if _ACTIVE.match(m[0]) else m[0], text)


def json_escaped(text: str) -> str:
    r"""JSON text with active characters as ``\u…``: the same data, harmless where it is printed."""
    return _ACTIVE_IN_LINES.sub(lambda m: _json_escape(m[0]), text)


def _json_escape(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i : i + 2].hex()}" for i in range(0, len(units), 2))


def _cut(match: re.Match[str]) -> str:
    word = match[0]
    return f"{word[: LONGEST_WORD // 2]}…{word[-LONGEST_WORD // 4 :]} ({len(word)} characters)"


def first_few(names: Iterable[object], most: int = 6) -> str:
    """The first of several names, and that there are more."""
    texts = [str(name) for name in names]
    return ", ".join(texts[:most]) + (" …" if len(texts) > most else "")
