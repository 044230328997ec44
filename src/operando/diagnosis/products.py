"""Products over lines that the forward model of the diagnosis is made of."""

from __future__ import annotations

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


class Rows:
    """How values of all pairs on the lines become independent rows: combinations of lines, or each line by a weight.

    ``basis`` is (responses, references, rows, lines), ``weights`` (lines, responses, references).
    """

    def __init__(self, basis: Array | None = None, weights: Array | None = None) -> None:
        self.basis, self.weights = basis, weights

    def of_responses(self, at: slice) -> Rows:
        """Those of some responses."""
        return Rows(None if self.basis is None else self.basis[at], None if self.weights is None else self.weights[:, at])

    def of(self, planes: Array) -> Array:
        """Of real and imaginary parts (responses, references, 2, lines, k), which may be changed: (responses, references, 2, rows, k)."""
        if self.weights is not None:
            planes *= np.moveaxis(self.weights, 0, 2)[:, :, None, :, None]
        return planes if self.basis is None else np.asarray(self.basis[:, :, None] @ planes)

    def flat(self, values: Array) -> Array:
        """Values (lines, responses, references, k) as rows (responses, rows, k), real and imaginary parts side by side."""
        laid = np.moveaxis(values, 0, 2)
        made = np.moveaxis(self.of(np.stack([laid.real, laid.imag], 2)), 2, 3)
        return made.reshape(len(made), -1, values.shape[3])
