"""``estimate_frf``: from time records to one FRF matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from operando.data import Channel, Finding, Frf, TimeRecord
from operando.dof import Dof, parse_dofs
from operando.errors import DataError
from operando.frf.estimators import estimate, inverse_force_matrix
from operando.frf.runs import RunEstimate, merge_runs
from operando.frf.spectra import cross_spectra

MOTION = ("displacement", "velocity", "acceleration")
QUANTITY = {"displacement": "receptance", "velocity": "mobility", "acceleration": "accelerance"}


def estimate_frf(
    records: TimeRecord | Sequence[TimeRecord],
    *,
    references: object = None,
    estimator: str | None = None,
    block_seconds: float | None = None,
    overlap: float | None = None,
    window: str | None = None,
    band: tuple[float, float] | None = None,
) -> Frf:
    """Estimate FRFs from force and response records."""
    runs = [records] if isinstance(records, TimeRecord) else list(records)
    if not runs:
        raise DataError("no records given", hint="estimate_frf needs at least one run with a force channel")
    wanted = None if references is None else parse_dofs(references)
    block_s = block_seconds if block_seconds is not None else min(r.duration_s for r in runs) / 8
    estimates = [_welch_run(r, estimator or "h1", block_s, 0.5 if overlap is None else overlap, window or "hann", band) for r in runs]
    return merge_runs(estimates, wanted)


def _welch_run(
    record: TimeRecord, estimator: str, block_s: float, overlap: float, window: str, band: tuple[float, float] | None
) -> RunEstimate:
    forces, responses, quantity, findings = rows_of(record)
    block = max(8, round(block_s * record.sampling_hz))
    lines = None
    if band is not None:
        step = record.sampling_hz / block
        lines = slice(max(0, int(np.ceil(band[0] / step - 1e-9))), min(block // 2, int(np.floor(band[1] / step + 1e-9))) + 1)
    spectra = cross_spectra(record.data, forces, responses, record.sampling_hz, block, overlap=overlap, window=window, lines=lines)
    h, variance, coherence, _ = estimate(spectra, estimator)
    inverse, _ = inverse_force_matrix(spectra.force)
    gain = spectra.averages / np.maximum(np.real(np.einsum("jjl->jl", inverse)), 1e-300)
    level = float(np.sqrt(np.mean([np.mean(np.square(record.data[i], dtype=float)) for i in forces])))
    return RunEstimate(
        spectra.frequencies_hz,
        h,
        variance,
        np.broadcast_to(coherence[:, None, :], h.shape),
        gain,
        spectra.averages,
        _dofs(record, responses),
        _dofs(record, forces),
        quantity,
        level,
        estimator,
        si=all(record.channels[i].unit for i in (*forces, *responses)),
        name=record.name,
        findings=tuple(findings),
        provenance=record.provenance.then(
            f"estimate_frf(estimator={estimator!r}, block_seconds={block / record.sampling_hz:g}, overlap={overlap:g}, window={window!r})"
        ),
    )


def _dofs(record: TimeRecord, rows: Sequence[int]) -> tuple[Dof, ...]:
    return tuple(d for i in rows if (d := record.channels[i].dof) is not None)


def rows_of(record: TimeRecord) -> tuple[list[int], list[int], str, list[Finding]]:
    """Rows of forces and responses with a DOF (each DOF once), FRF quantity, and findings about what is left out.

    Raises
    ------
    DataError
        If there is no force or no response with a DOF, or the responses are of several quantities.
    """
    findings: list[Finding] = []

    def unique(rows: list[int], what: str) -> list[int]:
        seen: dict[tuple[int, str], int] = {}
        out = []
        for i in rows:
            dof = record.channels[i].dof
            if dof is None:
                message = f"{what} channel {record.channels[i].name or i} has no DOF and is not used"
                findings.append(Finding("missing_dof", message, file=record.name or None, action="give its DOF in [channels]"))
            elif (dof.node, dof.axis) in seen:
                message = f"{what} channel {record.channels[i].name or i} repeats DOF {dof}; the first one is used"
                findings.append(
                    Finding("duplicate_dof", message, file=record.name or None, dof=str(dof), action="exclude one in [channels]")
                )
            else:
                seen[(dof.node, dof.axis)] = i
                out.append(i)
        return out

    forces = unique([i for i, c in enumerate(record.channels) if c.is_force], "force")
    motion: list[tuple[int, Channel]] = [(i, c) for i, c in enumerate(record.channels) if c.quantity in MOTION]
    if not forces:
        raise DataError(
            "no force channel with a DOF", where=record.name or None, hint='label the force channel in [channels]: quantity = "force", dof'
        )
    if not motion:
        raise DataError("no response channel", where=record.name or None, hint="label the responses in [channels]: quantity, dof")
    kinds = [c.quantity for _, c in motion]
    main = max(set(kinds), key=kinds.count)
    for i, c in motion:
        if c.quantity != main:
            message = f"channel {c.label} measures {c.quantity}, most others {main}; it is left out of the FRFs"
            findings.append(Finding("mixed_quantity", message, file=record.name or None, dof=c.label, action="estimate it apart"))
    responses = unique([i for i, c in motion if c.quantity == main], "response")
    if not responses:
        raise DataError("no response channel has a DOF", where=record.name or None, hint="label the responses in [channels]")
    return forces, responses, QUANTITY[main], findings
