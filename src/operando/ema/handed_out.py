"""What the model that is handed out leaves of the FRFs, beside what the fit behind it does, which has free residues in each pair.

The linear stage fits a complex residue, a shift and tails of its own in each pair. Handed out are real shapes of one scale at common
poles, and residual terms for what lies outside: where damping ties the modes, or a pair contradicts the others, these are worse by far,
and the fit behind them cannot say so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from operando.ema.answers import left_beyond, linear_outside, without_shape
from operando.ema.close_pairs import separated
from operando.ema.discrepancy import fit_variance
from operando.ema.linear import LinearFit, fit_linear
from operando.ema.pairs import Complex, Pairs, Real
from operando.ema.projection import basis, modal_power, tail_columns
from operando.ema.unit_mass import in_phase, unit_mass_shapes
from operando.synthesis import combined, modal_kernel, power_of

N_BLOCKS = 18
"""Contiguous blocks of lines of which every third is kept from the fit that judges the model."""


@dataclass(frozen=True)
class Left:
    """Reduced chi-square, by the measurement variance alone, on lines that the fit did not use.

    Of the model (real shapes of unit modal mass and residual terms) ``misfit`` and, by response DOF, ``by_row``; of free complex residues,
    shifts and tails in each pair ``free``. ``parts`` is what the model leaves out of the free fit by what it does without: "shift",
    "phase", "shape", "outside".
    """

    misfit: float
    by_row: Real
    free: float
    parts: dict[str, float]


def left_of(pairs: Pairs, fit: LinearFit, band: tuple[float, float], n_dofs: int) -> Left | None:
    """What the model of a fit leaves of lines that were kept from it, with its poles refitted to the others; None where these are too few.

    Every third of 18 contiguous blocks of lines (narrower ones where there are few lines) is left out of a refit from the final poles, and
    the model is made of that as it is of the whole fit. Only for FRFs whose measurement variance is known.
    """
    thin, f = fit.pairs.frequencies_hz, pairs.frequencies_hz
    lines = f.size
    blocks = max(N_BLOCKS, lines // 5)  # narrow: each resonance keeps lines on both sides
    number = (np.arange(lines) * blocks) // lines
    held = number % 3 == 1
    used, seen = pairs.lines((np.isin(f, thin) | (number % 3 == 0)) & ~held), pairs.lines(held & (f >= band[0]) & (f <= band[1]))
    if used.frequencies_hz.size < 8 or not seen.frequencies_hz.size:
        return None
    again = fit_linear(used, fit.poles, fit.ends_hz, start=fit.carried_to(used), rounds=1)
    power = modal_power(used, again.poles, again.projection, fit.ends_hz)
    variance = fit_variance(again.projection.error, power, used.noise, used.noise_known).kappa[:, None] * seen.noise
    free = again.on_lines(seen)
    parted = separated(again)
    mass = unit_mass_shapes(parted, n_dofs)
    kept = ~without_shape(parted, mass)
    inside = _of_modes(seen, parted.mean_hz[kept], parted.poles.zeta[kept], mass.shapes[:, kept])
    terms = linear_outside(parted, mass, band, local_terms=False)  # a term of an undriven DOF is in no measured pair
    outside = _of_modes(seen, terms.hz, terms.zeta, terms.shapes)
    beyond = left_beyond(parted, mass.shapes, ~kept, seen.frequencies_hz)
    by_pair = np.mean(power_of(seen.accelerance - inside - outside) / variance, axis=1)
    by_row = np.full(n_dofs, np.nan)
    for row in np.unique(pairs.rows):
        by_row[row] = by_pair[pairs.rows == row].mean()
    parts = {name: _mean(part, variance) for name, part in _parts(again, seen, free, inside, outside, beyond).items()}
    return Left(float(by_pair.mean()), by_row, _mean(seen.accelerance - free, variance), parts)


def _of_modes(pairs: Pairs, hz: Real, zeta: Real, shapes: Real) -> Complex:
    """Sum over modes of unit modal mass in each pair, on its lines, (P, L)."""
    kernel = modal_kernel(pairs.frequencies_hz, hz, zeta, "accelerance", pairs.window_rate)
    return combined(shapes[pairs.rows] * shapes[pairs.columns], kernel)


def _parts(fit: LinearFit, pairs: Pairs, free: Complex, inside: Complex, outside: Complex, beyond: Complex) -> dict[str, Complex]:
    """What stands between the free fit and the model, in the order in which the model goes without: their sum is the whole of it.

    What shapes leave of modes ``beyond`` the lines is a matter of the tails, which take it up.
    """
    f = pairs.frequencies_hz
    ends = max(fit.ends_hz[1], float(fit.poles.hz.max())), fit.ends_hz[0]
    tails = combined(fit.projection.tails, tail_columns(f, *ends, pairs.window_rate))
    g, h = basis(f, replace(fit.poles, hz=fit.mean_hz), pairs.window_rate)[:2]
    still, real = combined(fit.projection.a, g) + combined(fit.projection.b, h), combined(in_phase(fit).real, g)
    return {"shift": free - tails - still, "phase": still - real, "shape": real - inside - beyond, "outside": tails + beyond - outside}


def _mean(error: Complex, variance: Real) -> float:
    return float(np.mean(power_of(error) / variance))
