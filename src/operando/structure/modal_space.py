"""The idle structure as arrays: poles, shapes, receptances, free decays and the motion from rest."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft

from operando.data import ModalModel

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

REACH = 1.04
"""A model is known to this much beyond its last identified mode."""

LITTLE = 0.5
"""Residual modes below the band are masses that count there if they make this part of the compliance at its first line."""

MASS = 0.1
"""A residual mode below this part of the lowest identified one stands for a mass, of which an acceleration shows no decay."""


@dataclass(frozen=True)
class Modes:
    """The idle model as arrays: n modes of unit modal mass, the residual terms behind the identified ones.

    ``known_hz`` is how far up its modes were identified, ``low_hz`` how far down; beyond, residual modes stand for what is there.
    ``grounded``: records contradict the residual modes below the lines, so the structure is flat there.
    """

    hz: Real
    zeta: Real
    phi: Real  # shapes (m, n)
    known_hz: float = 0.0
    low_hz: float = 0.0
    signs: Real = field(default_factory=lambda: np.ones(1))  # −1 for residual terms that are taken away
    grounded: bool = False

    @classmethod
    def of(cls, idle: ModalModel) -> Modes:
        """All modes, then the residual terms."""
        proper, terms = idle.frequencies_hz, idle.terms
        known, low = REACH * float(np.max(proper, initial=0.0)), float(np.min(proper, initial=np.inf))
        return cls(
            np.asarray(terms.frequencies_hz),
            np.asarray(terms.damping_ratios),
            np.asarray(terms.shapes, float),
            known,
            low if np.isfinite(low) else 0.0,
            terms.signs,
        )

    @property
    def poles(self) -> Complex:
        """λ = −ζω + iω√(1−ζ²) [rad/s]."""
        w = 2 * np.pi * self.hz
        return np.asarray(w * (-self.zeta + 1j * np.sqrt(1 - self.zeta**2)))

    def receptance_kernel(self, hz: Real) -> Complex:
        """±1/(ω_r² − ω² + 2iζ_r ω_r ω), (n, L)."""
        w, w0 = 2 * np.pi * hz[None, :], 2 * np.pi * self.hz[:, None]
        return np.asarray(self.signs[:, None] / (w0**2 - w**2 + 2j * self.zeta[:, None] * w0 * w))

    def spurious(self, b: Real, first_hz: float) -> NDArray[np.bool_]:
        """Residual modes below all others that do not prevail across a place b (m,) at the first line, (n,).

        What stands for little in the band grows without bound below it: there it says nothing.
        """
        low = (self.hz < self.low_hz) & (self.hz < first_hz)
        own = (self.phi.T @ b) ** 2 * self.receptance_kernel(np.array([first_hz]))[:, 0]
        if not np.any(low) or (not self.grounded and abs(np.sum(own[low])) > LITTLE * abs(np.sum(own))):
            return np.zeros(self.hz.size, bool)
        return np.asarray(low)

    def bounded_kernel(self, hz: Real, spurious: NDArray[np.bool_], first_hz: float) -> Complex:
        """The receptance kernel, spurious modes below the first line as they are there: structures that stand are flat below it."""
        kernel = self.receptance_kernel(hz)
        kernel[spurious] = self.only(spurious).receptance_kernel(np.maximum(hz, first_hz))
        return kernel

    def only(self, keep: NDArray[np.bool_] | NDArray[np.int_]) -> Modes:
        """Some of the modes."""
        signs = self.signs if self.signs.size == 1 else self.signs[keep]
        return replace(self, hz=self.hz[keep], zeta=self.zeta[keep], phi=self.phi[:, keep], signs=signs)

    def free(self) -> Modes:
        """Those that move under their stiffness."""
        return self.only(self.hz > 1e-3)

    def ringing(self, sampling_hz: float) -> NDArray[np.int_]:
        """Modes whose free decay the record can show: below its Nyquist frequency, and no residual ones that are but a mass in the band."""
        return np.flatnonzero((self.hz < 0.49 * sampling_hz) & (self.hz > max(1e-3, MASS * self.low_hz)))

    def from_rest(self, drive: Complex, n: int, step: float) -> tuple[Real, Real, Real]:
        """Modal displacement, velocity and acceleration (modes, n) under modal forces given as spectra, at rest at the first sample."""
        w = 2 * np.pi * sfft.rfftfreq(n, step)
        q = self.receptance_kernel(w / (2 * np.pi)) * drive
        x, v, a = (sfft.irfft(part, n, axis=1) for part in (q, 1j * w * q, -(w**2) * q))
        poles = self.poles
        c = -(x[:, 0] / 2 + 1j * (poles.real * x[:, 0] - v[:, 0]) / (2 * poles.imag))
        # decay_in_time divides by 1 − exp(λT), which belongs to periodic sums; here the decay starts at once.
        c = c * (1 - np.exp(poles * n * step))
        more = decay_in_time(poles, np.stack([c, c * poles, c * poles**2]), n, step, apart=True)
        return x + more[0], v + more[1], a + more[2]


def decay_in_time(poles: Complex, amplitudes: Complex, n: int, step: float, apart: bool = False) -> Real:
    """Free decays as n samples: Σ 2 Re a·exp(λt)/(1 − exp(λ n step)), any number of rows of amplitudes (…, r); or each mode apart."""
    # exp(λ t) in two factors: a table of n exponentials for each mode would cost more than everything else.
    block = int(np.ceil(np.sqrt(n)))
    coarse = np.exp(poles[:, None] * step * block * np.arange(-(-n // block)))
    fine = np.exp(poles[:, None] * step * np.arange(block))
    scaled = amplitudes / (1 - np.exp(poles * n * step))
    table = np.einsum("...r,rc,rf->...rcf" if apart else "...r,rc,rf->...cf", scaled, coarse, fine, optimize=True)
    return np.asarray(2 * table.real.reshape(*table.shape[:-2], -1)[..., :n])
