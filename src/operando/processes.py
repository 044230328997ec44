"""Fits side by side in processes: most of a fit stays in the interpreter, where threads run one at a time."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from tempfile import TemporaryFile
from types import FunctionType, MethodType
from typing import Any, TypeVar

import numpy as np

from operando.threads import MOST, cores, each, inside, one_by_one

Item = TypeVar("Item")
Result = TypeVar("Result")

CAN_FORK = sys.platform == "linux"
"""A forked process has all that its parent has, so nothing is sent to it. Elsewhere there are threads: Windows cannot fork, and system
libraries of macOS do not bear it."""

_DIGITS = 4  # bytes of a number in the queue, which a pipe passes on as a whole


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results in the order of the items, from as many processes as there are processors.

    Parameters
    ----------
    function : callable
        It must change nothing that it is given: each process has a copy of its own.

    Raises
    ------
    Exception
        What the function raises for the first of the items for which it fails.
    """
    todo = list(items)
    count = min(MOST, cores(), len(todo))
    if count < 2 or not CAN_FORK or inside() or threading.current_thread() is not threading.main_thread():
        return each(function, todo)  # other threads of a server or a notebook may hold what a copy would wait for
    queue, end = os.pipe()
    os.set_blocking(end, False)  # numbers for which it has no room are left to this process
    os.write(end, b"".join(number.to_bytes(_DIGITS, "little") for number in range(len(todo))))
    os.close(end)
    known = _known(function, todo)
    others: list[_Other] = []
    try:
        others += [_Other(queue, function, todo, known) for _ in range(count - 1)]
        done = _taken(queue, function, todo)
        for other in others:
            done |= other.results(known)
    finally:
        os.close(queue)
        for other in others:
            other.end()
    return [_result(done[number] if number in done else function(item)) for number, item in enumerate(todo)]


def _taken(queue: int, function: Callable[[Item], Result], todo: Sequence[Item]) -> dict[int, Any]:
    """Results, or what was raised, of the numbers that this process takes from the queue."""
    done: dict[int, Any] = {}
    with one_by_one():
        while number := os.read(queue, _DIGITS):
            at = int.from_bytes(number, "little")
            try:
                done[at] = function(todo[at])
            except Exception as error:
                done[at] = _Failed(error)
    return done


class _Failed:
    """What a function has raised."""

    def __init__(self, error: Exception) -> None:
        self.error = error


def _result(found: Any) -> Any:
    if isinstance(found, _Failed):
        raise found.error
    return found


class _Other:
    """A process beside this one, and the file that it leaves its results in."""

    def __init__(self, queue: int, function: Callable[[Any], Any], todo: Sequence[Any], known: Mapping[int, Any]) -> None:
        self.file = TemporaryFile()  # noqa: SIM115  (closed by end)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # threads wait for work, and hold nothing that the process needs
            self.pid: int | None = os.fork()
        if not self.pid:
            status = 1
            try:
                signal.signal(signal.SIGINT, signal.SIG_DFL)
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                _Pickler(self.file, known).dump(_taken(queue, function, todo))
                self.file.flush()
                status = 0
            finally:
                os._exit(status)  # without what a process does at its end: that is left to the parent

    def results(self, known: Mapping[int, Any]) -> dict[int, Any]:
        """Once it has ended; nothing of one that was killed."""
        assert self.pid
        pid, self.pid = self.pid, None
        if os.waitpid(pid, 0)[1]:
            return {}
        self.file.seek(0)
        done: dict[int, Any] = _Unpickler(self.file, known).load()
        return done

    def end(self) -> None:
        if self.pid:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        self.file.close()


class _Pickler(pickle.Pickler):
    """Objects that the parent has are named, not sent. Only a process forked here writes what is read, to a file that has no name."""

    def __init__(self, file: Any, known: Mapping[int, Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.known = known

    def persistent_id(self, obj: Any) -> int | None:
        return id(obj) if id(obj) in self.known else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: Any, known: Mapping[int, Any]) -> None:
        super().__init__(file)
        self.known = known

    def persistent_load(self, pid: int) -> Any:
        return self.known[pid]


def _known(*roots: Any) -> dict[int, Any]:
    """Arrays and objects of ours that some objects lead to, by their address: a forked process has them at the same one."""
    known: dict[int, Any] = {}
    seen: dict[int, Any] = {}
    todo = list(roots)
    while todo:
        one = todo.pop()
        if id(one) in seen:
            continue
        seen[id(one)] = one
        if isinstance(one, np.ndarray):
            known[id(one)] = one
        elif isinstance(one, dict):
            todo += one.values()
        elif isinstance(one, (tuple, list, set, frozenset)):
            todo += one
        elif isinstance(one, partial):
            todo += [one.func, one.args, one.keywords]
        elif isinstance(one, MethodType):
            todo.append(one.__self__)
        elif isinstance(one, FunctionType):
            todo += [cell.cell_contents for cell in one.__closure__ or ()]
        elif type(one).__module__.startswith("operando."):
            known[id(one)] = one
            todo += getattr(one, "__dict__", {}).values()
    return known
