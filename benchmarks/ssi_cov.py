"""SSI-cov on FFT correlations against pyOMA-2: same record, same block rows, same orders, one BLAS thread, one process.

    python benchmarks/ssi_cov.py [--large]

Prints CPU seconds and their ratio, how far matched poles lie apart in units of their standard deviation, and the growth with size
(``--large`` adds 64 channels × 1 000 000 samples with its peak memory, own code only).
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
from threadpoolctl import threadpool_limits

from coverage_oma import Plate

FS = 256.0


def own(data, rows, order):
    """Correlations, Hankel factorisation and poles of all even orders; the keyword defaults of ``fit_oma`` with ``weighting='none'``."""
    from operando.oma.correlation import correlate
    from operando.oma.subspace import factorise_weighted, poles_of_orders, realise

    references = np.arange(data.shape[0])
    correlations = correlate(data, references, 2 * rows, 1, keep_blocks=False)
    factors = factorise_weighted(correlations.mean, references, rows, order, data.shape[1], "none")
    return poles_of_orders(realise(factors, data.shape[0]), range(4, order + 1, 2), FS)


def pyoma(data, rows, order):
    """pyOMA-2's SSIcov (method "cov"): its own three functions as ``SSI.run`` calls them, without progress bars."""
    from operando.oma.pyoma import contained_pyoma

    with contained_pyoma() as ssi:
        hankel, _ = ssi.build_hank(data, data, rows, "cov")
        obs, a, c, _ = ssi.SSI_fast(hankel, rows, order, step=2)
        return ssi.SSI_poles(obs, a, c, order, 1 / FS, step=2, xi_max=0.25)


def deviations(data, rows, order):
    """Standard deviations of frequency and damping of the poles of the highest order."""
    from operando.oma.correlation import correlate
    from operando.oma.subspace import factorise_weighted, poles_of_order, realise
    from operando.oma.uncertainty import covariance_of_mean, normalised_changes, perturb

    references = np.arange(data.shape[0])
    correlations = correlate(data, references, 2 * rows, 100)
    factors = factorise_weighted(correlations.mean, references, rows, 2 * order, data.shape[1], "none")
    realisation = realise(factors, data.shape[0])
    poles = poles_of_order(realisation, order, FS)
    change = perturb(correlations, factors, realisation, poles, np.arange(poles.hz.size), rows, FS)
    changes = normalised_changes(np.log(poles.mu) * FS, poles.shapes, change)[:, : 2 * poles.hz.size]
    return poles, np.sqrt(np.diag(covariance_of_mean(changes, correlations.weights))).reshape(2, -1)


def cpu(function, *arguments):
    """CPU seconds (user and system) and result."""
    start = time.process_time()
    result = function(*arguments)
    return time.process_time() - start, result


def main(large=False):
    rows, order = 40, 60
    own(np.random.default_rng(0).standard_normal((3, 4000)), 10, 10)
    import pyoma2.functions.ssi  # noqa: F401  (import time is not counted)

    if large:
        data = np.random.default_rng(2).standard_normal((64, 1_000_000), dtype=np.float32)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        seconds, _ = cpu(own, data, 30, 120)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        what = "64 channels x 1 000 000 samples, 30 block rows, order 120"
        print(f"{what}: {seconds:.2f} s CPU, {(peak - before) / 1e6:.2f} GB beside the record")
    print(f"block rows {rows}, orders 4 to {order} step 2; CPU seconds on one BLAS thread")
    print("channels  samples     own  pyOMA-2   ratio   |Δf|/σ max   |Δζ|/σ max   (poles with ζ < 5 %)")
    for channels, samples in ((6, 60_000), (12, 60_000), (19, 60_000), (19, 150_000), (19, 300_000)):
        data = Plate(n_sensors=channels, n_forces=8).record(samples / FS, FS, np.random.default_rng(1))
        data -= data.mean(axis=1, keepdims=True)
        fast, poles = cpu(own, data, rows, order)
        slow, other = cpu(pyoma, data, rows, order)
        reference, std = deviations(data, rows, order)
        hz, zeta = other[0][:, -1], other[1][:, -1]
        mine = poles[-1]
        physical = np.flatnonzero((mine.zeta > 0) & (mine.zeta < 0.05) & (mine.hz < 0.4 * FS))
        worst = [0.0, 0.0]
        for k in physical:
            j = int(np.nanargmin(np.abs(hz - mine.hz[k])))
            i = int(np.argmin(np.abs(reference.hz - mine.hz[k])))
            worst[0] = max(worst[0], abs(hz[j] - mine.hz[k]) / std[0, i])
            worst[1] = max(worst[1], abs(zeta[j] - mine.zeta[k]) / std[1, i])
        print(
            f"{channels:8d} {samples:8d} {fast:7.2f} {slow:8.2f} {slow / fast:7.1f} {worst[0]:12.3f} {worst[1]:12.3f}   ({physical.size})",
            flush=True,
        )


if __name__ == "__main__":
    with threadpool_limits(1, "blas"):
        main("--large" in sys.argv)
