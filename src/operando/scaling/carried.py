"""Idle modes that stand in the OFRF because operation did not show them: how far they have moved, by the modes that it did show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.scaling.doubt import DIAGONAL

NEIGHBOURS = 8
"""Highest pairs that speak for the modes above them."""

LEAST = 4
"""Pairs needed."""

LEAST_LEFT = 0.1
"""Idle modes of which less than this is left are not carried over."""

NOT_HELD = 0.5
"""Idle modes of which more than this is left are carried over though they have a partner."""

CLOSEST = 0.02
"""Relative distance of frequencies below which the mixing of modes grows no more: a bandwidth."""

SURE = 2.0
"""Standard errors below which a common shift counts as none."""


@dataclass(frozen=True)
class CommonShift:
    """What operation does to modes it does not show: ln f changes by ``logarithm`` (0 where the pairs do not agree), within ``spread``."""

    logarithm: float
    spread: float
    pairs: int

    @property
    def factor(self) -> float:
        """Factor on the frequencies."""
        return float(np.exp(self.logarithm))


def common_shift(idle_hz: NDArray[np.float64], operating_hz: NDArray[np.float64]) -> CommonShift:
    """Common shift of the highest pairs of modes of like shape.

    A change of a part (a spring, a mass) moves some modes and not others: the mean shift is then within its error, and nothing is assumed.
    A change of the whole (material, temperature, thickness) moves all alike; the modes above follow.
    """
    highest = np.argsort(idle_hz)[-NEIGHBOURS:]
    shift = np.log(operating_hz[highest] / idle_hz[highest])
    n = shift.size
    if n < LEAST:
        return CommonShift(0.0, 0.0, int(n))
    mean, scatter = float(np.mean(shift)), float(np.std(shift, ddof=1))
    error = scatter / np.sqrt(n)
    # Positive-part shrinkage (James & Stein 1961) with SURE² in the place of one.
    kept = max(0.0, 1 - (SURE * error / mean) ** 2) if mean else 0.0
    return CommonShift(kept * mean, float(np.hypot(scatter, error) if kept else np.sqrt(np.mean(shift**2))), int(n))


def shape_change(idle: NDArray[np.float64], operating: NDArray[np.float64]) -> float:
    """Relative rms change of the highest paired shapes (m, n), freed of noise, what a change of size alone makes left aside."""
    if idle.shape[1] == 0:
        return 0.0
    a, b = idle[:, -NEIGHBOURS:], operating[:, -NEIGHBOURS:]
    likeness = np.sum(a * b, axis=0) ** 2 / np.maximum(np.sum(a**2, axis=0) * np.sum(b**2, axis=0), 1e-300)
    return float(np.sqrt(np.mean(np.maximum(1 - likeness, 0))))


def lessened(idle_hz: NDArray[np.float64], pairs_hz: NDArray[np.float64], mass_share: float, below_hz: float = 0.0) -> NDArray[np.float64]:
    """Factor (k,) on what the highest pairs show of change, for modes beyond them.

    Above: a stiffness at a place changes ω² of every mode by as much, so relatively by less the higher the mode, as its participation in
    other modes; a mass changes all alike. Below all pairs: a change of stiffness mixes mode k into mode j by √(δ_j·δ_k)·ω_jω_k/(ω_k² −
    ω_j²) (``expansion``), little where ω_j lies far below; a change of mass Δm changes its size by Δm_jj/2, where neighbours among the
    pairs are mixed by Δm_jk·ω²/(ω_k² − ω²). The mean square of both laws, weighted by what changed. A residual mode below ``below_hz``, the
    lower end of the band, stands for modes anywhere up to there.
    """
    if pairs_hz.size == 0:
        return np.ones(idle_hz.size)
    ordered = np.sort(pairs_hz)
    middle = float(np.sqrt(np.mean(ordered[-NEIGHBOURS:] ** 2)))
    stiffness, mass = np.minimum((middle / np.maximum(idle_hz, 1e-12)) ** 4, 1), np.ones(idle_hz.size)
    below = idle_hz < ordered[0]
    if np.any(below) and ordered.size > 1:
        among = float(np.mean([_mixing(f, ordered) for f in ordered[-NEIGHBOURS:]]))
        reach = np.array([_mixing(max(f, below_hz), ordered) for f in idle_hz[below]])
        stiffness[below] = np.minimum(reach / among, 1)
        mass[below] = min(DIAGONAL / 4 / among, 1)
    return np.asarray(np.sqrt(mass_share * mass + (1 - mass_share) * stiffness))


def _mixing(hz: float, others: NDArray[np.float64]) -> float:
    """Σ (f·f_k/(f_k² − f²))² over other modes, no closer than ``CLOSEST``."""
    ratio = others[others != hz] / hz
    return float(np.sum((1 / np.maximum(np.abs(ratio - 1 / ratio), 2 * CLOSEST)) ** 2))


def part_left(participation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part of each idle mode that is in none of the operational modes found, 0 to 1, from participations (n_idle, n_operating).

    All operational modes together hold every idle mode once: ΣQ_kr² = 1 over r, for Q the orthonormal participations (of unit modal mass,
    or of unit modal stiffness in its own basis). An idle mode without a partner is either still there, unseen (nothing of it is held), or
    spread over modes that were found (all of it is): carried over, it would count twice.
    """
    unit = participation / np.maximum(np.linalg.norm(participation, axis=0), 1e-300)
    return np.asarray(np.clip(1 - np.sum(unit**2, axis=1), 0, 1))
