"""Files whose samples are read later, and where a channel lies in them."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from operando.errors import FormatError

MOST_OPEN = 100
"""Files of samples that are open at a time: systems let a process have 256 or 1024."""


def _nothing() -> None:
    """What there is to close of a file that was not opened."""


class StoredFile:
    """A file whose samples are read later: the same one as now, or an error says that it was changed.

    Of all these files ``MOST_OPEN`` at most are open at a time; one that is asked for again is opened again.

    Parameters
    ----------
    path : Path
    stream : file, optional
        A temporary file, which has no name to open it by.
    """

    _recent: ClassVar[list[weakref.ref[StoredFile]]] = []
    _recent_lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, path: Path, stream: IO[bytes] | None = None) -> None:
        self.path, self._stream, self._lock = path, stream, threading.Lock()
        self._reopens = stream is None
        self._close: Callable[[], Any] = _nothing if stream is None else weakref.finalize(self, stream.close)
        with self._lock:
            self._stamp = self._now(self._open())

    def _open(self) -> IO[bytes]:
        if self._stream is None:
            try:
                self._stream = open(self.path, "rb")  # noqa: SIM115  (it stays open for the next piece)
            except OSError as error:
                raise FormatError(f"the file cannot be opened any more: {error.strerror}", where=str(self.path)) from error
            self._close = weakref.finalize(self, self._stream.close)
            self._close_others()
        return self._stream

    def _close_others(self) -> None:
        """Note this file as open and close the one opened first, if they are too many and it is not being read."""
        with StoredFile._recent_lock:
            kept = [ref for ref in StoredFile._recent if ref() is not None and ref() is not self]
            StoredFile._recent[:] = [*kept, weakref.ref(self)]
            first = kept[0]() if len(kept) >= MOST_OPEN else None
            if first is not None and first._lock.acquire(blocking=False):
                try:
                    first._close()
                    first._stream = None
                    StoredFile._recent.pop(0)
                finally:
                    first._lock.release()

    @staticmethod
    def _now(stream: IO[bytes]) -> tuple[int, int]:
        state = os.fstat(stream.fileno())
        return state.st_size, state.st_mtime_ns

    def __reduce__(self) -> tuple[Any, ...]:
        if not self._reopens:
            raise TypeError("samples in a temporary file belong to this process")
        return StoredFile, (self.path,), {"_stamp": self._stamp}

    def read_into(self, offset: int, view: memoryview) -> None:
        """Fill ``view`` with the bytes from ``offset`` on.

        Raises
        ------
        FormatError
            If the file was changed since it was opened, or is not there any more.
        """
        with self._lock:
            stream = self._open()
            stream.seek(offset)
            done = 0
            while done < len(view):
                got = stream.readinto(view[done:])  # type: ignore[attr-defined]
                if not got:
                    break
                done += got
            if done < len(view) or self._now(stream) != self._stamp:
                hint = "read it again; do not write to files that are being analysed"
                raise FormatError("the file was changed while it was read", where=str(self.path), hint=hint)


@dataclass(frozen=True)
class StoredRow:
    """One channel in a file: samples one after the other.

    Parameters
    ----------
    offset : int
        Byte of the first sample.
    dtype : dtype
        As stored.
    factor : float
        To SI.
    """

    offset: int
    dtype: np.dtype[Any]
    factor: float = 1.0
