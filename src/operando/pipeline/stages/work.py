"""What the stages of the pipeline share: one run with its test and files, a stage, the words for what a test lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from operando.config import Analysis, Test
from operando.errors import MissingError
from operando.pipeline.inputs import Inputs
from operando.pipeline.lacks import lacking
from operando.results import Results


class Lacking(MissingError):
    """What a stage needs is not in the data: it is left out and said, which is no failure."""


@dataclass
class Work:
    """One run of the pipeline: the test, its files, what is known so far, and who is told of progress inside a stage."""

    test: Test
    inputs: Inputs
    results: Results
    say: Callable[[str], None] | None = None

    @property
    def analysis(self) -> Analysis:
        """Settings."""
        return self.test.analysis


@dataclass(frozen=True)
class Stage:
    """A step of the pipeline."""

    name: str  # name in the cache
    part_of: str  # stage of the specification it belongs to
    does: Callable[[Work], dict[str, Any]]  # ``Work`` → fields of ``Results`` it fills, and ``findings`` of the stage itself
    upstream: tuple[str, ...] = ()  # stages whose results it uses
    settings: tuple[str, ...] = ()  # names in [analysis] that decide the result
    states: tuple[str, ...] = ()  # states whose files it reads
    wanted: Callable[[Test], bool] = field(default=lambda test: True)  # whether it is asked for at all; else it is not left out either

    def lacks(self, test: Test) -> str | None:
        """Why the step is left out, or None."""
        return lacking(test, self.part_of)

    @property
    def which(self) -> str:
        """Which step of its stage it is, in brackets; nothing where it is named after the stage."""
        return f" ({self.name})" if self.name != self.part_of else ""


def needed(value: Any, what: str) -> Any:
    """The value, or the error that says what there is none of."""
    if value is None:
        raise MissingError(f"there are no {what}")
    return value


def none_read(states: Sequence[str]) -> str:
    """Says that no file of these states can be read."""
    return f"no file of {' or '.join(f'[{name}]' for name in states)} can be read"


def analysis_band(work: Work) -> tuple[float, float] | None:
    """The band of the test, else the one the idle modes were fitted in, so that both states have the same."""
    return work.analysis.band or (None if work.results.idle is None else work.results.idle.band_hz)
