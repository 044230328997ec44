"""Trying a file in a process of its own, with limits of time and memory, before it is read here.

HDF5 and SciPy's MATLAB reader are written in C: a damaged file can make them loop for ever or end the process; npTDMS takes the
lengths that a file states. The helper process
reads the whole file and throws the numbers away; only a file that passes is read here. One helper serves all files of a process.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from operando.children import started
from operando.errors import FormatError, MissingError

TIME_LIMIT_S = 2.0
"""Computing time without a sign of life [s]: the next object of the file. Objects take half a millisecond."""
WAITING = 3.5
"""Waiting time over computing time: other processes want the machine, too. With it a small file that hangs is given up after seven
seconds, below the ten after which a command counts as hanging."""
SLOWEST_BYTES_PER_S = 20e6
"""Reading rate that is still waited for: a network drive of 200 Mbit/s."""
START_LIMIT_S = 60.0
"""Time for the helper to start [s]: it loads NumPy and h5py, a second at most from a local disk."""

_Stamp = tuple[int, int, int, int]
_trusted: set[tuple[str, _Stamp]] = set()  # a file keeps its stamp when it is renamed
_lock = threading.Lock()


def _stamp(path: Path) -> _Stamp:
    state = path.stat()
    return state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns


def trust(path: str | Path, kind: str) -> None:
    """Take a file as tried: this process wrote it, or has tried it. A change of the file ends that."""
    with contextlib.suppress(OSError):
        _trusted.add((kind, _stamp(Path(path))))


def try_apart(path: str | Path, kind: str) -> None:
    """Read a file in the helper process; return if that ends well."""
    path = Path(path)
    try:
        stamp = _stamp(path)
    except OSError as error:
        raise MissingError("no such file" if isinstance(error, FileNotFoundError) else str(error.strerror), where=str(path)) from error
    if (kind, stamp) in _trusted:
        return
    limit = TIME_LIMIT_S + path.stat().st_size / SLOWEST_BYTES_PER_S
    with _lock:
        reply = _helper().ask({"kind": kind, "path": str(path.resolve()), "limit_s": limit}, WAITING * limit)
    if reply is not None:
        if reply["message"]:
            raise FormatError(str(reply["message"]), where=str(path), hint=reply["hint"])
        _trusted.add((kind, stamp))
        return
    reason = f"no progress within {limit:.0f} s of computing, or the reading process died"
    raise FormatError(
        f"the file makes the reader of {kind.upper()} files fail: {reason}", where=str(path), hint="the file is damaged: export it again"
    )


class _Helper:
    """The helper process and what it says, line by line."""

    def __init__(self) -> None:
        if not sys.executable:
            raise MissingError(
                "no Python to start a helper process with", where="sys.executable", hint="run operando by a Python interpreter"
            )
        self.owner = os.getpid()
        self.lines: queue.Queue[str] = queue.Queue()
        try:
            self.process = started("operando.io.safe.helper", "-W", "ignore", stderr=subprocess.DEVNULL)
        except OSError as error:
            raise MissingError(f"the helper process that tries files cannot be started: {error.strerror}", where=sys.executable) from error
        threading.Thread(target=self._listen, daemon=True).start()
        if self._hear(START_LIMIT_S) is None:
            self.end()
            raise MissingError("the helper process that tries files does not start", where=sys.executable)

    def _listen(self) -> None:
        assert self.process.stdout is not None
        with contextlib.suppress(ValueError, OSError):
            for line in self.process.stdout:
                self.lines.put(line)
        self.lines.put("")

    def _hear(self, limit_s: float) -> dict[str, Any] | None:
        try:
            line = self.lines.get(timeout=limit_s)
        except queue.Empty:
            return None
        return json.loads(line) if line else None

    def ask(self, request: dict[str, Any], limit_s: float) -> dict[str, Any] | None:
        """Answer to a request, None (and the end of the helper) if no sign of life comes in time."""
        assert self.process.stdin is not None
        reply = None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            reply = self._hear(limit_s)
            while reply is not None and "alive" in reply:
                reply = self._hear(limit_s)
        except OSError:
            pass
        finally:
            if reply is None:  # also when the user interrupts: an answer that comes late is no answer to the next request
                self.end()
        return reply

    def end(self) -> None:
        """Stop the process."""
        with contextlib.suppress(OSError):
            self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


_running: list[_Helper] = []


def _helper() -> _Helper:
    """The helper of this process; a new one where there is none, it ended, or this process is a fork of the one it serves."""
    if not (_running and _running[0].owner == os.getpid() and _running[0].process.poll() is None):
        _running[:] = [_Helper()]
    return _running[0]


@atexit.register
def _end() -> None:
    while _running:
        helper = _running.pop()
        if helper.owner == os.getpid():
            helper.end()
