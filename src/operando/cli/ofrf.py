"""``operando ofrf``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers


@click.command(
    "ofrf", epilog="Example: operando ofrf pump-results --responses 12+Z,13+Z --references 1+Z --frequencies 5:220:0.25 -o pair.uff"
)
@click.argument("folder", metavar="DIR", type=click.Path())
@click.option("--responses", metavar="DOFS", help="Comma-separated DOFs, as in 12+Z,7-X (default: all).")
@click.option("--references", metavar="DOFS", help="Comma-separated DOFs (default: all).")
@click.option("--frequencies", metavar="A:B:STEP", help="Lines in Hz (default: the lines of the idle FRFs).")
@click.option("--quantity", type=click.Choice(["accelerance", "mobility", "receptance"]), default="accelerance", show_default=True)
@click.option(
    "--route",
    type=click.Choice(["hybrid", "effect"]),
    default="hybrid",
    show_default=True,
    help="hybrid: scaled operational modes; effect: idle model + accepted effects.",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="File to write: .uff, .h5, .mat or .csv by its ending.")
@answers
def ofrf(
    folder: str, responses: str | None, references: str | None, frequencies: str | None, quantity: str, route: str, output: str | None
) -> Answer:
    """Operational FRFs of any response-reference pair, with the standard deviation of each line."""
    raise NotImplementedError
