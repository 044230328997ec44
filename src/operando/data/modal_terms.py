"""What a modal model sums over: modes first, then residual terms, as plain arrays with the layout of θ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import ByContent, frozen, is_complex, positions_of
from operando.data.coupling import ModalCoupling
from operando.data.objects import Shown, counted, names_text
from operando.dof import Dof, match_dofs, parse_dofs
from operando.errors import DataError


@dataclass(frozen=True, repr=False, eq=False)
class ResidualTerms(Shown):
    """Pseudo-modes that stand for what lies outside the band: part of every synthesis, never modes.

    Parameters
    ----------
    frequencies_hz : (k,) array
        Where each stands [Hz], below or above the band; not natural frequencies.
    damping_ratios : (k,) array
    shapes : (n_dofs, k) array
        Scaled as the modes of the model are.
    signs : (k,) array, optional
        1, or −1 for a term that is taken away (default: 1): a residual matrix that was corrected need not be a sum of squares.

    Raises
    ------
    DataError
        If the arrays do not belong together or values are out of range.

    Examples
    --------
    >>> import numpy as np, operando
    >>> operando.ResidualTerms(np.array([2.0]), np.array([0.01]), np.array([[0.1], [0.2]]))
    <ResidualTerms: 1 residual term at 2 DOFs; at 2 Hz>
    """

    frequencies_hz: NDArray[np.float64]
    damping_ratios: NDArray[np.float64]
    shapes: NDArray[Any]
    signs: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        arrays = checked_terms(self.frequencies_hz, self.damping_ratios, self.shapes, "residual terms")
        signs = checked_signs(self.signs, arrays[0].size)
        for name, value in zip(("frequencies_hz", "damping_ratios", "shapes", "signs"), (*arrays, signs), strict=True):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return int(self.frequencies_hz.size)

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        return {
            "Terms": f"{counted(len(self), 'residual term')} at {counted(len(self.shapes), 'DOF')}",
            "Frequencies": f"at {names_text(f'{f:.4g}' for f in self.frequencies_hz)} Hz" if len(self) else "",
        }


@dataclass(frozen=True, eq=False)
class ModalTerms(ByContent):
    """All terms of a modal model, for code that sums over them: the modes in their order, then the residual terms in theirs.

    θ = [f (Hz), ζ, shapes term by term (all DOFs of term 0, of term 1, …)]; for complex shapes the real parts of all terms come
    first, then the imaginary parts.

    Parameters
    ----------
    frequencies_hz, damping_ratios : (n_terms,) array
    shapes : (n_dofs, n_terms) array
    dofs : tuple of Dof
    residual : (n_terms,) bool array
        Which are residual terms: the last ones.
    in_band : (n_terms,) bool array
        Modes inside the analysis band; False for residual terms.
    covariance : (p, p) array or None
        Of θ.
    std : dict or None
        Standard deviations ``{"frequencies_hz", "damping_ratios", "shapes"}`` of all terms, where no full covariance is kept.
    coupling : ModalCoupling or None
        Damping that ties them to each other.
    signs : (n_terms,) array
        −1 for residual terms that are taken away, 1 for all others.
    """

    frequencies_hz: NDArray[np.float64]
    damping_ratios: NDArray[np.float64]
    shapes: NDArray[Any]
    dofs: tuple[Dof, ...]
    residual: NDArray[np.bool_]
    in_band: NDArray[np.bool_]
    covariance: NDArray[np.float64] | None = None
    std: dict[str, NDArray[np.float64]] | None = None
    coupling: ModalCoupling | None = None
    signs: NDArray[np.float64] = field(default_factory=lambda: np.ones(1))

    def __post_init__(self) -> None:
        if self.signs.size == 1:
            object.__setattr__(self, "signs", np.full(self.n, self.signs.item()))

    @property
    def n(self) -> int:
        """Number of terms: modes and residual terms."""
        return int(self.frequencies_hz.size)

    @property
    def quadratic(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Damping [1/s] and stiffness [1/s²] matrices in modal coordinates of unit mass."""
        w = 2 * np.pi * self.frequencies_hz
        damping, stiffness = np.diag(2 * self.damping_ratios * w), np.diag(w**2)
        if self.coupling is None:
            return damping, stiffness
        return damping + self.coupling.damping, stiffness + np.diag(self.coupling.beside)

    @property
    def n_parameters(self) -> int:
        """Length of θ: 2·n + m·n (real shapes) or 2·n + 2·m·n (complex)."""
        return self.n * (2 + len(self.dofs) * (2 if np.iscomplexobj(self.shapes) else 1))

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
        return self._std("frequencies_hz", slice(0, self.n))

    @property
    def damping_ratio_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of each damping ratio."""
        return self._std("damping_ratios", slice(self.n, 2 * self.n))

    @property
    def shape_std(self) -> NDArray[np.float64] | None:
        """Standard deviation of each shape value (n_dofs, n_terms); of the modulus, √(σ_re²+σ_im²), for complex shapes."""
        if self.covariance is None:
            return None if self.std is None or self.std.get("shapes") is None else np.asarray(self.std["shapes"])
        variance = np.maximum(np.diag(self.covariance)[2 * self.n :], 0)
        return np.sqrt(variance.reshape(-1, self.n, len(self.dofs)).sum(axis=0)).T

    def rows(self, dofs: object) -> NDArray[Any]:
        """Shape rows at the DOFs asked for, sign by their sense (n_wanted, n_terms)."""
        return shape_rows(self.shapes, self.dofs, dofs)

    def positions(self, terms: NDArray[np.int_], rows: NDArray[np.int_]) -> NDArray[np.int_]:
        """Where frequencies, damping ratios and shape values of some terms at some DOFs stand in θ."""
        n, m = self.n, len(self.dofs)
        values = (2 * n + terms[:, None] * m + rows).ravel()
        imaginary = [values + n * m] if np.iscomplexobj(self.shapes) else []
        return np.concatenate([terms, n + terms, values, *imaginary])

    def select(self, keep: Sequence[int] | NDArray[Any]) -> ModalTerms:
        """Some of the terms (indices or mask) in that order, covariance included; residual terms may stand anywhere then."""
        index = positions_of(keep, self.n, "terms")
        covariance = self.covariance
        if covariance is not None:
            where = self.positions(index, np.arange(len(self.dofs)))
            covariance = covariance[np.ix_(where, where)]
        std = None
        if self.std is not None:
            std = {k: np.asarray(v)[..., index] for k, v in self.std.items() if v is not None}
        hz, zeta, shapes = self.frequencies_hz[index], self.damping_ratios[index], self.shapes[:, index]
        coupling = None if self.coupling is None else self.coupling.select(index)
        flags = self.residual[index], self.in_band[index]
        return ModalTerms(hz, zeta, shapes, self.dofs, *flags, covariance, std, coupling, self.signs[index])


def checked_terms(
    frequencies_hz: ArrayLike, damping_ratios: ArrayLike, shapes: ArrayLike, what: str, n_dofs: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
    """Frequencies, damping ratios and shapes as read-only arrays that belong together."""
    hz = frozen(frequencies_hz, float, 1, "frequencies_hz")
    zeta = frozen(damping_ratios, float, 1, "damping_ratios")
    values = frozen(shapes, complex if is_complex(shapes) else float, 2, "shapes")
    rows = values.shape[0] if n_dofs is None else n_dofs
    if zeta.shape != hz.shape or values.shape != (rows, hz.size):
        raise DataError(
            f"{what}: {hz.size} frequencies, {zeta.size} damping ratios and shapes {values.shape} for {rows} DOFs do not belong together"
        )
    if not (np.all(np.isfinite(hz)) and np.all(hz >= 0)):
        raise DataError(f"{what}: frequencies must be finite and not negative")
    if not np.all(np.isfinite(zeta)):
        raise DataError(f"{what}: damping ratios must be finite")
    if not np.all(np.isfinite(values)):
        raise DataError(f"{what}: shapes must be finite", hint="leave DOFs out that were not measured")
    return hz, zeta, values


def checked_signs(signs: ArrayLike | None, n: int) -> NDArray[np.float64]:
    """One sign a term, read-only."""
    values = frozen(np.ones(n) if signs is None else signs, float, 1, "signs")
    if values.size != n or not np.all(np.abs(values) == 1):
        raise DataError(f"signs of residual terms are 1 and −1, one a term: {values.size} for {n} terms")
    return values


def shape_rows(shapes: NDArray[Any], own: tuple[Dof, ...], wanted: object) -> NDArray[Any]:
    """Rows of shapes at the DOFs wanted, sign by their sense."""
    i, s = match_dofs(parse_dofs(wanted), own)
    return shapes[i] * np.asarray(s)[:, None]
