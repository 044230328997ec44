"""Which format a file has, from its content, and reading it."""

from __future__ import annotations

import importlib
from pathlib import Path

from operando.errors import FormatError, MissingError
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units

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

    Raises
    ------
    MissingError
        If there is no such file.
    FormatError
        If it is none of these.
    """
    from operando.io.uff.reader import open_file
    from operando.io.uff.split import find_first_set

    path = Path(path)
    if path.is_dir():
        raise MissingError("a folder, not a file", where=str(path), hint="name the files in it, for example with *.uff")
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
    if _looks_like_text(head):
        return "csv"
    raise FormatError(
        "the format is not known", where=str(path), hint="UFF, HDF5 of operando, MATLAB, CSV, LVM, TDMS, NumPy and WAV files can be read"
    )


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
    """Read a measurement file of any known format, converted to SI.

    Parameters
    ----------
    path : path
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
        If ``units`` or ``channels`` hold something that is not known.
    """
    kind = detect_format(path)
    if kind not in READERS:
        return _read_own_hdf5(path)
    module, name = READERS[kind]
    content: Content = getattr(importlib.import_module(module), name)(path, units=units, channels=channels)
    return content


def _read_own_hdf5(path: str | Path) -> Content:
    """Objects of operando's own HDF5 file, wherever they stand in it."""
    from operando.data import Finding, Frf, Geometry, ModalModel, TimeRecord
    from operando.io.hdf5 import read_hdf5

    found = read_hdf5(path)
    records, frfs, models = [], [], []
    geometry = None
    infos = []
    findings: list[Finding] = []
    for i, (name, obj) in enumerate(found.items()):
        used = True
        if isinstance(obj, TimeRecord):
            records.append(obj)
        elif isinstance(obj, Frf):
            frfs.append(obj)
        elif isinstance(obj, ModalModel):
            models.append(obj)
        elif isinstance(obj, Geometry) and geometry is None:
            geometry = obj
        else:
            used = False
        title = f"{name}: {type(obj).__name__}"
        infos.append(SetInfo(i, 0, title, "used" if used else "ignored", "" if used else "no record, FRF, model or geometry"))
        findings += list(getattr(obj, "findings", ()) if used else ())
    return Content(str(path), "hdf5", tuple(records), tuple(frfs), tuple(models), geometry, tuple(infos), tuple(dict.fromkeys(findings)))
