"""Poly-reference least-squares complex frequency-domain estimator: the poles of all model orders from one Cholesky factor.

The FRF matrix is a right matrix fraction H(ω) = B(z) A(z)⁻¹ in z = e^{iθ(ω)}, found by linear least squares on the equation error B − H A
(Guillaume et al. 2003; Peeters et al. 2004, "PolyMAX"). The band is mapped onto the whole unit circle with complex coefficients, so
that all poles of the fit serve positive frequencies; or onto its upper half with real coefficients, the textbook form, which needs
twice the order.
The numerator keeps the largest order for every denominator order, so the normal matrices of the denominators are nested: one factor
serves them all, and each order costs one triangular solve and the roots of one matrix polynomial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from operando.ema.matrix_roots import polynomial_values, roots_near
from operando.errors import DataError, IdentificationError
from operando.threads import one_blas_thread

__all__ = ["OrderPoles", "plscf"]

CACHE_VALUES = 1 << 16
"""Complex values of the normal equations worked on at a time: a megabyte."""

EDGE = 0.02
"""How far beyond the lines, in units of the width of the band, a pole may lie."""


@dataclass(frozen=True)
class OrderPoles:
    """Poles of one denominator order.

    Parameters
    ----------
    order : int
        Order of the matrix polynomial A(z); it has ``order × min(n_resp, n_ref)`` eigenvalues.
    poles : (k,) complex array
        λ [rad/s] with positive imaginary part, by rising frequency.
    vectors : (n, k) complex array
        Participation vectors of unit norm, real axis along their principal direction.
    side : {"reference", "response"}
        What ``vectors`` run over: the references, or (more references than responses, the transposed problem) the responses.
    physical : (k,) bool array
        Whether the pole decays, its damping ratio is below the limit, and its frequency lies in the band or just beyond (``EDGE`` of
        its width: the flank of such a mode matters). The others are kept
        so that a diagram can show them and say why they were not taken.
    """

    order: int
    poles: NDArray[np.complex128]
    vectors: NDArray[np.complex128]
    side: Literal["reference", "response"]
    physical: NDArray[np.bool_]

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        """|λ|/2π of each pole."""
        return np.abs(self.poles) / (2 * np.pi)

    @property
    def damping_ratio(self) -> NDArray[np.float64]:
        """−Re λ/|λ| of each pole."""
        return -self.poles.real / np.abs(self.poles)


def plscf(
    frequencies_hz: ArrayLike,
    H: ArrayLike,
    *,
    max_order: int,
    min_order: int = 2,
    weights: ArrayLike | None = None,
    frequency_range: tuple[float, float] | None = None,
    max_damping: float = 0.2,
    constraint: Literal["lowest", "highest"] = "lowest",
    basis: Literal["complex", "real"] = "complex",
    arc: float = 0.9,
    numerator_extra: int = 12,
    step: int = 1,
    window_rate: float = 0.0,
) -> list[OrderPoles]:
    """Poles and participation vectors of every order from ``min_order`` to ``max_order``.

    Parameters
    ----------
    frequencies_hz : (n_lines,) array
        Lines, rising; they need not be even, nor start at a multiple of their spacing.
    H : (n_resp, n_ref, n_lines) complex array
        FRFs of any quantity (the numerator takes up the difference). It is not changed. With more references than responses
        (roving hammer) the transposed problem is solved and the vectors run over the responses.
    max_order, min_order : int
        Denominator orders; the numerator keeps its order throughout.
    weights : (n_resp, n_ref, n_lines) or (n_resp, n_lines) array, optional
        Amplitude weights, best 1/standard deviation of the line. The equation error mixes the references, so weights by reference are
        reduced to 1/rms(1/weight). A weight of 0 leaves the line out.
    frequency_range : (low, high), optional
        Band in Hz; default all lines.
    max_damping : float
        Poles above it are flagged as not physical.
    constraint : {"lowest", "highest"}
        Which coefficient of A is the identity. "lowest" moves spurious poles to the unstable side and gives clear diagrams, with
        damping biased low under strong noise; "highest" is more exact, biased high, and makes spurious poles look stable.
    basis : {"complex", "real"}
        Whole circle and complex coefficients (``order × n_ref`` poles in the band), or half circle and real ones (half as many).
    arc : float
        Part of the (half) circle that the band covers. Below 1 it leaves room at the band edges, where the continuous-time system is not
        periodic in θ; too small makes the normal matrix ill-conditioned.
    numerator_extra : int
        Powers that the numerator has beyond those of A, on both sides (fewer where there are few lines). They take up what modes
        outside the band do near its edges: with 12 the poles of a noise-free chain at the lowest sufficient order are 100–1000 times
        closer than without.
    step : int
        Step between orders.
    window_rate : float
        Rate β [1/s] of the exponential window the FRFs carry; each pole is moved back by it.

    Returns
    -------
    list of OrderPoles
        By rising order.

    Raises
    ------
    DataError
        If shapes disagree or a value is not finite.
    IdentificationError
        If there are too few lines for the order.

    Notes
    -----
    Poles: λ = ln(z)/T + 2πi·f₁, T the sampling interval that maps the band from f₁ onto the arc. Participation vectors u satisfy
    uᵀA(z) = 0; residues are ψuᵀ.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.ema import plscf
    >>> orders = plscf(frf.frequencies_hz, frf.data, max_order=6)
    >>> len(orders)
    5
    """
    f, data, w = _prepare(frequencies_hz, H, weights, frequency_range)
    side: Literal["reference", "response"] = "reference"
    if data.shape[1] > data.shape[0]:
        data, side = data.transpose(1, 0, 2), "response"
        w = None if w is None else w.transpose(1, 0, 2)
    n_in = data.shape[1]
    if not 1 <= min_order <= max_order or not 0.3 <= arc <= 1:
        raise DataError(f"orders {min_order} to {max_order} and arc {arc}: need 1 ≤ min_order ≤ max_order and 0.3 ≤ arc ≤ 1")
    if f.size < 2 * (max_order + 1):
        raise IdentificationError(f"{f.size} lines are too few for order {max_order}", hint="lower max_order or widen the band")
    extra = min(numerator_extra, (f.size // 2 - max_order - 1) // 2)
    real = basis == "real"
    interval = arc * (0.5 if real else 1.0) / (f[-1] - f[0])
    shift_hz = float(f[0] if real else (f[0] + f[-1]) / 2)
    theta = 2 * np.pi * (f - shift_hz) * interval
    with one_blas_thread():
        normal = _normal_matrix(theta, data, None if w is None else _response_weights(w), max_order, extra, real)
        scale, solved = _denominators(normal, n_in, range(min_order, max_order + 1, step), constraint)
        out = []
        z: NDArray[np.complex128] | None = None
        for n, blocks in solved:
            z = roots_near(blocks, z)
            poles = np.log(z) / interval + 2j * np.pi * shift_hz
            keep = (poles.imag > 0) & ((z.imag > 0) if real else np.ones(z.size, bool))
            chosen, poles = z[keep], poles[keep]
            poles = poles + window_rate
            rising = np.argsort(np.abs(poles))
            chosen, poles = chosen[rising], poles[rising]
            hz, zeta = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
            edge = EDGE * (f[-1] - f[0])
            physical = (poles.real < 0) & (zeta < max_damping) & (hz >= f[0] - edge) & (hz <= f[-1] + edge)
            out.append(OrderPoles(n, poles, _null_vectors(blocks, chosen, scale), side, physical))
    return out


def _prepare(
    frequencies_hz: ArrayLike, H: ArrayLike, weights: ArrayLike | None, band: tuple[float, float] | None
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64] | None]:
    """Checked lines, FRFs and weights (n_resp, n_ref or 1, n_lines) in the band."""
    f = np.asarray(frequencies_hz, float)
    data: NDArray[np.complex128] = np.asarray(H, complex)
    if data.ndim != 3 or f.ndim != 1 or data.shape[2] != f.size:
        raise DataError(f"FRFs of shape {data.shape} do not fit {f.shape} lines: expected (n_resp, n_ref, n_lines)")
    if f.size < 2 or np.any(np.diff(f) <= 0):
        raise DataError("frequency lines must rise, and there must be at least two")
    w: NDArray[np.float64] | None = None
    if weights is not None:
        w = np.asarray(weights, float)
        w = w[:, None, :] if w.ndim == 2 else w
        if w.shape not in (data.shape, (data.shape[0], 1, data.shape[2])):
            raise DataError(f"weights of shape {w.shape} do not fit FRFs of shape {data.shape}")
        w = np.broadcast_to(w, data.shape)
    if band is not None:
        keep = (f >= band[0]) & (f <= band[1])
        if np.count_nonzero(keep) < 2:
            raise IdentificationError(f"no lines between {band[0]:g} and {band[1]:g} Hz", hint=f"lines run from {f[0]:g} to {f[-1]:g} Hz")
        f, data, w = f[keep], data[:, :, keep], None if w is None else w[:, :, keep]
    if not np.all(np.isfinite(data)) or (w is not None and not np.all(np.isfinite(w) & (w >= 0))):
        raise DataError("FRFs and weights must be finite, weights not negative", hint="leave bad lines out, or give them weight 0")
    return f, data, w


def _response_weights(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (n_resp, n_lines): the references' variances averaged."""
    with np.errstate(divide="ignore"):
        mean = np.mean(np.where(w > 0, 1 / np.where(w > 0, w, 1) ** 2, np.inf), axis=1)
    return np.where(np.isfinite(mean), 1 / np.sqrt(mean), 0.0)


