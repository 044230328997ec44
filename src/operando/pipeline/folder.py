"""The results folder: what each of its files was made of and holds, and changes that happen as one.

Every file that operando makes there has an entry in ``.stages/manifest.json``: the key of what it was made of and the hash of its
content. A file counts as unchanged when both still fit; a missing, cut or altered one is made again. New files are written aside, in
``.stages/new``, and take their names together: first the files they stand in for go, then the new ones come, then the manifest. So
a process that ends at any moment leaves whole files, and never old ones beside new ones: the old results, unless it ends in the
fraction of a millisecond in which they go; and an entry never speaks for a file that is not there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from operando.atomic import left_behind, sync_folder, write_json, writing
from operando.errors import MissingError
from operando.files import file_hash
from operando.jsonable import jsonable
from operando.pipeline.lock import exclusive

HIDDEN = ".stages"
SCHEMA = "operando/manifest/1"

Made = TypeVar("Made")


def key_of(*parts: Any) -> str:
    """One key of hashes, settings and upstream keys."""
    return hashlib.sha256(json.dumps(jsonable(parts), sort_keys=True).encode()).hexdigest()


class ResultsFolder:
    """A results folder that this process alone writes to; see :func:`results_folder`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.hidden = path / HIDDEN
        self._aside = self.hidden / "new"
        self._entries = _read(self.hidden / "manifest.json")
        self._staged: dict[str, dict[str, Any]] = {}

    def clear(self) -> None:
        """Remove what an earlier process began to write, or this one did and dropped."""
        self._staged = {}
        begun = list(self._aside.iterdir()) if self._aside.is_dir() else []
        for file in (*begun, *left_behind(self.path), *left_behind(self.hidden)):
            file.unlink(missing_ok=True)

    @property
    def holds_results(self) -> bool:
        """Whether a run has kept anything here."""
        return bool(self._entries)

    def entry(self, name: str, key: str) -> dict[str, Any] | None:
        """What the manifest says of a file that was made under this key and still holds the same, else None."""
        entry = self._entries.get(name)
        if entry is None or entry.get("key") != key:
            return None
        with suppress(OSError):
            if file_hash(self.path / name) == entry.get("sha256"):
                return entry
        return None

    def hashes(self, *but: str) -> dict[str, str]:
        """Hash of each file that runs made here, but for some."""
        return {name: entry["sha256"] for name, entry in self._entries.items() if name not in but}

    def holds(self, hashes: Mapping[str, str]) -> bool:
        """Whether all these files are there, with this content."""
        try:
            return all(file_hash(self.path / name) == sha for name, sha in hashes.items())
        except OSError:
            return False

    def made_before(self, name: str, key: str) -> bool:
        """Whether a file was made under this key, whatever has become of it."""
        return self._entries.get(name, {}).get("key") == key

    def stage(self, name: str, key: str | None, write: Callable[[Path], Made], **more: Any) -> Made:
        """Write a file aside; :meth:`commit` gives it its name.

        Parameters
        ----------
        name : str
            Path inside the folder.
        key : str or None
            Of what it is made of; None for a file made by hand, which the next run makes again unless it is the same.
        write : callable
            Writes the file at the path it is given.
        more
            What the entry of the manifest shall hold besides.
        """
        with writing(self._aside):
            self._aside.mkdir(exist_ok=True)
        made = write(self._aside / Path(name).name)
        self._staged[name] = {"key": key, "sha256": file_hash(self._aside / Path(name).name), **more}
        return made

    def note(self, name: str, **more: Any) -> None:
        """Add to the entry of a file that was staged."""
        self._staged[name] |= more

    def commit(self, drop: Iterable[str] = ()) -> None:
        """Let the files written aside take their names, and those named in ``drop`` go."""
        gone = [name for name in drop if name in self._entries or (self.path / name).exists()]
        if not self._staged and not gone:
            return
        with writing(self.path):
            for name in reversed((*gone, *self._staged)):  # those that tell of the others go first
                (self.path / name).unlink(missing_ok=True)
            sync_folder(self.path)
            for name in self._staged:
                os.replace(self._aside / Path(name).name, self.path / name)
            sync_folder(self.path)
            sync_folder(self.hidden)
        for name in gone:
            self._entries.pop(name, None)
        self._entries |= {name: entry for name, entry in self._staged.items() if entry["key"] is not None}
        self._staged = {}
        write_json(self.hidden / "manifest.json", {"schema": SCHEMA, "files": dict(sorted(self._entries.items()))})


def _read(path: Path) -> dict[str, dict[str, Any]]:
    """Entries of a manifest; none where it is missing or damaged, so that all is made again."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["schema"] == SCHEMA and all(isinstance(entry, dict) for entry in found["files"].values()):
            return dict(found["files"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return {}


def default_folder(name: str) -> Path:
    """The results folder of a test of this name where none is given: ``results/NAME`` in the current one."""
    return Path("results") / "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip(".-")


@contextmanager
def results_folder(path: str | Path, doing: str, *, make: bool = False) -> Iterator[ResultsFolder]:
    """A results folder for this process alone, without what an earlier one left half done.

    Parameters
    ----------
    path : path
    doing : str
        What is done there, for the message to a process that comes meanwhile.
    make : bool
        Whether a missing folder is made.

    Raises
    ------
    BusyError
        If another process is at work there.
    MissingError
        If there is no such folder.
    WriteError
        If it cannot be written.
    """
    path = Path(path)
    if not make and not path.is_dir():
        raise MissingError("there is no such results folder", where=str(path), hint="make one with `operando run test.toml -o DIR`")
    with writing(path):
        (path / HIDDEN).mkdir(parents=True, exist_ok=True)
    with exclusive(path / HIDDEN / "lock", doing):
        folder = ResultsFolder(path)
        with writing(path):
            folder.clear()
        try:
            yield folder
        finally:
            with suppress(OSError):
                folder.clear()


def adopt(source: str | Path, target: str | Path, stages: Iterable[str]) -> None:
    """Let a results folder that is still empty begin with kept stages of another; whether they fit its test is for the run to see.

    Parameters
    ----------
    source, target : path
        Results folders; where ``source`` has no such stage, or it is damaged, it is made in ``target``.
    stages : iterable of str
    """
    source = Path(source)
    entries = _read(source / HIDDEN / "manifest.json")
    with results_folder(target, "campaign", make=True) as folder:
        if folder.holds_results:
            return
        for name in (f"{HIDDEN}/{stage}.h5" for stage in stages):
            entry = entries.get(name)
            with suppress(OSError):
                if entry is not None and file_hash(source / name) == entry.get("sha256"):
                    more = {key: value for key, value in entry.items() if key not in ("key", "sha256")}
                    folder.stage(name, entry["key"], partial(_same_file, source / name), **more)
        folder.commit()


def _same_file(source: Path, target: Path) -> None:
    """One file under two names (files of a results folder are never changed in place); a copy where the file system has no such thing."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def apart_from_runs(path: str | Path, doing: str) -> AbstractContextManager[None]:
    """For a file that is written by itself: where it lies in a results folder, no run is at work there inside the block.

    Raises
    ------
    BusyError
        If one is.
    """
    hidden = Path(path).absolute().parent / HIDDEN
    return exclusive(hidden / "lock", doing) if hidden.is_dir() else nullcontext()
