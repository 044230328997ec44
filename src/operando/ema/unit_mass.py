"""Real shapes of unit modal mass from the residues of given FRFs, with the covariance of everything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf
from operando.ema.frf_noise import stated_covariance
from operando.ema.linear import LinearFit
from operando.ema.pairs import Complex, Real

SMALL_SHARE = 0.1
"""Errors of small residues: this part of the proportional error of the largest one (a hit a little beside its point leaks in others)."""

SEEN = 3.0
"""A drive-point residue of less than so many standard deviations says nothing on the scale."""

FREE_STD = 20.0
"""Shape values that no data hold have a prior of so many times the mode's rms."""

UNSEEN_STD = 0.5
"""Relative standard deviation of the shape value at a drive point that is taken for the scale though its residue does not stand out."""

NEGATIVE_SHARE = 0.5


@dataclass(frozen=True)
class ModalCovariance:
    """Covariance of [f (Hz), ζ, shapes mode by mode], n·(2 + M) values: what the poles carry, and what residues add by themselves.

    The matrix itself is a hundred times as large where there are many places, so it is made where it is kept. ``carry`` (n·(2 + M), 2n) are
    derivatives by [ln f, ln ζ], ``poles`` the covariance of these, ``own`` (n, M, M) that of each shape at known poles.
    """

    carry: Real
    poles: Real
    own: Real

    def fill(self, out: Real, places: Sequence[slice], factors: Real) -> None:
        """Write the matrix of the values times ``factors`` into ``out``, where frequencies, damping ratios and shapes stand."""
        n, m = self.own.shape[:2]
        carry = factors[:, None] * self.carry
        half = carry @ self.poles
        parts = slice(n), slice(n, 2 * n), slice(2 * n, None)
        for i, rows in zip(parts, places, strict=True):
            for j, columns in zip(parts, places, strict=True):
                np.matmul(half[i], carry[j].T, out=out[rows, columns])
        shapes = out[places[2], places[2]]
        for r, (own, sign) in enumerate(zip(self.own, factors[2 * n :].reshape(n, m), strict=True)):
            shapes[r * m : (r + 1) * m, r * m : (r + 1) * m] += own * np.outer(sign, sign)

    def of_modes(self, modes: Sequence[int]) -> Real:
        """The matrix of some of the modes."""
        n, m = self.own.shape[:2]
        rows = np.concatenate([modes, [n + r for r in modes], *(2 * n + r * m + np.arange(m) for r in modes)]).astype(int)
        k = len(modes)
        out = np.empty((rows.size, rows.size))
        places = slice(k), slice(k, 2 * k), slice(2 * k, None)
        ModalCovariance(self.carry[rows], self.poles, self.own[list(modes)]).fill(out, places, np.ones(rows.size))
        return out


def tied_rows(frf: Frf) -> slice:
    """Rows of the shapes (responses, then references that are none) whose proportions the FRFs hold.

    All of them with a drive point. Without one a residue φ_o φ_i says how the responses move among themselves, and the references, and not
    one against the other: the shape is that of the side with more DOFs.
    """
    n = len(frf.responses)
    if frf.drive_points():
        return slice(None)
    return slice(n) if n >= len(frf.references) else slice(n, None)


def kept_parameters(n_terms: int, n_dofs: int, rows: slice) -> NDArray[np.int_]:
    """Where [f, ζ, shapes mode by mode] at some rows of the shapes stand among those of all."""
    at = 2 * n_terms + np.arange(n_terms * n_dofs).reshape(n_terms, n_dofs)[:, rows]
    return np.concatenate([np.arange(2 * n_terms), at.ravel()])


@dataclass(frozen=True)
class UnitMassShapes:
    """Shapes (M, n) with R_jk ≈ φ_j φ_k.

    ``scaled`` says whether a drive point gives the mode its scale; where none does the shape keeps an arbitrary one. ``drive`` has for each
    drive-point pair its residue over standard deviation (n,): positive, absent (|t| < 3) or negative.
    """

    shapes: Real
    scaled: NDArray[np.bool_]
    drive: tuple[tuple[int, Real], ...]
    covariance: ModalCovariance

    def at(self, rows: slice) -> UnitMassShapes:
        """The shapes at some of the DOFs, with their covariance."""
        known, (n, m) = self.covariance, self.covariance.own.shape[:2]
        carry, own = known.carry[kept_parameters(n, m, rows)], known.own[:, rows, rows]
        return replace(self, shapes=self.shapes[rows], covariance=ModalCovariance(carry, known.poles, own))


