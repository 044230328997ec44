"""Modal models: poles and shapes, with their covariance, and the FRFs they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import check_covariance, frozen, positions_of, positive_band
from operando.data.axis import FrequencyAxis
from operando.data.coupling import ModalCoupling
from operando.data.declared import check_fields, listed
from operando.data.findings import Finding
from operando.data.frf import Frf
from operando.data.modal_figures import ModalFigures
from operando.data.modal_poles import pole_form
from operando.data.modal_terms import ModalTerms, ResidualTerms, checked_signs, checked_terms, shape_rows
from operando.data.objects import Noun, counted, names_text
from operando.data.provenance import Provenance
from operando.data.quantities import quantity_named
from operando.data.receptances import Receptances
from operando.data.undriven import undriven_variance
from operando.dof import Dof, DofIndex, match_dofs, named_dofs, parse_dofs, refuse_twice
from operando.errors import DataError
from operando.synthesis import POWER, synthesis_variance, synthesise


@dataclass(frozen=True, repr=False, eq=False)
class ModalModel(ModalFigures, Noun):
    """Modes of a structure, and beside them the residual terms that complete its FRFs.

    Parameters
    ----------
    frequencies_hz : (n_modes,) array
        |λ|/2π [Hz] of the modes, in the order given; identification puts them in rising order.
    damping_ratios : (n_modes,) array
        −Re λ/|λ|, between −1 and 1.
    shapes : (n_dofs, n_modes) array
        Real, of unit modal mass [kg^(−1/2)] if ``scaling`` is "unit_modal_mass"; complex of arbitrary scale if "unscaled".
    dofs : tuple of Dof
    scaling : {"unit_modal_mass", "unscaled"}
    residuals : ResidualTerms, optional
        Pseudo-modes below or above the band that stand for what lies outside it: part of every synthesis, never modes. None where there
        are none. ``terms`` shows modes and residual terms together.
    in_band : (n_modes,) bool array, optional
        Modes inside the analysis band (default: all).
    covariance : (p, p) array, optional
        Covariance of θ = [f (Hz), ζ, shapes term by term (all DOFs of term 0, of term 1, …)] of all terms: modes first, residual terms
        last, in each of the three parts; for complex shapes the real parts of all terms come first, then the imaginary parts.
    std : dict, optional
        Standard deviations ``{"frequencies_hz", "damping_ratios", "shapes"}`` of all terms (modes first, residual terms last) where no
        full covariance is kept.
    band_hz : (float, float), optional
        Analysis band [Hz].
    misfit : float, optional
        Reduced chi-square of the FRFs of this model, under the noise of those it was fitted to, on lines the fit did not use.
    si : bool
        Whether the shapes are in SI; False where the units of the data were not known.
    findings : tuple of Finding
        What is wrong with it.
    provenance : Provenance, optional
        Where it came from.
    details : object, optional
        What the identification kept (stabilisation diagram, rejected poles, …); not part of the physics.
    coupling : ModalCoupling, optional
        Damping that ties all terms to each other, of a model of unit modal mass: its FRFs have it. Counts as known in variances.

    Raises
    ------
    DataError
        If shapes disagree or values are out of range.

    Examples
    --------
    >>> import numpy as np, operando
    >>> operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    <ModalModel: 2 modes at 20, 45 Hz; 2 DOFs 1+Z, 2+Z; unit modal mass>
    """

    frequencies_hz: NDArray[np.float64]
    damping_ratios: NDArray[np.float64]
    shapes: NDArray[Any]
    dofs: tuple[Dof, ...]
    scaling: str = "unscaled"
    residuals: ResidualTerms | None = None
    in_band: NDArray[np.bool_] | None = None
    covariance: NDArray[np.float64] | None = None
    std: dict[str, NDArray[np.float64]] | None = None
    band_hz: tuple[float, float] | None = None
    misfit: float | None = None
    si: bool = True
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
    details: Any = None
    coupling: ModalCoupling | None = None

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("dofs", parse_dofs(self.dofs))
        refuse_twice(self.dofs, "DOF")
        put("findings", listed(self.findings))
        arrays = checked_terms(self.frequencies_hz, self.damping_ratios, self.shapes, "modes", len(self.dofs))
        for name, value in zip(("frequencies_hz", "damping_ratios", "shapes"), arrays, strict=True):
            put(name, value)
        if self.covariance is not None:
            put("covariance", frozen(self.covariance, float, 2, "covariance"))
        if self.band_hz is not None:
            put("band_hz", positive_band(self.band_hz))
        in_band = frozen(np.ones(self.n_modes, bool) if self.in_band is None else self.in_band, bool, 1, "in_band")
        put("in_band", in_band)
        check_fields(self)
        if self.misfit is not None and self.misfit < 0:
            raise DataError(f"the reduced chi-square {self.misfit:g} is below 0", hint="leave it out where it is not known")
        residuals = self.residuals if self.residuals is not None and len(self.residuals) else None
        put("residuals", residuals)
        if residuals is not None and residuals.shapes.shape[0] != len(self.dofs):
            raise DataError(f"residual terms of {residuals.shapes.shape[0]} DOFs do not belong to modes of {len(self.dofs)} DOFs")
        if in_band.shape != (self.n_modes,):
            raise DataError("in_band needs one entry a mode")
        if self.scaling not in ("unit_modal_mass", "unscaled"):
            raise DataError(f"scaling {self.scaling!r} is neither unit_modal_mass nor unscaled")
        if self.scaling == "unit_modal_mass" and np.iscomplexobj(self.terms.shapes):
            raise DataError("shapes of unit modal mass must be real")
        if self.coupling is not None and (self.scaling != "unit_modal_mass" or self.coupling.lag.shape != self.terms.shapes.shape):
            raise DataError(f"damping between terms of lags {self.coupling.lag.shape} does not belong to this model")
        p = self.n_parameters
        if self.covariance is not None:
            check_covariance(self.covariance, p)
        for name, values in (self.std or {}).items():
            if values is not None and np.shape(values)[-1:] != (self.terms.n,):
                raise DataError(f"std[{name!r}] has shape {np.shape(values)}, expected one value a term, {self.terms.n} in all")

    @classmethod
    def from_terms(
        cls,
        frequencies_hz: ArrayLike,
        damping_ratios: ArrayLike,
        shapes: ArrayLike,
        dofs: Any,
        scaling: str = "unscaled",
        *,
        residual: ArrayLike | None = None,
        in_band: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        std: dict[str, NDArray[np.float64]] | None = None,
        coupling: ModalCoupling | None = None,
        signs: ArrayLike | None = None,
        **others: Any,
    ) -> ModalModel:
        """A model from arrays over modes and residual terms in any order: the modes come first, both kinds keep their order.

        Parameters
        ----------
        frequencies_hz, damping_ratios : (n_terms,) array
        shapes : (n_dofs, n_terms) array
        dofs : tuple of Dof
        scaling : {"unit_modal_mass", "unscaled"}
        residual : (n_terms,) bool array, optional
            Which terms are residual ones (default: none).
        in_band : (n_terms,) bool array, optional
            Modes inside the analysis band; what it says of residual terms is not used.
        covariance : (p, p) array, optional
            Of θ in the order given; it is put into the order of the model.
        std : dict, optional
            In the order given, too.
        coupling : ModalCoupling, optional
            In the order given, too.
        signs : (n_terms,) array, optional
            −1 for residual terms that are taken away (:class:`ResidualTerms`).
        **others
            As for :class:`ModalModel`.

        Raises
        ------
        DataError
            If the arrays do not belong together.
        """
        labels = parse_dofs(dofs)
        hz, zeta, values = checked_terms(frequencies_hz, damping_ratios, shapes, "modes and residual terms", len(labels))
        mask = np.zeros(hz.size, bool) if residual is None else np.asarray(residual, bool)
        inside = ~mask if in_band is None else np.asarray(in_band, bool)
        if mask.shape != hz.shape or inside.shape != hz.shape:
            raise DataError("residual and in_band need one entry a term")
        given = None if covariance is None else frozen(covariance, float, 2, "covariance")
        terms = ModalTerms(hz, zeta, values, labels, mask, inside, given, std, coupling, checked_signs(signs, hz.size))
        if np.any(terms.signs[~mask] < 0):
            raise DataError("modes are never taken away, only residual terms have signs")
        if given is not None and given.shape != (terms.n_parameters,) * 2:
            raise DataError(f"covariance has shape {given.shape}, expected {(terms.n_parameters,) * 2}")
        if np.any(mask[:-1] & ~mask[1:]):
            terms = terms.select(np.argsort(mask, kind="stable"))
        n = int(np.sum(~mask))
        rest = ResidualTerms(terms.frequencies_hz[n:], terms.damping_ratios[n:], terms.shapes[:, n:], terms.signs[n:])
        return cls(
            terms.frequencies_hz[:n], terms.damping_ratios[:n], terms.shapes[:, :n], labels, scaling,
            residuals=rest, in_band=terms.in_band[:n], covariance=terms.covariance, std=terms.std, coupling=terms.coupling, **others,
        )  # fmt: skip

    @classmethod
    def from_stored(cls, values: dict[str, Any]) -> ModalModel:
        """A model from the fields a file holds; older files mark residual terms among the modes by a mask ``residual``."""
        known = {f.name for f in fields(cls)}
        own = {name: value for name, value in values.items() if name in known}
        return cls.from_terms(residual=values["residual"], **own) if "residual" in values else cls(**own)

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        inside = np.asarray(self.in_band, bool)
        hz = [f"{f:.4g}" for f in self.frequencies_hz[inside]]
        modes, outside = counted(len(hz), "mode"), self.n_modes - len(hz)
        return {
            "Modes": (f"{modes} at {names_text(hz, 6)} Hz" if hz else modes) + (f" in band, {outside} outside the band" if outside else ""),
            "Residual terms": counted(self.n_residuals, "residual term") if self.n_residuals else "",
            "DOFs": f"{counted(len(self.dofs), 'DOF')} {names_text(self.dofs)}",
            "Shapes": ("unit modal mass" if self.scaling == "unit_modal_mass" else "no scale") + ("" if self.si else ", units not known"),
            "Band": "" if self.band_hz is None else f"band {self.band_hz[0]:g} to {self.band_hz[1]:g} Hz",
            "Findings": counted(len(self.findings), "finding") if self.findings else "",
        }

    def __getitem__(self, dofs: Any) -> ModalModel:
        """The model at some of its DOFs, covariance included: ``model["*Z"]``, ``model[["1+Z", "2-Z"]]``.

        A DOF in the other sense changes sign.

        Raises
        ------
        DofError
            If a DOF is not in the model.
        """
        wanted = named_dofs(dofs, self.dofs)
        i, signs = DofIndex(self.dofs).match(wanted)
        index, sign = np.asarray(i, int), np.asarray(signs, float)
        terms, n, covariance = self.terms, self.terms.n, self.covariance
        if covariance is not None:
            where = terms.positions(np.arange(n), index)
            factor = np.concatenate([np.ones(2 * n), np.tile(sign, (where.size - 2 * n) // max(sign.size, 1))])
            covariance = covariance[np.ix_(where, where)] * np.outer(factor, factor)
        std = self.std
        if std is not None and std.get("shapes") is not None:
            std = std | {"shapes": np.asarray(std["shapes"])[index]}
        return self.with_terms(
            shapes=np.asarray(terms.shapes)[index] * sign[:, None],
            dofs=wanted,
            covariance=covariance,
            std=std,
            coupling=None if self.coupling is None else self.coupling.at(index, sign),
        )

    @property
    def n_modes(self) -> int:
        """Number of modes; residual terms do not count."""
        return int(self.frequencies_hz.size)

    @property
    def n_residuals(self) -> int:
        """Number of residual terms."""
        return 0 if self.residuals is None else len(self.residuals)

    @cached_property
    def terms(self) -> ModalTerms:
        """Modes, then residual terms, in one set of arrays laid out as θ: what a synthesis sums over."""
        hz, zeta, shapes = self.frequencies_hz, self.damping_ratios, self.shapes
        if self.residuals is not None:
            rest = self.residuals
            hz, zeta = np.concatenate([hz, rest.frequencies_hz]), np.concatenate([zeta, rest.damping_ratios])
            shapes = np.concatenate([shapes, rest.shapes], axis=1)
        residual = np.arange(hz.size) >= self.n_modes
        in_band = np.concatenate([np.asarray(self.in_band, bool), np.zeros(self.n_residuals, bool)])
        signs = np.concatenate([np.ones(self.n_modes), np.zeros(0) if self.residuals is None else self.residuals.signs])
        return ModalTerms(hz, zeta, shapes, self.dofs, residual, in_band, self.covariance, self.std, self.coupling, signs)

    @property
    def n_parameters(self) -> int:
        """Length of θ, over all terms: 2·n + m·n (real shapes) or 2·n + 2·m·n (complex)."""
        return self.terms.n_parameters

    @property
    def poles(self) -> NDArray[np.complex128]:
        """λ = −ζω + iω√(1−ζ²) [rad/s] of the modes."""
        return self.terms.poles[: self.n_modes]

    @property
    def frequency_std_hz(self) -> NDArray[np.float64] | None:
        """Standard deviation of the frequency of each mode [Hz]."""
        std = self.terms.frequency_std_hz
        return None if std is None else std[: self.n_modes]

    @property
    def damping_ratio_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of the damping ratio of each mode."""
        std = self.terms.damping_ratio_std
        return None if std is None else std[: self.n_modes]

    @property
    def shape_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of each shape value (n_dofs, n_modes); of the modulus, √(σ_re²+σ_im²), for complex shapes."""
        std = self.terms.shape_std
        return None if std is None else std[:, : self.n_modes]

    def select_modes(self, keep: Sequence[int] | NDArray[Any]) -> ModalModel:
        """Some of the modes (indices or mask), covariance included, without residual terms.

        Raises
        ------
        DataError
            If one is not there.
        """
        return self.select_terms(positions_of(keep, self.n_modes, "modes"))

    def select_terms(self, keep: Sequence[int] | NDArray[Any]) -> ModalModel:
        """Some of the terms (indices or mask over ``terms``), covariance included; modes stay modes, residual terms residual."""
        some = self.terms.select(keep)
        others = {name: getattr(self, name) for name in ("scaling", "band_hz", "misfit", "si", "findings", "provenance", "details")}
        return ModalModel.from_terms(
            some.frequencies_hz, some.damping_ratios, some.shapes, self.dofs,
            residual=some.residual, in_band=some.in_band, covariance=some.covariance, std=some.std, coupling=some.coupling,
            signs=some.signs, **others,
        )  # fmt: skip

    def sums_of_squares(self, what: str) -> None:
        """Refuse a model with residual terms that are taken away, for what only sums of squares can do.

        Raises
        ------
        DataError
            If there are some.
        """
        if np.any(self.terms.signs < 0):
            raise DataError(
                f"{what} takes no residual terms that are taken away",
                hint="that is the idle model as a diagnosis has corrected it: give the idle model of the EMA, or use its FRFs",
            )

    def without_residuals(self) -> ModalModel:
        """The modes alone: what it synthesises lacks all that lies outside the band."""
        return self.select_modes(np.arange(self.n_modes))

    def with_terms(
        self,
        *,
        frequencies_hz: ArrayLike | None = None,
        damping_ratios: ArrayLike | None = None,
        shapes: ArrayLike | None = None,
        signs: ArrayLike | None = None,
        **others: Any,
    ) -> ModalModel:
        """The same modes with other values and residual terms, each array over all ``terms``; ``others`` as for :class:`ModalModel`."""
        old, n = self.terms, self.n_modes
        hz = old.frequencies_hz if frequencies_hz is None else np.asarray(frequencies_hz)
        zeta = old.damping_ratios if damping_ratios is None else np.asarray(damping_ratios)
        values = old.shapes if shapes is None else np.asarray(shapes)
        if signs is None:  # what is put behind them is added
            signs = np.concatenate([old.signs, np.ones(max(hz.size - old.n, 0))])
        rest = ResidualTerms(hz[n:], zeta[n:], values[:, n:], np.asarray(signs)[n:])
        return replace(self, frequencies_hz=hz[:n], damping_ratios=zeta[:n], shapes=values[:, :n], residuals=rest, **others)

    @cached_property
    def complex_shapes(self) -> NDArray[Any]:
        """Shapes as the modes move (n_dofs, n_modes): with damping that ties modes they are complex, else ``shapes`` as they are."""
        if (form := pole_form(self.terms)) is None:
            return self.shapes
        poles = replace(self.terms, frequencies_hz=form.frequencies_hz, damping_ratios=form.damping_ratios).poles
        lag = self.terms.coupling.lag if self.terms.coupling is not None else 0
        return np.asarray(self.terms.shapes @ form.vectors - poles * (lag @ form.vectors))[:, : self.n_modes]

    @property
    def real_shapes(self) -> bool:
        """Whether the shapes are real by construction, as those of an EMA are: their phase collinearity is 1 then and says nothing."""
        return not np.any(np.imag(self.complex_shapes))

    def rows(self, dofs: object) -> NDArray[Any]:
        """Shape rows of the modes at the DOFs asked for, sign by their sense (n_wanted, n_modes)."""
        return shape_rows(self.shapes, self.dofs, dofs)

    def frf(
        self,
        frequencies: ArrayLike,
        responses: object = None,
        references: object = None,
        quantity: str = "accelerance",
        variance: bool = True,
    ) -> Frf:
        """Synthesise FRFs (Shen & Lu 2024, Eq 4) of a model of unit modal mass, residual terms included.

        Parameters
        ----------
        frequencies : array
            Lines [Hz].
        responses, references : DOF labels or patterns over them, optional
            Default: all DOFs of the model.
        quantity : {"accelerance", "mobility", "receptance"}
            Or another name of one of them.
        variance : bool
            Fill the variance of each line from the covariance, where there is one.

        Raises
        ------
        DataError
            If the shapes are not scaled to unit modal mass.
        DofError
            If a DOF is not in the model, or none is named.
        """
        if self.scaling != "unit_modal_mass":
            raise DataError(
                "shapes of arbitrary scale make no FRF",
                hint="scale them with scale_operational, or give units to the EMA",
            )
        quantity = quantity_named(quantity, reciprocals=False)
        resp, refs = named_dofs(responses, self.dofs), named_dofs(references, self.dofs)
        axis = FrequencyAxis.of(frequencies)
        terms = self.terms
        if self.coupling is None:
            signed = terms.rows(refs) * terms.signs
            data = synthesise(axis.values, terms.frequencies_hz, terms.damping_ratios, terms.rows(resp), signed, quantity)
        else:
            tied = Receptances(terms, axis.values)
            data = tied.between(tied.rows(resp), tied.rows(refs)) * (2j * np.pi * axis.values) ** POWER[quantity]
        own = None
        if variance and self.covariance is not None:
            rows, columns = match_dofs(resp, self.dofs)[0], match_dofs(refs, self.dofs)[0]
            poles = terms.frequencies_hz, terms.damping_ratios
            own = synthesis_variance(axis.values, *poles, terms.shapes, self.covariance, rows, columns, quantity, terms.signs)
            own += undriven_variance(terms, rows, columns)[..., None] * (2 * np.pi * axis.values) ** (2 * POWER[quantity])
        return Frf(data, axis, resp, refs, quantity, variance=own, si=self.si, provenance=self.provenance.then("ModalModel.frf"))

    def mode_dict(self, i: int) -> dict[str, Any]:
        """JSON object of one mode, as in ``summary.json``."""
        i = int(positions_of([i], self.n_modes, "modes")[0])
        shape, moving = self.shapes[:, i], self.complex_shapes[:, i]
        f_std, z_std, s_std = self.frequency_std_hz, self.damping_ratio_std, self.shape_std
        value = (lambda v: [float(v.real), float(v.imag)]) if np.iscomplexobj(shape) else (lambda v: float(v))
        return {
            "frequency_hz": float(self.frequencies_hz[i]),
            "frequency_std_hz": _number(f_std, i),
            "damping_ratio": float(self.damping_ratios[i]),
            "damping_ratio_std": _number(z_std, i),
            "modal_phase_collinearity": phase_collinearity(moving),
            "in_band": bool(np.asarray(self.in_band)[i]),
            "shape": {str(d): value(v) for d, v in zip(self.dofs, shape, strict=True)},
            "shape_std": None if s_std is None else {str(d): float(v) for d, v in zip(self.dofs, s_std[:, i], strict=True)},
        }

    def to_dict(self) -> dict[str, Any]:
        """JSON object: modes, number of residual terms, reduced chi-square."""
        return {
            "modes": [self.mode_dict(i) for i in range(self.n_modes)],
            "residual_modes": self.n_residuals,
            "misfit": self.misfit,
            "scaling": self.scaling,
        }


def _number(values: NDArray[Any] | None, i: int) -> float | None:
    return None if values is None or not np.isfinite(values[i]) else float(values[i])


def phase_collinearity(shape: ArrayLike) -> float:
    """Modal phase collinearity of one shape, 1 for a real mode (Pappa, Elliott & Schenk 1993; centred at zero mean).

    Parameters
    ----------
    shape : array
        One mode shape.

    Returns
    -------
    float
        0 to 1.

    Examples
    --------
    >>> round(phase_collinearity([1.0, -0.5, 0.2]), 3)
    1.0
    """
    v = np.asarray(shape)
    if not np.iscomplexobj(v):
        return 1.0
    xx, yy, xy = float(v.real @ v.real), float(v.imag @ v.imag), float(v.real @ v.imag)
    total = xx + yy
    return 1.0 if total == 0 else ((xx - yy) ** 2 + 4 * xy**2) / total**2