def _normal_matrix(
    theta: NDArray[np.float64], data: NDArray[np.complex128], w: NDArray[np.float64] | None, order: int, extra: int, real: bool
) -> NDArray[Any]:
    """Σ_o T_o − S_oᴴ R_o⁻¹ S_o, ((order + 1)·n_in)², after elimination of the numerators.

    All entries depend on the difference of two powers only (Toeplitz), so they are lag sums over the lines; direct sums as matrix
    products are as fast as an FFT for the orders in use, and serve uneven grids.
    """
    n_out, n_in, n_lines = data.shape
    p, q = order + 1, order + 1 + 2 * extra
    same = w is None or bool(np.all(w == w[:1]))
    w2 = np.ones((1, n_lines)) if w is None else (w[:1] ** 2 if same else w**2)
    w2 = w2 / np.mean(w2)
    angles = np.outer(theta, np.arange(q))
    waves = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    powers, numerator = np.arange(p), np.arange(q) - extra

    def lag_sums(g: NDArray[Any]) -> NDArray[Any]:
        sums = _lag_sums(g, waves)
        return np.ascontiguousarray(sums.real) if real else sums

    weighted = w2[:, None, :] * data
    gram = _toeplitz(lag_sums(w2), numerator, numerator)
    inverse = [_inverse_factor(np.ascontiguousarray(g)) for g in gram]
    square = np.matmul(data.conj().transpose(2, 1, 0), weighted.transpose(2, 0, 1)).transpose(1, 2, 0)
    total = _toeplitz(lag_sums(square), powers, powers).transpose(2, 0, 3, 1).reshape(p * n_in, p * n_in)
    # rows: powers of the numerator; columns: (power, input) of the denominator; a few responses at a time, as the cache holds them
    lags = lag_sums(weighted)
    few = max(1, CACHE_VALUES // (p * q * n_in)) if same else 1
    taken = np.zeros((p * n_in, p * n_in), total.dtype, order="F")
    for first in range(0, n_out, few):
        part = _toeplitz(lags[first : first + few], numerator, powers)
        cross = np.array(part.transpose(2, 0, 3, 1), order="C").reshape(q, -1)
        factor = inverse[0 if same else first]
        rows = _lower_times(factor, cross).reshape(-1, p * n_in)
        taken = _add_product(rows, taken)
    return np.asarray(total - _full(taken))


def _toeplitz(lags: NDArray[Any], rows: NDArray[np.int_], columns: NDArray[np.int_]) -> NDArray[Any]:
    """Lag sums (…, 2n + 1) at the difference of two powers, (…, rows, columns): a view; both rise by one."""
    start = lags.shape[-1] // 2 + int(columns[0]) - int(rows[0])
    step = lags.strides[-1]
    shape = (*lags.shape[:-1], rows.size, columns.size)
    return np.lib.stride_tricks.as_strided(lags[..., start:], shape, (*lags.strides[:-1], -step, step), writeable=False)


def _lag_sums(g: NDArray[Any], waves: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Σ_k g_k e^{iθ_k d} for d = −n … n, from cos and sin of θ_k d, d ≥ 0, side by side in ``waves``: (…, 2n + 1).

    One real matrix product serves both signs of d: a quarter of the work of complex ones.
    """
    n = waves.shape[1] // 2
    flat = g.reshape(-1, g.shape[-1])
    real = np.ascontiguousarray(flat.real) @ waves
    imag = np.ascontiguousarray(flat.imag) @ waves if np.iscomplexobj(flat) else np.zeros_like(real)
    ac, as_, bc, bs = real[:, :n], real[:, n:], imag[:, :n], imag[:, n:]
    out = np.empty((flat.shape[0], 2 * n - 1), complex)
    out.real[:, n - 1 :], out.imag[:, n - 1 :] = ac - bs, as_ + bc
    out.real[:, n - 1 :: -1], out.imag[:, n - 1 :: -1] = ac + bs, bc - as_
    return out.reshape(*g.shape[:-1], -1)


def _lower_times(factor: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """L·X for a lower triangle, half the work of a product; X is overwritten."""
    trmm = linalg.blas.ztrmm if np.iscomplexobj(right) else linalg.blas.dtrmm
    return np.asarray(trmm(1.0, factor.T, right.T, side=1, overwrite_b=1).T)


def _add_product(rows: NDArray[Any], total: NDArray[Any]) -> NDArray[Any]:
    """The upper triangle of the conjugate of rowsᴴ·rows added to ``total`` (in Fortran order, overwritten)."""
    rank_k = linalg.blas.zherk if np.iscomplexobj(rows) else linalg.blas.dsyrk
    return np.asarray(rank_k(1.0, rows.T, beta=1.0, c=total, overwrite_c=1))


def _full(upper: NDArray[Any]) -> NDArray[Any]:
    """The Hermitian matrix whose conjugate's upper triangle is given."""
    full = np.conj(upper)
    return np.asarray(full + np.triu(full, 1).conj().T)


def _cholesky(matrix: NDArray[Any]) -> NDArray[Any]:
    """Lower factor; a matrix that rounding made indefinite gets the smallest ridge that helps."""
    scale = float(np.max(np.abs(np.diag(matrix))))
    if not scale > 0:
        raise IdentificationError("the FRFs have no weight or no content in the band")
    for ridge in (0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-10):
        try:
            return np.asarray(linalg.cholesky(matrix + ridge * scale * np.eye(len(matrix)), lower=True, check_finite=False))
        except linalg.LinAlgError:
            continue
    raise IdentificationError("the normal matrix is singular", hint="lower max_order or check for lines or channels without content")


def _inverse_factor(gram: NDArray[Any]) -> NDArray[Any]:
    """L⁻¹ of R = LLᴴ: small, and a product with it needs no copy of the large right-hand side."""
    factor = _cholesky(gram)
    return np.asarray(linalg.solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False))


def _denominators(
    normal: NDArray[Any], n_in: int, orders: range, constraint: str
) -> tuple[NDArray[np.float64], list[tuple[int, NDArray[Any]]]]:
    """Scale of the inputs, and for each order the blocks α_0 … α_n (n + 1, n_in, n_in), one of them the identity."""
    # inputs of one size: references may differ by orders of magnitude
    size = np.sqrt(np.abs(np.diag(normal)[:n_in]))
    size = np.where(size > 0, size, 1.0)
    tiled = np.tile(size, normal.shape[0] // n_in)
    scaled = normal / tiled[:, None] / tiled[None, :]
    identity = np.eye(n_in, dtype=normal.dtype)[None]
    out = []
    if constraint == "lowest":
        factor = _cholesky(scaled[n_in:, n_in:])
        forward = linalg.solve_triangular(factor, scaled[n_in:, :n_in], lower=True, check_finite=False)
    else:
        factor = _cholesky(scaled)
    for n in orders:
        k = n * n_in
        right = forward[:k] if constraint == "lowest" else factor[k : k + n_in, :k].conj().T
        solution = -linalg.solve_triangular(factor[:k, :k], right, lower=True, trans="C", check_finite=False).reshape(n, n_in, n_in)
        out.append((n, np.concatenate([identity, solution] if constraint == "lowest" else [solution, identity])))
    return size, out


def _null_vectors(blocks: NDArray[Any], z: NDArray[np.complex128], size: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Participation vectors u of uᵀA(z) = 0, (n_in, n_poles): unit norm, principal axis along the real one, largest part positive."""
    n_in = size.size
    if n_in == 1:
        return np.ones((1, z.size), complex)
    value = polynomial_values(blocks, z)
    v = np.linalg.svd(value.transpose(0, 2, 1))[2][:, -1, :].conj().T * size[:, None]
    v = v / np.linalg.norm(v, axis=0)
    v = v * np.exp(-0.5j * np.angle(np.sum(v**2, axis=0)))
    sign = np.sign(v.real[np.argmax(np.abs(v.real), axis=0), np.arange(v.shape[1])])
    return np.asarray(v * np.where(sign == 0, 1, sign), complex)
