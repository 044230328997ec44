"""Bands of idle FRFs between DOFs that were not driven: how many lines of simulated set-ups hold the exact ones.

    python undriven.py WORK

WORK is the folder of ``score.py --keep``: its results at rest are judged with the present code, once for each structure and way of
driving it. Shares no code with what makes the bands.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
from generate import parse, truth
from hidden import idle

from operando.store import load_results

LINES, INTERVAL = 12, 1.96


def judged(results: Path, case: str) -> dict[str, np.ndarray] | None:
    """Errors of the real part over their standard deviations (pairs, lines); None where the idle model has no covariance."""
    known = truth(parse(case))
    model = load_results(results).idle
    if model is None or model.covariance is None or model.scaling != "unit_modal_mass":
        return None
    names = [sensor.name for sensor in known.structure.sensors]
    hz = np.linspace(*known.band, LINES)
    rest = idle(known.structure)
    exact = rest.system.accelerance(hz, rest.rows, rest.rows)
    made = model.frf(hz, names, names)
    assert made.variance is not None
    off = np.abs((made.data - exact).real) / np.sqrt(made.variance / 2)
    free = [i for i in range(len(names)) if i not in known.references]
    return {
        "driven": off[:, list(known.references)].reshape(-1, LINES),
        "own": off[free, free],
        "between": off[np.ix_(free, free)][np.triu_indices(len(free), 1)],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    work = parser.parse_args().work
    seen, rows = set(), []
    for line in (work / "results.jsonl").read_text().splitlines():
        row = json.loads(line)
        if "family" not in row:  # a case that could not be run
            continue
        key = row["family"], row["seed"], row["references"], row["excitation"], row["complex"]
        folder = work / "runs" / hashlib.sha1(row["case"].encode()).hexdigest()[:10]
        if key in seen or not folder.exists():
            continue
        seen.add(key)
        if (found := judged(folder, row["case"])) is not None:
            rows.append((row["complex"], found))
    for title, some in (("real modes", [r for c, r in rows if not c]), ("complex modes", [r for c, r in rows if c])):
        for pairs in ("driven", "own", "between"):
            each = [np.mean(r[pairs] < INTERVAL) for r in some if r[pairs].size]
            if each:
                low, middle = np.quantile(each, (0.1, 0.5))
                every = np.concatenate([r[pairs].ravel() for r in some])
                of_set_ups = f"a tenth of set-ups below {100 * low:.0f} %, median {100 * middle:.0f} %"
                held = f"{len(each)} set-ups, {100 * np.mean(every < INTERVAL):.1f} % of lines"
                print(f"{title}, {pairs}: {held}, median error of {np.median(every):.2f} standard deviations; {of_set_ups}")


if __name__ == "__main__":
    main()
