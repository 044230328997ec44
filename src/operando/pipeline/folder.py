"""The results folder: what each of its files was made of and holds, and changes that happen as one.

Every file that operando makes there has an entry in ``.stages/manifest.json``: the key of what it was made of and the hash of its
content. A file counts as unchanged when both still fit; a missing, cut or altered one is made again. The result of a stage has a file of
its own until a ``model.h5`` holds it; from then on its entry names that ``model.h5`` by its hash. New files are written aside, in
``.stages/new``, and take their names together: first the files they stand in for go, then the new ones come, then the manifest. So
a process that ends at any moment leaves whole files, and never old ones beside new ones: the old results, unless it ends in the
fraction of a millisecond in which they go; and an entry never speaks for a file that is not there. A ``model.h5`` that entries of stages
name does not go: while they do, it lies in ``.stages``.
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
MODEL = "model.h5"
SOURCE = "source.json"
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
        self._older_model = self.hidden / MODEL
        self._known: dict[tuple[int, ...], str] = {}

    def clear(self) -> None:
        """Remove what an earlier process began to write, or this one did and dropped."""
        self._staged = {}
        begun = list(self._aside.iterdir()) if self._aside.is_dir() else []
        for file in (*begun, *left_behind(self.path), *left_behind(self.hidden)):
            file.unlink(missing_ok=True)
        self._drop_doubles()

    def came_from(self, test: Path | None, progress: Callable[[str, str], None] | None = None) -> None:
        """Keep which test file the results are made from (a test made in Python has none); say whose results they take the place of."""
        found = None if test is None else str(test.resolve())
        before = _source(self.hidden)
        if found != before:
            if progress is not None and before is not None and self.holds_results:
                progress("inspect", f"the kept results here are of {before}; they are replaced")
            write_json(self.hidden / SOURCE, {"schema": "operando/source/1", "test": found})

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
        return {name: entry["sha256"] for name, entry in self._entries.items() if name not in but and "sha256" in entry}

    def holds(self, hashes: Mapping[str, str]) -> bool:
        """Whether all these files are there, with this content."""
        try:
            return all(file_hash(self.path / name) == sha for name, sha in hashes.items())
        except OSError:
            return False

    def standing(self, name: str, key: str) -> tuple[dict[str, Any], Path] | None:
        """What the manifest says of a result under this key that stands in a ``model.h5``, and where that lies; None if it does not."""
        entry = self._entries.get(name)
        if entry is None or entry.get("key") != key or "model" not in entry:
            return None
        model = self._model(entry["model"])
        return None if model is None else (entry, model)

    def all_standing(self) -> dict[str, dict[str, Any]]:
        """The entries of all results that stand in a ``model.h5``."""
        return {name: entry for name, entry in self._entries.items() if "model" in entry}

    def model_hash(self) -> str | None:
        """Hash of ``model.h5``, as it is after the next :meth:`commit`."""
        entry = self._staged.get(MODEL) or self._entries.get(MODEL) or {}
        return entry.get("sha256")

    def _model(self, sha: str) -> Path | None:
        """Where the ``model.h5`` of this hash lies."""
        return next((path for path in (self.path / MODEL, self._older_model) if self._hash(path) == sha), None)

    def _hash(self, path: Path) -> str | None:
        """Hash of a file, None where there is none; taken once while the file is not written to."""
        try:
            state = path.stat()
            stamp = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns)
            if stamp not in self._known:
                self._known[stamp] = file_hash(path)
        except OSError:
            return None
        return self._known[stamp]

    def _drop_doubles(self) -> None:
        """Remove a ``model.h5`` in ``.stages`` that no entry needs, and files of stages that stand in one."""
        standing = self.all_standing()
        if self._older_model.exists():
            named = {entry["model"] for entry in standing.values()}
            if self._hash(self.path / MODEL) in named or self._hash(self._older_model) not in named:
                self._older_model.unlink(missing_ok=True)
        for name in standing:
            (self.path / name).unlink(missing_ok=True)

    def key(self, name: str) -> str | None:
        """The key under which a file was made, whatever has become of it."""
        key: str | None = self._entries.get(name, {}).get("key")
        return key

    def stage(self, name: str, key: str | None, write: Callable[[Path], Made], **more: Any) -> Made:
        """Write a file aside under a path inside the folder; :meth:`commit` gives it its name, and ``more`` to its entry in the manifest.

        Its key is of what it is made of; None for a file made by hand, which the next run makes again unless it is the same.
        """
        with writing(self._aside):
            self._aside.mkdir(exist_ok=True)
        made = write(self._aside / Path(name).name)
        self._staged[name] = {"key": key, "sha256": file_hash(self._aside / Path(name).name), **more}
        return made

    def note(self, name: str, **more: Any) -> None:
        """Add to the entry of a file that was staged."""
        self._staged[name] |= more

    def commit(self, drop: Iterable[str] = (), standing: Mapping[str, dict[str, Any]] | None = None) -> None:
        """Let the files written aside take their names, and those named in ``drop`` go.

        ``standing`` are files of stages → entry (``key``, ``model``: hash of the ``model.h5`` in which the result stands from here on, and
        more); such a file goes.
        """
        gone = [name for name in drop if name in self._entries or (self.path / name).exists()]
        moved = {name: entry for name, entry in (standing or {}).items() if self._entries.get(name) != entry}
        if not self._staged and not gone and not moved:
            return
        with writing(self.path):
            for name in reversed((*gone, *self._staged)):  # those that tell of the others go first
                self._remove(name)
            sync_folder(self.path)
            for name in self._staged:
                os.replace(self._aside / Path(name).name, self.path / name)
            sync_folder(self.path)
            sync_folder(self.hidden)
        entries = {name: entry for name, entry in self._entries.items() if name not in gone}
        entries |= {name: entry for name, entry in self._staged.items() if entry["key"] is not None} | moved
        write_json(self.hidden / "manifest.json", {"schema": SCHEMA, "files": dict(sorted(entries.items()))})
        self._entries, self._staged = entries, {}
        with writing(self.path):
            self._drop_doubles()

    def _remove(self, name: str) -> None:
        """Remove a file; a ``model.h5`` that entries name goes to ``.stages``."""
        if name == MODEL and self._hash(self.path / MODEL) in {entry["model"] for entry in self.all_standing().values()}:
            os.replace(self.path / MODEL, self._older_model)
        else:
            (self.path / name).unlink(missing_ok=True)


def _read(path: Path) -> dict[str, dict[str, Any]]:
    """Entries of a manifest; none where it is missing or damaged, so that all is made again."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["schema"] == SCHEMA and all(isinstance(entry, dict) for entry in found["files"].values()):
            return dict(found["files"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return {}


def _source(hidden: Path) -> str | None:
    try:
        found: str | None = json.loads((hidden / SOURCE).read_text(encoding="utf-8"))["test"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found


def source_of(path: Path) -> Path | None:
    """The test file from which the results in a folder were made, if it was kept and is still there."""
    found = _source(path / HIDDEN)
    return Path(found) if found is not None and Path(found).is_file() else None


def default_folder(name: str) -> Path:
    """The results folder of a test of this name where none is given: ``results/NAME`` in the current one."""
    return Path("results") / "".join(c if c.isalnum() or c in "-_." else "-" for c in name).strip(".-")


@contextmanager
def results_folder(path: str | Path, doing: str, *, make: bool = False) -> Iterator[ResultsFolder]:
    """A results folder for this process alone, made if asked, without what an earlier one left half done.

    Raises a BusyError where another process is at work there, which is told what is done here (``doing``).
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


@contextmanager
def changing(path: str, doing: str) -> Iterator[ResultsFolder]:
    """The results folder at a path (or around a ``model.h5``) that holds results, for this process alone; see :func:`results_folder`."""
    from operando.store import load_results

    load_results(path, only=())  # before anything is made in a folder that is none
    with results_folder(path if Path(path).is_dir() else Path(path).parent, doing) as folder:
        yield folder


def adopt(source: str | Path, target: str | Path, stages: Iterable[str]) -> None:
    """Let a results folder that is still empty begin with kept stages of another; whether they fit its test is for the run to see.

    Where ``source`` has no such stage, or it is damaged, it is made in ``target``.
    """
    other = ResultsFolder(Path(source))
    with results_folder(target, "campaign", make=True) as folder:
        if folder.holds_results:
            return
        standing: dict[str, dict[str, Any]] = {}
        for name in (f"{HIDDEN}/{stage}.h5" for stage in stages):
            key = other.key(name)
            if key is None:
                continue
            with suppress(OSError):
                if (whole := other.entry(name, key)) is not None:
                    more = {what: value for what, value in whole.items() if what not in ("key", "sha256")}
                    folder.stage(name, key, partial(_same_file, other.path / name), **more)
                elif (found := other.standing(name, key)) is not None:
                    if not standing:
                        _same_file(found[1], folder.hidden / MODEL)
                    standing[name] = found[0]
        folder.commit(standing=standing)


def _same_file(source: Path, target: Path) -> None:
    """One file under two names (files of a results folder are never changed in place); a copy where the file system has no such thing."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def apart_from_runs(path: str | Path, doing: str) -> AbstractContextManager[None]:
    """For a file that is written by itself: where it lies in a results folder, no run is at work there inside the block.

    Raises a BusyError if one is.
    """
    hidden = Path(path).absolute().parent / HIDDEN
    return exclusive(hidden / "lock", doing) if hidden.is_dir() else nullcontext()
