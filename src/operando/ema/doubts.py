"""Poles of the linear stage that are no modes to report: kept in the synthesis, told with the reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from operando.data.modal import phase_collinearity
from operando.ema.choose import CLOSE_TWIN_MAC, is_twin, two_peaks
from operando.ema.linear import FEW_PLACES, LinearFit
from operando.ema.pairs import Real
from operando.ema.projection import basis
from operando.ema.residue_matrix import MIN_RANK_SHARE, rank_share, residue_mac, two_shapes

MIN_COLLINEARITY = 0.6
HALF, HALF_COLLINEARITY = 0.5, 0.8
"""A pole that has less than half of the power at its own resonance (median of the pairs) must be in phase (0.8 is what automatic
selections ask of a mode, e.g. Reynders, Houbrechts & De Roeck, MSSP 29, 2012): what is left of a mode that moves between rows is not."""

FLAG_WIDTHS, FLAG_MAC = 2.0, 0.7
"""Neighbours within so many half bandwidths with residues so alike: too different for one pole, too alike for two modes to report.
At ``FEW_PLACES`` or more, shapes of different modes are so alike once in ten million pairs (Beta(1/2, 23/2)): neighbours of one shape are
then one mode at several frequencies, however far apart, unless they rule at their own resonance (half of the power there)."""

HIDDEN_ERRORS, BEST_PAIRS = 5.0, 0.9
"""A mode must exceed so many model errors of all modes at its own resonance, in at least a tenth of the pairs: with an error of 9 % that
is a fifth of the power."""

BACKGROUND_DAMPING, GOOD_COLLINEARITY, BACKGROUND_COLLINEARITY = 8.0, 0.8, 0.9
"""Damping over the median of the clearly real modes from which a pole that is not quite real is taken for a curved background:
modes of a plate have up to 3 times their median, the backgrounds beside them 7 to 100 times."""

MAX_LOG_DAMPING_STD = 0.15
"""Standard deviation of ln ζ: damping of the modes of that plate is known to 3–10 %."""

SAME_SHARE = 0.002
"""Frequencies that differ by less are those of one mode, however sharp: roving tests drift by half of it at most (projection.DRIFT)."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for one pole."""

    evidence: float  # fall of −log likelihood by the mode, in independent lines
    rank_share: float  # part of the residue matrix that one (complex) shape explains, weighted; 1 for a single column
    collinearity: float  # modal phase collinearity of the residues, weighted
    dominance: float  # share of the modes' power at its resonance that it exceeds in one pair of ten
    # quadrature, drift: typical size of the quadrature part over the residue, and of the relative shift between the pairs
    quadrature: float
    drift: float
    doubts: tuple[tuple[str, str], ...] = ()  # empty for a mode


def evidence_of_modes(fit: LinearFit) -> list[Evidence]:
    """Evidence and doubts of each pole."""
    n = fit.n_modes
    zeta = fit.poles.zeta
    residues = fit.residues()
    weights = 1 / np.maximum(fit.projection.a_std, 1e-300) ** 2
    weights = np.minimum(weights, 10 * np.median(weights, axis=0))
    collinearity = np.array([phase_collinearity(residues[:, k] * np.sqrt(weights[:, k])) for k in range(n)])
    shares = [rank_share(fit, k) for k in range(n)]
    power = _power_shares(fit)
    dominance, ruled = np.quantile(power, BEST_PAIRS, axis=0), np.median(power, axis=0)
    good = collinearity > GOOD_COLLINEARITY
    typical = float(np.median(zeta[good])) if good.any() else float(np.median(zeta))
    weaker = _weaker_twins(fit)
    total, cost = fit.evidence.sum(axis=0), fit.penalty()
    all_doubts: list[list[tuple[str, str]]] = []
    for k in range(n):
        doubts: list[tuple[str, str]] = []
        if shares[k] < MIN_RANK_SHARE:
            doubts.append(("not_one_shape", f"one shape explains {100 * shares[k]:.0f} % of its residues between all references"))
        wanted = HALF_COLLINEARITY if ruled[k] < HALF else MIN_COLLINEARITY
        if collinearity[k] < wanted and not fit.noise_limited:
            doubts.append(("complex_shape", f"its residues are not in phase (collinearity {collinearity[k]:.2f})"))
        if dominance[k] < (HIDDEN_ERRORS * fit.model_error) ** 2:
            doubts.append(("hidden", f"at its own resonance it has {100 * dominance[k]:.0f} % of the modes' power where it shows best"))
        background = zeta[k] > BACKGROUND_DAMPING * typical and collinearity[k] < BACKGROUND_COLLINEARITY
        if background and not fit.noise_limited:
            doubts.append(("background", f"its damping {100 * zeta[k]:.3g} % is {zeta[k] / typical:.0f} times that of the other modes"))
        if fit.log_damping_std[k] > MAX_LOG_DAMPING_STD:
            doubts.append(("uncertain", f"its damping is uncertain by {100 * fit.log_damping_std[k]:.0f} %"))
        if total[k] < cost and not fit.noise_limited:
            doubts.append(("few_pairs", "only a few pairs speak for it; by all of them it is a part of the model error"))
        if k in weaker:
            doubts.append(("twin", weaker[k]))
        if k in fit.second_shapes:
            text = f"a second shape at {fit.poles.hz[k]:.5g} Hz, of a mode too close to the first to have a frequency of its own"
            doubts.append(("close_pair", text))
        all_doubts.append(doubts)
    for k, strong in _split_modes(fit, [k for k in range(n) if not all_doubts[k]], total, ruled).items():
        all_doubts[k].append(("twin", f"its shape is that of {fit.poles.hz[strong]:.5g} Hz: one mode at several frequencies"))
    return [
        Evidence(float(total[k]), shares[k], float(collinearity[k]), float(dominance[k]), float(q), float(d), tuple(all_doubts[k]))
        for k, (q, d) in enumerate(zip(fit.poles.quadrature, fit.poles.drift, strict=True))
    ]


