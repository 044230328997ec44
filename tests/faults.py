"""Faults at the writes of ``operando run``: a small test, a process that is stopped at its n-th step, and what must be the same after.

A step is whatever changes the results folder: a file opened for writing, a write that leaves the process, a file or folder brought to the
disk, a file or folder made, renamed or removed. The faults are those that happen: the process is killed (half of the write done), the
disk is full (half of the write done, all later ones refused), the user presses Ctrl-C.
"""

from __future__ import annotations

import builtins
import copy
import errno
import functools
import gc
import hashlib
import io
import json
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import measurements
from structures import Chain

FAULTS = ("kill", "full", "interrupt")
EXIT = {"kill": -signal.SIGKILL, "full": 1, "interrupt": 130}
"""How a process ends by each."""

PARTLY = "some of the old results are gone, some are not"
"""What can only be so where the process ends while the old files go, one after the other."""

NOT_COMPARED = ("timings.json", ".stages/answer.json")
"""Outputs that tell how long something took."""


def small_test(folder: Path) -> Path:
    """Two masses, 12 s of records at 256 Hz, 10 to 70 Hz: every stage has work, and all of it takes a second or two."""
    from operando.data import Geometry
    from operando.io import write_uff

    folder.mkdir(parents=True)
    idle = Chain(n=2, mass=2.0, stiffness=4e4, zeta=0.02, seed=3)
    running = copy.copy(idle)
    running.K = running.K + np.diag([0.0, 1.5e4])
    from scipy.linalg import eigh

    w2, running.phi = eigh(running.K, running.M)
    running.hz = np.sqrt(w2) / 2 / np.pi
    make = measurements.record
    write_uff(folder / "idle.uff", make(idle, [0], 5.0, 1, "idle", seconds=12.0))
    write_uff(folder / "operating.uff", make(running, range(2), 5.0, 2, "operating", force_known=False, seconds=24.0))
    write_uff(folder / "check.uff", make(running, [0], 5.0, 3, "check", seconds=12.0))
    write_uff(folder / "geometry.uff", Geometry((1, 2), np.array([[0.0, 0, 0], [1, 0, 0]]), ((1, 2),)))
    path = folder / "test.toml"
    path.write_text(
        'name = "two masses"\n[idle]\nrecords = ["idle.uff"]\n[operating]\nrecords = ["operating.uff"]\n[check]\nrecords = ["check.uff"]\n'
        '[geometry]\nfile = "geometry.uff"\n[analysis]\nband = [10.0, 50.0]\nmax_order = 4\noma_max_order = 6\n'
        'kinds = ["ground_spring", "ground_hysteretic_spring"]\n',
        encoding="utf-8",
    )
    return path


def outputs(folder: Path) -> dict[str, bytes]:
    """Content of every file of a results folder, but for those that tell how long something took."""
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file() and p.name not in NOT_COMPARED}


