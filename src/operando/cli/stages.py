"""``operando frf``, ``ema``, ``oma``: a test up to that stage, and the report of what there is."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers
from operando.cli.summary import run_answer
from operando.cli.test_file import need_stage, output_option, read_test, results_folder, test_options


def _up_to(stage: str, test: str, output: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    loaded = read_test(test, changes, second_opinion)
    need_stage(loaded, stage)
    return run_answer(loaded, results_folder(loaded.name, output), stage, report=True, show=show)


@click.command("frf", epilog="Example: operando frf pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@output_option
@test_options
@answers
def frf(test: str, output: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    """Idle FRFs with coherence and variance (idle_frf.uff), and the report of them."""
    return _up_to("frf", test, output, changes, second_opinion, show)


@click.command("ema", epilog="Example: operando ema pump/test.toml -o pump-results --json")
@click.argument("test", type=click.Path())
@output_option
@test_options
@answers
def ema(test: str, output: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    """Idle modes of unit modal mass, with uncertainties (idle_modes.uff), and the report of them."""
    return _up_to("ema", test, output, changes, second_opinion, show)


@click.command("oma", epilog="Example: operando oma pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@output_option
@test_options
@answers
def oma(test: str, output: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
    """Idle and operational modes (operating_modes.uff), and the report of them."""
    return _up_to("oma", test, output, changes, second_opinion, show)
