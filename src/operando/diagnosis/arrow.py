"""Least squares of unknowns that all rows share and unknowns of one channel each: an information matrix in the shape of an arrow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular

Array = NDArray[Any]

ROUNDING = 1e-13  # share of an information that its sums over some thousand values lose


@dataclass(frozen=True)
class Information:
    """JᵀJ of rows that fall into blocks, without the prior.

    ``shared`` (s, s) is of the unknowns that all blocks share; ``own`` (blocks, k, k) of those that one block has for
    itself; ``across`` (blocks, k, s) between both.
    """

    shared: Array
    across: Array
    own: Array

    @classmethod
    def of(cls, shared: Array, own: Array) -> Information:
        """From weighted derivatives of the rows, (blocks, rows, s) and (blocks, rows, k)."""
        turned = np.swapaxes(own, 1, 2)
        blocks, rows, s = shared.shape
        flat = shared.reshape(blocks * rows, s)
        return cls(flat.T @ flat, turned @ shared, turned @ own)  # of an array with itself half the work, in threads as well

    def __add__(self, other: Information) -> Information:
        return Information(self.shared + other.shared, self.across + other.across, self.own + other.own)

    def __mul__(self, factor: float) -> Information:
        return Information(factor * self.shared, factor * self.across, factor * self.own)

    @property
    def trace(self) -> float:
        return float(np.trace(self.shared) + np.trace(self.own, axis1=1, axis2=2).sum())

    def times(self, shared: Array, own: Array) -> tuple[Array, Array]:
        """The product with a vector, (s,) and (blocks, k)."""
        first = self.shared @ shared + np.tensordot(own, self.across, 2)
        return first, self.across @ shared + (self.own @ own[..., None])[..., 0]

    def quadratic(self, shared: Array, own: Array) -> float:
        """vᵀ (JᵀJ) v of a vector."""
        first, second = self.times(shared, own)
        return float(shared @ first + np.sum(own * second))


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of an arrow: own blocks first, then what they leave of the shared one."""

    inverse: Array  # (blocks, k, k): of the factors of the own blocks
    across: Array  # (blocks, k, s): inverse @ Information.across
    lower: Array  # (s, s)

    @classmethod
    def of(cls, information: Information, shared: Array, own: Array) -> Factor:
        """With the precisions of the prior, (s,) and (blocks, k); ``LinAlgError`` if the matrix is not finite or positive definite."""
        k = own.shape[1]
        # sums of squares: where these are finite, all is
        if not (np.isfinite(np.diagonal(information.shared)).all() and np.isfinite(np.diagonal(information.own, axis1=1, axis2=2)).all()):
            raise np.linalg.LinAlgError("derivatives are not finite")
        blocks = np.array(information.own)
        # what two large numbers lose when one is taken from the other must not make what is left negative
        blocks[:, np.arange(k), np.arange(k)] += own + ROUNDING * np.diagonal(information.own, axis1=1, axis2=2)
        inverse = np.linalg.inv(np.linalg.cholesky(blocks))
        across = inverse @ information.across
        flat = across.reshape(-1, across.shape[2])
        rest = information.shared - flat.T @ flat
        rest[np.diag_indices_from(rest)] += shared + ROUNDING * np.diag(information.shared)
        return cls(inverse, across, cholesky(rest, lower=True, check_finite=False))

    @property
    def half_log_determinant(self) -> float:
        diagonal = np.diagonal(self.inverse, axis1=1, axis2=2)
        return float(np.sum(np.log(np.diag(self.lower))) - np.sum(np.log(diagonal)))

    def whitened(self, shared: Array, own: Array) -> tuple[Array, Array]:
        """Factor⁻¹ of right sides, (s, n) and (blocks, k, n): their squares sum to bᵀ H⁻¹ b."""
        y = self.inverse @ own
        rest = shared - np.tensordot(self.across, y, ((0, 1), (0, 1)))
        return solve_triangular(self.lower, rest, lower=True, check_finite=False), y

    def solve(self, shared: Array, own: Array) -> tuple[Array, Array]:
        """H⁻¹ of one right side, (s,) and (blocks, k)."""
        y = (self.inverse @ own[..., None])[..., 0]
        rest = shared - np.tensordot(self.across, y, ((0, 1), (0, 1)))
        first = cho_solve((self.lower, True), rest, check_finite=False)
        second = np.swapaxes(self.inverse, 1, 2) @ (y - self.across @ first)[..., None]
        return first, second[..., 0]

    def root(self) -> Array:
        """R with R Rᵀ = H⁻¹, shared unknowns first, (s + blocks k, s + blocks k)."""
        s, (blocks, k) = len(self.lower), self.across.shape[:2]
        out = np.zeros((s + blocks * k, s + blocks * k))
        out[:s, :s] = solve_triangular(self.lower, np.eye(s), lower=True, check_finite=False).T
        turned = np.swapaxes(self.inverse, 1, 2)
        out[s:, :s] = -(turned @ (self.across @ out[:s, :s])).reshape(blocks * k, s)
        for block in range(blocks):
            at = slice(s + block * k, s + (block + 1) * k)
            out[at, at] = turned[block]
        return out

    def variances(self) -> tuple[Array, Array]:
        """Diagonal of H⁻¹, (s,) and (blocks, k)."""
        root = solve_triangular(self.lower, np.eye(len(self.lower)), lower=True, check_finite=False)
        spread = np.swapaxes(self.inverse, 1, 2) @ self.across @ root.T
        own = np.sum(self.inverse**2, axis=1) + np.sum(spread**2, axis=2)
        return np.sum(root**2, axis=0), own

    def of_rows(self, shared: Array, own: Array, at: slice = slice(None)) -> Array:
        """Variance j H⁻¹ jᵀ of rows of some blocks, (blocks, rows, s) and (blocks, rows, k) → (blocks, rows)."""
        y = self.inverse[at] @ np.swapaxes(own, 1, 2)
        rest = np.swapaxes(shared, 1, 2) - np.swapaxes(self.across[at], 1, 2) @ y
        s = rest.shape[1]
        left = solve_triangular(self.lower, np.moveaxis(rest, 1, 0).reshape(s, -1), lower=True, check_finite=False)
        return np.asarray(np.sum(y**2, axis=1) + np.sum(left**2, axis=0).reshape(len(rest), -1))

    def shared_covariance(self, first: int) -> Array:
        """H⁻¹ among the shared unknowns from ``first`` on."""
        unit = np.zeros((len(self.lower), len(self.lower) - first))
        unit[first:] = np.eye(len(self.lower) - first)
        root = solve_triangular(self.lower, unit, lower=True, check_finite=False)
        return np.asarray(root.T @ root)
