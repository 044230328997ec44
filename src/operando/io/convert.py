"""Conversion between formats; what a format cannot hold is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.atomic import refuse_source
from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.errors import FormatError
from operando.io.content import Content, FileHeader, SetInfo
from operando.io.detect import read
from operando.io.quantities import ChannelSpecs, Units
from operando.paths import path_of
from operando.printable import printable

_SUFFIXES = {
    ".uff": "uff", ".unv": "uff", ".uf": "uff", ".bunv": "uff", ".asc": "uff", ".h5": "hdf5", ".hdf5": "hdf5", ".hdf": "hdf5",
    ".mat": "matlab", ".csv": "csv", ".txt": "csv",
}  # fmt: skip

NAMES = {TimeRecord: "record", Frf: "frf", ModalModel: "model", Geometry: "geometry"}
"""Group of each noun in an HDF5 file."""


def convert(
    source: str | Path,
    target: str | Path,
    *,
    units: Units | None = None,
    channels: ChannelSpecs | None = None,
    binary: bool = True,
) -> dict[str, Any]:
    """Convert a file; the format of the target follows from its name (.uff, .unv, .h5, .mat, .csv).

    Parameters
    ----------
    source, target : paths
        File to read.
    units, channels : mappings, optional
        As for :func:`operando.io.read`.
    binary : bool
        UFF: 58b or ASCII.

    Returns
    -------
    dict
        ``in, out, format_in, format_out, written`` (texts), ``passed_on`` (sets kept as they were), ``lost`` (texts), ``findings``.

    Raises
    ------
    FormatError
        If the source holds nothing that the target format can take, or the name of the target tells no format.
    WriteError
        If the target is the source, or cannot be written.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.uff", frf)
    ...     convert(f"{folder}/frf.uff", f"{folder}/frf.h5")["format_out"]
    'hdf5'
    """
    target = path_of(target, "a file is written to its path")
    kind = format_of(target)
    refuse_source(target, source)
    content = read(source, units=units, channels=channels)
    passed = [s for s in content.sets if s.raw and s.status != "used"] if kind == "uff" and content.format == "uff" else []
    kept = [obj for obj in content.objects if holds(kind, obj)]
    if kind == "csv":
        kept = kept[:1]
    if not kept and not passed:
        held = ", ".join(type(o).__name__ for o in content.objects) or "no object"
        raise FormatError(f"nothing to write: the file holds {held}, which {kind} cannot take", where=str(source))
    write_objects(kind, target, kept, _raw_sets(content, passed), binary, content.header)
    lost = [f"{_describe(obj)}: cannot be represented in {kind}" for obj in content.objects if not any(obj is k for k in kept)]
    lost += [text for obj in kept for text in losses(obj, kind, binary)]
    lost += _lost_of_file(content, kind)
    if kind != "uff" or content.format != "uff":
        lost += [f"set {s.index} ({s.title}): {s.note or s.status}" for s in content.sets if s.status != "used"][:50]
    return {
        "in": str(source),
        "out": str(target),
        "format_in": content.format,
        "format_out": kind,
        "written": [_describe(obj) for obj in kept],
        "passed_on": [{"set": s.index, "type": s.number, "title": s.title, "reason": s.note} for s in passed],
        "lost": list(dict.fromkeys(lost)),
        "findings": [f.to_dict() for f in content.findings],
    }


def format_of(path: str | Path) -> str:
    """Format that the name of a file to be written tells: ``uff``, ``hdf5``, ``matlab`` or ``csv``."""
    suffix = Path(path).suffix
    if suffix.lower() not in _SUFFIXES:
        raise FormatError(f"{suffix or 'no suffix'!r} tells no format", where=str(path), hint="use .uff, .unv, .h5, .mat or .csv")
    return _SUFFIXES[suffix.lower()]


def _raw_sets(content: Content, passed: list[SetInfo]) -> list[bytes]:
    """Sets passed on as they are, each behind the units of its file where those are not SI: the objects before them are."""
    units = [s for s in content.sets if s.number == 164 and s.status == "used"]
    out: list[bytes] = []
    last = None
    for info in passed:
        own = next((u for u in reversed(units) if u.index < info.index), units[0] if units else None)
        if own is not None and own is not last and not _states_si(own):
            out.append(own.raw)
            last = own
        out.append(info.raw)
    return out


def _states_si(units: SetInfo) -> bool:
    return "length 1/1 m, force 1/1 N" in units.note


def _lost_of_file(content: Content, kind: str) -> list[str]:
    """What of a file belongs to none of its objects and is not kept, in words."""
    out = [f.message for f in content.findings if f.kind in ("elements_left_out", "missing_node", "outside_sets")]
    out += content.unkept
    if content.format != "uff":
        return out
    used = {s.number for s in content.sets if s.status == "used"}
    if kind != "uff" and content.header is not None and (content.header.name or content.header.program):
        out.append("header of the file (set 151)")
    if kind == "uff" and content.header is not None and content.header.description and _has_components(content):
        out.append("description in the header (set 151): its line states the numbers of the components")
    if 164 in used and any(s.number == 164 and not _states_si(s) for s in content.sets):
        out.append("units of the file (set 164): the numbers are in SI now")
    if 2414 in used and kind == "uff":
        out.append("sets 2414 as such: their modes are sets 55 now")
    return out


def _has_components(content: Content) -> bool:
    nodes = [] if content.geometry is None else list(content.geometry.nodes)
    nodes += [dof.node for model in content.models for dof in model.dofs]
    return any(isinstance(node, str) for node in nodes)


def holds(kind: str, obj: Any) -> bool:
    """Whether a format can take an object."""
    if kind in ("csv", "matlab"):
        return isinstance(obj, TimeRecord | Frf)
    return kind == "hdf5" or isinstance(obj, TimeRecord | Frf | ModalModel | Geometry)


def write_objects(
    kind: str, target: Path, kept: list[Any], raws: list[bytes] | None = None, binary: bool = True, header: FileHeader | None = None
) -> None:
    """Write objects that a format holds into one file; CSV takes the first alone."""
    if kind == "uff":
        from operando.io.uff.writer import write_uff

        own = None if header is None else replace(header, writer="operando", written="")
        write_uff(target, *kept, binary=binary, header=own, passthrough=raws or ())
    elif kind == "hdf5":
        from operando.io.hdf5 import write_hdf5

        counts: dict[str, int] = {}
        names = {}
        for obj in kept:
            name = NAMES[type(obj)]
            counts[name] = counts.get(name, 0) + 1
            names[f"{name}{counts[name]:04d}" if name != "geometry" else name] = obj
        write_hdf5(target, names)
    elif kind == "matlab":
        from operando.io.matlab import write_matlab

        write_matlab(target, *kept)
    else:
        from operando.io.csv import write_csv
        from operando.io.frf_table import write_frf_csv

        write_frf_csv(target, kept[0]) if isinstance(kept[0], Frf) else write_csv(target, kept[0])


def _describe(obj: Any) -> str:
    if isinstance(obj, TimeRecord):
        return f"record of {len(obj.channels)} channels × {obj.n_samples} samples at {obj.sampling_hz:g} Hz"
    if isinstance(obj, Frf):
        return f"{obj.quantity} {len(obj.responses)} × {len(obj.references)}, {len(obj.axis)} lines"
    if isinstance(obj, ModalModel):
        beside = f" and {obj.n_residuals} residual terms" if obj.n_residuals else ""
        return f"modal model of {obj.n_modes} modes{beside}, {len(obj.dofs)} DOFs, {obj.scaling.replace('_', ' ')}"
    return f"geometry of {len(obj.nodes)} nodes"


def losses(obj: TimeRecord | Frf | ModalModel | Geometry, kind: str, binary: bool = True) -> list[str]:
    """What of an object a format does not keep, in words. UFF: 58b (``binary``) keeps all digits of functions, ASCII 13."""
    if kind == "hdf5":
        return []
    out = ["findings and provenance"] if obj.provenance.inputs or getattr(obj, "findings", ()) else []
    if isinstance(obj, TimeRecord):
        if any(c.source_unit and c.source_unit != c.unit for c in obj.channels):
            out.append("source units: the numbers are in SI now")
        if kind != "uff" and any(c.dof is not None and c.name for c in obj.channels):
            out.append("channel names: the DOF is the name")
        if kind == "csv" and any(printable(c.label) != c.label for c in obj.channels):
            out.append("control characters of channel names: they are shown escaped")
    elif isinstance(obj, Frf):
        if obj.variance is not None and kind != "uff":
            out.append("variance of the FRF lines")
        if kind == "matlab" and obj.coherence is not None:
            out.append("coherence")
        if kind == "matlab" and obj.averages is not None:
            out.append("number of averages")
        if obj.exponential_window_rate:
            out.append(f"decay rate of the exponential window, {obj.exponential_window_rate:g} 1/s")
    elif isinstance(obj, ModalModel):
        out.append("shapes keep 6 digits")
        if obj.covariance is not None or obj.std is not None:
            out.append("uncertainty of the modes")
        if any(d.sign < 0 for d in obj.dofs):
            out.append("the sense of DOFs: shapes are along the positive axes now")
        if obj.band_hz is not None:
            out.append(f"band of the analysis, {obj.band_hz[0]:g} to {obj.band_hz[1]:g} Hz")
        if obj.misfit is not None:
            out.append(f"reduced chi-square, {obj.misfit:.3g}")
        if not np.all(obj.in_band):
            out.append("which modes lie in the band")
    if kind == "uff" and not binary and isinstance(obj, TimeRecord | Frf):
        out.append("values keep 13 digits in ASCII")
    return out
