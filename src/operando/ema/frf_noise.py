"""How the errors of FRFs go together, where they are fitted without the records behind them."""

from __future__ import annotations

import numpy as np

from operando.ema.discrepancy import line_correlation, student_weights
from operando.ema.linear import FEW_PLACES, LinearFit, inverse_of, place_scatter
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.projection import basis, modal_power
from operando.ema.spectra import FrfNoise
from operando.synthesis import power_of

SHIFTED_PAIRS = 8.0
"""Pairs that tell the spread of shifts to a quarter, 1/√(2·8)."""

ROUNDS = 30
"""Rounds of the weights of the common error; they settle in fewer than ten."""


def frf_noise(pairs: Pairs, fit: LinearFit) -> FrfNoise:
    """From what the linear stage leaves of all lines.

    The FRFs of one reference are of one force record: its noise and its leakage are an error that all of them have in common, a share of
    each. A pole takes it for its own, so intervals from independent pairs were a third too narrow (``benchmarks/coverage_ema.py --frfs``).
    """
    model = fit.on_lines(pairs)
    error, power = pairs.accelerance - model, modal_power(pairs, fit.poles, fit.projection, fit.ends_hz)
    noise = fit.variance.kappa[:, None] * pairs.noise + fit.variance.alpha[:, None] ** 2 * power
    common = {int(k): _common_share(*(part[pairs.columns == k] for part in (error, model, noise))) for k in np.unique(pairs.columns)}
    spacing = float(np.median(np.diff(pairs.frequencies_hz)))
    return FrfNoise(line_correlation(error, noise), common, spacing)


def stated_covariance(fit: LinearFit) -> Real:
    """Covariance of [ln f, ln ζ] to be stated: that of the fit, and what it does not see of how errors go together.

    - Student weights make a sandwich of many places too small.
    - Few places count by their lines, of which those near a pole stand as close as they were measured: more of them count as one there than
      among all lines used.
    - An error common to all FRFs of a force is none between them.
    - 1/(x + iζ) averaged over a spread s is as with ζ(1 + s²/ζ²); a random walk over all places of rms δ has s² = δ²/places within one.

    Frequencies err as damping does (a pole in its real and imaginary part), and by the shifts of the pairs, whose spread no weight has made
    smaller. Where ``SHIFTED_PAIRS`` tell it, that spread counts as they show it, without the pairs that the prior of the search stands for.
    """
    variances, n = np.diag(fit.covariance).copy(), fit.n_modes
    places = max(1, np.unique(fit.pairs.places[fit.pairs.places >= 0]).size)
    counted, common = _line_variances(fit)
    if places >= FEW_PLACES:
        variances[n:] *= _damping_slope(fit)
    else:
        variances[n:] = np.maximum(variances[n:], counted)
        shifts, pairs = fit.projection.spread_sums[2:]
        own = place_scatter(fit.pairs, fit.projection)[0]
        by_lines = fit.poles.zeta**2 * counted + shifts / np.maximum(pairs, 1.0) ** 2
        scatter = by_lines if own is None else np.maximum(np.diag(own)[:n], by_lines)
        variances[:n] = np.where(pairs >= SHIFTED_PAIRS, scatter, variances[:n])
    variances[:n] += fit.poles.zeta**2 * common
    variances[n:] += common + np.minimum(fit.poles.drift**2 / fit.poles.zeta**2 / places, 1.0) ** 2
    size = np.sqrt(variances / np.maximum(np.diag(fit.covariance), 1e-300))
    return np.asarray(fit.covariance * np.outer(size, size))


def _line_variances(fit: LinearFit) -> tuple[Real, Real]:
    """Variances of ln ζ by errors of the lines, each mode by itself, (n,): independent between the pairs, and common to those of a force.

    Of the derivative of a mode by ln ζ counts what its residue and its phase do not explain.
    """
    f, poles, weight = fit.pairs.frequencies_hz, fit.poles, 1 / fit.variance.total
    g, h, _, _, gz, _ = basis(f, poles, fit.pairs.window_rate)
    noise = 0.5 * np.diag(inverse_of(fit.projection.normal))[fit.n_modes :]
    lines, common = np.ones(fit.n_modes), np.zeros(fit.n_modes)
    for r in range(fit.n_modes if fit.noise.common else 0):
        near = np.abs(f - poles.hz[r]) <= max(poles.zeta[r] * poles.hz[r], fit.noise.spacing_hz)
        width = 2 * max(poles.zeta[r] * poles.hz[r], fit.noise.spacing_hz)
        lines[r] = max(1.0, fit.noise.correlated_lines * fit.noise.spacing_hz * near.sum() / width)
        by_column = {k: fit.projection.a[at, r] ** 2 @ weight[at] for k in fit.noise.common for at in [fit.pairs.columns == k]}
        whole = np.sum(list(by_column.values()), axis=0)
        root = np.sqrt(whole)
        columns = np.stack([g[r], h[r]], axis=1)
        left = gz[r] - columns @ _real_solution(columns * root[:, None], gz[r] * root)
        known = np.sum(whole * power_of(left))
        for k, own in by_column.items():
            common[r] += 0.5 * fit.noise.common[k] * lines[r] * np.sum(own**2 * power_of(left * g[r])) / max(known, 1e-300) ** 2
    return noise * lines, common


def _real_solution(columns: Complex, values: Complex) -> Real:
    """Real least-squares coefficients of complex columns."""
    both = np.concatenate([columns.real, columns.imag])
    return np.asarray(np.linalg.lstsq(both, np.concatenate([values.real, values.imag]), rcond=None)[0])


def _damping_slope(fit: LinearFit) -> Real:
    """Factors to the true variances of damping ratios by scores under Student weights, (n,), at the lines that tell each of them."""
    plain, gz = fit.variance.plain, basis(fit.pairs.frequencies_hz, fit.poles, fit.pairs.window_rate)[4]
    weights, slope = student_weights(power_of(fit.projection.error), plain)
    out = []
    for a, kernel in zip(fit.projection.a.T, gz, strict=True):
        told = a[:, None] ** 2 * power_of(kernel) / plain
        out.append((np.sum(told * weights) / max(float(np.sum(told * slope)), 1e-300)) ** 2 if told.any() else 1.0)
    return np.array(out)


def _common_share(error: Complex, model: Complex, noise: Real) -> float:
    """Variance of an error s in e = s H + n, by the products of different responses (m, L); lines where others err weigh less."""
    a, b = error / np.sqrt(noise), model / np.sqrt(noise)
    product, power = a * b.conj(), power_of(b)
    of_error = power_of(product.sum(axis=0)) - power_of(product).sum(axis=0)
    of_model = power.sum(axis=0) ** 2 - np.sum(power**2, axis=0)
    share = 0.0
    for _ in range(ROUNDS):
        weight = 1 / (1 + share * power.sum(axis=0)) ** 2
        share = max(float(np.sum(weight * of_error)) / max(float(np.sum(weight * of_model)), 1e-300), 0.0)
    return share
