"""Which format a file has, from its content, and reading it."""

from __future__ import annotations

import glob
import importlib
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from operando.data import Finding
from operando.errors import FormatError, MissingError
from operando.files import natural_order
from operando.io.content import Content, SetInfo
from operando.io.quantities import Asked, ChannelSpecs, Silent, Units, check_stated, note_unused
from operando.paths import path_of

READERS = {
    "uff": ("operando.io.uff.reader", "read_uff"),
    "matlab": ("operando.io.matlab", "read_matlab"),
    "csv": ("operando.io.csv", "read_csv"),
    "lvm": ("operando.io.lvm", "read_lvm"),
    "tdms": ("operando.io.tdms", "read_tdms"),
    "npy": ("operando.io.numpy_files", "read_npy"),
    "npz": ("operando.io.numpy_files", "read_npz"),
    "wav": ("operando.io.wav", "read_wav"),
}
"""Format → module and function that reads it; modules are imported when a file asks for them."""
_MARKS = {
    b"\x89HDF\r\n\x1a\n": "hdf5", b"MATLAB 7.3 MAT-file": "matlab", b"MATLAB 5.0 MAT-file": "matlab", b"LabVIEW Measurement": "lvm",
    b"TDSm": "tdms", b"\x93NUMPY": "npy",
}  # fmt: skip
_HEAD = 1 << 16


def detect_format(path: str | Path) -> str:
    """Format of a file from its first bytes: ``uff``, ``hdf5``, ``matlab``, ``csv``, ``lvm``, ``tdms``, ``npy``, ``npz`` or ``wav``.

    Parameters
    ----------
    path : path
        File.

    Returns
    -------
    str

    Raises
    ------
    MissingError
        If there is no such file.
    FormatError
        If it is none of these.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.dat", frf)
    ...     detect_format(f"{folder}/frf.dat")
    'uff'
    """
    from operando.io.uff.reader import open_file
    from operando.io.uff.split import find_first_set

    path = path_of(path, "a file is read from its path")
    if path.is_dir():
        raise MissingError("a folder, not a file", where=str(path), hint=f"name the files in it, as in '{path / '*.uff'}'")
    with open_file(path) as stream:
        head = stream.read(_HEAD)
    if not head.strip():
        raise FormatError("the file is empty", where=str(path))
    for mark, kind in _MARKS.items():
        if head.startswith(mark):
            return kind
    if head.startswith(b"RIFF") and head[8:12] == b"WAVE":
        return "wav"
    if find_first_set(head) is not None:
        return "uff"
    if head.startswith(b"PK\x03\x04"):
        length = int.from_bytes(head[26:28], "little")
        if head[30 : 30 + length].endswith(b".npy"):
            return "npz"
        raise FormatError("a zip archive (xlsx, …)", where=str(path), hint="export CSV, or unpack it")
    known = "UFF, HDF5 of operando, MATLAB, CSV, LVM, TDMS, NumPy and WAV files can be read"
    if path.suffix.lower() == ".json":
        raise FormatError("a .json file, which holds no measurement", where=str(path), hint=known)
    if _looks_like_text(head):
        return "csv"
    raise FormatError("the format is not known", where=str(path), hint=known)


def _looks_like_text(head: bytes) -> bool:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return True
    control = sum(byte < 9 or 13 < byte < 32 for byte in head[:4096])
    return control == 0


def read(
    path: str | Path,
    *,
    units: Units | None = None,
    channels: ChannelSpecs | None = None,
) -> Content:
    """Read a measurement file of any known format, converted to SI; a pattern reads all files it matches.

    Parameters
    ----------
    path : path
        Of a file, or a pattern over files (``"idle/*.uff"``, ``"**/*.unv"``): their objects in natural order of the names.
    units : mapping, optional
        Quantity → unit text where the file is silent (``{"acceleration": "g", "force": "lbf", "length": "mm"}``); ``sampling_hz`` gives
        a sampling rate to a table without a time column, and ``columns`` says what the columns of a table without a header line are
        (see :func:`operando.io.csv.read_csv`).
    channels : mapping, optional
        Channel name or DOF label → dict of ``dof, quantity, unit, sensitivity, exclude, reason``. It overrides the file. Data are divided
        by ``sensitivity`` (numbers of the file per unit). A DOF label means the sensor of motion; ``12+Z:force`` the force there.

    Returns
    -------
    Content
        Records, FRFs, models, geometry, the inventory of sets, findings. A quantity without a unit keeps its numbers: ``Channel.unit`` is
        empty, ``Frf.si`` false, and the finding ``missing_unit`` says how to give it.

    Raises
    ------
    FormatError
        If the file cannot be understood, or is damaged throughout.
    MissingError
        If there is no such file.
    UnitError, ConfigError
        If ``units`` or ``channels`` hold something that is not known, or ``channels`` an entry that no file has a channel for.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [1.0, 2.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.uff", frf)
    ...     operando.read(f"{folder}/frf.uff").frfs[0]["7+Z", "1+Z"].data.real.tolist()
    [[[1.0, 2.0]]]
    """
    path = path_of(
        path, "a file is read from its path", "a pattern as 'idle/*.uff' reads several files; for arrays there are TimeRecord and Frf"
    )
    check_stated(units, channels)
    asked = channels if isinstance(channels, Asked) else Asked(channels)  # who hands over an Asked looks himself what was found
    content = _read_all(str(path), units, asked) if is_pattern(path) else _read_one(path, Silent(units), asked)
    if asked is not channels:
        asked.check(str(path))
    return content


