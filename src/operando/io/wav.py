"""WAV files: samples as a fraction of full scale; the file knows neither units nor DOFs."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Provenance
from operando.errors import FormatError
from operando.io.content import Content, SetInfo
from operando.io.quantities import ChannelSpecs, Units
from operando.io.sep005 import make_record
from operando.io.uff.reader import open_file, quick_hash

_PCM, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE


def read_wav(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read a RIFF WAVE file (PCM of 8 to 32 bits, float of 32 or 64 bits).

    Whole numbers become a fraction of full scale; the channels are ``ch1``, ``ch2``, …: [channels] says what they measure, and
    ``sensitivity`` the fraction of full scale per unit.

    Raises
    ------
    FormatError
        If the file is damaged, cut off, or of another coding.
    """
    path = Path(path)
    where = str(path)
    with open_file(path) as stream:
        raw = memoryview(stream.read())
    chunks = _chunks(raw, where)
    head = bytes(chunks.get(b"fmt ", b""))
    if len(head) < 16 or b"data" not in chunks:
        raise FormatError("no format or no data in the WAV file", where=where, hint="the file is damaged: export it again")
    coding, count, rate, _, frame, bits = struct.unpack_from("<HHIIHH", head)
    if coding == _EXTENSIBLE and len(head) >= 26:
        (coding,) = struct.unpack_from("<H", head, 24)
    body = chunks[b"data"]
    width = bits // 8
    known = (coding == _PCM and bits in (8, 16, 24, 32)) or (coding == _FLOAT and bits in (32, 64))
    if not known or not count or not rate or frame != count * width or not body or len(body) % frame:
        raise FormatError(
            f"coding {coding}, {count} channels of {bits} bits at {rate} Hz, {len(body)} bytes of data: not understood", where=where,
            hint="export PCM or float WAV",
        )  # fmt: skip
    data = _samples(body, coding, bits, count)
    del raw, body, chunks
    names = [f"ch{i + 1}" for i in range(count)]
    provenance = Provenance(((where, quick_hash(path)),), (f"read {path.name}",))
    record = make_record(data, float(rate), names, [""] * count, units=units, channels=channels, source=where, provenance=provenance)
    scale = "as stored" if coding == _FLOAT else "a fraction of full scale"
    note = Finding(
        "missing_unit", f"a WAV file knows no units: the numbers are {scale}", "info", where,
        consequence="without unit and sensitivity there is no mass scaling and no FRF in SI",
        action='give them in the test file: [channels] ch1 = {dof = "12+Z", quantity = "acceleration", unit = "g", sensitivity = 0.1}',
    )  # fmt: skip
    sets = tuple(SetInfo(i, 0, f"channel {name}") for i, name in enumerate(names))
    return Content(where, "wav", (record,), sets=sets, findings=(note, *record.findings))


def _chunks(raw: memoryview, where: str) -> dict[bytes, memoryview]:
    """Chunks of the file by name, the first of each; a chunk longer than the file is an error."""
    found: dict[bytes, memoryview] = {}
    at = 12
    while at + 8 <= len(raw):
        name, size = struct.unpack_from("<4sI", raw, at)
        if at + 8 + size > len(raw):
            raise FormatError(
                f"chunk {name.decode('latin-1')!r} states {size} bytes, the file has {len(raw) - at - 8} left", where=where,
                hint="the file was cut off: copy it again",
            )  # fmt: skip
        found.setdefault(name, raw[at + 8 : at + 8 + size])
        at += 8 + size + size % 2
    return found


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
