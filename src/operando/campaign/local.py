"""Local worker processes: each runs tests one after another, and is replaced when it is lost."""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from operando.atomic import writing
from operando.campaign.task import Task
from operando.children import started
from operando.errors import MissingError

MOST_ATTEMPTS = 2
"""A test whose worker is killed is tried once more: a second time it is the test (its memory) that kills."""

Answer = tuple[Task, dict[str, Any]]


class LocalPool:
    """Worker processes on this machine, each with one thread of its own.

    What libraries print in them goes to files in ``logs``, what happens to them to ``say``, in words.
    """

    def __init__(self, processes: int, logs: Path, say: Callable[[str], None]) -> None:
        self.size = processes
        self._logs, self._say = logs, say
        self._answers: queue.Queue[Answer] = queue.Queue()
        self._tasks: queue.Queue[Task | None] = queue.Queue()
        self._threads = [threading.Thread(target=self._serve, args=(i,), daemon=True) for i in range(1, processes + 1)]
        self._alive: set[subprocess.Popen[str]] = set()
        self._ended = False
        for thread in self._threads:
            thread.start()

    def submit(self, task: Task) -> None:
        """Have a test run as soon as a worker is free."""
        self._tasks.put(task)

    def next_answer(self) -> Answer:
        """The next test that ended, and what its worker said of it."""
        return self._answers.get()

    def end(self) -> None:
        """End the workers."""
        self._ended = True
        for process in tuple(self._alive):
            with suppress(OSError):
                process.kill()
        for _ in self._threads:
            self._tasks.put(None)

    def _serve(self, number: int) -> None:
        """One thread a worker: it starts the process, gives it tasks, and starts another where it is lost."""
        worker: _Worker | None = None
        while (task := self._tasks.get()) is not None:
            answer: dict[str, Any] | None = None
            how = ""
            for attempt in range(1, MOST_ATTEMPTS + 1):
                try:
                    worker = worker or _Worker(self._logs / f"worker-{number}.log", self._alive)
                    answer = worker.ask(task)
                except MissingError as error:
                    answer = {"state": "failed", "reason": str(error)}
                if answer is not None or self._ended:
                    break
                how, worker = worker.end() if worker is not None else "", None
                again = "; the test is tried again" if attempt < MOST_ATTEMPTS else ""
                self._say(f"{task.name}: worker {number} was lost ({how}){again}")
            if self._ended:
                break
            lost = f"its worker was lost {MOST_ATTEMPTS} times ({how}); not enough memory for so many processes?"
            self._answers.put((task, answer or {"state": "failed", "reason": lost}))
        if worker is not None:
            worker.end()


class _Worker:
    """A worker process."""

    def __init__(self, log: Path, alive: set[subprocess.Popen[str]]) -> None:
        with writing(log.parent):
            log.parent.mkdir(parents=True, exist_ok=True)
            stream = open(log, "a", encoding="utf-8")  # noqa: SIM115 - closed below, the process has its own
        try:
            self.process = started("operando.campaign.worker", stderr=stream)
        except OSError as error:
            raise MissingError(f"a worker process cannot be started: {error.strerror}", where=sys.executable) from error
        finally:
            stream.close()
        self._alive = alive
        alive.add(self.process)
        if self._hear() is None:
            raise MissingError(f"a worker process does not start ({self.end()})", where=str(log))

    def ask(self, task: Task) -> dict[str, Any] | None:
        """What the worker says of a test; None where it is lost."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(task.to_dict()) + "\n")
            self.process.stdin.flush()
        except (OSError, ValueError):
            return None
        return self._hear()

    def _hear(self) -> dict[str, Any] | None:
        assert self.process.stdout is not None
        try:
            line = self.process.stdout.readline()
            return dict(json.loads(line)) if line else None
        except (OSError, ValueError):
            return None

    def end(self) -> str:
        """End the process; how it ended, in words."""
        self._alive.discard(self.process)
        with suppress(OSError):
            assert self.process.stdin is not None
            self.process.stdin.close()
        try:
            code = self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()
        return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


@contextmanager
def local_pool(processes: int, logs: Path, say: Callable[[str], None]) -> Iterator[LocalPool]:
    """A pool that ends with the block."""
    pool = LocalPool(processes, logs, say)
    try:
        yield pool
    finally:
        pool.end()
