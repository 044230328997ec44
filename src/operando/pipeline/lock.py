"""One process at a time in a results folder.

The lock is one of the operating system: it ends with the process that holds it, however that ends, so that none is ever left behind.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from operando.atomic import writing
from operando.errors import BusyError, WriteError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_BEHIND_THE_TEXT = 1 << 30
"""Windows locks bytes and keeps them from being read: a byte far behind the text that names the holder."""


@contextmanager
def exclusive(path: Path, doing: str) -> Iterator[None]:
    """Hold a lock file inside the block; it is made where it is missing, and stays with the name of its last holder and what that did.

    Raises a BusyError that names the holder where another process has it, a WriteError where the file cannot be written.
    """
    with writing(path.parent):
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if not _take(handle, path):
            raise BusyError(
                f"in use by {_holder(path)}",
                where=str(path.parent.parent),
                hint="wait until it has finished, end it, or name another results folder with -o",
            )
        me = {"process": os.getpid(), "host": socket.gethostname(), "doing": doing, "since": time.strftime("%Y-%m-%d %H:%M:%S")}
        with writing(path.parent):
            os.ftruncate(handle, 0)
            os.write(handle, json.dumps(me).encode())
        yield
    finally:
        os.close(handle)


def _take(handle: int, path: Path) -> bool:
    """Whether the lock could be had."""
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:  # pragma: no cover
            import msvcrt

            os.lseek(handle, _BEHIND_THE_TEXT, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
            return False
        raise WriteError(
            f"this file system has no locks ({error.strerror}), and two runs at once would spoil each other's results",
            where=str(path),
            hint="name a results folder on a local disk with -o",
        ) from error
    return True


def _holder(path: Path) -> str:
    """Who holds the lock, in words."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return f"process {found['process']} on {found['host']} (operando {found['doing']}, since {found['since']})"
    except (OSError, ValueError, KeyError, TypeError):  # not written yet
        return "another process"
