"""The evidence engine on results folders of `operando run`, or on generated cases of the hidden-effects family.

    python benchmarks/engine/run.py RESULTS [RESULTS …]                    # folders with a model.h5 that holds idle model and check
    python benchmarks/engine/run.py --plan days --work DIR [--limit 40]    # cases of ../hidden_effects, identified by `operando run`

One line a case; with a plan, rows are kept in DIR/rows.jsonl, and cases that stand there are not run again.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "hidden_effects")]
from idle import Idle  # noqa: E402
from kinds import KINDS  # noqa: E402
from model import Case  # noqa: E402
from posterior import at_rest, names  # noqa: E402
from search import search  # noqa: E402
from verdict import verdict  # noqa: E402

from operando.store import load_results  # noqa: E402


def diagnosed(results: Path, talk: bool = False) -> dict[str, Any]:
    """What the engine says of the check with the most lines of a results folder."""
    loaded = load_results(results / "model.h5")
    check = max(loaded.check, key=lambda c: c.frf.data.shape[2])
    band = tuple(loaded.settings["band"])
    started = time.process_time()
    idle, rest = at_rest(Idle.from_terms(loaded.idle.terms, band), loaded.idle_frf, band)
    case = Case(idle, check.frf, band)
    found = search(case, (lambda text: print("  ", text[:200], flush=True)) if talk else (lambda text: None))
    best = found.best
    told = verdict(case, found, rest)
    std = np.sqrt(np.diag(best.covariance)) if best.effects else np.zeros(0)
    effects, at = [], 0
    for effect in best.effects:
        row = {"kind": effect.kind, "location": [str(case.dofs[i]) for i in effect.places], "size": effect.size}
        effects.append(row | {"log_std": float(std[at]) if effect.values else None})
        at += len(effect.values)
    whole = case.parts["stiffness"]
    return {
        "effects": effects,
        "text": names(case, best.effects),
        "discrepancy": best.alpha,
        "discrepancy_at_rest": rest.alpha,
        "discrepancy_of_idle": found.empty.alpha,
        "verdict": told.name,
        "why": told.why,
        "probability": told.probability,
        "others": [names(case, effects) for effects in told.others],
        "unseen_hz": told.unseen,
        "validation_chi_square": told.chi_square,
        "validation_db": told.validation_db,
        "stiffness": float(best.d[whole][0] * case.spread[whole][0]),
        "stiffness_std": float(best.std("stiffness")[0] * case.spread[whole][0]),
        "cpu_s": time.process_time() - started,
    }


def place(kind: str, location: list[str]) -> tuple[str, tuple[str, ...]]:
    """A mass acts on all directions of its node."""
    nodes = [re.sub(r"[+-][XYZ]$", "", dof) for dof in location] if kind == "point_mass" else location
    return kind, tuple(sorted(set(nodes)))


def compared(found: dict[str, Any], truth: list[dict[str, Any]]) -> dict[str, Any]:
    """Kinds and places right, missing and beside them; errors of log sizes over their standard deviations."""
    want = {place(e["kind"], e["location"]): e for e in truth}
    got = {place(e["kind"], e["location"]): e for e in found["effects"]}
    z = []
    for key in want.keys() & got.keys():
        value = next(iter(want[key]["parameters"].values()))["value"] if want[key]["parameters"] else None
        size, std = got[key]["size"], got[key]["log_std"]
        if value and size and std and key[0] != "sensor_delay":
            true = 1 + value if key[0] == "global_damping" else abs(value)  # told as a change, searched as a factor
            z.append([abs(size) / true - 1, float(np.log(abs(size) / true) / std)])
    both = want.keys() & got.keys()
    return {"right": len(both), "missing": len(want.keys() - both), "beside": len(got.keys() - both), "z": z}


def of_plan(plan: str, work: Path, limit: int | None, operando: str, only: str) -> None:
    """Generate, identify, diagnose, compare; one case after the other."""
    import score
    from generate import write

    specs = [s for s in score.plan(plan) if s.kind in (*KINDS, "none", "two", "uneven") and only in s.name]
    rows = work / "rows.jsonl"
    work.mkdir(parents=True, exist_ok=True)
    done = {json.loads(line)["case"] for line in rows.read_text().splitlines()} if rows.exists() else set()
    for spec in [s for s in specs if s.name not in done][:limit]:
        folder, results = work / "case", work / "results"
        for old in (folder, results):
            shutil.rmtree(old, ignore_errors=True)
        write(spec, work, folder)
        answer = json.loads((work / "answers" / f"{spec.name}.json").read_text())
        row: dict[str, Any] = {"case": spec.name, "truth": answer["effects"], "change_db": answer["change_db"]}
        row |= {key: answer.get(key) for key in ("weaker_db", "between_db", "between_median_db")}
        row["shift"] = (answer.get("between") or {}).get("frequency_shift_mean")
        command = [operando, "run", str(folder / "test.toml"), "-o", str(results), "--until", "compare"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            row["error"] = ended.stderr[-300:]
        else:
            found = diagnosed(results)
            row |= found | compared(found, answer["effects"])
        with rows.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
        said = ("text", "verdict", "others", "right", "missing", "beside", "discrepancy", "validation_chi_square", "cpu_s", "error")
        print(spec.name, {k: row[k] for k in said if k in row}, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="*", type=Path)
    parser.add_argument("--plan")
    parser.add_argument("--only", default="", help="text that the names of cases hold")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--operando", default=str(Path(sys.executable).with_name("operando")))
    options = parser.parse_args()
    for folder in options.results:
        print(folder, json.dumps(diagnosed(folder, talk=True), indent=1))
    if options.plan:
        of_plan(options.plan, options.work, options.limit, options.operando, options.only)


if __name__ == "__main__":
    main()
