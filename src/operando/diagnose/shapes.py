"""What the idle model does not know about the places of effects: directions in which its shapes may move when effects are fitted.

The undriven columns H0[:, b] of a place b hang on shape values that no drive point has seen: those of modes outside the band, and
those of modes in the band up to a factor that the driven columns leave open (a mode hardly seen from the reference: shape large, drive
point small, or the other way round). Both stand in the idle model's covariance. A direction moves the shapes at the place, and all
other shape values as they are expected to move with them, so that what the driven columns have shown stays as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.diagnose.predict import Prediction
from operando.diagnose.sets import CheckLines

Array = NDArray[Any]

KEPT = 1e-10
"""Directions of the prior below this share of the largest variance of one DOF are left out: they are known."""

TOLD = 0.1
"""Directions whose variance the lines would lower by less than about this part are not fitted."""

MOST = 36
"""Directions fitted at most."""

KNOWN = 0.3
"""A DOF counts as driven where its compliance from outside the band is known to better than this part."""

TOGETHER = 0.5
"""Part of the relative variance of a mode's shape that must go together to be called its scale."""

FARTHEST = 3.0
"""A mode's scale moves by no more than this, on a logarithmic scale."""


@dataclass(frozen=True)
class Scales:
    """How shapes move along directions: each mode's scale by a factor, what is left by a sum.

    A mode that the drive points hardly see has products φ_i·φ_j known well with j driven, but not its scale: φ_j·e^t and φ_i·e^−t leave
    them as they were measured. A sum would do so for small t only: fits crept along a bent valley and ended far from its floor.

    Parameters
    ----------
    row : (n_modes,) int array
        DOF whose relative move is taken for that of the scale.
    sense : (n_dofs, n_modes) array
        1 where values grow with that at ``row``, −1 where they shrink; 0 for modes that move by sums alone.
    """

    row: Array
    sense: Array

    @classmethod
    def of(cls, idle: ModalModel) -> Scales:
        """Of an idle model with covariance: a mode's scale moves where relative errors of most of its values go together."""
        assert idle.covariance is not None
        phi, n = np.asarray(idle.terms.shapes), idle.terms.n
        m = len(phi)
        row, sense = np.zeros(n, int), np.zeros((m, n))
        for mode in range(idle.n_modes):
            own = slice(2 * n + mode * m, 2 * n + (mode + 1) * m)
            block = idle.covariance[own, own]
            spread = np.sqrt(np.maximum(np.diag(block), 0))
            if not np.any(spread > 0):
                continue
            unit = np.divide(np.sign(phi[:, mode]), spread, out=np.zeros(m), where=spread > 0)
            values, vectors = np.linalg.eigh(block * unit[:, None] * unit)
            if values[-1] > TOGETHER * np.sum(values):
                common = vectors[:, -1]
                row[mode] = int(np.argmax(np.abs(common * phi[:, mode])))
                sense[:, mode] = np.where(common * common[row[mode]] >= 0, 1.0, -1.0)
        return cls(row, sense)

    @classmethod
    def none(cls, shape: tuple[int, int]) -> Scales:
        """Of shapes (n_dofs, n_modes) that move by sums alone."""
        return cls(np.zeros(shape[1], int), np.zeros(shape))

    def parts(self, base: Array, moves: Array) -> tuple[Array, Array]:
        """Logarithmic scales (n_modes, …) and the rest (n_dofs, n_modes, …) of moves of the shapes (n_dofs, n_modes, …)."""
        modes = np.arange(self.row.size)
        own = np.where(np.any(self.sense != 0, axis=0), base[self.row, modes], np.inf)
        extra = (1,) * (moves.ndim - 2)
        scale = moves[self.row, modes] / own.reshape(-1, *extra)
        return scale, moves - (self.sense * base).reshape(*base.shape, *extra) * scale[None]

    def moved(self, base: Array, move: Array) -> Array:
        """Shapes (n_dofs, n_modes) after one move."""
        scale, rest = self.parts(base, move)
        return np.asarray(self.factor(scale) * (base + rest))

    def move(self, base: Array, shapes: Array) -> Array:
        """The move after which the shapes are these: :meth:`moved` the other way round."""
        modes = np.flatnonzero(np.any(self.sense != 0, axis=0))
        scale = np.zeros(self.row.size)
        grown = shapes[self.row[modes], modes] / base[self.row[modes], modes]
        scale[modes] = np.clip(np.log(np.maximum(grown, 1e-9)), -FARTHEST, FARTHEST)
        return np.asarray(shapes / self.factor(scale) - base + self.sense * base * scale)

    def factor(self, scale: Array) -> Array:
        """What the values of shapes (n_dofs, n_modes) are multiplied by."""
        return np.asarray(np.exp(self.sense * np.clip(scale, -FARTHEST, FARTHEST)))

    def slope(self, base: Array, moves: Array, move: Array) -> Array:
        """∂φ of moves along each of ``moves`` (n_dofs, n_modes, k) where the shapes have gone ``move``."""
        scale, rest = self.parts(base, move)
        scales, rests = self.parts(base, moves)
        factor = self.factor(scale)
        here = self.sense * factor * (base + rest)
        return np.asarray(factor[:, :, None] * rests + here[:, :, None] * scales[None])


