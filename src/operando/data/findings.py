"""Findings: what was noticed about data, with consequence and advice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from operando.errors import DataError

Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One annotation of the data; nothing is deleted silently.

    Parameters
    ----------
    kind : str
        One of the kinds of the contract (``overload``, ``double_hit``, …) or a new one.
    message : str
        What was found, in one sentence with numbers and units.
    severity : {"info", "warning", "error"}
    file, set, dof : optional
        Where: file name, set index in the file (from 0), DOF or channel label.
    time_s, band_hz : (float, float), optional
        Interval [s] or frequency band [Hz] concerned.
    consequence, action : str
        What it does to the results (or what was done about it), and what the user can do.
    """

    kind: str
    message: str
    severity: Severity = "warning"
    file: str | None = None
    set: int | None = None
    dof: str | None = None
    time_s: tuple[float, float] | None = None
    band_hz: tuple[float, float] | None = None
    consequence: str = ""
    action: str = ""

    def __post_init__(self) -> None:
        if self.severity not in ("info", "warning", "error"):
            raise DataError(f"severity {self.severity!r} is none of info, warning, error")

    def to_dict(self) -> dict[str, object]:
        """JSON object as in the contract."""
        out: dict[str, object] = {
            "kind": self.kind,
            "severity": self.severity,
            "file": self.file,
            "set": self.set,
            "dof": self.dof,
        }
        if self.time_s is not None:
            out["time_s"] = list(self.time_s)
        if self.band_hz is not None:
            out["band_hz"] = list(self.band_hz)
        out |= {"consequence": self.consequence, "action": self.action, "message": self.message}
        return out

    @classmethod
    def from_dict(cls, d: dict) -> Finding:
        """Inverse of :meth:`to_dict`."""
        kw = dict(d)
        for key in ("time_s", "band_hz"):
            if kw.get(key) is not None:
                kw[key] = tuple(kw[key])
        return cls(**kw)
