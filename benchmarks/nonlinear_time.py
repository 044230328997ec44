"""How long a diagnosis from records takes: 12 sensors (66 pairs), 4 records of 96 s at 512 Hz, the idle model given.

    python benchmarks/nonlinear_time.py [--profile]

Records come from the tests' own integrator. Time is that of ``diagnose_records`` alone: what a run takes beyond identification. Measure
on an idle machine.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from threadpoolctl import threadpool_limits

from nonlinear_truth import Strip, measure_many, place
from operando.diagnosis import diagnose_records

SECONDS = 96.0


def cases(strip: Strip) -> dict:
    """Effects at DOFs and between two; nothing hidden."""
    return {
        "clearance at one DOF": [(place(strip, 4), "clearance", {"stiffness": 6e3, "gap": 1e-3})],
        "cubic stiffness at one DOF": [(place(strip, 2), "cubic_stiffness", {"coefficient": 1e8})],
        "dry friction between two": [(place(strip, 3, 7), "coulomb_friction", {"force": 1.0, "speed": 3e-3})],
        "hysteresis at one DOF": [(place(strip, 8), "hysteresis", {"stiffness": 4e3, "yield_force": 2.0, "exponent": 2.0, "ratio": 0.3})],
        "nothing": [],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", action="store_true", help="where the time goes, case by case")
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    options = parser.parse_args()
    strip = Strip(sensors=12)
    chosen = {name: effects for name, effects in cases(strip).items() if options.only in name}
    start = time.perf_counter()
    with threadpool_limits(1):
        made = measure_many(strip, chosen, seconds=SECONDS)
    print(f"{len(chosen)} cases integrated in {time.perf_counter() - start:.0f} s")
    for name, records in made.items():
        profile = cProfile.Profile()
        start, busy = time.perf_counter(), time.process_time()
        if options.profile:
            profile.enable()
        found = diagnose_records(strip.idle(), records)
        profile.disable()
        took, worked = time.perf_counter() - start, time.process_time() - busy
        print(
            f"{name:28s} {took:5.1f} s ({worked:5.1f} s of processor)  {found.verdict:11s} {', '.join(map(str, found.effects))}", flush=True
        )
        if options.profile:
            pstats.Stats(profile).sort_stats("tottime").print_stats(18)


if __name__ == "__main__":
    main()