@dataclass(frozen=True)
class ShapePrior:
    """Directions in which shapes may move.

    Parameters
    ----------
    base : (n_dofs, n_modes) array
        Shapes of the idle model.
    root : (n_dofs, n_modes, k) array
        Move of each shape value for unit z; z has unit variance before the fit.
    told : (n_dofs·n_modes, k) array
        z of given errors of the shapes (mode by mode, as in the covariance): z = toldᵀ δφ.
    scales : Scales
    scale : float
        What ``root`` was widened by where the covariance had proved too sure of itself.
    """

    base: Array
    root: Array
    told: Array
    scales: Scales
    scale: float = 1.0

    @property
    def size(self) -> int:
        """Number of directions."""
        return int(self.root.shape[2])

    def moved(self, z: Array) -> Array:
        """Shapes with these directions moved."""
        return self.scales.moved(self.base, self.root @ z) if self.size else self.base

    def slope(self, z: Array) -> Array:
        """∂φ/∂z, (n_dofs, n_modes, k)."""
        return self.scales.slope(self.base, self.root, self.root @ z) if self.size else self.root

    def widened(self, by: float) -> ShapePrior:
        """Directions of larger spread."""
        return replace(self, root=self.root * by, scale=self.scale * by)

    def turned(self, matrix: Array) -> ShapePrior:
        """Other orthonormal directions (columns of ``matrix``) of the same spread."""
        return replace(self, root=self.root @ matrix, told=self.told @ matrix)

    def bare(self) -> ShapePrior:
        """No directions at all."""
        return replace(self, root=self.root[:, :, :0], told=self.told[:, :0])


def shape_prior(idle: ModalModel, dofs: Array) -> ShapePrior:
    """Directions of the shapes at some DOFs, from the idle model's covariance (none without one).

    Parameters
    ----------
    idle : ModalModel
    dofs : int array
        Rows of the idle model that effects act at.
    """
    dofs = np.asarray(dofs, int)
    n, m = idle.terms.n, len(idle.dofs)
    base = np.array(idle.terms.shapes)
    if idle.covariance is None or dofs.size == 0:
        return ShapePrior(base, np.zeros((m, n, 0)), np.zeros((m * n, 0)), Scales.none((m, n)))
    shapes = given_driven(idle)
    index = (np.arange(n)[None, :] * m + dofs[:, None]).ravel()
    values, vectors = np.linalg.eigh(shapes[np.ix_(index, index)])
    keep = values > KEPT * max(float(values[-1]), 1e-300)
    told = np.zeros((n * m, int(keep.sum())))
    told[index] = vectors[:, keep] / np.sqrt(values[keep])
    root = (shapes @ told).reshape(n, m, -1).transpose(1, 0, 2)
    return ShapePrior(base, np.ascontiguousarray(root), told, Scales.of(idle))


def own_compliances(prior: ShapePrior, rows: Array) -> Array:
    """Orthonormal directions of z, a column each, that change what the own residual modes of some DOFs add to their compliance.

    Parameters
    ----------
    prior : ShapePrior
    rows : int array
    """
    alone = (np.count_nonzero(prior.base, axis=0) == 1) & np.any(prior.base[rows] != 0, axis=0)
    moves = []
    for mode in np.flatnonzero(alone):
        move = np.zeros_like(prior.base)
        move[:, mode] = prior.base[:, mode]
        moves.append(move.T.ravel() @ prior.told)
    if not moves or not prior.size:
        return np.zeros((prior.size, 0))
    left, size, _ = np.linalg.svd(np.array(moves).T, full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * size[0]])


def driven_rows(idle: ModalModel) -> Array:
    """DOFs whose own compliance outside the band is known: those that were driven.

    All others have a residual mode of their own, of no value and no variance at any driven DOF; in a model without such modes, a DOF
    counts as driven where its compliance is known well.
    """
    assert idle.covariance is not None
    n, m = idle.terms.n, len(idle.dofs)
    outside = np.flatnonzero(idle.terms.residual)
    psi = np.asarray(idle.terms.shapes)[:, outside]
    variance = np.diag(idle.covariance)[2 * n :].reshape(n, m).T[:, outside]
    moves = (psi != 0) | (variance > 0)
    local = np.any(moves, axis=0) & ~np.all(moves, axis=0)
    if local.any():
        return np.flatnonzero(~np.any(moves[:, local], axis=1))
    # Σ ψ²/ω² and its derivative: the static compliance of what lies outside, by its size alone.
    top = np.max(idle.frequencies_hz, initial=0.0)
    gain = 1 / np.maximum(np.abs(idle.terms.frequencies_hz[outside] ** 2 - top**2), 1e-300)
    out = []
    for row in range(m):
        index = 2 * n + outside * m + row
        slope = 2 * psi[row] * gain
        std = float(np.sqrt(max(slope @ idle.covariance[np.ix_(index, index)] @ slope, 0.0)))
        if std < KNOWN * float(np.sum(psi[row] ** 2 * gain)):
            out.append(row)
    return np.array(out, int)


