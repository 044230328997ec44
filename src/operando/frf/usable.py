"""The one place that decides which channels of the records of a state are used: faulty ones are left out everywhere, and said once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from operando.data import Finding, TimeRecord
from operando.dof import Node

FLAT_SHARE = 1e-4
"""A channel says nothing where its standard deviation is below this part of the median of its quantity (−80 dB: converter noise)."""

SPARED_SHARE = 0.1
"""A response that is faulty in at most this part of the runs that hold it (one of ten) is left out of those runs alone: without it in all
others, more would be lost than its gap in some columns costs. A roving hammer over 100 points keeps its drive points so."""


@dataclass(frozen=True)
class ChannelFault:
    """Why the channel of one row cannot be used: ``nan`` or ``flat``, and what is wrong with numbers."""

    row: int
    kind: str
    message: str


def channel_faults(record: TimeRecord) -> list[ChannelFault]:
    """Channels that hold samples that are not finite, or no signal."""
    spreads, finite = record.statistics.std, record.statistics.finite
    out = []
    for i, channel in enumerate(record.channels):
        peers = [spreads[k] for k, c in enumerate(record.channels) if c.quantity == channel.quantity and spreads[k] > 0]
        typical = float(np.median(peers)) if peers else 0.0
        if spreads[i] == 0 or spreads[i] < FLAT_SHARE * typical:
            others = f", others {typical:.3g}" if typical else ""
            out.append(ChannelFault(i, "flat", f"no signal: rms {spreads[i]:.3g}{others} {channel.unit}".rstrip()))
        elif not finite[i]:
            row = record.data[i]
            bad = np.flatnonzero(~np.isfinite(row))
            first = record.start_s + bad[0] / record.sampling_hz
            out.append(ChannelFault(i, "nan", f"{bad.size} of {row.size} samples are not finite, the first at {first:.4g} s"))
    return out


def usable_channels(records: Sequence[TimeRecord]) -> tuple[list[TimeRecord], list[Finding]]:
    """The records without the channels that no stage can use, and one finding for each of these.

    A response with samples that are not finite, or without a signal, is left out of every run (see ``SPARED_SHARE``); a run whose force
    is faulty is left out where another run has the same forces. A fault that nothing can be done about is left to the stages, which say
    what they need. Applied twice, nothing more is found.

    Parameters
    ----------
    records : sequence of TimeRecord
        The runs of one state.

    Returns
    -------
    records : list of TimeRecord
    findings : list of Finding
        ``nan``, ``flat`` (a response left out) and ``run_left_out``.

    Examples
    --------
    >>> import numpy as np, operando
    >>> rng = np.random.default_rng(0)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(rng.standard_normal((2, 1000)), 500.0, channels)
    >>> from operando.frf import usable_channels
    >>> len(usable_channels([record])[0])
    1
    """
    faults = [channel_faults(r) for r in records]
    if not any(faults):
        return list(records), []
    findings: list[Finding] = []
    kept = _runs_with_forces(records, faults, findings)
    bad: dict[tuple[Node, str], list[tuple[int, ChannelFault]]] = {}
    for k in kept:
        motion = set(records[k].response_indices)
        for fault in faults[k]:
            dof = records[k].channels[fault.row].dof
            if fault.row in motion and dof is not None:
                bad.setdefault(dof.key, []).append((k, fault))
    drop: dict[int, set[int]] = {k: set() for k in kept}
    for key, cases in bad.items():
        holders = {k: rows for k in kept if (rows := _rows_at(records[k], key))}
        everywhere = len({k for k, _ in cases}) > SPARED_SHARE * len(holders)
        if not everywhere:
            holders = {k: [fault.row] for k, fault in cases}
        for k, rows in holders.items():
            drop[k].update(rows)
        findings.append(_left_out(records, cases, len(holders), everywhere))
    out = []
    for k in kept:
        left = [i for i in range(len(records[k].channels)) if i not in drop[k]]
        part = records[k].select(left) if drop[k] else records[k]
        if part.response_indices:
            out.append(part)
        else:
            findings.append(_run_left_out(records[k], "none of its responses can be used"))
    return (out, findings) if out else (list(records), [])


def _rows_at(record: TimeRecord, key: tuple[Node, str]) -> list[int]:
    """Rows of the responses at a DOF, in either sense."""
    return [i for i in record.response_indices if (d := record.channels[i].dof) is not None and d.key == key]


def _runs_with_forces(records: Sequence[TimeRecord], faults: Sequence[list[ChannelFault]], findings: list[Finding]) -> list[int]:
    """Runs to keep: one whose force is faulty only where no other run has the same forces."""
    faulty = [[f for f in fault if records[k].channels[f.row].is_force] for k, fault in enumerate(faults)]
    forces = [
        frozenset(d.key for i in r.force_indices if (d := r.channels[i].dof) is not None) if r.force_indices else None for r in records
    ]
    kept = []
    for k, record in enumerate(records):
        others = any(forces[j] == forces[k] and not faulty[j] for j in range(len(records)) if j != k)
        if faulty[k] and others:
            fault = faulty[k][0]
            findings.append(_run_left_out(record, f"its force {record.channels[fault.row].label} has {fault.message}"))
        else:
            kept.append(k)
    return kept


def _run_left_out(record: TimeRecord, why: str) -> Finding:
    return Finding(
        "run_left_out",
        f"the run is left out: {why}",
        "warning",
        file=record.name or None,
        consequence="the other runs are used",
        action="check the cable, repeat the run",
    )


def _left_out(records: Sequence[TimeRecord], cases: Sequence[tuple[int, ChannelFault]], runs: int, everywhere: bool) -> Finding:
    """The finding for one channel that is left out."""
    k, fault = cases[0]
    record, label = records[k], records[k].channels[fault.row].label
    names = list(dict.fromkeys(records[j].name for j, _ in cases if records[j].name))
    where = f" (and in {len(names) - 1} more files)" if len(names) > 1 else ""
    scope = (
        "this channel is left out of this run and the others of its state, in all stages"
        if everywhere and runs > 1
        else "this channel is left out of this run, in all stages"
    )
    return Finding(
        fault.kind,
        f"{label}: {fault.message}{where}; {scope}",
        "warning",
        file=record.name or None,
        set=record.channels[fault.row].set,
        dof=label,
        consequence=f"FRFs and modes are those without {label}",
        action="repair the file, check cable and sensor, or exclude the channel in [channels] with a reason",
    )


def whole(records: Sequence[TimeRecord]) -> list[TimeRecord]:
    """The records that are finite in all forces and responses: those that an analysis of whole records can use."""
    return [r for r in records if r.statistics.finite[[*r.force_indices, *r.response_indices]].all()]


def trimmed(record: TimeRecord) -> tuple[TimeRecord, list[Finding]]:
    """The record without samples at either end at which no channel is finite (columns of a table that end early), and the finding."""
    if record.statistics.finite.any():
        return record, []
    there = np.flatnonzero(np.isfinite(record.data).any(axis=0))
    if not there.size or there.size == record.n_samples or (there[0] == 0 and there[-1] == record.n_samples - 1):
        return record, []
    first, last = int(there[0]), int(there[-1]) + 1
    text = f"{record.n_samples - (last - first)} samples at the ends hold no number in any channel and are cut off"
    cut = replace(record, data=record.data[:, first:last], start_s=record.start_s + first / record.sampling_hz)
    return cut, [Finding("trimmed", text, "info", file=record.name or None, consequence="the rest of the record is used")]
