"""The linear stage of the modal analysis of given FRFs: poles by variable projection under noise and model error, and their evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.ema.discrepancy import Variance, fit_variance, line_correlation
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.projection import (
    CURVED_SHARE,
    QUADRATURE_FREE,
    QUADRATURE_MOST,
    Coefficients,
    Poles,
    Projection,
    modal_power,
    project,
    search_poles,
    shift_curvature,
    synthesis,
    tail_columns,
    updated_spreads,
)
from operando.ema.spectra import FRF_NOISE, FrfNoise

MAX_DAMPING = 0.15
NOISE_LIMITED = 0.01
"""Model error α below which the noise limits the fit: 1 % of the FRF."""

FEW_PLACES = 24
"""Below so many places the scatter between them tells too little: the larger of the two covariances counts."""

SETTLED = 1e-4
"""A fit has settled where a round moves poles and shifts by less than a hundredth of the standard deviation of a line, in the mean."""

START_SHARE = 0.05
"""Error of the first fit, as a share of the FRF, before there are residuals to estimate it from."""


@dataclass(frozen=True)
class LinearFit:
    """Modes of given FRFs with free residues in each pair, on the lines that were used.

    ``covariance`` (2n, 2n) of [ln f, ln ζ] is for rating poles: errors of a pair may be correlated over its lines in any way
    (:func:`operando.ema.frf_noise.stated_covariance` is stated). ``correlation`` is ν, lines that count as one. ``second_shapes`` are
    poles that stand for the second shape of the one before them, at its frequency (:mod:`operando.ema.close_pairs`). ``noise`` is how
    errors go together on all lines, where that is known.
    """

    pairs: Pairs
    poles: Poles
    projection: Projection
    variance: Variance
    covariance: Real
    correlation: float
    ends_hz: tuple[float, float]
    second_shapes: tuple[int, ...] = ()
    noise: FrfNoise = FRF_NOISE

    @property
    def n_modes(self) -> int:
        """Number of poles."""
        return int(self.poles.hz.size)

    @property
    def model_error(self) -> float:
        """Median over the pairs of α: the error in proportion to the FRF."""
        return float(np.median(self.variance.alpha))

    @property
    def noise_limited(self) -> bool:
        """Whether the noise rules: phases and weak modes can be believed then, and a likelihood of noise alone may polish."""
        return self.model_error < NOISE_LIMITED

    def sensor_offset(self, pairs: Pairs, band: tuple[float, float]) -> float:
        """What the term 1/s is of the FRFs of the same pairs on all lines in band: median over lines and pairs."""
        inside = (pairs.frequencies_hz >= band[0]) & (pairs.frequencies_hz <= band[1])
        column = tail_columns(pairs.frequencies_hz[inside], self.ends_hz[1], self.ends_hz[0], pairs.window_rate)[-2]
        offset = np.abs(self.projection.tails[:, -2:-1] * column)
        return float(np.median(offset / np.maximum(np.abs(pairs.accelerance[:, inside]), 1e-300)))

    def shift_error(self, band: tuple[float, float]) -> float:
        """Largest error that poles common to all pairs would make at a resonance in band, as a share of the FRF: rms shift over ζ.

        A mode outside shows its flank alone, and takes what other modes beyond leave there for a shift.
        """
        power = self.projection.a**2 + self.projection.b**2
        squares = np.sum(power * self.projection.shift**2, axis=0) / np.maximum(power.sum(axis=0), 1e-300)
        inside = (self.poles.hz >= band[0]) & (self.poles.hz <= band[1])
        return float(np.max(np.sqrt(squares[inside]) / self.poles.zeta[inside], initial=0.0))

    @property
    def frequency_std_hz(self) -> Real:
        """Standard deviations [Hz]."""
        return np.asarray(self.poles.hz * np.sqrt(np.diag(self.covariance)[: self.n_modes]))

    @property
    def log_damping_std(self) -> Real:
        """Relative standard deviations of the damping ratios."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[self.n_modes :]))

    @property
    def mean_hz(self) -> Real:
        """Frequencies [Hz] as means over the pairs by the power of the mode in each: where a mode drifts, what a fit of all pairs gives."""
        power = self.projection.a**2 + self.projection.b**2
        mean = np.sum(power * self.projection.shift, axis=0) / np.maximum(power.sum(axis=0), 1e-300)
        return np.asarray(self.poles.hz * (1 + mean))

    @property
    def evidence(self) -> Real:
        """Fall of the cost by each mode in each pair, in independent lines, (P, n)."""
        return self.projection.evidence / self.correlation

    @property
    def information_lines(self) -> float:
        """Independent lines of a pair."""
        return max(self.pairs.frequencies_hz.size / self.correlation, 8.0)

    def penalty(self, modes: float = 1.0, pairs: int | None = None) -> float:
        """Bayesian information criterion of one more mode: half of ln(lines) for each of its unknowns (a and b in each pair, the pole)."""
        count = self.pairs.accelerance.shape[0] if pairs is None else pairs
        return float(modes * 0.5 * (2 * count + 2) * np.log(self.information_lines))

    def on_lines(self, pairs: Pairs) -> Complex:
        """FRFs of the fitted pairs on the lines of ``pairs``, (P, L)."""
        return np.asarray(pairs.accelerance - self.carried_to(pairs).error)

    def carried_to(self, pairs: Pairs) -> Projection:
        """The projection on other lines of the same pairs with nothing fitted anew: where a fit of those lines starts."""
        least = CURVED_SHARE * self.model_error
        curvature = shift_curvature(pairs.frequencies_hz, self.poles, self.projection.coefficients, pairs.window_rate, least)
        model = synthesis(pairs, self.poles, self.projection, self.ends_hz) + curvature
        return replace(self.projection, error=pairs.accelerance - model, curvature=curvature)

    def turned(self, dofs: NDArray[np.int_]) -> LinearFit:
        """The fit with the staying sensors at some DOFs in the opposite sense."""
        sign = np.where(np.isin(self.pairs.staying, dofs), -1.0, 1.0)[:, None]
        p = self.projection
        projection = replace(
            p,
            a=sign * p.a,
            b=sign * p.b,
            shifted=sign * p.shifted,
            curvature=sign * p.curvature,
            tails=sign * p.tails,
            error=sign * p.error,
            slope=sign[..., None] * p.slope,
        )
        return replace(self, pairs=self.pairs.turned(dofs), projection=projection)

    def take(self, modes: NDArray[np.int_]) -> LinearFit:
        """The fit with some of its modes, in this order; one may be taken twice."""
        both = np.concatenate([modes, self.n_modes + modes])
        covariance = self.covariance[np.ix_(both, both)]
        return replace(self, poles=self.poles.take(modes), projection=self.projection.take(modes), covariance=covariance)

    def residues(self) -> Complex:
        """a + ib, (P, n)."""
        return np.asarray(self.projection.a + 1j * self.projection.b)


