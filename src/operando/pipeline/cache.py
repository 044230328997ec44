"""Stage results on disk, each with the key of everything it depends on; files that appear whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import operando
from operando.errors import OperandoError
from operando.jsonable import json_text, jsonable

FOLDER = ".stages"


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; it takes the place of ``path`` when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """A JSON file, null where there is no value."""
    with whole(path) as beside:
        beside.write_text(json_text(document) + "\n", encoding="utf-8")


@cache
def code_hash(rooms: tuple[str, ...]) -> str:
    """Hash of the source of rooms (packages or files of operando): results of older code are not taken for new ones."""
    root = Path(operando.__file__).parent
    digest = hashlib.sha256(operando.__version__.encode())
    for room in sorted(rooms):
        place = root / room
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def key_of(*parts: Any) -> str:
    """One key of hashes, settings and upstream keys."""
    return hashlib.sha256(json.dumps(jsonable(parts), sort_keys=True).encode()).hexdigest()


class StageCache:
    """The last result of each stage, in a hidden folder of the results folder."""

    def __init__(self, out: Path) -> None:
        self.folder = out / FOLDER

    def load(self, stage: str, key: str) -> dict[str, Any] | None:
        """The result of a stage if it was made under this key, else None."""
        from operando.io import UNREADABLE, opened_hdf5, read_object

        path = self.folder / f"{stage}.h5"
        if not path.is_file():
            return None
        try:
            with opened_hdf5(path) as file:
                if read_object(file["key"]) != key:
                    return None
                result = read_object(file["result"])
        except (OperandoError, *UNREADABLE):
            return None  # damaged or of another version: made again
        return result if isinstance(result, dict) else None

    def save(self, stage: str, key: str, result: Mapping[str, Any]) -> None:
        """Keep the result of a stage."""
        from operando.io import write_hdf5

        self.folder.mkdir(parents=True, exist_ok=True)
        write_hdf5(self.folder / f"{stage}.h5", {"key": key, "result": dict(result)})

    def drop(self, stages: Iterable[str]) -> None:
        """Forget stages."""
        for stage in stages:
            (self.folder / f"{stage}.h5").unlink(missing_ok=True)
