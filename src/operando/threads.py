"""Threads over places, laws and runs: NumPy frees the interpreter on arrays of a record's length. Inside them BLAS has one."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from contextvars import copy_context
from functools import lru_cache
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST = 4
"""Threads at most: few pieces of work are more, and what stays in the interpreter runs one at a time."""

_here = threading.local()
_allowed: list[int] = []


def limit(count: int) -> None:
    """Let this process use no more than so many threads: where several processes share the machine, each has its own."""
    _allowed[:] = [max(1, count)]
    _pool.cache_clear()


def cores() -> int:
    """Processors that this process may use."""
    if _allowed:
        return _allowed[0]
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(min(MOST, cores()), "operando")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked process has none of its parent's threads


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results in the order of the items; what runs in a thread already does its own items one after another."""
    todo = list(items)
    if len(todo) < 2 or cores() == 1 or inside():
        return [function(item) for item in todo]

    def guarded(item: Item) -> Result:
        with one_by_one():
            return function(item)

    # each in a copy of this thread's context: what NumPy warns of is part of it
    return list(_pool().map(lambda item, context: context.run(guarded, item), todo, [copy_context() for _ in todo]))


def inside() -> bool:
    """Whether this runs for :func:`each` already."""
    return getattr(_here, "busy", False)


@contextmanager
def one_by_one() -> Iterator[None]:
    """While it lasts, what this thread has to do for each of some items it does one after another."""
    _here.busy = True
    try:
        yield
    finally:
        _here.busy = False


def one_blas_thread() -> AbstractContextManager[Any]:
    """While it lasts BLAS uses one thread: with more, products of small matrices take two to four times as long."""
    limited: AbstractContextManager[Any] = _blas().limit(limits=1, user_api="blas")
    return limited


@lru_cache(maxsize=1)
def _blas() -> Any:
    """The BLAS libraries of this process, looked for once: that takes as long as a small fit."""
    import numpy  # noqa: F401
    import scipy.linalg  # noqa: F401  (has a BLAS of its own)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
