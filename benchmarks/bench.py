"""All stages against their peers, one after the other: a table, and an error where a ratio is below its goal.

    make bench        or        python benchmarks/bench.py [--only read_uff.py …]

A stage is a script beside this one that takes ``--json FILE`` and writes a list of rows: stage, size, ours_s, peer, peer_s (processor
time), ratio (how many times better than the peer), goal (least ratio), ours_mb, peer_mb (peak resident memory), accuracy; null where it
does not apply. A peer that is not installed has no seconds and no ratio. Results are in ``results/bench.json`` and ``results/bench.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from datetime import date, datetime
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
STAGES = ("read_uff.py", "estimate_frf.py", "long_record.py", "plscf.py", "fit_ema.py", "ssi_cov.py", "campaign.py")
OPTIONS = {"campaign.py": ("--tests", "28")}
"""What a stage is called with here: the campaign of 200 tests takes a quarter of an hour."""
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SETTINGS = {"QT_QPA_PLATFORM": "offscreen", "MPLBACKEND": "Agg"}
COLUMNS = ("stage", "size", "ours [s]", "peer", "peer [s]", "ratio", "goal", "ours [MB]", "peer [MB]", "accuracy", "taken")


def run(script: str) -> tuple[list[dict[str, Any]], str]:
    """Rows of one stage, and what went wrong (empty where nothing did)."""
    if not (FOLDER / script).exists():
        return [], f"{script}: there is no such script"
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "rows.json"
        call = [sys.executable, str(FOLDER / script), *OPTIONS.get(script, ()), "--json", str(target)]
        code = subprocess.run(call, env={**os.environ, **ONE_THREAD, **SETTINGS}, check=False).returncode
        if code or not target.exists():
            return [], f"{script}: ended with {code}" if code else f"{script}: wrote no rows"
        return json.loads(target.read_text(encoding="utf-8")), ""


def falls_short(row: dict[str, Any]) -> bool:
    """Whether a row has a goal and misses it; a peer that is missing is no miss."""
    return row["ratio"] is not None and row["goal"] is not None and row["ratio"] < row["goal"]


def table(rows: list[dict[str, Any]], wrong: list[str]) -> str:
    """The rows as a Markdown table."""
    lines = [
        f"# Speed and memory against peers\n\n`make bench`, last on {date.today().isoformat()}: processor time, one BLAS thread, "
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}. "
        "Ratio: how many times better than the peer; rows in bold miss their goal." + _loaded() + "\n",
        "| " + " | ".join(COLUMNS) + " |",
        "| --- " * len(COLUMNS) + "|",
    ]
    for row in rows:
        ratio = _number(row["ratio"])
        cells = [
            row["stage"], row["size"], _number(row["ours_s"]), row["peer"] or "", _number(row["peer_s"]),
            f"**{ratio}**" if falls_short(row) else ratio, _number(row["goal"]), _number(row["ours_mb"]), _number(row["peer_mb"]),
            _number(row["accuracy"]), row.get("taken", ""),
        ]  # fmt: skip
        lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    lines += [f"\nNot measured: {text}" for text in wrong]
    return "\n".join(lines) + "\n"


def _loaded() -> str:
    """What to bear in mind where other programs ran beside."""
    if os.getloadavg()[0] <= 1.5:
        return ""
    return (
        " The machine was loaded: all times are processor time, but caches and memory were shared, so that seconds are longer than on a"
        " quiet machine and differ by a tenth or two from run to run; ours and the peer's ran in turn and share that."
    )


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.3g}" if isinstance(value, int | float) else str(value)


def main() -> None:
    """Run the stages and say what falls short."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="SCRIPT", choices=STAGES, default=list(STAGES), help="rows of the others are kept")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    wrong: list[str] = []
    for script in options.only:
        print(f"== {script}", flush=True)
        found, problem = run(script)
        rows += [row | {"script": script, "taken": f"{datetime.now():%Y-%m-%d %H:%M}"} for row in found]
        wrong += [problem] if problem else []
    known = RESULTS / "bench.json"
    before = json.loads(known.read_text(encoding="utf-8")) if known.exists() else []
    every = sorted([*(row for row in before if row["script"] not in options.only), *rows], key=lambda row: STAGES.index(row["script"]))
    known.write_text(json.dumps(every, indent=1) + "\n", encoding="utf-8")
    known.with_suffix(".md").write_text(table(every, wrong), encoding="utf-8")
    print(table(rows, wrong))
    short = [f"{row['stage']}, {row['size']}: {row['ratio']:.3g}, goal {row['goal']:.3g}" for row in rows if falls_short(row)]
    if short or wrong:
        raise SystemExit("\n".join(["falls short of its goal:", *short, *wrong]))


if __name__ == "__main__":
    main()
