"""How the errors of FRFs go together, where they are fitted without the records behind them."""

from __future__ import annotations

import numpy as np

from operando.ema.discrepancy import line_correlation
from operando.ema.linear import LinearFit
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.spectra import FrfNoise
from operando.synthesis import power_of

ROUNDS = 30
"""Rounds of the weights of the common error; they settle in fewer than ten."""


def frf_noise(pairs: Pairs, fit: LinearFit) -> FrfNoise:
    """From what the linear stage leaves of all lines.

    The FRFs of one reference are of one force record: its noise and its leakage are an error that all of them have in common, a share of
    each. A pole takes it for its own, so intervals from independent pairs were a third too narrow (``benchmarks/coverage_ema.py --frfs``).
    """
    model = fit.on_lines(pairs)
    error, noise = pairs.accelerance - model, fit.variance.kappa[:, None] * pairs.noise
    common = {int(k): _common_share(*(part[pairs.columns == k] for part in (error, model, noise))) for k in np.unique(pairs.columns)}
    return FrfNoise(line_correlation(error, noise), common)


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
