"""Reading the files of a test: contents with their findings, the inventory."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from operando.config import Span, State, Test
from operando.data import Finding, Frf, Geometry, MappedSamples, TimeRecord, file_hash, group_findings
from operando.errors import DataError, MissingError, OperandoError
from operando.io.quantities import Asked
from operando.pipeline.names import Names, UnfitTest, blamed, check_geometry, check_names, names_of

KEEP_BYTES = 1_500_000_000
"""Records held in memory between stages; beyond, files are read again."""

SHOWN_RECORDS = 6
"""Records of a state whose look is kept for the report: as many rows as a screen shows."""


class Inputs:
    """The files of one test, read when first asked for.

    Findings of all files read so far stand in ``findings`` by file; a file that cannot be read is a finding, not the end.
    """

    def __init__(self, test: Test) -> None:
        self.test = test
        self.findings: dict[Path, list[Finding]] = {}
        self._contents: dict[tuple[Path, Span | None], Any] = {}
        self._hashes: dict[Path, str] = {}
        self._channels = Asked(test.channels)
        self._names: dict[Path, Names] = {}
        self.raw: list[Any] = []

    def hashes(self, files: Sequence[Path]) -> list[tuple[str, str]]:
        """Name and content hash of files."""
        out = []
        for file in files:
            if file not in self._hashes:
                self._hashes[file] = file_hash(file)
            out.append((file.name, self._hashes[file]))
        return out

    def content(self, file: Path, span: Span | None = None) -> Any:
        """Content of a file with its records cut to a span and checked, or None if it cannot be read.

        Raises an UnfitTest if the span lies outside a record, or the file can be read but for what the test file says of its units or
        channels.
        """
        if (file, span) in self._contents:
            return self._contents[file, span]
        from operando.io import read
        from operando.quality import check_record

        try:
            content = read(file, units=self._units(file), channels=self._channels)
        except OperandoError as error:
            if (fault := blamed(self.test, file, self._units(file), error)) is not None:
                raise fault from None
            self.findings[file] = [unreadable(self.label(file), error)]
            self._contents[file, span] = None
            return None
        self._names[file] = names_of(content)
        name = self.test.label(file, span)
        records = tuple(check_record(_trimmed(replace(self._part(r, file, span), name=name))) for r in content.records)
        content = replace(content, records=records, frfs=tuple(replace(h, name=name) for h in content.frfs))
        found = [
            *content.findings,
            *(f for r in records for f in r.findings),
            *(f for h in content.frfs for f in h.findings),
        ]
        named = [replace(f, file=name) if f.file in (None, "", str(file), file.name) else f for f in found]
        self.findings[file] = list(dict.fromkeys([*self.findings.get(file, ()), *named]))
        kept = [r for c in self._contents.values() if c is not None for r in c.records]
        if sum(r.data.nbytes for r in (*kept, *records) if not isinstance(r.data, MappedSamples)) <= KEEP_BYTES:
            self._contents[file, span] = content
        return content

    def _part(self, record: TimeRecord, file: Path, span: Span | None) -> TimeRecord:
        """The part of a record that the test file says counts."""
        if span is None:
            return record
        try:
            return record.cut(span.start_s, span.stop_s)
        except DataError as error:
            where = f"{self.test.where(self._state_of(file), 'records')}: {self.label(file)}"
            raise UnfitTest(error.message, where=where, hint="start_s and stop_s count on the time axis of the file") from None

    def _units(self, file: Path) -> dict[str, Any] | None:
        units = dict(self.test.units)
        if file == self.test.geometry_file and self.test.geometry_units is not None:
            units["length"] = self.test.geometry_units
        return units or None

    def unread(self) -> list[str]:
        """States with files none of which could be read, of those asked for so far."""
        failed = {file for (file, _), content in self._contents.items() if content is None}
        return [name for name, state in self.test.states.items() if state and failed.issuperset(state.files)]

    def _state_of(self, file: Path) -> str:
        return next((name for name, state in self.test.states.items() if file in state.files), "geometry")

    def label(self, file: Path) -> str:
        """Name of a file in all outputs."""
        return self.test.label(file)

    def records(self, state: State, *, force: bool) -> list[TimeRecord]:
        """Records of a state with responses, and with a force if asked for, with the channels that every stage uses.

        Which these are is decided here, once (:func:`operando.frf.usable_channels`); what is left out stands in ``findings``.
        """
        found = []
        for file, span in state.runs:
            content = self.content(file, span)
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
                f"{self.label(file)}: {f.message}" if len(state.records) > 1 else f.message
                for file in state.records
                for f in self.findings.get(file, ())
                if f.severity == "error" or f.kind == "unused_record"
            ]
            raise MissingError(
                f"no file holds a record with {what}" + (f": {reasons[0]}" if reasons else ""),
                where=", ".join(p.name for p in state.records[:4]),
                hint=self._other_key(state.records, "frfs")
                or "`operando inspect FILE` shows what each channel is taken for; [channels] labels it",
            )
        return self._usable(state, found)

    def _other_key(self, files: Sequence[Path], key: str) -> str | None:
        """What to do where the files of a state hold what belongs to its other key."""
        contents = [self.content(file) for file in files]
        if not any(getattr(content, key) for content in contents if content is not None):
            return None
        return f"the files hold {'FRFs' if key == 'frfs' else 'time records'}: name them in {key}"

    def _usable(self, state: State, records: list[TimeRecord]) -> list[TimeRecord]:
        """The records without the channels that cannot be used; the finding that says so takes the place of those about single files."""
        from operando.frf import usable_channels

        usable, left_out = usable_channels(records)
        files = {self.test.label(file, span): file for file, span in state.runs}
        for finding in left_out:
            if finding.dof is not None:
                for file in files.values():
                    rest = [f for f in self.findings.get(file, ()) if not (f.kind in ("nan", "flat") and f.dof == finding.dof)]
                    self.findings[file] = rest
            self._note(files.get(finding.file or "", state.records[0]), finding)
        return usable

    def frf(self, state: State) -> Frf:
        """FRFs of all FRF files of a state in one matrix."""
        contents = [self.content(file) for file in state.frfs]
        frfs = [h for content in contents if content is not None for h in content.frfs]
        if not frfs:
            raise MissingError(
                "no file holds frequency response functions",
                where=", ".join(p.name for p in state.frfs[:4]),
                hint=self._other_key(state.frfs, "records") or "UFF 58 of function type 4; raw time histories belong to records",
            )
        from operando.frf import merge_frfs

        return merge_frfs(frfs)

    def geometry(self) -> Geometry | None:
        """Geometry of the geometry file, else the first one found in any file; coordinates in m where the unit is known, nodes with the
        components that the DOFs name, directions of DOFs that are no axes as declared."""
        found = self._geometry()
        if found is not None:
            found, unclear = found.with_components(dof for names in self._names.values() for dof in names.dofs)
            if unclear:
                file = self.test.geometry_file or self.test.files[0]
                numbers = ", ".join(str(n) for n in unclear[:8])
                self._note(file, Finding(
                    "unclear_component", f"nodes {numbers} of the geometry may belong to more than one component", file=self.label(file),
                    consequence="the DOFs there are not drawn", action="number the nodes of all components differently",
                ))  # fmt: skip
        return found if found is None or not self.test.directions else replace(found, directions=self.test.directions)

    def _geometry(self) -> Geometry | None:
        test = self.test
        parts = [(test.geometry_file, None)] if test.geometry_file is not None else list(test.parts)
        for file, span in parts:
            content = self.content(file, span)
            if content is not None and content.geometry is not None:
                geometry: Geometry = content.geometry
                if not geometry.unit_known and test.geometry_units is not None:
                    from operando.units import si_factor

                    factor = si_factor(test.geometry_units, "displacement")
                    geometry = replace(geometry, coordinates=geometry.coordinates * factor, unit_known=True)
                return geometry
        if test.geometry_file is not None and self.findings.get(test.geometry_file) == []:
            action = "UFF 15 or 2411 is expected, or a table with the columns node, x, y, z"
            name = test.geometry_file.name
            self._note(test.geometry_file, Finding("no_geometry", "the geometry file holds no nodes", file=name, action=action))
        return None

    def inventory(self) -> list[dict[str, Any]]:
        """One row a file (or part of it): what it is used for, format, sets, channels, sampling, duration, findings."""
        test = self.test
        rows = []
        self.raw = []
        uses = {name: (*state.runs, *((file, None) for file in state.frfs)) for name, state in test.states.items()}
        for file, span in test.parts:
            content = self.content(file, span)
            used_for = [name for name, parts in uses.items() if (file, span) in parts] or ["geometry"]
            row: dict[str, Any] = {"file": test.label(file, span), "sha256": self.hashes([file])[0][1], "used_for": ", ".join(used_for)}
            if content is None:
                row |= {"format": None, "error": self.findings[file][0].message}
            else:
                row |= inventory_row(content)
                self.raw += self._overviews(content, used_for[0])
            if span is not None:
                row |= {"start_s": span.start_s, "stop_s": span.stop_s}
            rows.append(row | {"n_findings": len(self.findings.get(file, ()))})
        return rows

    def _overviews(self, content: Any, state: str) -> list[Any]:
        """What the records of a file look like, of the first files of a state."""
        from operando.quality import overview

        seen = sum(raw.state == state for raw in self.raw)
        records = [r for r in content.records if r.force_indices or r.response_indices]
        return [overview(record, state) for record in records[: max(0, SHOWN_RECORDS - seen)]]

    def check_names(self) -> None:
        """Whether every name and frequency in the test file is in the files (see :func:`operando.pipeline.names.check_names`).

        Raises an UnfitTest if one is not; the nearest is named.
        """
        for part in self.test.parts:
            if part[0] not in self._names:
                self.content(*part)
        check_names(self.test, self._names, self._channels.found)

    def check_geometry(self, geometry: Geometry | None) -> list[Finding]:
        """Findings about measured nodes without a position (see :func:`operando.pipeline.names.check_geometry`)."""
        return check_geometry(self.test, geometry, self._names)

    def check_hits(self, inventory: Sequence[dict[str, Any]]) -> None:
        """Whether every hit that the test file rejects is there."""
        from operando.frf.hits import rejected_numbers

        counts = {row["file"]: len(row.get("hits") or ()) for row in inventory}
        for state in (self.test.idle, self.test.check):
            try:
                rejected_numbers(list(counts), list(counts.values()), self.test.rejected_hits(state))
            except DataError as error:
                raise UnfitTest(error.message, where=self.test.where("analysis", "hits_reject"), hint=error.hint) from None

    def all_findings(self) -> list[Finding]:
        """Findings of all files read so far, in the order of the test, each once; with what is left out of each state."""
        from operando.quality import check_states

        found = {}
        for name, state in self.test.states.items():
            if state.records:
                with suppress(OperandoError):  # the stage that needs the records says what is wrong
                    found[name] = self.records(state, force=name != "operating")
        return group_findings([*(f for file in self.test.files for f in self.findings.get(file, ())), *check_states(found)])

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
        if hits := list_hits(content.records):
            row["hits"] = hits
    if content.frfs:
        row |= {
            "frf_references": list(dict.fromkeys(str(d) for h in content.frfs for d in h.references)),
            "frf_responses": list(dict.fromkeys(str(d) for h in content.frfs for d in h.responses)),
            "frf_band_hz": [float(min(h.frequencies_hz[0] for h in content.frfs)), float(max(h.frequencies_hz[-1] for h in content.frfs))],
            "frf_lines": max(len(h.axis) for h in content.frfs),
        }
    return row


def list_hits(records: Sequence[TimeRecord]) -> list[dict[str, Any]]:
    """The hits of the hammer records of one file, numbered as ``hits_reject`` names them."""
    from operando.frf import hits_of

    out: list[dict[str, Any]] = []
    for record in records:
        hits = hits_of(record) if record.response_indices else None
        if hits is not None:
            unit = record.channels[record.force_indices[0]].unit
            for t, level in zip(hits.times_s + record.start_s, hits.levels, strict=True):
                out.append({"number": len(out), "time_s": float(t), "peak": float(level), "unit": unit})
    return out


def _trimmed(record: TimeRecord) -> TimeRecord:
    """The record without ends at which no channel holds a number; the finding stands with it."""
    from operando.frf import trimmed

    cut, findings = trimmed(record)
    return cut.with_findings(findings) if findings else record


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
