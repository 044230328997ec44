"""Files that appear whole or not at all, and stay so when the power fails."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from operando.errors import WriteError
from operando.jsonable import json_text
from operando.paths import path_of

_FULL = "make room and give the same command again; what was finished is kept"
_CLOSED = "choose another folder, or ask for the right to write there"
_HINTS = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EFBIG: _FULL,
    errno.EACCES: _CLOSED,
    errno.EPERM: _CLOSED,
    errno.EROFS: _CLOSED,
    errno.ENOENT: "does the folder exist?",
}

unfinished: set[Path] = set()
"""Files being written now: a process that ends without unwinding removes them (:func:`remove_unfinished`)."""


@contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """What the operating system refuses inside the block, as a typed error that names the file."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        hint = _HINTS.get(error.errno or 0, "give the same command again when this is put right")
        if error.errno == errno.ENOENT and error.filename and (folder := Path(os.fsdecode(error.filename)).parent).is_dir():
            reason, hint = f"the folder {folder} takes no new files or folders", _CLOSED
        raise WriteError(f"cannot be written: {reason}", where=str(path), hint=hint) from error


@contextmanager
def replacing(path: str | Path, mode: str = "wb", **kwargs: Any) -> Iterator[IO[Any]]:
    """Open a file beside ``path`` for writing; it takes the name ``path`` when the block ends well, and disappears when it does not.

    Its content is on the disk before it takes the name, so that no power failure leaves the name with half a file. Raises a WriteError if
    the folder does not exist, is full or cannot be written, no file is named, or a device is; an ObjectError if ``path`` is no path.
    """
    path = path_of(path, "a file is written to its path")
    if not path.name:
        raise WriteError(f"{str(path)!r} names no file", hint="give a path that ends in the name of the file")
    given, path = path, Path(os.path.realpath(path))  # a link stays, and leads to the new file
    if path.exists() and not (path.is_file() or path.is_dir()):  # taking the name of /dev/null would end it for all programs
        raise WriteError("is a device or a pipe, expected a file", where=str(given), hint="give a file; --json prints the document")
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    with writing(given):
        unfinished.add(beside)
        try:
            with open(beside, mode, **kwargs) as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(beside, path)
            sync_folder(path.parent)
        finally:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
            unfinished.discard(beside)


def refuse_source(target: str | Path, *sources: str | Path) -> None:
    """Refuse to write over a file that is being read: measurements are not recorded twice."""
    for source in sources:
        with suppress(OSError):  # one of them is not there
            if os.path.samefile(source, target):
                raise WriteError("would be written over the file that is read", where=str(target), hint="give the new file another name")


def write_json(path: str | Path, document: Mapping[str, Any] | list[Any]) -> None:
    """A JSON file, null where there is no value."""
    text = json_text(document) + "\n"
    with replacing(path, "w", encoding="utf-8", newline="\n") as stream:
        stream.write(text)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, where the operating system lets one (Windows does not)."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def left_behind(folder: Path) -> list[Path]:
    """Files in a folder that a process began to write and did not finish."""
    return [path for path in folder.glob(".*.part") if re.fullmatch(r"\..+\.\d+\.part", path.name)]


def remove_unfinished() -> None:
    """Remove the files being written now."""
    for path in tuple(unfinished):
        with suppress(OSError):
            path.unlink(missing_ok=True)
