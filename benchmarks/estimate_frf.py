"""H1 of 4 references × 64 responses × 1e6 samples: CPU time and peak memory, against pairs of scipy.signal.csd and sdynpy.

    python benchmarks/estimate_frf.py [--samples 1000000] [--others]

Each contestant runs in a process of its own on one BLAS thread; the input is a single-precision file that operando maps into
memory and the others read. Peak memory is the resident size of the whole process, interpreter and input included.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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


CONTESTANTS = {"operando": run_operando, "csd": run_csd, "sdynpy": run_sdynpy}


def memory() -> tuple[float, float]:
    """Peak resident size and present size of file mappings [MB]."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    mapped = float(status.get("RssFile", "0 kB").split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, mapped


def worker(name: str, path: Path, output: Path) -> None:
    """One contestant: prints CPU seconds, peak resident size and mapped files [MB]."""
    start = time.process_time()
    h = CONTESTANTS[name](path)
    cpu = time.process_time() - start
    peak, mapped = memory()
    np.save(output, h[:8].astype(np.complex128))
    print(f"{cpu} {peak} {mapped}")


def main() -> None:
    """Run the contestants one after the other and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--others", action="store_true", help="csd pairs and sdynpy too")
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.worker[0], Path(options.worker[1]), Path(options.worker[2]))
        return
    with tempfile.TemporaryDirectory() as folder:
        results = {}
        jobs = [("operando", options.samples // 4), ("operando", options.samples)]
        jobs += [(n, options.samples) for n in CONTESTANTS if n != "operando"] if options.others else []
        written = 0
        source = Path(folder) / "input.npy"
        for name, samples in jobs:
            if written != samples:
                write_input(source, samples)
                written = samples
                np.load(source, mmap_mode="r").sum()  # in the page cache for everybody
            target = Path(folder) / f"{name}.npy"
            call = [sys.executable, __file__, "--worker", name, str(source), str(target)]
            done = subprocess.run(call, capture_output=True, text=True, env={**os.environ, **THREADS})
            if done.returncode:
                print(f"{name}: failed: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else done.returncode}")
                continue
            cpu, peak, mapped = map(float, done.stdout.split()[-3:])
            size = (REFERENCES + RESPONSES) * samples * 4 / 2**20
            print(
                f"{name:9s} {samples:8d} samples ({size:4.0f} MB): {cpu:6.2f} s CPU, peak {peak:5.0f} MB, "
                f"of which at the end {mapped:4.0f} MB mapped files"
            )
            results[name] = (cpu, np.load(target))
        for name, (cpu, h) in results.items():
            if name != "operando":
                ours = results["operando"]
                n = min(h.shape[-1], ours[1].shape[-1])
                difference = np.abs(h[..., 10:n] - ours[1][..., 10:n]).max() / np.abs(ours[1]).max()
                print(f"{name}: {cpu / ours[0]:.1f} × the CPU time of operando, largest difference {difference:.1e} of the largest |H|")


if __name__ == "__main__":
    main()
