"""Receptances of a modal model between its DOFs and weighted sums of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.modal_terms import ModalTerms, shape_rows
from operando.synthesis import combined, modal_kernel, second_order_poles

Array = NDArray[Any]


class Receptances:
    """Receptances of a model of unit modal mass on some lines, between DOFs and whatever is a weighted sum of DOFs.

    Without coupling Σ_r φ_r φ_rᵀ/(ω_r² + 2iζ_rω_rω − ω²). With it (φ − s·lag)(s² + s·C + Ω²)⁻¹(φ − s·lag)ᵀ at s = iω, by the poles λ and
    vectors v, l of the quadratic: since Σ v lᵀ = 0 and Σ λ v lᵀ = 1, it is Σ ψ ψ'ᵀ/(s − λ) + lag·lagᵀ with ψ = (φ − λ·lag) v.

    Parameters
    ----------
    terms : ModalTerms
    frequencies_hz : (n_lines,) array
    """

    def __init__(self, terms: ModalTerms, frequencies_hz: Array) -> None:
        self._terms, coupling = terms, terms.coupling
        self._coordinates = terms.shapes if coupling is None else np.concatenate([terms.shapes, coupling.lag], axis=1)
        if coupling is None:
            kernel = modal_kernel(frequencies_hz, terms.frequencies_hz, terms.damping_ratios, "receptance")
            self._kernel = kernel * terms.signs[:, None]
        else:
            self._poles, self._right, left = second_order_poles(np.eye(terms.n), *terms.quadratic)
            self._left = left * terms.signs[:, None]  # terms that are taken away are tied to no other
            self._kernel = 1 / (2j * np.pi * np.asarray(frequencies_hz, float) - self._poles[:, None])

    def rows(self, dofs: object) -> Array:
        """What stands for DOFs in :meth:`between`, one row each, sign by their sense."""
        return shape_rows(self._coordinates, self._terms.dofs, dofs)

    def placed(self, weights: Array) -> Array:
        """What stands for weighted sums of DOFs, weights (k, n_dofs)."""
        return np.asarray(weights @ self._coordinates)

    def between(self, left: Array, right: Array) -> Array:
        """Receptances (a, b, lines) between places given by rows (a, ·) and (b, ·)."""
        both = (left.shape[0], right.shape[0], -1)
        if self._terms.coupling is None:
            residues = (left[:, None, :] * right[None, :, :]).reshape(-1, left.shape[1])
            return combined(residues, self._kernel).reshape(both)
        (phi, lag), (phi_r, lag_r) = (np.split(rows, 2, axis=1) for rows in (left, right))
        psi = phi @ self._right - (lag @ self._right) * self._poles
        psi_r = phi_r @ self._left - (lag_r @ self._left) * self._poles
        residues = (psi[:, None, :] * psi_r[None, :, :]).reshape(-1, psi.shape[1])
        return combined(residues, self._kernel).reshape(both) + (lag @ lag_r.T)[..., None]
