"""Least-squares frequency-domain residues (LSFD): complex residue matrices for given poles, with lower and upper residual terms.

Receptance H = Σ_r R_r/(iω − λ_r) + R_r*/(iω − λ_r*) − L/ω² + U; mobility and accelerance times iω and (iω)².
All unknowns are real and imaginary parts, one real least-squares problem on stacked real and imaginary lines.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from operando.errors import DataError
from operando.threads import one_blas_thread

__all__ = ["Residues", "lsfd"]

_POWER = {"receptance": 0, "mobility": 1, "accelerance": 2}

CHUNK_VALUES = 1 << 15
"""Complex values of the columns worked on at a time: half a megabyte."""

CANCELLED = 1e-6
"""What is left of a pair, as a share of the sums whose difference it is, below which it is added up line by line: nine digits are right."""


@dataclass(frozen=True)
class Residues:
    """Residues of a receptance model."""

    poles: NDArray[np.complex128]  # (n,): λ [rad/s], positive imaginary part
    residues: NDArray[np.complex128]  # (n_resp, n_ref, n): R_r; for real modes of unit modal mass φφᵀ/(2iω_d)
    # lower, upper (n_resp, n_ref): L [1/kg] and U [m/N]; 0 where the term was left out
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    relative_error: NDArray[np.float64]  # (n_resp, n_ref): norm of what is left over the norm of the FRF
    shapes: NDArray[np.complex128] | None = None  # (n_resp, n): ψ of R = ψuᵀ where participation vectors u were given

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

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.ema import lsfd
    >>> residues = lsfd(frf.frequencies_hz, frf.data, idle.poles)
    >>> residues.residues.shape
    (2, 2, 2)
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
    if w is not None:
        data = np.where(np.isfinite(data), data, 0)
    with one_blas_thread():
        if u is None:
            # every pair is a response of its own with one reference
            flat = None if w is None else w.reshape(-1, 1, f.size)
            problem = _Problem(f, lam, np.ones((1, lam.size), complex), quantity, lower, upper)
            solved, error = problem.solve(data.reshape(-1, 1, f.size), flat)
            residues = (solved[:, : lam.size] + 1j * solved[:, lam.size : 2 * lam.size]).reshape(n_out, n_in, lam.size)
            rest = solved[:, 2 * lam.size :].reshape(n_out, n_in, lower + upper)
            shapes = None
        else:
            solved, error = _Problem(f, lam, u, quantity, lower, upper).solve(data, w)
            shapes = solved[:, : lam.size] + 1j * solved[:, lam.size : 2 * lam.size]
            residues = shapes[:, None, :] * u[None]
            rest = solved[:, 2 * lam.size :].reshape(n_out, lower + upper, n_in).transpose(0, 2, 1)
    zero = np.zeros((n_out, n_in))
    low = rest[:, :, 0] if lower else zero
    up = rest[:, :, -1] if upper else zero
    return Residues(lam, residues, low, up, error.reshape(n_out, n_in), shapes)


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
    """(iω)^p/(iω − λ) and (iω)^p/(iω − λ*), each (n, n_lines); in real arithmetic, a complex division costs several times as much."""
    w, s = 2 * np.pi * f, (2j * np.pi * f) ** _POWER[quantity]
    out = []
    for sign in (1, -1):
        distance = w - sign * poles.imag[:, None]
        size = distance**2 + poles.real[:, None] ** 2
        kernel = np.empty(distance.shape, complex)
        np.divide(-poles.real[:, None], size, out=kernel.real)
        np.divide(distance, -size, out=kernel.imag)
        kernel *= s
        out.append(kernel)
    return out[0], out[1]


def _residual_kernels(f: NDArray[np.float64], quantity: str) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """(iω)^(p−2) and (iω)^p: lower (−1/ω² in receptance) and upper residual term."""
    s = 2j * np.pi * f
    p = _POWER[quantity]
    low: NDArray[np.complex128] = (
        np.ones(f.size, complex) if p == 2 else np.divide(1, s ** (2 - p), out=np.zeros(f.size, complex), where=f > 0)
    )
    return low, np.asarray(s**p, complex)


@dataclass(frozen=True)
class _Problem:
    """The least-squares problem of all responses; real and imaginary parts of a line stand side by side, as complex arrays hold them.

    The lines are taken in chunks: the columns of a chunk stay in the cache, and neither they nor the FRFs are ever held a second time.
    """

    f: NDArray[np.float64]
    poles: NDArray[np.complex128]
    participation: NDArray[np.complex128]
    quantity: str
    lower: bool
    upper: bool

    def columns(self, lines: slice | None = None) -> Iterator[tuple[int, slice, NDArray[np.float64]]]:
        """Reference, lines, and what the FRFs of the reference consist of there: Re ψ, Im ψ, residual terms; (2n + n_terms, 2·lines)."""
        n = self.poles.size
        size = max(16, CHUNK_VALUES // (2 * n + 2))
        for some in [slice(k, k + size) for k in range(0, self.f.size, size)] if lines is None else [lines]:
            above, below = _kernels(self.f[some], self.poles, self.quantity)
            terms = [k for k, use in zip(_residual_kernels(self.f[some], self.quantity), (self.lower, self.upper), strict=True) if use]
            for j, u in enumerate(self.participation):
                a, b = u[:, None] * above, u.conj()[:, None] * below
                out = np.empty((2 * n + len(terms), a.shape[1]), complex)
                np.add(a, b, out=out[:n])
                a -= b
                np.multiply(a, 1j, out=out[n : 2 * n])
                for t, term in enumerate(terms):
                    out[2 * n + t] = term
                yield j, some, out.view(float)

    def solve(self, data: NDArray[np.complex128], w: NDArray[np.float64] | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unknowns of each response (n_resp, 2n + n_terms·n_ref), Re ψ, Im ψ, then each residual term for each reference, and the
        norm of what is left of each pair over that of its FRF (n_resp, n_ref)."""
        if w is not None and not np.all(w == w[:1]):
            parts = [self.solve(data[o : o + 1], w[o : o + 1]) for o in range(data.shape[0])]
            return np.concatenate([x for x, _ in parts]), np.concatenate([e for _, e in parts])
        n_out, n_in, _ = data.shape
        own = 2 * self.poles.size + self.lower + self.upper
        grams, right = np.zeros((n_in, own, own)), np.zeros((n_in, own, n_out))
        for j, columns, target in self._weighted(data, w):
            grams[j] += columns @ columns.T
            right[j] += columns @ target.T
        # each reference has residual terms of its own
        where = np.tile(np.arange(own), (n_in, 1))
        where[:, 2 * self.poles.size :] = 2 * self.poles.size + np.arange(own - 2 * self.poles.size) * n_in + np.arange(n_in)[:, None]
        gram, product = np.zeros((where.max() + 1,) * 2), np.zeros((where.max() + 1, n_out))
        for j, at in enumerate(where):
            gram[np.ix_(at, at)] += grams[j]
            product[at] += right[j]
        solution = _solved(gram, product)
        if solution is None:
            solution = self._by_svd(data, w, where)
        total = np.stack([np.sum(np.abs(data[:, j] if w is None else w[:, j] * data[:, j]) ** 2, axis=1) for j in range(n_in)])
        left, size = total.copy(), total.copy()
        for j, at in enumerate(where):
            x = solution[at]
            left[j] += np.sum(x * (grams[j] @ x - 2 * right[j]), axis=0)
            size[j] += np.sum(np.abs(x) * (np.abs(grams[j]) @ np.abs(x) + 2 * np.abs(right[j])), axis=0)
        if np.any(left < CANCELLED * size):
            left = self._left(data, w, solution, where)
        error = np.sqrt(np.divide(left, total, out=np.zeros_like(left), where=total > 0))
        return np.ascontiguousarray(solution.T), error.T

    def _weighted(
        self, data: NDArray[np.complex128], w: NDArray[np.float64] | None, lines: slice | None = None
    ) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
        """Reference, columns and FRFs (n_resp, 2·lines), weighted, on chunks of the lines or on the lines given."""
        for j, some, columns in self.columns(lines):
            target = np.ascontiguousarray(data[:, j, some]).view(float)
            if w is not None:
                once = np.repeat(w[:1, j, some], 2, axis=1)
                columns *= once
                target = target * once
            yield j, columns, target

    def _left(
        self, data: NDArray[np.complex128], w: NDArray[np.float64] | None, solution: NDArray[np.float64], where: NDArray[np.int_]
    ) -> NDArray[np.float64]:
        """Σ|w·remainder|² of each pair from the lines themselves, (n_ref, n_resp): where it is lost in rounding as a difference of sums."""
        left = np.zeros((len(where), data.shape[0]))
        for j, columns, target in self._weighted(data, w):
            left[j] += np.sum((target - solution[where[j]].T @ columns) ** 2, axis=1)
        return left

    def _by_svd(self, data: NDArray[np.complex128], w: NDArray[np.float64] | None, where: NDArray[np.int_]) -> NDArray[np.float64]:
        """The solution of smallest norm where the normal equations are singular."""
        n_in, n_lines = data.shape[1:]
        design = np.zeros((n_in, 2 * n_lines, where.max() + 1))
        target = np.empty((n_in, 2 * n_lines, data.shape[0]))
        for j, columns, rows in self._weighted(data, w, slice(None)):
            design[j][:, where[j]], target[j] = columns.T, rows.T
        flat = design.reshape(-1, design.shape[2])
        scale = np.linalg.norm(flat, axis=0)
        scale[scale == 0] = 1.0
        solution = linalg.lstsq(flat / scale, target.reshape(flat.shape[0], -1), cond=1e-12, check_finite=False)[0]
        return np.asarray(solution / scale[:, None])


def _solved(gram: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Solution of the normal equations, columns scaled; None where they are singular."""
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0] = 1.0
    try:
        factor = linalg.cho_factor(gram / np.outer(scale, scale), lower=True, check_finite=False)
    except linalg.LinAlgError:
        return None
    if np.min(np.diag(factor[0])) < 1e-6:
        return None
    return np.asarray(linalg.cho_solve(factor, right / scale[:, None], check_finite=False) / scale[:, None])
