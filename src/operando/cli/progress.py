"""Progress on stderr: plain lines, or one bar with the share done and the time left where stderr is a terminal."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from operando.cli.answer import say, verbosity
from operando.printable import printable

Report = Callable[[str, str], None]
"""Takes a stage and a message; messages from inside a stage begin with two blanks."""

WORDS = {
    "inspect": "looking at the files",
    "frf": "idle FRFs",
    "ema": "idle modes",
    "oma": "operational modes",
    "ofrf": "operational FRFs",
    "compare": "comparison with the validation measurement",
    "diagnose": "diagnosis",
    "report": "report",
    "store": "writing the results",
    "refit": "refit with the effects",
}
TYPICAL_S = {"inspect": 0.4, "frf": 2.7, "ema": 16.0, "oma": 3.2, "ofrf": 0.4, "compare": 5.6, "diagnose": 35.0, "report": 5.7}
"""Seconds of the stages on the packaged example; of them only the proportions count, where the folder holds no timings of its own."""
_PART = 0.95
"""Share of a stage that counts as done at most before the next one begins."""
_NOTABLE = ("left out", "failed", "the kept result")
"""What is said of a stage beside the bar."""

active = False
"""Whether a bar hides the cursor: Ctrl-C gives it back."""


class Share:
    """Share done and time left, from the seconds that each stage is expected to take.

    Parameters
    ----------
    expected_s : mapping
        Stage → seconds, in order.
    known : bool
        Whether the seconds are those of an earlier run; else only their proportions count, and the first stage that is done sets the pace.
    now : callable
        Clock [s].
    """

    def __init__(self, expected_s: Mapping[str, float], known: bool = False, now: Callable[[], float] = time.monotonic) -> None:
        self._left = dict(expected_s)
        self._spent_s = self._done_s = 0.0
        self._pace: float | None = 1.0 if known else None
        self._now = now
        self._begun = now()
        self.stage = ""
        self.start_s = now()

    @property
    def counts(self) -> bool:
        """Whether there are stages to count."""
        return bool(self._left)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return self._now() - self.start_s

    def at(self, stage: str, message: str) -> None:
        """Take note of what a stage says."""
        if stage not in self._left:
            if stage != self.stage and self.stage in self._left:  # what follows the last stage
                self._finish()
            self.stage = stage
            return
        if stage != self.stage:
            self._finish()
            for earlier in list(self._left)[: list(self._left).index(stage)]:
                self._left[earlier] = 0.0  # passed without a word
            self.stage, self._begun = stage, self._now()
        if message.startswith(("unchanged", "left out")):
            self._left[stage] = 0.0

    def _finish(self) -> None:
        seconds = self._left.get(self.stage, 0.0)
        if seconds:
            took = self._now() - self._begun
            self._done_s += seconds
            self._left[self.stage] = 0.0
            self._spent_s += took
            self._pace = self._spent_s / self._done_s

    def _inside(self) -> float:
        """Expected seconds of the present stage that are done."""
        return min(_PART * self._left.get(self.stage, 0.0), (self._now() - self._begun) / (self._pace or 1.0))

    @property
    def share(self) -> float:
        """Part of the expected work that is done, 0 to 1."""
        total = self._done_s + sum(self._left.values())
        return (self._done_s + self._inside()) / total if total > 0 else 1.0

    @property
    def left_s(self) -> float | None:
        """Seconds to the end, None where nothing tells the pace yet."""
        return None if self._pace is None else max(sum(self._left.values()) - self._inside(), 0.0) * self._pace


def duration(seconds: float) -> str:
    """Seconds in words, as coarse as they are known."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextmanager
def following(stages: Sequence[str] = (), folder: Path | None = None) -> Iterator[Report]:
    """What reports the progress of a command until the block ends: nothing with -q, all messages with -v.

    Parameters
    ----------
    stages : sequence of str
        The stages that will run, in order; none where the command is one piece of work.
    folder : Path, optional
        Results folder; the timings of its last run say how long each stage takes.
    """
    level = verbosity()
    if level < 0:
        yield lambda stage, message: None
    elif sys.stderr.isatty() and os.environ.get("TERM", "") not in ("", "dumb"):
        with _bar(_share(stages, folder), level > 0) as report:
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


def _share(stages: Sequence[str], folder: Path | None) -> Share:
    try:
        told = json.loads((folder / "timings.json").read_text(encoding="utf-8"))["seconds"] if folder is not None else {}
        seconds = {stage: float(told[stage]) for stage in stages}
        return Share(seconds, known=bool(stages))
    except (OSError, ValueError, KeyError, TypeError):
        return Share({stage: TYPICAL_S[stage] for stage in stages})


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
