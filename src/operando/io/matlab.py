"""MATLAB files: versions 5 to 7, and 7.3 through h5py; data found by their shape and the names beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from operando.atomic import replacing
from operando.data import Finding, Frf, TimeRecord, complex_of
from operando.errors import DataError, FormatError, OperandoError
from operando.io.content import Content
from operando.io.mat5 import read_mat5
from operando.io.quantities import ChannelSpecs, Units
from operando.io.safe import opened_hdf5
from operando.io.uff.reader import open_file
from operando.io.variables import Variable, content_of
from operando.printable import first_few


def read_matlab(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read time histories and transfer functions of a MATLAB file.

    Which arrays are what, see :func:`operando.io.variables.content_of`. What was taken for what stands in ``Content.sets``; what is not
    known (DOFs, units) in ``Content.findings``.

    Parameters
    ----------
    path : path
        File.
    units : Units, optional
        Quantity → unit, where the file does not say.
    channels : ChannelSpecs, optional
        Channel name or DOF → what it is, where the file is silent or wrong.

    Returns
    -------
    Content

    Raises
    ------
    FormatError
        If the file is damaged, or no data with a time or frequency axis are found.

    Examples
    --------
    >>> import tempfile, numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.arange(20.0).reshape(2, 10), 500.0, channels)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_matlab(f"{folder}/run.mat", record)
    ...     len(read_matlab(f"{folder}/run.mat").records[0].channels)
    2
    """
    path = Path(path)
    variables, unread = read_variables(path)
    content = content_of(variables, path, "matlab", units, channels)
    if not unread:
        return content
    names = first_few(unread)
    note = Finding(
        "unused_variable", f"{len(unread)} variables hold neither numbers nor texts: {names:.200}", "info", str(path),
        consequence="they are not used", action="look whether they are data",
    )  # fmt: skip
    return replace(content, findings=(*content.findings, note))


def write_matlab(path: str | Path, *objects: TimeRecord | Frf) -> None:
    """Write records (``data`` samples × channels, ``fs``, ``channel_names``, ``units``) and FRFs (``H`` lines × responses × references).

    Parameters
    ----------
    path : path
        File.
    *objects : TimeRecord or Frf
        Records and FRFs to write.

    Raises
    ------
    DataError
        If an object is neither record nor FRF.

    Examples
    --------
    >>> import tempfile, numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.arange(20.0).reshape(2, 10), 500.0, channels)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_matlab(f"{folder}/run.mat", record)
    ...     operando.read(f"{folder}/run.mat").records[0].sampling_hz
    500.0
    """
    from scipy.io import savemat

    variables: dict[str, Any] = {}
    for i, obj in enumerate(objects):
        if isinstance(obj, TimeRecord):
            names = [c.label or f"ch{k + 1}" for k, c in enumerate(obj.channels)]
            item: dict[str, Any] = {"data": obj.data.T, "fs": obj.sampling_hz, "start": obj.start_s}
            item |= {"channel_names": np.array(names, dtype=object), "units": np.array([c.unit for c in obj.channels], dtype=object)}
            variables[f"record{i + 1}"] = item
        elif isinstance(obj, Frf):
            item = {"H": np.moveaxis(obj.data, 2, 0), "frequency": obj.frequencies_hz, "quantity": obj.quantity, "si": obj.si}
            item |= {"responses": np.array([str(d) for d in obj.responses], dtype=object)}
            item |= {"references": np.array([str(d) for d in obj.references], dtype=object)}
            variables[f"frf{i + 1}"] = item
        else:
            raise DataError(f"{type(obj).__name__} is not written to MATLAB files", hint="records and FRFs are")
    with replacing(path) as stream:
        savemat(stream, variables, do_compression=False, oned_as="column")  # type: ignore[arg-type]


def read_variables(path: Path) -> tuple[list[Variable], list[str]]:
    """Arrays and lists of texts of a file, each with its path (``structure.field``), of any version from 5 on; paths of anything else."""
    unread: list[str] = []
    with open_file(path) as stream:
        version73 = stream.read(19).startswith(b"MATLAB 7.3")
    try:
        if version73:
            with opened_hdf5(path) as file:
                return list(_walk_hdf5(file, "", file, unread)), unread
        loaded = read_mat5(path)
    except OperandoError:
        raise
    except Exception as error:  # h5py and SciPy raise errors of many kinds on damaged files
        raise FormatError(f"the MATLAB file cannot be read: {error}", where=str(path)) from error
    return [v for name, value in loaded.items() for v in _walk(value, name)], unread


def _walk(value: Any, path: str) -> Iterator[Variable]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _walk(item, f"{path}.{name}")
    elif isinstance(value, str):
        yield Variable(path, [value])
    elif (isinstance(value, np.ndarray) and value.dtype.kind in "OU") or isinstance(value, list):
        items = value if isinstance(value, list) else np.ravel(value).tolist()
        items = ["" if isinstance(item, np.ndarray) and item.dtype.kind == "U" and not item.size else item for item in items]
        if items and all(isinstance(item, str) for item in items):
            yield Variable(path, [str(item) for item in items])
        else:
            for i, item in enumerate(items):
                if isinstance(item, dict | np.ndarray):
                    yield from _walk(item, f"{path}{i}")
    elif isinstance(value, int | float | complex | np.number):
        yield Variable(path, np.atleast_1d(np.asarray(value)))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        yield Variable(path, value)


def _walk_hdf5(group: Any, path: str, file: Any, unread: list[str]) -> Iterator[Variable]:
    """Variables below a group; paths of what is none are added to ``unread``."""
    import h5py

    for name, item in group.items():
        if name.startswith("#"):
            continue
        here = f"{path}.{name}" if path else str(name)
        if isinstance(item, h5py.Group):
            yield from _walk_hdf5(item, here, file, unread)
        elif isinstance(item, h5py.Dataset):
            kind = item.attrs.get("MATLAB_class", b"")
            if kind == b"char":
                yield Variable(here, [_characters(item)])
            elif kind == b"cell":
                cells = [file[ref] for ref in np.ravel(item[()]) if isinstance(ref, h5py.Reference)]
                chars = [c for c in cells if c.attrs.get("MATLAB_class", b"") == b"char"]
                if len(chars) == len(cells):
                    yield Variable(here, [_characters(cell) for cell in chars])
                else:
                    unread.append(here)
            elif item.dtype.names == ("real", "imag"):
                raw = item[()]
                yield Variable(here, complex_of(raw["real"], raw["imag"]).T)
            elif item.dtype.kind in "biuf":
                yield Variable(here, np.asarray(item[()]).T)
            else:
                unread.append(here)


def _characters(item: Any) -> str:
    """Text of a dataset of UTF-16 code units; an empty text is stored as its size, two whole numbers of 64 bits."""
    units = np.ravel(item[()])
    return units[units != 0].astype("<u2").tobytes().decode("utf-16-le", "replace") if units.dtype == np.uint16 else ""
