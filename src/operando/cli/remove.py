"""``operando remove``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, own_option


@click.command("remove", epilog="Example: operando remove pump-results 1")
@click.argument("folder", metavar="DIR", type=click.Path())
@click.argument("step", type=int)
@own_option
@answers
def remove(folder: str, step: int) -> Answer:
    """Take the effect of a step back and refit the others (step 0 is the idle model)."""
    from operando.cli.by_hand import accepted, change, present
    from operando.cli.sources import changing
    from operando.errors import ConfigError

    with changing(folder, "remove") as out:
        state = present(folder)
        effects = accepted(state)
        if not 1 <= step <= len(effects):
            have = f"1 to {len(effects)}" if effects else "none: no effect has been added"
            raise ConfigError(f"there is no step {step} to remove", where=folder, hint=f"steps with an effect: {have}")
        return change(out, state, [e for i, e in enumerate(effects, 1) if i != step])
