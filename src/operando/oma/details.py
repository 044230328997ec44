"""What an operational modal analysis keeps beside the modes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel, Short, counted, names_text
from operando.data.arrays import ByContent
from operando.oma.spectra import Spectra
from operando.stabilization import RejectedPole, Stabilization


@dataclass(frozen=True, eq=False)
class SetUp(ByContent):
    """One set-up of a merged analysis: its sensors, those that another one measures, too, its modes, and the merged mode each belongs to.

    ``merged`` (n,) is −1 where a mode was left out, and ``reasons`` say why; ``failed`` says why the whole set-up is not used. NaN where
    there is no standard deviation.
    """

    name: str
    sensors: tuple[str, ...]
    shared: tuple[str, ...]
    frequencies_hz: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    frequency_std_hz: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    damping_ratios: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    damping_ratio_std: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    merged: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, int))
    reasons: tuple[str, ...] = ()
    stabilization: Stabilization | None = None
    failed: str = ""

    def to_dict(self) -> dict[str, Any]:
        """JSON object: sensors, modes with the merged mode each belongs to (null where to none), why it failed (null where not)."""
        return {
            "name": self.name,
            "sensors": list(self.sensors),
            "shared": list(self.shared),
            "modes": [
                {
                    "frequency_hz": float(self.frequencies_hz[i]),
                    "frequency_std_hz": float(self.frequency_std_hz[i]),
                    "damping_ratio": float(self.damping_ratios[i]),
                    "damping_ratio_std": float(self.damping_ratio_std[i]),
                    "merged": int(self.merged[i]) if self.merged[i] >= 0 else None,
                    "reason": self.reasons[i] or None,
                }
                for i in range(self.frequencies_hz.size)
            ],
            "left_out": self.failed or None,
        }


@dataclass(frozen=True, eq=False)
class JointCheck(ByContent):
    """The joint estimate beside the merged modes; NaN where it has no such mode.

    ``text`` says what it is, or why there is none; ``mac`` is between both shapes.
    """

    text: str
    frequencies_hz: NDArray[np.float64]
    frequency_std_hz: NDArray[np.float64]
    damping_ratios: NDArray[np.float64]
    damping_ratio_std: NDArray[np.float64]
    mac: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """JSON object: what it is, and one entry a merged mode (null where the joint estimate has none)."""
        rows = [
            {
                "frequency_hz": float(self.frequencies_hz[i]),
                "frequency_std_hz": float(self.frequency_std_hz[i]),
                "damping_ratio": float(self.damping_ratios[i]),
                "damping_ratio_std": float(self.damping_ratio_std[i]),
                "mac": float(self.mac[i]),
            }
            if np.isfinite(self.frequencies_hz[i])
            else None
            for i in range(self.frequencies_hz.size)
        ]
        return {"text": self.text, "modes": rows}


@dataclass(frozen=True, repr=False, eq=False)
class OmaDetails(Short):
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
    setups : tuple of SetUp
        Set-ups of different sensors that were merged; empty for one set-up.
    joint : JointCheck or None
        The joint estimate of merged set-ups, beside the answer.
    """

    stabilization: Stabilization
    harmonics_hz: NDArray[np.float64]
    spectra: Spectra
    second_opinion: tuple[dict[str, Any], ...] | None = None
    model_orders: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, int))
    settings: dict[str, Any] = field(default_factory=dict)
    halves: tuple[ModalModel, ...] = ()
    setups: tuple[SetUp, ...] = ()
    joint: JointCheck | None = None

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        return {
            "Poles": f"{counted(len(self.model_orders), 'pole')} taken, {len(self.rejected)} rejected",
            "Harmonics": f"harmonics at {names_text([f'{f:.4g}' for f in self.harmonics_hz])} Hz" if len(self.harmonics_hz) else "",
            "Set-ups": f"{len(self.setups)} set-ups merged" if self.setups else "",
        }

    @property
    def rejected(self) -> tuple[RejectedPole, ...]:
        """Candidates that were not taken, with reasons."""
        return self.stabilization.rejected
