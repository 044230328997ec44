"""Do the 95 % bands of operational FRFs hold, and does ``auto`` keep up with the best fixed method? Draws from raw records.

    python benchmarks/ofrf_bands.py FOLDER [--blocks 13] [--first-seed 2000]    # makes raw files, identifies, judges; resumes
    python benchmarks/ofrf_bands.py FOLDER --results RUNS --answers ANSWERS     # judges results folders that are there
    python benchmarks/ofrf_bands.py FOLDER --table                              # only prints the tables

What is drawn: ``ofrf_draws.py``. FOLDER/draws.jsonl gets one line a draw; raw files are removed after each draw, models are kept. A region
of a draw (on: within 2ζ of an operational mode; driven: input or output at a reference) has four figures:

- coverage: share of lines and pairs whose band holds the exact OFRF;
- width over error, rms: √(Σσ²/Σ|ΔH|²) over lines and pairs, both relative to the rms FRF of the line;
- share of all lines and pairs;
- width over error on a line: √(Σσ²/Σ|ΔH|²) over the pairs of each line, median over lines.

σ² is the variance of the complex OFRF, |ΔH|² what it is off the exact one, so that a band as wide as the error has a ratio of 1. For draws
of one case repeated with other forces and noise the scatter of the estimates themselves is compared with σ, too.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import defaultdict
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before NumPy is loaded

import numpy as np  # noqa: E402

from ofrf_draws import SKEW, Draw, draw_group, estimate_of, groups, stored  # noqa: E402
from operando.scaling import METHODS, scale_operational  # noqa: E402

REGIONS = ("all", "on", "off", "driven, on", "driven, off", "undriven, on", "undriven, off")
BOUND = -np.log(0.05)
"""|ΔH|² over its variance that a complex normal deviation exceeds on one line in twenty."""


def judge(draw: Draw, estimates: Path | None = None) -> dict:
    """Regions and errors of a draw by the present code; what the scatter needs goes to ``estimates``."""
    hybrid = scale_operational(draw.idle, draw.operating, draw.threshold)
    plain = [d.replace("-", "+") for d in draw.dofs]
    have = {str(d).replace("-", "+") for d in hybrid.modal.dofs}
    keep = [i for i, d in enumerate(plain) if d in have]
    known = {r.replace("-", "+") for r in draw.references}
    labels = [draw.dofs[i] for i in keep]
    square = draw.exact.shape[1] == len(draw.dofs)
    inputs = labels if square else draw.references
    exact = draw.exact[keep][:, keep] if square else draw.exact[keep]
    frf = hybrid.frf(draw.lines, labels, inputs)
    if estimates is not None:
        estimates.parent.mkdir(parents=True, exist_ok=True)
        np.savez(estimates, **estimate_of(frf, exact))
    at = [i for i, name in enumerate(inputs) if name.replace("-", "+") in known]
    errors = {
        name: _error_db(model.frf(draw.lines, labels, [inputs[i] for i in at], variance=False).data, exact[:, at])
        for name, model in hybrid.alternative_models.items()
    }
    driven = np.array([[i.replace("-", "+") in known or o.replace("-", "+") in known for i in inputs] for o in labels])
    on = _near_modes(hybrid.operating, draw.lines)
    return {
        "name": draw.name,
        "effects": draw.effects,
        "regions": _regions(np.abs(frf.data - exact) ** 2, np.asarray(frf.variance), exact, driven, on),
        "method": hybrid.method,
        "error_db": errors,
    }


def _near_modes(modes, lines: np.ndarray) -> np.ndarray:
    """Lines within 2ζ of a mode."""
    reach = np.maximum(2 * modes.damping_ratios, 0.004) * modes.frequencies_hz
    return np.any(np.abs(lines[:, None] - modes.frequencies_hz) < reach, axis=1)


def _error_db(made: np.ndarray, exact: np.ndarray) -> float:
    """Rms over lines and pairs, inputs at the references."""
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(made) / np.abs(exact))) ** 2)))


def _regions(error: np.ndarray, variance: np.ndarray, exact: np.ndarray, driven: np.ndarray, on: np.ndarray) -> dict[str, list[float]]:
    """Region → coverage, rms width over rms error, share, median over lines of the width over the error."""
    size = np.mean(np.abs(exact) ** 2, axis=(0, 1))
    out = {}
    for region in REGIONS:
        pairs = np.ones_like(driven) if "driven" not in region else driven == region.startswith("driven")
        lines = on if region.endswith("on") else ~on if region.endswith("off") else np.ones_like(on)
        if pairs.any() and lines.any():
            e, v = error[pairs][:, lines], variance[pairs][:, lines]
            inside = float(np.mean(e < BOUND * v))
            width = float(np.sqrt(np.mean(v / size[lines]) / np.mean(e / size[lines])))
            each = float(np.median(np.sqrt(np.mean(v, axis=0) / np.mean(e, axis=0))))
            out[region] = [inside, width, float(pairs.mean() * lines.mean()), each]
    return out


def skewed(row: dict) -> bool:
    """Whether the effect is one that a sum of real modes cannot hold."""
    return any(kind in SKEW for kind in row["effects"])


def print_bands(rows: list[dict]) -> None:
    """Coverage pooled over lines and the two widths, median over draws, by what was drawn."""
    chosen = {
        "all but skew effects": lambda r: not skewed(r),
        "frame": lambda r: r["name"].startswith("frame") and not skewed(r),
        "rotor": lambda r: r["name"].startswith("rotor") and not skewed(r),
        "paper": lambda r: r["name"].startswith("paper"),
        "gyroscopic, circulatory": skewed,
    }
    print("| draws | " + " | ".join(REGIONS) + " |\n|" + " --- |" * (len(REGIONS) + 1))
    for title, choose in chosen.items():
        part = [row["regions"] for row in rows if choose(row)]
        cells = []
        for region in REGIONS:
            values = np.array([p[region] for p in part if region in p])
            if not values.size:
                cells.append("–")
                continue
            inside = 100 * np.average(values[:, 0], weights=values[:, 2])
            cells.append(f"{inside:.1f} %, {np.median(values[:, 1]):.2f}, {np.median(values[:, 3]):.2f}")
        print(f"| {title} ({len(part)}) | " + " | ".join(cells) + " |")


def print_methods(rows: list[dict]) -> None:
    """Error of each method and how far ``auto`` is behind it; the best of each case is a choice nobody can make beforehand."""
    rows = [row for row in rows if not skewed(row)]
    auto = np.array([row["error_db"][row["method"]] for row in rows])
    if not auto.size:
        return
    print("\n| method | cases | error, median and worst (dB) | auto less it: median, 95 %, worst (dB) |\n| --- | --- | --- | --- |")
    for name in (*METHODS, "best of each case"):
        each = [min(r["error_db"].values()) if name not in METHODS else r["error_db"].get(name, np.nan) for r in rows]
        error = np.array(each)
        good = np.isfinite(error)
        if good.any():
            d = (auto - error)[good]
            print(
                f"| {name} | {good.sum()} | {np.median(error[good]):.2f}, {error[good].max():.2f} "
                f"| {np.median(d):.2f}, {np.percentile(d, 95):.2f}, {d.max():.2f} |"
            )
    print(f"| auto | {auto.size} | {np.median(auto):.2f}, {auto.max():.2f} | |")


def print_scatter(folder: Path) -> None:
    """Repeated draws: σ over the scatter of the estimates and over their rms error, median over lines and pairs."""
    cases = defaultdict(list)
    for path in sorted((folder / "estimates").glob("*.npz")):
        label = path.stem.partition("@")[0]
        if label.startswith("paper"):
            structure, case, seed = label.split("-")
            label = f"{structure}, case {case}, {'wide' if int(seed) % 2 else 'narrow'} band"
        cases[label].append(path)
    print("\n| repeated case | draws | width over scatter | width over rms error | lines held |\n| --- | --- | --- | --- | --- |")
    for label, paths in cases.items():
        if len(paths) < 3:
            continue
        loaded = [dict(np.load(path)) for path in paths]
        made, variance = (np.array([one[key] for one in loaded]) for key in ("estimate", "variance"))
        error = np.abs(made - loaded[0]["exact"]) ** 2
        mean = np.mean(variance, axis=0)
        scatter = np.sum(np.abs(made - made.mean(axis=0)) ** 2, axis=0) / (len(paths) - 1)
        print(
            f"| {label} | {len(paths)} | {np.median(np.sqrt(mean / scatter)):.2f} | {np.median(np.sqrt(mean / error.mean(axis=0))):.2f} "
            f"| {100 * np.mean(error < BOUND * variance):.1f} % |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--blocks", type=int, default=13, help="of 17 draws on average")
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--results", type=Path)
    parser.add_argument("--answers", type=Path)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    log = options.folder / "draws.jsonl"
    done = {row["name"]: row for row in map(json.loads, log.read_text().splitlines())} if log.exists() else {}
    if options.results is not None:
        folders = [p for p in sorted(options.results.iterdir()) if (p / "model.h5").exists()]
        todo = [[p.name] for p in folders if (options.answers / f"{p.name}.npz").exists()]
    else:
        todo = [] if options.table else list(groups(options.first_seed, options.blocks))
    for names in todo:
        if all(name in done for name in names):
            continue
        try:
            if options.results is not None:
                draws = iter([stored(options.results / names[0], options.answers / names[0])])
            else:
                draws = draw_group(names, options.folder)
            for draw in draws:
                if draw.name in done:
                    continue
                row = judge(draw, options.folder / "estimates" / f"{draw.name}.npz" if "@" in draw.name else None)
                done[draw.name] = row
                with log.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
                inside, width, _, each = row["regions"]["all"]
                print(f"{draw.name} {100 * inside:.0f} % {width:.2f} {each:.2f}", file=sys.stderr, flush=True)
        except Exception as error:  # one group that fails must not end the study; it is told
            print(f"{' '.join(names)}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
    print_bands(list(done.values()))
    print_methods(list(done.values()))
    print_scatter(options.folder)


if __name__ == "__main__":
    main()
