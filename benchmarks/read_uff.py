"""Reading and writing of UFF 58 and 58b: time against a raw read or write of the same bytes and against pyuff, and peak memory.

Run: python benchmarks/read_uff.py [--repeat 9] [--against FOLDER] [-o benchmarks/results/uff_speed] [--json FILE]

All tasks run in turn, so that a busy machine meets each alike; medians count. FOLDER is the ``src`` folder of an older version. Both ways
of writing make a new file: the system takes three times as long to write beside a file that is still there as over it, whoever writes.
All samples are brought into memory, also of files whose samples would stay there.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

CHANNELS, SAMPLES = 64, 1_000_000
FILES = {
    "small": "records, 58b, 8 x 100000", "ascii": "records, ASCII 58, 8 x 100000", "by_pyuff": "the same, written by pyuff",
    "frfs": "FRFs, ASCII 58, 20 x 4 x 2000", "many": "records, 58b, 500 sets of 64",
}  # fmt: skip
KINDS = ("clock", "processor")
GOALS = {"write": 1.2, "read": 1.2, "memory": 1.2, "ascii": 6.0, "by_pyuff": 6.0, "frfs": 6.0, "many": 1.5}


def make_record(channels: int, samples: int) -> Any:
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof

    data = np.random.default_rng(0).standard_normal((channels, samples))
    return TimeRecord(data, 51200.0, tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2", f"a{i + 1}") for i in range(channels)))


def make_frf() -> Any:
    from operando.data import FrequencyAxis, Frf
    from operando.dof import Dof

    parts = np.random.default_rng(1).standard_normal((2, 20, 4, 2000))
    responses, references = tuple(Dof(i + 1, "Z") for i in range(20)), tuple(Dof(i + 1, "Z") for i in range(4))
    return Frf(parts[0] + 1j * parts[1], FrequencyAxis(np.arange(2000) * 0.5), responses, references, "accelerance")


def make_files(folder: Path) -> None:
    import pyuff

    from operando.io import write_uff

    small = make_record(8, 100_000)
    write_uff(folder / "small", small)
    write_uff(folder / "ascii", small, binary=False)
    write_uff(folder / "frfs", make_frf(), binary=False)
    write_uff(folder / "many", make_record(500, 64))
    pyuff.UFF(str(folder / "by_pyuff")).write_sets(pyuff.UFF(str(folder / "ascii")).read_sets(), "overwrite")


def raw_read(path: Path) -> None:
    """Read the bytes into one fresh buffer of their size, as any reader must at least."""
    buffer = np.empty(path.stat().st_size, np.uint8)
    with open(path, "rb") as stream:
        stream.readinto(buffer.data)


def raw_write(path: Path, data: np.ndarray) -> None:
    """Write the bytes and bring them to the disk, as operando does with every file (versions before 82e57c0 did not)."""
    with open(path, "wb") as stream:
        stream.write(data.data)
        stream.flush()
        os.fsync(stream.fileno())


def serve(folder: Path) -> None:
    """Do tasks named on stdin, answer with the seconds each took by the clock and of the processor."""
    import pyuff

    from operando.io import read, write_uff

    record = make_record(CHANNELS, SAMPLES)
    own = folder / f"big{os.getpid()}"
    tasks: dict[str, Callable[[], object]] = {
        "raw write": lambda: raw_write(folder / f"raw{os.getpid()}", record.data),
        "write": lambda: write_uff(own, record),
        "raw read": lambda: raw_read(own),
        "read": lambda: np.asarray(read(own).records[0].data),
    }
    for name in FILES:
        tasks[name] = lambda path=folder / name: read(path)
        tasks[f"pyuff {name}"] = lambda path=folder / name: pyuff.UFF(str(path)).read_sets()
    for line in sys.stdin:
        if "write" in line:
            (own if line.strip() == "write" else folder / f"raw{os.getpid()}").unlink(missing_ok=True)
        else:
            tasks[line.strip()]()  # the first time, the system moves pages and memory about
        start, computing = time.perf_counter(), time.process_time()
        result = tasks[line.strip()]()
        print(time.perf_counter() - start, time.process_time() - computing, flush=True)
        del result


class Worker:
    """A process that does tasks with one version of operando."""

    def __init__(self, source: str, folder: Path) -> None:
        command = [sys.executable, __file__, "--serve", str(folder)]
        environment = os.environ | {"PYTHONPATH": source, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1, env=environment)

    def seconds(self, task: str) -> tuple[float, float]:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(task + "\n")
        clock, computing = self.process.stdout.readline().split()
        return float(clock), float(computing)

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def peak_memory(code: str, source: str) -> float:
    """Peak resident memory [bytes] of a fresh interpreter that runs the code."""
    # VmHWM starts anew with the program, ru_maxrss does not.
    script = code + "\nprint(next(l.split()[1] for l in open('/proc/self/status') if l.startswith('VmHWM')))"
    environment = os.environ | {"PYTHONPATH": source}
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    return float(out.stdout.split()[-1]) * 1024


def memory_of_reading(source: str, folder: Path) -> float:
    """Peak memory of reading the large file over the size of its data."""
    path = next(folder.glob("big*"))
    base = peak_memory("import numpy, operando.io", source)
    code = f"import numpy; from operando.io import read; x = numpy.asarray(read({str(path)!r}).records[0].data)"
    return (peak_memory(code, source) - base) / (8 * CHANNELS * SAMPLES)


def measure(sources: dict[str, str], folder: Path, repeat: int) -> dict[str, Any]:
    workers = {name: Worker(source, folder) for name, source in sources.items()}
    names = ["raw write", "write", "raw read", "read", *FILES]
    times: dict[str, list[tuple[float, float]]] = {}
    for turn in range(repeat + 1):  # the first turn warms the caches
        for task in names:
            # The first to come pays for what the system still does for the task before: each is first in turn.
            for name in (list(workers), list(workers)[::-1])[turn % 2]:
                seconds = workers[name].seconds(task)
                if turn:
                    times.setdefault(f"{name}: {task}", []).append(seconds)
        for task in FILES:
            seconds = workers["now"].seconds(f"pyuff {task}")
            if turn:
                times.setdefault(f"pyuff: {task}", []).append(seconds)
    for worker in workers.values():
        worker.end()
    seconds_of = {task: dict(zip(KINDS, map(median, zip(*t, strict=True)), strict=True)) for task, t in times.items()}
    ratios = {name: {kind: _ratios(seconds_of, name, names, kind) for kind in KINDS} for name in sources}
    memory = {name: memory_of_reading(source, folder) for name, source in sources.items()}
    return {"repeat": repeat, "load": os.getloadavg(), "ratios": ratios, "memory": memory, "seconds": seconds_of}


def _ratios(seconds: dict[str, dict[str, float]], name: str, names: list[str], kind: str) -> dict[str, float]:
    of = {task: seconds[f"{name}: {task}"][kind] for task in names}
    own = {"write": of["write"] / of["raw write"], "read": of["read"] / of["raw read"]}
    return own | {task: seconds[f"pyuff: {task}"][kind] / of[task] for task in FILES}


def table(result: dict[str, Any]) -> str:
    columns = [(version, kind) for version in result["ratios"] for kind in KINDS]
    words = {
        "write": f"write, 58b, {CHANNELS} x {SAMPLES} samples, over a raw write brought to the disk",
        "read": "read the same, over a raw read",
    }
    lines = [
        f"# Speed of UFF\n\n`python benchmarks/read_uff.py`: medians of {result['repeat']} turns, all tasks in turn; load of the machine "
        f"{result['load'][0]:.1f}, {os.cpu_count()} cores. Under load the time of the processor counts.\n",
        "| what | " + " | ".join(f"{version}, {kind}" for version, kind in columns) + " | goal |", "| --- " * (len(columns) + 2) + "|",
    ]  # fmt: skip
    for key in result["ratios"]["now"]["clock"]:
        text = words.get(key, f"read {FILES.get(key, key)}: times faster than pyuff")
        goal = f"{'≤' if key in words else '≥'} {GOALS[key]:g}" if key in GOALS else ""
        lines.append(f"| {text} | " + " | ".join(f"{result['ratios'][v][k][key]:.2f}" for v, k in columns) + f" | {goal} |")
    memory = ", ".join(f"{name} {value:.2f}" for name, value in result["memory"].items())
    lines.append(f"\nPeak memory of reading the large file over its data: {memory} (goal ≤ {GOALS['memory']:g}).")
    lines += ["\n| task | clock [ms] | processor [ms] |", "| --- | --- | --- |"]
    lines += [f"| {task} | {1e3 * s['clock']:.1f} | {1e3 * s['processor']:.1f} |" for task, s in result["seconds"].items()]
    return "\n".join(lines) + "\n"


def rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of ``make bench``: how many times faster, or smaller, than the peer; by processor time."""
    seconds = {task: s["processor"] for task, s in result["seconds"].items()}
    out = []
    large = f"58b, {CHANNELS} x {SAMPLES}"
    for task in ("write", "read"):
        out.append((f"UFF {task}", large, f"now: {task}", f"raw {task}", f"now: raw {task}", 1 / GOALS[task]))
    for name, size in FILES.items():
        out.append(("UFF read", size, f"now: {name}", "pyuff", f"pyuff: {name}", GOALS.get(name)))
    found = [
        {
            "stage": stage, "size": size, "ours_s": seconds[own], "peer": peer, "peer_s": seconds[other],
            "ratio": seconds[other] / seconds[own], "goal": goal, "ours_mb": None, "peer_mb": None, "accuracy": None,
        }
        for stage, size, own, peer, other, goal in out
    ]  # fmt: skip
    data = 8e-6 * CHANNELS * SAMPLES
    memory = {"stage": "UFF read, memory", "size": large, "ours_s": None, "peer": f"{GOALS['memory']} x the data", "peer_s": None}
    limit = GOALS["memory"] * data
    memory |= {"ratio": GOALS["memory"] / result["memory"]["now"], "goal": 1.0, "ours_mb": result["memory"]["now"] * data, "peer_mb": limit}
    return [*found, memory | {"accuracy": None}]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--against", metavar="FOLDER", help="src folder of an older version")
    parser.add_argument("-o", "--output", metavar="PATH", help="write PATH.json and PATH.md")
    parser.add_argument("--json", metavar="FILE", help="write the rows of make bench")
    parser.add_argument("--folder", help="where the files are written (default: the folder for temporary files)")
    parser.add_argument("--serve", metavar="FOLDER", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        serve(Path(args.serve))
        return
    import operando

    sources = {"now": str(Path(operando.__file__).parents[1])} | ({"before": args.against} if args.against else {})
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        make_files(Path(folder))
        result = measure(sources, Path(folder), args.repeat)
    text = table(result)
    print(text)
    if args.json:
        Path(args.json).write_text(json.dumps(rows(result), indent=1) + "\n", encoding="utf-8")
    if args.output:
        Path(args.output).with_suffix(".md").write_text(text, encoding="utf-8")
        Path(args.output).with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
