"""Do the 95 % bands of operational FRFs hold? Draws from raw records: both hidden-effect families and the paper's structure.

    python benchmarks/ofrf_bands.py FOLDER [--draws 240] [--first-seed 700]     # makes raw files, identifies, judges; resumes
    python benchmarks/ofrf_bands.py FOLDER --results RUNS --answers ANSWERS     # judges results folders that are there
    python benchmarks/ofrf_bands.py FOLDER --table                              # only prints the table

Every draw is another structure with another hidden effect (or the paper's structure with other noise and forces).
FOLDER/draws.jsonl gets one line a draw: per region the share of lines whose band holds the exact FRF, and the rms width over the rms
error, both relative to the rms FRF of the line. Effects that no symmetric sum of modes can hold (gyroscopic, circulatory) are drawn and
told apart; faults of sensors, which change the measurement and not the structure, are not drawn. Raw files are removed after each
draw, models are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before NumPy is loaded

import numpy as np  # noqa: E402

HERE = Path(__file__).resolve().parent
KINDS = (
    "ground_spring", "point_mass", "coupling_spring", "ground_damper", "tuned_absorber", "global_stiffness", "ground_rubber",
    "coupling_damper", "ground_hysteretic_spring", "global_damping", "none", "two", "gyroscopic",
)  # fmt: skip
SKEW = ("gyroscopic", "circulatory")
REGIONS = ("all", "driven, on", "driven, off", "undriven, on", "undriven, off")
BOUND = -np.log(0.05)
"""|ΔH|² over its variance that a complex normal deviation exceeds on one line in twenty."""


def judge(hybrid, lines: np.ndarray, exact: np.ndarray, dofs: list[str], references: list[str]) -> dict[str, list[float]]:
    """Region → coverage, rms width over rms error, share of all lines. ``exact``: (dofs, dofs or references, lines)."""
    have = {str(d).replace("-", "+") for d in hybrid.modal.dofs}
    keep = [i for i, d in enumerate(dofs) if d.replace("-", "+") in have]
    labels = [dofs[i] for i in keep]
    inputs = labels if exact.shape[1] == len(dofs) else references
    exact = exact[keep][:, keep] if inputs is labels else exact[keep]
    frf = hybrid.frf(lines, labels, inputs)
    error, size = np.abs(frf.data - exact) ** 2, np.mean(np.abs(exact) ** 2, axis=(0, 1))
    known = {r.replace("-", "+") for r in references}
    driven = np.array([[i.replace("-", "+") in known or o.replace("-", "+") in known for i in inputs] for o in labels])
    modes = hybrid.operating.modes_proper()
    reach = np.maximum(2 * modes.damping_ratios, 0.004) * modes.frequencies_hz
    on = np.any(np.abs(lines[:, None] - modes.frequencies_hz) < reach, axis=1)
    out = {}
    for region in REGIONS:
        pairs = np.ones_like(driven) if region == "all" else driven == region.startswith("driven")
        part = pairs[:, :, None] & (np.ones_like(on) if region == "all" else on == region.endswith("on"))
        if part.any():
            inside = float(np.mean((error < BOUND * frf.variance)[part]))
            width = float(np.sqrt(np.mean((frf.variance / size)[part]) / np.mean((error / size)[part])))
            out[region] = [inside, width, float(part.mean())]
    return out


def judge_folder(results: Path, answers: Path) -> dict[str, list[float]]:
    """A results folder of a hidden-effect case, scaled anew by the present code."""
    from operando.scaling import scale_operational
    from operando.store import load_results

    found = load_results(results / "model.h5", only=("idle", "operating"))
    answer = json.loads(answers.with_suffix(".json").read_text())
    with np.load(answers.with_suffix(".npz")) as kept:
        lines, exact, dofs = kept["f"], kept["H"].astype(complex), [str(d) for d in kept["dofs"]]
    return judge(scale_operational(found.idle, found.operating), lines, exact, dofs, answer["references"])


def draw_hidden(name: str, folder: Path) -> dict[str, list[float]]:
    """One draw of a family, from raw files written here."""
    sys.path.append(str(HERE / "hidden_effects"))
    import generate

    from operando.pipeline import run

    case = generate.write(generate.parse(name), folder)
    try:
        run(case / "test.toml", folder / "results" / name, until="ofrf")
    finally:
        shutil.rmtree(case, ignore_errors=True)
    return judge_folder(folder / "results" / name, folder / "answers" / name)


def draw_paper(name: str, folder: Path) -> dict[str, list[float]]:
    """One draw of the paper's structure: ``paper-CASE-SEED``, 0.5 % noise on every channel."""
    sys.path.append(str(HERE / "paper"))
    import exact
    import recordings
    from raw import BANDS
    from tripod import DOFS, exact_modes

    from operando.pipeline import run

    _, number, seed = name.split("-")
    case = f"case {number}"
    rest, target = exact_modes("original", folder / "modes"), exact_modes(case, folder / "modes")
    where, corners = folder / "cases" / name, [f"{c}+Z" for c in recordings.CORNERS]
    band = list(BANDS.values())[int(seed) % 2]
    try:
        test = recordings.write_case(where, rest, target, case, exact.EPSILON[case], noise=0.005, hits=1, seed=int(seed), band=band)
        found = run(test, folder / "results" / name, until="ofrf")
    finally:
        shutil.rmtree(where, ignore_errors=True)
    lines = np.linspace(*band, 400)
    truth = recordings.frf(target, lines, [DOFS.index(c) for c in corners])
    return judge(found.hybrid, lines, truth, list(DOFS), corners)


