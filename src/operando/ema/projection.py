"""Poles from given FRFs by variable projection: residues, phases, drifts and tails of each pair eliminated by linear least squares.

Each pair p of response and reference is

    H_p = Σ_r (1 + δ_pr ∂/∂ln f_r) [a_pr + b_pr s/ω_r] s²/(s² + 2ζ_rω_r s + ω_r²) + tails

with a real residue a, its quadrature part b (a complex mode), the relative shift δ of the mode in this pair (a test object that
changes while hammer or sensors rove), and tails: modes above and below the lines, a mass line, and 1/s, 1/s² (an offset or a drift
of the sensor under the window). b and δ have Gaussian priors whose spreads are estimated mode by mode (MacKay, Neural Computation
4, 1992, 415–447). Only the poles (ln f, ln ζ) are left to a Levenberg search (Golub & Pereyra, SIAM J. Numer.
Anal. 10, 1973, 413–432); with priors the gradient is that of the envelope theorem, Jᵀr, the columns of the shifts taken for fixed (their
curvature in the gradient pulls poles to where shifts of one sign are cheap, and lost 4 of 80 modes that drift). All pairs share their
columns and differ in their weights: the Gram matrices of all pairs come from one product of weights and column products a row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.ema.pair_fits import Before, Columns, PairFits, chunks, fit_pairs, modal_columns
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.polish_model import OUTSIDE_DAMPING
from operando.ema.start import OUTSIDE_FACTORS
from operando.synthesis import combined, kernel_derivatives, modal_kernel, power_of

Coefficients = tuple[Real, Real, Real]
"""Residues a, quadrature parts b and shifts δ, each (P, n)."""

LOWER_FACTOR = 0.6
QUADRATURE, QUADRATURE_GUESS, QUADRATURE_MOST, QUADRATURE_FREE = 0.2, 0.05, 0.25, 2.0
"""Spread of b over a: at the start, two pseudo-pairs' worth of it (a phase of 3°), at most (14°), and at most where noise limits."""

DRIFT, DRIFT_GUESS, DRIFT_MOST = 1e-3, 2e-4, 1e-2
"""The same for δ: roving tests drift by 1e-4 … 1e-3."""

PEAK_MOST, PEAK_WIDTHS, PEAK_LINES = 3.0, 3.0, 3
"""Spread of a: so many times what the FRF has at most within three half bandwidths (a mode has a third of its peak there), the drift
and three lines beside the nearest. Two modes of opposite sense 0.4 half bandwidths apart, which are one by the rule of twins, are five
times their sum: a prior cost of three of several hundred."""

LEAST_FALL = 0.02
"""Fall of the cost worth a step: t standard deviations of a pole cost t²/2, so poles stay by at most a fifth of one off their best (less
where neighbouring lines err together: a tenth where four count as one)."""

PSEUDO_PAIRS = 2.0


@dataclass(frozen=True)
class Poles:
    """Unknowns of the search and the spreads of their priors, all (n,)."""

    hz: Real
    zeta: Real
    quadrature: Real = field(default_factory=lambda: np.zeros(0))
    drift: Real = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name, value in (("quadrature", QUADRATURE), ("drift", DRIFT)):
            if getattr(self, name).size != self.hz.size:
                object.__setattr__(self, name, np.full(self.hz.size, value))

    def take(self, keep: NDArray[Any]) -> Poles:
        """Some of the poles."""
        return Poles(self.hz[keep], self.zeta[keep], self.quadrature[keep], self.drift[keep])


