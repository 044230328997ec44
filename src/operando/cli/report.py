"""``operando report``."""

from __future__ import annotations

from pathlib import Path

import click

from operando.cli.answer import Answer, answers


@click.command("report", epilog="Example: operando report pump-results")
@click.argument("folder", metavar="DIR", type=click.Path())
@answers
def report(folder: str) -> Answer:
    """Rebuild report.html of a results folder from its model.h5."""
    from operando.pipeline.cache import whole
    from operando.report import write_report
    from operando.store import load_results

    out = Path(folder)
    if out.is_file():
        out = out.parent
    results = load_results(folder)
    path = out / "report.html"
    with whole(path) as beside:
        write_report(results, beside)
    size = path.stat().st_size
    return Answer(
        {"schema": "operando/report/1", "report": str(path), "bytes": size, "test": results.name}, f"{path} ({size / 1e6:.1f} MB)"
    )