def names(draws: int, first_seed: int) -> list[str]:
    """The draws in the order they are made: two of a family, then one of the paper's structure, and so on."""
    out = []
    for k in range(draws):
        seed = first_seed + k
        if k % 3 == 2:
            out.append(f"paper-{1 + k // 3 % 2}-{seed}")
            continue
        references = 1 + seed % 3
        out.append(f"{('frame', 'rotor')[k % 3]}-{KINDS[k % len(KINDS)]}-{seed}-r{references}-{('shaker', 'hammer')[k // 3 % 2]}")
    return out


def print_table(rows: list[dict]) -> None:
    """Coverage pooled over lines and median width, by what was drawn."""
    kind = lambda row: row["name"].split("-")[1]  # noqa: E731
    groups = {
        "all but skew effects": lambda r: kind(r) not in SKEW,
        "frame": lambda r: r["name"].startswith("frame") and kind(r) not in SKEW,
        "rotor": lambda r: r["name"].startswith("rotor") and kind(r) not in SKEW,
        "paper": lambda r: r["name"].startswith("paper"),
        "gyroscopic, circulatory": lambda r: kind(r) in SKEW,
    }
    print("| draws | " + " | ".join(REGIONS) + " |\n|" + " --- |" * (len(REGIONS) + 1))
    for title, chosen in groups.items():
        part = [row["regions"] for row in rows if chosen(row)]
        cells = []
        for region in REGIONS:
            values = np.array([p[region] for p in part if region in p])
            text = f"{100 * np.average(values[:, 0], weights=values[:, 2]):.1f} %, {np.median(values[:, 1]):.2f}" if values.size else "–"
            cells.append(text)
        print(f"| {title} ({len(part)}) | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--draws", type=int, default=240)
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--answers", type=Path)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    log = options.folder / "draws.jsonl"
    done = {row["name"]: row for row in map(json.loads, log.read_text().splitlines())} if log.exists() else {}
    if options.results is not None:
        todo = sorted(
            p.name for p in options.results.iterdir() if (p / "model.h5").exists() and (options.answers / f"{p.name}.npz").exists()
        )
    else:
        todo = [] if options.table else names(options.draws, options.first_seed)
    for name in todo:
        if name in done:
            continue
        try:
            if options.results is not None:
                regions = judge_folder(options.results / name, options.answers / name)
            else:
                regions = (draw_paper if name.startswith("paper") else draw_hidden)(name, options.folder)
        except Exception as error:  # one draw that fails must not end the study; it is told
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr)
            continue
        done[name] = {"name": name, "regions": regions}
        with log.open("a") as stream:
            stream.write(json.dumps(done[name]) + "\n")
        print(name, " ".join(f"{100 * regions['all'][0]:.0f} % {regions['all'][1]:.2f}".split()), file=sys.stderr, flush=True)
    print_table(list(done.values()))


if __name__ == "__main__":
    main()
