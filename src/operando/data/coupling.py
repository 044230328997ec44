"""Damping that ties modes to each other: what makes them complex."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import frozen
from operando.data.objects import Shown, counted
from operando.errors import DataError

Array = NDArray[Any]


@dataclass(frozen=True, repr=False, eq=False)
class ModalCoupling(Shown):
    """Viscous damping that is not in proportion to stiffness and mass, as it ties the terms of a model of unit modal mass.

    In modal coordinates the damping matrix is then not diagonal (Rayleigh 1877, § 102). Between two terms of the model it is
    ``damping``; a mode that it ties to terms outside the band, which only follow, has the shape φ − iω·lag in the FRFs, exact to
    first order. Where frequencies and damping ratios of the model are those of its poles, what the diagonals of the modal damping and
    stiffness matrices have beside 2ζω and ω² stands on the diagonals here.

    Parameters
    ----------
    damping : (n_terms, n_terms) array
        Symmetric [1/s]; on its diagonal what is added to 2ζω.
    lag : (n_dofs, n_terms) array
        [s·kg^(−1/2)]
    stiffness : (n_terms,) array, optional
        What is added to ω² [1/s²]; default zero.

    Raises
    ------
    DataError
        If they do not belong together, or the damping is not symmetric.

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
    stiffness: Array | None = None

    def __post_init__(self) -> None:
        damping, lag = frozen(self.damping, float, 2, "damping"), frozen(self.lag, float, 2, "lag")
        object.__setattr__(self, "damping", damping)
        object.__setattr__(self, "lag", lag)
        n = lag.shape[1]
        if damping.shape != (n, n):
            raise DataError(f"damping between terms has shape {damping.shape}, lags have shape {lag.shape}: expected {(n, n)}")
        stiffness = frozen(np.zeros(n) if self.stiffness is None else self.stiffness, float, 1, "stiffness")
        object.__setattr__(self, "stiffness", stiffness)
        if stiffness.shape != (n,):
            raise DataError(f"stiffness beside that of {n} terms has shape {stiffness.shape}, expected {(n,)}")
        rounding = 1e-9 * np.abs(damping).max(initial=0.0)
        if np.abs(damping - damping.T).max(initial=0.0) > rounding:
            raise DataError("damping between terms is not symmetric", hint="what is not is a gyroscopic or circulatory effect")

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        n_dofs, n_terms = self.lag.shape
        return {"Terms": f"{counted(n_terms, 'term')} at {counted(n_dofs, 'DOF')}"}

    @property
    def beside(self) -> Array:
        """What is added to ω² of each term [1/s²]."""
        assert self.stiffness is not None  # filled when it was made
        return self.stiffness

    def select(self, terms: Array) -> ModalCoupling:
        """Of some of the terms, in that order."""
        return ModalCoupling(self.damping[np.ix_(terms, terms)], self.lag[:, terms], self.beside[terms])

    def at(self, dofs: Array, signs: Array) -> ModalCoupling:
        """At some of the DOFs (rows), with the signs of their senses."""
        return ModalCoupling(self.damping, self.lag[dofs] * signs[:, None], self.beside)

    def scaled(self, damping: float, stiffness: float) -> ModalCoupling:
        """Where all damping and all stiffness are so many times as large; what follows gives way less by as much."""
        return ModalCoupling(damping * self.damping, damping / stiffness * self.lag, stiffness * self.beside)

    def with_term(self, at: int) -> ModalCoupling:
        """With one term more before number ``at``, which nothing ties to the others."""
        damping = np.insert(np.insert(self.damping, at, 0.0, axis=0), at, 0.0, axis=1)
        return ModalCoupling(damping, np.insert(self.lag, at, 0.0, axis=1), np.insert(self.beside, at, 0.0))
