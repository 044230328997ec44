"""Validation measurements by excitation level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from operando.data import Frf, TimeRecord, force_rms, level_groups
from operando.results import CheckRun


def check_frfs(records: Sequence[TimeRecord], estimate: Callable[[list[TimeRecord]], Frf]) -> list[CheckRun]:
    """FRFs of the validation measurements: one for all levels where the estimate finds them homogeneous, else one a level, lowest first.

    A finding ``nonlinear`` of the estimate says that runs differ beyond their noise.
    """
    groups = level_groups(records)
    everything = estimate(list(records))
    linear = not any(f.kind == "nonlinear" for f in everything.findings)
    if len(groups) == 1 or linear:
        return [_run(records, everything, several=len(groups) > 1)]
    runs = [_run(group, estimate(group)) for group in groups]
    told = tuple(f for f in everything.findings if f.kind == "nonlinear")
    return [replace(runs[0], frf=runs[0].frf.with_findings([f for f in told if f not in runs[0].frf.findings])), *runs[1:]]


def _run(records: Sequence[TimeRecord], frf: Frf, several: bool = False) -> CheckRun:
    """The FRFs of records with their level."""
    forces = [force_rms(r) for r in records]
    low, high = min(forces), max(forces)
    text = f"{low:.4g} N rms" if high < 1.05 * low else f"{low:.4g} … {high:.4g} N rms"
    return CheckRun(
        ", ".join(r.name for r in records), f"{text}, all levels agree within their noise" if several else text, frf, low, several
    )
