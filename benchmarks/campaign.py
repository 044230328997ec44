"""A campaign of many simulated tests: speed-up on two processes, growth, the driver's memory, and what is left after kills.

    python benchmarks/campaign.py [FOLDER] [--tests 200] [--json FILE] [--no-kills]

Each test is a chain of four masses at rest, 8 s of random force at 256 Hz, run up to the idle modes: one second or so. The same campaign
runs on one process and on two in turn (one, two, two, one …), then once more on two with a worker killed after a quarter of the tests
and the driver after a half.

The row "by the clock" compares the time by the clock, less what was waited for a processor while other programs had it (the system keeps
count of that, /proc/PID/schedstat): by the workers, and by the driver before there are workers and after the last test. All else that
makes one wait is in it: start, driver, files, caches and memory shared.

The ratio of the other row is of processor time, so that it hangs little on other programs: what the tests took (mean of both campaigns)
and all the rest on one process, over half of the tests' and all of the rest on two (what the driver does, the start of the workers, the
report: as if nothing of it went on beside the tests). What a test costs more beside another one, by caches and memory that they share, is
stated beside. The driver's share grows with the tests by what it took between a quarter of them and the last; with fewer than 200 the row
says what that makes of 200, which is reckoned and not measured (that the report takes 1.6 ms more a test, docs/scale.md, is left out). The
clock is in the file beside, with the processors that others used meanwhile and `busy`, the share of the time that the workers worked.
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
from contextlib import suppress
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
GOAL, GOAL_TESTS = 1.85, 200


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


def processor_s(process: int) -> float:
    """Processor seconds of a process so far, without its children."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0


def waited_s(process: int) -> float:
    """Seconds that a process was ready and had no processor, without its children."""
    with suppress(OSError, IndexError, ValueError):
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9
    return 0.0


