"""Numbers of UFF 58 and 58b."""

from __future__ import annotations

import re
import warnings
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import complex_of
from operando.errors import FormatError
from operando.io.uff.columns58 import LINES, columns_of, numbers_in_columns
from operando.io.uff.header58 import Header58
from operando.io.uff.split import RawSet
from operando.io.uff.textform import Buffer

_CHUNK = 1 << 18
"""Characters read word by word at once."""
_GLUED = re.compile(rb"(?<=[0-9.])(?=[+-][0-9]*\.)")
_BARE_EXPONENT = re.compile(rb"(?<=[0-9.])([+-][0-9]{2,3})(?![0-9.])")


def stored_dtype(header: Header58) -> np.dtype[Any]:
    """Number format of a binary payload."""
    return np.dtype((">" if header.big_endian else "<") + ("f8" if header.is_double else "f4"))


def natural_dtype(header: Header58) -> np.dtype[Any]:
    """Narrowest native float that holds the values: single precision stays single, text with 6 digits as well."""
    return np.dtype(np.float64 if header.is_double or not header.binary else np.float32)


def fill_real(stream: IO[bytes], buffer: Buffer, raw: RawSet, out: NDArray[Any]) -> None:
    """Read a real, evenly spaced function straight into ``out`` (points,), without a copy where the format allows it."""
    header = _header(raw)
    if header.binary and not header.is_complex and header.even and out.flags.c_contiguous and out.itemsize == stored_dtype(header).itemsize:
        assert raw.payload is not None
        stream.seek(raw.payload[0])
        view = memoryview(out.data).cast("B")
        done = 0
        while done < len(view):
            got = stream.readinto(view[done:])  # type: ignore[attr-defined]
            if not got:
                raise FormatError(f"the file ends after {done} of {len(view)} bytes of the set")
            done += got
        if header.big_endian == np.little_endian:
            out.byteswap(inplace=True)
        return
    values = read_values(buffer, raw)[1]
    with np.errstate(over="ignore", invalid="ignore"):  # numbers of a damaged file
        out[:] = values.real if np.iscomplexobj(values) else values


def read_values(buffer: Buffer, raw: RawSet) -> tuple[NDArray[np.float64] | None, NDArray[Any]]:
    """Abscissa (points,), None if even, and ordinate (points,) of a function."""
    header = _header(raw)
    if raw.payload is None:
        raise FormatError("the set holds no data")
    per_point = header.numbers_per_point
    if header.binary:
        if raw.payload[1] - raw.payload[0] < header.expected_bytes:
            raise FormatError(f"the set holds {raw.payload[1] - raw.payload[0]} of {header.expected_bytes} bytes")
        payload = buffer[raw.payload[0] : raw.payload[0] + header.expected_bytes]
        numbers = np.frombuffer(payload, stored_dtype(header))
        numbers = numbers.astype(numbers.dtype.newbyteorder("="), copy=False)
    else:
        numbers = _read_text(buffer, raw.payload, header)
    if header.even and not header.is_complex:
        return None, numbers
    if header.even:
        return None, numbers.view(np.complex128 if numbers.dtype == np.float64 else np.complex64)
    table = numbers.reshape(-1, per_point)
    abscissa = table[:, 0].astype(np.float64)
    ordinate = complex_of(table[:, 1], table[:, 2]) if header.is_complex else table[:, 1].copy()
    return abscissa, ordinate


def _header(raw: RawSet) -> Header58:
    if raw.header is None or raw.problem:
        raise FormatError(raw.problem or "the set has no readable header")
    return raw.header


