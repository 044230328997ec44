"""The last result of each stage, kept in the results folder under the key of everything it depends on.

A stage that is done has a file of its own. When the run is done, ``model.h5`` holds what all stages found, and the files go: what stands
in the results under its own name is read from there, the rest of a stage (:func:`rest_of`) from ``Results.stages``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from operando.errors import FormatError, OperandoError
from operando.pipeline.folder import HIDDEN, ResultsFolder
from operando.results import Results

_NAMES = frozenset(f.name for f in fields(Results)) - {"findings"}


@dataclass(frozen=True)
class Kept:
    """The result of a stage."""

    found: dict[str, Any]  # fields of ``Results``, and ``findings`` of the stage itself
    seconds: float  # how long it took

    def standing(self, results: Results) -> list[str]:
        """Names of what the results hold as this stage found it."""
        return sorted(name for name, value in self.found.items() if name in _NAMES and getattr(results, name) is value)

    def rest(self, results: Results) -> dict[str, Any]:
        """What they do not: the findings of the stage, and what a later stage put something else in place of."""
        standing = self.standing(results)
        return {name: value for name, value in self.found.items() if name not in standing}


def load_stage(folder: ResultsFolder, stage: str, key: str) -> Kept | None:
    """The result of a stage, if it was made under this key and is whole, else None."""
    from operando.io import UNREADABLE

    name = stage_file(stage)
    try:
        entry = folder.entry(name, key)
        if entry is not None:
            return Kept(_read(folder.path / name), float(entry.get("seconds", 0.0)))
        found = folder.standing(name, key)
        if found is not None:
            entry, model = found
            return Kept(_read_in_model(model, stage, entry["fields"]), float(entry.get("seconds", 0.0)))
    except (OperandoError, *UNREADABLE):
        pass  # written by another version of a library: made again
    return None


def save_stage(folder: ResultsFolder, stage: str, key: str, result: Mapping[str, Any], seconds: float) -> Kept:
    """Keep the result of a stage and give it back as it was kept, so that later stages see the same whether it is new or not."""
    _write(folder, stage, key, Kept(dict(result), seconds), packed=False)  # it goes when the run is done
    folder.commit()
    return Kept(_read(folder.path / stage_file(stage)), seconds)


def in_model(kept: Mapping[str, Kept], keys: Mapping[str, str], results: Results, model: str) -> dict[str, dict[str, Any]]:
    """Entries of stages whose results stand from here on in the ``model.h5`` of these results, named by its hash."""
    return {
        stage_file(stage): {"key": keys[stage], "seconds": result.seconds, "model": model, "fields": result.standing(results)}
        for stage, result in kept.items()
    }


def apart(folder: ResultsFolder, but: Collection[str]) -> None:
    """Stage files of their own for results that stand in a ``model.h5`` which is about to go, but for those of some stages."""
    for name, entry in folder.all_standing().items():
        stage = Path(name).stem
        kept = None if stage in but else load_stage(folder, stage, entry["key"])
        if kept is not None:
            _write(folder, stage, entry["key"], kept)


def stage_file(stage: str) -> str:
    """Where the result of a stage is kept in the results folder."""
    return f"{HIDDEN}/{stage}.h5"


def _write(folder: ResultsFolder, stage: str, key: str, kept: Kept, packed: bool = True) -> None:
    from operando.io import write_hdf5

    folder.stage(stage_file(stage), key, lambda path: write_hdf5(path, {"result": kept.found}, packed=packed), seconds=kept.seconds)


def _read(path: Path) -> dict[str, Any]:
    found = _objects(path, ["result"])["result"]
    if not isinstance(found, dict):
        raise FormatError("holds no result of a stage", where=str(path))
    return found


def _read_in_model(path: Path, stage: str, names: Iterable[str]) -> dict[str, Any]:
    found = _objects(path, ["stages", *names])
    return {**found.pop("stages")[stage], **found}


def _objects(path: Path, names: Iterable[str]) -> dict[str, Any]:
    from operando.io import opened_hdf5, read_objects
    from operando.io.safe import trust

    trust(path, "hdf5")  # its content is what was written, to the bit
    with opened_hdf5(path) as file:
        return read_objects(file, names)