def children_of(process: int) -> set[int]:
    """Workers of a driver."""
    with suppress(OSError):
        return {int(c) for task in Path(f"/proc/{process}/task").iterdir() for c in (task / "children").read_text().split()}
    return set()


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
    memory: list[tuple[float, int, float]] = []  # of the driver: its processor seconds, tests done, MB
    free: list[tuple[int, float]] = []  # tests done, seconds less the waiting
    waited: dict[int, float] = {}  # by the workers
    alone: dict[str, float] = {}  # by the driver: until there are workers, until the last test ended, at the end

    def listen() -> None:
        for line in run.stderr or ():
            if ": done in" in line:
                ended.append(time.perf_counter() - wall)

    def watch() -> None:
        while run.poll() is None:
            memory.append((processor_s(run.pid), len(ended), resident_mb(run.pid)))
            workers, own_wait = children_of(run.pid), waited_s(run.pid)
            waited.update({worker: max(waited_s(worker), waited.get(worker, 0.0)) for worker in workers})
            here = time.perf_counter() - wall - sum(waited.values()) / processes
            free.append((len(ended), here - alone.get("start", 0.0)))
            alone["start" if not waited else "tests" if workers else "end"] = own_wait
            time.sleep(0.1)

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
    begin, end = (min(s for n, s in free if n >= limit) for limit in (count // 4, count))
    first, last = (max(s for s, n, _ in memory if n <= limit) for limit in (count // 4, count - 1))
    return {
        "processes": processes,
        "tests": count,
        "wall_s": wall,
        "waited_s": sum(waited.values()) / processes + alone["start"] + alone.get("end", alone["tests"]) - alone["tests"],
        "free_s_a_test": (end - begin) / max(count - count // 4, 1),
        "load": os.getloadavg()[0],
        "cpu_s": cpu,
        "tests_cpu_s": sum(t["cpu_seconds"] for t in document["tests"]),
        "driver_cpu_s": max(s for s, _, _ in memory),
        "driver_cpu_s_a_test": (last - first) / max(count - 1 - count // 4, 1),
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
            os.kill(min(children_of(run.pid)), signal.SIGKILL)
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


def rest_of(run: dict, tests: int) -> float:
    """Processor seconds beside those of the tests, with so many of them instead."""
    return run["cpu_s"] - run["tests_cpu_s"] + (tests - run["tests"]) * run["driver_cpu_s_a_test"]


def speed_up(one: dict, two: dict, tests: int) -> float:
    """Of two processes over one, by processor time, with so many tests."""
    work = 0.5 * (one["tests_cpu_s"] + two["tests_cpu_s"]) * tests / two["tests"]
    return (work + rest_of(one, tests)) / (work / 2 + rest_of(two, tests))


def by_the_clock(runs: list[dict], tests: int) -> tuple[float, float]:
    """Seconds on one process and on two, less the waiting for a processor, with so many tests: means over the runs in turn."""
    free = [(r["processes"], r["wall_s"] - r["waited_s"] + (tests - r["tests"]) * r["free_s_a_test"]) for r in runs]
    one, two = (float(np.mean([s for p, s in free if p == processes])) for processes in (1, 2))
    return one, two


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="where tests and results are kept (default: a temporary folder)")
    parser.add_argument("--tests", type=int, default=200)
    parser.add_argument("--turns", type=int, default=1, help="each of one, two, two, one; with 0 one, two")
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
    turns = [1, 2, 2, 1] * given.turns or [1, 2]
    runs = [measured(campaign, folder / f"out-{p}", p) for p in turns]
    one, two = runs[:2]
    same = all(run["answers"] == one["answers"] for run in runs)
    report: dict = {"runs": runs, "same answers": same}
    if not given.no_kills:
        report["kills"] = killed(campaign, folder / "out-kills", given.tests, one["answers"])
    for run in runs:
        run.pop("answers")
    ratio, at_goal = speed_up(one, two, given.tests), speed_up(one, two, GOAL_TESTS)
    report |= {"speed-up": ratio, f"speed-up, {GOAL_TESTS} tests": at_goal, "by the clock": by_the_clock(runs, given.tests)}
    (folder / "campaign-benchmark.json").write_text(json.dumps(report, indent=1))
    print(json.dumps(report, indent=1))
    memory = two["driver_mb"]
    said = [
        f"{'the same' if same else 'OTHER'} answers",
        f"a test takes {two['tests_cpu_s'] / one['tests_cpu_s']:.2f} times as long beside another",
        f"driver {100 * two['driver_cpu_s'] / two['cpu_s']:.1f} % of all processor time",
        f"{memory['at the last test'] - memory['at a quarter']:+.1f} MB from a quarter of the tests to the last",
    ]
    if "kills" in report:
        kills = report["kills"]
        said.append(f"after SIGKILL of a worker and the driver {kills['lost']} lost, {kills['done_twice']} done twice")
    if given.tests < GOAL_TESTS:
        said.append(f"measured {ratio:.3f}, the ratio is reckoned for {GOAL_TESTS} tests")
    row = {"stage": "Campaign, processor time", "size": f"{given.tests} tests on 2 processes", "peer": "one process"}
    row |= {"ours_s": two["cpu_s"] - two["tests_cpu_s"] / 2, "peer_s": one["cpu_s"]}
    row |= {"ratio": at_goal if given.tests < GOAL_TESTS else ratio, "goal": GOAL, "accuracy": "; ".join(said)}
    row |= {"ours_mb": memory["with the report"], "peer_mb": one["driver_mb"]["with the report"]}
    clocks = {n: by_the_clock(runs, n) for n in sorted({given.tests, max(given.tests, GOAL_TESTS)})}
    walls = "; ".join(f"{r['processes']}: {r['wall_s']:.0f} s, {r['waited_s']:.0f} s of them waiting, load {r['load']:.0f}" for r in runs)
    told = "; ".join(f"{n} tests: {a:.0f} s and {b:.0f} s, ratio {a / b:.3f}" for n, (a, b) in clocks.items())
    (a, b), size = clocks[max(clocks)], row["size"]
    clock = {"stage": "Campaign, by the clock", "size": size, "ours_s": b, "peer": "one process", "peer_s": a, "ratio": a / b, "goal": GOAL}
    reckoned = ", reckoned from these by what a test takes from a quarter of them on" if len(clocks) > 1 else ""
    clock |= {"ours_mb": None, "peer_mb": None, "accuracy": f"less waiting for a processor; {told}{reckoned}; processes, clock: {walls}"}
    if given.json:
        given.json.write_text(json.dumps([row, clock], indent=1))
    if not same or any(report.get("kills", {}).get(what) for what in ("lost", "done_twice")):
        raise SystemExit("tests lost, done twice, or with other answers")


if __name__ == "__main__":
    main()
