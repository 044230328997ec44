"""Leakage-free FRFs from full-record spectra: local rational modelling (LRM) with transient terms.

Around each line k₀ the spectra of a record of any length obey, with r = (k − k₀)/half,

    D(r)·X_i(k) = Σ_j N_ij(r)·F_j(k) + I_i(r) + noise,

where D, N and I are low polynomials and I holds the transient (leakage), whose poles are those of the structure
(McKelvey & Guérin 2012; the local polynomial method is the case D = 1, Schoukens et al. 2009). D is common to all
responses of a run: the poles of a structure are. H(k₀) = N(0)/D(0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from operando.data import MappedSamples
from operando.errors import DataError
from operando.synthesis import power_of

Array = NDArray[Any]

CACHE_VALUES = 1 << 16
"""Complex values of the windows worked on at a time: a megabyte; with less the calls cost a tenth more, with more the cache does."""


@dataclass(frozen=True)
class LocalRational:
    """Result of :func:`local_rational`.

    Parameters
    ----------
    data : (n_responses, n_forces, n_lines) complex array
    variance : array of the same shape
        E|ΔH|² from the residual of each response, smoothed over neighbouring windows, the common denominator included.
    gain : (n_forces, n_lines) array
        Information: 1/gain is the variance of H at unit noise of the spectra.
    noise : (n_responses, n_lines) array
        Noise variance of the response spectra.
    residual : (n_responses, n_lines) array
        The same of each window alone, before it is smoothed over neighbouring windows.
    degrees_of_freedom : float
        Complex degrees of freedom of the residual of one response in one window.
    """

    data: Array
    variance: Array
    gain: Array
    noise: Array
    residual: Array
    degrees_of_freedom: float


def window_indices(centres: Array, n_lines: int, first: int, last: int) -> NDArray[np.intp]:
    """Lines of the window around each centre (n_centres, n_lines), shifted inwards at the ends of [first, last]."""
    if last - first + 1 < n_lines:
        raise DataError(f"{last - first + 1} lines do not hold a window of {n_lines}", hint="the record or the band is too short")
    start = np.clip(np.rint(centres).astype(int) - n_lines // 2, first, last - n_lines + 1)
    return start[:, None] + np.arange(n_lines)


LONGEST = 1 << 21
"""Samples of a row that are transformed at once, where it has more than twice as many."""


def spectrum_lines(data: NDArray[np.floating[Any]], rows: ArrayLike, lines: NDArray[np.intp], n_samples: int) -> Array:
    """Chosen DFT lines (n_rows, n_lines) of the first ``n_samples`` samples of some rows, one row at a time; mean removed."""
    rows = np.asarray(rows, int)
    out = np.empty((rows.size, lines.size), complex)
    for i, row in enumerate(rows):
        # what was read from a file is nobody else's
        x = np.asarray(data[row, :n_samples], float) if isinstance(data, MappedSamples) else np.array(data[row, :n_samples], float)
        x -= x.mean()
        out[i] = _lines_of(x, lines)
    return out


def _lines_of(x: NDArray[np.float64], lines: NDArray[np.intp]) -> Array:
    """DFT lines of one row, which is overwritten.

    The transform of a long row takes five times its memory. So every p-th sample is transformed by itself, and the lines wanted are the
    sums of the p spectra, rotated by their delay (the last step of the Cooley-Tukey algorithm at these lines alone).
    """
    n = x.size
    parts = next((d for d in range(max(n // LONGEST, 1), 64) if n % d == 0), 1)
    if n <= 2 * LONGEST or parts == 1:
        return np.asarray(fft.rfft(x, overwrite_x=True)[lines])
    place = lines % (n // parts)
    beyond = place > n // parts // 2
    place = np.where(beyond, n // parts - place, place)
    out = np.zeros(lines.size, complex)
    for first in range(parts):
        part = fft.rfft(x[first::parts])[place]
        part.imag[beyond] *= -1
        out += part * np.exp((-2j * np.pi / n) * (lines * first % n))
    return out


def local_rational(
    force: Array,
    response: Array,
    lines: NDArray[np.intp],
    centres: Array,
    *,
    n_lines: int = 17,
    order: int = 2,
    passes: int = 2,
    transient: bool = True,
    coordinates: Array | None = None,
) -> LocalRational:
    """Local rational estimate of H at chosen lines of the DFT of a whole record.

    Linear least squares, reweighted by the last denominator (Sanathanan & Koerner 1963) and the noise of each response;
    numerators and transients are eliminated by QR.

    Parameters
    ----------
    force : (n_forces, n) complex array
        Force spectra at ``lines``.
    response : (n_responses, n) complex array
        Spectra of the responses (n_responses, n_lines).
    lines : (n,) array of int
        DFT line numbers, increasing, with every line of every window.
    centres : (n_centres,) array
        Where H is wanted, in DFT lines (need not be whole).
    n_lines : int
        Lines a window, odd.
    order : int
        Order of D, N and I.
    passes : int
        Passes that find the denominator and the noise, before the last one.
    transient : bool
        Whether the spectra hold a transient; FRFs themselves, with a force of 1, do not.
    coordinates : (n,) array, optional
        Frequency of each entry of ``lines`` in any unit, where they are not evenly spaced (excited lines with gaps).

    Returns
    -------
    LocalRational

    Raises
    ------
    DataError
        If a window has too few lines for the parameters.

    Examples
    --------
    >>> import numpy as np
    >>> rng, n = np.random.default_rng(0), np.arange(100, 200)
    >>> force = rng.normal(size=(1, 100)) + 1j * rng.normal(size=(1, 100))
    >>> found = local_rational(force, 2 * force + 1e-6 * rng.normal(size=(1, 100)), n, np.array([150.0]))
    >>> bool(np.allclose(found.data, 2, atol=1e-4))
    True
    """
    n_f, n_x = force.shape[0], response.shape[0]
    p = (order + 1) * (n_f + transient)
    dof = n_lines - p - order / n_x
    if dof < 1:
        raise DataError(f"{n_lines} lines are too few for a local model with {p} numerator and transient coefficients")
    n_c = centres.size
    chunk = max(4, CACHE_VALUES // (n_lines * (order + 1) * n_x))
    windows = window_indices(centres, n_lines, int(lines[0]), int(lines[-1]))
    parts = [slice(a, min(a + chunk, n_c)) for a in range(0, n_c, chunk)]

    def gather(s: slice) -> _Windows:
        columns = np.searchsorted(lines, windows[s, 0])[:, None] + np.arange(n_lines)
        if coordinates is None:
            r = (windows[s] - centres[s, None]) / (n_lines // 2)
        else:
            r = coordinates[columns] - np.interp(centres[s], lines, coordinates)[:, None]
            r = r / np.max(np.abs(r), axis=1, keepdims=True)
        return _prepare(force.take(columns, axis=1), response.take(columns, axis=1), r, order, transient)

    noise = np.empty((n_x, n_c))
    denominators = np.empty((n_c, order + 1), complex)
    for s in parts:
        denominators[s], noise[:, s] = _first_pass(gather(s), passes, dof)
    stride = float(np.median(np.diff(centres))) if n_c > 1 else 1.0
    residual = noise
    noise = smooth(noise, max(3, 2 * int(n_lines / max(stride, 1e-3)) + 1))
    h, variance, gain = np.empty((n_x, n_f, n_c), complex), np.empty((n_x, n_f, n_c)), np.empty((n_f, n_c))
    for s in parts:
        h[:, :, s], variance[:, :, s], gain[:, s] = _last_pass(gather(s), denominators[s], noise[:, s].T)
    return LocalRational(h, variance, gain, noise, residual, dof)


def roughness_variance(
    h: Array, n_lines: int = 17, frequencies_hz: Array | None = None, smoothed: bool = True, force_power: Array | None = None
) -> Array:
    """E|ΔH|² of FRFs without averages: what a local rational model, common to all responses of a reference, leaves of each.

    With fewer lines in all than a window has, it is NaN. ``smoothed`` over neighbouring windows is right for noise, which hardly changes
    with frequency, not for distortion, which peaks at resonances. With ``force_power`` (n_references, n_lines) noise of the response is
    even, that of the FRF grows where the force is weak (the notches of a hammer pulse).
    """
    count = h.shape[2]
    out = np.full(h.shape, np.nan)
    lines = np.arange(count)
    for k in range(h.shape[1]):
        rows = np.flatnonzero(np.isfinite(h[:, k]).all(axis=1) & np.any(h[:, k] != 0, axis=1))
        if count >= n_lines and rows.size:
            force = np.ones((1, count)) if force_power is None else np.sqrt(np.maximum(force_power[k : k + 1], 1e-300))
            found = local_rational(
                force.astype(complex),
                h[rows, k] * force,
                lines,
                lines.astype(float),
                n_lines=n_lines,
                transient=False,
                coordinates=frequencies_hz,
            )
            out[rows, k] = (found.noise if smoothed else found.residual) / force**2
    return out


def smooth(values: Array, width: int) -> Array:
    """Moving mean along the last axis over ``width`` (odd) entries, shorter at the ends."""
    half = min(width // 2, values.shape[-1] - 1)
    total = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    index = np.arange(values.shape[-1])
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, values.shape[-1])
    return np.asarray(np.maximum(total[..., high] - total[..., low], 0) / (high - low))


@dataclass(frozen=True)
class _Windows:
    """Windows of one chunk: basis (c, p, n) of forces and transient, responses (c, n_x, n), powers r^k (c, order+1, n)."""

    basis: Array
    x: Array
    powers: Array
    f_scale: Array
    least: Array  # (c, n_x): variances below are rounding


def _prepare(f: Array, x: Array, r: Array, order: int, transient: bool) -> _Windows:
    """Windows f (n_forces, c, n), scaled to unit rms, x (n_responses, c, n), r (c, n)."""
    n_f, c, n = f.shape
    tiny = np.finfo(float).tiny
    f_scale = np.sqrt(np.mean(power_of(f), axis=2)).T + tiny
    least = 1e-28 * _power(x).T / n + tiny
    powers = np.ones((c, order + 1, n))
    np.cumprod(np.broadcast_to(r[:, None, :], (c, order, n)), axis=1, out=powers[:, 1:])
    # Transient polynomial last, so that row j·(order+1) of the solution is N_j(0).
    inputs = np.ones((c, n_f + transient, 1, n), complex)
    inputs[:, :n_f, 0] = f.swapaxes(0, 1) / f_scale[:, :, None]
    basis = inputs * powers.astype(complex)[:, None]
    return _Windows(basis.reshape(c, -1, n), x.swapaxes(0, 1), powers, f_scale, least)


def _power(rows: Array) -> Array:
    """Σ |row|² along the last axis."""
    parts = rows.view(float)
    return np.asarray(np.einsum("...n,...n->...", parts, parts))


def _weights(windows: _Windows, d: Array) -> tuple[Array, Array]:
    """|D| on the lines of each window, and the weight 1/|D| with a floor, scaled to a maximum of 1."""
    size = np.abs(d[:, None, :] @ windows.powers)[:, 0]
    weight = 1 / np.maximum(size, 1e-4 * size.max(axis=1, keepdims=True))
    return size, weight / weight.max(axis=1, keepdims=True)


def _first_pass(windows: _Windows, passes: int, dof: float) -> tuple[Array, Array]:
    """Denominators (c, order+1) and noise variance of each response (n_x, c)."""
    c, p, n = windows.basis.shape
    weight = np.ones((c, n))
    sigma = windows.least * 1e28  # the power of each response, so that all count alike
    for _ in range(passes):
        inside, _ = _factored(windows, weight)
        rest = _rest(windows, weight, inside, sigma)
        d = _denominator(_normal(rest))
        size, next_weight = _weights(windows, d)
        free = 1 - np.sum(power_of(inside), axis=2)  # one minus the leverage of each line
        spread = np.sum(free * (size * weight) ** 2, axis=1) * dof / (n - p)
        left = (d[:, None, :] @ rest.reshape(c, d.shape[1], -1)).reshape(c, -1, n)
        sigma = np.maximum(sigma * _power(left) / np.maximum(spread, 1e-300)[:, None], windows.least)
        weight = next_weight
    return d, sigma.T


def _last_pass(windows: _Windows, d: Array, noise: Array) -> tuple[Array, Array, Array]:
    """H, its variance and the gain, with the noise (c, n_x) given and one more update of the denominator."""
    c, _, n = windows.basis.shape
    n_f = windows.f_scale.shape[1]
    order = d.shape[1] - 1
    sigma = np.maximum(noise, windows.least)
    size, weight = _weights(windows, d)
    inside, upper = _factored(windows, weight)
    normal = _normal(_rest(windows, weight, inside, sigma))
    d = _denominator(normal)
    inverse: Array = np.linalg.inv(upper)[:, :: order + 1][:, :n_f]  # rows of N_j(0): (c, n_f, p)
    pick = (inverse @ np.conj(np.swapaxes(inside, 1, 2)) * weight[:, None, :])[:, :, None, :] * windows.powers[:, None]
    parts = (pick.reshape(c, -1, n) @ np.swapaxes(windows.x, 1, 2)).reshape(c, n_f, order + 1, -1)  # N(0) for each power of r on X
    h = np.einsum("cjpx,cp->cjx", parts, d)
    # Noise of the weighted equations: (|D|·weight)², constant where the floor of the weight is not hit.
    level = np.mean((size * weight) ** 2, axis=1)[:, None]
    direct = np.sum(power_of(inverse), axis=2)
    variance = direct[:, :, None] * (level * sigma)[:, None, :]
    if order:
        inner = normal[:, 1:, 1:] / level[:, :, None]
        ridge = (1e-12 * np.trace(inner, axis1=1, axis2=2).real + 1e-300)[:, None, None] * np.eye(order)
        covariance = np.linalg.inv(inner + ridge)
        slope = parts[:, :, 1:].swapaxes(2, 3)
        variance = variance + np.real(np.sum((slope @ covariance[:, None]) * slope.conj(), axis=3))
    unit = 1 / windows.f_scale[:, :, None]
    gain = windows.f_scale**2 / np.maximum(direct * level, 1e-300)
    return np.transpose(h * unit, (2, 1, 0)), np.transpose(variance * unit**2, (2, 1, 0)), gain.T


def _factored(windows: _Windows, weight: Array) -> tuple[Array, Array]:
    """QR of the weighted basis: an orthonormal basis (c, n, p) of its span, and the triangle."""
    return np.linalg.qr((windows.basis * weight.astype(complex)[:, None, :]).swapaxes(1, 2))


def _rest(windows: _Windows, weight: Array, inside: Array, sigma: Array) -> Array:
    """Part of the weighted r^k·X outside the span, in units of the noise of each response, (c, order+1, n_x, n)."""
    c, n, _ = inside.shape
    x = windows.x * (1 / np.sqrt(sigma))[:, :, None]
    factor = (windows.powers * weight[:, None, :]).astype(complex)  # a product of complex and real values casts these, slowly
    rest = x[:, None] * factor[:, :, None, :]
    rows = rest.reshape(c, -1, n)
    rows -= (rows @ inside.conj()) @ inside.swapaxes(1, 2)
    return rest


def _normal(rest: Array) -> Array:
    """Normal matrix of the denominator (c, order+1, order+1)."""
    y = rest.reshape(*rest.shape[:2], -1)
    return np.asarray(y.conj() @ y.swapaxes(1, 2))


def _denominator(normal: Array) -> Array:
    """Least-squares D with D(0) = 1 (c, order+1).

    Taking the noise off the normal matrix (total least squares) was tried and is worse: where the FRF is smooth D cannot be
    identified, and the pull of the noise towards D = 1 is what keeps the estimate from wild values.
    """
    c, p, _ = normal.shape
    d = np.ones((c, p), complex)
    if p > 1:
        ridge = (1e-13 * np.trace(normal, axis1=1, axis2=2).real + 1e-300)[:, None, None] * np.eye(p - 1)
        d[:, 1:] = -np.linalg.solve(normal[:, 1:, 1:] + ridge, normal[:, 1:, :1])[:, :, 0]
    return d
