"""Frequency axis and frequency response functions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data.arrays import bands_of, frozen, number_of, numbers_of, ordered_band
from operando.data.axis import FrequencyAxis
from operando.data.declared import check_fields, listed
from operando.data.findings import Finding
from operando.data.objects import Noun, common_name, counted, names_text, plots
from operando.data.provenance import Provenance
from operando.data.quantities import QUANTITIES, RECIPROCALS, quantity_named, unit_of
from operando.dof import Dof, DofIndex, match_dofs, named_dofs, parse_dofs, refuse_twice
from operando.errors import DataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROUNDING = 1e-3
"""How far a coherence may lie beyond 0 to 1, and a variance below 0 (as a share of the largest): files hold them in few digits."""


@dataclass(frozen=True, repr=False, eq=False)
class Frf(Noun):
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

    Examples
    --------
    >>> import operando
    >>> frf = operando.Frf([[[1.0, 2.0]], [[3.0, 4.0]]], [5.0, 6.0], "1+Z, 2+Z", "1+Z")
    >>> frf["2+Z", "1+Z"].data.real.tolist()
    [[[3.0, 4.0]]]
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
            object.__setattr__(self, "axis", FrequencyAxis(self.axis))
        object.__setattr__(self, "responses", parse_dofs(self.responses))
        object.__setattr__(self, "references", parse_dofs(self.references))
        object.__setattr__(self, "findings", listed(self.findings))
        rate = number_of(self.exponential_window_rate, "exponential_window_rate", "give the decay rate of the window [1/s]", 0.0)
        object.__setattr__(self, "exponential_window_rate", rate)
        if self.averages is not None:
            object.__setattr__(self, "averages", number_of(self.averages, "averages", "give how many there are", 0.0))
        expected = (len(self.responses), len(self.references), len(self.axis))
        if self.data.shape != expected:
            raise DataError(f"FRF data have shape {self.data.shape}, labels and axis say {expected}")
        for name in ("variance", "coherence"):
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, frozen(array, float, 3, name))
                self._check_beside(name, expected)
        if self.setups is not None:
            object.__setattr__(self, "setups", frozen(self.setups, int, 2, "setups"))
            if self.setups.shape != expected[:2]:
                raise DataError(f"setups has shape {self.setups.shape}, expected {expected[:2]}")
        object.__setattr__(self, "quantity", quantity_named(self.quantity, reciprocals=False))
        check_fields(self)
        refuse_twice(self.responses, "response DOF")
        refuse_twice(self.references, "reference DOF")

    def _check_beside(self, name: str, expected: tuple[int, ...]) -> None:
        """Refuse a variance or coherence of another shape, or with values that none can have."""
        array = np.asarray(getattr(self, name))
        if array.shape != expected:
            raise DataError(f"{name} has shape {array.shape}, expected {expected}")
        size = float(np.max(np.abs(array), where=np.isfinite(array), initial=0.0)) if name == "variance" else 1.0
        wrong = (array < -ROUNDING * size) | (array > (np.inf if name == "variance" else 1 + ROUNDING))
        if wrong.any():
            i, j, k = np.argwhere(wrong)[0]
            where = f"{self.responses[i]}/{self.references[j]} at {self.frequencies_hz[k]:g} Hz"
            hint = "give E|ΔH|² of each line, at least 0" if name == "variance" else "give γ² of each line, 0 to 1"
            raise DataError(f"the {name} of {where} is {array[i, j, k]:g}; {np.sum(wrong)} of {array.size} values cannot be", hint=hint)

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        return {
            "Name": self.name,
            "Quantity": f"{self.quantity} [{unit_of(self.quantity)}]" if self.si else f"{self.quantity}, units not known",
            "Responses": f"{counted(len(self.responses), 'response')} {names_text(self.responses)}",
            "References": f"{counted(len(self.references), 'reference')} {names_text(self.references)}",
            **self.axis.facts(),
            "Beside": ", ".join(n for n in ("variance", "coherence") if getattr(self, n) is not None),
            "Findings": counted(len(self.findings), "finding") if self.findings else "",
        }

    def plot(
        self,
        axes: Axes | Sequence[Axes] | None = None,
        *,
        responses: object = None,
        references: object = None,
        quantity: str | None = None,
        band: tuple[float, float] | None = None,
        labels: Sequence[str] | None = None,
        noise: bool = False,
        parts: str | Sequence[str] = ("magnitude", "phase", "coherence"),
    ) -> Axes:
        """Magnitude, phase and coherence (:func:`operando.plots.plot_frf`).

        Parameters
        ----------
        axes : matplotlib Axes or sequence of Axes, optional
            Axes that a plot of another FRF returned: both are overlaid. Default: of a new figure.
        responses, references : DOF labels, optional
            Pairs drawn; default: all where they are eight at most, else the drive points, or the first eight.
        quantity : str, optional
            ``receptance``, ``compliance``, ``dynamic_stiffness``, …; default: its own.
        band : (float, float), optional
            Analysis band [Hz], shaded outside.
        labels : sequence of str, optional
            One word that names these curves in the legend. Default: the name of the FRF.
        noise : bool
            Draw the standard deviation of the first pair drawn; select one pair to see its own.
        parts : sequence of {"magnitude", "phase", "coherence"}, or one of them

        Returns
        -------
        matplotlib Axes
            Of the magnitude.

        Examples
        --------
        >>> import operando
        >>> frf = operando.Frf([[[1.0, 2.0, 1.0]]], [1.0, 2.0, 3.0], "1+Z", "1+Z")
        >>> frf.plot(frf.plot(), quantity="compliance").get_ylabel()
        'Receptance [m/N]'
        """
        made: Axes = plots().plot_frf(
            self, axes, responses=responses, references=references, quantity=quantity, band=band, labels=labels, noise=noise, parts=parts
        )
        return made

    def plot_nyquist(
        self,
        model: Any = None,
        axes: Axes | None = None,
        *,
        mode: int | None = None,
        response: object = None,
        reference: object = None,
        band: tuple[float, float] | None = None,
    ) -> Axes:
        """One pair in the complex plane, with the synthesis of a model and the circle of a mode (:func:`operando.plots.plot_nyquist`).

        Parameters
        ----------
        model : ModalModel, optional
        axes : matplotlib Axes, optional
        mode : int, optional
            Mode of the model whose surroundings are shown.
        response, reference : DOF label, optional
            Default: the first drive point, else the first pair.
        band : (float, float), optional
            Lines shown [Hz].

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_nyquist(self, model, axes, mode=mode, response=response, reference=reference, band=band)
        return made

    @property
    def frequencies_hz(self) -> NDArray[np.float64]:
        """Lines [Hz]."""
        return self.axis.values

    def band(self, low: float, high: float) -> Frf:
        """The lines within [low, high] Hz.

        Raises
        ------
        DataError
            If the band is reversed, or holds no line.
        """
        low, high = ordered_band((low, high))
        part = self.axis.band(low, high)
        if part.stop <= part.start:
            f = self.frequencies_hz
            raise DataError(
                f"the band of {low:g} to {high:g} Hz holds no lines of the FRFs, which lie at {f[0]:g} to {f[-1]:g} Hz",
                hint="choose another band",
            )
        return self.lines(part)

    def lines(self, which: slice | ArrayLike) -> Frf:
        """Some of the lines: a slice, positions in increasing order, or a mask.

        Raises
        ------
        DataError
            If a position is not there, or none is named.
        """
        keep = which if isinstance(which, slice) else np.atleast_1d(np.asarray(which))
        part = lambda array: None if array is None else array[:, :, keep]  # noqa: E731
        try:
            axis = FrequencyAxis(self.frequencies_hz[keep])
        except IndexError as error:
            raise DataError(f"{which!r:.60} names no lines of {len(self.axis)}", hint="give positions from 0, or a mask") from error
        return replace(self, data=self.data[:, :, keep], axis=axis, variance=part(self.variance), coherence=part(self.coherence))

    def decimate(self, step: int) -> Frf:
        """Every ``step``-th line, from the first on.

        Raises
        ------
        DataError
            If the step is not a positive whole number.
        """
        if int(step) != step or step < 1:
            raise DataError(f"a step of {step} lines cannot be taken", hint="give 2 for every second line")
        return self.lines(slice(None, None, int(step)))

    def same_lines(self, other: Frf) -> bool:
        """Whether both have the same frequency lines."""
        return len(self.axis) == len(other.axis) and bool(np.allclose(self.frequencies_hz, other.frequencies_hz))

    def beside(self, *others: Frf) -> Frf:
        """FRFs of other references at the same responses and lines set beside these, as one.

        Raises
        ------
        DataError
            If responses, lines, quantity or units differ, or a reference stands in two of them.
        """
        for other in others:
            same = (other.responses, other.quantity, other.si) == (self.responses, self.quantity, self.si)
            if not (same and self.same_lines(other)):
                hint = "see Frf.select, Frf.lines"
                raise DataError("FRFs of other responses, lines, quantity or units cannot stand side by side", hint=hint)
        parts = (self, *others)
        stack = lambda arrays: None if any(a is None for a in arrays) else np.concatenate(arrays, axis=1)  # noqa: E731
        return replace(
            self,
            data=np.concatenate([p.data for p in parts], axis=1),
            references=tuple(d for p in parts for d in p.references),
            variance=stack([p.variance for p in parts]),
            coherence=stack([p.coherence for p in parts]),
            setups=stack([p.setups for p in parts]),
            name=common_name(parts),
            findings=tuple(dict.fromkeys(f for p in parts for f in p.findings)),
            provenance=self.provenance if len(parts) == 1 else Provenance.merge(*(p.provenance for p in parts)),
        )

    def without_bands(self, bands: Sequence[tuple[float, float]]) -> Frf:
        """The lines outside these bands [Hz], ends of a band included in it."""
        keep = np.ones(len(self.axis), bool)
        for low, high in bands_of(bands, "bands left out"):
            keep[self.axis.band(low, high)] = False
        if not keep.any():
            f = self.frequencies_hz
            raise DataError(f"the bands left out hold all {f.size} lines, {f[0]:g} to {f[-1]:g} Hz", hint="leave lines to work on")
        return self if keep.all() else self.lines(keep)

    def select(self, responses: object = None, references: object = None) -> Frf:
        """Some rows and columns, by labels or patterns over them; a DOF asked for in the other sense changes sign.

        Raises
        ------
        DofError
            If a DOF is not measured.
        """
        resp, refs = named_dofs(responses, self.responses), named_dofs(references, self.references)
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

        Parameters
        ----------
        quantity : str
            One of the three, or another name of it (``compliance``, ``inertance``).

        Raises
        ------
        DataError
            If the quantity is unknown, or force over motion, which :meth:`values` gives.

        Examples
        --------
        >>> import operando
        >>> operando.Frf([[[1.0, 1.0]]], [1.0, 2.0], "1+Z", "1+Z").to_quantity("compliance").quantity
        'receptance'
        """
        quantity = quantity_named(quantity, reciprocals=False)
        power = QUANTITIES.index(quantity) - QUANTITIES.index(self.quantity)
        if power == 0:
            return self
        s = 2j * np.pi * self.frequencies_hz + self.exponential_window_rate
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = s**power
        factor[~np.isfinite(factor)] = np.nan
        var = None if self.variance is None else self.variance * np.abs(factor) ** 2
        return replace(self, data=self.data * factor, variance=var, quantity=quantity)

    def values(self, quantity: str) -> NDArray[np.complexfloating[Any, Any]]:
        """Numbers in any quantity, force over motion included.

        Parameters
        ----------
        quantity : str
            ``receptance``, ``mobility``, ``accelerance``, or ``dynamic_stiffness``, ``impedance``, ``apparent_mass``: 1/H pair by pair,
            what a force at the one DOF meets, all others free. The stiffness matrix of several DOFs is the inverse of the receptance
            matrix instead.

        Returns
        -------
        (n_responses, n_references, n_lines) complex array
            SI where ``si`` is true; NaN where H is zero.

        Raises
        ------
        DataError
            If the quantity is unknown.

        Examples
        --------
        >>> import operando
        >>> operando.Frf([[[1e-6]]], [1.0], "1+Z", "1+Z", "receptance").values("dynamic stiffness")[0, 0, 0].real
        np.float64(1000000.0)
        """
        name = quantity_named(quantity)
        if name not in RECIPROCALS:
            return self.to_quantity(name).data
        below = self.to_quantity(RECIPROCALS[name]).data
        with np.errstate(divide="ignore", invalid="ignore"):
            out = 1 / below
        out[~np.isfinite(out)] = np.nan
        return np.asarray(out)

    def __getitem__(self, dofs: Any) -> Frf:
        """FRFs of some DOFs: ``frf["7+Z", "12+Z"]``, ``frf["*Z", :]``, ``frf["7+Z"]`` (all references).

        Labels, lists of labels and patterns (``*``, ``?``); a DOF in the other sense changes sign.

        Raises
        ------
        DofError
            If a DOF is not measured.
        """
        pair = dofs if isinstance(dofs, tuple) else (dofs, None)
        if len(pair) != 2:
            raise DataError(f"an FRF has responses and references, {len(pair)} indices are given", hint='write frf["7+Z", "12+Z"]')
        return self.select(*pair)

    def at(self, frequencies: ArrayLike) -> NDArray[np.intp]:
        """Indices of the nearest lines."""
        hint = "give frequencies in Hz, as [12.1, 15.5]"
        f = np.atleast_1d(numbers_of(frequencies, "frequencies", hint))
        if not np.all(np.isfinite(f)):
            raise DataError(f"frequencies {frequencies!r:.60} are not all finite", hint=hint)
        lines = self.frequencies_hz
        above = np.searchsorted(lines[1:-1], f) + 1 if lines.size > 1 else np.zeros(f.size, np.intp)
        below = np.maximum(above - 1, 0)
        return np.asarray(np.where(f - lines[below] <= lines[above] - f, below, above), np.intp)

    def drive_points(self) -> list[tuple[int, int]]:
        """(response, reference) index pairs on the same node and axis."""
        return [(i, j) for j, r in enumerate(self.references) for i, d in enumerate(self.responses) if d.same_axis(r)]

    def both_ways(self) -> Iterator[tuple[Dof, Dof, NDArray[Any], NDArray[Any], NDArray[np.float64] | None]]:
        """Each pair of references that are also responses, as reciprocity is assessed by.

        Yields
        ------
        first, second : Dof
        forward, backward : (n_lines,) complex arrays
            H[second, first] and H[first, second], in the positive senses.
        variance : (n_lines,) float array or None
            Of their difference.
        """
        rows = DofIndex(self.responses)
        for b, second in enumerate(self.references):
            for a, first in enumerate(self.references[:b]):
                at_first, at_second = rows.find(first.unsigned), rows.find(second.unsigned)
                if at_first is None or at_second is None:
                    continue
                forward = self.data[at_second[0], a] * at_second[1] * first.sign
                backward = self.data[at_first[0], b] * at_first[1] * second.sign
                variance = None if self.variance is None else self.variance[at_second[0], a] + self.variance[at_first[0], b]
                yield first, second, forward, backward, variance

    def with_findings(self, findings: Sequence[Finding]) -> Frf:
        """The FRF with more annotations."""
        return replace(self, findings=(*self.findings, *findings))
