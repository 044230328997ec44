"""``operando completion``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers

SHELLS = ("bash", "zsh", "fish")
_HOW = {
    "bash": "operando completion bash >> ~/.bashrc",
    "zsh": "operando completion zsh >> ~/.zshrc",
    "fish": "operando completion fish > ~/.config/fish/completions/operando.fish",
}


@click.command("completion", epilog="Example: operando completion bash >> ~/.bashrc")
@click.argument("shell", type=click.Choice(SHELLS))
@answers
def completion(shell: str) -> Answer:
    """The script by which a shell completes commands, options, stages and kinds of effects at the Tab key."""
    from click.shell_completion import get_completion_class

    from operando.cli import main

    made = get_completion_class(shell)
    assert made is not None  # the choice saw to it
    script = made(main, {}, "operando", "_OPERANDO_COMPLETE")
    text = script.source_template % script.source_vars()
    return Answer({"schema": "operando/completion/1", "shell": shell, "install": _HOW[shell], "script": text}, text.strip())
