"""The text of a proposed test file."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.printable import printable, without_active

if TYPE_CHECKING:
    from operando.scaffold.band import Band
    from operando.scaffold.labels import Seen
    from operando.scaffold.look import Taken


def quoted(text: str) -> str:
    r"""A text as a TOML string; what would act where the file is shown stands as ``\u…``.

    TOML knows no surrogates, so a file name that is no Unicode cannot stand in a test file (``can_be_named``).
    """
    marks = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t"}
    return '"' + "".join(marks.get(c) or (c if without_active(c) == c else _escape(c)) for c in text) + '"'


def can_be_named(path: Path) -> bool:
    """Whether the name of a file is Unicode: others cannot stand in a test file."""
    return not any(0xD800 <= ord(c) <= 0xDFFF for c in str(path))


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def _list(texts: Sequence[str]) -> str:
    return "[" + ", ".join(quoted(text) for text in texts) + "]"


def file_text(folder: Path, base: Path, taken: Sequence[Taken], seen: Seen, notes: Sequence[str], band: Band | None) -> str:
    """The test file of measurements in ``folder`` that will lie in ``base``, with notes as comments at its head and a proposed band."""
    lines = [f"name = {quoted(folder.resolve().name)}"]
    titles = {
        "idle": "at rest, force measured",
        "operating": "running, force unknown",
        "check": "running, force measured: the validation measurement",
    }
    for state, title in titles.items():
        for kind in ("records", "frfs"):
            files = [t.file for t in taken if t.role == f"{state} {kind}"]
            if state == "idle" and kind == "frfs" and any(t.role == "idle records" for t in taken):
                lines += [f"# left out, there are raw records: {printable(p.name)}" for p in files]
            elif files:
                if f"[{state}]" not in "\n".join(lines):
                    lines += ["", f"[{state}]  # {title}"]
                lines.append(f"{kind} = {_list(_patterns(files, folder, base))}")
    geometry = [t.file for t in taken if t.role == "geometry"]
    if geometry:
        lines += ["", "[geometry]", f"file = {quoted(_relative(geometry[0], base))}"]
        lines.append('# units = "m"  # of coordinates, where the file does not say')
    if seen.columns or seen.lineless or seen.rateless or seen.unitless:
        lines += ["", "[units]  # where the files do not say: take off the # and write what was used"]
    if seen.columns:
        columns = max(seen.columns, key=lambda c: len(seen.columns[c]))
        lines.append(f"columns = {_list(columns)}  # of tables without a header line: a guess from the numbers, look at it")
    if seen.lineless:
        lines.append(f"# frequency_step_hz = 0.25  # Hz: needed, {printable(', '.join(seen.lineless))} does not say")
    if seen.rateless:
        lines.append(f"# sampling_hz = ?  # samples a second: needed, {printable(', '.join(seen.rateless[:4]))} does not say")
    units = {"acceleration": "g", "force": "N"}
    lines += [f'# {quantity} = "{units.get(quantity, "?")}"' for quantity in sorted(seen.unitless)]
    if seen.labels or seen.unlabelled:
        lines += ["", "[channels]  # what the files do not say"]
        lines += [f"{quoted(name)} = {_inline(label)}{_said(seen.guessed.get(name))}" for name, label in seen.labels.items()]
        lines += [
            f'# {quoted(name)} = {{dof = "{i}+Z", quantity = "acceleration", unit = "g"}}'
            for i, name in enumerate(list(seen.unlabelled)[:64], 1)
        ]
        lines += ['# "force" = {dof = "1+Z"}  # where the force acts'] if seen.unlabelled_force else []
    lines += ["", "[analysis]"]
    if band is None:
        lines.append(
            "# band = [5.0, 200.0]  # Hz, an example: no file says which frequencies it holds; without it the data choose the band"
        )
    else:
        reason = printable(band.reason)
        lines.append(f"# band = [{band.low_hz:.4g}, {band.high_hz:.4g}]  # Hz, proposed: {reason}; take off the # to use it")
    head = ["# " + printable(note) for note in notes]
    return "\n".join([*head, *([""] if head else []), *lines]) + "\n"


def _said(guessed: str | None) -> str:
    """What stands behind a guessed line of [channels]."""
    return f"  # guessed, in no file: {guessed}; correct it" if guessed else ""


def _inline(label: dict[str, Any]) -> str:
    """An entry of [channels] as an inline table."""
    words = {key: quoted(value) if isinstance(value, str) else json.dumps(value) for key, value in label.items()}
    return "{" + ", ".join(f"{key} = {word}" for key, word in words.items()) + "}"


def _relative(path: Path, base: Path) -> str:
    return Path(os.path.relpath(path.resolve(), base.resolve())).as_posix()


def _patterns(files: Sequence[Path], folder: Path, base: Path) -> list[str]:
    """Globs where a folder holds files of this state alone, else the files one by one."""
    out: list[str] = []
    for place in dict.fromkeys(p.parent for p in files):
        for suffix in dict.fromkeys(p.suffix for p in files if p.parent == place):
            mine = [p for p in files if p.parent == place and p.suffix == suffix]
            others = [p for p in place.iterdir() if p.is_file() and p.suffix == suffix and p not in mine]
            literal = any(c in place.as_posix() for c in "[]*?")
            if others or literal or not suffix or place == folder:
                out += [_relative(p, base) for p in mine]
            else:
                out.append(f"{_relative(place, base)}/*{suffix}")
    return out
