"""Speed of the poly-reference LSCF against sdynpy's PolyPy on 200 × 4 FRFs and 120 poles, and of LSFD; one BLAS thread, one run.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/plscf.py [--json] [--quick]

CPU seconds, median of several for ours, both in the same process on the same FRFs (the order is ours, theirs, ours, so that a busy machine
cannot favour one). 120 poles are what the largest order gives: order 30 on the whole circle here, order 60 on the half circle there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import time
import warnings

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np  # noqa: E402

from operando.ema.lsfd import lsfd  # noqa: E402
from operando.ema.plscf import plscf  # noqa: E402


def plate(n_resp: int, n_ref: int, n_modes: int, n_lines: int, noise: float, seed: int = 0):
    """Random shapes, modes spread over the band with the even density of a plate; noise relative to the rms FRF."""
    rng = np.random.default_rng(seed)
    f = np.linspace(10, 500, n_lines)
    hz = np.linspace(20, 490, n_modes) + rng.uniform(-2, 2, n_modes)
    zeta = rng.uniform(0.002, 0.006, n_modes)
    shapes = rng.standard_normal((n_resp, n_modes))
    w, wr = 2 * np.pi * f, 2 * np.pi * hz
    kernel = -(w**2) / (wr[:, None] ** 2 - w**2 + 2j * zeta[:, None] * wr[:, None] * w)
    residues = (shapes[:, None, :] * shapes[None, :n_ref, :]).reshape(-1, n_modes)
    H = (residues @ kernel).reshape(n_resp, n_ref, n_lines)
    sigma = noise * np.sqrt(np.mean(np.abs(H) ** 2))
    H += sigma * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)) / np.sqrt(2)
    return f, H, hz, zeta, sigma


def cpu(function, repeats: int):
    """Median CPU seconds and the last result."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return float(np.median(times)), result


def polypy(f, H, orders):
    """Poles of the largest order (frequencies, damping) by sdynpy; only the fit itself is timed."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import sdynpy as sdpy

        n, m, _ = H.shape
        rows = sdpy.coordinate_array(np.arange(1, n + 1), 3)[:, None]
        columns = sdpy.coordinate_array(np.arange(1, m + 1), 3)[None, :]
        data = sdpy.data.data_array(
            sdpy.data.FunctionTypes.FREQUENCY_RESPONSE_FUNCTION, f, H.copy(), np.stack(np.broadcast_arrays(rows, columns), -1)
        )
        fit = sdpy.modal.PolyPy(data)
        start = time.process_time()
        fit.compute_poles(np.asarray(orders))
        seconds = time.process_time() - start
    poles = fit.pole_list[0]
    return seconds, poles["omega"] / (2 * np.pi), poles["zeta"]


def errors(hz, zeta, found_hz, found_zeta):
    """Median relative errors of frequency and damping, and how many modes were found within a quarter of their bandwidth."""
    k = np.array([int(np.argmin(np.abs(found_hz - h))) for h in hz])
    near = np.abs(found_hz[k] / hz - 1) < 0.5 * zeta
    return {
        "found": int(near.sum()),
        "of": int(hz.size),
        "median_frequency_error": float(np.median(np.abs(found_hz[k] / hz - 1))),
        "median_damping_error": float(np.median(np.abs(found_zeta[k] / zeta - 1))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--quick", action="store_true", help="without sdynpy and the large sizes")
    options = parser.parse_args()
    out: dict[str, object] = {}

    f, H, hz, zeta, _ = plate(200, 4, 40, 2000, 0.01)
    before, orders = cpu(lambda: plscf(f, H, max_order=30), 5)
    best = orders[-1]
    ours = errors(hz, zeta, best.frequency_hz[best.physical], best.damping_ratio[best.physical])
    row: dict[str, object] = {"poles": int(best.order * 4), "ours": ours}
    if not options.quick:
        theirs_seconds, theirs_hz, theirs_zeta = polypy(f, H, range(2, 61))
        row |= {"polypy": errors(hz, zeta, theirs_hz, theirs_zeta), "polypy_cpu_s": theirs_seconds}
        after, _ = cpu(lambda: plscf(f, H, max_order=30), 5)
        before = max(before, after)
        row["ratio"] = theirs_seconds / before
        equal, real = cpu(lambda: plscf(f, H, max_order=60, basis="real", arc=1.0, numerator_extra=0), 3)
        # poles of the same algorithm, in PolyPy's terms of the shifted problem
        shifted = real[-1].poles - 2j * np.pi * f[0]
        keep = (shifted.real < 0) & (shifted.imag > 0)
        omega = np.sort(np.abs(shifted[keep]) / (2 * np.pi) + f[0])
        row["same_algorithm_cpu_s"] = equal
        row["same_algorithm_ratio"] = theirs_seconds / equal
        row["same_algorithm_worst_pole_difference"] = (
            float(np.max(np.abs(omega / np.sort(theirs_hz) - 1))) if omega.size == theirs_hz.size else None
        )
    row["ours_cpu_s"] = before
    out["plscf 200 x 4, 2000 lines"] = row

    growth = {}
    sizes = [(12, 3, 4000, 20), (50, 4, 2000, 30), (200, 4, 2000, 30)] + ([] if options.quick else [(200, 4, 2000, 75), (400, 8, 4000, 30)])
    for n_resp, n_ref, n_lines, order in sizes:
        f, H, *_ = plate(n_resp, n_ref, 30, n_lines, 0.01)
        seconds, _ = cpu(lambda: plscf(f, H, max_order=order), 3)  # noqa: B023
        growth[f"{n_resp} x {n_ref}, {n_lines} lines, {order * n_ref} poles"] = seconds
    out["plscf cpu_s by size"] = growth

    fits = {}
    for n_resp, n_ref, n_lines, n_modes in [(12, 3, 4000, 20), (100, 4, 4000, 60)][: 1 if options.quick else 2]:
        f, H, hz, zeta, _ = plate(n_resp, n_ref, n_modes, n_lines, 0.01)
        lam = 2 * np.pi * hz * (-zeta + 1j * np.sqrt(1 - zeta**2))
        label = f"{n_resp} x {n_ref}, {n_lines} lines, {n_modes} modes"
        fits[label] = {
            "free residues": cpu(lambda: lsfd(f, H, lam), 3)[0],  # noqa: B023
        }
    out["residues cpu_s"] = fits
    json.dump(out, sys.stdout, indent=None if options.json else 2)
    print()


if __name__ == "__main__":
    main()
