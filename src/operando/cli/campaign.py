"""``operando campaign``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from operando.cli.answer import Answer, answers, say, table, verbosity
from operando.cli.test_file import open_option, results_folder, set_option

EPILOG = """\b
Example: operando campaign campaign.toml -o speeds, where campaign.toml says
  name = "pump over speed"
  template = "pump/test.toml"      # a test file; {speed} in it is the row's value
  rows = [{speed = 600}, {speed = 900}, {speed = 1200}]
or  table = "runs.csv"             # header line speed [rpm],load [N]; a row a test
or  tests = ["runs/{speed}/test.toml"]   # test files; {speed} is what the folder says
All optional: over = "speed", baseline = {speed = 600}, units = {speed = "rpm"},
until = "diagnose", and [workers] processes = 4 | scheduler = "tcp://host:8786"
| cluster = "slurm" | "kubernetes" with jobs = 20 and options = {...}.
"""


@click.command("campaign", epilog=EPILOG)
@click.argument("campaign", type=click.Path())
@click.option("-o", "--output", type=click.Path(), help="Results folder (default: results/NAME here).")
@click.option("-p", "--processes", type=click.IntRange(1), help="Local processes (default: one a processor).")
@click.option("--scheduler", metavar="ADDRESS", help="Run on the workers of this Dask scheduler, which see the files under the same paths.")
@set_option
@open_option
@answers
def campaign(
    campaign: str, output: str | None, processes: int | None, scheduler: str | None, changes: tuple[str, ...], show: bool
) -> Answer:
    """Run many tests, and see what changes over speed, load or date.

    Each test is a results folder of its own, as `operando run` makes it. What is done is not done again: after Ctrl-C, a lost worker
    or a power failure the same command goes on. A test that fails is listed and does not stop the others; exit status 1 where none can
    be used.
    """
    from operando.campaign import load_campaign, run_campaign
    from operando.errors import IdentificationError

    if processes is not None and scheduler is not None:
        raise click.UsageError("--processes is for local processes; --scheduler has its own workers")
    loaded = load_campaign(campaign)
    out = results_folder(loaded.name, output)
    document = run_campaign(
        loaded, out, processes=processes, scheduler=scheduler, changes=changes, progress=say if verbosity() >= 0 else None
    )
    document |= {"results": str(out)}
    if show:
        from operando.cli.summary import open_report

        open_report(out / "report.html")
    failure = None
    if document["counts"]["failed"] == len(document["tests"]):
        first = document["tests"][0]
        failure = IdentificationError(
            f"none of {len(document['tests'])} tests can be used; the first: {first['reason']}", where=first["name"]
        )
    return Answer(document, _text(document, out), failure)


def _text(document: dict[str, Any], out: Path) -> str:
    """The answer first, then tests that failed or stand out, one row a test, and where the files are."""
    from operando.campaign.page import headline, said_of

    parts = [headline(document)]
    more = said_of(document)[1:9]
    if more:
        parts.append("\n".join(f"  {text}." for text in more))
    base = document["baseline"]
    if base is not None:
        parts.append(f"Baseline: {base['test']} ({base['chosen']}).")
    rows = []
    for row in document["tests"][:60]:
        errors = [e["error_db"] for k in ("ofrf", "effect") if (e := row["errors"].get(k)) and e["error_db"] is not None]
        verdict = (row["diagnosis"] or {}).get("verdict")
        rows.append(
            [
                str(row["number"]),
                row["name"],
                row["state"],
                f"{min(errors):.2f}" if errors else "",
                verdict or "",
                "; ".join(row["missing"][:2]),
            ]
        )
    head = ["no.", "test", "state", "error dB", "verdict", "missing in the idle model"]
    kept = [i for i, name in enumerate(head) if i < 3 or any(row[i] for row in rows)]  # no empty columns where no test came so far
    parts.append(table([[row[i] for i in kept] for row in rows], [head[i] for i in kept]))
    if len(document["tests"]) > 60:
        parts[-1] += f"\nand {len(document['tests']) - 60} more in campaign.csv"
    bad = [f"  {row['name']}: {row['reason']}" for row in document["tests"] if row["state"] != "done"]
    if bad:
        parts.append("Failed, whole or in part:\n" + "\n".join(bad[:30]))
    odd = [f"  {row['name']}: {'; '.join(row['stands_out'][:3])}" for row in document["tests"] if row["stands_out"]]
    if odd:
        parts.append("Stand out:\n" + "\n".join(odd[:30]))
    parts.append(f"Table: {out / 'campaign.csv'}\nReport: {out / 'report.html'}")
    return "\n\n".join(parts)
