"""``operando inspect``."""

from __future__ import annotations

from typing import Any

import click

from operando.cli.answer import Answer, answers, table


@click.command("inspect", epilog="Example: operando inspect idle/run1.uff operating/*.uff")
@click.argument("files", nargs=-1, required=True, type=click.Path(), metavar="FILE...")
@answers
def inspect(files: tuple[str, ...]) -> Answer:
    """What is in files: sets, channels, DOFs, units, sampling; what is used, ignored, missing, and wrong."""
    from operando.io import inspect_files

    document: dict[str, Any] = inspect_files(list(files))
    from operando.cli.tables import inspection_text

    return Answer(document, inspection_text(document))


__all__ = ["inspect", "table"]
