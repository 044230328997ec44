"""Speed of pole fits, residues and synthesis of the modal analysis against sdynpy and einsum; one BLAS thread, one run.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/plscf.py [--json FILE] [--quick]

Processor seconds, median of several, both in the same process on the same FRFs and in turn, so that a busy machine cannot favour one.
120 poles are what the largest order gives: order 30 on the whole circle here, order 60 on the half circle there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import time
import warnings

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np  # noqa: E402

from operando.ema.lsfd import lsfd  # noqa: E402
from operando.ema.plscf import plscf  # noqa: E402
from operando.synthesis import modal_kernel, synthesise  # noqa: E402
from rows import report, row  # noqa: E402


def plate(n_resp: int, n_ref: int, n_modes: int, n_lines: int, noise: float, seed: int = 0):
    """Random shapes, modes spread over the band with the even density of a plate; noise relative to the rms FRF.

    Returns lines, FRFs, frequencies, damping ratios, standard deviation of the noise, shapes.
    """
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
    return f, H, hz, zeta, sigma, shapes


def cpu(function, repeats: int):
    """Median CPU seconds and the last result."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return float(np.median(times)), result


def sdynpy_frf(f, H):
    """The FRFs as sdynpy holds them, and the package; None where it is not installed."""
    try:
        import sdynpy as sdpy
    except ImportError:
        return None, None
    n, m, _ = H.shape
    rows = sdpy.coordinate_array(np.arange(1, n + 1), 3)[:, None]
    columns = sdpy.coordinate_array(np.arange(1, m + 1), 3)[None, :]
    kind = sdpy.data.FunctionTypes.FREQUENCY_RESPONSE_FUNCTION
    return sdpy.data.data_array(kind, f, H.copy(), np.stack(np.broadcast_arrays(rows, columns), -1)), sdpy


@contextlib.contextmanager
def quiet():
    """Without the prints and warnings of others."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def polypy(f, H, orders):
    """Seconds, frequencies and damping of the largest order by sdynpy; only the fit itself is timed."""
    with quiet():
        data, sdpy = sdynpy_frf(f, H)
        if sdpy is None:
            return None
        fit = sdpy.modal.PolyPy(data)
        start = time.process_time()
        fit.compute_poles(np.asarray(orders))
        seconds = time.process_time() - start
    poles = fit.pole_list[0]
    return seconds, poles["omega"] / (2 * np.pi), poles["zeta"]


def multireference(f, H, hz, zeta, participation):
    """Seconds and synthesised FRFs of sdynpy's shapes for given poles and participation."""
    with quiet():
        data, sdpy = sdynpy_frf(f, H)
        if sdpy is None:
            return None
        from sdynpy.modal.sdynpy_modeshape import compute_shapes_multireference

        start = time.process_time()
        found = compute_shapes_multireference(data, hz, zeta, participation.T, displacement_derivative=2)
        return time.process_time() - start, found[3].ordinate


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


def in_turn(ours, theirs, repeats):
    """Median seconds of ours and theirs (None where it is not installed), one after the other, and both last results."""
    own, other, mine, peer = [], [], None, None
    for _ in range(repeats):
        seconds, mine = cpu(ours, 3)
        own.append(seconds)
        peer = theirs()
        if peer is not None:
            other.append(peer[0])
    return float(np.median(own)), float(np.median(other)) if other else None, mine, peer


