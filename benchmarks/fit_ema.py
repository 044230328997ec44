"""Processor time and memory of whole modal analyses: many sensors, roving hammers, and the packaged example from raw files to report.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/fit_ema.py [--json FILE] [--quick] [--case FOLDER …]

FRFs are simulated: random shapes, modes spread evenly over the band, 1 % noise, variances stated. Each case runs in a process of its own.
There is no peer that goes from FRFs to modes with uncertainty by itself: the limits are stated, ratio = limit/ours. Accuracy: distance from
the truth in stated standard deviations (rms over the modes), and the worst modal assurance criterion.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

from rows import report, row  # noqa: E402

CASES = {
    "200 x 4, 4000 lines, 60 modes": (200, 4, 60, 4000, 60.0),
    "roving hammer, 3 x 100, 2000 lines, 40 modes": (3, 100, 40, 2000, 60.0),
    "12 x 3, 2000 lines, 15 modes": (12, 3, 15, 2000, None),
}
COMPLEX = {f"{n} x 3, 2000 lines, 10 modes": (n, 3, 10, 2000) for n in (50, 100, 200, 400)}
EXAMPLE = Path(__file__).resolve().parents[1] / "data" / "example" / "test.toml"
CASE = EXAMPLE.parents[3] / "shared" / "cases" / "p1" / "test.toml"
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def simulated(n_resp, n_ref, n_modes, n_lines, noise=0.01, seed=0):
    """FRFs with their variance, and the true frequencies, damping ratios and shapes."""
    import numpy as np

    from operando import Dof, Frf
    from operando.data import FrequencyAxis
    from operando.synthesis import synthesise

    rng = np.random.default_rng(seed)
    f = np.linspace(10, 500, n_lines)
    hz = np.linspace(20, 490, n_modes) + rng.uniform(-2, 2, n_modes)
    zeta = rng.uniform(0.002, 0.006, n_modes)
    phi = rng.standard_normal((max(n_resp, n_ref), n_modes))
    H = synthesise(f, hz, zeta, phi[:n_resp], phi[:n_ref])
    sigma = noise * np.sqrt(np.mean(np.abs(H) ** 2))
    H = H + sigma * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape)) / np.sqrt(2)
    dofs = [tuple(Dof(i + 1, "Z") for i in range(count)) for count in (n_resp, n_ref)]
    return Frf(H, FrequencyAxis(f), *dofs, "accelerance", variance=np.full(H.shape, sigma**2)), hz, zeta, phi


def one(n_resp, n_ref, n_modes, n_lines):
    """Seconds and accuracy of one case, in this process."""
    import numpy as np

    from operando import fit_ema
    from operando.indicators import mac

    frf, hz, zeta, phi = simulated(n_resp, n_ref, n_modes, n_lines)
    start = time.process_time()
    model = fit_ema(frf)
    seconds = time.process_time() - start
    at = np.array([int(np.argmin(np.abs(model.frequencies_hz - h))) for h in hz])
    off = [
        float(np.sqrt(np.mean(((found[at] - true) / std[at]) ** 2)))
        for found, std, true in (
            (model.frequencies_hz, model.frequency_std_hz, hz),
            (model.damping_ratios, model.damping_ratio_std, zeta),
        )
    ]
    like = float(np.min(np.diag(mac(phi, model.shapes[:, at]))))
    text = f"{model.n_modes} of {n_modes} modes ({model.details.answer}), f {off[0]:.2f} σ, damping {off[1]:.2f} σ, MAC {like:.4f}"
    return {"seconds": seconds, "accuracy": text}


def complex_modes(n_resp, n_ref, n_modes, n_lines):
    """Seconds of looking for complex modes where all modes are 2e-4 off in each response, and the peak memory before it."""
    from dataclasses import replace
    from resource import RUSAGE_SELF, getrusage

    import numpy as np

    from operando import fit_ema
    from operando.diagnosis import with_complex_modes
    from operando.synthesis import synthesise

    frf, hz, zeta, phi = simulated(n_resp, n_ref, n_modes, n_lines)
    off = 1 + 2e-4 * np.random.default_rng(1).standard_normal(n_resp)
    rows = [synthesise(frf.frequencies_hz, hz * off[i], zeta, phi[[i]], phi[:n_ref])[0] for i in range(n_resp)]
    frf = replace(frf, data=frf.data + rows - synthesise(frf.frequencies_hz, hz, zeta, phi[:n_resp], phi[:n_ref]))
    model = fit_ema(frf, ema="linear")
    before, start = getrusage(RUSAGE_SELF).ru_maxrss / 1e3, time.process_time()
    with_complex_modes(model, frf)
    seconds = time.process_time() - start
    return {"seconds": seconds, "accuracy": f"peak before it {before:.0f} MB"}


def child(arguments):
    """Output of a call of this script or of operando, its processor seconds and peak memory [MB]."""
    done = subprocess.Popen([sys.executable, *arguments], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    text = done.stdout.read()
    _, status, used = os.wait4(done.pid, 0)
    done.returncode = os.waitstatus_to_exitcode(status)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)} ended with {done.returncode}")
    return text, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="write the rows here")
    parser.add_argument("--quick", action="store_true", help="the small case only")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    known = [str(CASE)] if CASE.exists() else []
    parser.add_argument("--case", nargs="*", default=known, metavar="FILE", help="test files with a limit of 12 s (p1, where it is)")
    options = parser.parse_args()
    if options.one:
        what, *numbers = options.one.split(",")
        print(json.dumps(globals()[what](*(int(v) for v in numbers))))
        return
    rows = []
    for size, (*numbers, limit) in list(CASES.items())[2 if options.quick else 0 :]:
        text, _, memory = child([str(Path(__file__).resolve()), "--one", ",".join(["one", *map(str, numbers)])])
        found = json.loads(text)
        peer = None if limit is None else "limit"
        rows.append(row("EMA, FRFs to modes with σ", size, found["seconds"], peer, limit, None, found["accuracy"], memory))
    for size, numbers in {} if options.quick else COMPLEX.items():
        text, _, memory = child([str(Path(__file__).resolve()), "--one", ",".join(["complex_modes", *map(str, numbers)])])
        found = json.loads(text)
        rows.append(row("Complex modes sought", size, found["seconds"], None, None, None, found["accuracy"], memory))
    # As pip does when it installs: an editable installation may lack it, or be told not to keep it.
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(EXAMPLE.parents[2] / "src")], check=True, env=ENVIRONMENT)
    tests = [(EXAMPLE, 15.0), *((Path(p), 12.0) for p in options.case)]
    for path, limit in tests:
        with tempfile.TemporaryDirectory() as folder:
            call = ["-m", "operando", "run", str(path), "-o", str(Path(folder) / "out")]
            _, seconds, memory = child(call)
            _, again, again_mb = child(call)
        rows.append(row("Whole run, raw files to report", path.parent.name, seconds, "limit", limit, None, None, memory, 500.0))
        rows.append(row("The same again, nothing changed", path.parent.name, again, "limit", 1.0, None, None, again_mb, 500.0))
    report(rows, options.json)


if __name__ == "__main__":
    main()
