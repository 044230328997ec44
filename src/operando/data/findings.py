"""Findings: what was noticed about data, with consequence and advice."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from operando.data.declared import check_fields
from operando.errors import DataError
from operando.printable import first_few

Severity = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One annotation of the data; nothing is deleted silently.

    Parameters
    ----------
    kind : str
        What it is, in one word (``overload``, ``double_hit``, …).
    message : str
        What was found, in one sentence with numbers and units.
    severity : {"info", "warning", "error"}
    file, set, dof : optional
        Where: file name, set index in the file (from 0), DOF or channel label.
    time_s, band_hz : (float, float), optional
        Interval [s] or frequency band [Hz] concerned.
    consequence, action : str
        What it does to the results (or what was done about it), and what the user can do.

    Examples
    --------
    >>> import operando
    >>> operando.Finding("overload", "3 samples at full scale", "warning", dof="1+Z").to_dict()["severity"]
    'warning'
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
        check_fields(self)
        if self.severity not in ("info", "warning", "error"):
            raise DataError(f"severity {self.severity!r} is none of info, warning, error")

    def to_dict(self) -> dict[str, object]:
        """JSON object as it stands in ``summary.json``."""
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
    def from_dict(cls, d: dict[str, Any]) -> Finding:
        """Inverse of :meth:`to_dict`."""
        kw = dict(d)
        for key in ("time_s", "band_hz"):
            if kw.get(key) is not None:
                kw[key] = tuple(kw[key])
        return cls(**kw)


ALIKE = 3
"""Findings that differ in file, DOF and numbers alone are grouped from this number on; one or two are easier read apart."""

SHOWN = 3
"""Names shown of a group."""


def once_of_a_sense(findings: Iterable[Finding]) -> list[Finding]:
    """The findings of a test without what each file says again of a drive point whose polarity the fit of the modes reversed."""
    found = list(findings)
    reversed_at = {f.dof for f in found if f.kind == "drive_point_sign" and f.severity == "error"}
    return [f for f in found if not (f.kind == "inverted" and f.dof in reversed_at and "drive point" in f.message)]


def group_findings(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in their order, each once, with those that are alike (but for files, DOFs and numbers) as one that counts them.

    A group takes the words of its first member and names how many there are, and the first few files or DOFs.

    Parameters
    ----------
    findings : sequence of Finding
        Findings of one object or file, or of several.

    Returns
    -------
    list of Finding

    Examples
    --------
    >>> finding = Finding("overload", "3 samples at full scale", "warning", file="run1.uff")
    >>> len(group_findings([finding, finding]))
    1
    """
    groups: dict[tuple[object, ...], list[Finding]] = {}
    for finding in dict.fromkeys(findings):
        groups.setdefault(_likeness(finding, finding.message), []).append(finding)
    return [f for group in groups.values() for f in ([_grouped(group)] if len(group) >= ALIKE else group)]


def with_further(findings: Sequence[Finding], further: Iterable[Finding]) -> list[Finding]:
    """The findings, then those further ones that are not among them and are not counted in a group of them (:func:`group_findings`)."""
    counted = {_likeness(f, f.message[: group.start()]) for f in findings if (group := _GROUP.search(f.message))}
    return list(dict.fromkeys([*findings, *(f for f in further if _likeness(f, f.message) not in counted)]))


_GROUP = re.compile(r" \[(?:alike|the same) \d+ times.*\]$")
"""What :func:`_grouped` puts behind the message of its first member."""


def _likeness(finding: Finding, message: str) -> tuple[object, ...]:
    """What findings of one group share."""
    return (finding.kind, finding.severity, *(_masked(text) for text in (message, finding.consequence, finding.action)))


def _masked(text: str) -> str:
    """The text without words that hold numbers: numbers, DOF labels, names of files and channels with one."""
    words = (re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?([+-]R?[XYZ])?", "#", word) for word in text.split())
    return " ".join("#" if "#" in word else word for word in words)


def _grouped(group: list[Finding]) -> Finding:
    first = group[0]
    parts = []
    for names, what in ((_names(f.file for f in group), "files"), (_names(f.dof for f in group), "DOFs")):
        if len(names) > 1:
            shown = first_few(names, SHOWN)
            parts.append(f"{len(names)} {what} ({shown})")
    where = " in " + " and ".join(parts) if parts else ""
    word = "the same" if len({f.message for f in group}) == 1 else "alike"
    same = lambda values: len(set(values)) == 1  # noqa: E731
    return replace(
        first,
        message=f"{first.message} [{word} {len(group)} times{where}]",
        file=first.file if same(f.file for f in group) else None,
        set=first.set if same(f.set for f in group) else None,
        dof=first.dof if same(f.dof for f in group) else None,
        time_s=first.time_s if same(f.time_s for f in group) else None,
        band_hz=first.band_hz if same(f.band_hz for f in group) else None,
    )


def _names(values: Iterable[str | None]) -> list[str]:
    return [v for v in dict.fromkeys(values) if v]
