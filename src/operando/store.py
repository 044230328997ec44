"""Results of a test in one HDF5 file, ``model.h5``: one group a field, everything with uncertainties and provenance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from operando.errors import FormatError, MissingError, OperandoError
from operando.results import Results

_NAMES = tuple(f.name for f in fields(Results) if f.name != "timings_s")
"""What took how long is no result: it differs from run to run."""


def save_results(results: Results, path: str | Path) -> None:
    """Write results to HDF5; the file appears whole or not at all.

    Parameters
    ----------
    results : Results
    path : path
        Usually ``model.h5`` in the results folder.

    Raises
    ------
    DataError
        If a result holds something that has no lasting form.
    """
    from operando.io import write_hdf5

    write_hdf5(path, {name: getattr(results, name) for name in _NAMES})


def load_results(path: str | Path, only: Iterable[str] | None = None) -> Results:
    """Read what :func:`save_results` wrote.

    Parameters
    ----------
    path : path
        ``model.h5``, or a results folder that holds one.
    only : iterable of str, optional
        Names of the fields wanted (the others keep their defaults); default all.

    Raises
    ------
    MissingError
        If there is no such file.
    FormatError
        If it is no results file of operando, or damaged.
    """
    from operando.io import UNREADABLE, check_fields, check_objects, opened_hdf5, read_object

    path = Path(path)
    if path.is_dir():
        path = path / "model.h5"
    if not path.is_file():
        raise MissingError("there is no model.h5", where=str(path.parent), hint="make one with `operando run test.toml -o DIR`")
    wanted = _NAMES if only is None else ("name", *only)
    try:
        with opened_hdf5(path) as file:
            check_objects(file)
            if "name" not in file:
                raise FormatError("an HDF5 file, but no results of operando", where=str(path), hint="expected model.h5 of a results folder")
            values: dict[str, Any] = {name: read_object(file[name]) for name in _NAMES if name in wanted and name in file}
        results = Results(**values)
    except OperandoError:
        raise
    except UNREADABLE as error:
        raise FormatError(f"cannot be read: {error}", where=str(path), hint="rebuild it with `operando run`") from error
    check_fields(results, str(path))
    return results
