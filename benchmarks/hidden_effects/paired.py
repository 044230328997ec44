"""Two codes on the same cases: right and wrong in pairs, group by group, with sizes, intervals and time.

python benchmarks/hidden_effects/paired.py                                # the table of the pairs that are kept
python benchmarks/hidden_effects/paired.py --add NEW.jsonl OLD.jsonl --as COMMIT COMMIT    # more pairs, from the rows score.py keeps

The pairs are kept in results/paired.csv, so that they grow over many runs; the table is results/paired.md.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from contacts import NONLINEAR
from hidden import SENSOR

RESULTS = Path(__file__).resolve().parents[1] / "results"
QUIET = ("none", "orders")
FIELDS = ("verdict", "right", "alone", "values", "inside", "z2", "error", "seconds")
GROUPS = (
    "linear, three or two references", "linear, one reference", "sensors and forces", "output-only", "between sensors", "level-dependent",
    "two effects", "nothing hidden: no_misfit", "outside the catalogue: not explained",
)  # fmt: skip


def group(row: dict) -> str:
    """Of the groups whose figures stand side by side."""
    kind = row["kind"]
    if kind in QUIET:
        return GROUPS[7]
    if kind == "outside":
        return GROUPS[8]
    if kind in SENSOR:
        return GROUPS[2]
    if kind in NONLINEAR:
        return GROUPS[5]
    if kind in ("two", "uneven"):
        return GROUPS[6]
    if kind == "unmeasured":
        return GROUPS[4]
    return GROUPS[3] if not row["check"] else GROUPS[row["references"] == 1]


def judged(row: dict) -> dict[str, object]:
    """What one code said of a case: right as its group has it, and no effect beside the hidden ones."""
    found = row.get("diagnosis")
    if found is None:
        return dict.fromkeys(FIELDS, 0) | {"verdict": "failed" if row.get("exit") else "no diagnosis", "error": ""}
    kind, verdict = row["kind"], found["verdict"]
    if kind in QUIET:
        right = not found["false_alarm"]
    elif kind == "outside":
        right = verdict != "explained"
    elif kind == "quintic":  # no kind of the catalogue
        right = verdict in ("partial", "unexplained")
    else:
        right = all(found["right"])
    z = np.array([s["z"] for s in found.get("sizes", ()) if s["z"] is not None], float)
    errors = [abs(s["error"]) for s in found.get("sizes", ()) if s["primary"]]
    return {
        "verdict": verdict, "right": int(right), "alone": int(right and found["extra"] <= 0), "values": z.size,
        "inside": int((np.abs(z) <= 1.96).sum()), "z2": round(float(np.sum(np.minimum(z**2, 100))), 3),
        "error": round(float(np.median(errors)), 6) if errors else "", "seconds": round(row.get("timings_s", {}).get("diagnose") or 0.0, 2),
    }  # fmt: skip


def pairs(new: Path, old: Path, commits: Sequence[str]) -> Iterator[dict[str, object]]:
    """Rows of the cases that both codes have run."""
    both = [{r["case"]: r for r in map(json.loads, path.read_text().splitlines())} for path in (new, old)]
    for case, row in both[0].items():
        if case in both[1]:
            sides = zip(("new", "old"), commits, (row, both[1][case]), strict=True)
            yield {"case": case, "group": group(row)} | {
                f"{side}_{name}": value for side, commit, r in sides for name, value in ({"commit": commit} | judged(r)).items()
            }


def table(rows: Sequence[dict[str, str]]) -> str:
    """Counts of each group: right of both codes, and where only one of them is."""
    head = ("group", "pairs", "new right", "old right", "only new", "only old", "nothing beside: new, old", "diagnosis, median s: new, old")
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name in (*GROUPS, "all"):
        some = [r for r in rows if name in (r["group"], "all")]
        if not some:
            continue
        new, old = (np.array([r[f"{side}_right"] == "1" for r in some]) for side in ("new", "old"))
        alone = [sum(r[f"{side}_alone"] == "1" for r in some) for side in ("new", "old")]
        seconds = [np.median([float(r[f"{side}_seconds"]) for r in some]) for side in ("new", "old")]
        counts = (name, len(some), new.sum(), old.sum(), (new & ~old).sum(), (old & ~new).sum(), f"{alone[0]}, {alone[1]}")
        lines.append("| " + " | ".join(map(str, (*counts, f"{seconds[0]:.1f}, {seconds[1]:.1f}"))) + " |")
    for side in ("new", "old"):
        right = [r for r in rows if r[f"{side}_right"] == "1" and int(r[f"{side}_values"])]
        values, inside = (sum(int(r[f"{side}_{name}"]) for r in right) for name in ("values", "inside"))
        errors = [float(r[f"{side}_error"]) for r in right if r[f"{side}_error"]]
        rms = np.sqrt(sum(float(r[f"{side}_z2"]) for r in right) / max(values, 1))
        commits = ", ".join(sorted({r[f"{side}_commit"] for r in rows}))
        lines.append(
            f"\n{side} ({commits}): {inside} of {values} hidden values in their 95 % interval ({100 * inside / max(values, 1):.0f} %), "
            f"rms of z {rms:.2f} (each at most 10), median error of a size {100 * np.median(errors or [np.nan]):.2f} %."
        )
    only_old = [r["case"] for r in rows if r["old_right"] == "1" and r["new_right"] != "1"]
    lines.append(f"\nRight with the old code alone: {', '.join(only_old) or 'none'}.")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--add", nargs=2, type=Path, metavar=("NEW.jsonl", "OLD.jsonl"))
    parser.add_argument("--as", nargs=2, dest="commits", default=("new", "old"), metavar="COMMIT")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of paired.csv and paired.md")
    options = parser.parse_args()
    file = options.results / "paired.csv"
    kept = list(csv.DictReader(file.open(encoding="utf-8"))) if file.exists() else []
    if options.add:
        added = [{k: str(v) for k, v in row.items()} for row in pairs(*options.add, options.commits)]
        there = {row["case"] for row in kept}
        kept += [row for row in added if row["case"] not in there]
        names = ("case", "group", *(f"{side}_{name}" for side in ("new", "old") for name in ("commit", *FIELDS)))
        with file.open("w", encoding="utf-8", newline="") as out:
            writer = csv.DictWriter(out, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(kept)
    text = table(kept)
    (options.results / "paired.md").write_text("# Two codes on the same cases\n\n" + text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
