"""The idle model: real modes, what makes them complex, residual terms, and the covariance of all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

FREQUENCY_LOOSE, DAMPING_LOOSE, SHAPE_LOOSE, BETWEEN_LOOSE, LAG_LOOSE = 0.01, 0.3, 0.3, 0.5, 0.1
"""Standard deviations of a loose model, relative; of damping between modes as a share of the most there can be."""


@dataclass(frozen=True)
class Idle:
    """The structure at rest: real modes and residual terms, damping between modes, lag of the shapes, and the covariance of all.

    θ = (f, ζ, shapes, damping between, lag). Damping that ties a mode to what lies outside the band makes its shape φ − iω·lag, exact
    to first order where those modes only follow; damping between modes in band makes them complex by itself.
    """

    f: np.ndarray
    zeta: np.ndarray
    phi: np.ndarray
    residual: np.ndarray
    dofs: tuple
    between: np.ndarray  # of each pair of modes, over 2 √(ζ_r ω_r ζ_s ω_s)
    lag: np.ndarray  # (DOFs, modes) s
    covariance: np.ndarray

    @classmethod
    def from_terms(cls, terms: Any, band: tuple[float, float]) -> Idle:
        """Of a fitted model's terms; real modes, no damping between them. A residual term in band is a mode."""
        f, zeta, phi = (np.array(v, float) for v in (terms.frequencies_hz, terms.damping_ratios, terms.shapes))
        residual = np.asarray(terms.residual) & ~((f > band[0]) & (f < band[1]))
        n = int((~residual).sum())
        more = n * (n - 1) // 2 + len(terms.dofs) * n
        covariance = np.zeros((2 * f.size + phi.size + more,) * 2)
        covariance[:-more, :-more] = terms.covariance
        return cls(f, zeta, phi, residual, terms.dofs, np.zeros(n * (n - 1) // 2), np.zeros((len(terms.dofs), n)), covariance)

    def loose(self) -> Idle:
        """With a covariance that only says of which order the parameters are."""
        rms = np.sqrt(np.mean(self.phi**2, axis=0))
        modes = ~self.residual
        std = [
            np.where(self.residual, 0, FREQUENCY_LOOSE * self.f),
            np.where(self.residual, 0, DAMPING_LOOSE * self.zeta),
            np.repeat(np.where(self.residual, 1.0, SHAPE_LOOSE) * rms, len(self.dofs)),
            np.full(self.between.size, BETWEEN_LOOSE),
            np.repeat(LAG_LOOSE * rms[modes] / (2 * np.pi * self.f[modes]), len(self.dofs)),
        ]
        return replace(self, covariance=np.diag(np.concatenate(std) ** 2))

    def split(self, theta: np.ndarray) -> list[np.ndarray]:
        """Rows of θ: f, ζ, shapes (terms · DOFs), damping between, lag (modes · DOFs)."""
        n, size = self.f.size, self.phi.size
        return np.split(theta, np.cumsum([n, n, size, self.between.size]))

    def moved(self, theta: np.ndarray, covariance: np.ndarray) -> Idle:
        """With θ added."""
        f, zeta, phi, between, lag = self.split(theta)
        modes = np.flatnonzero(~self.residual)
        first, second = np.triu_indices(modes.size, 1)
        loss = np.abs((self.zeta + zeta) * (self.f + f) / (self.zeta * self.f))[modes]
        scale = 1 / np.sqrt(loss[first] * loss[second])  # it is told over the damping of its modes
        start = 2 * self.f.size + self.phi.size
        factors = np.ones(theta.size)
        factors[start : start + scale.size] = scale
        return replace(
            self,
            f=self.f + f,
            zeta=self.zeta + zeta,
            phi=self.phi + phi.reshape(self.phi.shape[::-1]).T,
            between=(self.between + between) * scale,
            lag=self.lag + lag.reshape(self.lag.shape[::-1]).T,
            covariance=covariance * np.outer(factors, factors),
        )
