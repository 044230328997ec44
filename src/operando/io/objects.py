"""Objects to files and back: what ``save`` and ``load`` do for one object."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from operando.errors import FormatError, OperandoError
from operando.io.convert import NAMES, format_of, holds, losses, write_objects
from operando.io.detect import detect_format
from operando.io.hdf5 import UNREADABLE, read_hdf5, write_hdf5
from operando.io.safe import opened_hdf5

HDF5_SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5")
"""Names of HDF5 files, in lower case."""


def save(obj: Any, path: str | Path) -> None:
    """Write one object; the format follows from the name of the file.

    ``.h5`` keeps everything; other formats take what they can hold, and a warning says what they cannot.
    """
    kind = format_of(path)
    if kind == "hdf5":
        write_hdf5(path, {NAMES.get(type(obj), type(obj).__name__.lower()): obj})
        return
    if not holds(kind, obj):
        raise FormatError(f"a {type(obj).__name__} cannot be represented in {kind}", where=str(path), hint="save it as .h5")
    write_objects(kind, Path(path), [obj])
    for text in losses(obj, kind, True):
        warnings.warn(f"lost in {Path(path).name}: {text}", stacklevel=4)  # the line that calls the method


def load_object(path: str | Path) -> Any:
    """The one object that :func:`save` wrote into an HDF5 file.

    Parameters
    ----------
    path : path
        File.

    Returns
    -------
    object

    Raises
    ------
    FormatError
        If the file is no HDF5 file of operando, or holds several objects.

    Examples
    --------
    >>> import tempfile, operando
    >>> geometry = operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]], ((1, 2),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     geometry.save(f"{folder}/geometry.h5")
    ...     load_object(f"{folder}/geometry.h5").lines
    ((1, 2),)
    """
    _expect_hdf5(path)
    found = read_hdf5(path)
    if len(found) != 1:
        raise FormatError(
            f"the file holds {len(found)} objects: {', '.join(found)}", where=str(path), hint="operando.read gives all of them"
        )
    return next(iter(found.values()))


def object_names(path: str | Path) -> tuple[str, ...]:
    """Names of the objects in an HDF5 file of operando.

    Parameters
    ----------
    path : path
        File.

    Returns
    -------
    tuple of str

    Raises
    ------
    FormatError
        If it is none, or damaged.

    Examples
    --------
    >>> import tempfile, operando
    >>> geometry = operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]], ((1, 2),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     geometry.save(f"{folder}/geometry.h5")
    ...     len(object_names(f"{folder}/geometry.h5"))
    1
    """
    _expect_hdf5(path)
    try:
        with opened_hdf5(path) as file:
            return tuple(str(name) for name in file)
    except OperandoError:
        raise
    except UNREADABLE as error:
        raise FormatError(f"cannot be read as HDF5: {error}", where=str(path), hint="operando.read takes files of other formats") from error


def _expect_hdf5(path: str | Path) -> None:
    """Refuse a file of another format in words of its own: it is not damaged.

    A file that is in no known format and is called as HDF5 files are goes on, to be tried as a damaged one.
    """
    try:
        kind = detect_format(path)
    except FormatError:
        if Path(path).suffix.lower() in HDF5_SUFFIXES:
            return
        kind = ""
    if kind in ("hdf5", "matlab"):  # MATLAB 7.3 writes HDF5, too: reading it tells what is not there
        return
    found = {"": "not an .h5 file of operando", "csv": "a text, not an .h5 file of operando"}
    message = found.get(kind, f"a file in the format {kind}, not an .h5 file of operando")
    hint = "load takes .h5 files that operando wrote, and results folders; operando.read takes measurements of other formats"
    raise FormatError(message, where=str(path), hint=hint)