def _read_text(buffer: Buffer, payload: tuple[int, int], header: Header58) -> NDArray[np.float64]:
    """Numbers of a text payload, in pieces of some megabytes, so that memory stays near the size of the result."""
    start, end = payload
    expected = header.points * header.numbers_per_point
    if expected > (end - start + 1):
        raise FormatError(f"the header declares {header.points} points, the set holds {end - start} characters")
    out = np.empty(expected)
    count = 0
    while start < end:
        values, stop = _next_numbers(buffer, start, end, header)
        if count + values.size > expected:
            if stop < end:  # whether it is filling shows only with all that follows
                rest = _parse_text(bytes(buffer[stop : min(end, stop + _CHUNK)]), header)
                values, stop = np.concatenate([values, rest]), end
            first_line = bytes(buffer[payload[0] : payload[0] + 400]).split(b"\n", 1)[0]
            values = _surplus(values, count, expected, header, len(first_line.split()))
        if values.size == expected and stop >= end:
            return values
        out[count : count + values.size] = values
        count += values.size
        start = stop
    if count != expected:
        raise FormatError(f"the header declares {header.points} points ({expected} numbers), the set holds {count} numbers")
    return out


def _next_numbers(buffer: Buffer, start: int, end: int, header: Header58) -> tuple[NDArray[np.float64], int]:
    """Numbers of the next lines, and where the lines behind them start: all lines at once where they have the columns of the first."""
    newline = buffer.find(b"\n", start, min(end, start + _CHUNK)) + 1
    columns = columns_of(bytes(buffer[start:newline])) if newline else None
    if columns is not None:
        lines = min((end - start) // columns.length, LINES)
        stop = start + lines * columns.length
        values = numbers_in_columns(bytes(buffer[start:stop]), columns)
        if values is not None:
            return values, stop
    stop = end if end - start <= _CHUNK else buffer.rfind(b"\n", start, start + _CHUNK) + 1 or end
    return _parse_text(bytes(buffer[start:stop]), header), stop


def _surplus(values: NDArray[np.float64], count: int, expected: int, header: Header58, a_line: int) -> NDArray[np.float64]:
    rest = values[max(expected - count, 0) :]
    by_standard = 6 if not header.is_double else (4 if header.even else header.numbers_per_point)
    # Some programs fill the last line of a set with zeros: just as many as it has room for.
    room = {n - expected % n for n in (a_line, by_standard) if n > 1 and expected % n}
    if rest.size in room and not np.any(rest):
        return values[: expected - count]
    raise FormatError(f"the header declares {header.points} points ({expected} numbers), the set holds at least {count + values.size}")


def _parse_text(text: bytes, header: Header58) -> NDArray[np.float64]:
    """Numbers of some lines; the plain way first, then with glued numbers, bare exponents and overflow marks put right."""
    if b"D" in text or b"d" in text:
        text = text.replace(b"D", b"E").replace(b"d", b"e")
    values = _numbers(text)
    if values is not None:
        return values
    text = re.sub(rb"\*+", b" nan ", text)
    text = re.sub(rb"[+-]?1\.#[A-Z]+0*", b" nan ", text)
    values = _numbers(_BARE_EXPONENT.sub(rb"E\1", _GLUED.sub(b" ", text)))
    if values is not None:
        return values
    values = _columns(text, header)
    if values is None:
        raise FormatError("the data of the set hold text that is no number")
    return values


def _numbers(text: bytes) -> NDArray[np.float64] | None:
    """Numbers between blanks, or None if something is no number."""
    # np.fromstring also takes numbers without a blank between them, and may cut them at the wrong place: so count the words.
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(text, sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    blank = np.frombuffer(text, np.uint8) <= 32
    words = 0 if blank.size == 0 else int(np.count_nonzero(blank[:-1] & ~blank[1:])) + int(not blank[0])
    return values if values.size == words else None


def _columns(text: bytes, header: Header58) -> NDArray[np.float64] | None:
    """Numbers in the fixed columns of the standard, for lines without blanks between them."""
    if not header.is_double:
        widths = [13] * 6
    elif header.even:
        widths = [20] * 4
    else:
        widths = [13, 20, 20] if header.is_complex else [13, 20, 13, 20]
    values: list[float] = []
    for line in text.splitlines():
        position = 0
        for width in widths:
            field = line[position : position + width].strip()
            position += width
            if not field:
                continue
            try:
                values.append(float(field))
            except ValueError:
                return None
    return np.asarray(values)
