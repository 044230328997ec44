"""All modes shifted by one factor at unchanged shapes: a wrong sampling rate of one file, or a stiffness that changed as a whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from operando.data import Finding, ModalModel
from operando.indicators import INTERVAL
from operando.scaling.pairing import Pairing

LEAST_MODES = 3
"""Ratios that must agree: two agree too easily."""
SAME_SHAPE = 0.9
"""MAC of modes that are taken for unchanged in shape here: shapes of a structure changed at a place fall below with its shifts."""
MOST_OF_THEM = 0.8
"""Part of the operational modes that must take part; local changes leave some modes where they were and turn others."""
LEAST_SHIFT = 0.005
"""Smallest shift that is reported: steel loses 0.02 % of its frequencies a kelvin, so that 25 K stay below."""
SIGNIFICANT = 5.0
"""The factor must differ from 1 by so many of its standard deviations, and the typical mode by a third as many of its own."""
QUANTILE = 0.01
"""Probability of refusing a common factor that is there: the ratios' chi-square is compared with its 99 % point."""
REPEATABILITY = 1e-4
"""Standard deviation of ln f between two identifications beside the stated ones (model order, band), 0.01 %."""
RATES = ((500.0, 512.0), (44100.0, 48000.0), (1.0, 2.0), (2.0, 2.56), (1.0, 2.56), (50.0, 60.0))
"""Sampling rates that are taken for one another: decimal and binary series, audio rates, rate and bandwidth."""


def common_factor(
    idle_hz: NDArray[np.float64],
    operating_hz: NDArray[np.float64],
    idle_std: NDArray[np.float64],
    operating_std: NDArray[np.float64],
) -> tuple[float, float, bool]:
    """Weighted mean of operating over idle frequency, its standard deviation, and whether all modes have this factor.

    The deviation is widened where the scatter is larger than stated. All have it where the ratios agree within their standard deviations
    (99 %), differ from 1 clearly, and each is precise enough to tell.
    """
    ratio = np.log(operating_hz / idle_hz)
    variance = (idle_std / idle_hz) ** 2 + (operating_std / operating_hz) ** 2 + REPEATABILITY**2
    weight = 1 / variance
    mean = float(np.sum(weight * ratio) / np.sum(weight))
    chi2, freedom = float(np.sum(weight * (ratio - mean) ** 2)), max(ratio.size - 1, 1)
    std = float(np.sqrt(1 / np.sum(weight)) * np.sqrt(max(chi2 / freedom, 1.0)))
    agree = chi2 <= float(chdtri(freedom, QUANTILE))
    clear = abs(mean) > max(LEAST_SHIFT, SIGNIFICANT * std, SIGNIFICANT / 3 * float(np.median(np.sqrt(variance))))
    return float(np.exp(mean)), float(np.exp(mean) * std), bool(agree and clear and ratio.size >= LEAST_MODES)


def sampling_rate_finding(pairing: Pairing, idle: ModalModel, operating: ModalModel) -> Finding | None:
    """Finding where all operational modes lie at one factor from their idle partners."""
    alike = [p for p in pairing.pairs if p.idle is not None and p.mac >= SAME_SHAPE]
    stds = idle.frequency_std_hz, operating.frequency_std_hz
    if len(alike) < max(LEAST_MODES, MOST_OF_THEM * len(pairing.pairs)) or stds[0] is None or stds[1] is None:
        return None
    j, i = np.array([p.idle for p in alike], int), np.array([p.operating for p in alike], int)
    factor, std, one = common_factor(idle.frequencies_hz[j], operating.frequencies_hz[i], stds[0][j], stds[1][i])
    if not one:
        return None
    return Finding(
        "sampling_rate",
        f"all {len(alike)} operational modes that keep their shape lie at {factor:.5f} ± {INTERVAL * std:.5f} times their idle frequency"
        + _taken_for(factor, std),
        "warning",
        consequence="if the sampling rate of one file is wrong, all frequencies and the operational FRFs are shifted by this factor; if "
        "the stiffness of the whole structure changed (temperature, support, mass of all parts alike), the shift is real",
        action="compare the sampling rate in the headers of idle and operating records with that of the measuring system, and export "
        "again with the right one ([units] sampling_hz for tables); a real change of the whole is global_stiffness",
    )


def _taken_for(factor: float, std: float) -> str:
    """Which mistaken rate gives this factor."""
    for a, b in RATES:
        for low, high in ((a, b), (b, a)):
            if abs(low / high - factor) < max(3 * std, 1e-4):
                return f", as an operating header of {low:g} for {high:g} Hz would make it (or the other way round for an idle one)"
    return ""
