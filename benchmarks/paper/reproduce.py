"""Reproduces Section 4 of Shen & Lu (2024), Machines 12(8), 516: tables, figures and what operando makes of the raw files.

    python benchmarks/paper/reproduce.py [FOLDER]        (make paper)

Writes FOLDER/paper.html (default paper-results) with everything in it; the raw files, the results of each run and the exact modes stay
beside it. Nothing outside the project is needed; the check against the modes of the layout study runs where they are.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import exact
import experiment
import raw
from page import write_page
from tripod import DESIGNS, Modes, exact_modes

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT.parent / "shared" / "reference"
REFERENCE_FILES = {"original": "mitc_orig", "case 1": "mitc_t1", "case 2": "mitc_t2"}


def against_reference(modes: dict[str, Modes]) -> dict[str, float] | None:
    """Largest relative difference of the 72 frequencies from the layout study, by design; None where its files are missing."""
    import numpy as np

    if not REFERENCE.exists():
        return None
    out = {}
    for name, file in REFERENCE_FILES.items():
        with np.load(REFERENCE / f"{file}.npz") as kept:
            out[name] = float(np.max(np.abs(modes[name].hz / kept["f"] - 1)))
    return out


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "paper-results")
    start = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - start:6.1f} s  {text}", file=sys.stderr, flush=True)

    modes = {}
    for name in DESIGNS:
        say(f"finite elements: {name}")
        modes[name] = exact_modes(name, folder / "modes")
    say("exact modes through every scaling")
    studies = {case: exact.study(modes["original"], modes[case], case) for case in exact.EPSILON}
    runs = []
    for case in exact.EPSILON:
        for label, band in raw.BANDS.items():
            where = folder / f"{case.replace(' ', '-')}-{label.split(' ')[0].replace('–', '-')}"
            runs.append(raw.study(where, modes["original"], modes[case], case, band, say))
            say(f"{case}, {label}: {runs[-1].seconds:.0f} s, auto {runs[-1].errors[raw.SOURCES[0]]['auto']:.2f} dB from A")
    legs_study = experiment.study(folder / "plate-on-legs", say)
    path = write_page(
        folder / "paper.html", modes, studies, runs, legs_study, against_reference(modes), lambda: time.perf_counter() - start
    )
    say("done")
    print(path.resolve())


if __name__ == "__main__":
    main()
