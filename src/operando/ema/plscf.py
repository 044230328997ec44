"""Poly-reference least-squares complex frequency-domain estimator: the poles of all model orders from one Cholesky factor.

The FRF matrix is a right matrix fraction H(ω) = B(z) A(z)⁻¹ in z = e^{iθ(ω)} with real coefficients, linear least squares on the equation
error B − H A (Guillaume et al. 2003; Peeters et al. 2004, "PolyMAX"). The numerator keeps the largest order for every denominator
order, so the normal matrices of the denominators are nested: one factor serves them all, and each order costs one triangular solve and the
eigenvalues of one block companion matrix. The lowest coefficient is the identity: noise then moves spurious poles to the unstable side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg
from threadpoolctl import threadpool_limits

from operando.errors import DataError, IdentificationError

__all__ = ["OrderPoles", "plscf"]


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
        Whether the pole decays, its damping ratio is below the limit, and its frequency lies in the band. The others are kept
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
    arc: float = 0.95,
    step: int = 1,
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
        Denominator orders; the numerator order is ``max_order`` throughout.
    weights : (n_resp, n_ref, n_lines) or (n_resp, n_lines) array, optional
        Amplitude weights, best 1/standard deviation of the line. The equation error mixes the references, so weights by reference are
        reduced to 1/rms(1/weight). A weight of 0 leaves the line out.
    frequency_range : (low, high), optional
        Band in Hz; default all lines.
    max_damping : float
        Poles above it are flagged as not physical.
    arc : float
        Part of the half circle that the band covers. Below 1 it leaves room at the band edges, where the continuous-time system is not
        periodic in θ; too small makes the normal matrix ill-conditioned.
    step : int
        Step between orders.

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
    """
    f, data, w = _prepare(frequencies_hz, H, weights, frequency_range)
    side: Literal["reference", "response"] = "reference"
    if data.shape[1] > data.shape[0]:
        data, side = data.transpose(1, 0, 2), "response"
        w = None if w is None else w.transpose(1, 0, 2)
    n_in = data.shape[1]
    if not 1 <= min_order <= max_order or not 0.3 <= arc <= 1:
        raise DataError(f"orders {min_order} to {max_order} and arc {arc}: need 1 ≤ min_order ≤ max_order and 0.3 ≤ arc ≤ 1")
    if 2 * f.size * data.shape[0] < (max_order + 1) * (n_in + data.shape[0]) or f.size <= max_order:
        raise IdentificationError(f"{f.size} lines are too few for order {max_order}", hint="lower max_order or widen the band")
    interval = np.pi * arc / (2 * np.pi * (f[-1] - f[0]))
    theta = 2 * np.pi * (f - f[0]) * interval
    with threadpool_limits(1, "blas"):
        normal = _normal_matrix(theta, data, None if w is None else _response_weights(w), max_order)
        return _all_orders(normal, n_in, range(min_order, max_order + 1, step), interval, f, side, max_damping)


def _prepare(
    frequencies_hz: ArrayLike, H: ArrayLike, weights: ArrayLike | None, band: tuple[float, float] | None
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64] | None]:
    """Checked lines, FRFs and weights (n_resp, n_ref or 1, n_lines) in the band."""
    f = np.asarray(frequencies_hz, float)
    data = np.asarray(H, complex)
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
    theta: NDArray[np.float64], data: NDArray[np.complex128], w: NDArray[np.float64] | None, order: int
) -> NDArray[np.float64]:
    """Σ_o T_o − S_oᵀ R_o⁻¹ S_o, ((order + 1)·n_in)², after elimination of the numerators.

    All entries depend on the difference of two powers only (Toeplitz), so they are lag sums over the lines; direct sums as matrix
    products are as fast as an FFT for the orders in use, and serve uneven grids.
    """
    n_out, n_in, n_lines = data.shape
    p = order + 1
    lags = np.arange(p)
    cos, sin = np.cos(np.outer(theta, lags)), np.sin(np.outer(theta, lags))
    same = w is None or bool(np.all(w == w[:1]))
    w2 = np.ones((1, n_lines)) if w is None else (w[:1] ** 2 if same else w**2)
    w2 = w2 / np.mean(w2, axis=1, keepdims=True) if same else w2 / np.mean(w2)

    difference = lags[None, :] - lags[:, None] + order
    gram = (w2 @ cos)[:, np.abs(difference - order)]
    weighted = w2[:, None, :] * data
    s_lags = _lag_sums(weighted.reshape(-1, n_lines), cos, sin).reshape(n_out, n_in, 2 * p - 1)
    square = np.matmul(data.conj().transpose(2, 1, 0), weighted.transpose(2, 0, 1)).transpose(1, 2, 0)
    t_lags = _lag_sums(np.ascontiguousarray(square).reshape(-1, n_lines), cos, sin).reshape(n_in, n_in, 2 * p - 1)
    total = t_lags[:, :, difference].transpose(2, 0, 3, 1).reshape(p * n_in, p * n_in)

    # rows: powers of the numerator; columns: (power, input) of the denominator
    cross = s_lags[:, :, difference].transpose(0, 2, 3, 1).reshape(n_out, p, p * n_in)
    if same:
        rows = linalg.solve_triangular(
            _cholesky(gram[0]), cross.transpose(1, 0, 2).reshape(p, -1), lower=True, check_finite=False
        ).reshape(p * n_out, p * n_in)
    else:
        rows = np.concatenate(
            [linalg.solve_triangular(_cholesky(gram[o]), cross[o], lower=True, check_finite=False) for o in range(n_out)]
        )
    return total - rows.T @ rows