@dataclass(frozen=True)
class Projection:
    """Linear part of the fit at given poles."""

    cost: Real  # (P,): Σ|e|²/variance of each pair, priors included
    # a, b, shift (P, n): residues, quadrature parts, relative shifts δ
    a: Real
    b: Real
    shift: Real
    shifted: Real  # (P, 2n): δ·a and δ·b (a, b of the round before): what ∂g/∂ln f and ∂h/∂ln f are multiplied by
    curvature: Complex  # (P, L): what shifts add beyond their first order
    tails: Real
    error: Complex
    normal: Real  # (2n, 2n): Gauss–Newton matrix of (ln f, ln ζ) with everything else eliminated
    gradient: Real  # (P, 2n): of each pair: −½ ∂cost
    evidence: Real  # (P, n): rise of the cost without the mode (a and b), the rest refitted
    a_std: Real  # (P, n): standard deviation of a at known poles
    slope: Real  # (P, n, 2n): ∂a/∂(ln f, ln ζ)
    spread_sums: Real  # (4, n): Σγ(b/amplitude)², Σγ², Σγδ², Σγ² over the pairs, with γ = 1 − posterior/prior variance

    @property
    def coefficients(self) -> Coefficients:
        """(a, b, δ): the start of the fit of nearly the same poles."""
        return self.a, self.b, self.shift

    def take(self, modes: NDArray[np.int_]) -> Projection:
        """Of some of the modes, in this order; one may be taken twice."""
        both = np.concatenate([modes, self.a.shape[1] + modes])
        by_mode = {name: getattr(self, name)[:, modes] for name in ("a", "b", "shift", "evidence", "a_std", "spread_sums")}
        by_pole = {name: getattr(self, name)[:, both] for name in ("shifted", "gradient")}
        slope = self.slope[:, modes][:, :, both]
        return replace(self, **by_mode, **by_pole, normal=self.normal[np.ix_(both, both)], slope=slope)


def basis(f: Real, poles: Poles, rate: float) -> tuple[Complex, Complex, Complex, Complex, Complex, Complex]:
    """Columns g, h (quadrature) and their derivatives by ln f and ln ζ: g, h, gf, hf, gz, hz, each (n, L)."""
    g, gf, gz = kernel_derivatives(f, poles.hz, poles.zeta, rate)
    c = (2j * np.pi * f[None, :] + rate) / (2 * np.pi * poles.hz[:, None])
    return g, g * c, gf, (gf - g) * c, gz, gz * c


def tail_columns(f: Real, top_hz: float, bottom_hz: float, rate: float) -> Complex:
    """Kernels above the band and one below, a constant (free mass), 1/s and 1/s² (offset and drift under the window), (t, L)."""
    outside = np.array([factor * top_hz for factor in OUTSIDE_FACTORS] + [LOWER_FACTOR * bottom_hz])
    kernel = modal_kernel(f, outside, np.full(outside.size, OUTSIDE_DAMPING), "accelerance", rate)
    s = (2j * np.pi * f + rate) / (2 * np.pi * bottom_hz)
    return np.concatenate([kernel, np.ones((1, f.size)), 1 / s[None], 1 / s[None] ** 2])


def _columns(pairs: Pairs, poles: Poles, ends_hz: tuple[float, float]) -> Columns:
    top = max(ends_hz[1], float(poles.hz.max(initial=0.0)))
    tails = tail_columns(pairs.frequencies_hz, top, ends_hz[0], pairs.window_rate)
    tails[-2] *= pairs.offset
    return modal_columns(pairs.frequencies_hz, poles.hz, poles.zeta, tails, pairs.window_rate)


def modal_power(pairs: Pairs, poles: Poles, fit: Projection, ends_hz: tuple[float, float]) -> Real:
    """Σ_r|mode r in pair p|² + |tails|², (P, L): what a proportional model error is proportional to."""
    c = _columns(pairs, poles, ends_hz)
    cross = c.g.real * c.h.real + c.g.imag * c.h.imag
    power = fit.a**2 @ power_of(c.g) + fit.b**2 @ power_of(c.h) + 2 * (fit.a * fit.b) @ cross
    return np.asarray(np.maximum(power, 0) + power_of(combined(fit.tails, c.tails)))


def synthesis(pairs: Pairs, poles: Poles, fit: Projection, ends_hz: tuple[float, float]) -> Complex:
    """FRFs of the fitted pairs on the lines of ``pairs``, (P, L)."""
    c, n = _columns(pairs, poles, ends_hz), poles.hz.size
    moved = c.by_frequency(fit.shifted[:, :n], fit.shifted[:, n:])
    return combined(c.amounts(fit.a, fit.b, fit.tails, moved), c.rows)


CURVED_SHARE, CURVED_MOST = 0.1, 1.5
"""Shifts whose second order at a resonance is beyond this share of the model error are taken in full, up to 1.5 ζ.

There 1/(x − δ + iζ) has (δ/ζ)² beyond its first order; a tenth of the model error beside it adds 0.5 % to it. With first order alone a
shift of 0.1 ζ (rms) errs by 0.4 % of the damping, one of 0.25 ζ by 1.4 % and splits modes; in full, modes stay whole with 0.02 % up to
0.35 ζ (tests/test_ema_linear.py), from 0.4 ζ on they may split. 1.5 ζ is four times that: a pair beyond is a wrong one.
Not those of two poles within one half bandwidth: what is a shift of one is a residue of the other there.
"""


