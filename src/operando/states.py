"""The states of a test: which files, and which part of each record counts."""

from __future__ import annotations

import difflib
import glob
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from operando.entries import Entry
from operando.errors import ConfigError
from operando.files import natural_order
from operando.values import Record, StateFiles


@dataclass(frozen=True)
class Span:
    """The part of a record that counts, on the record's own time axis."""

    start_s: float | None = None  # first time [s]; None: from the beginning
    stop_s: float | None = None  # last time [s]; None: to the end

    def __str__(self) -> str:
        start = "the beginning" if self.start_s is None else f"{self.start_s:g} s"
        return f"{start} to {'the end' if self.stop_s is None else f'{self.stop_s:g} s'}"


@dataclass(frozen=True)
class State:
    """Files of one state of the structure (idle, operating or check)."""

    records: tuple[Path, ...] = ()  # raw time histories, one run a file; a file stands here twice where two parts of it count
    frfs: tuple[Path, ...] = ()  # FRFs measured elsewhere
    spans: tuple[Span | None, ...] = ()  # one for each of ``records``, None where all of it counts; empty: all of all

    def __post_init__(self) -> None:
        if self.spans and len(self.spans) != len(self.records):
            raise ConfigError(f"{len(self.spans)} spans for {len(self.records)} records", hint="give one span, or None, a record")

    def __bool__(self) -> bool:
        return bool(self.records or self.frfs)

    @property
    def files(self) -> tuple[Path, ...]:
        """All files of the state, each once."""
        return tuple(dict.fromkeys((*self.records, *self.frfs)))

    @property
    def runs(self) -> tuple[tuple[Path, Span | None], ...]:
        """Each record with the part of it that counts (None: all of it)."""
        return tuple(zip(self.records, self.spans or (None,) * len(self.records), strict=True))


MOST_NAMES = 2000
"""Files looked at for a name near to one that is not there."""


def find_files(patterns: Sequence[str], folder: Path, where: Entry) -> tuple[Path, ...]:
    """Files that paths and patterns name, each once, in natural order."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        try:
            hits = _matches(pattern, folder)
            if not hits:
                raise _no_file(pattern, folder, where)
        except (OSError, ValueError, RecursionError, re.error) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{pattern!r:.200} is no path: {error}", where=str(where), hint='write for example ["idle/*.uff"]') from None
        found |= dict.fromkeys(hits)
    return tuple(found)


def _matches(pattern: str, folder: Path) -> list[Path]:
    literal = folder / pattern
    if literal.is_file():
        return [literal]
    found = sorted((folder / p for p in glob.glob(pattern, root_dir=folder, recursive=True)), key=natural_order)
    return [p for p in found if p.is_file()]


def _no_file(pattern: str, folder: Path, where: Entry) -> ConfigError:
    """The error for a path or pattern that matches nothing."""
    if (folder / pattern).is_dir():
        hint = f"write {pattern.rstrip('/')}/* for the files in it"
        return ConfigError(f"{pattern!r} is a folder, expected files", where=str(where), hint=hint)
    there = [p.relative_to(folder).as_posix() for p in islice(folder.rglob("*"), MOST_NAMES) if p.is_file()]
    near = difflib.get_close_matches(pattern, there, 1, 0.6)
    hint = (f"did you mean {near[0]!r}? " if near else "") + f"paths are relative to {folder.resolve()}"
    return ConfigError(f"{pattern!r:.200} matches no file", where=str(where), hint=hint)


def state_of(table: StateFiles, folder: Path, where: Entry) -> State:
    """State of a section of the test file.

    Raises a ConfigError if a pattern matches no file, or a record ends before it starts.
    """
    runs = _runs(table.get("records", []), folder, where.at("records"))
    return State(
        records=tuple(file for file, _ in runs),
        frfs=find_files(table.get("frfs", []), folder, where.at("frfs")),
        spans=tuple(span for _, span in runs) if any(span is not None for _, span in runs) else (),
    )


def _runs(entries: Sequence[Record], folder: Path, where: Entry) -> list[tuple[Path, Span | None]]:
    """Records and the part of each that counts. What a table says of a file holds also where a pattern names the file, too."""
    found: dict[Path, list[Span | None]] = {}
    for entry in entries:
        span = _span(entry, where)
        for file in find_files([entry["file"]], folder, where):
            spans = found.setdefault(file, [])
            if span not in spans:
                spans.append(span)
    out: list[tuple[Path, Span | None]] = []
    for file, spans in found.items():
        parts = [span for span in spans if span is not None]
        out += [(file, span) for span in parts] or [(file, None)]
    return out


def _span(entry: Record, where: Entry) -> Span | None:
    """The part of a record that its entry names, None where it names none."""
    start, stop = entry.get("start_s"), entry.get("stop_s")
    if start is not None and stop is not None and start >= stop:
        raise ConfigError(f"start_s = {start:g} is not before stop_s = {stop:g}", where=f"{where}: {entry['file']:.200}")
    return None if start is None and stop is None else Span(start, stop)


def record_named(name: str, labels: Iterable[str], where: str, rest: str = "") -> str:
    """The record meant by a name: its label, or its file name alone where that is enough. ``rest`` is what is written after the name."""
    labels = sorted(labels)
    clean = name.removeprefix("./")
    if clean in labels:
        return clean
    alike = [label for label in labels if Path(label).name == clean]
    if len(alike) == 1:
        return alike[0]
    near = alike or difflib.get_close_matches(clean, labels, 1, 0.3)
    raise ConfigError(
        f"{name!r} is no record of [idle] or [check]" if not alike else f"{name!r} may be any of {', '.join(alike)}",
        where=where,
        hint=f"did you mean {near[0] + rest!r}?" if near else None,
    )
