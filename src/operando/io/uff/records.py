"""Time records from the time functions of a UFF file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Channel, StoredFile, StoredRow, TimeRecord, mapped, mapped_rows
from operando.data.arrays import owned
from operando.dof import Node
from operando.errors import FormatError, UnitError
from operando.io.quantities import Scale, code_quantity, find_spec, quantity_from_words, resolve, spec_dof
from operando.io.uff.header58 import Header58
from operando.io.uff.increments import even_step, tidy_rate
from operando.io.uff.inventory import Inventory
from operando.io.uff.split import RawSet
from operando.io.uff.values58 import fill_real, natural_dtype, read_values, stored_dtype
from operando.units import parse_unit


@dataclass
class _Row:
    raw: RawSet
    header: Header58
    channel: Channel
    scale: Scale
    sampling_hz: float
    start_s: float
    values: NDArray[Any] | None = None


def is_time_function(header: Header58) -> bool:
    """Time responses, and general functions over time."""
    return header.function_type == 1 or (header.function_type == 0 and header.abscissa.code == 17 and not header.is_complex)


def assemble_records(stream: IO[bytes], functions: list[RawSet], inventory: Inventory) -> tuple[TimeRecord, ...]:
    """One record for each sampling rate, length and start among the time functions of a file."""
    rows = [row for position, raw in enumerate(functions) if (row := _row(raw, position, inventory)) is not None]
    groups: dict[tuple[float, int, float], list[_Row]] = {}
    for row in rows:
        groups.setdefault((float(f"{row.sampling_hz:.9g}"), row.header.points, float(f"{row.start_s:.9g}")), []).append(row)
    _note_unequal(list(groups), inventory)
    records = []
    for group in groups.values():
        record = _record(stream, group, inventory)
        if record is not None:
            records.append(record)
    return tuple(records)


def _row(raw: RawSet, position: int, inventory: Inventory) -> _Row | None:
    header = raw.header
    assert header is not None
    if header.is_complex:
        inventory.ignore(raw, header.title, "a complex time function")
        return None
    stated = code_quantity(header.ordinate.code, header.response)
    spec = find_spec(inventory.channels, header.name, header.response, stated in ("force", "moment"), position)
    dof = spec_dof(spec, header.response)
    if spec.get("exclude"):
        inventory.ignore(raw, header.title, "excluded by [channels]: " + str(spec.get("reason") or "no reason given"))
        return None
    if stated == "unknown" and not header.ordinate.unit:
        stated = quantity_from_words(header.ordinate.label)
    label, system = str(dof) if dof is not None else header.name, inventory.system_at(raw.index)
    scale = resolve(stated, header.ordinate.unit, inventory.units, spec, system, header.ordinate.exponents, label)
    if scale.problem:
        inventory.note(
            "unit_conflict", f"set {raw.index}: {scale.problem}", raw, label, action="say the unit in [channels] of the test file"
        )
    if not scale.known and scale.quantity not in ("unknown", "order", "rpm", "voltage"):
        _note_missing_unit(scale.quantity, raw, label, inventory)
    try:
        rate, start, values = _sampling(raw, header, inventory)
    except FormatError as error:
        inventory.refuse(raw, header.title, error.message)
        return None
    channel = Channel(dof, scale.quantity, scale.unit, header.name, scale.source_unit, raw.index)
    return _Row(raw, header, channel, scale, rate, start, values)


def _note_missing_unit(quantity: str, raw: RawSet, label: str, inventory: Inventory) -> None:
    inventory.note(
        "missing_unit", f"the file states no unit for the {quantity} {label}", raw, label,
        consequence="the numbers are kept as they are; nothing can be scaled to unit modal mass with them",
        action=f'give it in the test file: [units] {quantity} = "…" (for example "m/s2", "g", "N", "lbf")',
    )  # fmt: skip


def _sampling(raw: RawSet, header: Header58, inventory: Inventory) -> tuple[float, float, NDArray[Any] | None]:
    """Rate [Hz], start [s], and the values where they had to be read to know."""
    factor = 1.0
    if header.abscissa.unit:
        try:
            factor = parse_unit(header.abscissa.unit, "time")[1]
        except UnitError:
            inventory.note("unit_conflict", f"set {raw.index}: time axis in {header.abscissa.unit!r}, taken as seconds", raw)
    if header.even:
        return tidy_rate(header.step * factor), header.start * factor, None
    abscissa, values = read_values(inventory.buffer, raw)
    assert abscissa is not None
    time = abscissa * factor
    if time.size < 2 or not np.all(np.isfinite(time)) or not np.all(np.diff(time) > 0):
        raise FormatError("the time axis does not increase")
    step, off = even_step(time)
    if off > 0.01:
        raise FormatError(f"the samples are not evenly spaced: up to {off:.3g} samples off; resample the data at a constant rate")
    return tidy_rate(step), float(time[0]), values


def _record(stream: IO[bytes], group: list[_Row], inventory: Inventory) -> TimeRecord | None:
    dtype = np.result_type(*[natural_dtype(row.header) for row in group])
    if (stays := _mapped(group, dtype, inventory)) is not None:
        return stays
    data = np.empty((len(group), group[0].header.points), dtype)
    good: list[int] = []
    for i, row in enumerate(group):
        try:
            if row.values is not None:
                data[i] = row.values
                row.values = None
            else:
                fill_real(stream, inventory.buffer, row.raw, data[i])
        except FormatError as error:
            inventory.refuse(row.raw, row.header.title, error.message)
            continue
        if row.scale.factor != 1.0:
            with np.errstate(over="ignore", invalid="ignore"):
                data[i] *= data.dtype.type(row.scale.factor)
        good.append(i)
    if not good:
        return None
    return _labelled(data if len(good) == len(group) else data[good], [group[i] for i in good], inventory)


def _mapped(group: list[_Row], dtype: np.dtype[Any], inventory: Inventory) -> TimeRecord | None:
    """The record with its samples left in the file, where they are many and lie there as plain numbers."""
    points = group[0].header.points
    plain = all(row.header.binary and row.header.even and row.values is None and row.raw.payload is not None for row in group)
    if len(group) * points * dtype.itemsize < mapped.MAPPED_FROM or not plain or not isinstance(inventory.buffer, mmap):
        return None
    rows = [StoredRow(row.raw.payload[0], stored_dtype(row.header), row.scale.factor) for row in group if row.raw.payload is not None]
    return _labelled(mapped_rows(StoredFile(Path(inventory.file)), rows, points, dtype), group, inventory)


def _labelled(data: Any, rows: list[_Row], inventory: Inventory) -> TimeRecord:
    for row in rows:
        note = f"{row.scale.source_unit or 'no unit'} → {row.scale.unit or 'numbers kept'} ({row.scale.origin})" if row.scale.origin else ""
        inventory.use(row.raw, row.header.title, note)
    channels = tuple(row.channel for row in rows)
    _note_duplicates(channels, inventory)
    data = owned(data) if isinstance(data, np.ndarray) else data
    return TimeRecord(data, rows[0].sampling_hz, channels, rows[0].start_s, inventory.file, provenance=inventory.provenance)


def _note_duplicates(channels: tuple[Channel, ...], inventory: Inventory) -> None:
    seen: dict[tuple[Node, str, str], Channel] = {}
    for channel in channels:
        if channel.dof is None:
            continue
        key = (channel.dof.node, channel.dof.axis, channel.quantity)
        if key in seen:
            inventory.findings.append(_duplicate(channel, seen[key], inventory.file))
        seen.setdefault(key, channel)


def _duplicate(channel: Channel, first: Channel, file: str) -> Any:
    from operando.data import Finding

    return Finding(
        "duplicate_channel", f"{channel.quantity} at {channel.dof} is in sets {first.set} and {channel.set}", "warning", file, channel.set,
        str(channel.dof), consequence="both stay in the record", action="exclude one in [channels], or put each run into its own file",
    )  # fmt: skip


def _note_unequal(keys: list[tuple[float, int, float]], inventory: Inventory) -> None:
    counts: Mapping[str, list[Any]] = {
        "unequal_rate": sorted({k[0] for k in keys}),
        "unequal_length": sorted({k[1] for k in keys}),
        "unequal_start": sorted({k[2] for k in keys}),
    }
    names = {"unequal_rate": "sampling rates [Hz]", "unequal_length": "numbers of samples", "unequal_start": "start times [s]"}
    for kind, values in counts.items():
        if len(values) > 1:
            inventory.note(
                kind, f"the channels of the file have different {names[kind]}: {', '.join(f'{v:g}' for v in values[:8])}",
                consequence=f"they became {len(keys)} records of equal sampling",
                action="export all channels of a run with one rate and length",
            )  # fmt: skip