def _lag_sums(g: NDArray[np.complex128], cos: NDArray[np.float64], sin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Re Σ_k g_k e^{iθ_k d} for d = −order … order: (rows, 2·order + 1)."""
    even, odd = g.real @ cos, g.imag @ sin
    return np.concatenate([(even + odd)[:, :0:-1], even - odd], axis=1)


def _cholesky(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _all_orders(
    normal: NDArray[np.float64],
    n_in: int,
    orders: range,
    interval: float,
    f: NDArray[np.float64],
    side: Literal["reference", "response"],
    max_damping: float,
) -> list[OrderPoles]:
    """Denominators with lowest coefficient I, by nested factors, and their poles."""
    # unit diagonal scaling: references may differ by orders of magnitude
    scale = np.sqrt(np.abs(np.diag(normal)[:n_in]))
    scale = np.where(scale > 0, scale, 1.0)
    full = normal / np.tile(scale, normal.shape[0] // n_in)[:, None] / np.tile(scale, normal.shape[0] // n_in)[None, :]
    factor = _cholesky(full[n_in:, n_in:])
    forward = linalg.solve_triangular(factor, full[n_in:, :n_in], lower=True, check_finite=False)
    out = []
    for n in orders:
        k = n * n_in
        solution = linalg.solve_triangular(factor[:k, :k], forward[:k], lower=True, trans="T", check_finite=False)
        # A(z) = I + α₁z + … + α_n zⁿ ; in μ = 1/z the polynomial of Aᵀ is monic
        blocks = -solution.reshape(n, n_in, n_in)
        companion = np.zeros((k, k), order="F")
        companion[:n_in] = -blocks.transpose(2, 0, 1).reshape(n_in, k)
        companion[np.arange(n_in, k), np.arange(k - n_in)] = 1.0
        mu = linalg.eigvals(companion, overwrite_a=True, check_finite=False)
        out.append(_order_poles(n, mu, blocks, scale, interval, f, side, max_damping))
    return out


def _order_poles(
    order: int,
    mu: NDArray[np.complex128],
    blocks: NDArray[np.float64],
    scale: NDArray[np.float64],
    interval: float,
    f: NDArray[np.float64],
    side: Literal["reference", "response"],
    max_damping: float,
) -> OrderPoles:
    """Continuous-time poles of one order, with vectors and flags."""
    z = 1 / mu[(mu.imag < 0) & (np.abs(mu) > 1e-12)]
    poles = np.log(z) / interval + 2j * np.pi * f[0]
    keep = poles.imag > 0
    by_frequency = np.argsort(np.abs(poles[keep]))
    z, poles = z[keep][by_frequency], poles[keep][by_frequency]
    n_in = scale.size
    if n_in == 1:
        vectors = np.ones((1, z.size), complex)
    else:
        # null vectors of A(z)ᵀ; scaling by a power keeps the polynomial finite far from the unit circle
        value = np.zeros((z.size, n_in, n_in), complex)
        for block in blocks[::-1]:
            value = (value + block) * z[:, None, None]
        value += np.eye(n_in)
        vectors = np.linalg.svd(value.transpose(0, 2, 1))[2][:, -1, :].conj().T * scale[:, None]
        vectors = _along_real_axis(vectors)
    hz, zeta = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
    physical = (poles.real < 0) & (zeta < max_damping) & (hz >= f[0]) & (hz <= f[-1])
    return OrderPoles(order, poles, vectors, side, physical)


def _along_real_axis(vectors: NDArray[Any]) -> NDArray[np.complex128]:
    """Unit norm, Σv² real and positive (principal axis along the real one), largest part positive."""
    v = vectors / np.linalg.norm(vectors, axis=0)
    v = v * np.exp(-0.5j * np.angle(np.sum(v**2, axis=0)))
    sign = np.sign(v.real[np.argmax(np.abs(v.real), axis=0), np.arange(v.shape[1])])
    return np.asarray(v * np.where(sign == 0, 1, sign), complex)
