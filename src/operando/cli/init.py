"""``operando init``."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import click

from operando.cli.answer import Answer, answers, table


@click.command("init", epilog="Example: operando init pump -o pump/test.toml")
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False))
@click.option("-o", "--output", type=click.Path(dir_okay=False), help="Test file to write (default: DIR/test.toml).")
@click.option("--force", is_flag=True, help="Write over an existing test file.")
@answers
def init(folder: str, output: str | None, force: bool) -> Answer:
    """Look at the files in DIR and write a test file, saying what was taken for what and what is unsure."""
    from operando.scaffold import scaffold, write_test

    target = Path(output) if output is not None else Path(folder) / "test.toml"
    made = scaffold(folder, target)
    write_test(made, target, overwrite=force)
    rows = [[str(t.file), t.role + ("" if t.sure else " ?"), t.reason] for t in made.taken]
    parts = [f"{target} written.", table(rows, ["file", "taken as", "because"])]
    if made.notes:
        parts.append("To look at:\n" + "\n".join(f"  {note}" for note in made.notes))
    parts.append(f"Next: {_next(made.notes, folder, target)}")
    return Answer({"schema": "operando/init/1", "test": str(target), **made.to_dict()}, "\n\n".join(parts))


def _next(notes: Sequence[str], folder: str, target: Path) -> str:
    """What to do before the test can be run, and the command that runs it."""
    if any("hold FRFs of the same DOFs" in note for note in notes):
        again = shlex.join(["operando", "init", folder])
        return f"move each state into a folder of its own (idle, check), remove {target}, then {again} again"
    first = f"write what {target} asks for, then " if any("nothing runs without" in note for note in notes) else ""
    return first + shlex.join(["operando", "run", str(target)])