def given_driven(idle: ModalModel) -> Array:
    """Covariance of the shapes given the values outside the band at driven DOFs.

    A residual mode's share of a driven column is the product of a value there and one elsewhere. With the former held it is linear in
    the latter: moves, however large, then leave the driven columns as they were measured.
    """
    assert idle.covariance is not None
    n, m = idle.terms.n, len(idle.dofs)
    shapes = np.array(idle.covariance[2 * n :, 2 * n :])
    held = (np.flatnonzero(idle.terms.residual)[None, :] * m + driven_rows(idle)[:, None]).ravel()
    if held.size:
        across = shapes[:, held]
        shapes -= across @ np.linalg.pinv(shapes[np.ix_(held, held)], rcond=1e-10, hermitian=True) @ across.T
        shapes[held] = 0
        shapes[:, held] = 0
    return shapes


def by_directions(p: Prediction, lines: CheckLines, slope: Array) -> Array:
    """∂H/∂z for moves of all shapes together, (k, lines, responses, references).

    With A = I − H0_·B·T·Bᵀ on the left and its mirror image on the right, dH = A·dH0·A'.
    """
    _, n, size = slope.shape
    count, n_o, n_j = lines.hz.size, lines.responses.size, lines.references.size
    at = p.rows @ p.phi[:, :n]
    psi = (p.phi[lines.responses, :n][None] - p.left @ at) * p.kernel[:, None, :n]
    chi = (p.phi[lines.references, :n].T[None] - at.T @ p.right) * p.kernel[:, :n, None]
    # A differs from I by as many terms as the effects have coordinates: the products over modes are real matrix products of
    # what moves at the responses (or references) and at these coordinates.
    at_rows = np.tensordot(p.rows, slope, 1)
    moved_o = np.concatenate([slope[lines.responses], at_rows])
    moved_j = np.concatenate([slope[lines.references], at_rows])
    over_o = _product(moved_o.transpose(0, 2, 1).reshape(-1, n), chi.transpose(1, 0, 2).reshape(n, -1))
    over_o = over_o.reshape(n_o + len(at_rows), size, count, n_j)
    over_j = _product(psi.reshape(-1, n), moved_j.transpose(1, 0, 2).reshape(n, -1)).reshape(count, n_o, len(moved_j), size)
    out = np.ascontiguousarray(over_o[:n_o].transpose(1, 2, 0, 3))
    out += over_j[:, :, :n_j].transpose(3, 0, 1, 2)
    left, right = p.left.astype(np.complex64), p.right.astype(np.complex64)
    for c in range(len(at_rows)):
        out -= left[None, :, :, c, None] * over_o[n_o + c][:, :, None, :]
        out -= over_j[:, :, n_j + c].transpose(2, 0, 1)[..., None] * right[None, :, c][:, :, None, :]
    if not np.array_equal(p.order, np.arange(p.order.size)):
        out = out[:, :, p.order]
    return out if p.factor is None else out * p.factor.astype(np.complex64)


def _product(a: Array, b: Array) -> Array:
    """a @ b of one real and one complex matrix, as one real product in single precision: these are steps of a search."""
    rows, columns = a.shape[0], b.shape[1]
    out = np.empty((rows, columns), np.complex64)
    if np.iscomplexobj(a):
        both = np.concatenate([a.real, a.imag]).astype(np.float32) @ b.astype(np.float32)
        out.real, out.imag = both[:rows], both[rows:]
    else:
        both = a.astype(np.float32) @ np.concatenate([b.real, b.imag], axis=1).astype(np.float32)
        out.real, out.imag = both[:, :columns], both[:, columns:]
    return out


def told_by(prior: ShapePrior, weighted: Array, start: Array) -> tuple[ShapePrior, Array]:
    """The directions that the lines say something about and that of the start, and the matrix that turned them.

    Parameters
    ----------
    prior : ShapePrior
    weighted : (k, n) complex array
        ∂H/∂z over the standard deviation of each line.
    start : (k,) array
        z from which a fit begins.
    """
    information = 2 * np.real(weighted.conj() @ weighted.T)
    values, vectors = np.linalg.eigh(information)
    keep = np.flatnonzero(values > TOLD)[::-1][:MOST]
    turn = vectors[:, keep]
    rest = start - turn @ (turn.T @ start)
    length = float(np.linalg.norm(rest))
    if length > 0.01:
        turn = np.c_[turn, rest / length]
    return prior.turned(turn), turn
