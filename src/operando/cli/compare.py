"""``operando compare``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers


@click.command("compare", epilog="Example: operando compare pump-results check/run1.uff -o comparison.json")
@click.argument("model", type=click.Path())
@click.argument("measured", type=click.Path())
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="JSON file to write.")
@answers
def compare(model: str, measured: str, output: str | None) -> Answer:
    """Any model (results folder, model.h5, UFF FRFs or modes) against any measurement (FRFs, or records with force)."""
    raise NotImplementedError
