"""Time records: several channels on one clock."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import mapped
from operando.data.arrays import frozen, is_complex, number_of, positions_of
from operando.data.declared import check_fields, listed
from operando.data.findings import Finding
from operando.data.mapped import MappedSamples, RowStatistics, mapped_memmap, row_statistics, scaled_rows
from operando.data.objects import Noun, counted, names_text, plots
from operando.data.provenance import Provenance
from operando.dof import Dof
from operando.errors import DataError, DofError, UnitError
from operando.units import stated_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Channel:
    """What one row of a record is.

    Parameters
    ----------
    dof : Dof, str or None
        Where and in which sense it measures; None where not known. A text such as ``12+Z`` is read.
    quantity : str
        ``acceleration``, ``force``, ``velocity``, … or ``unknown``; a unit tells which one it is.
    unit : str
        Unit of the samples given with it (``m/s2``, ``g``, ``N``, ``lbf``), empty where not known. The channels of a record are in SI:
        :class:`TimeRecord` converts the samples and notes the unit given as ``source_unit``.
    name : str
        Channel name in the source.
    source_unit : str
        Unit as stated by the source (already converted).
    set : int or None
        Index of the set in its file, from 0.

    Raises
    ------
    DofError
        If a text is no DOF.
    UnitError
        If the quantity or the unit is not known, or the unit is of another quantity.

    Examples
    --------
    >>> import operando
    >>> operando.Channel("7-X", "acceleration", "m/s2").label
    '7-X'
    """

    dof: Dof | None
    quantity: str = "unknown"
    unit: str = ""
    name: str = ""
    source_unit: str = ""
    set: int | None = None

    def __post_init__(self) -> None:
        if self.dof is not None:
            object.__setattr__(self, "dof", Dof.parse(self.dof))
        try:
            object.__setattr__(self, "quantity", stated_unit(self.unit, self.quantity)[0])
        except UnitError as error:
            raise UnitError(error.message, where=f"channel {self.label}" if self.label else None, hint=error.hint) from None
        check_fields(self)

    @property
    def label(self) -> str:
        """DOF if there is one, else the name."""
        return str(self.dof) if self.dof is not None else self.name

    @property
    def is_force(self) -> bool:
        """Whether the channel measures an input (force or moment)."""
        return self.quantity in ("force", "moment", "reaction_force")


@dataclass(frozen=True, repr=False, eq=False)
class TimeRecord(Noun):
    """Evenly sampled channels of one run.

    Parameters
    ----------
    data : (n_channels, n_samples) float array
        Samples, each row in the unit of its channel; the record holds them in SI where the unit is known. Made read-only. Samples of
        more than 67 MB that lie in a file, or in a read-only memory map, stay there (:class:`operando.data.mapped.MappedSamples`).
    sampling_hz : float
        Sampling rate [Hz].
    channels : sequence of Channel
        One a row.
    start_s : float
        Time of the first sample [s].
    name : str
        File name or title of the run.
    findings : tuple of Finding
        Annotations.
    provenance : Provenance

    Raises
    ------
    DataError
        If shapes and labels disagree, the sampling rate is not positive, or something else than :class:`Channel` is given.

    Examples
    --------
    >>> import numpy as np, operando
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("3+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.zeros((2, 1000)), 500.0, channels)
    >>> record
    <TimeRecord: 1 force 1+Z; 1 response 3+Z; 1000 samples at 500 Hz, 2 s>

    Samples in another unit become SI:

    >>> record = operando.TimeRecord(np.ones((1, 1000)), 500.0, [operando.Channel("3+Z", "acceleration", "g")])
    >>> record.data[0, 0], record.channels[0].unit
    (np.float64(9.80665), 'm/s2')
    """

    data: NDArray[np.floating[Any]]
    sampling_hz: float
    channels: tuple[Channel, ...]
    start_s: float = 0.0
    name: str = ""
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", _samples(self.data))
        hint = 'write operando.Channel("3+Z", "acceleration", "m/s2") for each row'
        channels = tuple(self.channels) if isinstance(self.channels, Iterable) else (self.channels,)
        if not all(isinstance(c, Channel) for c in channels):
            found = f"{channels!r:.100}: 'channels' of TimeRecord is tuple of other things, expected tuple[Channel, ...]"
            raise DataError(found, where=self.name or None, hint=hint)
        object.__setattr__(self, "channels", channels)
        object.__setattr__(self, "findings", listed(self.findings))
        if self.data.shape[0] != len(self.channels):
            raise DataError(f"{self.data.shape[0]} rows but {len(self.channels)} channel labels", where=self.name or None)
        object.__setattr__(self, "sampling_hz", number_of(self.sampling_hz, "sampling rate", "give the samples in a second [Hz]"))
        object.__setattr__(self, "start_s", number_of(self.start_s, "start_s", "give the time of the first sample [s]"))
        check_fields(self)
        if not self.sampling_hz > 0:
            raise DataError(f"sampling rate {self.sampling_hz} Hz is not positive", where=self.name or None)
        scales = [stated_unit(c.unit, c.quantity) for c in self.channels]
        if any(unit != c.unit for c, (_, unit, _) in zip(self.channels, scales, strict=True)):
            object.__setattr__(self, "data", _samples(scaled_rows(self.data, [factor for _, _, factor in scales])))
            in_si = (
                c if unit == c.unit else replace(c, unit=unit, source_unit=c.source_unit or c.unit)
                for c, (_, unit, _) in zip(self.channels, scales, strict=True)
            )
            object.__setattr__(self, "channels", tuple(in_si))

    def facts(self) -> dict[str, str]:
        """What the short form says."""
        forces = [self.channels[i].label for i in self.force_indices]
        motion = [self.channels[i].label for i in self.response_indices]
        others = len(self.channels) - len(forces) - len(motion)
        return {
            "Name": self.name,
            "Forces": f"{counted(len(forces), 'force')} {names_text(forces)}" if forces else "",
            "Responses": f"{counted(len(motion), 'response')} {names_text(motion)}" if motion else "",
            "Other channels": f"{counted(others, 'other channel')}" if others else "",
            "Samples": f"{self.n_samples} samples at {self.sampling_hz:g} Hz, {self.duration_s:g} s",
            "Findings": counted(len(self.findings), "finding") if self.findings else "",
        }

    def plot(self, axes: Axes | None = None, *, channels: object = None) -> Axes:
        """Samples over time, each channel below the other (:func:`operando.plots.plot_record`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
            All channels over one another, which needs one quantity. Default: a new figure.
        channels : DOF labels or channel names, optional
            Default: the first eight.

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_record(self, axes, channels=channels)
        return made

    def plot_psd(
        self,
        axes: Axes | None = None,
        *,
        channels: object = None,
        block_seconds: float | None = None,
        band: tuple[float, float] | None = None,
    ) -> Axes:
        """Power spectral densities (:func:`operando.plots.plot_psd`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        channels : DOF labels or channel names, optional
            Default: the first eight.
        block_seconds : float, optional
            Length of a block [s].
        band : (float, float), optional
            Band shown [Hz].

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_psd(self, axes, channels=channels, block_seconds=block_seconds, band=band)
        return made

    def plot_force_spectra(self, axes: Axes | None = None, *, band: tuple[float, float] | None = None) -> Axes:
        """What the forces excite: the spectrum of each hit, else the density of each force (:func:`operando.plots.plot_force_spectra`).

        Parameters
        ----------
        axes : matplotlib Axes, optional
        band : (float, float), optional
            Band shown [Hz].

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_force_spectra(self, axes, band=band)
        return made

    def plot_hits(self, axes: Axes | None = None) -> Axes:
        """The hits of a hammer record over one another, with their numbers (:func:`operando.plots.plot_hits`).

        Parameters
        ----------
        axes : matplotlib Axes, optional

        Returns
        -------
        matplotlib Axes
        """
        made: Axes = plots().plot_hits(self, axes)
        return made

    @cached_property
    def statistics(self) -> RowStatistics:
        """Mean, standard deviation, extremes of each channel, and whether all its samples are finite: one pass, made once."""
        return row_statistics(self.data)

    @property
    def n_samples(self) -> int:
        """Samples a channel."""
        return int(self.data.shape[1])

    @property
    def duration_s(self) -> float:
        """Length [s]: samples over rate."""
        return self.n_samples / self.sampling_hz

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Time of each sample [s]."""
        return self.start_s + np.arange(self.n_samples) / self.sampling_hz

    @property
    def force_indices(self) -> list[int]:
        """Rows that measure forces."""
        return [i for i, c in enumerate(self.channels) if c.is_force]

    @property
    def response_indices(self) -> list[int]:
        """Rows that measure motion with a DOF (acceleration, velocity or displacement)."""
        return [i for i, c in enumerate(self.channels) if c.dof is not None and c.quantity in ("acceleration", "velocity", "displacement")]

    def select(self, rows: Sequence[int]) -> TimeRecord:
        """The record with some of its rows, in the order given."""
        numbers = positions_of(rows, len(self.channels), "channels").tolist()
        return replace(self, data=self.data[numbers], channels=tuple(self.channels[i] for i in numbers))

    def rows(self, wanted: Any) -> list[tuple[int, Dof | None]]:
        """Rows of channels named by DOF or by name, and the DOF each was asked for (None: by its name).

        Parameters
        ----------
        wanted : str, Dof, or several
            ``"3+Z"`` (the sensor of motion there, else the force), ``"3+Z:force"`` (a quantity there), a channel name, a pattern
            (``"*Z"``).

        Raises
        ------
        DofError
            If there is no such channel; one of a similar name is told.
        """
        if wanted is None or wanted is Ellipsis or (isinstance(wanted, slice) and wanted == slice(None)):
            return [(i, None) for i in range(len(self.channels))]
        if not isinstance(wanted, str | Dof | Iterable):
            raise DofError(
                f"{wanted!r} is no channel", hint='write a DOF or a channel name: record["3+Z"]; rows by number: record.select([0])'
            )
        if isinstance(wanted, str | Dof):
            names = [wanted] if not isinstance(wanted, str) or wanted in {c.name for c in self.channels} else wanted.split(",")
        else:
            names = list(wanted)
        out: list[tuple[int, Dof | None]] = []
        for name in names:
            out += [found for found in self._channel(name) if found not in out]
        if not out:
            raise DofError(f"{wanted!r} names no channel", where=self.name or None, hint="channels: " + ", ".join(self._labels()[:40]))
        return out

    def _labels(self) -> list[str]:
        """What each channel is called in square brackets."""
        motion = set(self.response_indices)
        return [c.label + ("" if i in motion else f":{c.quantity}") for i, c in enumerate(self.channels)]

    def _channel(self, wanted: str | Dof) -> list[tuple[int, Dof | None]]:
        text = str(wanted).strip()
        label, _, quantity = text.rpartition(":") if re.search(r":[a-z_]+$", text) else (text, "", "")
        rows = [i for i, c in enumerate(self.channels) if not quantity or c.quantity == quantity]
        if not quantity:
            named = [i for i in rows if self.channels[i].name == text]
            if named and (len(named) == 1 or not any(str(self.channels[i].dof) == text for i in rows)):
                return [(i, None) for i in named]
        motion = set(self.response_indices)
        if "*" in label or "?" in label:
            found = [i for i in rows if fnmatchcase(self.channels[i].label, label)]
            if found:
                return [(i, None) for i in found]
        else:
            try:
                dof = Dof.parse(label)
            except DofError:
                dof = None
            there = [] if dof is None else [i for i in rows if (d := self.channels[i].dof) is not None and d.same_axis(dof)]
            if there:
                return [(next((i for i in there if i in motion), there[0]), dof)]
        labels = self._labels()
        near = get_close_matches(text, [*labels, *(c.name for c in self.channels)], 1, 0.5)
        hint = (f"did you mean {near[0]!r}? " if near else "") + "channels: " + ", ".join(labels[:40])
        raise DofError(f"there is no channel {text!r}", where=self.name or None, hint=hint)

    def __getitem__(self, channels: Any) -> TimeRecord:
        """Some of the channels: ``record["3+Z"]``, ``record["3+Z:force"]``, ``record["*Z"]``, ``record[["1+Z", "ch2"]]``.

        A DOF in the other sense changes sign. A DOF alone means the sensor of motion where there is one.

        Raises
        ------
        DofError
            If there is no such channel.
        """
        found = self.rows(channels)
        part = self.select([i for i, _ in found])
        turned = [dof is not None and (d := self.channels[i].dof) is not None and dof.sign != d.sign for i, dof in found]
        if not any(turned):
            return part
        signs = np.where(turned, -1, 1).astype(part.data.dtype)
        labels = tuple(replace(c, dof=c.dof.opposite) if t and c.dof is not None else c for c, t in zip(part.channels, turned, strict=True))
        return replace(part, data=np.asarray(part.data) * signs[:, None], channels=labels)

    def cut(self, start_s: float | None = None, stop_s: float | None = None) -> TimeRecord:
        """The part of the record from one time to another, on its own time axis.

        Parameters
        ----------
        start_s, stop_s : float, optional
            First time, and the time before which it ends [s]. Default: the beginning, the end.

        Raises
        ------
        DataError
            If a time lies outside the record by more than a sample, or fewer than two samples lie between them.
        """
        end = self.start_s + self.duration_s
        for name, value in (("start_s", start_s), ("stop_s", stop_s)):
            if value is not None and not self.start_s - 1 / self.sampling_hz <= value <= end + 1 / self.sampling_hz:
                raise DataError(
                    f"{name} = {value:g} s lies outside the record, which is {self.duration_s:g} s long ({self.start_s:g} to {end:g} s)",
                    where=self.name or None,
                )
        first = 0 if start_s is None else max(0, int(np.ceil((start_s - self.start_s) * self.sampling_hz - 1e-6)))
        last = self.n_samples if stop_s is None else min(self.n_samples, int(np.ceil((stop_s - self.start_s) * self.sampling_hz - 1e-6)))
        if last - first < 2:
            raise DataError(
                f"{max(last - first, 0)} samples between start_s and stop_s of a record of {self.duration_s:g} s",
                where=self.name or None,
            )
        begins, ends = self.start_s + first / self.sampling_hz, self.start_s + last / self.sampling_hz
        return replace(
            self,
            data=self.data[:, first:last],
            start_s=begins,
            findings=tuple(f for f in self.findings if f.time_s is None or (f.time_s[0] <= ends and f.time_s[1] >= begins)),
            provenance=self.provenance.then(f"cut(start_s={begins:g}, stop_s={ends:g})"),
        )

    def with_findings(self, findings: Sequence[Finding]) -> TimeRecord:
        """The record with more annotations."""
        return replace(self, findings=(*self.findings, *findings))


def _samples(data: Any) -> Any:
    """Samples as a record holds them: a read-only array of floats, or what stays in its file."""
    if isinstance(data, MappedSamples):
        return data
    if isinstance(data, np.memmap) and data.ndim == 2 and data.mode == "r" and data.nbytes >= mapped.MAPPED_FROM and data.dtype.kind == "f":
        return mapped_memmap(data)
    if is_complex(data):
        raise DataError("record data are complex, samples are real", hint="FRFs and spectra are no record: operando.Frf holds FRFs")
    single = isinstance(data, np.ndarray) and data.dtype.kind == "f"
    return frozen(data, None if single else float, 2, "record data")