def fit_linear(
    pairs: Pairs,
    poles: Poles,
    ends_hz: tuple[float, float],
    *,
    start: Coefficients | Projection | None = None,
    rounds: int = 3,
    steps: int = 3,
    before: Variance | None = None,
    hold: Variance | None = None,
) -> LinearFit:
    """Poles and variance in turn: a few ``steps`` on the poles, then the variance from what is left, in so many ``rounds``.

    Poles are by rising frequency. ``start`` is from a fit of nearly the same poles, 0 for a mode that is new; a projection is one of these
    lines and poles. ``before`` is the variance of such a fit, to begin with; ``hold`` keeps this variance (and the spreads of the priors):
    for comparing costs.
    """
    known = hold or before
    first = pairs.noise + START_SHARE**2 * np.abs(pairs.accelerance) ** 2 if known is None else known.total
    least = np.inf if known is None else CURVED_SHARE * float(np.median(known.alpha))
    now = start if isinstance(start, Projection) else project(pairs, poles, first, start, ends_hz, least, with_slopes=False)
    for number in range(rounds):
        variance = hold or fit_variance(now.error, modal_power(pairs, poles, now, ends_hz), pairs.noise, pairs.noise_known)
        least = CURVED_SHARE * float(np.median(variance.alpha))
        if number and hold is None:
            # with a large model error a phase is soon bought; without it what is measured counts, as of modes of local dampers
            free = float(np.median(variance.alpha)) < NOISE_LIMITED
            poles = updated_spreads(poles, now.spread_sums, QUADRATURE_FREE if free else QUADRATURE_MOST)
        last = now.curvature
        poles, now, fall, whole = search_poles(
            pairs, poles, variance.total, now.coefficients, ends_hz, steps=steps, max_damping=MAX_DAMPING, least=least
        )
        bent = float(np.sum(np.abs(now.curvature - last) ** 2 / variance.total))
        if number >= 2 and max(fall, bent) < SETTLED * last.size:
            now = whole()
            break
    else:
        now = project(pairs, poles, variance.total, now.coefficients, ends_hz, least)
    nu = line_correlation(now.error, variance.total)
    return _sorted(LinearFit(pairs, poles, now, variance, _covariance(pairs, now, nu), nu, ends_hz))


