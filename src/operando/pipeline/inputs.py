"""Reading the files of a test: contents with their findings, the inventory, FRFs of several files in one matrix."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.config import State, Test
from operando.data import Finding, Frf, Geometry, Provenance, TimeRecord, file_hash
from operando.dof import Dof
from operando.errors import ConfigError, DataError, MissingError, OperandoError

KEEP_BYTES = 1_500_000_000
"""Records held in memory between stages; beyond, files are read again."""


class Inputs:
    """The files of one test, read when first asked for.

    Findings of all files read so far stand in ``findings`` by file; a file that cannot be read is a finding, not the end.
    """

    def __init__(self, test: Test) -> None:
        self.test = test
        self.findings: dict[Path, list[Finding]] = {}
        self._contents: dict[Path, Any] = {}
        self._hashes: dict[Path, str] = {}

    def hashes(self, files: Sequence[Path]) -> list[tuple[str, str]]:
        """Name and content hash of files."""
        out = []
        for file in files:
            if file not in self._hashes:
                self._hashes[file] = file_hash(file)
            out.append((file.name, self._hashes[file]))
        return out

    def content(self, file: Path) -> Any:
        """Content of a file with its records checked, or None if it cannot be read."""
        if file in self._contents:
            return self._contents[file]
        from operando.io import read

        try:
            content = read(file, units=self._units(file), channels=self.test.channels or None)
        except OperandoError as error:
            self.findings[file] = [unreadable(self.label(file), error)]
            self._contents[file] = None
            return None
        name = self.label(file)
        records = tuple(checked(replace(r, name=name)) for r in content.records)
        content = replace(content, records=records, frfs=tuple(replace(h, name=name) for h in content.frfs))
        found = [*content.findings, *(f for r in records for f in r.findings), *(f for h in content.frfs for f in h.findings)]
        named = [replace(f, file=name) if f.file in (None, "", str(file), file.name) else f for f in found]
        self.findings[file] = list(dict.fromkeys(named))
        held = sum(r.data.nbytes for c in self._contents.values() if c is not None for r in c.records)
        if held + sum(r.data.nbytes for r in records) <= KEEP_BYTES:
            self._contents[file] = content
        return content

    def _units(self, file: Path) -> dict[str, Any] | None:
        units = dict(self.test.units)
        if file == self.test.geometry_file and self.test.geometry_units is not None:
            units["length"] = self.test.geometry_units
        return units or None

    def label(self, file: Path) -> str:
        """Name of a file in all outputs: relative to the test file where it lies below it."""
        folder = None if self.test.path is None else self.test.path.parent
        return file.relative_to(folder).as_posix() if folder is not None and file.is_relative_to(folder) else file.name

    def records(self, state: State, *, force: bool) -> list[TimeRecord]:
        """Records of a state with responses, and with a force if asked for.

        Raises
        ------
        MissingError
            If no file holds such a record.
        """
        found = []
        for file in state.records:
            content = self.content(file)
            for record in () if content is None else content.records:
                if record.response_indices and (record.force_indices or not force):
                    found.append(record)
                else:
                    lacks = "response with a DOF" if not record.response_indices else "force channel"
                    self._note(
                        file,
                        Finding(
                            "unused_record",
                            f"a record without a {lacks} is not used",
                            file=self.label(file),
                            action="label its channels in [channels]",
                        ),
                    )
        if not found:
            what = "force and responses" if force else "responses"
            reasons = [
                f.message
                for file in state.records
                for f in self.findings.get(file, ())
                if f.severity == "error" or f.kind == "unused_record"
            ]
            raise MissingError(
                f"no file holds a record with {what}" + (f": {reasons[0]}" if reasons else ""),
                where=", ".join(p.name for p in state.records[:4]),
                hint="`operando inspect FILE` shows what each channel is taken for; [channels] labels it",
            )
        return found

    def frf(self, state: State) -> Frf:
        """FRFs of all FRF files of a state in one matrix.

        Raises
        ------
        MissingError
            If no file holds FRFs.
        """
        contents = [self.content(file) for file in state.frfs]
        frfs = [h for content in contents if content is not None for h in content.frfs]
        if not frfs:
            raise MissingError(
                "no file holds frequency response functions",
                where=", ".join(p.name for p in state.frfs[:4]),
                hint="UFF 58 of function type 4; raw time histories belong to records",
            )
        return merge_frfs(frfs)

    def geometry(self) -> Geometry | None:
        """Geometry of the geometry file, else the first one found in any file; coordinates in m where the unit is known, directions of
        DOFs that are no axes as declared."""
        found = self._geometry()
        return found if found is None or not self.test.directions else replace(found, directions=self.test.directions)

    def check_directions(self) -> None:
        """Every DOF in [directions] must be in the data.

        Raises
        ------
        ConfigError
            If one is not; the nearest is named.
        """
        measured: dict[str, None] = {}
        for file in self.test.files if self.test.directions else ():
            content = self.content(file)
            if content is not None:
                dofs = [c.dof for r in content.records for c in r.channels if c.dof is not None]
                dofs += [d for h in content.frfs for d in (*h.responses, *h.references)]
                measured |= dict.fromkeys(str(d.unsigned) for d in dofs)
        for label in self.test.directions:
            if label not in measured:
                near = difflib.get_close_matches(label, measured, 1, 0.3)
                raise ConfigError(
                    f"DOF {label} is in no file" + (f"; the nearest measured one is {near[0]}" if near else ""),
                    where="[directions]",
                    hint="label a channel with it in [channels], or take it out of [directions]",
                )

    def _geometry(self) -> Geometry | None:
        test = self.test
        files = [test.geometry_file] if test.geometry_file is not None else list(test.files)
        for file in files:
            content = self.content(file)
            if content is not None and content.geometry is not None:
                geometry: Geometry = content.geometry
                if not geometry.unit_known and test.geometry_units is not None:
                    from operando.units import si_factor

                    factor = si_factor(test.geometry_units, "displacement")
                    geometry = replace(geometry, coordinates=geometry.coordinates * factor, unit_known=True)
                return geometry
        if test.geometry_file is not None and self.findings.get(test.geometry_file) == []:
            self._note(
                test.geometry_file,
                Finding(
                    "no_geometry", "the geometry file holds no nodes", file=test.geometry_file.name, action="UFF 15 or 2411 is expected"
                ),
            )
        return None

    def inventory(self) -> list[dict[str, Any]]:
        """One row a file: what it is used for, format, sets, channels, sampling, duration, findings."""
        test = self.test
        rows = []
        uses = {"idle": test.idle.files, "operating": test.operating.files, "check": test.check.files}
        for file in test.files:
            content = self.content(file)
            used_for = [name for name, files in uses.items() if file in files] or ["geometry"]
            row: dict[str, Any] = {"file": self.label(file), "sha256": self.hashes([file])[0][1], "used_for": ", ".join(used_for)}
            if content is None:
                row |= {"format": None, "error": self.findings[file][0].message}
            else:
                row |= inventory_row(content)
            rows.append(row | {"n_findings": len(self.findings.get(file, ()))})
        return rows

    def all_findings(self) -> list[Finding]:
        """Findings of all files read so far, in the order of the test, each once."""
        return list(dict.fromkeys(f for file in self.test.files for f in self.findings.get(file, ())))

    def _note(self, file: Path, finding: Finding) -> None:
        notes = self.findings.setdefault(file, [])
        if finding not in notes:
            notes.append(finding)


def inventory_row(content: Any) -> dict[str, Any]:
    """What one file holds, for the inventory."""
    status = [s.status for s in content.sets]
    row: dict[str, Any] = {
        "format": content.format,
        "sets": len(status),
        "used": status.count("used"),
        "ignored": status.count("ignored"),
        "not_understood": status.count("not understood"),
        "set_types": sorted({s.number for s in content.sets if s.number}),
        "geometry_nodes": 0 if content.geometry is None else len(content.geometry.nodes),
        "models": len(content.models),
    }
    if content.records:
        first: TimeRecord = max(content.records, key=lambda r: r.data.size)
        row |= {
            "sampling_hz": first.sampling_hz,
            "duration_s": first.duration_s,
            "samples": first.n_samples,
            "channels": [
                {
                    "dof": None if c.dof is None else str(c.dof),
                    "quantity": c.quantity,
                    "unit": c.unit,
                    "source_unit": c.source_unit,
                    "name": c.name,
                }
                for c in first.channels
            ],
            "forces": [first.channels[i].label for i in first.force_indices],
            "responses": [first.channels[i].label for i in first.response_indices],
        }
    if content.frfs:
        row |= {
            "frf_references": list(dict.fromkeys(str(d) for h in content.frfs for d in h.references)),
            "frf_responses": list(dict.fromkeys(str(d) for h in content.frfs for d in h.responses)),
            "frf_band_hz": [float(min(h.frequencies_hz[0] for h in content.frfs)), float(max(h.frequencies_hz[-1] for h in content.frfs))],
            "frf_lines": max(len(h.axis) for h in content.frfs),
        }
    return row


def checked(record: TimeRecord) -> TimeRecord:
    """The record with what the raw-data checks find."""
    try:
        from operando.quality import check_record
    except ImportError:
        return record
    return check_record(record)


def unreadable(name: str, error: OperandoError) -> Finding:
    """A file that cannot be read, as a finding."""
    return Finding(
        "unreadable",
        f"cannot be read: {error.message}",
        "error",
        file=name,
        consequence="the file is not used",
        action=error.hint or "export it again, or take it out of the test file",
    )


def merge_frfs(frfs: Sequence[Frf]) -> Frf:
    """One matrix of FRFs measured reference by reference; NaN where a pair was not measured.

    Parameters
    ----------
    frfs : sequence of Frf
        On the same lines; brought to the quantity of the first one. Of a pair measured twice the first one counts.

    Raises
    ------
    DataError
        If the lines differ.
    """
    first = frfs[0]
    if len(frfs) == 1:
        return first
    axis = first.frequencies_hz
    findings: list[Finding] = [f for h in frfs for f in h.findings]
    same = []
    for h in frfs:
        if len(h.axis) == axis.size and np.allclose(
            h.frequencies_hz, axis, rtol=1e-9, atol=1e-6 * (axis[-1] - axis[0]) / max(axis.size, 1)
        ):
            same.append(h.to_quantity(first.quantity))
        else:
            raise DataError(
                f"FRFs on different lines: {axis.size} lines to {axis[-1]:g} Hz and {len(h.axis)} lines to {h.frequencies_hz[-1]:g} Hz",
                where=h.name or None,
                hint="use FRFs of one frequency resolution",
            )
    responses: dict[tuple[int, str], Dof] = {}
    references: dict[tuple[int, str], Dof] = {}
    for h in same:
        for d in h.responses:
            responses.setdefault((d.node, d.axis), d)
        for d in h.references:
            references.setdefault((d.node, d.axis), d)
    row = {key: i for i, key in enumerate(responses)}
    column = {key: j for j, key in enumerate(references)}
    shape = (len(row), len(column), axis.size)
    data = np.full(shape, np.nan, complex)
    variance = np.full(shape, np.nan) if any(h.variance is not None for h in same) else None
    coherence = np.full(shape, np.nan) if any(h.coherence is not None for h in same) else None
    twice: list[str] = []
    for h in same:
        for a, d in enumerate(h.responses):
            for b, e in enumerate(h.references):
                if np.all(np.isnan(h.data[a, b].real)):
                    continue
                i, j = row[d.node, d.axis], column[e.node, e.axis]
                if not np.all(np.isnan(data[i, j].real)):
                    twice.append(f"{d}/{e}")
                    continue
                sign = d.sign * responses[d.node, d.axis].sign * e.sign * references[e.node, e.axis].sign
                data[i, j] = sign * h.data[a, b]
                if variance is not None and h.variance is not None:
                    variance[i, j] = h.variance[a, b]
                if coherence is not None and h.coherence is not None:
                    coherence[i, j] = h.coherence[a, b]
    if twice:
        shown = ", ".join(twice[:6]) + (" …" if len(twice) > 6 else "")
        findings.append(
            Finding(
                "duplicate_pair", f"{len(twice)} pairs are given twice ({shown}); the first one is used", "warning", action="keep one file"
            )
        )
    return Frf(
        data,
        first.axis,
        tuple(responses.values()),
        tuple(references.values()),
        first.quantity,
        variance=variance,
        coherence=coherence,
        averages=first.averages,
        si=all(h.si for h in same),
        exponential_window_rate=first.exponential_window_rate,
        name=first.name,
        findings=tuple(dict.fromkeys(findings)),
        provenance=Provenance.merge(*(h.provenance for h in same)).then("merge_frfs"),
    )
