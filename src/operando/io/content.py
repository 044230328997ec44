"""What reading a file gives: objects, an inventory of its sets, findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from operando.data import Finding, Frf, Geometry, ModalModel, TimeRecord

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
        The bytes of a set that was not understood or not used, for passing it on unchanged.
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
class Content:
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
    """

    path: str
    format: str
    records: tuple[TimeRecord, ...] = ()
    frfs: tuple[Frf, ...] = ()
    models: tuple[ModalModel, ...] = ()
    geometry: Geometry | None = None
    sets: tuple[SetInfo, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def objects(self) -> tuple[Any, ...]:
        """Geometry, records, FRFs and models, in this order."""
        head = () if self.geometry is None else (self.geometry,)
        return (*head, *self.records, *self.frfs, *self.models)
