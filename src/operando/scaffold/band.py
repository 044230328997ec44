"""A proposal for the analysis band, from the forces and the lines that were measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from operando.errors import OperandoError

if TYPE_CHECKING:
    from operando.scaffold.labels import Seen
    from operando.scaffold.look import Taken

HIGHEST = 0.4
"""Part of the sampling rate up to which a band is proposed: above it the filters of recorders begin to act."""
CYCLES = 10
"""Periods of the lowest frequency that a record holds at least: fewer tell neither frequency nor damping."""


@dataclass(frozen=True)
class Band:
    """A band [Hz] and where it comes from."""

    low_hz: float
    high_hz: float
    reason: str


def excited_band(record: Any) -> tuple[float, float] | None:
    """Frequencies [Hz] between which the forces of a record have power, None where that cannot be told."""
    from operando.ema import excited_limits

    widest = (CYCLES / record.duration_s, HIGHEST * record.sampling_hz)
    try:
        low, high = excited_limits(record, widest)
    except OperandoError:
        return None
    low, high = max(low, widest[0]), min(high, widest[1])
    return (low, high) if low < high else None


def proposed_band(taken: Sequence[Taken], seen: Seen) -> Band | None:
    """What all idle measurements have in common, None where nothing is known or nothing is common."""
    files = [t.file for t in taken if t.role in ("idle records", "idle frfs") and str(t.file) in seen.bands]
    raw = [t.file for t in taken if t.role == "idle records" and t.file in files]
    files = raw or files
    if not files:
        return None
    low, high = max(seen.bands[str(f)][0] for f in files), min(seen.bands[str(f)][1] for f in files)
    what = "the forces" if raw else "the lines"
    from operando.data import counted

    return Band(low, high, f"{what} of {counted(len(files), 'idle file')} reach over it") if low < high else None
