"""TDMS files of LabVIEW, by npTDMS (the extra ``tdms``)."""

from __future__ import annotations

import logging
import struct
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from operando.data import Finding, Frf, MappedSamples, TimeRecord, mapped, pieces
from operando.errors import FormatError, MissingError
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units, stated_rate
from operando.io.safe import check_growth, try_apart
from operando.io.sep005 import make_record
from operando.io.uff.increments import tidy_rate
from operando.io.uff.reader import provenance_of
from operando.io.variables import Source, make_frf

_UNIT_KEYS = ("unit_string", "NI_UnitDescription", "Unit")


def read_tdms(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read the channels of a TDMS file: those of one rate and length are one record, complex ones FRFs.

    The rate is the waveform increment of the channels, else ``units["sampling_hz"]``.
    """
    path = Path(path)
    where = str(path)
    load_library(where)
    try_apart(path, "tdms")
    provenance = provenance_of(path)
    source = Source(where, [], units, channels, provenance)
    series: dict[tuple[float, float, int], list[tuple[str, str, Any, int]]] = {}
    frfs: list[Frf] = []
    listed, said = _load(path)
    findings = [
        Finding(
            "damaged",
            f"the samples of the TDMS file: {text}",
            "warning",
            where,
            consequence="samples may be missing",
            action="export it again",
        )
        for text in dict.fromkeys(said)
    ]
    infos: list[SetInfo] = []
    for i, (name, unit, increment, offset, values, kind) in enumerate(listed):
        note = ""
        rate = stated_rate(units, []) or (tidy_rate(increment) if increment else None)
        if values.dtype.kind not in "biufc" or values.size < 2:
            note = f"{values.size} values of {values.dtype}: no signal"
        elif values.dtype.kind == "c" and increment:
            lines = offset + increment * np.arange(values.size)
            frf, found = make_frf(values[None, None].astype(complex), lines, name, source, [name])
            frfs.append(frf)
            findings += found
        elif "freq" in kind.lower():
            note = "a spectrum without phase"
        elif rate is None:
            note = "no waveform increment: give [units] sampling_hz in the test file"
        else:
            series.setdefault((rate, offset, values.size), []).append((name, unit, values, i))
        infos.append(SetInfo(i, 0, f"channel {name}", "ignored" if note else "used", note))
    records: list[TimeRecord] = []
    for (rate, start, _), rows in series.items():
        data = _together([values for _, _, values, _ in rows])
        names, texts = [name for name, _, _, _ in rows], [unit for _, unit, _, _ in rows]
        records.append(
            make_record(data, rate, names, texts, start_s=start, units=units, channels=channels, source=where, provenance=provenance)
        )
        findings += records[-1].findings
    if not records and not frfs:
        seen = "; ".join(f"{s.title}: {s.note}" for s in infos[:6]) or "no channel"
        raise FormatError(f"no channel with a rate ({seen})", where=where, hint="give [units] sampling_hz in the test file")
    return Content(where, "tdms", tuple(records), tuple(frfs), sets=tuple(infos), findings=tuple(findings))


def _together(rows: list[Any]) -> Any:
    """Channels of one length as rows of floats; they stay in the file where they do."""
    if not any(isinstance(row, MappedSamples) for row in rows):
        return np.stack([np.asarray(row, np.float32 if row.dtype == np.float32 else np.float64) for row in rows])
    dtype = np.result_type(*[np.float32 if row.dtype == np.float32 else np.float64 for row in rows])

    def read(wanted: Sequence[int], first: int, last: int) -> np.ndarray:
        return np.stack([np.asarray(rows[k][0, first:last], dtype) for k in wanted])

    return MappedSamples(read, (len(rows), rows[0].size), dtype)


def load_library(where: str) -> Any:
    """The library npTDMS."""
    try:
        import nptdms
    except ImportError as error:
        hint = 'install it with: pip install "operando[tdms]"'
        raise MissingError("a TDMS file; reading it needs npTDMS, which is not installed", where=where, hint=hint) from error
    return nptdms


def try_tdms(path: Path, alive: Callable[[], None] = lambda: None) -> None:
    """Read all channels once (see :func:`operando.io.safe.try_apart`)."""
    alive()
    for *_, values, _ in _load(path)[0]:
        if isinstance(values, MappedSamples):
            for _ in pieces(values, 1 << 20):
                alive()


def _load(path: Path) -> tuple[list[tuple[str, str, float, float, Any, str]], list[str]]:
    """Name, unit, increment (0: none), offset, values and name of the axis of each channel; what the library says of damage."""
    nptdms = load_library(str(path))
    found = []
    with _heard() as said, ExitStack() as at_end:
        file = nptdms.TdmsFile.open(str(path))
        at_end.enter_context(file)
        listed = [channel for group in file.groups() for channel in group.channels()]
        plain = all(channel.dtype is not None and channel.dtype.kind != "O" for channel in listed)
        needed = sum(len(channel) * (channel.dtype.itemsize if channel.dtype is not None else 8) for channel in listed)
        check_growth(needed, path.stat().st_size, str(path), "what the channels declare")
        names = [channel.name for channel in listed]
        holder = _Holder()
        stays = plain and needed >= mapped.MAPPED_FROM
        for channel in listed:
            given = channel.properties
            name = channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}"
            unit = next((str(given[key]) for key in _UNIT_KEYS if given.get(key)), "")
            step, offset = _number(given.get("wf_increment")), _number(given.get("wf_start_offset"))
            values = _mapped(channel, holder) if stays and channel.dtype.kind in "iuf" else np.asarray(channel[:])
            found.append((name, unit, step if step > 0 else 0.0, offset, values, str(given.get("wf_xname", ""))))
        if stays:
            weakref.finalize(holder, at_end.pop_all().close)  # the file stays open as long as its samples may be asked for
    stored = _stored_bytes(path) if plain else None
    if stored is not None and stored > needed:
        said.append(f"{stored} bytes of samples are stored, the channels take {needed}")
    return found, said


class _Holder:
    """What the samples of an open file hold on to: the file is closed when the last of them go."""


def _mapped(channel: Any, holder: _Holder) -> MappedSamples:
    """Samples of one channel that stay in the file, which is kept open with them."""

    def read(rows: Sequence[int], first: int, last: int, holder: _Holder = holder) -> np.ndarray:
        return np.asarray(channel.read_data(offset=first, length=last - first))[np.newaxis]

    return MappedSamples(read, (1, len(channel)), channel.dtype)


_BIG_ENDIAN, _DAQMX = 1 << 6, 1 << 7
_LEAD = 28


def _stored_bytes(path: Path) -> int | None:
    """Bytes of samples by the lead-ins of all segments (TDMS file format, National Instruments); None where cards stored them raw."""
    size, at, total = path.stat().st_size, 0, 0
    with path.open("rb") as stream:
        while at + _LEAD <= size:
            stream.seek(at)
            lead = stream.read(_LEAD)
            (contents,) = struct.unpack_from("<I", lead, 4)
            if contents & _DAQMX:
                return None
            following, begin = struct.unpack_from(">QQ" if contents & _BIG_ENDIAN else "<QQ", lead, 12)
            stop = min(size, at + _LEAD + following)
            total += max(0, stop - (at + _LEAD + begin))
            at = stop
    return total


@contextmanager
def _heard() -> Iterator[list[str]]:
    """What npTDMS logs of damage (data cut off, names that are no Unicode) in a list; it would go to the terminal."""
    said: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())

    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("nptdms")]
    before = [(logger.handlers, logger.propagate) for logger in loggers]
    try:
        for logger in loggers:
            logger.handlers, logger.propagate = [Listener()], False
        yield said
    finally:
        for logger, (handlers, propagate) in zip(loggers, before, strict=True):
            logger.handlers, logger.propagate = handlers, propagate


def _number(value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        return 0.0
    return number if np.isfinite(number) else 0.0
