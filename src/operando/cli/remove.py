"""``operando remove``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, own_option
from operando.cli.diagnose import refit_answer
from operando.cli.progress import following
from operando.cli.test_file import open_option


@click.command("remove", epilog="Example: operando remove pump-results 1")
@click.argument("folder", metavar="DIR", type=click.Path())
@click.argument("step", type=int)
@open_option
@own_option
@answers
def remove(folder: str, step: int, show: bool) -> Answer:
    """Take the effect of a step back and refit the others (step 0 is the idle model)."""
    from operando.pipeline.by_hand import remove_effect

    with following() as progress:
        return refit_answer(remove_effect(folder, step, progress=progress), folder, show)
