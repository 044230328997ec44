"""A campaign of many simulated tests: speed-up on two processes, growth, the driver's memory, and what is left after kills.

    python benchmarks/campaign.py [FOLDER] [--tests 200] [--json FILE] [--no-kills]

Each test is a chain of four masses at rest, 8 s of random force at 256 Hz, run up to the idle modes: one second or so. The same campaign
runs on one process and on two, then once more on two with a worker killed after a quarter of the tests and the driver after a half.
Other programs on the machine are counted (processors they used meanwhile); `busy` is the share of the time that the workers were at
work, which does not hang on them. Where they used more than a tenth of a processor, the clock compares nothing: the ratio in the row is
then what two free processors would give, by `busy` and the processor time of the tests, and the row says so.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
GOAL = 1.85
QUIET = 0.1


def write_tests(folder: Path, count: int) -> Path:
    """Test files and records, and the campaign file."""
    sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]
    from scipy.linalg import eigh

    from measurements import idle_chain, record
    from operando.io import write_uff

    for i in range(count):
        here = folder / "runs" / f"{1000 + i}"
        if (here / "test.toml").exists():
            continue
        here.mkdir(parents=True)
        chain = copy.copy(idle_chain())
        chain.K = chain.K * (1 + 0.1 * i / count) + np.diag([0.0, 0.0, 2e4 * (i >= 0.6 * count), 0.0])
        w2, chain.phi = eigh(chain.K, chain.M)
        chain.hz = np.sqrt(w2) / 2 / np.pi
        write_uff(here / "idle.uff", record(chain, [0], 5.0, i, "idle", seconds=8.0))
        (here / "test.toml").write_text('[idle]\nrecords = ["idle.uff"]\n[analysis]\nband = [10.0, 90.0]\n')
    path = folder / "campaign.toml"
    path.write_text(f'name = "{count} chains"\ntests = ["runs/{{speed}}/test.toml"]\nuntil = "ema"\n')
    return path


def jiffies() -> float:
    """Processor seconds used by everybody since the machine started."""
    with open("/proc/stat") as stream:
        user, nice, system, _, _, irq, soft = map(int, stream.readline().split()[1:8])
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


def resident_mb(process: int) -> float:
    """Resident memory now."""
    try:
        with open(f"/proc/{process}/statm") as stream:
            return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, IndexError, ValueError):
        return 0.0


def command(campaign: Path, out: Path, processes: int) -> list[str]:
    return [sys.executable, "-m", "operando", "campaign", str(campaign), "-o", str(out), "-p", str(processes), "--json"]


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def measured(campaign: Path, out: Path, processes: int) -> dict:
    """One campaign from nothing: times, the driver's memory as it goes, when each test ended."""
    shutil.rmtree(out, ignore_errors=True)
    everybody, own, wall = jiffies(), resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = subprocess.Popen(command(campaign, out, processes), env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    ended: list[float] = []
    memory: list[tuple[float, int, float]] = []

    def listen() -> None:
        for line in run.stderr or ():
            if ": done in" in line:
                ended.append(time.perf_counter() - wall)

    def watch() -> None:
        while run.poll() is None:
            memory.append((time.perf_counter() - wall, len(ended), resident_mb(run.pid)))
            time.sleep(0.25)

    threads = [threading.Thread(target=f, daemon=True) for f in (listen, watch)]
    for thread in threads:
        thread.start()
    assert run.stdout is not None
    document = json.loads(run.stdout.read())
    run.wait()
    wall, used = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = used.ru_utime + used.ru_stime - own.ru_utime - own.ru_stime
    count = len(document["tests"])
    assert document["counts"]["done"] == count, document["counts"]
    quarter = [m for _, n, m in memory if n >= count // 4]
    seconds = [t["seconds"] for t in document["tests"]]
    return {
        "processes": processes,
        "tests": count,
        "wall_s": wall,
        "cpu_s": cpu,
        "tests_cpu_s": sum(t["cpu_seconds"] for t in document["tests"]),
        "busy": sum(seconds) / (processes * (ended[-1])),
        "others_processors": (jiffies() - everybody - cpu) / wall,
        "ended_s": {n: ended[n - 1] for n in (count // 8, count // 4, count // 2, count) if 0 < n <= len(ended)},
        "driver_mb": {
            "at a quarter": quarter[0],
            "at the last test": max(m for _, n, m in memory if n < count) if count > 1 else quarter[-1],
            "with the report": max(m for _, _, m in memory),
        },
        "answers": [[p["frequency_hz"] for p in t["points"]] for t in document["idle"]["tracks"]],
    }


def records(out: Path) -> dict[str, int]:
    """Tests that ended, and when each record was written."""
    return {f.stem: f.stat().st_mtime_ns for f in (out / ".stages" / "records").glob("*.json")}


def killed(campaign: Path, out: Path, count: int, answers: list) -> dict:
    """Two processes; SIGKILL of a worker at a quarter, of the driver at a half; then the same command again."""
    shutil.rmtree(out, ignore_errors=True)
    run = subprocess.Popen(command(campaign, out, 2), env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    lost, seen = 0, 0
    for line in run.stderr or ():
        seen += ": done in" in line
        lost += "was lost" in line
        if seen == count // 4 and not lost:
            workers = {int(c) for t in Path(f"/proc/{run.pid}/task").iterdir() for c in (t / "children").read_text().split()}
            os.kill(min(workers), signal.SIGKILL)
            lost = 1
        if seen == count // 2:
            os.kill(run.pid, signal.SIGKILL)
            break
    run.wait()
    time.sleep(2.0)  # the workers see that their driver is gone
    before = records(out)
    done = subprocess.run(command(campaign, out, 2), env=environment(), capture_output=True, text=True, check=True)
    document, after = json.loads(done.stdout), records(out)
    found = [[p["frequency_hz"] for p in t["points"]] for t in document["idle"]["tracks"]]
    return {
        "done_before_the_kill": len(before),
        "run_after": document["counts"]["run"],
        "unchanged": document["counts"]["unchanged"],
        "done_twice": sum(after[name] != when for name, when in before.items()),
        "lost": count - document["counts"]["done"],
        "same_answers": found == answers,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="where tests and results are kept (default: a temporary folder)")
    parser.add_argument("--tests", type=int, default=200)
    parser.add_argument("--json", type=Path, help="rows for benchmarks/bench.py")
    parser.add_argument("--no-kills", action="store_true")
    given = parser.parse_args()
    if given.folder is None:
        with tempfile.TemporaryDirectory() as folder:
            return compare(Path(folder), given)
    compare(given.folder, given)


def compare(folder: Path, given: argparse.Namespace) -> None:
    """All runs, printed and written."""
    campaign = write_tests(folder, given.tests)
    one, two = (measured(campaign, folder / f"out-{p}", p) for p in (1, 2))
    same = one["answers"] == two["answers"]
    report: dict = {"one": one, "two": two, "same answers": same}
    if not given.no_kills:
        report["kills"] = killed(campaign, folder / "out-kills", given.tests, one["answers"])
    for part in (one, two):
        part.pop("answers")
    ratio = one["wall_s"] / two["wall_s"]
    # what two free processors would give: the share of time the workers work, and what a test costs beside another one
    free = 2 * two["busy"] / one["busy"] * one["tests_cpu_s"] / two["tests_cpu_s"]
    quiet = max(one["others_processors"], two["others_processors"]) < QUIET
    report |= {"speed-up": ratio, "speed-up on free processors": free}
    (folder / "campaign-benchmark.json").write_text(json.dumps(report, indent=1))
    print(json.dumps(report, indent=1))
    how = (
        f"{'the same' if same else 'OTHER'} answers; workers busy {two['busy']:.3f}; others used {two['others_processors']:.2f} processors"
    )
    row = {"stage": "campaign", "size": f"{given.tests} tests on 2 processes", "ours_s": two["wall_s"], "peer": "one process"}
    row |= {"peer_s": one["wall_s"], "ratio": ratio if quiet else free, "goal": GOAL, "ours_mb": two["driver_mb"]["with the report"]}
    row |= {
        "peer_mb": one["driver_mb"]["with the report"],
        "accuracy": f"{how}; ratio {'by the clock' if quiet else f'reckoned for free processors, by the clock {ratio:.2f}'}",
    }
    if given.json:
        given.json.write_text(json.dumps([row], indent=1))


if __name__ == "__main__":
    main()
