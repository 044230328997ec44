"""What the stages of the pipeline share: one run with its test and files, a stage, the words for what a test lacks."""

from __future__ import annotations

import inspect as introspection
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from operando.config import Analysis, Test
from operando.data import Finding
from operando.errors import MissingError
from operando.pipeline.inputs import Inputs
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
    """A step of the pipeline.

    Parameters
    ----------
    name : str
        Name in the cache.
    part_of : str
        Stage of the specification it belongs to.
    does : callable
        ``Work`` → fields of ``Results`` it fills (and ``findings``, those of the stage itself).
    lacks : callable
        ``Test`` → why the stage is left out, or None.
    upstream : tuple of str
        Stages whose results it uses.
    settings : tuple of str
        Names in [analysis] that decide the result.
    states : tuple of str
        States whose files it reads.
    wanted : callable
        ``Test`` → whether it is asked for at all; what is not is not left out either.
    """

    name: str
    part_of: str
    does: Callable[[Work], dict[str, Any]]
    lacks: Callable[[Test], str | None] = field(default=lambda test: None)
    upstream: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    wanted: Callable[[Test], bool] = field(default=lambda test: True)


def offered(function: Callable[..., Any], findings: list[Finding], **keywords: Any) -> dict[str, Any]:
    """The keywords that have a value and that the function knows; one it does not know becomes a finding."""
    known = introspection.signature(function).parameters
    given = {key: value for key, value in keywords.items() if value is not None and value != ()}
    for key in given:
        if key not in known:
            message = f"setting {key} has no effect on {function.__name__}"
            findings.append(Finding("setting_unused", message, "warning", consequence="this stage runs as if it were not set"))
    return {key: value for key, value in given.items() if key in known}


def needed(value: Any, what: str) -> Any:
    """The value, or the error that says what there is none of."""
    if value is None:
        raise MissingError(f"there are no {what}")
    return value


def analysis_band(work: Work) -> tuple[float, float] | None:
    """The band of the test, else the one the idle modes were fitted in, so that both states have the same."""
    return work.analysis.band or (None if work.results.idle is None else work.results.idle.band_hz)


def no_idle(test: Test) -> str | None:
    """Why a stage of the idle state is left out."""
    return None if test.idle else "the test has no [idle] measurement"


def no_operation(test: Test) -> str | None:
    """Why a stage of the operating state is left out."""
    return None if test.operating else "the test has no [operating] records"


def no_both(test: Test) -> str | None:
    """Why a stage that needs both states is left out."""
    return no_idle(test) or no_operation(test)


def no_check(test: Test) -> str | None:
    """Why the comparison is left out."""
    return no_idle(test) or (None if test.check else "the test has no [check] measurement")


def no_evidence(test: Test) -> str | None:
    """Why the diagnosis is left out."""
    return no_idle(test) or (None if test.check or test.operating else "the test has neither [check] nor [operating] measurements")