def _read_one(path: Path, units: Silent, channels: Asked) -> Content:
    kind = detect_format(path)
    if kind in READERS:
        module, name = READERS[kind]
        content: Content = getattr(importlib.import_module(module), name)(path, units=units, channels=channels)
    else:
        from operando.io.variables import note_unused_si

        content = _read_own_hdf5(path)
        for frf in (frf for frf in content.frfs if frf.si):
            note_unused_si(units, frf.quantity, frf.name or "the FRFs")
        for channel in (c for record in content.records for c in record.channels if c.unit):
            note_unused(units, channel.quantity, channel.source_unit or channel.unit, 1.0, channel.label)
    return replace(content, findings=tuple(dict.fromkeys((*content.findings, *units.findings(str(path))))))


def is_pattern(path: str | Path) -> bool:
    """Whether a path is a pattern over files: it has a ``*``, ``?`` or ``[`` and no file is called so."""
    return any(mark in str(path) for mark in "*?[") and not Path(path).exists()


def _read_all(pattern: str, units: Units | None, channels: Asked) -> Content:
    """The content of all files that a pattern matches, as one."""
    files = sorted((p for p in map(Path, glob.glob(pattern, recursive=True)) if p.is_file()), key=natural_order)
    if not files:
        near = get_close_matches(pattern, [str(p) for p in Path(pattern).parent.glob("*")][:2000], 1, 0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"paths are relative to {Path.cwd()}"
        raise MissingError("no file matches the pattern", where=pattern, hint=hint)
    parts = [read(file, units=units, channels=channels) for file in files]
    geometries = [p for p in parts if p.geometry is not None]
    findings = [f for p in parts for f in p.findings]
    if len(geometries) > 1:
        text = f"{len(geometries)} of {len(files)} files hold a geometry; that of {geometries[0].path} is used"
        findings.append(Finding("several_geometries", text, "info", action="read the file of the other alone"))
    formats = dict.fromkeys(p.format for p in parts)
    return Content(
        pattern,
        next(iter(formats)) if len(formats) == 1 else "several",
        tuple(r for p in parts for r in p.records),
        tuple(f for p in parts for f in p.frfs),
        tuple(m for p in parts for m in p.models),
        geometries[0].geometry if geometries else None,
        tuple(s for p in parts for s in p.sets),
        tuple(dict.fromkeys(findings)),
        parts[0].header if len(parts) == 1 else None,
        tuple(text for p in parts for text in p.unkept),
    )


def _read_own_hdf5(path: str | Path) -> Content:
    """Objects of operando's own HDF5 file, wherever they stand in it."""
    from operando.data import Frf, Geometry, ModalModel, TimeRecord
    from operando.io.hdf5 import read_hdf5

    held: dict[type, list[Any]] = {TimeRecord: [], Frf: [], ModalModel: [], Geometry: []}
    infos = []
    findings: list[Finding] = []
    for i, (name, obj) in enumerate(read_hdf5(path).items()):
        kind = type(obj)
        used = kind in held and not (kind is Geometry and held[kind])
        if used:
            held[kind].append(obj)
            findings += getattr(obj, "findings", ())
        what = "content read of a file: operando.load gives it" if kind is Content else "no record, FRF, model or geometry"
        note = "" if used else what
        infos.append(SetInfo(i, 0, f"{name}: {kind.__name__}", "used" if used else "ignored", note))
    records, frfs, models = (tuple(held[kind]) for kind in (TimeRecord, Frf, ModalModel))
    geometry = next(iter(held[Geometry]), None)
    return Content(str(path), "hdf5", records, frfs, models, geometry, tuple(infos), tuple(dict.fromkeys(findings)))
