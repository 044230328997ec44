"""``operando inspect``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, table
from operando.cli.test_file import read_test, set_option

if TYPE_CHECKING:
    from operando.config import Test
    from operando.errors import OperandoError


@click.command("inspect", epilog="Example: operando inspect idle/run1.uff operating/*.uff")
@click.argument("files", nargs=-1, required=True, type=click.Path(), metavar="FILE...")
@set_option
@answers
def inspect(files: tuple[str, ...], changes: tuple[str, ...]) -> Answer:
    """What is in files: sets, channels, DOFs, units, sampling; what is used, ignored, missing, and wrong.

    Of a test file (.toml) the files it names are read, with its units and channels.
    """
    from operando.errors import FormatError
    from operando.io import inspect_files
    from operando.io.quantities import Asked

    paths: list[str | Path] = list(files)
    units: Any = None
    channels: Any = None
    wrong: OperandoError | None = None
    if len(files) == 1 and files[0].endswith(".toml"):
        test = read_test(files[0], changes)
        length = {} if test.geometry_units is None else {"length": test.geometry_units}
        paths, units, channels = list(test.files), (length | dict(test.units)) or None, Asked(test.channels)
        wrong = _names_no_file_has(test)
    elif changes:
        raise click.UsageError("--set belongs to a test file, and none is named")
    document: dict[str, Any] = inspect_files(paths, units=units, channels=channels)
    unread = [f for f in document["files"] if f["error"] is not None]
    if len(unread) == len(document["files"]):
        first = unread[0]["error"]
        raise FormatError(first["error"], where=first["where"] or unread[0]["path"], hint=first["hint"])
    for entry in document["files"]:
        if entry["records"]:
            found = _quality(entry["path"], units, channels, entry["findings"])
            entry["findings"] += found
            document["findings"] += found
    return Answer(document, _text(document), wrong)


def _names_no_file_has(test: Test) -> OperandoError | None:
    """The first name of a test file that is in none of its files; None where all are there."""
    from operando.errors import OperandoError
    from operando.pipeline.inputs import Inputs

    try:
        Inputs(test).check_names()
    except OperandoError as error:
        return error
    return None


def _quality(path: str, units: Any, channels: Any, known: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the raw-data checks find beyond what reading found."""
    from operando.io import read
    from operando.quality import check_record

    found = [f.to_dict() for record in read(path, units=units, channels=channels).records for f in check_record(record).findings]
    return [f | {"file": f["file"] or Path(path).name} for f in found if f not in known]


def _text(document: dict[str, Any]) -> str:
    blocks = [_file_text(entry) for entry in document["files"]]
    blocks += [f"Missing: {text}" for text in document["missing"]]
    return "\n\n".join(blocks)


def _file_text(entry: dict[str, Any]) -> str:
    from operando.data import counted
    from operando.io.inspect import DAMAGE

    if entry["error"] is not None:
        hint = entry["error"]["hint"]
        return f"{entry['path']}: cannot be read: {entry['error']['error']}" + (f" ({hint})" if hint else "")
    lines = [f"{entry['path']} ({entry['format']}, {counted(len(entry['sets']), 'set')})"]
    lines += [f"  damaged  {text}" for text in entry["damage"]]
    lines += [f"  found    {text}" for text in entry["found"]]
    lines += [f"  used     {text}" for text in entry["used"]]
    told = [f for f in entry["findings"] if f["severity"] == "error" and f["kind"] in DAMAGE]
    sets = {f["set"] for f in told}
    lines += [f"  ignored  {text}" for text in _ignored([s for s in entry["ignored"] if s["set"] not in sets])]
    lines += [f"  missing  {text}" for text in entry["missing"]]
    for record in entry["records"]:
        rows = [[c["dof"] or "-", c["quantity"], _unit(c), c["name"]] for c in record["channels"][:64]]
        lines.append(_indented(table(rows, ["DOF", "quantity", "unit", "name"])))
        if len(record["channels"]) > 64:
            lines.append(f"    … and {len(record['channels']) - 64} more channels")
    for frf in entry["frfs"]:
        lines.append(f"    responses  {_some(frf['responses'])}")
        lines.append(f"    references {_some(frf['references'])}; drive points {_some(frf['drive_points'])}")
    for model in entry["models"]:
        modes = [f"{f:.4g} Hz" for f in model["frequencies_hz"]]
        lines.append(f"    modes      {_some(modes)}")
    for f in [f for f in entry["findings"] if f not in told]:
        todo = f" ({f['action']})" if f["action"] and f["severity"] != "info" else ""
        lines.append(f"  {f['severity']:8s} {f['message']}{todo}")
    return "\n".join(lines)


def _ignored(sets: list[dict[str, Any]]) -> list[str]:
    """Sets not used, those of one kind and reason together."""
    kinds: dict[tuple[Any, str, str], list[int]] = {}
    for s in sets:
        kinds.setdefault((s["type"], s["title"], s["reason"] or s["status"]), []).append(s["set"])
    lines = []
    for (number, title, reason), which in kinds.items():
        where = f"set {which[0]}" if len(which) == 1 else f"{len(which)} sets from {which[0]}"
        lines.append(f"{where} (type {number}): {title}: {reason}")
    return lines


def _unit(channel: dict[str, Any]) -> str:
    unit, source = channel["unit"] or "unknown", channel["source_unit"]
    return unit if source in (None, unit) else f"{unit} (from {source})"


def _some(items: list[str]) -> str:
    return (", ".join(items[:12]) + (f" … {len(items)} in all" if len(items) > 12 else "")) or "none"


def _indented(text: str) -> str:
    return "\n".join("    " + line for line in text.splitlines())
