"""One test of a campaign, run where its worker is: its results folder, and the record that says that it is done.

The record is written last, by the process that ran the test, whole or not at all. So it alone decides what is done: a campaign that
ends at any moment, and however, goes on from it, and a test in progress goes on from its last finished stage.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from operando.atomic import write_json, writing
from operando.campaign.config import load_member
from operando.campaign.record import record_of
from operando.campaign.store import copied, in_store, listing
from operando.config import Test
from operando.errors import BusyError, OperandoError
from operando.pipeline.code import code_hash
from operando.pipeline.folder import adopt, key_of

PATIENCE_S = 20.0
"""How long a test waits for its folder: a process that lost its driver needs a moment to end."""


@dataclass(frozen=True)
class Task:
    """All that a worker needs to run a test; plain values, so that it can travel."""

    name: str
    path: str  # test file, its URL in an object store, or template
    text: str | None  # the template filled in
    title: str  # the test by its parameters
    changes: tuple[str, ...]  # entries changed, as ``--set`` takes them
    folder: str  # results folder of the test
    record: str  # path of its record
    until: str | None
    fingerprint: str  # of the test and its files; see :func:`fingerprint`
    idle_from: str | None = None  # results folder of a test with the same files at rest, whose stages at rest may be taken over

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Task:
        """A task from its plain values."""
        return cls(**{**values, "changes": tuple(values["changes"])})


def fingerprint(test: Test, until: str | None) -> str:
    """Of what a test is made of: settings, name, size and time of change of every file, and the code.

    It is for the question whether anything may have changed; the run itself compares contents.
    """
    files = []
    for file, span in test.parts:
        state = file.stat()
        files.append((str(file), repr(span), state.st_size, state.st_mtime_ns))
    runs = [(name, [str(f) for f in state.files]) for name, state in test.states.items()]
    return key_of(test.name, test.settings(), test.geometry_units, files, runs, until, code_hash("operando.pipeline.runner"))


def fingerprint_in_store(url: str, changes: Sequence[str], until: str | None) -> str:
    """The same of a test in an object store, by what the store says of its files."""
    return key_of(url, listing(url), list(changes), until, code_hash("operando.pipeline.runner"))


def read_record(path: str | Path, wanted: str) -> dict[str, Any] | None:
    """A record, if there is one that is whole and of this fingerprint."""
    with suppress(OSError, ValueError):
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        if isinstance(found, dict) and found.get("fingerprint") == wanted:
            return found
    return None


def settled(record: dict[str, Any] | None) -> bool:
    """Whether a test need not be run again: it is done, or a stage fails by its data. All else is tried again."""
    return record is not None and (record["state"] == "done" or (record["state"] == "incomplete" and "unexpected " not in record["reason"]))


def perform(task: Task) -> dict[str, Any]:
    """Run a test and write its record; what is said of it while the campaign goes on (``state`` is done, incomplete or failed)."""
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        before = read_record(task.record, task.fingerprint)
        if before is not None and settled(before):
            return _told(before)  # another worker finished it and was lost before it could say so
        document = _run(task)
    except OperandoError as error:
        document = {"state": "failed", "reason": str(error)}
    except MemoryError:
        document = {"state": "failed", "reason": "not enough memory (use fewer processes, a shorter record, or a narrower band)"}
    except Exception as error:
        document = {"state": "failed", "reason": f"unexpected {type(error).__name__}: {error} (a fault of the program)"}
    document |= {
        "name": task.name,
        "fingerprint": task.fingerprint,
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "process": os.getpid(),
    }
    path = Path(task.record)
    with writing(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)
    return _told(document)


def _told(document: dict[str, Any]) -> dict[str, Any]:
    return {key: document.get(key) for key in ("state", "reason", "seconds", "cpu_seconds")}


def _run(task: Task) -> dict[str, Any]:
    from operando.pipeline import run

    if in_store(task.path):
        with copied(task.path) as here:
            return _run(replace(task, path=str(here)))
    test = load_member(task.path, task.text, task.title, task.changes)
    if task.idle_from is not None:
        adopt(task.idle_from, task.folder, ("frf", "automatic", "ema"))
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return record_of(run(test, task.folder, until=task.until))
        except BusyError:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)
