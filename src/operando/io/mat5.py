"""MATLAB 5 to 7 files by SciPy, once their sizes are checked (MAT-File Format, The MathWorks, "Level 5")."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from operando.errors import FormatError
from operando.io.safe.guard import try_apart
from operando.io.safe.limits import check_growth

_COMPRESSED = 15
_PIECE = 1 << 16


def read_mat5(path: str | Path) -> dict[str, Any]:
    """Variables of a file by name: arrays, numbers, texts, lists (cells), dicts (structures).

    The file is tried in a process of its own first: SciPy's reader can end the process on a damaged file.
    """
    try_apart(path, "matlab")
    return _load(Path(path))


def try_mat5(path: Path, alive: Callable[[], None] = lambda: None) -> None:
    """Check the sizes of all variables, then read them once; ``alive`` is called after every variable."""
    size = path.stat().st_size
    with open(path, "rb") as stream:
        mark = stream.read(128)[126:128]
        if mark not in (b"IM", b"MI"):
            raise FormatError("the header of the MATLAB file is damaged", where=str(path))
        order = "<" if mark == b"IM" else ">"
        total = 0
        while tag := stream.read(8):
            if len(tag) < 8:
                raise FormatError("the MATLAB file ends in the middle of a variable", where=str(path))
            kind, length = struct.unpack(order + "II", tag)
            if stream.tell() + length > size:
                raise FormatError(f"a variable of {length} bytes is longer than the rest of the MATLAB file", where=str(path))
            if kind == _COMPRESSED:
                total = _inflated(stream, length, total, size, path)
            else:
                total += length
                stream.seek(length, 1)
            alive()
    _load(path)


def _inflated(stream: IO[bytes], length: int, total: int, size: int, path: Path) -> int:
    """Bytes after decompression, counted piece by piece and kept nowhere."""
    unpack = zlib.decompressobj()
    left = length
    try:
        while left:
            piece = stream.read(min(left, _PIECE))
            left -= len(piece)
            while piece:
                total += len(unpack.decompress(piece, 1 << 20))
                check_growth(total, size, str(path), "a compressed variable and those before it")
                piece = unpack.unconsumed_tail
    except zlib.error as error:
        raise FormatError(f"compressed data of the MATLAB file are damaged: {error}", where=str(path)) from error
    if not unpack.eof:
        raise FormatError("compressed data of the MATLAB file are cut off", where=str(path))
    return total


def _load(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # SciPy warns of names given twice and goes on with one of them
        variables: dict[str, Any] = loadmat(path, appendmat=False, simplify_cells=True)
    return {name: value for name, value in variables.items() if not name.startswith("__")}
