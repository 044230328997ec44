"""Evidence in operational shapes of a gyroscopic or circulatory effect, which no symmetric FRF can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding
from operando.data.arrays import ByContent
from operando.scaling.expansion import DEFAULT_NOISE
from operando.scaling.methods import real_shapes

LEAST_SHARE = 0.06
"""Imaginary share below which a shape counts as real whatever its stated uncertainty (phase errors of real channels)."""

NOISE_FACTOR = 3.5
"""Standard deviations of the imaginary share that are put down to noise."""

DAMPING_FACTOR = 1.5
"""Margin on the share that symmetric damping could explain (a first-order bound)."""

LEAST_MODES = 2
"""A gyroscopic coupling turns at least two shapes."""


@dataclass(frozen=True, eq=False)
class Complexity(ByContent):
    """How complex each operational shape is, and how much of it symmetric damping or noise could explain.

    As the norm of the imaginary part over the norm of the shape, on the principal axis.
    """

    share: NDArray[np.float64]
    by_damping: NDArray[np.float64]
    noise: NDArray[np.float64]
    unexplained: NDArray[np.bool_]


def complexity(
    operating: NDArray[Any],
    hz: NDArray[np.float64],
    damping: NDArray[np.float64],
    scaled: NDArray[np.float64],
    noise: NDArray[np.float64] | None,
) -> Complexity:
    """Compare the imaginary part of each complex shape (m, n) with what symmetric damping can make.

    A positive semidefinite damping matrix has |C_kr| ≤ √(C_kk·C_rr) with C_kk = 2ζ_kω_k in modal coordinates, so the imaginary
    participation of mode k in mode r is at most about ω_r·2√(ζ_kω_k·ζ_rω_r)/|ω_k² − ω_r²| (first order). A skew coupling has no such bound:
    shapes turn complex while damping stays. ``scaled`` real shapes (m, n_all) of unit modal mass are those of the operational modes, then
    of the idle modes carried over; ``noise`` is the standard deviation of each part (real or imaginary) of shapes rotated to real and
    brought to unit length.
    """
    n = operating.shape[1]
    factor = real_shapes(operating)[1]
    turned = operating * factor
    size = np.linalg.norm(turned, axis=0)
    share = np.linalg.norm(turned.imag, axis=0) / size
    sd = np.full(n, DEFAULT_NOISE) if noise is None else np.linalg.norm(noise, axis=0)
    by_damping = np.zeros(n)
    for r in range(n):
        gap = np.abs(hz**2 - hz[r] ** 2)
        gap[r] = np.inf
        most = 2 * hz[r] * np.sqrt(damping * hz * damping[r] * hz[r]) / np.maximum(gap, 1e-12)
        parts = np.minimum(most, 1) * np.linalg.norm(scaled, axis=0) / max(np.linalg.norm(scaled[:, r]), 1e-300)
        by_damping[r] = np.sqrt(np.sum(parts**2))
    limit = np.hypot(DAMPING_FACTOR * by_damping, NOISE_FACTOR * sd)
    return Complexity(share, by_damping, sd, share > np.maximum(limit, LEAST_SHARE))


def reciprocity_finding(found: Complexity, hz: NDArray[np.float64]) -> Finding | None:
    """The finding ``not_reciprocal``, or None where the shapes give no reason for it."""
    index = np.flatnonzero(found.unexplained)
    if index.size < LEAST_MODES:
        return None
    worst = index[np.argsort(-found.share[index])][:4]
    listed = ", ".join(
        f"{hz[r]:.2f} Hz {100 * found.share[r]:.0f} % (damping explains {100 * found.by_damping[r]:.1f} %)" for r in sorted(worst)
    )
    return Finding(
        "not_reciprocal",
        f"{index.size} of {hz.size} operational shapes have an imaginary part that neither damping nor noise explains: {listed}",
        "warning",
        band_hz=(float(hz[index].min()), float(hz[index].max())),
        consequence="a gyroscopic or circulatory effect is likely (H is not symmetric): "
        "it cannot be represented by a symmetric OFRF; only the effect route can",
        action="check the phase and timing of the channels; else model the effect (gyroscopic or circulatory) and use the effect route",
    )
