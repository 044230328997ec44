"""Results of a test in one HDF5 file, ``model.h5``: one group a field, everything with uncertainties and provenance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, overload

from operando.errors import DataError, FormatError, MissingError, ObjectError, OperandoError
from operando.paths import near_path, path_of
from operando.results import Results

_NAMES = tuple(f.name for f in fields(Results) if f.name != "timings_s")
"""What took how long is no result: it differs from run to run."""


T = TypeVar("T")


@overload
def load(path: str | Path) -> Any: ...
@overload
def load(path: str | Path, kind: type[T]) -> T: ...
def load(path: str | Path, kind: type[Any] = object) -> Any:
    """Read what was saved: the results of a test, or one object.

    Parameters
    ----------
    path : path
        A results folder of ``operando run``, a ``model.h5``, or an ``.h5`` file that ``save`` of an object wrote.
    kind : class, optional
        What is expected (``operando.Results``, ``operando.Frf``, …): type checkers then know it, and something else is an error.

    Returns
    -------
    Results, or the object saved

    Raises
    ------
    MissingError
        If there is no such file or folder.
    FormatError
        If it is no file of operando, is damaged, or holds several objects (``operando.read`` gives all of them).
    ObjectError
        If it holds something else than ``kind``.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [1.0, 2.0], "1+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     frf.save(f"{folder}/frf.h5")
    ...     operando.load(f"{folder}/frf.h5", operando.Frf)
    <Frf: accelerance [(m/s²)/N]; 1 response 1+Z; 1 reference 1+Z; 2 lines, 1 to 2 Hz in steps of 1 Hz>
    """
    from operando.io import load_object, object_names

    file = path_of(path, "what was saved is loaded from its path", "save(path) of an object writes what load(path) reads")
    if not file.exists():
        raise MissingError("there is no such file or folder", where=str(path), hint=near_path(file))
    found = load_results(file) if file.is_dir() or "name" in object_names(file) else load_object(file)
    if not isinstance(found, kind):
        raise ObjectError(f"a {type(found).__name__} was saved, not a {kind.__name__}", hint=f"load({str(path)!r}) without a kind takes it")
    return found


def save_results(results: Results, path: str | Path) -> None:
    """Write results to HDF5, usually ``model.h5`` of the results folder; the file appears whole or not at all."""
    from operando.io import write_hdf5

    write_hdf5(path, {name: getattr(results, name) for name in _NAMES})


def load_results(path: str | Path, only: Iterable[str] | None = None) -> Results:
    """Read what :func:`save_results` wrote, from ``model.h5`` or the folder that holds one; fields not wanted keep their defaults."""
    from h5py import is_hdf5

    from operando.io import UNREADABLE, check_objects, opened_hdf5, read_objects

    path = path_of(path, "results are loaded from their folder")
    if path.is_dir():
        path = path / "model.h5"
    elif not path.exists():
        raise MissingError(
            "there is no such results folder", where=str(path), hint=f"{near_path(path)}; `operando run test.toml -o DIR` makes one"
        )
    elif not is_hdf5(path):
        hint = "a folder that `operando run test.toml -o DIR` made is expected, or its model.h5"
        raise FormatError("holds no results of operando", where=str(path), hint=hint)
    if not path.is_file():
        raise MissingError("there is no model.h5", where=str(path.parent), hint="make one with `operando run test.toml -o DIR`")
    wanted = _NAMES if only is None else ("name", *only)
    try:
        with opened_hdf5(path) as file:
            check_objects(file)
            if "name" not in file:
                raise FormatError("an HDF5 file, but no results of operando", where=str(path), hint="expected model.h5 of a results folder")
            values = read_objects(file, [name for name in _NAMES if name in wanted and name in file])
        results = Results(**values)
    except DataError as error:
        raise FormatError(error.message, where=str(path), hint="the file is damaged") from error
    except OperandoError:
        raise
    except UNREADABLE as error:
        raise FormatError(f"cannot be read: {error}", where=str(path), hint="rebuild it with `operando run`") from error
    return results
