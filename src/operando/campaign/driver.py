"""Runs the tests of a campaign on whatever workers there are, and goes on where an earlier call ended."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from operando.atomic import write_json, writing
from operando.campaign.cluster import dask_pool
from operando.campaign.config import Campaign, Member, Workers, load_campaign, load_member
from operando.campaign.document import document_of
from operando.campaign.local import local_pool
from operando.campaign.outputs import write_outputs
from operando.campaign.task import Task, fingerprint, fingerprint_in_store, read_record, settled
from operando.config import Test
from operando.errors import ConfigError, OperandoError
from operando.jsonable import jsonable
from operando.pipeline.folder import HIDDEN
from operando.pipeline.lock import exclusive
from operando.pipeline.runner import check_progress
from operando.threads import cores

Progress = Callable[[str], None]


def run_campaign(
    campaign: Campaign | str | Path,
    out: str | Path,
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    changes: Sequence[str] = (),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run many tests and put together what they found.

    Each test has a results folder of its own, ``DIR/tests/NAME``, as ``operando run`` makes it. A test that is done is not run
    again as long as its files, settings and the code are the same; one that was interrupted goes on from its last finished stage.
    A test that fails is listed with the reason, and tried again by the next call.

    Parameters
    ----------
    campaign : Campaign or path
        Campaign or campaign file.
    out : path
        Results folder of the campaign; made where it is missing.
    processes : int, optional
        Local processes (default: as in the file, else one a processor).
    scheduler : str, optional
        Address of a Dask scheduler whose workers see the files under the same paths.
    changes : sequence of str, optional
        Entries of every test file to be changed, each ``section.key=value``.
    progress : callable, optional
        Called with what happens, in words.

    Returns
    -------
    dict
        The document ``operando/campaign/1``, which also stands in ``DIR/campaign.json``.

    Raises
    ------
    ConfigError
        If the campaign file is wrong, or no test can be read with the changes; nothing is written then.
    BusyError
        If another campaign is at work in the folder.
    """
    if not isinstance(campaign, Campaign):
        campaign = load_campaign(campaign)
    check_progress(progress)
    workers = campaign.workers
    if processes is not None:
        workers = Workers(processes=processes)
    if scheduler is not None:
        workers = replace(workers, scheduler=scheduler, cluster=None)
    out = Path(out).absolute()
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file, expected a folder for the results", where=str(out), hint="choose another name with -o")
    _check_changes(campaign, changes)
    with writing(out):
        (out / HIDDEN).mkdir(parents=True, exist_ok=True)
    with exclusive(out / HIDDEN / "lock", "campaign"):
        run = _Run(campaign, out, workers, changes, progress or (lambda text: None))
        run.all()
        run.say("campaign: table and report …")
        document = document_of(campaign, run.records, run.counts())
        write_outputs(out, document)
        return document


def _check_changes(campaign: Campaign, changes: Sequence[str]) -> None:
    """Refuse changes that no test can be read with, before they write over what earlier calls found."""
    fault: OperandoError | None = None
    for member in campaign.members if changes else ():
        if isinstance(member.path, str):
            return  # in an object store: its worker reads it
        title = campaign.title(member)
        try:
            load_member(member.path, member.text, title, member.row.changes)
        except (OperandoError, OSError):
            continue  # this one fails by itself, which the table says
        try:
            load_member(member.path, member.text, title, (*member.row.changes, *changes))
            return
        except OperandoError as error:
            fault = fault or error
    if fault is not None:
        raise fault


@dataclass(slots=True)
class _Group:
    """Tests with the same files at rest: one runs first, the others take its stages at rest over."""

    first: str | None = None
    folder: str | None = None
    waiting: list[tuple[Member, str]] = field(default_factory=list)


