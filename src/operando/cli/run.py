"""``operando run``."""

from __future__ import annotations

from pathlib import Path

import click

from operando.cli.answer import Answer, answers
from operando.cli.story import Clock, run_answer, test_options


@click.command("run", epilog="Example: operando run pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@click.option("-o", "--output", type=click.Path(file_okay=False), help="Results folder (default: results/NAME here).")
@click.option("--until", metavar="STAGE", help="Last stage: inspect, frf, ema, oma, ofrf, compare, diagnose or report.")
@test_options
@answers
def run(test: str, output: str | None, until: str | None, second_opinion: bool) -> Answer:
    """Run all stages of a test, from raw files to the report.

    Stages whose files and settings are unchanged are taken from the last run; a stage whose data the test lacks is left out and said.
    """
    from operando.config import load_test
    from operando.pipeline import STAGES
    from operando.pipeline import run as run_pipeline

    if until is not None and until not in STAGES:
        raise click.BadParameter(f"{until!r} is no stage; stages: {', '.join(STAGES)}", param_hint="--until")
    loaded = load_test(test)
    if second_opinion:
        loaded = loaded.with_analysis(second_opinion=True)
    out = default_output(loaded.name) if output is None else Path(output)
    results = run_pipeline(loaded, out, until=until, progress=Clock())
    return run_answer(results, out, until)


def default_output(name: str) -> Path:
    """``results/NAME`` in the current folder."""
    return Path("results") / "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip(".-")
