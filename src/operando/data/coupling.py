"""Damping that ties modes to each other: what makes them complex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import frozen
from operando.errors import DataError

Array = NDArray[Any]


@dataclass(frozen=True)
class ModalCoupling:
    """Viscous damping that is not in proportion to stiffness and mass, as it ties the terms of a model of unit modal mass.

    In modal coordinates the damping matrix is then not diagonal (Rayleigh 1877, § 102). Between two terms of the model it is
    ``damping``; a mode that it ties to terms outside the band, which only follow, has the shape φ − iω·lag in the FRFs, exact to
    first order.

    Parameters
    ----------
    damping : (n_terms, n_terms) array
        Symmetric, zero on its diagonal [1/s].
    lag : (n_dofs, n_terms) array
        [s·kg^(−1/2)]

    Raises
    ------
    DataError
        If the two do not belong together, or the damping is not symmetric or has a diagonal.

    Examples
    --------
    >>> import numpy as np, operando
    >>> tie = operando.ModalCoupling(np.array([[0, 3.0], [3.0, 0]]), np.zeros((1, 2)))
    >>> model = operando.ModalModel([10, 11], [0.01, 0.01], np.ones((1, 2)), "1+Z", "unit_modal_mass", coupling=tie)
    >>> apart = operando.ModalModel([10, 11], [0.01, 0.01], np.ones((1, 2)), "1+Z", "unit_modal_mass")
    >>> bool(abs(model.frf([10.0]).data) < abs(apart.frf([10.0]).data))
    True
    """

    damping: Array
    lag: Array

    def __post_init__(self) -> None:
        damping, lag = frozen(self.damping, float, 2, "damping"), frozen(self.lag, float, 2, "lag")
        object.__setattr__(self, "damping", damping)
        object.__setattr__(self, "lag", lag)
        n = lag.shape[1]
        if damping.shape != (n, n):
            raise DataError(f"damping between terms has shape {damping.shape}, lags have shape {lag.shape}: expected {(n, n)}")
        rounding = 1e-9 * np.abs(damping).max(initial=0.0)
        if np.abs(damping - damping.T).max(initial=0.0) > rounding or np.diagonal(damping).any():
            raise DataError("damping between terms is not symmetric, or not zero on its diagonal", hint="a term's own is its damping ratio")

    def select(self, terms: Array) -> ModalCoupling:
        """Of some of the terms, in that order."""
        return ModalCoupling(self.damping[np.ix_(terms, terms)], self.lag[:, terms])

    def at(self, dofs: Array, signs: Array) -> ModalCoupling:
        """At some of the DOFs (rows), with the signs of their senses."""
        return ModalCoupling(self.damping, self.lag[dofs] * signs[:, None])

    def scaled(self, damping: float, stiffness: float) -> ModalCoupling:
        """Where all damping and all stiffness are so many times as large; what follows gives way less by as much."""
        return ModalCoupling(damping * self.damping, damping / stiffness * self.lag)

    def with_term(self, at: int) -> ModalCoupling:
        """With one term more before number ``at``, which nothing ties to the others."""
        damping = np.insert(np.insert(self.damping, at, 0.0, axis=0), at, 0.0, axis=1)
        return ModalCoupling(damping, np.insert(self.lag, at, 0.0, axis=1))
