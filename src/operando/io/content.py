"""What reading a file gives: objects, an inventory of its sets, findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from operando.data import Finding, Frf, Geometry, ModalModel, Short, TimeRecord, counted, names_text

Status = Literal["used", "ignored", "not understood"]


@dataclass(frozen=True)
class SetInfo:
    """One set (UFF) or variable, group, table (other formats) of a file.

    Parameters
    ----------
    index : int
        Position in the file, from 0.
    number : int
        UFF set type (58, 15, …); 0 for other formats.
    title : str
        What it is, in words: function type and DOFs for measured functions.
    status : {"used", "ignored", "not understood"}
    note : str
        Reason where it was not used, and remarks.
    raw : bytes
        The bytes of a set that was not understood or not used, for passing it on unchanged; of a unit set (UFF 164) always.
    """

    index: int
    number: int
    title: str
    status: Status = "used"
    note: str = ""
    raw: bytes = field(default=b"", repr=False)

    def to_dict(self) -> dict[str, Any]:
        """JSON object."""
        return {"index": self.index, "type": self.number, "title": self.title, "status": self.status, "note": self.note}


@dataclass(frozen=True)
class FileHeader:
    """What a file says of itself (UFF 151), texts as they stand there.

    Parameters
    ----------
    name, description : str
        Of the model or test.
    program, created, saved : str
        Program that made the database, when it was made, when it was last saved.
    writer, written : str
        Program that wrote the file, and when. Dates may be in the form of ISO 8601; a writer brings them into that of its format.
    """

    name: str = ""
    description: str = ""
    program: str = ""
    created: str = ""
    saved: str = ""
    writer: str = ""
    written: str = ""


@dataclass(frozen=True, repr=False, eq=False)
class Content(Short):
    """Everything found in one file.

    Parameters
    ----------
    path : str
    format : str
        ``uff``, ``hdf5``, ``matlab``, ``csv``, ``lvm``, ``tdms``, ``npy``, ``npz``, ``wav`` or ``sep005``.
    records : tuple of TimeRecord
        One for each sampling rate and length in the file (normally one: one file is one run).
    frfs : tuple of Frf
        One for each quantity and frequency axis.
    models : tuple of ModalModel
    geometry : Geometry or None
    sets : tuple of SetInfo
        Inventory: what was used, ignored, not understood.
    findings : tuple of Finding
    header : FileHeader or None
        What the file says of itself.
    unkept : tuple of str
        What the file says and none of the objects holds, in words: a conversion names it.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.uff", frf)
    ...     content = operando.read(f"{folder}/frf.uff")
    >>> content.format, len(content.frfs), len(content.records)
    ('uff', 1, 0)
    """

    path: str
    format: str
    records: tuple[TimeRecord, ...] = ()
    frfs: tuple[Frf, ...] = ()
    models: tuple[ModalModel, ...] = ()
    geometry: Geometry | None = None
    sets: tuple[SetInfo, ...] = ()
    findings: tuple[Finding, ...] = ()
    header: FileHeader | None = None
    unkept: tuple[str, ...] = ()

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        held = [
            counted(len(part), noun)
            for part, noun in ((self.records, "record"), (self.frfs, "FRF matrix"), (self.models, "modal model"))
            if part
        ]
        unused = [s for s in self.sets if s.status != "used"]
        return {
            "File": f"{self.path} ({self.format})",
            "Holds": ", ".join(held + (["a geometry"] if self.geometry is not None else [])) or "nothing that is used",
            "Records": names_text(r.name for r in self.records),
            "Not used": f"{counted(len(unused), 'set')} not used" if unused else "",
            "Findings": counted(len(self.findings), "finding") if self.findings else "",
        }

    @property
    def objects(self) -> tuple[Any, ...]:
        """Geometry, records, FRFs and models, in this order."""
        head = () if self.geometry is None else (self.geometry,)
        return (*head, *self.records, *self.frfs, *self.models)
