"""The practice cases from raw files to OFRFs, judged against their exact answers.

    python benchmarks/practice_cases.py [p1 p2 …] [--cases ../shared/cases] [--out DIR]

Runs `operando run` on each case (answers are read only here, after the run) and prints how far the idle modes, their intervals, the
modal masses, undriven FRF columns and the operational FRFs are from the truth, and how far from the Cramér–Rao bound.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "cases"


def run_case(case: Path, out: Path) -> float:
    """Wall seconds of the command line on one case."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "operando", "run", str(case / "test.toml"), "-o", str(out)], check=True, capture_output=True)
    return time.perf_counter() - start


def judge_modes(summary: dict, answer: dict) -> dict[str, object]:
    """Errors of idle modes in band against the exact ones."""
    low, high = answer["band"]
    hz, zeta, shapes = (np.array(answer[k]) for k in ("idle_hz", "idle_zeta", "idle_shapes"))
    true = np.flatnonzero((hz >= low) & (hz <= high))
    modes = [m for m in summary["idle"]["modes"] if m["in_band"]]
    found = np.array([m["frequency_hz"] for m in modes])
    rows = [f"{n}+Z" for n in answer["nodes"]]
    z, frequency, damping, mass, matched = [], [], [], [], 0
    for r in true:
        i = int(np.argmin(np.abs(found - hz[r])))
        m = modes[i]
        frequency.append(m["frequency_hz"] / hz[r] - 1)
        damping.append(m["damping_ratio"] / zeta[r] - 1)
        z += [(m["frequency_hz"] - hz[r]) / m["frequency_std_hz"], (m["damping_ratio"] - zeta[r]) / m["damping_ratio_std"]]
        shape = np.array([m["shape"][row] for row in rows])
        scale = shape @ shapes[:, r] / (shapes[:, r] @ shapes[:, r])
        mass.append(abs(scale**-2 - 1))
        matched += abs(frequency[-1]) < 5e-4 and abs(damping[-1]) < 0.03
    return {
        "found": f"{matched}/{true.size}",
        "too_many": len(modes) - true.size,
        "f_max_%": 100 * float(np.max(np.abs(frequency))),
        "zeta_max_%": 100 * float(np.max(np.abs(damping))),
        "zeta_median_%": 100 * float(np.median(np.abs(damping))),
        "within_2std": float(np.mean(np.abs(z) < 2)),
        "mass_median_%": 100 * float(np.median(mass)),
        "mass_max_%": 100 * float(np.max(mass)),
        "misfit": summary["idle"]["misfit"],
    }


def error_db(h: np.ndarray, exact: np.ndarray) -> float:
    """Contract: rms of 20 log10 |H_model|/|H_exact| over lines and pairs."""
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(h) / np.abs(exact))) ** 2)))


def judge_ofrf(out: Path, answer: dict, exact: dict) -> dict[str, float]:
    """Errors of the idle model, the baselines and the OFRF against the exact operating FRF."""
    from operando.scaling import scale_operational
    from operando.store import load_results

    results = load_results(out / "model.h5")
    dofs = [f"{n}+Z" for n in answer["nodes"]]
    f, h = exact["f"], exact["H"]
    figures = {"idle_db": error_db(results.idle.frf(f, dofs, dofs).data, h)}
    for method in ("idle_shapes", "msf_all", "eq13"):
        model = scale_operational(results.idle, results.operating, method=method)
        figures[f"{method}_db"] = error_db(model.frf(f, dofs, dofs).data, h)
    figures["ofrf_db"] = error_db(results.hybrid.frf(f, dofs, dofs).data, h)
    return figures


def undriven(case: Path, answer: dict, exact: dict, work: Path) -> dict[str, object]:
    """p5 fitted with two of its three references: relative error of each column of the idle FRF (nothing changed in operation)."""
    from operando.config import load_test
    from operando.ema import fit_ema
    from operando.frf import estimate_frf
    from operando.io import read

    band = load_test(case / "test.toml").analysis.band
    paths = sorted((case / "idle").glob("*.uff"))
    figures: dict[str, object] = {}
    for leave in range(3):
        records = [r for i, p in enumerate(paths) if i != leave for r in read(p).records]
        frf = estimate_frf(records)
        model = fit_ema(frf, band=band, records=records)
        dofs = [f"{n}+Z" for n in answer["nodes"]]
        h = model.frf(exact["f"], dofs, dofs).data
        error = np.linalg.norm(h - exact["H"], axis=(0, 2)) / np.linalg.norm(exact["H"], axis=(0, 2))
        driven = [answer["nodes"].index(r.node) for r in frf.references]
        free = [j for j in range(len(dofs)) if j not in driven]
        figures[f"without reference {leave}"] = {
            "driven_max_%": 100 * float(error[driven].max()),
            "undriven_median_%": 100 * float(np.median(error[free])),
            "undriven_max_%": 100 * float(error[free].max()),
        }
    return figures


def bound(out: Path) -> dict[str, float]:
    """Stated standard deviations without the floors: the Cramér–Rao bound of the fit, median over the modes in band."""
    from operando.ema.answers import DAMPING_FLOOR, FREQUENCY_FLOOR
    from operando.store import load_results

    idle = load_results(out / "model.h5").idle
    idle = idle.select_modes(np.asarray(idle.in_band))
    f = idle.frequency_std_hz / idle.frequencies_hz
    z = idle.damping_ratio_std / idle.damping_ratios
    return {
        "crb_f": float(np.median(np.sqrt(np.maximum(f**2 - FREQUENCY_FLOOR**2, 0)))),
        "crb_zeta_%": 100 * float(np.median(np.sqrt(np.maximum(z**2 - DAMPING_FLOOR**2, 0)))),
    }


def main() -> None:
    """Run the cases asked for and print one JSON object a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=[])
    parser.add_argument("--cases", type=Path, default=SHARED)
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--undriven", action="store_true", help="also fit p5 with two of its three references")
    options = parser.parse_args()
    work = options.out or Path(tempfile.mkdtemp())
    for name in options.names or ["p1", "p2", "p3", "p4", "p5"]:
        case, out = options.cases / name, work / name
        seconds = run_case(case, out)
        answer = json.loads((options.cases / "answers" / f"{name}.json").read_text())
        summary = json.loads((out / "summary.json").read_text())
        row: dict[str, object] = {"case": name, "seconds": seconds, **judge_modes(summary, answer), **bound(out)}
        row["findings"] = sorted({f["kind"] for f in summary["findings"]})
        exact = options.cases / "answers" / f"{name}.npz"
        if exact.exists():
            truth = dict(np.load(exact))
            row |= judge_ofrf(out, answer, truth)
            if options.undriven and name == "p5":
                row["undriven"] = undriven(case, answer, truth, work)
        print(json.dumps({k: (float(f"{v:.4g}") if isinstance(v, float) else v) for k, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
