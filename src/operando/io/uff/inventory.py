"""What becomes of each set while a file is read: status, reason, findings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from operando.data import Finding, Provenance
from operando.errors import FormatError
from operando.io.content import SetInfo, Status
from operando.io.quantities import ChannelSpecs, Units, UnitSystem
from operando.io.uff.components import NodeNumbers
from operando.io.uff.split import RawSet
from operando.io.uff.textform import Buffer

SET_NAMES = {
    15: "nodes", 18: "coordinate systems", 55: "data at nodes", 58: "function", 82: "trace lines", 151: "header", 164: "units",
    773: "material", 1858: "qualifiers of functions", 2400: "model header", 2411: "nodes", 2412: "elements", 2414: "analysis data",
    2420: "coordinate systems", 2429: "groups", 2435: "groups", 2467: "groups", 2477: "groups",
}  # fmt: skip

T = TypeVar("T")


@dataclass
class Inventory:
    """Notes taken during the reading of one file (not public: the reader turns it into a ``Content``)."""

    file: str
    buffer: Buffer
    sets: list[RawSet]
    units: Units
    channels: ChannelSpecs
    provenance: Provenance
    systems: dict[int, UnitSystem] = field(default_factory=dict)
    status: dict[int, tuple[Status, str, str]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    unkept: list[str] = field(default_factory=list)
    node_numbers: NodeNumbers = field(default_factory=NodeNumbers)

    def use(self, raw: RawSet, title: str, note: str = "") -> None:
        """The set is used."""
        self.status[raw.index] = ("used", title, "; ".join((*raw.notes, *([note] if note else []))))

    def ignore(self, raw: RawSet, title: str, reason: str) -> None:
        """The set is understood, and not needed or not wanted."""
        self.status[raw.index] = ("ignored", title, reason)

    def refuse(self, raw: RawSet, title: str, reason: str) -> None:
        """The set is damaged or of a kind that cannot be read; an error finding says so."""
        self.status[raw.index] = ("not understood", title, reason)
        self.damaged.append(f"set {raw.index} ({title}): {reason}")
        kind = "truncated" if "declares" in reason else "unknown_set"
        self.note(
            kind, f"set {raw.index} ({title}) is not used: {reason}", raw, severity="error",
            consequence="its data are missing from every result", action="export the file again, or take the set from another format",
        )  # fmt: skip

    def attempt(self, raw: RawSet, reader: Callable[[bytes], T]) -> T | None:
        """What a reader makes of the bytes of a set, or None: then it is kept as not understood, and a finding says why."""
        try:
            return reader(raw.raw(self.buffer))
        except FormatError as error:
            self.status[raw.index] = ("not understood", title_of(raw), error.message)
            self.note(
                "unknown_set", f"set {raw.index} of type {raw.number} ({title_of(raw)}) is not understood: {error.message}", raw,
                consequence="it is not used; a conversion to UFF passes it on as it is",
            )  # fmt: skip
            return None

    def note(self, kind: str, message: str, raw: RawSet | None = None, dof: str | None = None, severity: str = "warning",
             consequence: str = "", action: str = "") -> None:  # fmt: skip
        """Add a finding."""
        self.findings.append(
            Finding(kind, message, severity, self.file, None if raw is None else raw.index, dof, consequence=consequence, action=action)  # type: ignore[arg-type]
        )

    def system_at(self, index: int) -> UnitSystem | None:
        """Unit set 164 in force for a set: the last one before it, else the first of the file."""
        before = [i for i in self.systems if i < index]
        if before:
            return self.systems[max(before)]
        return self.systems[min(self.systems)] if self.systems else None

    def set_infos(self) -> tuple[SetInfo, ...]:
        """Inventory of all sets; the bytes of those not used are kept, and of the unit sets, which say what the others mean."""
        out = []
        for raw in self.sets:
            status, title, note = self.status.get(raw.index, ("not understood", title_of(raw), "no reader for this type"))
            kept = b"" if status == "used" and raw.number != 164 else raw.raw(self.buffer)
            out.append(SetInfo(raw.index, raw.number, title, status, note, kept))
        return tuple(out)


def title_of(raw: RawSet) -> str:
    """Name of a set in words."""
    if raw.header is not None:
        return raw.header.title
    return SET_NAMES.get(raw.number, "unknown")
