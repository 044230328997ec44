"""The process that tries files: requests on stdin, answers on stdout, one JSON document a line (see ``guard``)."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from operando.children import Say, speaker
from operando.errors import OperandoError
from operando.io.safe.limits import memory_allowed

SIGN_EVERY_S = 0.25
"""Time between signs of life [s]."""
NAMES = {"hdf5": "HDF5", "matlab": "a MATLAB file", "tdms": "TDMS"}


def main() -> None:
    """Answer requests until stdin ends."""
    say = speaker()
    import h5py  # noqa: F401  (loaded before the first file, so that its time and memory count for no file)

    say({"ready": True})
    for line in sys.stdin:
        say(_answer(json.loads(line), say))


class _Watch:
    """Ends the process when it computes for too long without a sign of life; tells the asking process at every sign."""

    def __init__(self, limit_s: float, say: Say) -> None:
        self.limit_s, self.say, self.told = limit_s, say, time.monotonic()
        self._set(limit_s)

    def alive(self) -> None:
        """The trial goes on."""
        if time.monotonic() - self.told > SIGN_EVERY_S:
            self.told = time.monotonic()
            self._set(self.limit_s)
            self.say({"alive": True})

    def end(self) -> None:
        """The trial is over."""
        self._set(0.0)

    def _set(self, seconds: float) -> None:
        # Time of computing, so that a machine under load refuses no file. No handler: the process ends also in the middle of C code.
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_PROF, seconds)


def _answer(request: dict[str, Any], say: Say) -> dict[str, Any]:
    path = Path(request["path"])
    watch = _Watch(float(request["limit_s"]), say)
    try:
        _try(path, str(request["kind"]), watch.alive)
        return {"message": "", "hint": None}
    except OperandoError as error:
        return {"message": error.message, "hint": error.hint}
    except MemoryError:
        allowed = memory_allowed(path.stat().st_size)
        return {"message": f"reading takes more than {allowed / 1e6:.0f} MB of memory", "hint": "the file is damaged: export it again"}
    except Exception as error:  # the libraries raise errors of many kinds on damaged files
        return {
            "message": f"cannot be read as {NAMES[request['kind']]}: {error or type(error).__name__}",
            "hint": "the file is damaged: export it again",
        }
    finally:
        watch.end()


def _try(path: Path, kind: str, alive: Callable[[], None]) -> None:
    try_file: Callable[[Path, Callable[[], None]], None]
    # imported before the memory is limited
    if kind == "matlab":
        import scipy.io  # noqa: F401

        from operando.io.mat5 import try_mat5 as try_file
    elif kind == "tdms":
        from operando.io.tdms import load_library
        from operando.io.tdms import try_tdms as try_file

        load_library(str(path))
    else:
        from operando.io.safe.hdf5_file import try_hdf5 as try_file
    with _memory_limited(path.stat().st_size):
        try_file(path, alive)


@contextlib.contextmanager
def _memory_limited(size: int) -> Any:
    """Hold the address space to what a file of a size may take beyond what the process has now (Linux; elsewhere no limit)."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as stream:
            now = int(stream.read().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    wanted = now + memory_allowed(size)
    resource.setrlimit(resource.RLIMIT_AS, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
