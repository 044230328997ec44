"""Modes that damping ties to each other, told by their poles: frequency and damping ratio as measured, what ties them beside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import ByContent
from operando.data.coupling import ModalCoupling
from operando.data.modal_terms import ModalTerms
from operando.synthesis import second_order_poles

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class PoleForm(ByContent):
    """Frequencies and damping ratios (n,) of the poles of tied terms.

    With tied terms the diagonals of the modal damping and stiffness matrices say 2ζω and ω² of no pole. This form has the poles, and
    the rest of both diagonals in the coupling, so FRFs are the same. ``by_terms`` (2n, 2n) is the derivative of [f; ζ] of the poles by
    [f (Hz); ζ] of the terms, ``by_damping`` (2n, n, n) by the damping between two terms [1/s], each counted in both triangles; ``vectors``
    (n, n) the mode of each pole over the terms, its own entry 1.
    """

    frequencies_hz: Array
    damping_ratios: Array
    coupling: ModalCoupling
    by_terms: Array
    by_damping: Array
    vectors: Array


def pole_form(terms: ModalTerms) -> PoleForm | None:
    """Of terms with coupling, each told by the pole in which it moves most; of a term without oscillation as it was. None without coupling.

    dλ = −lᵀ (λ dC + dK) v with (M s² + C s + K)⁻¹ = Σ v lᵀ/(s − λ) (Lancaster, Lambda-Matrices and Vibrating Systems, 1966, ch. 4).
    """
    if terms.coupling is None:
        return None
    from scipy.optimize import linear_sum_assignment

    n, (damping, stiffness) = terms.n, terms.quadratic
    poles, right, left = second_order_poles(np.eye(n), damping, stiffness)
    upper = np.flatnonzero(poles.imag > 1e-9 * np.abs(poles))
    share = np.abs(right[:, upper]) ** 2
    at, which = linear_sum_assignment(-share / share.sum(axis=0))
    which = upper[which]
    w, zeta, vectors = 2 * np.pi * terms.frequencies_hz, terms.damping_ratios, np.eye(n, dtype=complex)
    hz, ratio = np.array(terms.frequencies_hz), np.array(zeta)
    by_terms, by_damping = np.eye(2 * n), np.zeros((2 * n, n, n))
    for term, k in zip(at, which, strict=True):
        pole, r, v = poles[k], right[:, k], left[:, k]
        size, both = np.abs(pole), r * v
        hz[term], ratio[term] = size / 2 / np.pi, -pole.real / size
        vectors[:, term] = r / r[term]
        by_f = -both * (2 * zeta * pole + 2 * w) * 2 * np.pi
        by_zeta = -both * 2 * w * pole
        by_terms[[term, n + term]] = _told(pole, np.concatenate([by_f, by_zeta]))
        by_damping[[term, n + term]] = _told(pole, -pole * np.outer(v, r))
    told = 2 * np.pi * hz
    matrix = damping - np.diag(2 * ratio * told)
    return PoleForm(hz, ratio, ModalCoupling(matrix, terms.coupling.lag, np.diag(stiffness) - told**2), by_terms, by_damping, vectors)


def _told(pole: complex, slopes: Array) -> Array:
    """Slopes of a pole as those of frequency [Hz] and damping ratio."""
    size = abs(pole)
    by_w = (np.conj(pole) * slopes).real / size
    by_ratio = -(slopes.real - pole.real / size * by_w) / size
    return np.stack([by_w / 2 / np.pi, by_ratio])
