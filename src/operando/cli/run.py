"""``operando run``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers
from operando.cli.summary import run_answer
from operando.cli.test_file import output_option, read_test, results_folder, test_options


def _stages_like(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    from operando.pipeline import STAGES

    return [name for name in STAGES if name.startswith(incomplete)]


@click.command("run", epilog="Example: operando run pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@output_option
@click.option(
    "--until", metavar="STAGE", shell_complete=_stages_like, help="Last stage: inspect, frf, ema, oma, ofrf, compare, diagnose or report."
)
@test_options
@answers
def run(test: str, output: str | None, until: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    """Run all stages of a test, from raw files to the report.

    Stages whose files and settings are unchanged are taken from the last run; a stage whose data the test lacks is left out and said.
    """
    from operando.pipeline import STAGES
    from operando.values import nearest

    if until is not None and until not in STAGES:
        hint = nearest(until, STAGES)
        raise click.BadParameter(f"{until!r} is no stage; stages: {', '.join(STAGES)}; {hint}", param_hint="--until")
    loaded = read_test(test, changes, second_opinion)
    return run_answer(loaded, results_folder(loaded.name, output), until, show=show)
