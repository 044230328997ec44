"""Reading of MATLAB 5 to 7 files (MAT-File Format, The MathWorks, "Level 5"), every length checked.

Own code, because a damaged file makes the reader of SciPy end the whole process; the tests compare with it.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import FormatError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1", 17: "u2", 18: "u4"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR = 1, 2, 4
_DEPTH = 32


def read_mat5(raw: bytes) -> dict[str, Any]:
    """Variables of a file by name: arrays, texts, lists (cells), dicts (structures); what is none of these is left out.

    Raises
    ------
    FormatError
        If the file is damaged.
    """
    mark = raw[126:128]
    if mark not in (b"IM", b"MI"):
        raise FormatError("the header of the MATLAB file is damaged")
    order = "<" if mark == b"IM" else ">"
    variables: dict[str, Any] = {}
    position = 128
    while position + 8 <= len(raw):
        kind, body, position = _element(raw, position, len(raw), order)
        if kind == _COMPRESSED:
            try:
                body = zlib.decompress(body)
            except zlib.error as error:
                raise FormatError(f"compressed data of the MATLAB file are damaged: {error}") from error
            kind, body, _ = _element(body, 0, len(body), order)
        if kind != _MATRIX:
            raise FormatError(f"an element of type {kind} stands where a variable should")
        name, value = _matrix(body, order, 0)
        if value is not None:
            variables[name] = value
    if not raw[position:].strip(b"\0"):
        return variables
    raise FormatError("the MATLAB file ends in the middle of a variable")


def _element(raw: bytes, at: int, end: int, order: str) -> tuple[int, bytes, int]:
    """Type and data of an element, and where the next one starts."""
    if at + 8 > end:
        raise FormatError("the MATLAB file ends in the middle of a variable")
    (word,) = struct.unpack_from(order + "I", raw, at)
    if word >> 16:
        size = word >> 16
        if size > 4:
            raise FormatError(f"a short element of {size} bytes in the MATLAB file")
        return word & 0xFFFF, raw[at + 4 : at + 4 + size], at + 8
    (size,) = struct.unpack_from(order + "I", raw, at + 4)
    start = at + 8
    if start + size > end:
        raise FormatError(f"an element of {size} bytes is longer than the rest of the MATLAB file")
    padded = size if word == _COMPRESSED else -(-size // 8) * 8
    return word, raw[start : start + size], min(start + padded, end)


def _numbers(kind: int, body: bytes, order: str) -> NDArray[Any]:
    code = _TYPES.get(kind)
    if code is None or len(body) % int(code[1]):
        raise FormatError(f"{len(body)} bytes of number type {kind} in the MATLAB file")
    return np.frombuffer(body, order + code)


def _matrix(body: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a variable, value None for classes that hold no data for us (objects, functions, sparse)."""
    if not body:
        return "", np.zeros((0, 0))
    if depth > _DEPTH:
        raise FormatError("structures of the MATLAB file are nested too deeply")
    at = 0
    parts = []
    for _ in range(3):
        kind, part, at = _element(body, at, len(body), order)
        parts.append((kind, part))
    flags = _numbers(*parts[0], order)
    dims = [int(d) for d in _numbers(*parts[1], order)]
    name = parts[2][1].decode("latin-1")
    if flags.size < 1 or parts[0][0] != 6 or parts[1][0] != 5 or not 1 <= len(dims) <= 32 or min(dims) < 0:
        raise FormatError("the head of a variable of the MATLAB file is damaged")
    kind, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & 0x800)
    count = math.prod(dims)
    if kind in _CLASSES:
        return name, _array(body, at, order, dims, is_complex, _CLASSES[kind])
    if kind == _CHAR:
        return name, _text(body, at, order, dims)
    if kind == _CELL:
        return name, _values(body, at, order, count, depth)[0]
    if kind == _STRUCT:
        return name, _structure(body, at, order, count, depth)
    return name, None


def _array(body: bytes, at: int, order: str, dims: list[int], is_complex: bool, dtype: str) -> NDArray[Any]:
    count = math.prod(dims)
    parts = []
    for _ in range(2 if is_complex else 1):
        kind, part, at = _element(body, at, len(body), order)
        numbers = _numbers(kind, part, order)
        if numbers.size != count:
            raise FormatError(f"a variable of {count} numbers holds {numbers.size} in the MATLAB file")
        parts.append(numbers)
    if is_complex:
        values = np.empty(count, np.complex64 if dtype == "f4" else np.complex128)
        values.real, values.imag = parts
    else:
        # Small whole numbers are stored narrower than they are.
        values = parts[0].astype(dtype, casting="unsafe")
    return values.reshape(dims, order="F")


def _text(body: bytes, at: int, order: str, dims: list[int]) -> str | list[str]:
    kind, part, _ = _element(body, at, len(body), order)
    try:
        if kind == 16:
            text = part.decode("utf-8")
        elif kind == 17:
            text = part.decode("utf-16-le" if order == "<" else "utf-16-be")
        else:
            text = "".join(chr(int(c)) for c in _numbers(kind, part, order))
    except (UnicodeDecodeError, ValueError, OverflowError) as error:
        raise FormatError(f"a text of the MATLAB file cannot be decoded: {error}") from error
    rows = dims[0]
    if rows <= 1:
        return text
    return ["".join(text[i::rows]).rstrip() for i in range(rows)] if rows <= len(text) else text


def _values(body: bytes, at: int, order: str, count: int, depth: int) -> tuple[list[Any], int]:
    if count > len(body) // 8 + 1:
        raise FormatError(f"{count} cells do not fit into {len(body)} bytes of the MATLAB file")
    values = []
    for _ in range(count):
        kind, part, at = _element(body, at, len(body), order)
        if kind != _MATRIX:
            raise FormatError("a cell of the MATLAB file is damaged")
        values.append(_matrix(part, order, depth + 1)[1])
    return values, at


def _structure(body: bytes, at: int, order: str, count: int, depth: int) -> dict[str, Any] | list[dict[str, Any]]:
    kind, part, at = _element(body, at, len(body), order)
    length = _numbers(kind, part, order)
    kind, names, at = _element(body, at, len(body), order)
    if length.size != 1 or not 0 < int(length[0]) <= 4096:
        raise FormatError("the field names of a structure of the MATLAB file are damaged")
    width = int(length[0])
    fields = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), width)]
    values, _ = _values(body, at, order, count * len(fields), depth)
    rows = [dict(zip(fields, values[i * len(fields) : (i + 1) * len(fields)], strict=True)) for i in range(count)]
    return rows[0] if count == 1 else rows
