"""FRFs of the model with level-dependent effects at levels of the force that were not measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from operando.data import Frf, ModalModel
from operando.diagnose.model import Model
from operando.dof import parse_dofs
from operando.effects import Effect
from operando.nonlinear.levels import at_level


def level_frf(
    idle: ModalModel,
    effects: Sequence[Effect],
    level: float,
    frequencies: ArrayLike,
    responses: Any = None,
    references: Any = None,
    quantity: str = "accelerance",
    *,
    band: tuple[float, float] | None = None,
) -> Frf:
    """What an FRF measurement would find under a random force of this size: the best linear model of the running structure there.

    Each reference is driven by itself; level-dependent effects stand in its column as the spring and damper that they are equivalent to
    then (:func:`operando.nonlinear.at_level`).

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent effects, springs and dampers.
    level : float
        rms of the force [N], even over the band.
    frequencies : array
        Lines [Hz].
    responses, references : DOF labels, optional
        Default: all DOFs of the idle model.
    quantity : {"accelerance", "mobility", "receptance"}
    band : (float, float), optional
        Of the force [Hz]; default the idle model's.

    Returns
    -------
    Frf

    Raises
    ------
    DataError
        If no steady motion is found at this level.
    ConfigError
        If an effect has no restoring force of displacement and velocity.
    """
    driven = idle.dofs if references is None else tuple(parse_dofs(references))
    columns: list[Frf] = []
    with threadpool_limits(1, "blas"):
        for reference in driven:
            standing = at_level(idle, effects, level, reference, band)
            columns.append(Model(idle, tuple(standing)).frf(frequencies, responses, (reference,), quantity, variance=False))
    return replace(columns[0], data=np.concatenate([c.data for c in columns], axis=1), references=driven)
