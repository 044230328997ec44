"""Frequency axis and frequency response functions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import frozen
from operando.data.elsewhere import ForOthers
from operando.data.findings import Finding
from operando.data.provenance import Provenance
from operando.dof import Dof, Node, match_dofs, parse_dofs
from operando.errors import DataError

QUANTITIES = ("receptance", "mobility", "accelerance")
"""Displacement, velocity, acceleration over force: powers 0, 1, 2 of iω."""


@dataclass(frozen=True)
class FrequencyAxis:
    """Frequency lines, even or not.

    Parameters
    ----------
    values : (n_lines,) array
        Frequencies [Hz], increasing.

    Raises
    ------
    DataError
        If the values are not finite, negative, or not increasing.
    """

    values: NDArray[np.float64]

    def __post_init__(self) -> None:
        values = frozen(self.values, float, 1, "frequency axis")
        object.__setattr__(self, "values", values)
        if values.size == 0 or not np.all(np.isfinite(values)) or values[0] < 0 or np.any(np.diff(values) <= 0):
            raise DataError("frequency lines must be finite, not negative and increasing, at least one")

    @classmethod
    def even(cls, start: float, step: float, count: int) -> FrequencyAxis:
        """Evenly spaced lines."""
        return cls(np.asarray(start + step * np.arange(count), float))

    @property
    def step(self) -> float | None:
        """Spacing [Hz] if even to 1e-6 of it, else None."""
        if self.values.size < 2:
            return None
        step = (self.values[-1] - self.values[0]) / (self.values.size - 1)
        even = self.values[0] + step * np.arange(self.values.size)
        return float(step) if np.allclose(self.values, even, rtol=0, atol=1e-6 * step + 1e-9 * self.values[-1]) else None

    def __len__(self) -> int:
        return int(self.values.size)

    def band(self, low: float, high: float) -> slice:
        """Lines within [low, high] Hz."""
        i = int(np.searchsorted(self.values, low - 1e-9))
        j = int(np.searchsorted(self.values, high + 1e-9, side="right"))
        return slice(i, j)


@dataclass(frozen=True)
class Frf(ForOthers):
    """Frequency response functions H[response, reference] = response/force, e^{+iωt}.

    Parameters
    ----------
    data : (n_responses, n_references, n_lines) complex array
        SI where ``si`` is true. NaN where a pair was not measured.
    axis : FrequencyAxis or array
        Lines [Hz].
    responses, references : tuple of Dof
    quantity : {"accelerance", "mobility", "receptance"}
        Accelerance in (m/s²)/N, mobility in (m/s)/N, receptance in m/N.
    variance : (n_responses, n_references, n_lines) float array, optional
        E|ΔH|² of the complex line (``var_meas`` of the error measures).
    coherence : array of the same shape, optional
        Ordinary coherence (single reference) or multiple coherence.
    averages : float, optional
        Effective number of averages.
    si : bool
        False where the units are not known: then no mass scaling is possible.
    exponential_window_rate : float
        Decay rate β [1/s] of an exponential window e^{−βt} used in the estimate; it adds β/ω to the damping
        ratio of each pole and is taken off after identification.
    name : str
        What was measured, as the file says.
    setups : (n_responses, n_references) int array, optional
        Where sensors roved: number of the set-up that measured the pair, −1 for more than one.
    findings : tuple of Finding
        What is wrong with it.
    provenance : Provenance, optional
        Where it came from.
    """

    data: NDArray[np.complexfloating[Any, Any]]
    axis: FrequencyAxis
    responses: tuple[Dof, ...]
    references: tuple[Dof, ...]
    quantity: str = "accelerance"
    variance: NDArray[np.float64] | None = None
    coherence: NDArray[np.float64] | None = None
    averages: float | None = None
    si: bool = True
    exponential_window_rate: float = 0.0
    name: str = ""
    setups: NDArray[np.int_] | None = None
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", frozen(self.data, complex, 3, "FRF data"))
        if not isinstance(self.axis, FrequencyAxis):
            object.__setattr__(self, "axis", FrequencyAxis(np.asarray(self.axis, float)))
        object.__setattr__(self, "responses", parse_dofs(self.responses))
        object.__setattr__(self, "references", parse_dofs(self.references))
        object.__setattr__(self, "findings", tuple(self.findings))
        expected = (len(self.responses), len(self.references), len(self.axis))
        if self.data.shape != expected:
            raise DataError(f"FRF data have shape {self.data.shape}, labels and axis say {expected}")
        for name in ("variance", "coherence"):
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, frozen(array, float, 3, name))
                if array.shape != expected:
                    raise DataError(f"{name} has shape {array.shape}, expected {expected}")
        if self.setups is not None:
            object.__setattr__(self, "setups", frozen(self.setups, int, 2, "setups"))
            if self.setups.shape != expected[:2]:
                raise DataError(f"setups has shape {self.setups.shape}, expected {expected[:2]}")
        if self.quantity not in QUANTITIES:
            raise DataError(f"quantity {self.quantity!r} is none of {', '.join(QUANTITIES)}")
        for label, dofs in (("response", self.responses), ("reference", self.references)):
            seen: set[tuple[Node, str]] = set()
            for d in dofs:
                if (d.node, d.axis) in seen:
                    raise DataError(f"{label} DOF {d} appears twice (in either sense)")
                seen.add((d.node, d.axis))

    @property
    def frequencies_hz(self) -> NDArray[np.float64]:
        """Lines [Hz]."""
        return self.axis.values

    def band(self, low: float, high: float) -> Frf:
        """The lines within [low, high] Hz."""
        s = self.axis.band(low, high)
        return replace(
            self,
            data=self.data[:, :, s],
            axis=FrequencyAxis(self.axis.values[s]),
            variance=None if self.variance is None else self.variance[:, :, s],
            coherence=None if self.coherence is None else self.coherence[:, :, s],
        )

    def without_bands(self, bands: Sequence[tuple[float, float]]) -> Frf:
        """The lines outside these bands [Hz], ends of a band included in it."""
        keep = np.ones(len(self.axis), bool)
        for low, high in bands:
            keep[self.axis.band(low, high)] = False
        if keep.all():
            return self
        part = lambda array: None if array is None else array[:, :, keep]  # noqa: E731
        axis = FrequencyAxis(self.frequencies_hz[keep])
        return replace(self, data=self.data[:, :, keep], axis=axis, variance=part(self.variance), coherence=part(self.coherence))

    def select(self, responses: object = None, references: object = None) -> Frf:
        """Some rows and columns; a DOF asked for in the other sense changes sign.

        Raises
        ------
        DofError
            If a DOF is not measured.
        """
        resp = self.responses if responses is None else parse_dofs(responses)
        refs = self.references if references is None else parse_dofs(references)
        i, si = match_dofs(resp, self.responses)
        j, sj = match_dofs(refs, self.references)
        ix = np.ix_(i, j)
        signs = np.outer(si, sj)[:, :, None]
        return replace(
            self,
            data=self.data[ix] * signs,
            responses=resp,
            references=refs,
            variance=None if self.variance is None else self.variance[ix],
            coherence=None if self.coherence is None else self.coherence[ix],
            setups=None if self.setups is None else self.setups[ix],
        )

    def to_quantity(self, quantity: str) -> Frf:
        """Convert between receptance, mobility and accelerance by powers of iω (a line at 0 Hz becomes NaN if divided).

        FRFs under an exponential window of rate β are H(iω + β), so the powers are those of iω + β.
        """
        if quantity not in QUANTITIES:
            raise DataError(f"quantity {quantity!r} is none of {', '.join(QUANTITIES)}")
        power = QUANTITIES.index(quantity) - QUANTITIES.index(self.quantity)
        if power == 0:
            return self
        s = 2j * np.pi * self.frequencies_hz + self.exponential_window_rate
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = s**power
        factor[~np.isfinite(factor)] = np.nan
        var = None if self.variance is None else self.variance * np.abs(factor) ** 2
        return replace(self, data=self.data * factor, variance=var, quantity=quantity)

    def at(self, frequencies: ArrayLike) -> NDArray[np.intp]:
        """Indices of the nearest lines."""
        f = np.atleast_1d(np.asarray(frequencies, float))
        lines = self.frequencies_hz
        above = np.searchsorted(lines[1:-1], f) + 1 if lines.size > 1 else np.zeros(f.size, np.intp)
        below = np.maximum(above - 1, 0)
        return np.asarray(np.where(f - lines[below] <= lines[above] - f, below, above), np.intp)

    def drive_points(self) -> list[tuple[int, int]]:
        """(response, reference) index pairs on the same node and axis."""
        return [(i, j) for j, r in enumerate(self.references) for i, d in enumerate(self.responses) if d.same_axis(r)]

    def both_ways(self) -> Iterator[tuple[Dof, Dof, NDArray[Any], NDArray[Any], NDArray[np.float64] | None]]:
        """Each pair of references that are also responses, as reciprocity is judged by.

        Yields
        ------
        first, second : Dof
        forward, backward : (n_lines,) complex arrays
            H[second, first] and H[first, second], in the positive senses.
        variance : (n_lines,) float array or None
            Of their difference.
        """
        row = {(d.node, d.axis): (i, d.sign) for i, d in enumerate(self.responses)}
        for b, second in enumerate(self.references):
            for a, first in enumerate(self.references[:b]):
                at_first, at_second = row.get((first.node, first.axis)), row.get((second.node, second.axis))
                if at_first is None or at_second is None:
                    continue
                forward = self.data[at_second[0], a] * at_second[1] * first.sign
                backward = self.data[at_first[0], b] * at_first[1] * second.sign
                variance = None if self.variance is None else self.variance[at_second[0], a] + self.variance[at_first[0], b]
                yield first, second, forward, backward, variance

    def with_findings(self, findings: Sequence[Finding]) -> Frf:
        """The FRF with more annotations."""
        return replace(self, findings=(*self.findings, *findings))
