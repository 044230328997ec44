"""SSI-cov on FFT correlations against pyOMA-2: same record, same block rows, same orders, one BLAS thread, one process; and its
uncertainty, against pyOMA-2's and against the scatter of many records.

    python benchmarks/ssi_cov.py [--json FILE] [--quick]

Processor seconds and their ratio, how far matched poles lie apart in units of their standard deviation, growth with size, and the peak
memory of 64 channels × 1 000 000 samples. pyOMA-2's uncertainty is right with a step of one order only.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from threadpoolctl import threadpool_limits

from coverage_oma import Plate
from rows import report, row

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


def installed():
    """Whether pyOMA-2 is; its import is not timed."""
    try:
        import pyoma2.functions.ssi  # noqa: F401
    except ImportError:
        return False
    return True


def size_rows(quick):
    """All orders without uncertainty, by size."""
    rows, order = 40, 60
    goals = {(19, 60_000): 15.0, (19, 300_000): 60.0}
    out = []
    for channels, samples in ((6, 60_000), (12, 60_000), (19, 60_000), (19, 150_000), (19, 300_000))[: 3 if quick else None]:
        data = Plate(n_sensors=channels, n_forces=8).record(samples / FS, FS, np.random.default_rng(1))
        data -= data.mean(axis=1, keepdims=True)
        slow, accuracy = None, None
        seconds = [cpu(own, data, rows, order)[0] for _ in range(2)]
        if installed():
            slow, other = cpu(pyoma, data, rows, order)
        last, poles = cpu(own, data, rows, order)
        fast = float(np.median([*seconds, last]))
        if slow is not None:
            apart = worst_distance(data, rows, order, poles[-1], other)
            accuracy = f"at most {apart[0]:.3f} σ apart in frequency, {apart[1]:.3f} σ in damping"
        size = f"{channels} x {samples // 1000}k, {rows} block rows, orders to {order}"
        out.append(row("SSI-cov, all orders", size, fast, "pyOMA-2", slow, goals.get((channels, samples)), accuracy))
    return out


def worst_distance(data, rows, order, mine, other):
    """Largest distance of matched poles of the highest order from pyOMA-2's, in standard deviations: frequency, damping."""
    reference, std = deviations(data, rows, order)
    hz, zeta = other[0][:, -1], other[1][:, -1]
    worst = [0.0, 0.0]
    for k in np.flatnonzero((mine.zeta > 0) & (mine.zeta < 0.05) & (mine.hz < 0.4 * FS)):
        j = int(np.nanargmin(np.abs(hz - mine.hz[k])))
        i = int(np.argmin(np.abs(reference.hz - mine.hz[k])))
        worst[0] = max(worst[0], abs(hz[j] - mine.hz[k]) / std[0, i])
        worst[1] = max(worst[1], abs(zeta[j] - mine.zeta[k]) / std[1, i])
    return worst


def large_row():
    """64 channels × 1 000 000 samples: seconds and memory beside the record, against 3 s and 500 MB."""
    data = np.random.default_rng(2).standard_normal((64, 1_000_000), dtype=np.float32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds, _ = cpu(own, data, 30, 120)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3
    return row("SSI-cov, all orders", "64 x 1000k, 30 block rows, orders to 120", seconds, "limit", 3.0, None, None, memory, 500.0)


ROWS, ORDER, BLOCKS = 20, 30, 50


def own_uncertainty(data):
    """Poles of all orders and their standard deviations: correlations in blocks, every pole of every order."""
    from operando.oma.correlation import correlate
    from operando.oma.subspace import factorise_weighted, poles_of_orders, realise
    from operando.oma.uncertainty import block_products, covariance_of_mean, normalised_changes, perturb

    references = np.arange(data.shape[0])
    correlations = correlate(data, references, 2 * ROWS, BLOCKS)
    factors = factorise_weighted(correlations.mean, references, ROWS, 2 * ORDER, data.shape[1], "none")
    realisation = realise(factors, data.shape[0])
    products = block_products(correlations, factors, ROWS)
    out = []
    for poles in poles_of_orders(realisation, range(2, ORDER + 1), FS):
        change = perturb(correlations, factors, realisation, poles, np.arange(poles.hz.size), ROWS, FS, products)
        changes = normalised_changes(np.log(poles.mu) * FS, poles.shapes, change)
        out.append((poles, np.sqrt(np.diag(covariance_of_mean(changes, correlations.weights)))[: 2 * poles.hz.size].reshape(2, -1)))
    return out


def pyoma_uncertainty(data):
    """The same by pyOMA-2, as ``SSI.run`` calls it with ``calc_unc``."""
    from operando.oma.pyoma import contained_pyoma

    with contained_pyoma() as ssi:
        hankel, covariance = ssi.build_hank(data, data, ROWS, "cov", calc_unc=True, nb=BLOCKS)
        obs, a, c, _ = ssi.SSI_fast(hankel, ROWS, ORDER, step=1)
        return ssi.SSI_poles(obs, a, c, ORDER, 1 / FS, step=1, xi_max=0.25, calc_unc=True, H=hankel, T=covariance)


def uncertainty_row(draws):
    """Uncertainty of every pole of every order, and stated deviations over the scatter of fresh records."""
    plate = Plate(n_sensors=12, n_forces=8)
    true = plate.hz[plate.hz < 0.4 * FS]
    near = lambda hz: np.array([int(np.nanargmin(np.abs(hz - f))) for f in true])  # noqa: E731
    found, stated = [], []
    for d in range(draws):
        data = plate.record(60_000 / FS, FS, np.random.default_rng([5, d]))
        data -= data.mean(axis=1, keepdims=True)
        if d == 0:
            first = data
        poles, std = own_uncertainty(data)[-1]
        at = near(poles.hz)
        found.append([poles.hz[at], poles.zeta[at]])
        stated.append(std[:, at])
    scatter = np.std(found, axis=0, ddof=1)
    ours = np.median(np.median(stated, axis=0) / scatter, axis=1)
    fast = float(np.median([cpu(own_uncertainty, first)[0] for _ in range(3)]))
    slow, text = None, f"stated over scatter of {draws} records, median over modes: f {ours[0]:.2f}, damping {ours[1]:.2f}"
    if installed():
        slow, other = cpu(pyoma_uncertainty, first)
        at = near(other[0][:, -1])
        theirs = [np.median(other[i][at, -1] / scatter[k]) for k, i in enumerate((4, 5))]
        text += f" (pyOMA-2, one record: {theirs[0]:.2f}, {theirs[1]:.2f})"
    size = f"12 x 60k, {ROWS} block rows, orders to {ORDER}, {BLOCKS} blocks"
    return row("SSI-cov, uncertainty of all poles", size, fast, "pyOMA-2 calc_unc", slow, 20.0, text)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", metavar="FILE", help="write the rows here")
    parser.add_argument("--quick", action="store_true", help="without the large sizes, fewer records")
    options = parser.parse_args()
    own(np.random.default_rng(0).standard_normal((3, 4000)), 10, 10)
    rows = [] if options.quick else [large_row()]
    rows += [uncertainty_row(12 if options.quick else 60), *size_rows(options.quick)]
    report(rows, options.json)


if __name__ == "__main__":
    with threadpool_limits(1, "blas"):
        main()
