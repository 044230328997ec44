"""``operando demo``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, verbosity
from operando.cli.summary import run_answer
from operando.cli.test_file import read_test, results_folder, test_options
from operando.paths import example_folder


@click.command("demo", epilog="Example: operando demo -o demo --open")
@click.option("-o", "--output", type=click.Path(), default="demo", show_default=True, help="Results folder.")
@test_options
@answers
def demo(output: str, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    """The packaged example: a plate, idle and operating, from raw UFF files to the report."""
    test = read_test(example_folder() / "test.toml", changes, second_opinion)
    if verbosity() >= 0:
        click.echo(f"Example test: {test.path} ({len(test.files)} files)", err=True)
    return run_answer(test, results_folder(test.name, output), show=show)
