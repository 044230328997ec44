"""What is in some files: found, used, ignored, missing."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from operando.data import Finding, Frf, Geometry, ModalModel, TimeRecord, counted
from operando.errors import OperandoError
from operando.io.content import Content
from operando.io.detect import read
from operando.io.quantities import Asked, ChannelSpecs, Units

SCHEMA = "operando/inspect/1"
DAMAGE = ("truncated", "unknown_set", "outside_sets")
"""Kinds of errors that say that a part of a file is lost."""
_FUNCTIONS = (0, 58)
"""Types of sets that hold what was measured; 0 where not even the type can be read."""


def inspect_files(paths: Iterable[str | Path], units: Units | None = None, channels: ChannelSpecs | None = None) -> dict[str, Any]:
    """Look at files without analysing them.

    Parameters
    ----------
    paths : iterable of paths
        Files to look at.
    units, channels : mappings, optional
        As for :func:`operando.io.read`.

    Returns
    -------
    dict
        JSON document ``operando/inspect/1``: ``files`` (one entry a file, see :func:`inspect_content`; a file that cannot be read has
        an ``error`` and a finding), ``findings`` of all files, ``dofs`` (all response DOFs), ``missing`` over all files.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.uff", frf)
    ...     inspect_files([f"{folder}/frf.uff"])["files"][0]["format"]
    'uff'
    """
    files: list[dict[str, Any]] = []
    findings: list[Finding] = []
    geometry = False
    dofs: dict[str, None] = {}
    asked = channels if isinstance(channels, Asked) else Asked(channels)
    for path in paths:
        try:
            content = read(path, units=units, channels=asked)
        except OperandoError as error:
            finding = Finding(
                "unreadable", error.message, "error", str(path), consequence="nothing of this file is used", action=error.hint or ""
            )
            files.append(_unread(path, error, finding))
            findings.append(finding)
            continue
        entry, notes = inspect_content(content)
        files.append(entry)
        findings += notes
        geometry |= content.geometry is not None
        for record in content.records:
            dofs |= dict.fromkeys(str(record.channels[i].dof) for i in record.response_indices)
        for frf in content.frfs:
            dofs |= dict.fromkeys(str(d) for d in frf.responses)
    if asked is not channels and not any(entry["error"] for entry in files):
        asked.check(", ".join(str(entry["path"]) for entry in files))
    missing = [] if geometry or not dofs else ["no geometry: shapes are not drawn on the structure"]
    return {
        "schema": SCHEMA,
        "files": files,
        "dofs": list(dofs),
        "missing": missing,
        "findings": [f.to_dict() for f in findings],
    }


def _unread(path: str | Path, error: OperandoError, finding: Finding) -> dict[str, Any]:
    return {
        "path": str(path), "format": None, "damage": [], "sets": [], "records": [], "frfs": [], "models": [], "geometry": None, "found": [],
        "used": [], "ignored": [], "missing": [], "findings": [finding.to_dict()], "error": error.to_dict(),
    }  # fmt: skip


def inspect_content(content: Content) -> tuple[dict[str, Any], list[Finding]]:
    """Entry of one file in the JSON of :func:`inspect_files`, and its findings.

    ``damage`` says in sentences what of a damaged file is lost; what may be in that part is not called missing. ``sets`` is the whole
    inventory; ``found`` and ``missing`` are sentences; ``used`` counts the sets used by title, ``ignored`` lists sets not used with the
    reason.
    """
    damage, functions_lost = _damage(content)
    extra = [] if functions_lost else [f for record in content.records for f in _drive_point(record, content.path)]
    findings = [*content.findings, *extra]
    missing = [text for record in content.records for text in _missing_of_record(record, functions_lost)]
    missing += [text for frf in content.frfs for text in _missing_of_frf(frf, functions_lost)]
    if not content.objects:
        missing.append("nothing that can be analysed: no time record, FRF, modes or geometry")
    unused = [s for s in content.sets if s.status != "used"]
    entry = {
        "path": content.path,
        "format": content.format,
        "damage": damage,
        "sets": [s.to_dict() for s in content.sets],
        "records": [_record(r) for r in content.records],
        "frfs": [_frf(f) for f in content.frfs],
        "models": [_model(m) for m in content.models],
        "geometry": None if content.geometry is None else _geometry(content.geometry),
        "found": _found(content),
        "used": _counted([s.title for s in content.sets if s.status == "used"]),
        "ignored": [{"set": s.index, "type": s.number, "title": s.title, "status": s.status, "reason": s.note} for s in unused],
        "missing": list(dict.fromkeys(missing)),
        "findings": [f.to_dict() for f in findings],
        "error": None,
    }
    return entry, findings


def _damage(content: Content) -> tuple[list[str], bool]:
    """What of a damaged file is lost, and whether measured functions may be in that part."""
    wrong = [f for f in content.findings if f.severity == "error" and f.kind in DAMAGE]
    types = {s.index: s.number for s in content.sets}
    refused = [f for f in wrong if f.kind != "outside_sets" and f.set in types]
    numbers = {types[f.set] for f in refused if f.set is not None}
    lost = [s for s in content.sets if s.status == "not understood" and s.number in numbers]
    out = []
    if refused:
        reasons = "; ".join(f.message.replace(" is not used: ", ": ") for f in refused)
        out.append(f"{len(lost)} of {counted(len(content.sets), 'set')} not used: {reasons}{_to_do(refused)}")
    out += [f"{f.message}{_to_do([f])}" for f in wrong if f not in refused]
    functions_lost = bool(numbers.intersection(_FUNCTIONS)) or len(wrong) > len(refused)
    if functions_lost:
        out.append("whether forces, responses, drive points or coherence are missing is not said: they may be in the damaged part")
    return out, functions_lost


def _to_do(findings: list[Finding]) -> str:
    actions = "; ".join(dict.fromkeys(f.action for f in findings if f.action))
    return f" ({actions})" if actions else ""


def _counted(titles: list[str]) -> list[str]:
    """Titles with the number of sets that share their first words."""
    counts: dict[str, int] = {}
    for title in titles:
        key = " ".join(word for word in title.split() if not any(c.isdigit() for c in word)) or title
        counts[key] = counts.get(key, 0) + 1
    return [f"{n} × {key}" if n > 1 else key for key, n in counts.items()]


def _found(content: Content) -> list[str]:
    out = []
    for r in content.records:
        forces, responses = len(r.force_indices), len(r.response_indices)
        out.append(
            f"time record: {forces} force and {responses} response channels of {len(r.channels)}, {r.sampling_hz:g} Hz, {r.duration_s:g} s"
        )
    for f in content.frfs:
        lines = f.frequencies_hz
        out.append(f"{f.quantity}: {len(f.responses)} responses × {len(f.references)} references, {lines[0]:g} to {lines[-1]:g} Hz")
    for m in content.models:
        beside = f" and {m.n_residuals} residual terms" if m.n_residuals else ""
        out.append(f"modal model: {m.n_modes} modes{beside} at {len(m.dofs)} DOFs, {m.scaling.replace('_', ' ')}")
    if content.geometry is not None:
        g = content.geometry
        out.append(f"geometry: {len(g.nodes)} nodes, {len(g.lines)} lines, {len(g.faces)} faces")
    return out


def _record(r: TimeRecord) -> dict[str, Any]:
    channels = [
        {
            "dof": None if c.dof is None else str(c.dof), "name": c.name, "quantity": c.quantity, "unit": c.unit or None,
            "source_unit": c.source_unit or None, "set": c.set,
        }
        for c in r.channels
    ]  # fmt: skip
    return {
        "sampling_hz": r.sampling_hz, "samples": r.n_samples, "duration_s": r.duration_s, "start_s": r.start_s, "channels": channels,
        "forces": [r.channels[i].label for i in r.force_indices], "responses": [r.channels[i].label for i in r.response_indices],
    }  # fmt: skip


def _frf(f: Frf) -> dict[str, Any]:
    hz = f.frequencies_hz
    measured = ~np.all(np.isnan(f.data), axis=2)
    return {
        "quantity": f.quantity, "si": f.si, "responses": [str(d) for d in f.responses], "references": [str(d) for d in f.references],
        "lines": len(f.axis), "band_hz": [float(hz[0]), float(hz[-1])], "step_hz": f.axis.step, "pairs_measured": int(measured.sum()),
        "coherence": f.coherence is not None, "averages": f.averages,
        "drive_points": [str(f.responses[i]) for i, j in f.drive_points() if measured[i, j]],
    }  # fmt: skip


def _model(m: ModalModel) -> dict[str, Any]:
    return {
        "frequencies_hz": m.frequencies_hz.tolist(), "damping_ratios": m.damping_ratios.tolist(),
        "residual_modes": m.n_residuals, "dofs": [str(d) for d in m.dofs], "scaling": m.scaling, "complex": bool(np.iscomplexobj(m.shapes)),
    }  # fmt: skip


def _geometry(g: Geometry) -> dict[str, Any]:
    return {"nodes": len(g.nodes), "lines": len(g.lines), "faces": len(g.faces), "unit": "m" if g.unit_known else None}


def _missing_of_record(r: TimeRecord, functions_lost: bool) -> list[str]:
    out = []
    if not r.force_indices and not functions_lost:
        out.append("no force channel: usable as operating record only")
    if not r.response_indices and not functions_lost:
        out.append("no response channel with a DOF and a motion quantity: say in [channels] what the channels are")
    unlabelled = [c.name or f"set {c.set}" for c in r.channels if c.dof is None]
    if unlabelled:
        out.append(f"no DOF for {len(unlabelled)} channels ({', '.join(unlabelled[:6])}): give them in [channels]")
    without = sorted({c.quantity for c in r.channels if not c.unit and c.quantity in ("force", "acceleration", "velocity", "displacement")})
    if without:
        out.append(f"no unit for {', '.join(without)}: no scaling to unit modal mass; give it in [units]")
    return out


def _missing_of_frf(f: Frf, functions_lost: bool) -> list[str]:
    out = []
    if not f.si:
        out.append("no units of the FRFs: frequencies and damping only, no scaling to unit modal mass; give them in [units]")
    for name, values in (("FRFs", f.data), ("coherence", f.coherence)):
        if values is not None:
            there = np.isfinite(values)
            if lost := np.count_nonzero(~there & there.any(axis=2, keepdims=True)):  # a pair that was not measured lacks all
                out.append(f"no number at {lost} of {values.size} values of the {name}: export them again, or leave out these lines")
    if functions_lost:
        return out
    if not f.drive_points():
        out.append("no drive point among the FRFs: modes cannot be scaled to unit modal mass")
    if f.coherence is None:
        out.append("no coherence: the variance of the FRF lines is not known")
    elif f.averages is None:
        out.append("no number of averages: the variance of the FRF lines is not known")
    return out


def _drive_point(r: TimeRecord, path: str) -> list[Finding]:
    """Forces that have no sensor at their own DOF."""
    sensed = {c.dof.key for i in r.response_indices if (c := r.channels[i]).dof is not None}
    out = []
    for i in r.force_indices:
        channel = r.channels[i]
        if channel.dof is not None and r.response_indices and channel.dof.key not in sensed:
            out.append(
                Finding(
                    "missing_drive_point", f"no response is measured at the force DOF {channel.dof}", "warning", path, channel.set,
                    str(channel.dof), consequence="with no drive point in any run, modes cannot be scaled to unit modal mass",
                    action="measure the response at the force, or use a run of another reference that does",
                )
            )  # fmt: skip
    return out
