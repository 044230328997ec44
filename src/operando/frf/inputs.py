"""What of a record an FRF estimate uses: forces, responses, spans to leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from operando.data import Finding, TimeRecord
from operando.dof import Dof, Node
from operando.errors import DataError

QUANTITY = {"displacement": "receptance", "velocity": "mobility", "acceleration": "accelerance"}
BAD_KINDS = ("overload", "dropout")
"""Findings with a time span that no block may touch (samples that are not finite are looked for block by block)."""
LONGEST_BAD = 0.125
"""A span longer than this part of the record (a block by default) is used as it is: nothing would be left without it."""


@dataclass(frozen=True)
class RunInput:
    """Rows of a record that enter the estimate.

    ``bad`` are sample spans (first, last) with overload or dropout, ``findings`` what was left out and why.
    """

    record: TimeRecord
    forces: tuple[int, ...]
    responses: tuple[int, ...]
    quantity: str
    bad: tuple[tuple[int, int], ...]
    findings: tuple[Finding, ...]

    @property
    def name(self) -> str | None:
        """File or title of the run."""
        return self.record.name or None

    @property
    def references(self) -> tuple[Dof, ...]:
        """DOFs of the forces."""
        return _dofs(self.record, self.forces)

    @property
    def response_dofs(self) -> tuple[Dof, ...]:
        """DOFs of the responses."""
        return _dofs(self.record, self.responses)

    @property
    def si(self) -> bool:
        """Whether the unit of every channel is known."""
        return all(self.record.channels[i].unit for i in (*self.forces, *self.responses))

    @property
    def level(self) -> float:
        """Rms of the forces [N], offsets removed."""
        return float(np.sqrt(np.mean(np.square(self.record.statistics.std[list(self.forces)]))))

    def finite(self, rows: Sequence[int]) -> list[int]:
        """Those of the rows whose samples are all finite."""
        return [i for i in rows if self.record.statistics.finite[i]]


def _dofs(record: TimeRecord, rows: Sequence[int]) -> tuple[Dof, ...]:
    return tuple(d for i in rows if (d := record.channels[i].dof) is not None)


def run_input(record: TimeRecord) -> RunInput:
    """Sort out the channels of a record."""
    where = record.name or None
    findings: list[Finding] = []
    forces = _unique(record, [i for i, c in enumerate(record.channels) if c.is_force], "force", findings)
    motion = [i for i, c in enumerate(record.channels) if c.quantity in QUANTITY]
    if not forces:
        raise DataError(
            "no force channel with a DOF and a signal", where=where, hint='label it in [channels]: quantity = "force", dof = "…"'
        )
    if not motion:
        raise DataError("no response channel", where=where, hint="label the responses in [channels]: quantity, dof")
    kinds = [record.channels[i].quantity for i in motion]
    main = max(QUANTITY, key=kinds.count)
    for i in motion:
        channel = record.channels[i]
        if channel.quantity != main:
            message = f"channel {channel.label} measures {channel.quantity}, most others {main}; it is left out of the FRFs"
            findings.append(Finding("mixed_quantity", message, file=where, dof=channel.label, action="estimate it apart"))
    responses = _unique(record, [i for i in motion if record.channels[i].quantity == main], "response", findings)
    if not responses:
        raise DataError("no response channel has a DOF and a signal", where=where, hint="label the responses in [channels]")
    used = {record.channels[i].label for i in (*forces, *responses)}
    return RunInput(record, tuple(forces), tuple(responses), QUANTITY[main], _bad_spans(record, used), tuple(findings))


def _unique(record: TimeRecord, rows: Sequence[int], what: str, findings: list[Finding]) -> list[int]:
    """Rows with a DOF that no earlier row has, and a signal; a finding for each of the others."""
    where = record.name or None
    seen: set[tuple[Node, str]] = set()
    out = []
    for i in rows:
        channel = record.channels[i]
        if channel.dof is None:
            message = f"{what} channel {channel.name or i} has no DOF and is not used"
            findings.append(Finding("missing_dof", message, file=where, set=channel.set, action="give its DOF in [channels]"))
        elif channel.dof.key in seen:
            message = f"{what} channel {channel.name or i} repeats DOF {channel.dof}; the first one is used"
            findings.append(
                Finding("duplicate_dof", message, file=where, set=channel.set, dof=channel.label, action="exclude one in [channels]")
            )
        elif record.statistics.flat[i]:
            message = f"{what} channel {channel.label} is constant and is not used"
            findings.append(Finding("flat", message, file=where, set=channel.set, dof=channel.label, action="check cable and sensor"))
        else:
            seen.add(channel.dof.key)
            out.append(i)
    return out


def _bad_spans(record: TimeRecord, labels: set[str]) -> tuple[tuple[int, int], ...]:
    """Sample spans of findings that make the samples useless, on the channels used."""
    spans = []
    for finding in record.findings:
        if finding.kind in BAD_KINDS and finding.time_s is not None and (finding.dof is None or finding.dof in labels):
            first, last = ((t - record.start_s) * record.sampling_hz for t in finding.time_s)
            if last - first > LONGEST_BAD * record.n_samples:
                continue
            spans.append((max(0, int(np.floor(first))), min(record.n_samples - 1, int(np.ceil(last)))))
    return tuple(sorted(spans))
