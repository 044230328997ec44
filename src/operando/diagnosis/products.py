"""Products over lines that the forward model of the diagnosis is made of."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Compliance:
    """Modal displacement over modal force (lines, terms, terms): a diagonal, and modes that damping or stiffness between them couple."""

    def __init__(self, diagonal: Array, modes: Array | None = None, coupled: Array | None = None) -> None:
        self.diagonal, self.modes, self.coupled = diagonal, modes, coupled

    def after(self, left: Array) -> Array:
        """left (…, DOFs, terms) @ compliance."""
        out = np.asarray(left * self.diagonal[:, None])
        if self.coupled is not None:
            out[..., self.modes] = left[..., self.modes] @ self.coupled
        return out

    def before(self, right: Array) -> Array:
        """compliance @ right (…, terms, columns)."""
        out = np.asarray(self.diagonal[:, :, None] * right)
        if self.coupled is not None:
            out[:, self.modes] = self.coupled @ right[..., self.modes, :]
        return out


def laid(value: Array, b: list[int], size: int) -> Array:
    """Dynamic stiffness (lines, places, places) among all touched DOFs."""
    full = np.zeros((len(value), size, size), complex)
    full[:, np.array(b)[:, None], b] = value
    return full


def times(values: Array, real: Array) -> Array:
    """Values (…, k) by a real matrix (k, q)."""
    flat = values.reshape(math.prod(values.shape[:-1]), values.shape[-1])
    out = np.empty((len(flat), real.shape[1]), complex)
    out.real, out.imag = flat.real @ real, flat.imag @ real
    return out.reshape(*values.shape[:-1], real.shape[1])


def through(at: Array, reached: Array, there: Array) -> Array:
    """What shows at each DOF (lines, DOFs, references, n), and through the effects what shows at the touched ones."""
    if not reached.shape[2]:
        return at
    n, dofs = reached.shape[:2]
    return at + (reached @ there.reshape(n, there.shape[1], -1)).reshape(n, dofs, *at.shape[2:])


def motion(reached: Array, here: list[int], dof: int, dofs: int) -> Array:
    """Motion (lines, DOFs) that a unit motion of one DOF brings about."""
    out = np.zeros((reached.shape[0], dofs), complex)
    out[:, dof] = 1
    if dof in here:
        out += reached[:, :, here.index(dof)]
    return out


def each_dof(kt: Array, own: Array) -> Array:
    """kt (lines, references, terms) by own (DOFs, terms, k): (lines, DOFs, references, k)."""
    dofs, terms, k = own.shape
    by_dof = times(kt, np.swapaxes(own, 0, 1).reshape(terms, dofs * k))
    return np.swapaxes(by_dof.reshape(*kt.shape[:2], dofs, k), 1, 2)
