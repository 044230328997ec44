"""Faults at every write of ``operando run``, and kills at random times; then a clean run, and every output bit for bit.

    python benchmarks/faults/sweep.py writes  [--every 1]   # each step × killed, disk full, Ctrl-C, over older results
    python benchmarks/faults/sweep.py stages                # one write of each stage × the three, everything computed again
    python benchmarks/faults/sweep.py kills   [--count 200] # SIGKILL at random times
    python benchmarks/faults/sweep.py kills-computing       # the same, everything computed again
    python benchmarks/faults/sweep.py outputs               # each output missing, emptied, cut, altered

Each adds its table to ``benchmarks/results/faults.json``. The test and the injector are those of ``tests/faults.py``.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path.insert(0, str(HERE.parents[2] / "tests"))

import faults  # noqa: E402

RESULTS = HERE.parents[1] / "results" / "faults.json"


def warm(test: Path, out: Path) -> None:
    """One run in this process, so that its forks find everything imported."""
    from operando.pipeline import run

    run(test, out)
    shutil.rmtree(out)


def tests(folder: Path) -> tuple[Path, Path]:
    """The small test, and the same with another band and block length, whose results are the old ones."""
    new = faults.small_test(folder / "test")
    old = new.with_name("old.toml")
    old.write_text(new.read_text().replace("band = [10.0, 50.0]", "band = [12.0, 48.0]\nblock_seconds = 2.0"))
    return new, old


def reference(test: Path, out: Path) -> tuple[dict[str, bytes], dict[str, bytes], list[str]]:
    """Outputs and stage results of an undisturbed run, and its steps."""
    steps = out.with_name(f"{out.name}.steps")
    status = faults.run_in_a_fork(test, out, report=steps)
    assert status == 0, out.with_name(f"{out.name}.log").read_text()
    return faults.outputs(out), faults.stage_results(out), steps.read_text().splitlines()


class Check:
    """Faults at steps of a run and the clean run after each; of states that are the same on the disk the clean run is made once."""

    def __init__(self, test: Path, out: Path, old: dict[str, bytes], new: dict[str, bytes], stages: dict[str, bytes]) -> None:
        self.test, self.out, self.old, self.new, self.stages = test, out, old, new, stages
        self.cleaned: dict[str, list[str]] = {}
        self.faults = 0

    def __call__(self, start: Path | None, fault: str, at: int) -> list[str]:
        """What is wrong after a fault at a step of a run on a copy of ``start``, and after the clean run."""
        shutil.rmtree(self.out, ignore_errors=True)
        if start is not None:
            shutil.copytree(start, self.out)
        self.faults += 1
        wrong = faults.problems(fault, faults.run_in_a_fork(self.test, self.out, fault, at), self.out, self.old, self.new)
        state = faults.state(self.out)
        if state not in self.cleaned:
            status = faults.run_in_a_fork(self.test, self.out)
            self.cleaned[state] = faults.after_a_clean_run(status, self.out, self.new, self.stages)
        return wrong + self.cleaned[state]


def writes(base: Path, every: int) -> dict:
    """A fault at every step of a run, each stage from where the one before it ended, over older results and into an empty place."""
    faults.hold_results()
    new_test, old_test = tests(base)
    for test in (new_test, old_test):
        warm(test, base / "warm")
    old, _, _ = reference(old_test, base / "old")
    new, stages, _ = reference(new_test, base / "new")
    table: dict = {"files": {name: len(data) for name, data in sorted(new.items())}}
    for title, start, before, stride in (("over older results", base / "old", old, every), ("into an empty place", None, {}, 3 * every)):
        check = Check(new_test, base / "out", before, new, stages)
        kinds: Counter[str] = Counter()
        failed: dict = {}
        partly = 0
        for number in range(100):
            shutil.rmtree(base / "next", ignore_errors=True)
            if start is not None:
                shutil.copytree(start, base / "next")
            _, _, steps = reference(new_test, base / "next")
            ends = [at for at, name in enumerate(steps, start=1) if name == "rename manifest.json"]
            last = ends[0] + 2 if len(ends) > 1 else len(steps)
            for fault in faults.FAULTS:
                for at in range(1, last + 1, stride):
                    kinds[steps[at - 1].split()[0]] += 1
                    wrong = check(start, fault, at)
                    if wrong == [faults.PARTLY] and steps[at - 1].startswith("remove "):
                        partly += 1
                    elif wrong:
                        failed[f"part {number}, step {at} {steps[at - 1]}, {fault}"] = wrong
                        print(title, number, fault, at, steps[at - 1], wrong, flush=True)
            print(
                title, "part", number, "steps", last, "faults", check.faults, "states", len(check.cleaned), "wrong", len(failed), flush=True
            )
            if len(ends) < 2:
                break
            shutil.rmtree(base / "out", ignore_errors=True)  # the state at the end of this part is where the next one starts
            if start is not None:
                shutil.copytree(start, base / "out")
            assert faults.run_in_a_fork(new_test, base / "out", "kill", last + 1) == faults.EXIT["kill"]
            start = base / f"{title[:4]}{number}"
            shutil.copytree(base / "out", start)
        table[title] = {
            "faults (killed, disk full, Ctrl-C)": check.faults,
            "at steps": dict(kinds),
            "different states on the disk, each followed by a clean run": len(check.cleaned),
            "of these ended while the old files went: some gone, some still there, none new": partly,
            "not bit-equal or otherwise wrong": failed,
        }
    return table


def stages(base: Path) -> dict:
    """A fault at the first write of each stage and output, everything computed."""
    test, _ = tests(base)
    warm(test, base / "warm")
    new, kept, steps = reference(test, base / "new")
    points = {}
    for at, name in enumerate(steps, start=1):
        if name.startswith("write "):
            points.setdefault(name.removeprefix("write ").lstrip(".").split(".")[0], at)
    check = Check(test, base / "out", {}, new, kept)
    failed = {}
    for name, at in points.items():
        for fault in faults.FAULTS:
            wrong = check(None, fault, at)
            print(name, at, fault, wrong or "bit-equal", flush=True)
            if wrong:
                failed[f"{at} {steps[at - 1]}, {fault}"] = wrong
    return {"files": list(points), "faults": len(points) * len(faults.FAULTS), "not bit-equal or otherwise wrong": failed}


def kills(base: Path, count: int, held: bool) -> dict:
    """SIGKILL at random times of the whole run, then a clean run."""
    if held:
        faults.hold_results()
    test, _ = tests(base)
    warm(test, base / "warm")
    new, kept, _ = reference(test, base / "new")
    shutil.rmtree(base / "new")
    started = time.perf_counter()
    assert reference(test, base / "new")[0] == new
    seconds = time.perf_counter() - started
    rng = random.Random(18)
    failed, at_stage = {}, Counter()
    while sum(at_stage.values()) < count:  # those that come after the end of the run do not count
        out = base / "out"
        shutil.rmtree(out, ignore_errors=True)
        delay = rng.uniform(0.0, seconds)
        status = faults.run_in_a_fork(test, out, kill_after=delay)
        log = (base / "out.log").read_text()
        if status == 0:
            continue
        told = re.findall(r"s\] (\w+)", log)
        at_stage[told[-1] if told else "start"] += 1
        number = sum(at_stage.values())
        wrong = faults.problems("kill", status, out, {}, new)
        wrong += faults.after_a_clean_run(faults.run_in_a_fork(test, out), out, new, kept)
        if wrong:
            failed[f"{number} after {delay:.3f} s"] = wrong
        print(number, f"{delay:.2f} s", wrong or "bit-equal", flush=True)
    return {"kills": count, "seconds of a run": round(seconds, 1), "killed in": dict(at_stage), "not bit-equal or otherwise wrong": failed}


def spoilt(base: Path) -> dict:
    """Each output missing, emptied, cut in half, altered in one byte; then a run."""
    faults.hold_results()
    test, _ = tests(base)
    warm(test, base / "warm")
    out = base / "out"
    new, kept, _ = reference(test, out)
    new |= {name: (out / name).read_bytes() for name in faults.NOT_COMPARED}
    failed, count = {}, 0
    for name in list(new):
        data = (out / name).read_bytes()
        if name in faults.NOT_COMPARED:
            new[name] = data
        middle = len(data) // 2
        ways = {
            "emptied": b"",
            "cut": data[:middle],
            "altered": data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :],
            "missing": None,
        }
        for way, content in ways.items():
            if content is None:
                (out / name).unlink()
            else:
                (out / name).write_bytes(content)
            count += 1
            if name == "report.html":  # made again, it takes another time
                new = {other: was for other, was in new.items() if other not in faults.NOT_COMPARED}
            wrong = faults.after_a_clean_run(faults.run_in_a_fork(test, out), out, faults.outputs(out), kept)
            wrong += [f"{other} differs" for other, was in new.items() if not (out / other).is_file() or (out / other).read_bytes() != was]
            print(name, way, wrong or "bit-equal", flush=True)
            if wrong:
                failed[f"{name} {way}"] = wrong
    return {"spoilt": count, "not bit-equal or otherwise wrong": failed}


def main() -> None:
    """Run one of them and keep its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["writes", "stages", "kills", "kills-computing", "outputs"])
    parser.add_argument("--every", type=int, default=1, help="writes: every n-th step")
    parser.add_argument("--count", type=int, default=200, help="kills: how many")
    given = parser.parse_args()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        ways = {
            "writes": lambda: writes(base, given.every),
            "stages": lambda: stages(base),
            "kills": lambda: kills(base, given.count, held=True),
            "kills-computing": lambda: kills(base, given.count, held=False),
            "outputs": lambda: spoilt(base),
        }
        table = ways[given.what]()
    table["minutes"] = round((time.perf_counter() - started) / 60, 1)
    known = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    RESULTS.write_text(json.dumps(known | {given.what: table}, indent=1) + "\n")
    print(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
