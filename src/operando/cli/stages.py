"""``operando frf``, ``ema``, ``oma``: a test up to that stage, and the report of what there is."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers
from operando.cli.summary import run_answer
from operando.cli.test_file import need_stage, output_option, read_test, results_folder, test_options


def _command(stage: str, does: str, more: str = "") -> click.Command:
    """The command that runs a test up to a stage."""

    @click.command(stage, help=does, epilog=f"Example: operando {stage} pump/test.toml -o pump-results{more}")
    @click.argument("test", type=click.Path())
    @output_option
    @test_options
    @answers
    def command(test: str, output: str | None, changes: tuple[str, ...], second_opinion: bool, show: bool) -> Answer:
        loaded = read_test(test, changes, second_opinion)
        need_stage(loaded, stage)
        return run_answer(loaded, results_folder(loaded.name, output), stage, report=True, show=show)

    return command


frf = _command("frf", "Idle FRFs with coherence and variance (idle_frf.uff), and the report of them.")
ema = _command("ema", "Idle modes of unit modal mass, with uncertainties (idle_modes.uff), and the report of them.", " --json")
oma = _command("oma", "Idle and operational modes (operating_modes.uff), and the report of them.")