def pole_rows(quick):
    """Poles of all orders."""
    f, H, hz, zeta, *_ = plate(200, 4, 40, 2000, 0.01)
    theirs_now = (lambda: None) if quick else (lambda: polypy(f, H, range(2, 61)))
    ours, theirs, orders, peer = in_turn(lambda: plscf(f, H, max_order=30), theirs_now, 2)
    best = orders[-1]
    mine = errors(hz, zeta, best.frequency_hz[best.physical], best.damping_ratio[best.physical])
    accuracy = f"{mine['found']} of {mine['of']} modes, damping {100 * mine['median_damping_error']:.2f} % off"
    if peer is not None:
        other = errors(hz, zeta, peer[1], peer[2])
        accuracy += f" (sdynpy {other['found']}, {100 * other['median_damping_error']:.2f} %)"
    out = [row("pLSCF, all orders", "200 x 4, 2000 lines, 120 poles", ours, "sdynpy PolyPy", theirs, 80, accuracy)]
    if peer is not None:
        seconds, real = cpu(lambda: plscf(f, H, max_order=60, basis="real", arc=1.0, numerator_extra=0), 1)
        # poles of the same algorithm, in PolyPy's terms of the shifted problem
        shifted = real[-1].poles - 2j * np.pi * f[0]
        keep = (shifted.real < 0) & (shifted.imag > 0)
        omega = np.sort(np.abs(shifted[keep]) / (2 * np.pi) + f[0])
        same = "poles differ in number"
        if omega.size == peer[1].size:
            same = f"poles equal to {np.max(np.abs(omega / np.sort(peer[1]) - 1)):.1e}"
        out.append(row("pLSCF, the same algorithm", "200 x 4, 2000 lines, 120 poles", seconds, "sdynpy PolyPy", theirs, None, same))
    sizes = [(12, 3, 4000, 20), (50, 4, 2000, 30), (200, 4, 2000, 75), (400, 8, 4000, 30)]
    for n_resp, n_ref, n_lines, order in sizes[: 2 if quick else None]:
        f, H, *_ = plate(n_resp, n_ref, 30, n_lines, 0.01)
        seconds, _ = cpu(lambda: plscf(f, H, max_order=order), 3)  # noqa: B023
        limit = 1.5 if order == 75 else None
        size = f"{n_resp} x {n_ref}, {n_lines} lines, {order * n_ref} poles"
        out.append(row("pLSCF, growth", size, seconds, "limit" if limit else None, limit))
    return out


def residue_rows(quick):
    """Residues for given poles."""
    out = []
    for n_resp, n_ref, n_lines, n_modes in [(200, 4, 2000, 40), (100, 4, 4000, 60)][: 1 if quick else 2]:
        f, H, hz, zeta, sigma, shapes = plate(n_resp, n_ref, n_modes, n_lines, 0.01)
        lam = 2 * np.pi * hz * (-zeta + 1j * np.sqrt(1 - zeta**2))
        u = shapes[:n_ref]
        peer = lambda: None if quick else multireference(f, H, hz, zeta, u)  # noqa: B023, E731
        ours, theirs, found, other = in_turn(lambda: lsfd(f, H, lam, participation=u), peer, 3)  # noqa: B023
        left = [float(np.sqrt(np.mean(np.abs(fit - H) ** 2)) / sigma) for fit in (found.frf(f), *(() if other is None else (other[1],)))]
        accuracy = f"remainder {left[0]:.4f} of the noise" + ("" if other is None else f" (sdynpy {left[1]:.4f})")
        size = f"{n_resp} x {n_ref}, {n_lines} lines, {n_modes} modes"
        out.append(row("LSFD, shapes of all references", size, ours, "sdynpy compute_shapes_multireference", theirs, 15, accuracy))
    return out


def synthesis_rows():
    """FRFs from modes."""
    rng = np.random.default_rng(0)
    f, hz, zeta = np.linspace(0, 500, 4097), np.sort(rng.uniform(5, 490, 60)), np.full(60, 0.01)
    a, b = rng.standard_normal((200, 60)), rng.standard_normal((4, 60))

    def einsum(optimize):
        start = time.process_time()
        found = np.einsum("ir,jr,rl->ijl", a, b, modal_kernel(f, hz, zeta, "accelerance"), optimize=optimize)
        return time.process_time() - start, found

    out = []
    for name, optimize, goal in (("numpy einsum", False, 20), ("numpy einsum(optimize=True)", True, 1)):
        ours, theirs, mine, other = in_turn(lambda: synthesise(f, hz, zeta, a, b), lambda: einsum(optimize), 7)  # noqa: B023
        same = f"equal to {np.max(np.abs(mine - other[1])) / np.max(np.abs(other[1])):.1e}"
        out.append(row("Synthesis of FRFs", "200 x 4, 4097 lines, 60 modes", ours, name, theirs, goal, same))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="write the rows here")
    parser.add_argument("--quick", action="store_true", help="without sdynpy and the large sizes")
    options = parser.parse_args()
    rows = [*synthesis_rows(), *residue_rows(options.quick), *pole_rows(options.quick)]
    report(rows, options.json)


if __name__ == "__main__":
    main()