class Steps:
    """Counts the steps of this process inside a folder, and makes one of them go wrong.

    Parameters
    ----------
    folder : Path
        Results folder; it need not exist.
    fault : str or None
        One of ``FAULTS``, or ``read-only``: every step from ``at`` on is refused; None only counts.
    at : int
        Step (from 1) at which it happens.
    """

    def __init__(self, folder: Path, fault: str | None = None, at: int = 0) -> None:
        self.folder, self.fault, self.at = str(folder.resolve()), fault, at
        self.names: list[str] = []

    def step(self, what: str, name: object, half=None) -> None:
        """One more step; ``half`` does half of it."""
        self.names.append(f"{what} {Path(str(name)).name}")
        now = len(self.names)
        if self.fault is None or now < self.at or (now > self.at and self.fault in ("kill", "interrupt")):
            return
        if self.fault == "read-only":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(name))
        if self.fault == "full":
            if what in ("remove", "rename"):
                return  # these need no room
            if half is not None and now == self.at:
                half()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(name))
        if half is not None:
            half()
        os.kill(os.getpid(), signal.SIGKILL if self.fault == "kill" else signal.SIGINT)

    def inside(self, path: object) -> bool:
        """Whether a path is the folder or in it."""
        text = os.path.abspath(os.fspath(path)) if isinstance(path, str | os.PathLike) else ""
        return text == self.folder or text.startswith(self.folder + os.sep)

    def install(self) -> None:
        """Put the counter before the calls that change files; there is no way back in this process."""
        real_open, steps = builtins.open, self

        class Raw(io.FileIO):
            def write(self, data):
                view = memoryview(data).cast("B")
                steps.step("write", self.name, lambda: super(Raw, self).write(view[: len(view) // 2]))
                return super().write(view)

        def counted_open(file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, **more):
            if not (steps.inside(file) and set(mode) & set("wax+")):
                return real_open(file, mode, buffering, encoding, errors, newline, **more)
            steps.step("open", file)
            stream = io.BufferedWriter(Raw(os.fspath(file), mode.replace("b", "").replace("t", "")))
            return stream if "b" in mode else io.TextIOWrapper(stream, encoding, errors, newline)

        def counted(name, what):
            real = getattr(os, name)

            def call(path, *args, **kwargs):
                if isinstance(path, int) or steps.inside(path):
                    steps.step(what, args[0] if name == "replace" else path)
                return real(path, *args, **kwargs)

            setattr(os, name, call)

        builtins.open = counted_open
        calls = {"replace": "rename", "fsync": "sync", "unlink": "remove", "mkdir": "make folder", "ftruncate": "write"}
        for name, what in calls.items():
            counted(name, what)


def hold_results() -> None:
    """What a stage or the report was once found to be for the same settings is not computed again in this process and its forks.

    Nor are the same results put into the form of HDF5, or taken out of the same file, twice. A sweep over hundreds of steps can then be
    made in minutes: everything that is written is written as ever.
    """
    import operando.io as files
    from operando.data import file_hash
    from operando.pipeline import cache, runner
    from operando.report import page

    kept: dict = {}

    def once(key, make):
        if key not in kept:
            kept[key] = make()
        return kept[key]

    def held(does):
        return functools.wraps(does)(lambda work: dict(once((does.__name__, repr(work.analysis)), lambda: does(work))))

    def write(path, objects, real=files.write_hdf5, **how):
        flat = objects.get("result", objects)
        key = (
            path.name,
            *((repr(v) if name in ("name", "settings", "findings", "left_out", "stages") else id(v)) for name, v in flat.items()),
        )
        if key in kept:
            with files.hdf5.replacing(path) as stream:
                stream.write(kept[key][0])
        else:
            real(path, objects, **how)
            kept[key] = path.read_bytes(), flat  # held on to: no other object gets its id

    render, read = page.render_report, cache._read
    runner.STEPS = tuple(replace(step, does=held(step.does)) for step in runner.STEPS)
    page.render_report = lambda results: once(("report", results.name, repr(results.settings)), lambda: render(results))
    cache._read = lambda path: dict(once(("read", file_hash(path)), lambda: read(path)))
    files.write_hdf5 = write


def problems(fault: str, status: int, out: Path, old: dict[str, bytes], new: dict[str, bytes]) -> list[str]:
    """What is wrong with a results folder after a fault, and with what the process said."""
    log = out.with_name(f"{out.name}.log").read_text(encoding="utf-8")
    found = outputs(out) if out.is_dir() else {}
    wrong = [f"{name} is neither old nor new" for name, data in found.items() if data not in (old.get(name), new.get(name))]
    only_old = [name for name, data in found.items() if data == old.get(name) != new.get(name)]
    only_new = [name for name, data in found.items() if data == new.get(name) != old.get(name)]
    if only_old and only_new:
        wrong.append(f"old {only_old} lie beside new {only_new}")
    if only_old and found != old:
        wrong.append(PARTLY)
    if status != EXIT[fault] and not (fault == "full" and status == 0 and found == new):
        wrong.append(f"exit status {status}")
    if "Traceback" in log:
        wrong.append("a traceback was shown")
    last = log.splitlines()[-1] if log else ""
    if fault == "full" and status == 1 and not (last.startswith("operando: ") and "No space left on device (make room" in last):
        wrong.append(f"said: {last}")
    if fault == "interrupt" and not last.startswith("operando: interrupted"):
        wrong.append(f"said: {last}")
    return wrong


def after_a_clean_run(status: int, out: Path, new: dict[str, bytes], stages: dict[str, bytes]) -> list[str]:
    """What differs from an undisturbed run once the next one has ended."""
    found, kept = outputs(out), stage_results(out)
    wrong = [
        f"{name} differs from that of an undisturbed run" for name in sorted(found.keys() | new.keys()) if found.get(name) != new.get(name)
    ]
    differing = [name for name in sorted(kept.keys() | stages.keys()) if kept.get(name) != stages.get(name)]
    wrong += [f"stage {name} differs from that of an undisturbed run" for name in differing]
    wrong += [f"{p} was left behind" for p in (*out.glob(".*.part"), *(out / ".stages").glob(".*"), *(out / ".stages/new").iterdir())]
    return wrong + ([f"the clean run ended with {status}"] if status else [])


def state(folder: Path) -> str:
    """Hash of all that lies in a results folder, but for how long something took and who held the lock: what the next run goes by."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()) if folder.is_dir() else []:
        name, data = path.relative_to(folder).as_posix(), path.read_bytes()
        if name == ".stages/lock" or name in NOT_COMPARED:
            continue
        if name == ".stages/manifest.json":
            entries = json.loads(data)["files"]
            bare = {n: {k: v for k, v in e.items() if k != "seconds"} for n, e in entries.items() if n not in NOT_COMPARED}
            data = json.dumps(bare).encode()
        if Path(name).parent.name == "new" or name.endswith(".part"):
            data = b""  # removed by the next run, whatever it holds
        digest.update(f"{name} {len(data)}\n".encode() + data)
    return digest.hexdigest()


def stage_results(folder: Path) -> dict[str, bytes]:
    """Content of the kept stage results of a results folder."""
    return {p.name: p.read_bytes() for p in (folder / ".stages").glob("*.h5")}


def run_in_a_fork(
    test: Path, out: Path, fault: str | None = None, at: int = 0, report: Path | None = None, kill_after: float | None = None
) -> int:
    """``operando run`` in a child of this process, with a fault; returns its exit status (negative: the signal that ended it).

    The child has what this process has imported, so that it does not take seconds to begin. ``report`` gets the steps, a line each;
    ``kill_after`` kills the child after so many seconds.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        status = 99
        try:
            log = os.open(out.with_name(f"{out.name}.log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            gc.disable()
            steps = Steps(out, fault, at)
            steps.install()
            sys.argv = ["operando", "run", str(test), "-o", str(out)]
            from operando.__main__ import main

            try:
                main()
                status = 0
            except SystemExit as end:
                status = int(end.code or 0)
            if report is not None:
                report.write_text("\n".join(steps.names))
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
