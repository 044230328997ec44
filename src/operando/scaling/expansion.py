"""Prior-weighted expansion: operational shapes as mixtures of all idle modes, weighted by what a local change can do.

A change of stiffness or mass at some place b mixes idle mode k into an operational mode at ω_o by q_k ∝ φ_k(b)/(ω_k² − ω_o²)
(method.md, "What the paper leaves open"). Where b is not known, φ_k(b) is of the size of the others: so q has a prior with
standard deviations ∝ 1/|ω_k² − ω_o²|, and its posterior mean follows from the shape and its noise. All idle modes take part,
residual ones too, however few sensors there are, and noise is smoothed where the prior leaves no room for it. The scale then
follows from the modal mass qᵀq = 1 if mass is the same at rest and in operation (assumption 3 of Shen & Lu 2024, Eq 13 in
another basis), or from the modal stiffness qᵀΩ²q = ω_o² if stiffness is; which of the two holds is seen from the
orthogonality of the operational modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

DEFAULT_NOISE = 0.02
"""Relative noise of an operational shape where no covariance is given."""

NOISE_FLOOR = 0.003
"""Least relative noise: idle shapes are not better than this."""

WIDTHS = (0.3, 1.0, 3.0, 10.0, 30.0)
"""Trial widths of the prior; the evidence of each shape chooses."""

REMAINDERS = (0.0, 1.0, 3.0, 10.0, 30.0)
"""Trial sizes of what no idle mode explains, in units of the noise."""

Array = NDArray[Any]


@dataclass(frozen=True)
class Prior:
    """Standard deviations that are held fixed while shapes vary.

    Parameters
    ----------
    participation : (n_idle, n_operating) array
        Of q, for operational shapes of unit length.
    remainder : (n_operating,) array
        Of the part of a shape, at each DOF, that lies outside the span of the idle modes.
    noise : (m, n_operating) array
        Of the shape values.
    outside : (m, m) array
        Projector on what lies outside the span of the idle modes; zero with at least as many modes as DOFs.
    """

    participation: NDArray[np.float64]
    remainder: NDArray[np.float64]
    noise: NDArray[np.float64]
    outside: NDArray[np.float64]

    def covariance(self, r: int) -> NDArray[np.float64]:
        """Covariance of all in shape r that is not Φq: noise and remainder."""
        return np.diag(self.noise[:, r] ** 2) + self.remainder[r] ** 2 * self.outside


def make_prior(
    idle: NDArray[np.float64],
    idle_hz: NDArray[np.float64],
    unit_shapes: NDArray[np.float64],
    operating_hz: NDArray[np.float64],
    damping: NDArray[np.float64],
    partners: NDArray[np.int_],
    noise: NDArray[np.float64] | None = None,
) -> Prior:
    """Prior of each operational shape; its width and remainder are the most likely of a small grid (empirical Bayes).

    Parameters
    ----------
    idle : (m, n_idle) real array of unit modal mass, residual modes included
    idle_hz : (n_idle,) array [Hz]
    unit_shapes : (m, n_operating) real array, columns of unit length
    operating_hz, damping : (n_operating,) arrays
    partners : (n_operating,) int array
        Idle partner or −1.
    noise : (m, n_operating) array, optional
        Standard deviation of ``unit_shapes``.
    """
    m, n = unit_shapes.shape
    default = np.full((m, n), DEFAULT_NOISE / np.sqrt(m))
    sd = default if noise is None else np.sqrt(noise**2 + NOISE_FLOOR**2 / m)
    width = np.zeros((idle.shape[1], n))
    remainder = np.zeros(n)
    size = np.maximum(np.linalg.norm(idle, axis=0), 1e-12 * np.max(np.linalg.norm(idle, axis=0)))
    outside = np.eye(m) - idle @ np.linalg.pinv(idle) if idle.shape[1] < m else np.zeros((m, m))
    for r in range(n):
        # Damping keeps the weight finite where frequencies meet: what lies within a bandwidth may mix freely.
        reach = 1 / np.hypot(1 - (idle_hz / operating_hz[r]) ** 2, 2 * damping[r] + 1e-4)
        j = int(partners[r]) if partners[r] >= 0 else int(np.argmax(reach))
        relative = reach / max(reach[j], 1e-12) / size[j]
        best = -np.inf
        for t in WIDTHS:
            std = np.minimum(t * relative, 3 / size)
            std[j] = 3 / size[j]
            spread = (idle * std**2) @ idle.T
            for rest in REMAINDERS if idle.shape[1] < m else REMAINDERS[:1]:
                tau = rest * float(np.sqrt(np.mean(sd[:, r] ** 2)))
                factor = np.linalg.cholesky(spread + np.diag(sd[:, r] ** 2) + tau**2 * outside)
                white = np.linalg.solve(factor, unit_shapes[:, r])
                evidence = -0.5 * float(white @ white) - float(np.sum(np.log(np.diag(factor))))
                if evidence > best + 1e-9:
                    best, width[:, r], remainder[r] = evidence, std, tau
    return Prior(width, remainder, sd, outside)


def expand(idle: Array, unit_shapes: Array, prior: Prior) -> tuple[Array, Array, Array]:
    """Posterior mean of q and of the shape.

    Parameters
    ----------
    idle : (..., m, n_idle) real array
    unit_shapes : (..., m, n_operating) real array
    prior : Prior

    Returns
    -------
    q : (..., n_idle, n_operating) array
    shape : (..., m, n_operating) array
        Φq plus the likely part of the remainder.
    rest : (..., n_operating) array
        Squared length of that remainder.
    """
    lead = np.broadcast_shapes(idle.shape[:-2], unit_shapes.shape[:-2])
    m, n = unit_shapes.shape[-2:]
    q = np.zeros((*lead, idle.shape[-1], n))
    shape, rest = np.zeros((*lead, m, n)), np.zeros((*lead, n))
    for r in range(n):
        weighted = idle * prior.participation[:, r] ** 2
        total = weighted @ np.swapaxes(idle, -1, -2) + prior.covariance(r)
        column = np.broadcast_to(unit_shapes[..., :, r], (*lead, m))[..., None]
        white = np.linalg.solve(np.broadcast_to(total, (*lead, m, m)), column)[..., 0]
        q[..., :, r] = np.einsum("...mk,...m->...k", weighted, white)
        extra = prior.remainder[r] ** 2 * white @ prior.outside
        shape[..., :, r] = np.einsum("...mk,...k->...m", idle, q[..., :, r]) + extra
        rest[..., r] = np.sum(extra**2, axis=-1)
    return q, shape, rest


def modal_mass(idle: Array, q: Array, rest: Array, in_sight: NDArray[np.int_]) -> Array:
    """qᵀq of each column; what no idle mode explains counts with the typical size of a mode at the sensors."""
    typical = np.median(np.sum(idle[..., :, in_sight] ** 2, axis=-2), axis=-1)
    return np.sum(q**2, axis=-2) + rest / typical[..., None]


def modal_stiffness(idle: Array, idle_hz: Array, operating_hz: Array, q: Array, rest: Array, in_sight: NDArray[np.int_]) -> Array:
    """qᵀΩ²q/ω_o² of each column (1 for unit modal mass if stiffness is the same)."""
    typical = np.median(np.sum(idle[..., :, in_sight] ** 2, axis=-2), axis=-1)
    ratio = (idle_hz[..., :, None] / operating_hz[..., None, :]) ** 2
    return np.sum(q**2 * ratio, axis=-2) + rest / typical[..., None]


def orthogonality(q: NDArray[np.float64], idle_hz: NDArray[np.float64]) -> tuple[float, float]:
    """Rms off-diagonal of the operational modes' normalised mass and stiffness matrices, both in the idle structure.

    Zero for the first if mass did not change, for the second if stiffness did not.
    """
    n = q.shape[1]
    if n < 2:
        return 0.0, 0.0
    upper = np.triu_indices(n, 1)
    out = []
    for weighted in (q, q * idle_hz[:, None]):
        unit = weighted / np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)
        out.append(float(np.sqrt(np.mean((unit.T @ unit)[upper] ** 2))))
    return out[0], out[1]


def prior_spread(
    idle: NDArray[np.float64], unit_shapes: NDArray[np.float64], size_factor: NDArray[np.float64], prior: Prior
) -> list[NDArray[np.float64]]:
    """What the prior leaves open: deviations of each scaled shape that the smoothing may have taken away.

    For q ~ N(0, P) and gain K the error of the posterior mean that is not noise is (KΦ − 1)q + Kρ; with the noise part
    (from the covariance of the shapes) it makes up the posterior covariance.

    Parameters
    ----------
    idle : (m, n_idle) array
    unit_shapes : (m, n_operating) array
    size_factor : (n_idle, n_operating) array
        Weight of q² in the squared size (1 for mass, (ω_k/ω_o)² for stiffness).
    prior : Prior

    Returns
    -------
    list of (m, k) array
        One an operational mode; its outer product is the covariance to add.
    """
    m, n = unit_shapes.shape
    q, shape, _ = expand(idle, unit_shapes, prior)
    out = []
    for r in range(n):
        std = prior.participation[:, r]
        weighted = idle * std**2
        total = weighted @ idle.T + prior.covariance(r)
        gain = np.linalg.solve(total, weighted).T
        rest = prior.remainder[r] * prior.outside
        tail = prior.remainder[r] * rest @ np.linalg.inv(total)
        # Columns: one a unit deviation of each q, then of the remainder at each DOF.
        dq = np.concatenate([(gain @ idle - np.eye(std.size)) * std, gain @ rest], axis=1)
        dshape = idle @ dq + np.concatenate([tail @ idle * std, (tail - np.eye(m)) @ rest], axis=1)
        size = float(np.sqrt(np.sum(size_factor[:, r] * q[:, r] ** 2)))
        along = (size_factor[:, r] * q[:, r]) @ dq / size**2
        out.append((dshape - np.outer(shape[:, r], along)) / size)
    return out
