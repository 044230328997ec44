"""Stage ``inspect``: what is in the files of a test."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

from operando.data import Finding
from operando.errors import MissingError
from operando.pipeline.stages.work import Work, none_read


def inspect_files(work: Work) -> dict[str, Any]:
    """Inventory, geometry, findings of all files; names in the test file that no file has end the run."""
    inventory = work.inputs.inventory()
    work.inputs.check_names()
    work.inputs.check_hits(inventory)
    geometry = work.inputs.geometry()
    findings = [*work.inputs.all_findings(), *_same_data(inventory), *work.inputs.check_geometry(geometry)]
    if unread := work.inputs.unread():
        state = work.test.states[unread[0]]
        first = work.inputs.findings[state.files[0]][0]
        where = f"{work.test.where(unread[0], 'records' if state.records else 'frfs')}: {', '.join(f.name for f in state.files[:4])}"
        raise MissingError(f"{none_read(unread)}: {first.message.removeprefix('cannot be read: ')}", where=where, hint=first.action)
    if geometry is None:
        message = "no geometry in the files"
        findings.append(
            Finding(
                "no_geometry", message, "info", consequence="mode shapes are drawn as bars", action="give [geometry] file in the test file"
            )
        )
    return {"inventory": inventory, "raw": work.inputs.raw, "geometry": geometry, "findings": findings}


ITSELF = "one measurement is compared with itself: that nothing differs says nothing of operation"


def data_twice(inventory: Sequence[dict[str, Any]]) -> Iterator[tuple[tuple[str, dict[str, Any]], tuple[str, dict[str, Any]]]]:
    """Files (or overlapping parts of one) of the same content that stand for two measurements: section and row of each."""
    uses: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for row in inventory:
        for state in row["used_for"].split(", "):
            uses.setdefault(row["sha256"], []).append((state, row))
    for first, second in (pair for same in uses.values() for pair in combinations(same, 2)):
        rows = [row for _, row in (first, second)]
        end = min(float("inf") if row.get("stop_s") is None else row["stop_s"] for row in rows)
        if max(row.get("start_s") or 0.0 for row in rows) < end and "geometry" not in (first[0], second[0]):
            yield first, second


def _same_data(inventory: Sequence[dict[str, Any]]) -> list[Finding]:
    """What :func:`data_twice` comes to; operating and check may share theirs."""
    out = []
    for (one, a), (other, b) in data_twice(inventory):
        file = b["file"]
        if one == other:
            consequence = "they count as two measurements: too many averages, intervals too narrow"
            message, action = f"holds the same data as {a['file']}", "take one of them out of the test file"
            out.append(Finding("same_data", message, "warning", file=file, consequence=consequence, action=action))
        elif "idle" in (one, other):
            message = f"the data of [{other}] are those of [{one}]" + ("" if a is b else f" in {a['file']}")
            action = "name in each section the files measured in that state"
            out.append(Finding("same_data", message, "error", file=file, consequence=ITSELF, action=action))
    return out
