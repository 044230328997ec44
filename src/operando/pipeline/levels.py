"""Validation measurements by excitation level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from operando.data import Frf, TimeRecord, one_level
from operando.dof import Node
from operando.results import CheckRun


def force_rms(record: TimeRecord) -> float:
    """Rms of the forces of a record [N], root mean square over its force channels."""
    return float(np.sqrt(np.mean([np.mean(np.square(record.data[i], dtype=float)) for i in record.force_indices])))


def level_groups(records: Sequence[TimeRecord]) -> list[list[TimeRecord]]:
    """Runs of one level, lowest level first.

    Runs of the same references are ranked by their force; a step of more than ``LEVEL_RATIO`` starts a new level. The groups
    of all references are joined by rank, so that the lowest level holds every reference.
    """
    by_reference: dict[frozenset[tuple[Node, str]], list[TimeRecord]] = {}
    for record in records:
        dofs = (record.channels[i].dof for i in record.force_indices)
        by_reference.setdefault(frozenset(d.key for d in dofs if d is not None), []).append(record)
    groups: list[list[TimeRecord]] = []
    for runs in by_reference.values():
        ranked = sorted(runs, key=force_rms)
        rank = 0
        for previous, run in zip([None, *ranked], ranked, strict=False):
            if previous is not None and not one_level(force_rms(previous), force_rms(run)):
                rank += 1
            while len(groups) <= rank:
                groups.append([])
            groups[rank].append(run)
    return groups


def check_frfs(records: Sequence[TimeRecord], estimate: Callable[[list[TimeRecord]], Frf]) -> list[CheckRun]:
    """FRFs of the validation measurements: one for all levels where the estimate finds them homogeneous, else one a level, lowest first.

    Parameters
    ----------
    records : sequence of TimeRecord
        With forces and responses.
    estimate : callable
        Records → Frf; a finding ``nonlinear`` says that runs differ beyond their noise.
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
    return CheckRun(", ".join(r.name for r in records), f"{text}, all levels agree" if several else text, frf, low, several)