def turned_dofs(fit: LinearFit) -> NDArray[np.int_]:
    """DOFs whose drive-point residues are mostly negative over the modes: force and accelerometer there have opposite senses.

    Σ R|R| over the modes is assessed, each weighed by its certainty, so that a certain residue outweighs uncertain ones. Which of the two
    is wrong the FRFs cannot say; one sensor that stays explains all of its pairs, so all of them are reversed in polarity.
    """
    out, std = [], residue_std(fit)
    for p in fit.pairs.drive_points:
        value = fit.projection.a[p]
        weight = value**2 / (1 + (std[p] / np.maximum(np.abs(value), 1e-300)) ** 2)
        if np.sum(np.sign(value) * weight) < -NEGATIVE_SHARE * np.sum(weight):
            out.append(int(fit.pairs.staying[p]))
    return np.array(out, int)


def residue_std(fit: LinearFit) -> Real:
    """Standard deviations of the residues (P, n): of the fit over ν correlated lines, and the model error of the pair."""
    a, share = fit.projection.a, fit.variance.alpha[:, None]
    top = np.max(np.abs(a), axis=0, initial=0.0)
    return np.asarray(np.sqrt(fit.correlation * fit.projection.a_std**2 + (share * a) ** 2 + (SMALL_SHARE * share * top) ** 2))


def in_phase(fit: LinearFit) -> Complex:
    """Residues rotated by the mean phase of each mode, (P, n), which is 0 for real modes and not for those of local dampers.

    Shapes of unit modal mass are made of the real parts; the imaginary ones are what they leave out.
    """
    residues = fit.residues()
    weight = 1 / np.maximum(fit.projection.a_std, 1e-300) ** 2
    phase = 0.5 * np.angle(np.sum(weight * residues**2, axis=0))
    return np.asarray(residues * np.exp(-1j * phase))


def unit_mass_shapes(fit: LinearFit, n_dofs: int) -> UnitMassShapes:
    """Shapes by robust weighted least squares of R_jk = φ_j φ_k, with the uncertainty of residues and poles.

    All pairs of the fit have the right sense (:func:`turned_dofs`).
    """
    n = fit.n_modes
    rows, columns = fit.pairs.rows, fit.pairs.columns
    std, residues = residue_std(fit), in_phase(fit)
    shapes, scaled = np.zeros((n_dofs, n)), np.zeros(n, bool)
    poles = np.concatenate([fit.poles.hz, fit.poles.zeta])
    by_poles = np.zeros((n_dofs * n, 2 * n))
    own = np.zeros((n, n_dofs, n_dofs))
    for r in range(n):
        shape, scaled[r], gain, variance = _one_shape(rows, columns, residues[:, r].real, std[:, r], n_dofs)
        shapes[:, r] = shape
        by_poles[r * n_dofs : (r + 1) * n_dofs] = gain @ fit.projection.slope[:, r]
        own[r] = variance + _left_out(gain @ residues[:, r].imag, variance)
    # poles in Hz and as ratios; what they do to the shapes, and what the residues leave by themselves
    carry = np.concatenate([np.diag(poles), by_poles])
    covariance = ModalCovariance(carry, stated_covariance(fit), own)
    drive = tuple((int(p), fit.projection.a[p] / std[p]) for p in fit.pairs.drive_points)
    return UnitMassShapes(shapes, scaled, drive, covariance)


def _left_out(imaginary: Real, variance: Real) -> Real:
    """What the imaginary part of a shape adds to its covariance, (M, M): as a deviation of its size, without what noise alone makes of it.

    R_jk − φ_jφ_k = i(φ_jχ_k + χ_jφ_k): an error χ of the real shape would change |H| by as much.
    """
    power = float(imaginary @ imaginary)
    beyond = max(0.0, 1 - float(np.trace(variance)) / power) if power > 0 else 0.0
    return np.asarray(beyond * np.outer(imaginary, imaginary))


