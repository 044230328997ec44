"""Changes of a test file made by hand: kept as a list, shown as lines old and new, written so that comments and order survive."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from operando.atomic import replacing, writing
from operando.config import Test, parse_text, text_of
from operando.errors import ConfigError, OperandoError


class Edit(Protocol):
    """One change of a test file."""

    def apply(self, document: Any) -> None:
        """Make the change in a document of tomlkit."""


@dataclass(frozen=True)
class AddTo:
    """A frequency more in a list of [analysis]."""

    key: str
    value_hz: float

    def apply(self, document: Any) -> None:
        """Append it, unless it is there."""
        section = _section(document, "analysis")
        if self.key not in section:
            section[self.key] = [self.value_hz]
        elif self.value_hz not in section[self.key]:
            section[self.key].append(self.value_hz)


@dataclass(frozen=True)
class TakeFrom:
    """A frequency less in a list of [analysis]; the list goes with its last one."""

    key: str
    value_hz: float

    def apply(self, document: Any) -> None:
        """Remove it, if it is there."""
        section = _section(document, "analysis")
        listed = section.get(self.key)
        if listed is None or self.value_hz not in listed:
            return
        if len(listed) == 1:
            del section[self.key]
        else:
            listed.pop(list(listed).index(self.value_hz))


@dataclass(frozen=True)
class SetValue:
    """Another value of a key of [analysis]; none leaves the key out."""

    key: str
    value: Any

    def apply(self, document: Any) -> None:
        """Set it, or remove the key."""
        section = _section(document, "analysis")
        if self.value is not None:
            section[self.key] = self.value
        elif self.key in section:
            del section[self.key]


@dataclass(frozen=True)
class Exclude:
    """A channel left out with a reason, or taken back (no reason)."""

    channel: str
    reason: str | None

    def apply(self, document: Any) -> None:
        """Set or remove ``exclude`` and ``reason``; what else is said of the channel stays."""
        import tomlkit

        section = _section(document, "channels")
        entry = section.get(self.channel)
        if self.reason is not None:
            if entry is None:
                section[self.channel] = tomlkit.inline_table()
                entry = section[self.channel]
            entry["exclude"], entry["reason"] = True, self.reason
        elif entry is not None:
            for key in ("exclude", "reason"):
                if key in entry:
                    del entry[key]
            if not entry:
                del section[self.channel]
        if not section:
            del document["channels"]


def _section(document: Any, name: str) -> Any:
    if name not in document:
        import tomlkit

        document[name] = tomlkit.table()
    return document[name]


def edited(text: str, edits: Sequence[Edit]) -> str:
    """The text of a test file with changes; without any it is the same text."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    if not edits:
        return text
    windows = "\r\n" in text
    try:
        document = tomlkit.parse(text.replace("\r\n", "\n"))
        for edit in edits:
            edit.apply(document)
        made = tomlkit.dumps(document)
    except (TOMLKitError, TypeError, AttributeError, ValueError) as error:
        raise ConfigError(f"this change cannot be made in the test file: {error}", hint="make it in the file by hand") from None
    return made.replace("\n", "\r\n") if windows else made


def changed_lines(old: str, new: str) -> list[dict[str, Any]]:
    """Lines of the test file that differ: ``line`` (number in the old text, from 1), ``old`` and ``new``."""
    a, b = old.splitlines(), new.splitlines()
    return [
        {"line": i + 1, "old": a[i:j], "new": b[k:m]}
        for what, i, j, k, m in difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes()
        if what != "equal"
    ]


@dataclass
class Draft:
    """A test file with changes that are not written yet."""

    path: Path  # the test file
    changes: tuple[str, ...] = ()  # entries that take the place of those in the file (``--set``); they are used and never written
    text: str = field(init=False)  # what the file said when it was read
    edits: list[Edit] = field(init=False, default_factory=list)  # changes since, in order
    test: Test = field(init=False)  # the test without them

    def __post_init__(self) -> None:
        self.text = text_of(self.path)
        self.test = self._parsed(self.text)

    @property
    def new_text(self) -> str:
        """The text with the changes."""
        return edited(self.text, self.edits)

    @property
    def table(self) -> dict[str, Any]:
        """The table of the new text."""
        return tomllib.loads(self.new_text)

    def lines(self) -> list[dict[str, Any]]:
        """See :func:`changed_lines`."""
        return changed_lines(self.text, self.new_text)

    def add(self, edit: Edit) -> None:
        """One more change.

        Raises a ConfigError if the test file would not be valid with it: the change is not kept.
        """
        self._parsed(edited(self.text, [*self.edits, edit]))
        self.edits.append(edit)

    def undo(self) -> None:
        """Without the last change."""
        if self.edits:
            self.edits.pop()

    def _parsed(self, text: str) -> Test:
        return parse_text(text, self.path, self.changes)

    def changed_on_disk(self) -> bool:
        """Whether the file says something else than when it was read."""
        try:
            return text_of(self.path) != self.text
        except OperandoError:
            return True

    def read_again(self) -> list[str]:
        """Take the file as it is now; changes that do not fit it any more go, and are named."""
        text, edits = text_of(self.path), self.edits
        self.test = self._parsed(text)
        self.text, self.edits, gone = text, [], []
        for edit in edits:
            try:
                self.add(edit)
            except OperandoError as error:
                gone.append(f"{edit}: {error.message}")
        return gone

    def save(self) -> None:
        """Write the changes: valid, on the text they were made for, beside the file, then renamed."""
        if not self.edits:
            return
        if self.changed_on_disk():
            raise ConfigError(
                "the test file was changed meanwhile by something else, and nothing was written",
                where=str(self.path),
                hint="read it again: your changes stay in the list and are made on the new text",
            )
        new = self.new_text
        test = self._parsed(new)
        with writing(self.path):
            marked = self.path.read_bytes().startswith(b"\xef\xbb\xbf")
            mode = self.path.stat().st_mode
        with replacing(self.path.resolve(), "wb") as stream:
            stream.write(new.encode("utf-8-sig" if marked else "utf-8"))
        with writing(self.path):
            self.path.chmod(mode)
        self.text, self.edits, self.test = new, [], test
