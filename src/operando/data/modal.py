"""Modal models: poles and shapes, with their covariance, and the FRFs they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import frozen
from operando.data.findings import Finding
from operando.data.frf import FrequencyAxis, Frf
from operando.data.provenance import Provenance
from operando.dof import Dof, match_dofs, parse_dofs
from operando.errors import DataError
from operando.synthesis import synthesis_variance, synthesise


@dataclass(frozen=True)
class ModalModel:
    """Modes of a structure.

    Parameters
    ----------
    frequencies_hz : (n_modes,) array
        |λ|/2π [Hz], increasing within the modes proper; residual modes may stand anywhere.
    damping_ratios : (n_modes,) array
        −Re λ/|λ|.
    shapes : (n_dofs, n_modes) array
        Real, of unit modal mass [kg^(−1/2)] if ``scaling`` is "unit_modal_mass"; complex of arbitrary scale if "unscaled".
    dofs : tuple of Dof
    scaling : {"unit_modal_mass", "unscaled"}
    residual : (n_modes,) bool array, optional
        Pseudo-modes below or above the band that stand for what lies outside it: part of every synthesis, never listed as modes.
    in_band : (n_modes,) bool array, optional
        Modes inside the analysis band (default: all that are not residual).
    covariance : (p, p) array, optional
        Covariance of θ = [f (Hz), ζ, shapes mode by mode (all DOFs of mode 0, of mode 1, …)]; for complex shapes
        the real parts of all modes come first, then the imaginary parts.
    std : dict, optional
        Standard deviations ``{"frequencies_hz", "damping_ratios", "shapes"}`` where no full covariance is kept.
    band_hz : (float, float), optional
        Analysis band [Hz].
    misfit : float, optional
        Mean squared standardised residual on lines the fit did not use.
    si : bool
        Whether the shapes are in SI; False where the units of the data were not known.
    findings : tuple of Finding
        What is wrong with it.
    provenance : Provenance, optional
        Where it came from.
    details : object, optional
        What the identification kept (stabilisation diagram, rejected poles, …); not part of the physics.

    Raises
    ------
    DataError
        If shapes disagree or values are out of range.
    """

    frequencies_hz: NDArray[np.float64]
    damping_ratios: NDArray[np.float64]
    shapes: NDArray[Any]
    dofs: tuple[Dof, ...]
    scaling: str = "unscaled"
    residual: NDArray[np.bool_] | None = None
    in_band: NDArray[np.bool_] | None = None
    covariance: NDArray[np.float64] | None = None
    std: dict[str, NDArray[np.float64]] | None = None
    band_hz: tuple[float, float] | None = None
    misfit: float | None = None
    si: bool = True
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
    details: Any = None

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("frequencies_hz", frozen(self.frequencies_hz, float, 1, "frequencies_hz"))
        put("damping_ratios", frozen(self.damping_ratios, float, 1, "damping_ratios"))
        shapes = np.asarray(self.shapes)
        put("shapes", frozen(shapes, complex if np.iscomplexobj(shapes) else float, 2, "shapes"))
        put("dofs", parse_dofs(self.dofs))
        put("findings", tuple(self.findings))
        n = self.frequencies_hz.size
        if self.damping_ratios.shape != (n,) or self.shapes.shape != (len(self.dofs), n):
            raise DataError(
                f"{n} frequencies, {self.damping_ratios.size} damping ratios and shapes {self.shapes.shape} "
                f"for {len(self.dofs)} DOFs do not belong together"
            )
        if self.scaling not in ("unit_modal_mass", "unscaled"):
            raise DataError(f"scaling {self.scaling!r} is neither unit_modal_mass nor unscaled")
        if self.scaling == "unit_modal_mass" and np.iscomplexobj(self.shapes):
            raise DataError("shapes of unit modal mass must be real")
        if not (np.all(np.isfinite(self.frequencies_hz)) and np.all(self.frequencies_hz >= 0)):
            raise DataError("frequencies must be finite and not negative")
        residual = np.zeros(n, bool) if self.residual is None else np.asarray(self.residual, bool)
        put("residual", frozen(residual, bool, 1, "residual"))
        in_band = ~residual if self.in_band is None else np.asarray(self.in_band, bool)
        put("in_band", frozen(in_band, bool, 1, "in_band"))
        if residual.shape != (n,) or in_band.shape != (n,):
            raise DataError("residual and in_band need one entry a mode")
        if self.covariance is not None:
            p = self.n_parameters
            put("covariance", frozen(self.covariance, float, 2, "covariance"))
            if self.covariance.shape != (p, p):
                raise DataError(f"covariance has shape {self.covariance.shape}, expected {(p, p)}")

    @property
    def n_modes(self) -> int:
        """Number of modes, residual ones included."""
        return int(self.frequencies_hz.size)

    @property
    def n_parameters(self) -> int:
        """Length of θ: 2·n + m·n (real shapes) or 2·n + 2·m·n (complex)."""
        return self.n_modes * (2 + len(self.dofs) * (2 if np.iscomplexobj(self.shapes) else 1))

    @property
    def poles(self) -> NDArray[np.complex128]:
        """λ = −ζω + iω√(1−ζ²) [rad/s]."""
        w = 2 * np.pi * self.frequencies_hz
        return -self.damping_ratios * w + 1j * w * np.sqrt(np.maximum(1 - self.damping_ratios**2, 0))

    def _std(self, name: str, block: slice) -> NDArray[np.float64] | None:
        if self.covariance is not None:
            return np.sqrt(np.maximum(np.diag(self.covariance)[block], 0))
        return None if self.std is None or self.std.get(name) is None else np.asarray(self.std[name])

    @property
    def frequency_std_hz(self) -> NDArray[np.float64] | None:
        """Standard deviation of each frequency [Hz]."""
        return self._std("frequencies_hz", slice(0, self.n_modes))

    @property
    def damping_ratio_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of each damping ratio."""
        return self._std("damping_ratios", slice(self.n_modes, 2 * self.n_modes))

    @property
    def shape_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of each shape value (n_dofs, n_modes); of the modulus, √(σ_re²+σ_im²), for complex shapes."""
        if self.covariance is None:
            return None if self.std is None or self.std.get("shapes") is None else np.asarray(self.std["shapes"])
        n, m = self.n_modes, len(self.dofs)
        variance = np.maximum(np.diag(self.covariance)[2 * n :], 0)
        parts = variance.reshape(-1, n, m).sum(axis=0)
        return np.sqrt(parts).T

    def select_modes(self, keep: Sequence[int] | NDArray[Any]) -> ModalModel:
        """Some of the modes (indices or mask), covariance included."""
        index = np.arange(self.n_modes)[keep if isinstance(keep, np.ndarray) else list(keep)]
        n, m = self.n_modes, len(self.dofs)
        covariance = self.covariance
        if covariance is not None:
            shape_rows = (2 * n + index[:, None] * m + np.arange(m)).ravel()
            rows = [index, n + index, shape_rows]
            if np.iscomplexobj(self.shapes):
                rows.append(shape_rows + n * m)
            rows_all = np.concatenate(rows)
            covariance = covariance[np.ix_(rows_all, rows_all)]
        std = None
        if self.std is not None:
            std = {k: (v[:, index] if np.ndim(v) == 2 else v[index]) for k, v in self.std.items() if v is not None}
        return replace(
            self,
            frequencies_hz=self.frequencies_hz[index],
            damping_ratios=self.damping_ratios[index],
            shapes=self.shapes[:, index],
            residual=self.residual[index] if self.residual is not None else None,
            in_band=self.in_band[index] if self.in_band is not None else None,
            covariance=covariance,
            std=std,
        )

    def modes_proper(self) -> ModalModel:
        """The model without its residual modes."""
        return self.select_modes(~np.asarray(self.residual))

    def rows(self, dofs: object) -> NDArray[Any]:
        """Shape rows at the DOFs asked for, sign by their sense (n_wanted, n_modes)."""
        i, s = match_dofs(parse_dofs(dofs), self.dofs)
        return self.shapes[i] * np.asarray(s)[:, None]

    def frf(
        self,
        frequencies: ArrayLike,
        responses: object = None,
        references: object = None,
        quantity: str = "accelerance",
        variance: bool = True,
    ) -> Frf:
        """Synthesise FRFs (Shen & Lu 2024, Eq 4) of a model of unit modal mass, residual modes included.

        Parameters
        ----------
        frequencies : array
            Lines [Hz].
        responses, references : DOF labels, optional
            Default: all DOFs of the model.
        quantity : {"accelerance", "mobility", "receptance"}
        variance : bool
            Fill the variance of each line from the covariance, where there is one.

        Raises
        ------
        DataError
            If the shapes are not scaled to unit modal mass.
        """
        if self.scaling != "unit_modal_mass":
            raise DataError(
                "shapes of arbitrary scale make no FRF",
                hint="scale them with scale_operational, or give units to the EMA",
            )
        resp = self.dofs if responses is None else parse_dofs(responses)
        refs = self.dofs if references is None else parse_dofs(references)
        axis = FrequencyAxis(np.atleast_1d(np.asarray(frequencies, float)))
        data = synthesise(axis.values, self.frequencies_hz, self.damping_ratios, self.rows(resp), self.rows(refs), quantity)
        own = None
        if variance and self.covariance is not None:
            rows, columns = match_dofs(resp, self.dofs)[0], match_dofs(refs, self.dofs)[0]
            own = synthesis_variance(
                axis.values, self.frequencies_hz, self.damping_ratios, self.shapes, self.covariance, rows, columns, quantity
            )
        return Frf(data, axis, resp, refs, quantity, variance=own, si=self.si, provenance=self.provenance.then("ModalModel.frf"))

    def mode_dict(self, i: int) -> dict[str, Any]:
        """JSON object of one mode, as in ``summary.json``."""
        shape = self.shapes[:, i]
        f_std, z_std, s_std = self.frequency_std_hz, self.damping_ratio_std, self.shape_std
        value = (lambda v: [float(v.real), float(v.imag)]) if np.iscomplexobj(shape) else (lambda v: float(v))
        return {
            "frequency_hz": float(self.frequencies_hz[i]),
            "frequency_std_hz": _number(f_std, i),
            "damping_ratio": float(self.damping_ratios[i]),
            "damping_ratio_std": _number(z_std, i),
            "modal_phase_collinearity": phase_collinearity(shape),
            "in_band": bool(np.asarray(self.in_band)[i]),
            "shape": {str(d): value(v) for d, v in zip(self.dofs, shape, strict=True)},
            "shape_std": None if s_std is None else {str(d): float(v) for d, v in zip(self.dofs, s_std[:, i], strict=True)},
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON object: modes proper, number of residual modes, misfit."""
        proper = np.flatnonzero(~np.asarray(self.residual))
        return {
            "modes": [self.mode_dict(int(i)) for i in proper],
            "residual_modes": int(np.sum(self.residual)),  # type: ignore[arg-type]
            "misfit": self.misfit,
            "scaling": self.scaling,
        }


def _number(values: NDArray[Any] | None, i: int) -> float | None:
    return None if values is None or not np.isfinite(values[i]) else float(values[i])


def phase_collinearity(shape: ArrayLike) -> float:
    """Modal phase collinearity of one shape, 1 for a real mode (Pappa, Elliott & Schenk 1993; centred at zero mean)."""
    v = np.asarray(shape)
    if not np.iscomplexobj(v):
        return 1.0
    xx, yy, xy = float(v.real @ v.real), float(v.imag @ v.imag), float(v.real @ v.imag)
    total = xx + yy
    return 1.0 if total == 0 else ((xx - yy) ** 2 + 4 * xy**2) / total**2