def _one_shape(
    rows: NDArray[np.int_], columns: NDArray[np.int_], residue: Real, std: Real, n_dofs: int, rounds: int = 40
) -> tuple[Real, bool, Real, Real]:
    """One shape, whether it is scaled, ∂φ/∂R (M, P) and its covariance (M, M).

    Gauss–Newton with soft-L1 weights: one wrong hit moves a residue by any amount, and must not move the others.
    """
    drive = np.flatnonzero(rows == columns)
    best = int(drive[np.argmax(residue[drive] / std[drive])]) if drive.size else -1
    scaled = best >= 0 and residue[best] > SEEN * std[best]
    # A drive point that hardly moves gives no scale, but says that it hardly moves: about as much as its residue is uncertain.
    phi = _start(rows, columns, residue, best, float(np.sqrt(max(residue[best], std[best]))), n_dofs)
    known = np.isin(np.arange(n_dofs), np.concatenate([rows, columns]))
    rms = float(np.sqrt(np.mean(phi[known] ** 2))) or 1.0
    prior = np.full(n_dofs, 1 / (FREE_STD * rms) ** 2)
    # A negative drive-point residue is no scale; it is told, and left out.
    use = ~((rows == columns) & (residue < 0))
    if not scaled:
        held = int(rows[best]) if best >= 0 else int(np.argmax(np.abs(phi)))
        prior[held] = 1 / (UNSEEN_STD * abs(phi[held]) + 1e-300) ** 2
    centre = phi.copy()
    size = residue.size
    # each residue changes with two shape values; at a drive point they are one
    ends = np.stack([rows, columns])
    cells = (ends[:, None] * n_dofs + ends[None, :]).ravel()
    for _ in range(rounds):
        rest = np.where(use, (residue - phi[rows] * phi[columns]) / std, 0.0)
        weight = use / np.sqrt(1 + rest**2)
        slopes = np.stack([phi[columns], phi[rows]]) / std
        products = (slopes[:, None] * slopes[None, :] * weight).ravel()
        normal = np.bincount(cells, products, n_dofs**2).reshape(n_dofs, n_dofs) + np.diag(prior)
        pull = np.bincount(ends.ravel(), (slopes * weight * rest).ravel(), n_dofs)
        if not scaled:
            pull -= prior * np.where(prior > 2 * prior.min(), phi - centre, 0.0)
        step = np.linalg.solve(normal, pull)
        step *= min(1.0, 0.5 * float(np.linalg.norm(phi)) / max(float(np.linalg.norm(step)), 1e-300))
        phi = phi + step
        if np.linalg.norm(step) < 1e-9 * np.linalg.norm(phi):
            break
    inverse = np.linalg.inv(normal)
    jacobian = np.zeros((size, n_dofs))
    for end, slope in zip(ends, slopes, strict=True):
        jacobian[np.arange(size), end] += slope
    gain = inverse @ (jacobian * weight[:, None]).T / std
    freedom = int(use.sum()) - int(known.sum())
    birge = max(1.0, float(np.sum(weight * rest**2) / freedom)) if freedom > 0 else 1.0
    return phi, bool(scaled), gain, birge * (gain * std) @ (gain * std).T


def _start(rows: NDArray[np.int_], columns: NDArray[np.int_], residue: Real, drive: int, scale: float, n_dofs: int) -> Real:
    """Shape values from the row and the column of one drive point; without one, from the strongest column at an arbitrary scale."""
    phi = np.zeros(n_dofs)
    if drive >= 0:
        centre = int(rows[drive])
    else:
        strength = {int(c): float(np.sum(residue[columns == c] ** 2)) for c in np.unique(columns)}
        strength |= {int(r): max(strength.get(int(r), 0.0), float(np.sum(residue[rows == r] ** 2))) for r in np.unique(rows)}
        centre = max(strength, key=lambda c: strength[c])
        scale = float(np.sqrt(np.max(np.abs(residue)))) or 1.0
    for mine, other in ((columns, rows), (rows, columns)):
        at = np.flatnonzero(mine == centre)
        phi[other[at]] = residue[at] / scale
    phi[centre] = scale
    # DOFs that share no pair with the centre follow from those that do.
    for _ in range(2):
        for mine, other in ((columns, rows), (rows, columns)):
            for d in np.flatnonzero(phi == 0):
                at = mine == d
                u = phi[other[at]]
                if np.any(u != 0):
                    phi[d] = float(u @ residue[at] / (u @ u))
    return phi