def unknown_to(fit: LinearFit, hz: Sequence[float] | Real, band: tuple[float, float]) -> list[float]:
    """Modes in band where the linear stage has no pole, not even a doubtful one, within a half bandwidth or ``SAME_SHARE``.

    It leaves phases and scales of the pairs free; what it does not need makes up for what real modes cannot be, such as gains of sensors.
    """
    within = np.maximum(fit.poles.zeta, SAME_SHARE) * fit.poles.hz
    known = np.array([fit.poles.hz, fit.mean_hz])
    return [float(h) for h in hz if band[0] <= h <= band[1] and not np.any(np.abs(known - h) < within)]


def _power_shares(fit: LinearFit) -> Real:
    """Share of the modes' power that each mode has at its own resonance in each pair, (P, n)."""
    out = np.empty(fit.projection.a.shape)
    for k, h in enumerate(fit.poles.hz):
        g, quadrature = basis(np.array([h]), fit.poles, fit.pairs.window_rate)[:2]
        power = np.abs(fit.projection.a * g[:, 0] + fit.projection.b * quadrature[:, 0]) ** 2
        out[:, k] = power[:, k] / np.maximum(power.sum(axis=1), 1e-300)
    return out


def _weaker_twins(fit: LinearFit) -> dict[int, str]:
    """The weaker of two neighbours of one shape without a dip between, or nearly of one frequency, and what is said of it."""
    out = {}
    strength = fit.projection.evidence.sum(axis=0)
    for k in range(fit.n_modes - 1):
        width = fit.poles.zeta[k : k + 2] * fit.poles.hz[k : k + 2]
        near = fit.poles.hz[k + 1] - fit.poles.hz[k] < FLAG_WIDTHS * max(width) and not fit.noise_limited
        if is_twin(fit, k) or (near and residue_mac(fit, k, k + 1) > FLAG_MAC and not two_peaks(fit, k) and not two_shapes(fit, k, k + 1)):
            weak, strong = (k, k + 1) if strength[k] < strength[k + 1] else (k + 1, k)
            hz = f"{fit.poles.hz[strong]:.5g} Hz"
            if residue_mac(fit, k, k + 1) > CLOSE_TWIN_MAC:
                out[weak] = f"its shape is that of {hz}: one mode at two frequencies between the rows"
            else:
                out[weak] = f"it is so close to {hz} that these FRFs do not tell two modes from one that moves between the rows"
    return out


def _split_modes(fit: LinearFit, among: list[int], strength: Real, ruled: Real) -> dict[int, int]:
    """Poles that repeat the shape of a stronger one of a row of neighbours of one shape, and rule nowhere: number → the stronger.

    A mode that answers otherwise from hit to hit, or bends with level, takes several poles where the model error rules.
    """
    grid = fit.pairs.grid
    places = max(np.unique(grid[:, 0]).size, np.unique(grid[:, 1]).size)  # pairs of several references repeat the shape
    if fit.noise_limited or places < FEW_PLACES:
        return {}
    rows: list[list[int]] = []
    for k in among:
        if rows and residue_mac(fit, rows[-1][-1], k) > FLAG_MAC:
            rows[-1].append(k)
        else:
            rows.append([k])
    out: dict[int, int] = {}
    for row in rows:
        strong = max(row, key=lambda k: strength[k])
        out |= {k: strong for k in row if k != strong and ruled[k] < HALF}
    return out
