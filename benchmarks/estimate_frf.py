"""H1 of 4 references × 64 responses: CPU time and peak memory, against the transforms alone, pairs of scipy.signal.csd, sdynpy and pyFRF.

    python benchmarks/estimate_frf.py [--samples 1000000 4000000] [--repeat 3] [--json FILE]

Each contestant runs in a process of its own on one BLAS thread, in turn; medians count. The input is a single-precision file that operando
maps into memory and the others read. *map, convert, FFT* maps it, converts each block to double precision and transforms it, eight
channels at once, and keeps nothing. Peak memory is the resident size of the whole process, interpreter and input included. sdynpy and
pyFRF are left out where they are not installed; they and csd run at the shortest length only.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

REFERENCES, RESPONSES, BLOCK, RATE = 4, 64, 8192, 4096.0
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "QT_QPA_PLATFORM": "offscreen"}


def write_input(path: Path, samples: int) -> None:
    """Four white forces, responses that mix and delay them, noise; written channel by channel."""
    rng = np.random.default_rng(0)
    data = np.lib.format.open_memmap(path, "w+", np.float32, (REFERENCES + RESPONSES, samples))
    data[:REFERENCES] = rng.standard_normal((REFERENCES, samples), np.float32)
    for i in range(RESPONSES):
        weights = rng.standard_normal(REFERENCES).astype(np.float32)
        data[REFERENCES + i] = np.roll(weights @ data[:REFERENCES], 3 + i % 5) + 0.1 * rng.standard_normal(samples, np.float32)
    data.flush()


def run_operando(path: Path) -> np.ndarray:
    from operando.data import Channel, TimeRecord
    from operando.dof import Dof
    from operando.frf import estimate_frf

    data = np.load(path, mmap_mode="r")
    channels = [Channel(Dof(900 + i, "Z"), "force", "N") for i in range(REFERENCES)]
    channels += [Channel(Dof(1 + i, "Z"), "acceleration", "m/s2") for i in range(RESPONSES)]
    frf = estimate_frf(TimeRecord(data, RATE, tuple(channels)), estimator="h1", block_seconds=BLOCK / RATE, overlap=0.5)
    return frf.data


def run_csd(path: Path) -> np.ndarray:
    from scipy.signal import csd

    data = np.load(path)
    options = {"fs": RATE, "window": "hann", "nperseg": BLOCK, "noverlap": BLOCK // 2}
    gff = np.array([[csd(f, g, **options)[1] for f in data[:REFERENCES]] for g in data[:REFERENCES]])
    gxf = np.array([[csd(f, x, **options)[1] for f in data[:REFERENCES]] for x in data[REFERENCES:]])
    return np.moveaxis(
        np.linalg.solve(np.moveaxis(gff, -1, 0).swapaxes(1, 2), np.moveaxis(gxf, -1, 0).swapaxes(1, 2)).swapaxes(1, 2), 0, -1
    )


def run_sdynpy(path: Path) -> np.ndarray:
    import sdynpy

    data = np.load(path)
    _, frf = sdynpy.frf.timedata2frf(data[:REFERENCES], data[REFERENCES:], 1 / RATE, BLOCK, method="H1", overlap=0.5, window="hann")
    return np.moveaxis(frf, 0, -1)


def run_pyfrf(path: Path) -> np.ndarray:
    import pyFRF

    data = np.load(path).astype(float)
    frf = pyFRF.FRF(sampling_freq=RATE, fft_len=BLOCK, exc_window="hann", resp_window="hann", resp_type="a", nperseg=BLOCK)
    starts = range(0, data.shape[1] - BLOCK + 1, BLOCK // 2)
    blocks = np.array([data[:, start : start + BLOCK] for start in starts])
    frf.add_data(blocks[:, :REFERENCES], blocks[:, REFERENCES:])
    return np.asarray(frf.get_H1())


def run_transform(path: Path) -> np.ndarray:
    from scipy import fft

    data = np.load(path, mmap_mode="r")
    np.empty(1 << 21)  # freed at once: the C library then keeps memory of this size, and the transforms are three times as fast
    for start in range(0, data.shape[1] - BLOCK + 1, BLOCK // 2):
        for row in range(0, data.shape[0], 8):
            fft.rfft(data[row : row + 8, start : start + BLOCK].astype(float), axis=1, overwrite_x=True)
    return np.zeros((RESPONSES, REFERENCES, BLOCK // 2 + 1))


TRANSFORM = "map, convert, FFT"
CONTESTANTS = {"operando": run_operando, TRANSFORM: run_transform, "csd": run_csd, "sdynpy": run_sdynpy, "pyFRF": run_pyfrf}
GOALS = {TRANSFORM: 1 / 1.7}
GOAL_MB = 300.0
LIBRARIES = {"operando": "operando.frf", TRANSFORM: "scipy.fft", "csd": "scipy.signal", "sdynpy": "sdynpy", "pyFRF": "pyFRF"}


def worker(name: str, path: Path, output: Path) -> None:
    """One contestant: prints CPU seconds without those of its imports, and peak resident size [MB]."""
    importlib.import_module("scipy.linalg")  # operando imports it when it is first asked for one thread of BLAS
    importlib.import_module(LIBRARIES[name])
    start = time.process_time()
    h = CONTESTANTS[name](path)
    cpu = time.process_time() - start
    np.save(output, h[:8].astype(np.complex128))
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    print(cpu, float(status["VmHWM"].split()[0]) / 1024)


def measure(samples: int, names: list[str], repeat: int, folder: Path) -> list[dict[str, Any]]:
    """Rows of one length; the contestants in turn."""
    source = folder / "input.npy"
    write_input(source, samples)
    np.load(source, mmap_mode="r").sum()  # in the page cache for everybody
    found: dict[str, list[tuple[float, float]]] = {}
    for _ in range(repeat):
        for name in names:
            call = [sys.executable, __file__, "--worker", name, str(source), str(folder / f"{name}.npy")]
            done = subprocess.run(call, capture_output=True, text=True, env={**os.environ, **THREADS})
            if done.returncode:
                said = done.stderr.strip().splitlines()
                print(f"{name}: {'not installed' if 'ModuleNotFoundError' in done.stderr else said[-1] if said else done.returncode}")
                names = [other for other in names if other != name]
                continue
            cpu, peak = map(float, done.stdout.split()[-2:])
            found.setdefault(name, []).append((cpu, peak))
    own, own_mb = (median(values) for values in zip(*found["operando"], strict=True))
    h = np.load(folder / "operando.npy")
    size = f"{REFERENCES} x {RESPONSES} x {samples}, blocks of {BLOCK}, 50 %"
    limit = {"stage": "H1, memory", "size": size, "ours_s": own, "peer": f"{GOAL_MB:g} MB resident", "peer_s": None, "accuracy": None}
    rows = [limit | {"ratio": GOAL_MB / own_mb, "goal": 1.0, "ours_mb": own_mb, "peer_mb": GOAL_MB}]
    for name in (n for n in found if n != "operando"):
        cpu, peak = (median(values) for values in zip(*found[name], strict=True))
        other = np.load(folder / f"{name}.npy")
        n = min(other.shape[-1], h.shape[-1])
        off = None if name == TRANSFORM else float(np.abs(other[..., 10:n] - h[..., 10:n]).max() / np.abs(h).max())
        rows.append(
            {
                "stage": "H1", "size": size, "ours_s": own, "peer": name, "peer_s": cpu, "ratio": cpu / own, "goal": GOALS.get(name),
                "ours_mb": own_mb, "peer_mb": peak, "accuracy": off if off is None else f"differs by {off:.1e} of the largest H",
            }
        )  # fmt: skip
    return rows


def main() -> None:
    """Run the contestants in turn and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[1_000_000, 4_000_000])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--json", metavar="FILE", help="write the rows of make bench")
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.worker[0], Path(options.worker[1]), Path(options.worker[2]))
        return
    rows: list[dict[str, Any]] = []
    for samples in sorted(options.samples):
        names = list(CONTESTANTS) if samples == min(options.samples) else ["operando", TRANSFORM]
        with tempfile.TemporaryDirectory() as folder:
            rows += measure(samples, names, options.repeat, Path(folder))
    for row in rows:
        print(f"{row['size']}: {row['stage']}, {row['peer']}: ratio {row['ratio']:.2f}, ours {row['ours_s']:.2f} s {row['ours_mb']:.0f} MB")
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
