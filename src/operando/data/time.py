"""Time records: several channels on one clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data.arrays import frozen
from operando.data.findings import Finding
from operando.data.provenance import Provenance
from operando.dof import Dof
from operando.errors import DataError


@dataclass(frozen=True)
class Channel:
    """What one row of a record is.

    Parameters
    ----------
    dof : Dof or None
        Where and in which sense it measures; None where not known.
    quantity : str
        ``acceleration``, ``force``, ``velocity``, … or ``unknown``.
    unit : str
        Unit of the data as held. SI (``m/s2``, ``N``) wherever the unit was known; empty where it was not.
    name : str
        Channel name in the source.
    source_unit : str
        Unit as stated by the source (already converted).
    set : int or None
        Index of the set in its file, from 0.
    """

    dof: Dof | None
    quantity: str = "unknown"
    unit: str = ""
    name: str = ""
    source_unit: str = ""
    set: int | None = None

    @property
    def label(self) -> str:
        """DOF if there is one, else the name."""
        return str(self.dof) if self.dof is not None else self.name

    @property
    def is_force(self) -> bool:
        """Whether the channel measures an input (force or moment)."""
        return self.quantity in ("force", "moment", "reaction_force")


@dataclass(frozen=True)
class TimeRecord:
    """Evenly sampled channels of one run.

    Parameters
    ----------
    data : (n_channels, n_samples) float array
        Samples, SI where the units are known. Made read-only.
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
        If shapes and labels disagree or the sampling rate is not positive.
    """

    data: NDArray[np.floating[Any]]
    sampling_hz: float
    channels: tuple[Channel, ...]
    start_s: float = 0.0
    name: str = ""
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        data = np.asarray(self.data)
        if not np.issubdtype(data.dtype, np.floating):
            data = data.astype(float)
        object.__setattr__(self, "data", frozen(data, ndim=2, name="record data"))
        object.__setattr__(self, "channels", tuple(self.channels))
        object.__setattr__(self, "findings", tuple(self.findings))
        if self.data.shape[0] != len(self.channels):
            raise DataError(f"{self.data.shape[0]} rows but {len(self.channels)} channel labels", where=self.name or None)
        if not (np.isfinite(self.sampling_hz) and self.sampling_hz > 0):
            raise DataError(f"sampling rate {self.sampling_hz} Hz is not positive", where=self.name or None)

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
        return replace(self, data=self.data[list(rows)], channels=tuple(self.channels[i] for i in rows))

    def with_findings(self, findings: Sequence[Finding]) -> TimeRecord:
        """The record with more annotations."""
        return replace(self, findings=(*self.findings, *findings))
