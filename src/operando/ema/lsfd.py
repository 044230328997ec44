"""Least-squares frequency-domain residues (LSFD): complex residue matrices for given poles, with lower and upper residual terms.

Receptance H = Σ_r R_r/(iω − λ_r) + R_r*/(iω − λ_r*) − L/ω² + U; mobility and accelerance times iω and (iω)².
All unknowns are real and imaginary parts, one real least-squares problem on stacked real and imaginary lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg
from threadpoolctl import threadpool_limits

from operando.errors import DataError

__all__ = ["Residues", "lsfd"]

_POWER = {"receptance": 0, "mobility": 1, "accelerance": 2}


@dataclass(frozen=True)
class Residues:
    """Residues of a receptance model.

    Parameters
    ----------
    poles : (n,) complex array
        λ [rad/s], positive imaginary part.
    residues : (n_resp, n_ref, n) complex array
        R_r; for real modes of unit modal mass φφᵀ/(2iω_d).
    lower, upper : (n_resp, n_ref) real arrays
        L [1/kg] and U [m/N]; 0 where the term was left out.
    relative_error : (n_resp, n_ref) array
        Norm of what is left over the norm of the FRF.
    shapes : (n_resp, n) complex array or None
        ψ of R = ψuᵀ where participation vectors u were given.
    """

    poles: NDArray[np.complex128]
    residues: NDArray[np.complex128]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    relative_error: NDArray[np.float64]
    shapes: NDArray[np.complex128] | None = None

    def frf(self, frequencies_hz: ArrayLike, quantity: str = "accelerance") -> NDArray[np.complex128]:
        """FRFs (n_resp, n_ref, n_lines) of the model."""
        f = np.asarray(frequencies_hz, float)
        above, below = _kernels(f, self.poles, quantity)
        low, up = _residual_kernels(f, quantity)
        flat = self.residues.reshape(-1, self.poles.size)
        out = flat @ above + flat.conj() @ below + np.outer(self.lower.ravel(), low) + np.outer(self.upper.ravel(), up)
        return np.asarray(out.reshape(*self.lower.shape, f.size))


def lsfd(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    poles: ArrayLike,
    *,
    participation: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    quantity: str = "accelerance",
    lower: bool = True,
    upper: bool = True,
) -> Residues:
    """Residues of all pairs for given poles.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Positive where ``lower`` is used with receptance or mobility.
    H : (n_resp, n_ref, n_lines) complex array
        Not finite lines get no weight.
    poles : (n,) complex array
        λ [rad/s] with positive imaginary part.
    participation : (n_ref, n) complex array, optional
        With it R_r = ψ_r u_rᵀ and only ψ is unknown (what one mode is for all references); without, every pair is free.
    weights : (n_resp, n_ref, n_lines) array, optional
        Amplitude weights, best 1/standard deviation.
    quantity : {"accelerance", "mobility", "receptance"}
    lower, upper : bool
        Whether the residual terms are used.

    Returns
    -------
    Residues

    Raises
    ------
    DataError
        If shapes disagree or the quantity is unknown.
    """
    f = np.asarray(frequencies_hz, float)
    data: NDArray[np.complex128] = np.asarray(H, complex)
    lam: NDArray[np.complex128] = np.atleast_1d(np.asarray(poles, complex))
    if data.ndim != 3 or data.shape[2] != f.size:
        raise DataError(f"FRFs of shape {data.shape} do not fit {f.size} lines: expected (n_resp, n_ref, n_lines)")
    if np.any(lam.imag <= 0):
        raise DataError("poles need a positive imaginary part: one of each conjugate pair")
    if quantity not in _POWER:
        raise DataError(f"quantity {quantity!r} is none of {', '.join(_POWER)}")
    n_out, n_in, _ = data.shape
    u = None if participation is None else np.asarray(participation, complex)
    if u is not None and u.shape != (n_in, lam.size):
        raise DataError(f"participation {u.shape} does not fit {n_in} references and {lam.size} poles")
    w = _checked_weights(data, weights)
    data = np.where(np.isfinite(data), data, 0)
    terms = [k for k, use in zip(_residual_kernels(f, quantity), (lower, upper), strict=True) if use]
    with threadpool_limits(1, "blas"):
        if u is None:
            # every pair is a response of its own with one reference
            flat = None if w is None else w.reshape(-1, 1, f.size)
            solved = _solve(data.reshape(-1, 1, f.size), flat, _kernels(f, lam, quantity), np.ones((1, lam.size), complex), terms)
            residues = (solved[:, : lam.size] + 1j * solved[:, lam.size : 2 * lam.size]).reshape(n_out, n_in, lam.size)
            rest = solved[:, 2 * lam.size :].reshape(n_out, n_in, len(terms))
            shapes = None
        else:
            solved = _solve(data, w, _kernels(f, lam, quantity), u, terms)
            shapes = solved[:, : lam.size] + 1j * solved[:, lam.size : 2 * lam.size]
            residues = shapes[:, None, :] * u[None]
            rest = solved[:, 2 * lam.size :].reshape(n_out, len(terms), n_in).transpose(0, 2, 1)
        zero = np.zeros((n_out, n_in))
        low = rest[:, :, 0] if lower else zero
        up = rest[:, :, -1] if upper else zero
        out = Residues(lam, residues, low, up, zero, shapes)
        amount = np.ones(data.shape) if w is None else w
        left = np.linalg.norm(amount * (data - out.frf(f, quantity)), axis=2)
        total = np.linalg.norm(amount * data, axis=2)
    return Residues(lam, residues, low, up, np.divide(left, total, out=np.zeros_like(left), where=total > 0), shapes)


def _checked_weights(data: NDArray[np.complex128], weights: ArrayLike | None) -> NDArray[np.float64] | None:
    finite = np.isfinite(data)
    if weights is None:
        return None if finite.all() else finite.astype(float)
    w = np.asarray(weights, float)
    w = w[:, None, :] if w.ndim == 2 else w
    try:
        w = np.broadcast_to(w, data.shape)
    except ValueError:
        raise DataError(f"weights of shape {w.shape} do not fit FRFs of shape {data.shape}") from None
    if not np.all(np.isfinite(w) & (w >= 0)):
        raise DataError("weights must be finite and not negative")
    return w * finite


def _kernels(f: NDArray[np.float64], poles: NDArray[np.complex128], quantity: str) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """(iω)^p/(iω − λ) and (iω)^p/(iω − λ*), each (n, n_lines)."""
    s = 2j * np.pi * f[None, :]
    factor = s ** _POWER[quantity]
    return factor / (s - poles[:, None]), factor / (s - poles.conj()[:, None])


def _residual_kernels(f: NDArray[np.float64], quantity: str) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """(iω)^(p−2) and (iω)^p: lower (−1/ω² in receptance) and upper residual term."""
    s = 2j * np.pi * f
    p = _POWER[quantity]
    low: NDArray[np.complex128] = (
        np.ones(f.size, complex) if p == 2 else np.divide(1, s ** (2 - p), out=np.zeros(f.size, complex), where=f > 0)
    )
    return low, np.asarray(s**p, complex)


def _solve(
    data: NDArray[np.complex128],
    w: NDArray[np.float64] | None,
    kernels: tuple[NDArray[np.complex128], NDArray[np.complex128]],
    u: NDArray[np.complex128],
    terms: list[NDArray[np.complex128]],
) -> NDArray[np.float64]:
    """Unknowns of each response: Re ψ, Im ψ, then each residual term for each reference; (n_resp, 2n + n_terms·n_ref)."""
    n_out, n_in, n_lines = data.shape
    above, below = kernels
    n = above.shape[0]
    design = np.zeros((2 * n + len(terms) * n_in, n_in, n_lines), complex)
    for j in range(n_in):
        a, b = u[j][:, None] * above, u[j].conj()[:, None] * below
        design[:n, j], design[n : 2 * n, j] = a + b, 1j * (a - b)
        for t, term in enumerate(terms):
            design[2 * n + t * n_in + j, j] = term
    flat = _stack(design.reshape(design.shape[0], -1))
    target = _stack(data.reshape(n_out, -1))
    if w is None or np.all(w == w[:1]):
        if w is not None:
            once = _twice(w[:1].reshape(1, -1))
            flat, target = flat * once, target * once
        return _least_squares(flat, target)
    rows = [_least_squares(flat * v, target[o : o + 1] * v)[0] for o in range(n_out) for v in (_twice(w[o].reshape(1, -1)),)]
    return np.array(rows)


def _stack(z: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.concatenate([z.real, z.imag], axis=1)


def _twice(w: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([w, w], axis=1)


def _least_squares(design: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """X of least ‖X·design − target‖, columns scaled; by normal equations, by SVD where they are singular."""
    size = np.linalg.norm(design, axis=1)
    size[size == 0] = 1.0
    gram = (design @ design.T) / np.outer(size, size)
    right = (design @ target.T) / size[:, None]
    try:
        factor = linalg.cho_factor(gram, lower=True, check_finite=False)
        if np.min(np.diag(factor[0])) < 1e-6:
            raise linalg.LinAlgError
        solution = linalg.cho_solve(factor, right, check_finite=False)
    except linalg.LinAlgError:
        solution = linalg.lstsq((design / size[:, None]).T, target.T, cond=1e-12, check_finite=False)[0]
    return np.asarray((solution / size[:, None]).T)
