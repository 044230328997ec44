"""What an analysis found beside its modes: diagram, poles left out, how the answer was chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Short, counted
from operando.ema.answers import LinearModes
from operando.ema.candidates import Candidate
from operando.stabilization import RejectedPole, Stabilization


@dataclass(frozen=True, repr=False, eq=False)
class EmaDetails(Short):
    """What the identification did.

    Parameters
    ----------
    stabilization : Stabilization
        Diagram of the linear fit over the band; the modes selected are the final ones.
    rejected : tuple of RejectedPole
        Everything that was not taken, with reasons.
    rounds : tuple of str
        One line a round of the search for the number of modes.
    fit_band_hz : (float, float)
        Lines that the fit used.
    misfit_by_dof : (n_dofs,) array
        Reduced chi-square on hold-out lines of each response DOF (of each hit point where a roving hammer is polished); NaN where it
        was not measured.
    fit_misfit : float
        Mean of eᴴC⁻¹e/m on the lines of the fit.
    converged : bool
    lower_residual : bool
        Whether kernels below the band were needed.
    second_opinion : tuple of dict
        sdypy-EMA beside it, where asked for.
    answer : {"linear", "polished"}
        Which stage gave the modes.
    answer_reason : str
    linear : LinearModes or None
        The linear stage's own answer, with the evidence of each pole.
    candidates : tuple of Candidate
        Poles that the linear fits of the band and its parts agree on: what modes named by hand are taken from.
    free_misfit : float
        As ``ModalModel.misfit``, of the fit behind the model: complex residues and tails free in each pair (linear), or what lies outside
        free in each run (polished). NaN where it was not computed.
    """

    stabilization: Stabilization | None
    rejected: tuple[RejectedPole, ...]
    rounds: tuple[str, ...]
    fit_band_hz: tuple[float, float]
    misfit_by_dof: NDArray[np.float64]
    fit_misfit: float
    converged: bool
    lower_residual: bool
    second_opinion: tuple[dict[str, Any], ...] = field(default=())
    answer: str = "polished"
    answer_reason: str = ""
    linear: LinearModes | None = None
    candidates: tuple[Candidate, ...] = ()
    free_misfit: float = float("nan")

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        return {
            "Answer": f"{self.answer} fit of {self.fit_band_hz[0]:g} to {self.fit_band_hz[1]:g} Hz",
            "Normalised error": f"reduced chi-square {self.fit_misfit:.3g} on its lines" if np.isfinite(self.fit_misfit) else "",
            "Poles": f"{counted(len(self.candidates), 'candidate pole')}, {len(self.rejected)} rejected",
        }
