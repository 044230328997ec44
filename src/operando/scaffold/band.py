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


def held_band(record: Any) -> tuple[float, float]:
    """Frequencies [Hz] that a record can hold: ``CYCLES`` periods of the lowest, ``HIGHEST`` of its sampling rate."""
    return CYCLES / record.duration_s, HIGHEST * record.sampling_hz


def excited_band(record: Any) -> tuple[float, float] | None:
    """Frequencies [Hz] between which the forces of a record have power, None where that cannot be told."""
    from operando.ema import excited_limits

    widest = held_band(record)
    try:
        low, high = excited_limits(record, widest)
    except OperandoError:
        return None
    low, high = max(low, widest[0]), min(high, widest[1])
    return (low, high) if low < high else None


def proposed_band(taken: Sequence[Taken], seen: Seen) -> Band | None:
    """What all idle measurements have in common, within what all records hold; None where nothing is known or nothing is common.

    Where no force and no FRF says more it is what the records hold. Records too slow or too short for anything in common with the idle
    measurements do not narrow these.
    """
    from operando.data import counted

    held = _common([seen.held[str(t.file)] for t in taken if t.role.endswith("records") and str(t.file) in seen.held])
    files = [t.file for t in taken if t.role in ("idle records", "idle frfs") and str(t.file) in seen.bands]
    raw = [t.file for t in taken if t.role == "idle records" and t.file in files]
    files = raw or files
    if not files:
        slowest = f"sampled at {min(seen.rates, default=0):.6g} Hz" + (" or more" if len(seen.rates) > 1 else "")
        return None if held is None else Band(*held, f"what all records hold, {slowest}")
    common = _common([seen.bands[str(f)] for f in files])
    if common is None:
        return None
    what = "the forces" if raw else "the lines"
    return Band(*(_common([common, held or common]) or common), f"{what} of {counted(len(files), 'idle file')} reach over it")


def _common(bands: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """What some bands have in common, None where it is nothing."""
    if not bands:
        return None
    low, high = max(b[0] for b in bands), min(b[1] for b in bands)
    return (low, high) if low < high else None
