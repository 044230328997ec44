"""A record that is larger than the memory it may take: processor time and resident memory of inspect, FRFs and OMA over its length.

    python benchmarks/long_record.py [--gigabytes 0.5 2] [--folder DIR] [--json FILE]

64 channels in double precision, UFF 58b: two forces, 62 responses of eight modes with noise. Each stage runs in a process of its own on one
BLAS thread; memory is the peak resident size of the whole process. The files are deleted afterwards.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

RATE, FORCES, RESPONSES = 2048.0, 2, 62
MODES_HZ = np.array([11.0, 19.0, 31.0, 47.0, 74.0, 101.0, 142.0, 190.0])
DAMPING = 0.01
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
GOAL_MB = 1000.0

TEST = """name = "long"
[STATE]
records = ["long.uff"]
[analysis]
band = [5.0, 250.0]
"""
STAGES = {
    "inspect": "main(['inspect', file, '--json'])",
    "h1": "estimate_frf(read(file).records, estimator='h1', block_seconds=8192 / 2048)",
    "frf": "estimate_frf(read(file).records)",
    "oma": "fit_oma(read(file).records, band=(5.0, 250.0))",
    "command frf": "main(['frf', folder + '/idle.toml', '-o', out])",
    "command oma": "main(['oma', folder + '/operating.toml', '-o', out])",
}
CHILD = """
import contextlib, io, os, sys, time
folder, out = sys.argv[1:]
file = folder + '/long.uff'
sys.argv = ['operando']
from operando.cli import main as command
from operando.frf import estimate_frf
from operando.io import read
from operando.oma import fit_oma
def main(arguments):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        command(arguments)
start = time.process_time()
made = {stage}
seconds = time.process_time() - start
peak = next(l.split()[1] for l in open('/proc/self/status') if l.startswith('VmHWM'))
modes = [] if not hasattr(made, 'damping_ratios') else made.frequencies_hz.round(3).tolist()
print(seconds, peak, modes, sep=';')
"""


def write_record(path: Path, gigabytes: float) -> int:
    """The record, channel by channel; returns its samples."""
    from scipy.signal import lfilter

    from operando.data import Channel, MappedSamples, TimeRecord
    from operando.dof import Dof
    from operando.io import write_uff

    samples = int(gigabytes * 1e9 / (8 * (FORCES + RESPONSES)))
    rng = np.random.default_rng(0)
    force = rng.standard_normal((FORCES, samples))
    entering, shapes = rng.standard_normal((MODES_HZ.size, FORCES)), rng.standard_normal((RESPONSES, MODES_HZ.size))
    motion = np.empty((MODES_HZ.size, samples))
    for k, hz in enumerate(MODES_HZ):
        pole = np.exp((-DAMPING + 1j * np.sqrt(1 - DAMPING**2)) * 2 * np.pi * hz / RATE)
        drive = entering[k] @ force
        motion[k] = lfilter([1.0, -2.0, 1.0], [1.0, -2 * pole.real, abs(pole) ** 2], drive)

    def row(rows: Any, first: int, last: int) -> np.ndarray:
        out = []
        for i in rows:
            if i < FORCES:
                out.append(force[i, first:last])
            else:
                noise = np.random.default_rng((i, first)).standard_normal(last - first)
                out.append(shapes[i - FORCES] @ motion[:, first:last] + 0.05 * noise)
        return np.array(out)

    channels = [Channel(Dof(900 + i, "Z"), "force", "N", f"f{i}") for i in range(FORCES)]
    channels += [Channel(Dof(1 + i, "Z"), "acceleration", "m/s2", f"a{i}") for i in range(RESPONSES)]
    write_uff(path, TimeRecord(MappedSamples(row, (FORCES + RESPONSES, samples), np.float64), RATE, tuple(channels)))
    return samples


def run(stage: str, folder: Path) -> tuple[float, float, str]:
    """Processor seconds, peak memory [MB] and the modes found of one stage."""
    code = CHILD.replace("{stage}", STAGES[stage])
    call = [sys.executable, "-c", code, str(folder), str(folder / f"out-{stage.replace(' ', '-')}")]
    done = subprocess.run(call, capture_output=True, text=True, env={**os.environ, **THREADS})
    if done.returncode or ";" not in done.stdout:
        raise SystemExit(f"{stage}: {done.stderr[-2000:]}")
    seconds, peak, modes = done.stdout.strip().splitlines()[-1].split(";")
    return float(seconds), float(peak) / 1024, modes


def main() -> None:
    """Run the stages on each length and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gigabytes", type=float, nargs="+", default=[0.5, 2.0])
    parser.add_argument("--stages", nargs="+", default=["inspect", "h1", "frf", "oma"], choices=list(STAGES))
    parser.add_argument("--folder", help="where the files are written (default: the folder for temporary files)")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    rows = []
    for size in options.gigabytes:
        with tempfile.TemporaryDirectory(dir=options.folder) as name:
            folder = Path(name)
            samples = write_record(folder / "long.uff", size)
            for state in ("idle", "operating"):
                (folder / f"{state}.toml").write_text(TEST.replace("STATE", state))
            for stage in options.stages:
                seconds, peak, modes = run(stage, folder)
                print(f"{size:6g} GB, {samples} samples: {stage:12s} {seconds:8.1f} s {peak:6.0f} MB {modes}", flush=True)
                length = f"{size:g} GB, {FORCES + RESPONSES} x {samples}"
                row = {"stage": f"long record, {stage}", "size": length, "ours_s": round(seconds, 2), "peer": "1 GB resident"}
                row |= {"peer_s": None, "ratio": round(GOAL_MB / peak, 3), "goal": 1.0, "ours_mb": round(peak), "peer_mb": GOAL_MB}
                rows.append(row | {"accuracy": modes if modes != "[]" else None})
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
