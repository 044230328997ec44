"""``operando frf``, ``ema``, ``oma``: a test up to that stage."""

from __future__ import annotations

from pathlib import Path

import click

from operando.cli.answer import Answer, answers
from operando.cli.run import default_output
from operando.cli.story import Clock, run_answer, test_options


def _up_to(stage: str, test: str, output: str | None, second_opinion: bool) -> Answer:
    from operando.config import load_test
    from operando.pipeline import run

    loaded = load_test(test)
    if second_opinion:
        loaded = loaded.with_analysis(second_opinion=True)
    out = default_output(loaded.name) if output is None else Path(output)
    return run_answer(run(loaded, out, until=stage, progress=Clock()), out, stage)


_OUTPUT = click.option("-o", "--output", type=click.Path(file_okay=False), help="Results folder (default: results/NAME here).")


@click.command("frf", epilog="Example: operando frf pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@_OUTPUT
@test_options
@answers
def frf(test: str, output: str | None, second_opinion: bool) -> Answer:
    """Idle FRFs with coherence and variance (idle_frf.uff)."""
    return _up_to("frf", test, output, second_opinion)


@click.command("ema", epilog="Example: operando ema pump/test.toml -o pump-results --json")
@click.argument("test", type=click.Path())
@_OUTPUT
@test_options
@answers
def ema(test: str, output: str | None, second_opinion: bool) -> Answer:
    """Idle modes of unit modal mass, with uncertainties (idle_modes.uff)."""
    return _up_to("ema", test, output, second_opinion)


@click.command("oma", epilog="Example: operando oma pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@_OUTPUT
@test_options
@answers
def oma(test: str, output: str | None, second_opinion: bool) -> Answer:
    """Idle and operational modes (operating_modes.uff)."""
    return _up_to("oma", test, output, second_opinion)
