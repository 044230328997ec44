"""Many mutants of the seeds of every reader, in processes of their own; the table of what became of them.

    python benchmarks/fuzz/long.py [--count 100000] [--series a] [--only NAME]

Mutator, seeds and judge are those of ``tests/fuzzing.py`` and ``tests/fuzz_seeds.py``: ``Fuzzer(seed, path, series).mutant(number)`` gives
the bytes of each mutant again. Results: ``benchmarks/results/fuzz.json`` and ``fuzz.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import select
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve()
sys.path.insert(0, str(HERE.parents[2] / "tests"))

from fuzz_seeds import all_seeds  # noqa: E402
from fuzzing import TIME_LIMIT_S, Fuzzer, Seed, scratch  # noqa: E402

RESULTS = HERE.parents[1] / "results"
BATCH = 500
"""Mutants a process."""
ADDRESS_SPACE = 4 << 30
"""Most memory of a process: a reader that wants more ends here, and the machine does not."""


def batch(seed: Seed, folder: Path, series: str, numbers: range) -> list[dict]:
    """Outcomes of some mutants, tried in a fork; one that hangs or ends the process is a failure, and the next fork goes on behind it."""
    found: list[dict] = []
    while len(found) < len(numbers):
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
            fuzzer = Fuzzer(seed, folder / seed.file, series)
            with os.fdopen(writing, "w") as out:
                for number in numbers[len(found) :]:
                    print(json.dumps({"number": number} | vars(fuzzer.try_mutant(number))), file=out, flush=True)
            from operando.io.safe import guard

            guard._end()
            os._exit(0)
        os.close(writing)
        text = b""
        while select.select([reading], [], [], 6 * TIME_LIMIT_S)[0]:
            more = os.read(reading, 1 << 16)
            if not more:
                break
            *lines, text = (text + more).split(b"\n")
            found += [json.loads(line) for line in lines]
        os.close(reading)
        if len(found) < len(numbers):
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if len(found) < len(numbers):
            note = f"the process hung or ended with status {status}"
            found.append({"number": numbers[len(found)], "what": "failure", "note": note, "seconds": TIME_LIMIT_S, "memory": 0})
    return found


def examine(seed: Seed, folder: Path, series: str, count: int) -> dict:
    """Row of the table for one seed."""
    kinds: Counter[str] = Counter()
    failures: dict[str, list[int]] = {}
    worst, most = (0.0, 0), (0, 0)
    started = time.perf_counter()
    for start in range(0, count, BATCH):
        for outcome in batch(seed, folder, series, range(start, min(count, start + BATCH))):
            kinds[outcome["what"]] += 1
            worst = max(worst, (outcome["seconds"], outcome["number"]))
            most = max(most, (outcome["memory"], outcome["number"]))
            if outcome["what"] == "failure":
                failures.setdefault(outcome["note"], []).append(outcome["number"])
    row = {"bytes": len(seed.data), "mutants": count, "refused": kinds["refused"], "equal outside the mutated part": kinds["equal"]}
    row |= {"with a finding": kinds["told"], "failures": kinds["failure"], "worst_s": round(worst[0], 2), "worst_number": worst[1]}
    row |= {"most_memory_mb": round(most[0] / 1e6, 1), "minutes": round((time.perf_counter() - started) / 60, 2), "failed": failures}
    return row


HOW = (
    "Mutants of small good files, by `python benchmarks/fuzz/long.py`; `benchmarks/fuzz/README.md` explains the columns. Times are of "
    "a machine with other work; the memory is that of the reading process above what it had (files below 50 kB: 200 MB are allowed)."
)


def markdown(rows: dict[str, dict]) -> str:
    """The table for reading."""
    heads = ["series", "mutants", "refused", "equal outside the mutated part", "with a finding", "failures", "worst_s", "most_memory_mb"]
    lines = ["# Fuzzing of the readers", "", HOW, "", "| seed | " + " | ".join(heads) + " |", "| --- " * (len(heads) + 1) + "|"]
    for name, row in rows.items():
        lines.append(f"| {name} | " + " | ".join(str(row[h]) for h in heads) + " |")
    total: dict = {h: sum(row[h] for row in rows.values()) for h in heads[1:6]}
    total |= {h: max(row[h] for row in rows.values()) for h in heads[6:]}
    lines.append("| **all** | | " + " | ".join(str(total[h]) for h in heads[1:]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Try mutants of all seeds and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="mutants of all seeds together")
    parser.add_argument("--series", default="a", help="another series has other mutants")
    parser.add_argument("--only", default="", help="seeds whose names hold this; their rows are put into the table there is")
    given = parser.parse_args()
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=scratch()) as name:
        folder = Path(name)
        seeds = [seed for seed in all_seeds(folder) if given.only in seed.name]
        each = -(-given.count // len(seeds))
        table: dict = {}
        for seed in seeds:
            table[seed.name] = examine(seed, folder, given.series, each)
            print(seed.name, json.dumps(table[seed.name]), flush=True)
    minutes = (time.perf_counter() - started) / 60
    known = json.loads((RESULTS / "fuzz.json").read_text())["seeds"] if given.only and (RESULTS / "fuzz.json").is_file() else {}
    document = {"seeds": known | {name: {"series": given.series} | row for name, row in table.items()}}
    (RESULTS / "fuzz.json").write_text(json.dumps(document, indent=1) + "\n")
    (RESULTS / "fuzz.md").write_text(markdown(document["seeds"]))
    failures = sum(row["failures"] for row in table.values())
    print(f"{each * len(seeds)} mutants, {failures} failures, {minutes:.0f} minutes")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
