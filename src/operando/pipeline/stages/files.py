"""Stage ``inspect``: what is in the files of a test."""

from __future__ import annotations

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
    findings = [*work.inputs.all_findings(), *work.inputs.check_geometry(geometry)]
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
