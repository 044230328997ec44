"""The linear truth of a case: modal equations with any damping matrix, their poles and complex shapes, FRFs. Shares no code with operando.

q'' + C q' + diag(ω²) q = Φᵀ f, y = Φ q. Poles λ and vectors v of the 2n state-space problem, scaled so that vᵀ(2λ + C)v = 1, give the
receptance Φ (Σ v vᵀ/(iω − λ)) Φᵀ over all 2n poles (Lancaster, Lambda-Matrices and Vibrating Systems, 1966, for symmetric C).
A complex shape is stated as v √(2iω_d): for a real mode that is its shape of unit modal mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Modal:
    """Undamped frequencies (kept,) in Hz and the damping matrix (kept, kept) in modal coordinates of unit mass, 1/s."""

    hz: np.ndarray
    damping: np.ndarray

    @cached_property
    def _solved(self) -> tuple[np.ndarray, np.ndarray]:
        n = len(self.hz)
        if not np.any(self.damping - np.diag(np.diag(self.damping))):  # uncoupled: in closed form
            half = np.diag(self.damping) / 2 + 0j
            root = np.sqrt(half**2 - (2 * np.pi * self.hz) ** 2)
            poles = np.concatenate([-half + root, -half - root])
            v = np.tile(np.eye(n), 2) / np.sqrt(np.concatenate([2 * root, -2 * root]))
            order = np.lexsort((-poles.imag, np.round(np.abs(poles), 6)))
            return poles[order], v[:, order]
        stiffness = np.diag((2 * np.pi * self.hz) ** 2)
        state = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -self.damping]])
        poles, vectors = np.linalg.eig(state)
        v = vectors[:n]
        scale = 2 * poles * np.einsum("ir,ir->r", v, v) + np.einsum("ir,ij,jr->r", v, self.damping, v)
        v = v / np.sqrt(scale)
        order = np.lexsort((-poles.imag, np.round(np.abs(poles), 6)))
        return poles[order], v[:, order]

    @property
    def poles(self) -> np.ndarray:
        """All 2n poles in rad/s."""
        return self._solved[0]

    @property
    def vectors(self) -> np.ndarray:
        """Their vectors (kept, 2n), scaled as above."""
        return self._solved[1]

    @cached_property
    def oscillating(self) -> np.ndarray:
        """Indices of one pole of each pair (positive imaginary part), by rising frequency."""
        return np.flatnonzero(self.poles.imag > 1e-9 * np.abs(self.poles))

    @property
    def frequencies(self) -> np.ndarray:
        """|λ|/2π of the pairs, Hz."""
        return np.abs(self.poles[self.oscillating]) / 2 / np.pi

    @property
    def ratios(self) -> np.ndarray:
        """−Re λ/|λ| of the pairs."""
        chosen = self.poles[self.oscillating]
        return -chosen.real / np.abs(chosen)

    @property
    def shapes(self) -> np.ndarray:
        """Complex shapes (kept, pairs) in modal coordinates, v √(2iω_d)."""
        i = self.oscillating
        return self.vectors[:, i] * np.sqrt(2j * self.poles[i].imag)

    @cached_property
    def _partners(self) -> np.ndarray:
        """Index of the conjugate of each pole of ``oscillating``."""
        return np.array([int(np.argmin(np.abs(self.poles - self.poles[i].conj()))) for i in self.oscillating])

    def shifted(self, relative: np.ndarray) -> np.ndarray:
        """All 2n poles with each pair moved by a relative amount (pairs,): a drift of the modes at constant damping ratio."""
        poles = self.poles.copy()
        poles[self.oscillating] *= 1 + relative
        poles[self._partners] *= 1 + relative
        return poles

    def accelerance(self, hz: np.ndarray, outputs: np.ndarray, inputs: np.ndarray, poles: np.ndarray | None = None) -> np.ndarray:
        """(outputs, inputs, lines) in (m/s²)/N for modal rows (·, kept) of outputs and inputs."""
        poles = self.poles if poles is None else poles
        s = 2j * np.pi * np.asarray(hz)
        gains = s**2 / (s - poles[:, None])  # (2n, lines)
        o, i = outputs @ self.vectors, inputs @ self.vectors
        return ((o[:, None] * i[None]).reshape(-1, o.shape[1]) @ gains).reshape(len(o), len(i), -1)

    def contributions(self, hz: np.ndarray, outputs: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """What each pair of poles adds (pairs, outputs, inputs) at its own frequency in ``hz`` (pairs,)."""
        i = self.oscillating
        s = 2j * np.pi * np.asarray(hz)
        o, f = outputs @ self.vectors[:, i], inputs @ self.vectors[:, i]
        gain = s**2 / (s - self.poles[i])
        other = s**2 / (s - self.poles[i].conj())
        return np.einsum("or,fr,r->rof", o, f, gain) + np.einsum("or,fr,r->rof", o.conj(), f.conj(), other)
