"""What an operational modal analysis keeps beside the modes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.oma.spectra import Spectra
from operando.stabilization import RejectedPole, Stabilization


@dataclass(frozen=True)
class OmaDetails:
    """How the modes were found.

    Parameters
    ----------
    stabilization : Stabilization
        Diagram, selection and rejected poles; its indicator are the first singular values of the output PSD.
    harmonics_hz : (k,) array
        Sinusoids found in (or named for) the records and kept out of the modes [Hz].
    spectra : Spectra
        ``frequencies_hz`` (k,), ``singular_values`` (n_curves, k).
    second_opinion : tuple of dict, optional
        One row a mode: ``frequency_hz``, ``other_frequency_hz``, ``damping_ratio``, ``other_damping_ratio``, ``mac``, ``agrees``, ``text``.
    model_orders : (n,) int array
        Model order each mode was taken from.
    settings : dict
        All settings as used, defaults filled in.
    halves : tuple of ModalModel
        Modes of the first and of the second half of the record, identified apart (``fit_halves``); empty where nobody asked.
    """

    stabilization: Stabilization
    harmonics_hz: NDArray[np.float64]
    spectra: Spectra
    second_opinion: tuple[dict[str, Any], ...] | None = None
    model_orders: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, int))
    settings: dict[str, Any] = field(default_factory=dict)
    halves: tuple[ModalModel, ...] = ()

    @property
    def rejected(self) -> tuple[RejectedPole, ...]:
        """Candidates that were not taken, with reasons."""
        return self.stabilization.rejected
