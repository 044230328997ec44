"""Progress on stderr: plain lines, or one bar with the share done and the time left where stderr is a terminal."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from operando.cli.answer import say, verbosity
from operando.pipeline.share import WORDS, Share, duration, share_of
from operando.printable import printable

Report = Callable[[str, str], None]
"""Takes a stage and a message; messages from inside a stage begin with two blanks."""

_NOTABLE = ("left out", "failed", "the kept result")
"""What is said of a stage beside the bar."""

active = False
"""Whether a bar hides the cursor: Ctrl-C gives it back."""


@contextmanager
def following(stages: Sequence[str] = (), folder: Path | None = None) -> Iterator[Report]:
    """What reports the progress of a command until the block ends: nothing with -q, all messages with -v.

    The stages that will run stand in order; none where the command is one piece of work. The timings of the last run in the results folder
    say how long each takes.
    """
    level = verbosity()
    if level < 0:
        yield lambda stage, message: None
    elif sys.stderr.isatty() and os.environ.get("TERM", "") not in ("", "dumb"):
        with _bar(share_of(stages, folder), level > 0) as report:
            yield report
    else:
        yield _lines(level > 0)


def _lines(verbose: bool) -> Report:
    """Plain lines: seconds since the start, stage, message."""
    start = time.perf_counter()

    def report(stage: str, message: str) -> None:
        if verbose or not message.startswith("  "):
            say(f"[{time.perf_counter() - start:6.1f} s] {stage:8s} {message}")

    return report


@contextmanager
def _bar(share: Share, verbose: bool) -> Iterator[Report]:
    """A bar on the terminal; colours where NO_COLOR allows them. It is gone when the answer comes."""
    global active
    from rich.console import Console
    from rich.live import Live

    console = Console(file=sys.stderr, highlight=False)

    def report(stage: str, message: str) -> None:
        share.at(stage, message)
        if verbose or message.startswith(_NOTABLE):
            console.print(f"[{share.elapsed_s:6.1f} s] {stage:8s} {printable(message)}", markup=False, soft_wrap=True)

    with Live(_Row(share), console=console, refresh_per_second=4, transient=True):
        active = True
        try:
            yield report
        finally:
            active = False


class _Row:
    """What the bar shows now."""

    def __init__(self, share: Share) -> None:
        self._share = share

    def __rich__(self) -> Any:
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        done, left = self._share.share, self._share.left_s
        row = Table.grid(padding=(0, 1))
        words = Text(WORDS.get(self._share.stage, self._share.stage) or "starting")
        if not self._share.counts:
            row.add_row(words, Text(f"{duration(self._share.elapsed_s)}"))
            return row
        ends = f"about {duration(left)} left" if left is not None else f"{duration(self._share.elapsed_s)} so far"
        row.add_row(ProgressBar(total=1.0, completed=done, width=30), Text(f"{100 * done:3.0f} %"), Text(ends), words)
        return row
