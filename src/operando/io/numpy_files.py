"""NumPy files, ``.npy`` and ``.npz``: numbers and texts; pickled objects are not read."""

from __future__ import annotations

import math
import warnings
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from operando.data import Finding
from operando.errors import FormatError
from operando.io.content import Content
from operando.io.quantities import ChannelSpecs, Units
from operando.io.safe import DEFLATE_RATIO, check_growth
from operando.io.uff.reader import open_file
from operando.io.variables import Variable, content_of


def read_npy(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read one array; the sampling rate comes from ``units["sampling_hz"]``, or the first column is the axis."""
    path = Path(path)
    with open_file(path) as stream:
        value = _array(stream, path.stat().st_size, str(path))
    return content_of(_variables("data", value), path, "npy", units, channels)


def read_npz(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read the arrays of an archive by name, as those of a MATLAB file (``data``, ``fs``, ``time``, ``channel_names``, ``units``, …)."""
    path = Path(path)
    where = str(path)
    variables: list[Variable] = []
    refused = ""
    with open_file(path) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
                other = [m.filename for m in archive.infolist() if not m.filename.endswith(".npy")]
                check_growth(sum(m.file_size for m in members), path.stat().st_size, where, "the arrays of the archive")
                for member in members:
                    if member.file_size > DEFLATE_RATIO * member.compress_size + DEFLATE_RATIO:
                        raise FormatError(f"{member.filename!r} states a size that its data cannot have", where=where)
                    name = member.filename.removesuffix(".npy")
                    try:
                        with archive.open(member) as inner:
                            variables += _variables(name, _array(inner, member.file_size, where))
                    except FormatError as error:
                        refused = refused or f"{name}: {error.message}"
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError, ValueError) as error:
            raise FormatError(
                f"the archive cannot be read: {error!s:.200}", where=where, hint="the file is damaged: export it again"
            ) from error
    if refused:
        raise FormatError(refused, where=where, hint="save arrays of numbers and texts, with allow_pickle=False")
    content = content_of(variables, path, "npz", units, channels)
    if not other:
        return content
    lost = Finding(
        "unused_member", f"{len(other)} members of the archive are no arrays: {', '.join(other)[:100]}", "warning", where,
        consequence="they are not used", action="look whether they are data",
    )  # fmt: skip
    return replace(content, findings=(*content.findings, lost))


def _array(stream: IO[bytes], size: int, where: str) -> Any:
    """Array of an ``.npy`` stream of a size; what it declares is compared with that before memory is taken."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a header that NumPy has to repair is damaged
            major, _ = np.lib.format.read_magic(stream)
            reader = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
            shape, _, dtype = reader(stream)
        if dtype.hasobject:
            raise FormatError("holds pickled objects, which are not read: a file could bring code with it", where=where)
        declared = math.prod(shape) * dtype.itemsize
        if declared != size - stream.tell():
            there = size - stream.tell()
            raise FormatError(f"declares {declared} bytes of numbers and holds {there}", where=where, hint="the file is damaged")
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)
    except FormatError:
        raise
    except Exception as error:  # NumPy's parser of headers raises errors of many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"the array cannot be read: {reason}", where=where, hint="the file is damaged: save it again") from error


def _variables(name: str, value: Any) -> list[Variable]:
    if value.dtype.names:
        return [v for field in value.dtype.names for v in _variables(f"{name}.{field}", value[field])]
    if value.dtype.kind in "US":
        return [Variable(name, [item.decode("latin-1") if isinstance(item, bytes) else item for item in np.ravel(value).tolist()])]
    return [Variable(name, np.atleast_1d(value))] if value.dtype.kind in "biufc" else []