def _covariance(pairs: Pairs, projection: Projection, nu: float) -> Real:
    """By the scatter between places; with few of them the covariance of ν correlated lines counts where it is larger."""
    naive = np.asarray(0.5 * nu * inverse_of(projection.normal))
    own, count = place_scatter(pairs, projection)
    if own is None:
        return naive
    return raised(own, np.diag(naive)) if count < FEW_PLACES else own


def place_scatter(pairs: Pairs, projection: Projection) -> tuple[Real | None, int]:
    """Covariance by the scatter between places, None where there is one alone, and how many they are.

    Cluster sandwich (Liang & Zeger, Biometrika 73, 1986, 13–22): all pairs of one place or set-up are a cluster, means belong to each.

    One hit, or one mounting of the sensors, is behind them all. What is stated is the mean over the places that were measured: a slow trend
    from place to place, in the order of the file, is no error of it, so successive differences of many stand for the scatter (von Neumann,
    Ann. Math. Stat. 12, 1941, 367–395).
    """
    inverse = inverse_of(projection.normal)
    single = pairs.places >= 0
    place = np.unique(pairs.places[single], return_inverse=True)[1]
    count = int(place.max(initial=-1)) + 1
    if count < 2:
        return None, count
    gradient = np.zeros((count, projection.gradient.shape[1]))
    np.add.at(gradient, place, projection.gradient[single])
    gradient += projection.gradient[~single].sum(axis=0) / count
    if count < FEW_PLACES:
        return np.asarray(inverse @ (gradient.T @ gradient) @ inverse * count / (count - 1)), count
    steps = np.diff(gradient, axis=0)
    return np.asarray(inverse @ (steps.T @ steps) @ inverse * 0.5 * count / (count - 1)), count


def inverse_of(normal: Real) -> Real:
    """Inverse of a normal matrix of unknowns in different units."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.asarray(np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale))


def raised(covariance: Real, variances: Real) -> Real:
    """The covariance with variances at least as large as these, correlations kept."""
    own = np.maximum(np.diag(covariance), 1e-300)
    ratio = np.sqrt(np.maximum(variances, own) / own)
    return np.asarray(covariance * np.outer(ratio, ratio))


def keep_modes(fit: LinearFit, keep: NDArray[Any]) -> tuple[Poles, Coefficients]:
    """Poles and coefficients of some of the modes: the start of the next fit."""
    a, b, shift = fit.projection.coefficients
    return fit.poles.take(keep), (a[:, keep], b[:, keep], shift[:, keep])


def _sorted(fit: LinearFit) -> LinearFit:
    """The fit with its modes by rising frequency."""
    order = np.argsort(fit.poles.hz)
    return fit if np.all(np.diff(order) > 0) else fit.take(order)
