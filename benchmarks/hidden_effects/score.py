"""Runs the command line over cases with hidden effects, from their raw files, and keeps one line of figures a case.

    python benchmarks/hidden_effects/score.py WORK --plan full        # some 450 runs; --plan short: 50; or names of cases
    python benchmarks/hidden_effects/tally.py WORK/results.jsonl      # the tables, also printed at the end here

Each case is written under a name that says nothing, run with ``operando run``, judged, and deleted (``--keep``: kept). Finished cases are
found in WORK/results.jsonl and not run again (``--fresh``: they are). Where diagnosis.json is not written, the row says so, and what
there is is scored.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import numpy as np
from contacts import NONLINEAR
from families import IN_PLANS
from generate import Spec, parse, truth, write
from hidden import LINEAR, SENSOR
from judge import judge
from tally import report
from threadpoolctl import threadpool_limits

OUTPUT_ONLY = ("ground_spring", "coupling_spring", "point_mass", "gyroscopic", "global_stiffness", "ground_damper", "coupling_damper")
EXCITATIONS = ("shaker", "hammer")
TIMEOUT = 900  # s a run


def plan(name: str) -> list[Spec]:
    """The cases of a plan; ``full``, ``short`` (one seed of each kind in turn), ``contacts`` (level-dependent kinds), ``uneven`` pairs,
    ``days`` (two days in a laboratory), ``complex`` (complex modes at rest), ``single`` (two effects seen from one reference), ``panel``
    (a structure hung up on soft springs, modes in close pairs).
    """
    if name == "panel":
        kinds = (*(k for k in LINEAR if k != "circulatory"), *SENSOR, "none", "two", "uneven", "unmeasured", "outside")
        specs = [Spec("panel", kind, 1200 + i, (3, 1, 2)[i % 3], EXCITATIONS[i // 3 % 2]) for i, kind in enumerate(kinds * 2)]
        return _mixed([*specs, *(Spec("panel", kind, 1260 + i, 1 + i % 3, check=False) for i, kind in enumerate(OUTPUT_ONLY))])
    if name == "days":
        return _mixed([*_in_turn(60, 800, days=True), *_quiet(30, 900, days=True)])
    if name == "complex":
        return _mixed([*_in_turn(26, 1000, complex=True), *_quiet(8, 1050, complex=True)])
    if name == "single":
        return _mixed([Spec(f, kind, 1100 + i, 1, EXCITATIONS[i % 2]) for i in range(6) for f in IN_PLANS for kind in ("two", "uneven")])
    if name == "uneven":
        return [Spec(family, "uneven", 700 + i, (3, 2)[i % 2]) for i in range(10) for family in IN_PLANS]
    if name == "contacts":
        return _mixed([Spec(family, kind, 500 + i, 2 + i % 2) for family in IN_PLANS for kind in NONLINEAR for i in range(6)])
    seeds = {"full": 6, "short": 1}[name]
    nothing = {"full": 60, "short": 6}[name]
    specs: list[Spec] = []
    for offset, family in enumerate(IN_PLANS):
        for kind in (*LINEAR, *SENSOR):
            for i in range(seeds):
                seed = (i if name == "full" else (*LINEAR, *SENSOR).index(kind) % 6) + 100
                # Three references and one by turns; hammer and shaker by pairs, so that all four meet.
                specs.append(Spec(family, kind, seed, (3, 1)[(seed + offset) % 2], EXCITATIONS[(seed // 2) % 2]))
        for i in range(nothing):
            kind = "orders" if i % 4 == 3 else "none"
            specs.append(Spec(family, kind, 200 + i, 1 + i % 3, EXCITATIONS[(i // 3) % 2], check=i % 5 != 4))
        for kind in OUTPUT_ONLY:
            specs += [Spec(family, kind, 300 + i, (3, 2)[i % 2], EXCITATIONS[i % 2], check=False, orders=i % 3 == 2) for i in range(seeds)]
        for kind in ("unmeasured", "outside", "one_mode", "two"):
            specs += [Spec(family, kind, 400 + i, (3, 2)[i % 2], EXCITATIONS[(i // 2) % 2]) for i in range(max(seeds + 2, 2))]
    return _mixed(specs)


def _mixed(specs: list[Spec]) -> list[Spec]:
    """Families and kinds mixed, so that an early stop still shows everything."""
    return sorted(specs, key=lambda s: hashlib.sha1(s.name.encode()).hexdigest())


def _in_turn(count: int, seed: int, **more: bool) -> list[Spec]:
    """Linear kinds in turn, so that each meets both families, three references and one, shaker and hammer."""
    kinds = len(LINEAR)  # odd, so the families swap kinds each round
    return [
        Spec(
            IN_PLANS[n % 2], LINEAR[n % kinds], seed + n, (3, 1)[(n // kinds + n // 2) % 2], EXCITATIONS[(n // kinds + n // 4) % 2], **more
        )
        for n in range(count)
    ]


def _quiet(count: int, seed: int, **more: bool) -> list[Spec]:
    """Nothing hidden, by turns as above."""
    return [Spec(IN_PLANS[n % 2], "none", seed + n, (3, 1)[n // 2 % 2], EXCITATIONS[n // 4 % 2], **more) for n in range(count)]


def run_case(spec: Spec, work: Path, command: str, keep: bool, until: str | None, library: bool) -> dict:
    """Writes, runs, judges."""
    label = hashlib.sha1(spec.name.encode()).hexdigest()[:10]
    case, results = work / "cases" / label, work / "runs" / label
    row: dict = {"case": spec.name, "family": spec.family, "kind": spec.kind, "seed": spec.seed, "references": spec.references}
    row |= {"excitation": spec.excitation, "check": spec.check, "orders": spec.orders or spec.kind == "orders", "folder": str(case)}
    row |= {"days": spec.days, "complex": spec.complex}
    if not (case / "test.toml").exists():
        write(spec, work, case)
    answer = json.loads((work / "answers" / f"{spec.name}.json").read_text())
    row["truth"], row["change_db"], row["weaker_db"] = answer["effects"], answer["change_db"], answer.get("weaker_db")
    row["between_db"] = answer.get("between_db")
    start = time.perf_counter()
    arguments = [command, "run", str(case / "test.toml"), "-o", str(results), *(["--until", until] if until else [])]
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MPLBACKEND="Agg")
    try:
        done = subprocess.run(arguments, capture_output=True, text=True, timeout=TIMEOUT, env=environment, check=False)
        row["exit"], row["stderr"] = done.returncode, done.stderr[-600:] if done.returncode else ""
    except subprocess.TimeoutExpired:
        row["exit"], row["stderr"] = -1, f"no end after {TIMEOUT} s"
    row["seconds"] = time.perf_counter() - start
    if library and not row["exit"] and not (results / "diagnosis.json").exists():
        row["diagnosed_by"] = "library"
        script = str(Path(__file__).with_name("through_library.py"))
        done = subprocess.run([sys.executable, script, str(results)], capture_output=True, text=True, env=environment, check=False)
        row["no_diagnosis"] = done.stderr.strip()[-200:]
    known = truth(spec)
    state = known.state
    row |= judge(answer, results, None if known.contact is not None else partial(_exact, state.system, state.rows))
    if row["diagnosis"] is None:
        row["no_diagnosis"] = row.get("no_diagnosis") or row.get("left_out", {}).get("diagnose") or "diagnosis.json was not written"
    if not keep:
        shutil.rmtree(results, ignore_errors=True)
        shutil.rmtree(case, ignore_errors=True)
    return row


def _exact(system, rows: np.ndarray, hz: np.ndarray) -> np.ndarray:
    return system.accelerance(hz, rows, rows)


def finished(path: Path) -> Iterator[dict]:
    """The rows kept so far; a line cut off by an interruption is left out."""
    if not path.exists():
        return
    for line in path.read_text().splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("names", nargs="*", help="names of cases, as generate.py writes them")
    parser.add_argument("--plan", choices=("full", "short", "contacts", "uneven", "days", "complex", "single", "panel"))
    parser.add_argument("--only", help="of the plan, cases whose name holds this text")
    parser.add_argument("--limit", type=int, help="stop after so many new runs")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--until", help="last stage of the run, e.g. compare: identification alone")
    parser.add_argument("--keep", action="store_true", help="keep cases and results folders")
    parser.add_argument("--fresh", action="store_true", help="run finished cases again")
    parser.add_argument("--library", action="store_true", help="where the run leaves no diagnosis, ask the Python interface for one")
    parser.add_argument("--operando", default=str(Path(sys.executable).with_name("operando")), help="the command to run")
    options = parser.parse_intermixed_args()
    specs = [parse(name) for name in options.names] or [
        s for s in plan(options.plan or "short") if not options.only or options.only in s.name
    ]
    options.work.mkdir(parents=True, exist_ok=True)
    path = options.work / "results.jsonl"
    rows = {row["case"]: row for row in finished(path)}
    todo = [s for s in specs if options.fresh or s.name not in rows][: options.limit]
    print(f"{len(specs)} cases, {len(todo)} to run", flush=True)
    with ProcessPoolExecutor(options.processes, initializer=threadpool_limits, initargs=(1,)) as pool, path.open("a") as sink:
        futures = {pool.submit(run_case, s, options.work, options.operando, options.keep, options.until, options.library): s for s in todo}
        for number, future in enumerate(as_completed(futures), start=1):
            try:
                row = future.result()
            except Exception as problem:  # one broken case must not end the study; it is counted as failed
                row = {"case": futures[future].name, "kind": futures[future].kind, "exit": -2, "stderr": repr(problem)}
            rows[row["case"]] = row
            sink.write(json.dumps(row) + "\n")
            sink.flush()
            print(f"{number:4d}/{len(todo)} {one_line(row)}", flush=True)
    print()
    print(report([rows[s.name] for s in specs if s.name in rows]))


def one_line(row: dict) -> str:
    """What happened, for the eye."""
    text = f"{row['case']:46s} {row.get('seconds', 0):5.1f} s"
    if row.get("exit"):
        return f"{text}  FAILED {row['stderr'].strip().splitlines()[-1:]}"
    found = row["identification"]
    text += f"  misfit {found['misfit']:.2f}" if found and found["misfit"] else "  no idle model"
    diagnosis = row["diagnosis"]
    if diagnosis is None:
        return f"{text}  {row['no_diagnosis']}"
    right = "false alarm" if diagnosis["false_alarm"] else "right" if not row["truth"] or all(diagnosis["right"]) else "WRONG"
    return f"{text}  {diagnosis['verdict']:11s} {right:11s} {' + '.join(diagnosis['effects'])}"


if __name__ == "__main__":
    main()
