"""The hybrid model: operational poles and scaled shapes, idle residuals, and the FRFs they make."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Finding, Frf, ModalModel, Short, counted, plots
from operando.scaling.condensed import CondensedBasis
from operando.scaling.pairing import Pairing
from operando.threads import one_blas_thread

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False, eq=False)
class HybridModel(Short):
    """Operational modes with the scale carried over from rest.

    Parameters
    ----------
    idle : ModalModel
        The idle model given.
    operating : ModalModel
        The operational model given (complex, unscaled).
    modal : ModalModel
        Operational modes of unit modal mass; its residual terms are the idle modes and residual terms carried over. Real shapes, with
        covariance where both models carry one.
    pairing : Pairing
        Indices count modes, as in ``summary.json``.
    method, reason : str
        Scaling method used, and why.
    threshold : float
    basis : CondensedBasis or None
        Idle modes of the condensed mass; None where it could not be built.
    scales : (n,) complex array
        Least-squares factor of each scaled shape on the operational shape given.
    scale_std : (n,) array or None
        Relative standard deviation of the size of each scaled shape.
    outside_span : (n,) array
        Part of each operational shape (norm ratio) outside the span of the basis.
    imaginary_share : (n,) array
        Norm of what is dropped by taking the real part, over the norm of the shape.
    alternatives : dict
        Method → largest difference in dB over lines and pairs from the method used (None where it cannot be applied).
    alternative_models : dict
        Method → ModalModel of that method (same residuals).
    residuals : str
        Which idle modes are carried over, in words.
    evidence : dict
        Figures the choice of the method rests on.
    findings : tuple of Finding

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> operating = operando.ModalModel([21.0, 45.0], [0.01, 0.02], np.array([[2, 3], [2, -3]]), "1+Z, 2+Z", "unscaled")
    >>> hybrid = operando.scale_operational(idle, operating)
    >>> hybrid.frf([21.0], "1+Z", "2+Z").data.shape
    (1, 1, 1)
    """

    idle: ModalModel
    operating: ModalModel
    modal: ModalModel
    pairing: Pairing
    method: str
    reason: str
    threshold: float
    basis: CondensedBasis | None
    scales: NDArray[np.complex128]
    scale_std: NDArray[np.float64] | None
    outside_span: NDArray[np.float64]
    imaginary_share: NDArray[np.float64]
    alternatives: dict[str, float | None]
    alternative_models: dict[str, ModalModel]
    residuals: str
    evidence: dict[str, Any] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    @property
    def kappa(self) -> float | None:
        """Condition number of the idle shapes used, None without a condensed mass."""
        return None if self.basis is None else self.basis.kappa

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        modal, kinds = self.modal, [p.kind for p in self.pairing.pairs]
        return {
            "Modes": f"{counted(modal.n_modes, 'operational mode')} at {len(modal.dofs)} DOFs",
            "Scaling": f"scaled by {self.method}",
            "Reason": self.reason,
            "Pairing": ", ".join(f"{kinds.count(k)} {k.replace('_', ' ')}" for k in dict.fromkeys(kinds)),
            "Findings": counted(len(self.findings), "finding") if self.findings else "",
        }

    def __repr__(self) -> str:
        facts = self.facts()
        return f"<HybridModel: {facts['Modes']}; {facts['Scaling']}; {facts['Pairing']}>"

    def plot(
        self,
        axes: Axes | None = None,
        *,
        response: object = None,
        reference: object = None,
        measured: Frf | None = None,
        frequencies: ArrayLike | None = None,
    ) -> Axes:
        """One operational FRF with its 95 % band, beside the idle model and a validation measurement (:func:`operando.plots.plot_hybrid`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        response, reference : DOF label, optional
            Default: the first pair of the measurement, else the DOF of the largest shape values with itself.
        measured : Frf, optional
            Running, force measured; its lines are used.
        frequencies : array, optional
            Lines [Hz]; default: the band in steps that resolve every mode.

        Returns
        -------
        matplotlib Axes
            Of the magnitude.
        """
        made: Axes = plots().plot_hybrid(self, axes, response=response, reference=reference, measured=measured, frequencies=frequencies)
        return made

    def frf(self, frequencies: ArrayLike, responses: object = None, references: object = None, quantity: str = "accelerance") -> Frf:
        """Operational FRFs (Shen & Lu 2024, Eq 4) with the variance of each line where both models carry a covariance.

        Parameters
        ----------
        frequencies : array
            Lines [Hz].
        responses, references : DOF labels, optional
            Default: all common DOFs.
        quantity : {"accelerance", "mobility", "receptance"}
        """
        with one_blas_thread():
            return self.modal.frf(frequencies, responses, references, quantity)

    def to_dataframe(self) -> pandas.DataFrame:
        """One row a mode: the scaled modes (``modal.to_dataframe()``) with their idle partner, MAC, class and the spread of their scale.

        Raises
        ------
        MissingError
            If pandas is not installed.
        """
        table = self.modal.to_dataframe()
        rows = {p["operating"]: p for p in self.to_dict()["pairing"]}
        for place, (name, key) in enumerate((("idle_mode", "idle"), ("mac", "mac"), ("class", "class"), ("scale_std", "scale_std"))):
            table.insert(place, name, [rows[r][key] if r in rows else None for r in range(self.modal.n_modes)])
        return table

    def to_dict(self) -> dict[str, Any]:
        """``{"pairing": […], "scaling": {…}}`` of ``summary.json``."""
        rows = []
        for p in self.pairing.pairs:
            r = p.operating
            rows.append(
                {
                    "operating": r,
                    "idle": p.idle,
                    "mac": p.mac,
                    "class": p.kind,
                    "scale": [float(self.scales[r].real), float(self.scales[r].imag)],
                    "scale_std": None if self.scale_std is None else float(self.scale_std[r]),
                    "imaginary_share": float(self.imaginary_share[r]),
                    "note": p.note,
                }
            )
        scaling = {
            "method": self.method,
            "reason": self.reason,
            "threshold": self.threshold,
            "kappa": self.kappa if self.kappa is None or np.isfinite(self.kappa) else None,
            "kappa_dofs": [] if self.basis is None else [str(self.modal.dofs[i]) for i in self.basis.weak_dofs],
            "best_dofs": [] if self.basis is None else [str(self.modal.dofs[i]) for i in self.basis.best_dofs],
            "best_dofs_kappa": None if self.basis is None or not np.isfinite(self.basis.best_kappa) else self.basis.best_kappa,
            "outside_span": [float(v) for v in self.outside_span],
            "residuals": self.residuals,
            "alternatives": dict(self.alternatives),
            "conflicts": list(self.pairing.conflicts),
            "evidence": self.evidence,
        }
        return {"pairing": rows, "scaling": scaling}