def shift_curvature(f: Real, poles: Poles, coefficients: Coefficients, rate: float, least: float) -> Complex:
    """What the shifts of modes between pairs add beyond their first order, (P, L): a [g(f_r(1 + δ)) − g(f_r) − δ ∂g/∂ln f_r], and b's.

    Modes are left out whose rms shift over ζ, squared, is below ``least``, and lines so far off that it is a quarter of it there.
    """
    a, b, shift = coefficients
    out = np.zeros((a.shape[0], f.size), complex)
    power = a**2 + b**2
    shares = np.sum(power * shift**2, axis=0) / np.maximum(power.sum(axis=0), 1e-300) / poles.zeta**2
    apart = np.abs(poles.hz[:, None] - poles.hz[None, :]) + np.diag(np.full(poles.hz.size, np.inf))
    single = apart.min(axis=1) > (poles.zeta * poles.hz)
    g, h, gf, hf = basis(f, poles, rate)[:4]
    s = 2j * np.pi * f + rate
    for r in np.flatnonzero((shares > least) & single):
        moved_by = np.clip(shift[:, r], -CURVED_MOST * poles.zeta[r], CURVED_MOST * poles.zeta[r])
        hz = poles.hz[r] * (1 + moved_by)
        near = np.abs(f - poles.hz[r]) < 2 * CURVED_MOST / np.sqrt(max(least, 1e-300)) * poles.zeta[r] * poles.hz[r]
        moved = modal_kernel(f[near], hz, np.full(hz.size, poles.zeta[r]), "accelerance", rate)
        out[:, near] += a[:, r, None] * (moved - g[r, near] - moved_by[:, None] * gf[r, near])
        out[:, near] += b[:, r, None] * (moved * s[near] / (2 * np.pi * hz[:, None]) - h[r, near] - moved_by[:, None] * hf[r, near])
    return out


def project(
    pairs: Pairs,
    poles: Poles,
    variance: Real,
    previous: Coefficients | None,
    ends_hz: tuple[float, float],
    least: float = np.inf,
    most: Real | None = None,
    with_slopes: bool = True,
) -> Projection:
    """Linear fit of all pairs at given poles, and the normal equations of the poles.

    ``previous`` (a, b, δ) of the round before size the priors and make the columns of the shifts; without them b is free and δ left out.
    From a shift over ζ, squared, of ``least`` on shifts enter in full: what they add beyond the first order, as of the round before.
    ``most`` (P, n) is the spread of the prior on a (:func:`largest` at these poles where not given). Without slopes the normal matrix, the
    gradient and the slopes, by which the poles are searched, are 0.
    """
    columns = _columns(pairs, poles, ends_hz)
    before = None
    if previous is not None:
        # a prior on b against the pair's own a and against what the mode has in the pairs at large: b may be there where a is not
        size = np.sqrt(np.mean(power_of(pairs.accelerance), axis=1, keepdims=True))
        amplitude = np.sqrt(0.5 * (previous[0] ** 2 + np.mean((previous[0] / size) ** 2, axis=0) * size**2))
        before = Before(previous[0], previous[1], amplitude)
    curvature = np.zeros_like(pairs.accelerance)
    if previous is not None and np.isfinite(least):
        curvature = shift_curvature(pairs.frequencies_hz, poles, previous, pairs.window_rate, least)
    flat = pairs.accelerance - curvature
    most = largest(pairs, poles) if most is None else most
    parts: list[PairFits] = []
    for rows in chunks(flat.shape[0], poles.hz.size):
        spreads = most[rows], poles.quadrature, poles.drift
        parts += fit_pairs(flat[rows], variance[rows], columns, spreads, None if before is None else before.pairs(rows), with_slopes)
    gather = lambda name: np.concatenate([getattr(part, name) for part in parts])  # noqa: E731
    shift = gather("shift")
    shifted = np.zeros((flat.shape[0], 2 * poles.hz.size))
    if before is not None:
        shifted = np.concatenate([shift * before.a, shift * before.b], axis=1)
    return Projection(
        gather("cost"), gather("a"), gather("b"), shift, shifted, curvature, gather("tails"), gather("error"),
        np.sum([part.normal for part in parts], axis=0), gather("gradient"), gather("evidence"), gather("a_std"), gather("slope"),
        np.sum([part.spread_sums for part in parts], axis=0),
    )  # fmt: skip


