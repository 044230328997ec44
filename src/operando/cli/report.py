"""``operando report``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, own_option
from operando.cli.test_file import open_option


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
