"""WAV files: samples as a fraction of full scale; the file knows neither units nor DOFs."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, MappedSamples, StoredFile, mapped
from operando.data.mapped import PIECE
from operando.errors import FormatError
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units
from operando.io.sep005 import make_record
from operando.io.uff.reader import map_file, open_file, provenance_of

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE


def read_wav(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read a RIFF WAVE file (PCM of 8 to 32 bits, float of 32 or 64 bits).

    Whole numbers become a fraction of full scale; the channels are ``ch1``, ``ch2``, …: [channels] says what they measure, and
    ``sensitivity`` the fraction of full scale per unit.
    """
    path = Path(path)
    where = str(path)
    with open_file(path) as stream:
        long = path.stat().st_size >= mapped.MAPPED_FROM
        raw = memoryview(map_file(stream, where) if long else stream.read())
    chunks = _chunks(raw, where)
    head = bytes(raw[chunks[b"fmt "]]) if b"fmt " in chunks else b""
    if len(head) < 16 or b"data" not in chunks:
        raise FormatError("no format or no data in the WAV file", where=where, hint="the file is damaged: export it again")
    coding, count, rate, _, frame, bits = struct.unpack_from("<HHIIHH", head)
    if coding == _EXTENSIBLE and len(head) >= 26:
        (coding,) = struct.unpack_from("<H", head, 24)
    body = raw[chunks[b"data"]]
    width = bits // 8
    known = (coding == _PCM and bits in (8, 16, 24, 32)) or (coding == _FLOAT and bits in (32, 64))
    if not known or not count or not rate or frame != count * width or not body or len(body) % frame:
        raise FormatError(
            f"coding {coding}, {count} channels of {bits} bits at {rate} Hz, {len(body)} bytes of data: not understood", where=where,
            hint="export PCM or float WAV",
        )  # fmt: skip
    data: Any = _mapped(path, chunks[b"data"], coding, bits, count) if long else _samples(body, coding, bits, count)
    del raw, body
    names = [f"ch{i + 1}" for i in range(count)]
    provenance = provenance_of(path)
    record = make_record(data, float(rate), names, [""] * count, units=units, channels=channels, source=where, provenance=provenance)
    scale = "as stored" if coding == _FLOAT else "a fraction of full scale"
    note = Finding(
        "missing_unit", f"a WAV file knows no units: the numbers are {scale}", "info", where,
        consequence="without unit and sensitivity there is no mass scaling and no FRF in SI",
        action='give them in the test file: [channels] ch1 = {dof = "12+Z", quantity = "acceleration", unit = "g", sensitivity = 0.1}',
    )  # fmt: skip
    sets = tuple(SetInfo(i, 0, f"channel {name}") for i, name in enumerate(names))
    return Content(where, "wav", (record,), sets=sets, findings=(note, *record.findings))


def _chunks(raw: memoryview, where: str) -> dict[bytes, slice]:
    """Where the chunks of the file lie, by name, the first of each; a chunk longer than the file is an error."""
    found: dict[bytes, slice] = {}
    at = 12
    while at + 8 <= len(raw):
        name, size = struct.unpack_from("<4sI", raw, at)
        if at + 8 + size > len(raw):
            raise FormatError(
                f"chunk {name.decode('latin-1')!r} states {size} bytes, the file has {len(raw) - at - 8} left", where=where,
                hint="the file was cut off: copy it again",
            )  # fmt: skip
        found.setdefault(name, slice(at + 8, at + 8 + size))
        at += 8 + size + size % 2
    return found


def _mapped(path: Path, where: slice, coding: int, bits: int, count: int) -> MappedSamples:
    """Samples that stay in the file: the frames of a stretch are read together, channels picked after."""
    file, frame = StoredFile(path), count * bits // 8

    def read(rows: Sequence[int], first: int, last: int) -> NDArray[np.floating]:
        out = np.empty((len(rows), last - first), dtype)
        for start in range(first, last, PIECE):
            stop = min(start + PIECE, last)
            frames = np.empty((stop - start) * frame, np.uint8)
            file.read_into(where.start + start * frame, memoryview(frames))  # type: ignore[arg-type]
            out[:, start - first : stop - first] = _samples(memoryview(frames), coding, bits, count)[list(rows)]  # type: ignore[arg-type]
        return out

    dtype = np.float64 if bits in (32, 64) and not (coding == _FLOAT and bits == 32) else np.float32
    return MappedSamples(read, (count, (where.stop - where.start) // frame), dtype)


def _samples(body: memoryview, coding: int, bits: int, count: int) -> NDArray[np.floating]:
    """(n_channels, n_samples) samples; float32 holds what 24-bit converters give exactly."""
    if coding == _FLOAT:
        return np.ascontiguousarray(np.frombuffer(body, f"<f{bits // 8}").reshape(-1, count).T)
    data = np.empty((count, len(body) // (count * bits // 8)), np.float64 if bits == 32 else np.float32)
    if bits == 24:
        parts = np.frombuffer(body, np.uint8).reshape(-1, count, 3)
        for channel, row in enumerate(data):
            wide = np.zeros((len(row), 4), np.uint8)
            wide[:, 1:] = parts[:, channel]
            row[:] = wide.view("<i4")[:, 0]
        data /= 2.0**31
        return data
    data[:] = np.frombuffer(body, np.uint8 if bits == 8 else np.dtype(f"<i{bits // 8}")).reshape(-1, count).T
    if bits == 8:
        data -= 128
    data /= 2.0 ** (bits - 1)
    return data
