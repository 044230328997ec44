"""Another day than that of the idle model: what FRFs of that day say of it, and what they leave open in the records."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, TimeRecord
from operando.structure.modal_space import Complex, Modes, Real

Seen = Callable[[Real, NDArray[np.int_], Sequence[int]], Complex | None]
"""Accelerances (L, q, k) on lines [Hz] that the sensors at rows of the idle model show, with forces at other rows and nothing missing."""


@dataclass(frozen=True)
class Day:
    """The idle model of m DOFs on the day of a validation measurement, as FRFs of that day have it.

    Attributes
    ----------
    idle : ModalModel
        Its frequencies, damping and shapes on that day.
    shown : (m, terms) array
        Shapes as the sensors show them, which were put back elsewhere and askew.
    shown_std : (m, n) array
        Their standard deviations in the n modes of the band, beside a gain.
    modes : (n,) array
        Terms of the idle model in the band.
    covariance : (2n, 2n) array
        Of ln f and then of ln ζ of these.
    sensor_gains, sensor_std : (m,) arrays
        What sensors show over what there is, and relative standard deviations.
    force_gains : dict
        The same of the forces, by rows of the idle model.
    driven : dict
        Shapes (terms,) under which the forces drive, by rows of the idle model: they were put back elsewhere and askew, too.
    force_std : float
        Relative, in the mean over the forces.
    springs : dict
        Standard deviations of a spring [N/m] and a damper [N·s/m] that were fitted with this day, by the rows of their location in order.
        FRFs know the one with the other: as far as these go the day may be another one, with another spring there.
    seen : callable
        Accelerances without these gains; None where no FRF shows one of them.
    between : tuple of dict
        All that differs, as ``between`` of ``diagnosis.json``.
    unexplained : float
        Share of the FRFs that stays unexplained.
    """

    idle: ModalModel
    shown: Real
    shown_std: Real
    modes: NDArray[np.int_]
    covariance: Real
    sensor_gains: Real
    sensor_std: Real
    force_gains: dict[int, float]
    driven: dict[int, Real]
    force_std: float
    springs: dict[tuple[int, ...], tuple[float, float]]
    seen: Seen
    between: tuple[dict[str, Any], ...] = ()
    unexplained: float = float("inf")

    def corrected(self, record: TimeRecord) -> TimeRecord:
        """A record without the gains of its channels."""
        known = {d.key: i for i, d in enumerate(self.idle.dofs)}
        forces, gains = set(record.force_indices), np.ones(len(record.channels))
        for k, channel in enumerate(record.channels):
            at = None if channel.dof is None else known.get(channel.dof.key)
            if at is not None:
                gains[k] = self.force_gains.get(at, 1.0) if k in forces else self.sensor_gains[at]
        return replace(record, data=np.asarray(record.data, float) / gains[:, None])

    def slopes(self, terms: Modes, kernel: Complex, accelerations: Complex, hz: Real) -> Complex:
        """Modal accelerations (2n, L) that follow a relative change of each frequency, then of each damping ratio.

        ``kernel`` and ``accelerations`` (terms, L) are receptances and the accelerations of the modes under all forces that act.
        """
        w, w0 = 2 * np.pi * hz, 2 * np.pi * terms.hz[self.modes, None]
        loss = 2j * terms.zeta[self.modes, None] * w0 * w
        follows = -kernel[self.modes] * accelerations[self.modes]
        return np.concatenate([follows * (2 * w0**2 + loss), follows * loss])


def powers(unit: str) -> tuple[int, int]:
    """Powers of metre and of newton in a unit as ``N s2/m2``."""
    out = {"m": 0, "N": 0}
    for sign, part in zip((1, -1), (*unit.split("/"), "")[:2], strict=True):
        for name, power in re.findall(r"([A-Za-z]+)(\d*)", part):
            if name in out:
                out[name] += sign * int(power or 1)
    return out["m"], out["N"]
