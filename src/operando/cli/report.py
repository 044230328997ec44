"""``operando report``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from operando.cli.answer import Answer, answers, own_option, say
from operando.cli.test_file import open_option


def unknown_kinds(diagnosis: Mapping[str, Any] | None) -> list[str]:
    """Kinds of the effects in the model that the catalogue does not have: of the user's own, with their file not named."""
    from operando.structure.effects import catalogue

    known = catalogue()
    return sorted({e["kind"] for e in (diagnosis or {}).get("effects") or [] if e["kind"] not in known})


@click.command("report", epilog="Example: operando report pump-results")
@click.argument("folder", metavar="DIR", type=click.Path())
@open_option
@own_option
@answers
def report(folder: str, show: bool) -> Answer:
    """Rebuild report.html of a results folder from its model.h5."""
    from operando.pipeline.folder import changing
    from operando.report import write_report
    from operando.store import load_results

    with changing(folder, "report") as out:
        results = load_results(folder)
        unknown = unknown_kinds(results.diagnosis)
        if unknown:
            say(f"warning: the report lacks the FRFs with effects: unknown kind {', '.join(unknown)}; name its file by --own FILE")
        out.stage("report.html", None, lambda path: write_report(results, path))
        out.commit()
    path = out.path / "report.html"
    size = path.stat().st_size
    if show:
        from operando.cli.summary import open_report

        open_report(path)
    return Answer(
        {"schema": "operando/report/1", "report": str(path), "bytes": size, "test": results.name}, f"{path} ({size / 1e6:.1f} MB)"
    )