class _Run:
    """State of one call of :func:`run_campaign`."""

    def __init__(self, campaign: Campaign, out: Path, workers: Workers, changes: Sequence[str], say: Progress) -> None:
        self.campaign, self.out, self.workers, self.changes = campaign, out, workers, tuple(changes)
        self._progress = say
        self.start = time.perf_counter()
        self.unchanged = self.ended = self.failed = 0
        self.work_s = 0.0
        self.fingerprints: dict[str, str] = {}
        self._groups: dict[str, _Group] = {}
        self._in_group: dict[str, str] = {}
        self._freed: deque[tuple[Member, str, str | None]] = deque()

    def say(self, text: str) -> None:
        """Progress, with the seconds since the start."""
        self._progress(f"[{time.perf_counter() - self.start:6.1f} s] {text}")

    def counts(self) -> dict[str, Any]:
        """What this call did."""
        return {"run": self.ended, "unchanged": self.unchanged, "seconds": time.perf_counter() - self.start, "work_seconds": self.work_s}

    def all(self) -> None:
        """All tests that are not done; at most two a worker are on their way, so that memory does not grow with the campaign."""
        count = len(self.campaign.members)
        self.say(f"campaign {self.campaign.name}: {count} tests")
        with ExitStack() as stack:
            pool: Any = None
            under_way = 0
            tasks = self._tasks()
            while True:
                while pool is None or under_way < 2 * pool.size:
                    task = self._freed_task() or next(tasks, None)
                    if task is None:
                        break
                    pool = pool or self._pool(stack)
                    pool.submit(task)
                    under_way += 1
                if not under_way:
                    break
                self._ended(*pool.next_answer())
                under_way -= 1
        if self.unchanged:
            self.say(f"{self.unchanged} of {count} tests were done before and have not changed")

    def _pool(self, stack: ExitStack) -> Any:
        if self.workers.scheduler is not None or self.workers.cluster is not None:
            return stack.enter_context(dask_pool(self.workers, self.say))
        left = len(self.campaign.members) - self.unchanged - self.failed
        size = min(self.workers.processes or cores(), max(left, 1))
        return stack.enter_context(local_pool(size, self.out / HIDDEN / "logs", self.say))

    def _tasks(self) -> Iterator[Task]:
        """Tests to be run, made one by one; those whose files at rest another test is working on wait for it."""
        for member in self.campaign.members:
            record = self._record_file(member)
            try:
                test, mark = self._loaded(member)
                self.fingerprints[member.name] = mark
            except (OperandoError, OSError) as error:
                self._not_begun(member, record, error)
                continue
            group = self._groups.setdefault(key, _Group()) if (key := _at_rest(test)) is not None else None
            if settled(read_record(record, mark)):
                self.unchanged += 1
                if group is not None and group.folder is None:
                    group.folder = self._folder(member)
                continue
            if group is None or key is None:
                yield self._task(member, mark, None)
                continue
            self._in_group[member.name] = key
            if group.folder is None and group.first is not None:
                group.waiting.append((member, mark))
            else:
                group.first = group.first or member.name
                yield self._task(member, mark, group.folder)

    def _loaded(self, member: Member) -> tuple[Test | None, str]:
        """A test and its fingerprint; one in an object store is read by its worker alone."""
        changes = (*member.row.changes, *self.changes)
        if isinstance(member.path, str):
            return None, fingerprint_in_store(member.path, changes, self.campaign.until)
        test = load_member(member.path, member.text, self.campaign.title(member), changes)
        return test, fingerprint(test, self.campaign.until)

    def _task(self, member: Member, mark: str, idle_from: str | None) -> Task:
        changes = (*member.row.changes, *self.changes)
        path, record = member.path if isinstance(member.path, str) else str(member.path.absolute()), str(self._record_file(member))
        return Task(
            member.name, path, member.text, self.campaign.title(member), changes, self._folder(member), record, self.campaign.until, mark,
            idle_from,
        )  # fmt: skip

    def _folder(self, member: Member) -> str:
        return str(self.out / "tests" / member.name)

    def _freed_task(self) -> Task | None:
        """A test that waited for another and need not wait any more."""
        return self._task(*self._freed.popleft()) if self._freed else None

    def _ended(self, task: Task, answer: dict[str, Any]) -> None:
        """Count and tell what ended; free the tests that waited for it."""
        self.ended += 1
        self.work_s += answer.get("seconds") or 0.0
        state, reason = answer["state"], answer.get("reason")
        if state == "failed":
            self.failed += 1
            if (read_record(task.record, task.fingerprint) or {}).get("reason") != reason:  # a lost worker writes none
                self._keep(Path(task.record), task.name, task.fingerprint, str(reason))
        seconds = f" in {answer['seconds']:.1f} s" if answer.get("seconds") is not None else ""
        count = len(self.campaign.members)
        done = self.unchanged + self.ended
        self.say(f"{done}/{count} {task.name}: {state}{seconds}" + (f": {reason}" if reason else "") + self._left(count - done))
        key = self._in_group.pop(task.name, None)
        if key is None:
            return
        group = self._groups[key]
        if group.folder is None:
            group.first, group.folder = None, None if state == "failed" else task.folder
        free = len(group.waiting) if group.folder is not None else min(1, len(group.waiting))
        self._freed.extend((member, mark, group.folder) for member, mark in group.waiting[:free])
        group.first = group.waiting[0][0].name if free else group.first
        del group.waiting[:free]

    def _left(self, count: int) -> str:
        if count < 1 or self.ended < 3:
            return ""
        left = (time.perf_counter() - self.start) / self.ended * count
        return f" (about {left / 60:.0f} min left)" if left > 90 else f" (about {left:.0f} s left)"

    def _record_file(self, member: Member) -> Path:
        return self.out / HIDDEN / "records" / f"{member.name}.json"

    def _not_begun(self, member: Member, record: Path, error: Exception) -> None:
        self.failed += 1
        self.ended += 1
        self.fingerprints[member.name] = ""
        self._keep(record, member.name, "", str(error))
        self.say(f"{self.unchanged + self.ended}/{len(self.campaign.members)} {member.name}: failed: {error}")

    def _keep(self, record: Path, name: str, mark: str, reason: str) -> None:
        with writing(record.parent):
            record.parent.mkdir(parents=True, exist_ok=True)
        write_json(record, {"state": "failed", "reason": reason, "name": name, "fingerprint": mark})

    def records(self, members: Sequence[Member]) -> Iterator[dict[str, Any]]:
        """Records of tests, read one by one."""
        for member in members:
            found = read_record(self._record_file(member), self.fingerprints.get(member.name, ""))
            yield found or {"state": "failed", "reason": "its record cannot be read", "name": member.name}


def _at_rest(test: Test | None) -> str | None:
    """What tests that share their files at rest have in common; whether settings agree as well is for the run to see."""
    if test is None or not test.idle:
        return None
    files = [(str(file), repr(span)) for file, span in (*test.idle.runs, *((f, None) for f in test.idle.frfs))]
    return hashlib.sha256(repr((files, jsonable(test.units))).encode()).hexdigest()
