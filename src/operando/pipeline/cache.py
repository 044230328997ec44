"""The last result of each stage, kept in the results folder under the key of everything it depends on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from operando.errors import FormatError, OperandoError
from operando.pipeline.folder import HIDDEN, ResultsFolder


def load_stage(folder: ResultsFolder, stage: str, key: str) -> tuple[dict[str, Any], float] | None:
    """The result of a stage and the seconds it took, if it was made under this key and is whole, else None."""
    entry = folder.entry(stage_file(stage), key)
    if entry is None:
        return None
    from operando.io import UNREADABLE

    try:
        return _read(folder.path / stage_file(stage)), float(entry.get("seconds", 0.0))
    except (OperandoError, *UNREADABLE):
        return None  # written by another version of a library: made again


def save_stage(folder: ResultsFolder, stage: str, key: str, result: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """Keep the result of a stage and give it back as it was kept, so that later stages see the same whether it is new or not."""
    from operando.io import write_hdf5

    folder.stage(stage_file(stage), key, lambda path: write_hdf5(path, {"result": dict(result)}), seconds=seconds)
    folder.commit()
    return _read(folder.path / stage_file(stage))


def stage_file(stage: str) -> str:
    """Where the result of a stage is kept in the results folder."""
    return f"{HIDDEN}/{stage}.h5"


def _read(path: Path) -> dict[str, Any]:
    from operando.io import opened_hdf5, read_object
    from operando.io.safe import trust

    trust(path, "hdf5")  # its content is what was written, to the bit
    with opened_hdf5(path) as file:
        found = read_object(file["result"])
    if not isinstance(found, dict):
        raise FormatError("holds no result of a stage", where=str(path))
    return found
