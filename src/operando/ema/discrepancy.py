"""Variance of given FRFs: measurement noise, and a model error in proportion to what the modes add, both estimated from the residuals.

var_p = κ_p v_p + α_p² M_p. A measured structure is a little nonlinear and changes while it is measured, hits and sensors are a few
per cent off: errors that are smooth over frequency and grow with the response. Without the second term a line on a peak would weigh
a thousand times less than one beside it, or rule everything, as the noise estimate has it. Kennedy & O'Hagan (J. R. Stat. Soc. B 63,
2001, 425–464) call it model discrepancy. Student weights keep single wrong hits from setting it (Lange, Little & Taylor, J. Am. Stat.
Assoc. 84, 1989, 881–896).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from operando.ema.pairs import Complex, Real
from operando.synthesis import power_of

STUDENT_FREEDOM = 4.0
"""Degrees of freedom of the weights: heavy tails that still have a variance (Lange et al. 1989, Section 5)."""

POOLED_LINES = 30.0
"""A pair's α counts its own lines, and so many at the level of all pairs."""

ALPHA_START, ALPHA_MOST = 1e-2, 0.5
KAPPA_LEAST, KAPPA_MOST = 0.25, 1e8
ROUNDS = 36

CACHE_VALUES = 1 << 15
"""Values of each array worked on at a time: a quarter of a megabyte."""


@dataclass(frozen=True)
class Variance:
    """What a residual is made of.

    ``total`` (P, L) is the variance over the Student weight: what the next least-squares fit divides by; ``plain`` κ v + α² M, (m/s²/N)²;
    ``pooled`` the same with the α of all pairs, for the search of missing modes: around such a mode a pair's own α has grown.
    """

    total: Real
    plain: Real
    pooled: Real
    kappa: Real
    alpha: Real


def fit_variance(error: Complex, power: Real, noise: Real, noise_known: bool) -> Variance:
    """Maximum-likelihood κ and α of each pair, by multiplicative updates, from the residuals of the linear fit, all (P, L).

    ``power`` is M: Σ_r|mode r in the pair|² + |tails|²; ``noise`` v: the noise variance, or its shape. Where v comes from a measurement
    (coherence), κ is at least 1.
    """
    squares = power_of(error)
    kappa, alpha2 = np.ones(error.shape[0]), np.full(error.shape[0], ALPHA_START**2)
    least = 1.0 if noise_known else KAPPA_LEAST
    few = max(1, CACHE_VALUES // error.shape[1])
    for _ in range(ROUNDS):
        level = float(np.exp(np.mean(np.log(alpha2))))
        for first in range(0, kappa.size, few):
            at = slice(first, first + few)
            kappa[at], alpha2[at] = _updated(squares[at], power[at], noise[at], kappa[at], alpha2[at], least, level)
    plain = kappa[:, None] * noise + alpha2[:, None] * power
    pooled = np.minimum(kappa, np.median(kappa))[:, None] * noise + np.exp(np.mean(np.log(alpha2))) * power
    return Variance(plain * (STUDENT_FREEDOM + 2 * squares / plain) / (STUDENT_FREEDOM + 2), plain, pooled, kappa, np.sqrt(alpha2))


def _updated(squares: Real, power: Real, noise: Real, kappa: Real, alpha2: Real, least: float, level: float) -> tuple[Real, Real]:
    """κ and α² of some pairs after one round; ``level`` is the geometric mean of α² over all."""
    by_noise = kappa[:, None] * noise
    variance = by_noise + alpha2[:, None] * power
    ratio = squares / variance
    ratio *= (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 2 * ratio)
    by_noise /= variance
    told, total = np.einsum("pl,pl->p", by_noise, ratio), by_noise.sum(axis=1)
    up = (ratio.sum(axis=1) - told + POOLED_LINES * level / alpha2) / (squares.shape[1] - total + POOLED_LINES)
    kappa = np.clip(kappa * np.sqrt(told / np.maximum(total, 1e-9)), least, KAPPA_MOST)
    return kappa, np.clip(alpha2 * np.sqrt(up), 1e-14, ALPHA_MOST**2)


def student_weights(squares: Real, plain: Real) -> tuple[Real, Real]:
    """Student weights w of residuals, and the slope of the score w e: w − 2xw²/(4 + 2) with x = |e|²/plain.

    A normal matrix has w where the mean of the slope belongs. Scores between two inverses of it (a sandwich) make variances that are too
    small by the square of the ratio of both: 1.7 for Gaussian noise (Huber, Proc. 5th Berkeley Symp. 1, 1967, 221–233).
    """
    x = squares / plain
    weights = (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 2 * x)
    return weights, weights - 2 * x * weights**2 / (STUDENT_FREEDOM + 2)


def line_correlation(error: Complex, variance: Real) -> float:
    """ν = 1 + 2 Σ_k ρ_k: how many lines count as one, from the autocorrelation of the normalised residuals to its first value below 0.1."""
    x = error / np.sqrt(variance)
    x = x / np.sqrt(np.maximum(np.mean(np.abs(x) ** 2, axis=1, keepdims=True), 1e-300))
    total = 1.0
    for k in range(1, max(2, min(60, x.shape[1] // 4))):
        rho = float(np.mean((x[:, k:] * x[:, :-k].conj()).real))
        if rho < 0.1:
            break
        total += 2 * rho
    return total
