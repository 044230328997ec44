"""SEP005 of the SDyPy project: a measurement as a list of dicts, one a channel."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from operando.data import Channel, Finding, MappedSamples, Provenance, TimeRecord
from operando.data.arrays import owned
from operando.data.mapped import scaled_rows
from operando.dof import Dof
from operando.errors import DataError, DofError
from operando.io.quantities import Asked, ChannelSpecs, Units, check_stated, find_spec, quantity_from_words, resolve, spec_dof
from operando.io.uff.increments import even_step, tidy_rate
from operando.units import SI_UNIT


def make_record(
    data: Any,
    sampling_hz: float,
    names: Sequence[str],
    unit_texts: Sequence[str],
    *,
    start_s: float = 0.0,
    units: Units | None = None,
    channels: ChannelSpecs | None = None,
    source: str = "",
    provenance: Provenance | None = None,
) -> TimeRecord:
    """A record from an array (n_channels, n_samples) and what is known of its channels, converted to SI.

    A name that is a DOF label such as ``12+Z`` becomes its DOF; unit texts are empty where not known. The finding ``missing_unit`` names
    each channel that should have a unit and has none. ``source`` is the file, for findings.
    """
    array = data if isinstance(data, MappedSamples) else np.asarray(data)
    if array.ndim != 2 or array.shape[0] != len(names) or len(names) != len(unit_texts):
        raise DataError(f"data of shape {array.shape} for {len(names)} names and {len(unit_texts)} units", hint="(n_channels, n_samples)")
    rows: list[int] = []
    factors: list[float] = []
    labels, findings = [], []
    for i, (name, text) in enumerate(zip(names, unit_texts, strict=True)):
        dof = _dof_of(name)
        quantity = quantity_from_words(name)
        spec = find_spec(channels, name, dof, quantity == "force", i)
        dof = spec_dof(spec, dof)
        if spec.get("exclude"):
            reason = str(spec.get("reason") or "no reason given")
            findings.append(Finding("excluded", f"channel {name} excluded by [channels]: {reason}", "info", source or None, i, name))
            continue
        scale = resolve("unknown" if text and not spec.get("quantity") else quantity, text, units, spec, name=str(dof or name))
        if not scale.known and scale.quantity == "unknown" and quantity != "unknown":
            scale = resolve(quantity, "", units, spec)
        if not scale.known:
            findings.append(_missing_unit(name, scale.quantity, source, i))
        rows.append(i)
        factors.append(scale.factor)
        labels.append(Channel(dof, scale.quantity, scale.unit, name, scale.source_unit, i))
    if not rows:
        raise DataError("no channel is left", where=source or None, hint="[channels] excludes them all")
    part = array if len(rows) == len(array) else array[rows]
    data = scaled_rows(part, factors)
    if isinstance(data, np.ndarray) and not np.may_share_memory(data, array):
        data = owned(data)
    return TimeRecord(data, sampling_hz, tuple(labels), start_s, source, tuple(findings), provenance or Provenance())


def _dof_of(name: str) -> Dof | None:
    """DOF of a channel name that is a DOF label with a direction, or has one word that is (``acc 3+Z``); a bare number is a name."""
    try:
        dof = Dof.parse(name)
    except DofError:
        labels = [word for word in name.split() if _SIGNED_DOF.fullmatch(word)]
        return Dof.parse(labels[0]) if len(labels) == 1 else None
    return dof if dof.axis else None


_SIGNED_DOF = re.compile(r"[0-9]{1,9}[+-]R?[XYZ]", re.IGNORECASE)
"""A label among other words: the sign is asked for, since "3z" may be anything."""


def _missing_unit(name: str, quantity: str, source: str, i: int) -> Finding:
    return Finding(
        "missing_unit", f"no unit is known for channel {name}" + ("" if quantity == "unknown" else f" ({quantity})"), "warning",
        source or None, i, name, consequence="its numbers are kept as they are; nothing can be scaled to unit modal mass with them",
        action=f"give it in the test file: [channels] {_entry_that_lacks(name, quantity)}",
    )  # fmt: skip


def _entry_that_lacks(name: str, quantity: str) -> str:
    """An entry of [channels] that keeps the quantity of a channel; where nobody states one, it is said to be an example."""
    unit = SI_UNIT.get(quantity, "")
    if not unit:
        return f'"{name}" = {{quantity = "acceleration", unit = "m/s2"}}, if it is an acceleration in m/s2'
    entry = f'"{name}" = {{quantity = "{quantity}", unit = "{unit}"}}'
    if quantity == "voltage":
        return f"{entry}; where a sensor gives this voltage, quantity and unit of what it measures, and its sensitivity in V per unit"
    return entry


def from_sep005(
    measurement: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    *,
    units: Units | None = None,
    channels: ChannelSpecs | None = None,
    name: str = "",
) -> TimeRecord:
    """A record from a SEP005 measurement.

    Parameters
    ----------
    measurement : dict or list of dict
        Each with ``data``, ``name``, ``unit_str`` and ``fs`` or ``time``.
    units, channels : mappings, optional
        As for :func:`operando.io.read`.
    name : str
        Name of the record.

    Returns
    -------
    TimeRecord

    Raises
    ------
    DataError
        If a key is missing, or the channels differ in rate or length.

    Examples
    --------
    >>> import numpy as np, operando
    >>> rng = np.random.default_rng(0)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(rng.standard_normal((2, 1000)), 500.0, channels)
    >>> from operando.io import from_sep005, to_sep005
    >>> from_sep005(to_sep005(record))
    <TimeRecord: 1 force 1+Z; 1 response 2+Z; 1000 samples at 500 Hz, 2 s>
    """
    if not isinstance(measurement, Mapping | Sequence) or isinstance(measurement, str | bytes):
        raise DataError(f"{type(measurement).__name__} is no SEP005 measurement", hint="a dict, or a list of dicts, one a channel")
    items = [measurement] if isinstance(measurement, Mapping) else list(measurement)
    check_stated(units, channels)
    if not items:
        raise DataError("the SEP005 measurement holds no channel")
    rows, names, texts, rates, starts = [], [], [], [], []
    for i, item in enumerate(items):
        if not isinstance(item, Mapping) or "data" not in item:
            raise DataError(f"channel {i} of the SEP005 measurement has no 'data'")
        data = _samples(item["data"], i, "data")
        rate, start = _rate(item, data.size, i)
        rows.append(data)
        names.append(_text(item, "name", i) or f"ch{i + 1}")
        texts.append(_text(item, "unit_str", i))
        rates.append(rate)
        starts.append(start)
    if len({r.size for r in rows}) > 1 or not np.allclose(rates, rates[0], rtol=1e-9, atol=0):
        raise DataError(
            f"the channels have {sorted({r.size for r in rows})} samples at {sorted(set(rates))} Hz",
            hint="one record holds channels of one rate and length: make one for each",
        )
    asked = Asked(channels)
    record = make_record(np.stack(rows), rates[0], names, texts, start_s=starts[0], units=units, channels=asked, source=name)
    asked.check(name)
    return record


def _rate(item: Mapping[str, Any], samples: int, i: int) -> tuple[float, float]:
    if item.get("time") is not None:
        time = np.asarray(_samples(item["time"], i, "time"), float)
        if time.shape != (samples,) or samples < 2 or not np.all(np.diff(time) > 0):
            raise DataError(f"the time axis of channel {i} does not fit its data, or does not increase")
        step, off = even_step(time)
        if off > 0.01:
            raise DataError(f"channel {i} is not evenly sampled")
        return (_number(item, "fs", i) if item.get("fs") is not None else tidy_rate(step)), float(time[0])
    if item.get("fs") is None:
        raise DataError(f"channel {i} of the SEP005 measurement has neither 'fs' nor 'time'")
    return _number(item, "fs", i), 0.0 if item.get("start") is None else _number(item, "start", i, positive=False)


def _samples(value: Any, i: int, key: str) -> np.ndarray:
    """One-dimensional real numbers of a channel."""
    expected = f"'{key}' of channel {i} of the SEP005 measurement"
    try:
        array = np.asarray(value)
        array = array.astype(float) if array.dtype.kind == "O" else array
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{expected} holds no numbers: {error}", hint="a one-dimensional array of real numbers") from None
    if array.ndim != 1:
        raise DataError(f"{expected} has {array.ndim} dimensions instead of 1")
    if array.dtype.kind not in "fiu" or not array.size:
        what = f"values of type {array.dtype}" if array.size else "no value"
        raise DataError(f"{expected} holds {what}", hint="a one-dimensional array of real numbers")
    return array


def _number(item: Mapping[str, Any], key: str, i: int, positive: bool = True) -> float:
    try:
        value = float(item[key])
    except (ValueError, TypeError, OverflowError):
        value = float("nan")
    if not np.isfinite(value) or (positive and value <= 0):
        raise DataError(
            f"'{key}' of channel {i} of the SEP005 measurement is {item[key]!r:.100}, expected a {'positive ' * positive}number"
        )
    return value


def _text(item: Mapping[str, Any], key: str, i: int) -> str:
    value = item.get(key)
    if value is not None and not isinstance(value, str):
        raise DataError(f"'{key}' of channel {i} of the SEP005 measurement is {value!r:.100}, expected a text")
    return value or ""


def to_sep005(record: TimeRecord) -> list[dict[str, Any]]:
    """A record as SEP005: one dict a channel with ``data``, ``time``, ``fs``, ``name``, ``unit_str``, ``quantity``.

    Parameters
    ----------
    record : TimeRecord
        One record.

    Returns
    -------
    list of dict

    Examples
    --------
    >>> import numpy as np, operando
    >>> rng = np.random.default_rng(0)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(rng.standard_normal((2, 1000)), 500.0, channels)
    >>> from operando.io import to_sep005
    >>> [channel["unit_str"] for channel in to_sep005(record)]
    ['N', 'm/s2']
    """
    return [
        {
            "data": row,
            "time": record.time_s,
            "fs": record.sampling_hz,
            "name": channel.label,
            "unit_str": channel.unit or channel.source_unit,
            "quantity": channel.quantity,
        }
        for row, channel in zip(record.data, record.channels, strict=True)
    ]
