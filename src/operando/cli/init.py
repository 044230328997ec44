"""``operando init``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers


@click.command("init", epilog="Example: operando init pump -o pump/test.toml")
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False))
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="Test file to write (default: DIR/test.toml).")
@answers
def init(folder: str, output: str | None) -> Answer:
    """Look at the files in DIR and write a test file, saying what was taken for what and what is unsure."""
    raise NotImplementedError
