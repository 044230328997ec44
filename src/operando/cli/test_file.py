"""What the commands share that read a test file: its argument checked, ``--set``, ``--second-opinion``, the results folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.paths import path_of

if TYPE_CHECKING:
    from operando.config import Test

set_option = click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="Another value of an entry of the test file, as in analysis.band=[5,220]; may be repeated.",
)
output_option = click.option("-o", "--output", type=click.Path(), help="Results folder (default: results/NAME here).")
open_option = click.option("--open", "show", is_flag=True, help="Open the report in the browser when it is done.")
_second_opinion = click.option(
    "--second-opinion", is_flag=True, help="Compare with sdypy-EMA and pyOMA-2 on the same data; the report shows where they differ."
)


def test_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Options of all commands that run a test."""
    return _second_opinion(set_option(open_option(function)))


def read_test(path: str | Path, changes: tuple[str, ...] = (), second_opinion: bool = False) -> Test:
    """The test of a file, with what the command line changes of it."""
    from operando.config import load_test

    test = load_test(path, changes)
    return test.with_analysis(second_opinion=True) if second_opinion else test


def need_stage(test: Test, stage: str) -> None:
    """Refuse a command whose stage the test has no data for."""
    from operando.errors import MissingError
    from operando.pipeline import lacking

    reason = lacking(test, stage)
    if reason is not None:
        raise MissingError(f"there is nothing for {stage}: {reason}", where=str(test.path), hint="name its files in the test file")


def results_folder(name: str, output: str | None) -> Path:
    """The folder named, else ``results/NAME`` in the current one."""
    if output is not None:
        return path_of(output, "results go into a folder")
    from operando.pipeline.folder import default_folder

    return default_folder(name)
