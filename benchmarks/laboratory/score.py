"""Runs the command line, defaults only, over cases of the laboratory family and scores what it says against the answers.

    python benchmarks/laboratory/score.py WORK --seeds 0:4                        # every kind; cases and results in WORK
    python benchmarks/laboratory/score.py WORK --kinds roving_hammer --seeds 0:60 --name rev17
    python benchmarks/laboratory/score.py WORK --case FOLDER …                    # folders made by generate.py

One process at a time with one BLAS thread, killed after ``--cpu`` seconds of processor time. Finished cases are kept in WORK/NAME.jsonl and
not run again; the aggregate goes to benchmarks/results/laboratory-NAME.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parent))
from lab_judge import judge, table, together

STAGE = {"idle": "ema", "operating": "oma"}
RESULTS = Path(__file__).resolve().parents[1] / "results"


# Starts a command in a child of a small process: the peak memory of a child counts what it had of its parent before it became the command.
LAUNCHER = """
import json, os, resource, sys
limit, log, command = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
child = os.fork()
if not child:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    os.nice(5)
    os.execv(command[0], command)
_, status, usage = os.wait4(child, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024]))
"""


def run_limited(command: list[str], cpu_s: int, log: Path) -> dict[str, Any]:
    """Runs a command in a process of its own: exit code, times, peak memory; killed after ``cpu_s`` of processor time."""
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", MPLBACKEND="Agg")
    start = time.perf_counter()
    launcher = [sys.executable, "-S", "-c", LAUNCHER, str(cpu_s), str(log), *command]
    done = subprocess.run(launcher, capture_output=True, text=True, env=environment, check=True)
    code, cpu, memory = json.loads(done.stdout)
    return {"exit": code, "cpu_s": round(cpu, 2), "wall_s": round(time.perf_counter() - start, 2), "memory_mb": round(memory, 1)}


def outcome(exit_code: int, stderr: str, cpu_s: float = 0.0, limit: float = 0.0) -> str:
    """done; out of time (killed by the limit); killed (by the system, mostly for memory); refused (an error it explains); crash (else)."""
    if exit_code == 0:
        return "done"
    if exit_code in (-signal.SIGXCPU, -signal.SIGKILL):
        return "out of time" if exit_code == -signal.SIGXCPU or cpu_s >= limit else "killed"
    if exit_code == 1 and "Traceback" not in stderr and "fault of the program" not in stderr:
        return "refused"
    return "crash"


def run_case(folder: Path, out: Path, cpu_s: int) -> dict[str, Any]:
    """One case: run, read, judge."""
    truth = json.loads(folder.with_name(folder.name + ".truth.json").read_text(encoding="utf-8"))
    shutil.rmtree(out, ignore_errors=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    log = out.with_name(out.name + ".log")
    command = [
        sys.executable,
        "-m",
        "operando",
        "run",
        str(folder / "test.toml"),
        "-o",
        str(out),
        "--until",
        STAGE[truth["state"]],
        "--json",
    ]
    row: dict[str, Any] = {"kind": truth["kind"], "seed": truth["seed"], "structure": truth["structure"]} | run_limited(command, cpu_s, log)
    said = log.read_text(encoding="utf-8", errors="replace")
    row["outcome"] = outcome(row["exit"], said, row["cpu_s"], cpu_s)
    row["said"] = said[-300:] if row["exit"] else ""
    path = out / "summary.json"
    summary = json.loads(path.read_text(encoding="utf-8")) if row["outcome"] == "done" and path.exists() else None
    if summary is not None:
        left = summary.get("left_out") or {}
        row["left_out"] = {k: str(v)[:200] for k, v in left.items() if k == STAGE[truth["state"]]}
        row["findings"] = len(summary.get("findings") or [])
    return row | judge(truth, summary)


def finished(path: Path) -> Iterator[dict[str, Any]]:
    """Rows kept so far; a line cut off by an interruption is left out."""
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue


def write_results(rows: list[dict[str, Any]], name: str, note: str, folder: Path = RESULTS) -> str:
    """JSON (aggregates and the rows) and markdown; gives the markdown."""
    kinds = list(dict.fromkeys(r["kind"] for r in rows))
    groups = {kind: together([r for r in rows if r["kind"] == kind]) for kind in kinds}
    if len(kinds) > 1:
        groups["all"] = together(rows)
    kept = [{k: v for k, v in r.items() if k != "said"} for r in rows]
    folder.mkdir(parents=True, exist_ok=True)
    text = f"# Laboratory family: {name}\n\n{note}\n\n" + table(groups)
    unseen = sum(r["not_counted"] for r in rows)
    text += f"\nModes in band that nothing measured shows (README.md) are not counted: {unseen}.\n"
    document = {"schema": "laboratory/score/1", "name": name, "note": note, "groups": groups, "rows": kept}
    (folder / f"laboratory-{name}.json").write_text(_compact(document), encoding="utf-8")
    (folder / f"laboratory-{name}.md").write_text(text, encoding="utf-8")
    return text


def _compact(document: dict[str, Any]) -> str:
    """JSON with one line a case."""
    rows = ",\n".join(json.dumps(r) for r in document["rows"])
    rest = json.dumps({k: v for k, v in document.items() if k != "rows"}, indent=1)
    return rest.rstrip().removesuffix("}").rstrip() + f',\n "rows": [\n{rows}\n]\n}}\n'


def main() -> None:
    from generate import KINDS, generate

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--kinds", nargs="*", choices=tuple(KINDS), default=list(KINDS))
    parser.add_argument("--seeds", default="0:3", help="first:last+1")
    parser.add_argument("--case", nargs="*", type=Path, default=[], help="folders made by generate.py, instead of kinds and seeds")
    parser.add_argument("--cpu", type=int, default=120, help="processor time in s after which a run is killed")
    parser.add_argument("--name", default="now", help="name of the results")
    parser.add_argument("--note", default="", help="a sentence for the results: which code, which machine")
    parser.add_argument("--keep", action="store_true", help="keep cases and results folders")
    parser.add_argument("--fresh", action="store_true", help="run finished cases again")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    first, last = (int(v) for v in options.seeds.split(":"))
    todo = [(f.name, f, None) for f in options.case] or [
        (f"{k}-{s}", options.work / "cases" / f"{k}-{s}", (k, s)) for s in range(first, last) for k in options.kinds
    ]
    options.work.mkdir(parents=True, exist_ok=True)
    path = options.work / f"{options.name}.jsonl"
    if options.fresh:
        path.unlink(missing_ok=True)
    rows = {r["case"]: r for r in finished(path)}
    for number, (case, folder, drawn) in enumerate(todo, start=1):
        if case in rows:
            continue
        if drawn is not None and not (folder / "test.toml").exists():
            generate(*drawn, folder)
        rows[case] = {"case": case} | run_case(folder, options.work / "runs" / case, options.cpu)
        with path.open("a", encoding="utf-8") as sink:
            sink.write(json.dumps(rows[case]) + "\n")
        print(f"{number:4d}/{len(todo)} {one_line(rows[case])}", flush=True)
        if drawn is not None and not options.keep:
            shutil.rmtree(options.work / "runs" / case, ignore_errors=True)
            shutil.rmtree(folder, ignore_errors=True)
    print()
    print(write_results([rows[c] for c, _, _ in todo if c in rows], options.name, options.note, options.results))


def one_line(row: dict[str, Any]) -> str:
    """What happened, for the eye."""
    text = f"{row['case']:28s} {row['cpu_s']:6.1f} s {row['memory_mb']:6.0f} MB  {row['outcome']:11s}"
    text += f" found {row['found']}/{row['wanted']}, invented {row['invented']}, flagged {row['flagged']}"
    if row["missed_hz"] and row["found"]:
        text += f", missed {row['missed_hz']}"
    if row["invented_hz"]:
        text += f", no mode at {row['invented_hz']}"
    last = row["said"].strip().splitlines()[-1:] if row["outcome"] != "done" else []
    return text + (f"  {last[0][:160]}" if last else "")


if __name__ == "__main__":
    main()
