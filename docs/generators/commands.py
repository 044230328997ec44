"""The reference of the command line: what `operando COMMAND --help` prints, for every command there is."""

from __future__ import annotations

import click

from operando.cli import COMMANDS, main


def page() -> str:
    """The page without its title."""
    context = click.Context(main, info_name="operando", max_content_width=100, terminal_width=100)
    out = []
    for name in COMMANDS:
        command = main.get_command(context, name)
        assert command is not None
        text = command.get_help(click.Context(command, info_name=name, parent=context, max_content_width=100, terminal_width=100))
        out += [f"## `operando {name}`", "", "```text", text, "```", ""]
    return "\n".join(out)