def largest(pairs: Pairs, poles: Poles) -> Real:
    """Spread of the prior on a, (P, n): no mode is much larger than the FRF at its resonance, so two do not stand against each other there.

    In a pair near a node of both, two poles within a bandwidth of each other otherwise trade places and grow to any size.
    """
    out = np.empty((pairs.accelerance.shape[0], poles.hz.size))
    g = modal_kernel(pairs.frequencies_hz, poles.hz, poles.zeta, "accelerance", pairs.window_rate)
    for r, hz in enumerate(poles.hz):
        distance = np.abs(pairs.frequencies_hz - hz)
        near = distance <= max(PEAK_WIDTHS * poles.zeta[r] * hz, DRIFT_MOST * hz, np.partition(distance, PEAK_LINES)[PEAK_LINES])
        out[:, r] = PEAK_MOST * np.abs(pairs.accelerance[:, near]).max(axis=1) / np.abs(g[r, near]).max()
    return out


def updated_spreads(poles: Poles, sums: Real, most_quadrature: float) -> Poles:
    """Spreads of the priors from the well-determined values, two pseudo-pairs at the guess beside them (evidence approximation)."""
    out = []
    for (squares, count), guess, most in zip(
        (sums[:2], sums[2:]), (QUADRATURE_GUESS, DRIFT_GUESS), (most_quadrature, DRIFT_MOST), strict=True
    ):
        out.append(np.clip(np.sqrt((squares + 0.25 * PSEUDO_PAIRS * guess**2) / (count + PSEUDO_PAIRS)), 1e-7, most))
    return replace(poles, quadrature=out[0], drift=out[1])


def search_poles(
    pairs: Pairs,
    poles: Poles,
    variance: Real,
    previous: Coefficients,
    ends_hz: tuple[float, float],
    *,
    steps: int,
    max_damping: float,
    least: float = np.inf,
) -> tuple[Poles, Projection, float, Callable[[], Projection]]:
    """A few Levenberg steps on the poles under a given variance.

    Returns the best poles and their projection (without the normal equations where no further step was foreseen), the fall of the cost, and
    a function that gives the projection with them.
    """
    n = poles.hz.size
    most = largest(pairs, poles)  # as it is here: a prior that moved with the poles would be no part of their gradient
    whole = partial(project, pairs, poles, variance, previous, ends_hz, least, most)
    now = whole()
    has_slopes, total, damping = True, float(now.cost.sum()), 1e-3
    at_start = total
    for number in range(steps):
        if not has_slopes:
            now, has_slopes = whole(), True
        pull = now.gradient.sum(axis=0)
        diagonal = np.diag(now.normal)
        floor = 1e-12 * float(diagonal.max(initial=0.0)) + 1e-300
        better = None
        for _ in range(5):
            free = np.linalg.solve(now.normal + np.diag(damping * diagonal + floor), pull)
            limit = np.concatenate([0.7 * poles.zeta, np.full(n, 0.6)])
            step = np.clip(free, -limit, limit)  # each on its own: a pole that runs away must not hold the others
            worth = max(LEAST_FALL, 1e-6 * total)
            foreseen, at_most = (float(2 * d @ pull - d @ now.normal @ d) for d in (step, free))
            if at_most < worth:
                break  # even if all went as foreseen
            if foreseen < worth:  # cut off, it may foresee a rise; a shorter one is not cut off
                damping = max(10 * damping, 1e-6)
                continue
            zeta = np.clip(poles.zeta * np.exp(step[n:]), 1e-5, max_damping * 1.02)
            trial = replace(poles, hz=poles.hz * np.exp(step[:n]), zeta=zeta)
            # shifts are counted from the pole: it moves, they do the other way
            a, b, shift = now.coefficients
            trial_whole = partial(project, pairs, trial, variance, (a, b, shift - step[:n]), ends_hz, least, most)
            further = number < steps - 1 and foreseen > 2 * worth  # a third of the work is for a step that will hardly be made
            found = trial_whole(with_slopes=further)
            if found.cost.sum() <= total * (1 + 1e-12):
                better = found
                break
            damping = max(10 * damping, 1e-6)
        if better is None:
            break
        damping = max(damping / 10, 1e-9)
        fall = total - float(better.cost.sum())
        poles, now, total, whole, has_slopes = trial, better, total - fall, trial_whole, further
        if fall < max(LEAST_FALL, 1e-6 * total):
            break
    return poles, now, at_start - total, whole if not has_slopes else lambda: now
