"""``operando add``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, own_option
from operando.cli.diagnose import refit_answer
from operando.cli.effects import kinds_like
from operando.cli.progress import following
from operando.cli.test_file import open_option


@click.command("add", epilog="Example: operando add pump-results point_mass@272+Z=mass:0.2")
@click.argument("folder", metavar="DIR", type=click.Path())
@click.argument("effects", metavar="EFFECT...", nargs=-1, shell_complete=kinds_like)
@click.option("--suggested", is_flag=True, help="Add what the diagnosis accepts, in its order.")
@click.option("--fix", is_flag=True, help="Hold the values given instead of fitting them.")
@open_option
@own_option
@answers
def add(folder: str, effects: tuple[str, ...], suggested: bool, fix: bool, show: bool) -> Answer:
    """Add effects to the idle model, refit all of them, and print the error before and after on lines the fit has not seen.

    The next `operando run` on this folder makes the results of the test file again, without what was added here.

    EFFECT is KIND[@PLACE][=name:value,...], PLACE is DOF, DOF,DOF or x,y,z:+Z (m); values are starting values.
    """
    if bool(effects) == suggested:
        raise click.UsageError("name effects to add, or --suggested")
    from operando.pipeline.by_hand import add_effects, add_suggested

    with following() as progress:
        done = add_suggested(folder, progress=progress) if suggested else add_effects(folder, effects, fix=fix, progress=progress)
    return refit_answer(done, folder, show)
