"""The linear least-squares problems of many pairs that share their columns and differ in their weights.

Of each mode four columns are enough: with D = ω₀² + 2ζω₀s + s², g = s²/D and c = s/ω₀ these are g, h = cg, r = ω₀²g/D and q = cr, since
c²r = g − r − 2ζq. Residue and quadrature part are fitted to g and h, and all derivatives by ln f and ln ζ are sums of the four, which
saves more than half of the products of two columns that each pair is summed over.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri

from operando.ema.pairs import Complex, Real
from operando.synthesis import combined, compliance, power_of, real_inner, row_blocks

RIDGE = 1e-9

PRODUCT_BYTES, CACHE_BYTES, SOLVED_BYTES = 1e8, 2e6, 1.6e7
"""Products over the lines held at a time, Gram matrices that are worked on together, and inverses held at a time.

The last is below what the C library takes from the system anew each time (32 MB), whose pages the system clears: a quarter of all time.
"""

GEMM_ROWS = 400
"""Rows of a product over the lines."""

Four = tuple[Real, Real, Real, Real]
"""Amounts of g, h, r and q of each mode, each (P, n)."""


@dataclass(frozen=True)
class Columns:
    """Columns over the lines: g, h, tails, r, q one below the other, (4n + t, L); ω₀ [rad/s] of the modes and s = iω + β of the lines."""

    rows: Complex
    zeta: Real
    w0: Real
    s: Complex

    @property
    def n(self) -> int:
        """Number of modes."""
        return int(self.zeta.size)

    @property
    def core(self) -> int:
        """Number of columns that are fitted freely: g, h, tails."""
        return self.rows.shape[0] - 2 * self.n

    @property
    def four(self) -> tuple[slice, slice, slice, slice]:
        """Where g, h, r and q stand."""
        n, core = self.n, self.core
        return slice(0, n), slice(n, 2 * n), slice(core, core + n), slice(core + n, core + 2 * n)

    @property
    def g(self) -> Complex:
        """Kernels."""
        return self.rows[self.four[0]]

    @property
    def h(self) -> Complex:
        """Their quadrature parts."""
        return self.rows[self.four[1]]

    @property
    def tails(self) -> Complex:
        """What stands for all outside."""
        return self.rows[2 * self.n : self.core]

    def by_frequency(self, a: Real, b: Real) -> Four:
        """a·∂g/∂ln f + b·∂h/∂ln f in the four columns."""
        z = self.zeta
        return -2 * z * b, -b, 2 * (z * b - a), (4 * z**2 - 2) * b - 2 * z * a

    def by_damping(self, a: Real, b: Real) -> Four:
        """a·∂g/∂ln ζ + b·∂h/∂ln ζ in the four columns."""
        z = self.zeta
        return -2 * z * b, np.zeros_like(b), 2 * z * b, 4 * z**2 * b - 2 * z * a

    def amounts(self, a: Real, b: Real, tails: Real, moved: Four) -> Real:
        """Amounts of all columns, (P, 4n + t)."""
        out = np.concatenate([a, b, tails, np.zeros((a.shape[0], 2 * self.n))], axis=1)
        for at, more in zip(self.four, moved, strict=True):
            out[:, at] += more
        return out


@dataclass(frozen=True)
class Before:
    """Residues a and quadrature parts b of the round before, and the amplitude that sizes the prior on b, each (P, n)."""

    a: Real
    b: Real
    amplitude: Real

    def pairs(self, rows: slice) -> Before:
        """Some of the pairs."""
        return Before(self.a[rows], self.b[rows], self.amplitude[rows])


@dataclass(frozen=True)
class PairFits:
    """What :class:`operando.ema.projection.Projection` is made of, for a chunk of pairs."""

    cost: Real
    a: Real
    b: Real
    shift: Real
    tails: Real
    error: Complex
    evidence: Real
    a_std: Real
    gradient: Real
    slope: Real
    normal: Real
    spread_sums: Real


def modal_columns(f: Real, hz: Real, zeta: Real, tails: Complex, rate: float) -> Columns:
    """The columns of modes on lines f [Hz] of FRFs under an exponential window of this rate."""
    n, t = hz.size, tails.shape[0]
    s: Complex = np.asarray(2j * np.pi * f + rate, complex)
    w0 = 2 * np.pi * hz
    squared = s * s
    rows = np.empty((4 * n + t, f.size), complex)
    rows[2 * n : 2 * n + t] = tails
    out = Columns(rows, zeta, w0, s)
    g, h, r, q = (rows[at] for at in out.four)
    for at in row_blocks(n, f.size):
        inverse, c = compliance(s, w0[at], zeta[at]), s / w0[at, None]
        np.multiply(inverse, squared, out=g[at])
        np.multiply(g[at], c, out=h[at])
        inverse *= w0[at, None] ** 2
        np.multiply(g[at], inverse, out=r[at])
        np.multiply(r[at], c, out=q[at])
    return out


def chunks(n_pairs: int, n_modes: int) -> Iterator[slice]:
    """Pairs whose products over the lines are held at a time."""
    size = max(16, int(PRODUCT_BYTES / (32 * max(n_modes, 1) ** 2)))
    return (slice(k, k + size) for k in range(0, n_pairs, size))


def fit_pairs(
    data: Complex, variance: Real, c: Columns, spreads: tuple[Real, Real, Real], before: Before | None, with_slopes: bool
) -> Iterator[PairFits]:
    """Residues, quadrature parts, shifts and tails of each pair, and what they say of the poles; some pairs at a time.

    ``spreads`` are those of the priors: most (P, n), quadrature (n,), drift (n,). ``before`` is what the columns of the shifts are made
    with; without it there are no shifts, and b has no prior. Normal equations and slopes by the poles are zeros unless wanted.
    """
    most, quadrature, drift = spreads
    weight = 1 / variance
    grams = Grams(c, weight, core_only=not with_slopes and before is None)
    size = max(1, int(SOLVED_BYTES / (8 * (c.core + c.n) ** 2)))
    for first in range(0, data.shape[0], size):
        at = slice(first, min(first + size, data.shape[0]))
        some = None if before is None else before.pairs(at)
        yield _fit_some(data[at], weight[at], c, grams, first, (most[at], quadrature, drift), some, with_slopes)


def _fit_some(
    data: Complex,
    weight: Real,
    c: Columns,
    grams: Grams,
    begin: int,
    spreads: tuple[Real, Real, Real],
    before: Before | None,
    with_slopes: bool,
) -> PairFits:
    """The same for some pairs, the first of which is number ``begin`` of those with Gram matrices."""
    n, core, count = c.n, c.core, data.shape[0]
    rows = c.rows if with_slopes or before is not None else c.rows[:core]
    step = _few(rows.shape[0])
    parts = [slice(k, min(k + step, count)) for k in range(0, count, step)]
    gram = lambda at: grams.of(slice(begin + at.start, begin + at.stop))  # noqa: E731
    shifts = None if before is None else c.by_frequency(before.a, before.b)
    size = core if shifts is None else core + n
    inverse = np.empty((count, size, size))
    scale, prior = np.empty((count, size)), np.zeros((count, size))
    most, quadrature, drift = spreads
    spread_b = None if before is None else np.maximum(quadrature * before.amplitude, 1e-150)
    for at in parts:
        matrix = _matrix(gram(at), c, None if shifts is None else _some(shifts, at))
        own = np.sqrt(np.einsum("pii->pi", matrix))
        own[own == 0] = 1
        matrix /= own[:, :, None] * own[:, None, :]
        diagonal = np.einsum("pii->pi", matrix)
        diagonal += RIDGE
        known = prior[at]  # precision, in the scaled unknowns
        known[:, :n] = np.minimum(1e12, 0.5 / np.maximum(most[at] * own[:, :n], 1e-150) ** 2)
        if spread_b is not None:
            known[:, n : 2 * n] = np.minimum(1e12, 0.5 / np.maximum(spread_b[at] * own[:, n : 2 * n], 1e-150) ** 2)
            known[:, core:] = np.minimum(1e12, 0.5 / np.maximum(drift * own[:, core:], 1e-150) ** 2)
        diagonal += known
        inverse[at], scale[at] = _inverted(matrix), own
    x, error = np.zeros((count, size)), data
    for _ in range(2):  # refined once: next to strong peaks rounding is more than what pulls the poles
        pull = real_inner(error * weight, rows)
        if shifts is None:
            pulls = pull[:, :core]
        else:
            pulls = np.concatenate([pull[:, :core], _summed(pull, c, shifts)], axis=1)
        x += np.matmul(inverse, (pulls / scale - prior * scale * x)[:, :, None])[:, :, 0] / scale
        amounts = x[:, :core]
        if shifts is not None:
            moved = x[:, core:]
            shifted = moved * shifts[0], moved * shifts[1], moved * shifts[2], moved * shifts[3]
            amounts = c.amounts(x[:, :n], x[:, n : 2 * n], x[:, 2 * n : core], shifted)
        error = data - combined(amounts, rows[: amounts.shape[1]])
    a, b, tails = x[:, :n], x[:, n : 2 * n], x[:, 2 * n : core]
    shift = np.zeros_like(a) if shifts is None else x[:, core:]
    # from the residuals: as a difference of sums over strong peaks it would be lost in rounding
    cost = np.sum(power_of(error) * weight, axis=1) + np.sum(prior * (x * scale) ** 2, axis=1)
    slope, normal, gradient = np.zeros((count, n, 2 * n)), np.zeros((2 * n, 2 * n)), np.zeros((count, 2 * n))
    if with_slopes:
        # Jacobian columns a·gf + b·hf, a·gz + b·hz; gradient by the envelope theorem
        moves = c.by_frequency(a, b), c.by_damping(a, b)
        pull = real_inner(error * weight, rows)
        gradient = np.concatenate([_summed(pull, c, move) for move in moves], axis=1)
        for at in parts:
            own, against = _against_slopes(gram(at), c, [_some(m, at) for m in moves], None if shifts is None else _some(shifts, at))
            scaled = against / scale[at, :, None]
            solved = inverse[at] @ scaled
            normal += own - scaled.reshape(-1, 2 * n).T @ solved.reshape(-1, 2 * n)
            slope[at] = -solved[:, :n] / scale[at, :n, None]
    evidence, a_std = _evidence(inverse, scale, x, n)
    sums = np.zeros((4, n))
    if before is not None and spread_b is not None:
        posterior = np.einsum("pii->pi", inverse) / scale**2
        known = np.clip(1 - 0.5 * posterior[:, n : 2 * n] / spread_b**2, 0, 1)
        sums[:2] = np.sum(known * (b / np.maximum(before.amplitude, 1e-150)) ** 2, axis=0), np.sum(known**2, axis=0)
        known = np.clip(1 - 0.5 * posterior[:, core:] / drift**2, 0, 1)
        sums[2:] = np.sum(known * shift**2, axis=0), np.sum(known**2, axis=0)
    return PairFits(cost, a, b, shift, tails, error, evidence, a_std, gradient, slope, normal, sums)


def _few(n_columns: int) -> int:
    return max(1, int(CACHE_BYTES / (8 * n_columns**2)))


def _some(four: Four, at: slice) -> Four:
    return four[0][at], four[1][at], four[2][at], four[3][at]


class Grams:
    """Gram matrices Re Σ_l w_pl c_i c̄_j of the columns of each pair, made where they are used: they fit no cache together.

    Real and imaginary parts carry the same weight, so real products do. With u = g, r and z = u_i ū_j three of them serve the four
    products of u and cu = su/ω₀ (s = β + iω): Σw Re z, Σwω Im z, Σw|s|² Re z; of modes that lie apart one product serves for the three
    (:class:`Moments`).
    """

    def __init__(self, c: Columns, weight: Real, core_only: bool) -> None:
        n, core = c.n, c.core
        self.columns, self.size = c, core if core_only else core + 2 * n
        self.moments = Moments(c, weight, core_only)
        re, im = np.ascontiguousarray(c.rows[: self.size].real), np.ascontiguousarray(c.rows[: self.size].imag)
        self.tails = np.empty((weight.shape[0], core - 2 * n, self.size))
        for i in range(2 * n, core):
            np.matmul(weight, (re[i] * re + im[i] * im).T, out=self.tails[:, i - 2 * n])

    def of(self, at: slice) -> Real:
        """Those of some of the pairs, (P, K, K)."""
        c, rate = self.columns, float(self.columns.s.real[0])
        out = np.empty((at.stop - at.start, self.size, self.size))
        g, h, r, q = c.four
        for own, other, plain, cross, square in self.moments.of(at):
            u_i, cu_i, u_j, cu_j = (*((g, h) if own == 0 else (r, q)), *((g, h) if other == 0 else (r, q)))
            out[:, u_i, u_j] = plain
            np.divide(rate * plain + cross, c.w0, out=out[:, u_i, cu_j])
            if own != other:
                np.divide(rate * plain - cross, c.w0[:, None], out=out[:, cu_i, u_j])
            np.divide(square + rate**2 * plain if rate else square, c.w0[:, None] * c.w0, out=out[:, cu_i, cu_j])
        tails = self.tails[at]
        out[:, 2 * c.n : c.core] = tails
        out[:, :, 2 * c.n : c.core] = tails.transpose(0, 2, 1)
        return _mirrored(out)


class Moments:
    """M₀ = Σw Re z, M₁ = Σwω Im z and M₂ = Σwω² Re z of z = u_i ū_j, u = g and r, over the lines, for each pair.

    With D_i = ω_i² + 2ζ_iω_i s + s² is D_i − D̄_j = Δ + iωτ, Δ = ω_i² − ω_j² + 2β(ζ_iω_i − ζ_jω_j), τ = 2(ζ_iω_i + ζ_jω_j + 2β), so that

        ΔM₀ − τM₁ = Re Σw e,   ΔM₁ + τM₂ = Im Σwω e,   e = (D_i − D̄_j) z

    and e is simpler than z: s²ḡ_j − s̄²g_i of g_i ḡ_j, s²r̄_j − ω_j² g_i ḡ_j of g_i r̄_j, and ω_i² g_i r̄_j − ω_j² r_i ḡ_j of r_i r̄_j: sums
    that one mode alone, or a simpler z, have. So M₂ is a product over the lines, and M₁ and M₀ follow where |Δ| ≥ τω of all lines, which
    makes errors of M₂ no larger; all three are products for modes closer than that. (g − 1 stands for g in e: it falls with ω².)
    """

    def __init__(self, c: Columns, weight: Real, core_only: bool) -> None:
        n, s = c.n, c.s
        omega, rate, decay = s.imag, float(s.real[0]), c.zeta * c.w0
        self.square, self.kinds = c.w0**2, 1 if core_only else 2
        delta = self.square[:, None] - self.square + 2 * rate * (decay[:, None] - decay)
        self.turn = 2 * (decay[:, None] + decay + 2 * rate)
        apart = np.abs(delta) >= self.turn * float(omega.max(initial=0.0))
        self.over = np.where(apart, 1 / np.where(apart, delta, 1.0), 0.0)
        u = np.concatenate([c.rows[at] for at in c.four[: 2 * self.kinds : 2]])
        re, im = np.ascontiguousarray(u.real), np.ascontiguousarray(u.imag)
        by_omega = weight * omega
        by_square = by_omega * omega
        self.second = np.zeros((weight.shape[0], u.shape[0], u.shape[0]))
        one, more = (np.empty((max(GEMM_ROWS, u.shape[0]), omega.size)) for _ in range(2))
        begin = 0
        while begin < u.shape[0]:  # a few rows at a time: a product of larger matrices is faster
            rows = slice(begin, min(begin + max(1, GEMM_ROWS // (u.shape[0] - begin)), u.shape[0]))
            shape = rows.stop - begin, u.shape[0] - begin
            real, imag = (part[: shape[0] * shape[1]].reshape(*shape, -1) for part in (one, more))
            np.multiply(re[rows, None], re[None, begin:], out=real)
            real += np.multiply(im[rows, None], im[None, begin:], out=imag)
            self.second[:, rows, begin:] = (by_square @ one[: shape[0] * shape[1]].T).reshape(-1, *shape)
            begin = rows.stop
        self.near = []
        for own, other in self.blocks():
            i, j = np.nonzero(~apart if own != other else np.triu(~apart))
            a, b = own * n + i, other * n + j
            plain = weight @ (re[a] * re[b] + im[a] * im[b]).T
            self.near.append((i, j, plain, by_omega @ (im[a] * re[b] - re[a] * im[b]).T))
        phase = np.where(s == 0, 1.0, s.conj() ** 2 / np.where(s == 0, 1.0, s * s))
        alone = -(self.square[:, None] + 2 * decay[:, None] * s) * c.g * phase
        self.alone = weight @ alone.real.T, by_omega @ alone.imag.T
        self.constant = 4 * rate * by_square.sum(axis=1)[:, None, None]
        if not core_only:
            double = c.rows[c.four[2]] * s.conj() ** 2
            self.double = weight @ double.real.T, by_omega @ double.imag.T

    def blocks(self) -> tuple[tuple[int, int], ...]:
        """Kinds of u_i and u_j: 0 for g, 1 for r."""
        return ((0, 0),) if self.kinds == 1 else ((0, 0), (0, 1), (1, 1))

    def of(self, at: slice) -> Iterator[tuple[int, int, Real, Real, Real]]:
        """Kinds of u_i and u_j, M₀, M₁ and M₂ of some of the pairs, each (P, n, n); of equal kinds i ≤ j alone counts in M₂."""
        n = self.square.size
        zero, one = (part[at] for part in self.alone)
        by_one = zero[:, None] - zero[:, :, None], self.constant[at] - one[:, None] - one[:, :, None]
        last: tuple[Real, Real] = by_one
        for (own, other), (i, j, plain, cross) in zip(self.blocks(), self.near, strict=True):
            m2 = self.second[at, own * n : (own + 1) * n, other * n : (other + 1) * n]
            if own == other:
                m2 = np.triu(m2) + np.triu(m2, 1).swapaxes(1, 2)
            if (own, other) == (0, 1):
                first, second = (part[at][:, None] for part in self.double)
                last = first - self.square * last[0], -second - self.square * last[1]
            elif own == 1:
                mine = self.square[:, None]
                last = (
                    mine * last[0] - self.square * last[0].swapaxes(1, 2),
                    mine * last[1] + self.square * last[1].swapaxes(1, 2),
                )
            m1 = (last[1] - self.turn * m2) * self.over
            m0 = (last[0] + self.turn * m1) * self.over
            m0[:, i, j], m1[:, i, j] = plain[at], cross[at]
            if own == other:
                m0[:, j, i], m1[:, j, i] = plain[at], -cross[at]
            last = m0, m1
            yield own, other, m0, m1, m2


def _mirrored(upper: Real) -> Real:
    """The upper triangles copied to the lower ones, in place."""
    for i in range(1, upper.shape[1]):
        upper[:, i, :i] = upper[:, :i, i]
    return upper


def _inverted(matrix: Real) -> Real:
    """Inverses of positive matrices, in place: by Cholesky factors, a third of the work of a general one."""
    for i, one in enumerate(matrix):
        factor, failed = dpotrf(one.T, lower=1, clean=0)
        matrix[i] = np.linalg.inv(one) if failed else dpotri(factor, lower=1, overwrite_c=1)[0].T
    return _mirrored(matrix)


def _summed(values: Real, c: Columns, four: Four) -> Real:
    """Sums over the four columns of each mode, along the last axis: (P, …, n)."""
    shape = (values.shape[0], *(1,) * (values.ndim - 2), -1)
    first, *others = (values[..., at] * part.reshape(shape) for at, part in zip(c.four, four, strict=True))
    for other in others:
        first += other
    return np.asarray(first)


def _matrix(gram: Real, c: Columns, shifts: Four | None) -> Real:
    """Normal matrices of the fitted columns: core, then the shifts, a·gf + b·hf."""
    core = c.core
    if shifts is None:
        return np.array(gram[:, :core, :core])
    by_shift = _summed(gram, c, shifts)
    out = np.empty((gram.shape[0], core + c.n, core + c.n))
    out[:, :core, :core] = gram[:, :core, :core]
    out[:, :core, core:] = by_shift[:, :core]
    out[:, core:, :core] = by_shift[:, :core].transpose(0, 2, 1)
    out[:, core:, core:] = _summed(by_shift.transpose(0, 2, 1), c, shifts).transpose(0, 2, 1)
    return out


def _against_slopes(gram: Real, c: Columns, moves: list[Four], shifts: Four | None) -> tuple[Real, Real]:
    """Products of the Jacobian's columns with each other, summed over the pairs (2n, 2n), and with the fitted columns (P, size, 2n)."""
    slopes = np.concatenate([_summed(gram, c, move) for move in moves], axis=2)
    turned = slopes.transpose(0, 2, 1)
    own = np.concatenate([_summed(turned, c, move).sum(axis=0) for move in moves], axis=1)
    against = slopes[:, : c.core]
    if shifts is not None:
        against = np.concatenate([against, _summed(turned, c, shifts).transpose(0, 2, 1)], axis=1)
    return own, against


def _evidence(inverse: Real, scale: Real, x: Real, n: int) -> tuple[Real, Real]:
    """Evidence of the two columns of each mode, cᵀ (inverse block)⁻¹ c, and the standard deviation of a."""
    coefficients = x * scale
    posterior: NDArray[np.float64] = np.einsum("pii->pi", inverse)
    i, j = np.arange(n), n + np.arange(n)
    p, q, m = posterior[:, i], posterior[:, j], inverse[:, i, j]
    u, v = coefficients[:, i], coefficients[:, j]
    return (q * u**2 - 2 * m * u * v + p * v**2) / np.maximum(p * q - m**2, 1e-300), np.sqrt(0.5 * p) / scale[:, :n]
