"""Operational modes that nobody found, told by what the found ones leave of the idle modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel
from operando.data.arrays import ByContent
from operando.errors import IdentificationError

WHOLE = 0.5
"""A combination of idle modes counts as a mode nobody found where more than this part of it is in no operational mode."""

DEPENDENT = 0.3
"""Singular value below which operational participations count as dependent."""

BEYOND = 1.1
"""Such a mode is put beyond the band by this factor; its logarithm is the standard deviation, too."""


@dataclass(frozen=True, eq=False)
class Missing(ByContent):
    """Modes beyond the band, at ``hz``, that stand for what was not found: ``mixture`` (n_idle, k) is the amount of each idle mode in each.

    ``idle_hz`` are the idle modes they are mostly made of.
    """

    mixture: NDArray[np.float64]
    hz: NDArray[np.float64]
    idle_hz: tuple[float, ...]

    @property
    def text(self) -> str:
        """In words."""
        made, place = (", ".join(f"{f:.1f}" for f in hz) for hz in (self.idle_hz, self.hz))
        return f"{self.hz.size} mode(s) of what idle modes at {made} Hz hold together, put at {place} Hz"

    @property
    def finding(self) -> Finding | None:
        """What to tell, None where nothing is missing."""
        if not self.hz.size:
            return None
        return Finding(
            "mode_not_found",
            "the operational modes found leave out what idle modes at " + ", ".join(f"{f:.1f}" for f in self.idle_hz) + " Hz hold together",
            "warning",
            consequence=f"{self.text}: where it lies beyond the band, and its shape, is hardly known, which the bands include",
            action="identify the operational modes in a wider band",
        )


def missing_modes(
    participation: NDArray[np.float64],
    idle_hz: NDArray[np.float64],
    held: NDArray[np.int_],
    band_hz: tuple[float, float] | None,
    rising: bool,
) -> Missing:
    """Combinations of idle modes that must be in operational modes which were not found.

    All operational modes together are a basis of the space of the idle ones (:func:`operando.scaling.carried.part_left`), so what the found
    ones leave of a combination of idle modes is in others. Those were not found in the band, so they are put beyond it: the upper end where
    frequencies rose, the lower one where they fell. Where exactly, and with which shape, is not known. ``held`` are idle modes proper that
    are not carried over by themselves; without a band in which operational modes were looked for all are left out.
    """
    if not np.all(np.isfinite(participation)):
        raise IdentificationError(
            "the operational shapes have no finite part in the idle modes",
            hint="check the units and sensitivities of the channels of both states",
        )
    unit = participation / np.maximum(np.linalg.norm(participation, axis=0), 1e-300)
    left, size, _ = np.linalg.svd(unit, full_matrices=False)
    basis = left[held][:, size > DEPENDENT]
    value, vector = np.linalg.eigh(np.eye(held.size) - basis @ basis.T)
    found = value > WHOLE
    if band_hz is None or not np.any(found):
        return Missing(np.zeros((idle_hz.size, 0)), np.zeros(0), ())
    mixture = np.zeros((idle_hz.size, int(np.sum(found))))
    mixture[held] = vector[:, found] * np.sqrt(value[found])
    place = band_hz[1] * BEYOND if rising else band_hz[0] / BEYOND
    mostly = idle_hz[np.any(mixture**2 > 0.1, axis=1)]
    return Missing(mixture, np.full(mixture.shape[1], place), tuple(float(f) for f in mostly))


def with_missing(model: ModalModel, missing: Missing, idle_shapes: NDArray[np.float64]) -> ModalModel:
    """The model with those modes as further residual terms; their shapes as uncertain as they are large."""
    k = missing.hz.size
    if k == 0:
        return model
    shapes = idle_shapes @ missing.mixture
    terms, m = model.terms, len(model.dofs)
    n = terms.n
    covariance: NDArray[Any] | None = None
    if model.covariance is not None:
        total = n + k
        covariance = np.zeros((total * (2 + m), total * (2 + m)))
        old = np.concatenate([np.arange(n), total + np.arange(n), 2 * total + np.arange(n * m)])
        covariance[np.ix_(old, old)] = model.covariance
        hz = n + np.arange(k)
        covariance[hz, hz] = (np.log(BEYOND) * missing.hz) ** 2
        values = 2 * total + n * m + np.arange(k * m)
        covariance[values, values] = np.repeat(np.mean(shapes**2, axis=0), m)
    return model.with_terms(
        frequencies_hz=np.concatenate([terms.frequencies_hz, missing.hz]),
        damping_ratios=np.concatenate([terms.damping_ratios, np.full(k, np.median(terms.damping_ratios))]),
        shapes=np.concatenate([terms.shapes, shapes], axis=1),
        covariance=covariance,
    )
