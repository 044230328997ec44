"""Samples that stay in their file: read where they are asked for, converted as they are read.

A record longer than ``MAPPED_FROM`` is not held in memory. Its ``data`` behave as those of a memory map do: a part of rows and columns is
a view that reads nothing, one row or anything that computes with them reads what it needs. What goes through a whole record does so in
pieces (:func:`pieces`), so that its memory does not grow with the length.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike, NDArray

from operando.data.arrays import ByContent
from operando.data.stored import StoredFile, StoredRow
from operando.errors import WriteError

MAPPED_FROM = 1 << 26
"""Bytes of samples from which a record stays in its file (67 MB, 64 channels of 130 000 samples): so that a test of many such records stays
far below the 1 GB that a run may take. What is read again comes from the cache of the system."""
PIECE = 1 << 16
"""Samples of one channel taken at once by what goes through a whole record: in double precision they stay in the cache of a core."""

_METHODS = {
    "T", "all", "any", "argmax", "argmin", "astype", "clip", "copy", "cumsum", "dot", "flatten", "max", "mean", "min", "nonzero",
    "ravel", "reshape", "round", "std", "sum", "swapaxes", "tobytes", "tolist", "transpose", "var",
}  # fmt: skip
"""Methods of arrays that change nothing and ask nothing of how samples lie in memory."""

Reader = Callable[[Sequence[int], int, int], NDArray[Any]]
"""Rows, first sample, one past the last → samples in SI (len(rows), last − first)."""


class MappedSamples(NDArrayOperatorsMixin):
    """Samples of several channels (n_channels, n_samples) in a file.

    ``samples[i]`` and ``samples[i, a:b]`` are arrays. ``samples[rows]`` and ``samples[rows, a:b]`` with a step of one are views. Everything
    else, NumPy's functions and the common methods of arrays included, reads the view as a whole.

    Parameters
    ----------
    read : Reader
    shape : (int, int)
    dtype : float dtype
        Of what ``read`` gives.
    """

    ndim = 2

    def __init__(self, read: Reader, shape: tuple[int, int], dtype: DTypeLike) -> None:
        self._read = read
        self._rows: NDArray[Any] = np.arange(shape[0])
        self._span = (0, shape[1])
        self._statistics: RowStatistics | None = None
        self.dtype = np.dtype(dtype)

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return self._rows.size, self._span[1] - self._span[0]

    @property
    def size(self) -> int:
        """Number of samples in all."""
        return self.shape[0] * self.shape[1]

    @property
    def rows_apart(self) -> bool:
        """Whether a row can be read without the others: it lies in one piece."""
        return isinstance(self._read, _RowReader | _MemmapReader)

    @property
    def nbytes(self) -> int:
        """Bytes that the samples would take in memory."""
        return self.size * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f"MappedSamples(shape={self.shape}, dtype={self.dtype})"

    def __getitem__(self, key: Any) -> Any:
        rows, columns = key if isinstance(key, tuple) and len(key) == 2 else (key, slice(None))
        plain = isinstance(columns, slice) and columns.step in (None, 1)
        if isinstance(rows, int | np.integer):
            if not plain:
                return self[rows][columns]
            first, last, _ = columns.indices(self.shape[1])
            begin = self._span[0]
            return self._samples([int(self._rows[rows])], begin + first, begin + max(first, last), self.dtype)[0]
        if plain and (isinstance(rows, slice | list) or (isinstance(rows, np.ndarray) and rows.ndim == 1)):
            return self._view(rows, columns)
        return self.filled()[key]

    def _view(self, rows: Any, columns: slice) -> MappedSamples:
        first, last, _ = columns.indices(self.shape[1])
        out = object.__new__(MappedSamples)
        out._read, out._rows, out.dtype = self._read, self._rows[rows], self.dtype
        out._span = (self._span[0] + first, self._span[0] + max(first, last))
        known = self._statistics if out._span == self._span else None
        out._statistics = None if known is None else RowStatistics(*(getattr(known, f.name)[rows] for f in fields(known)))
        return out

    def filled(self, dtype: DTypeLike | None = None) -> NDArray[Any]:
        """All samples as an array, read in pieces."""
        return self._samples(self._rows.tolist(), *self._span, self.dtype if dtype is None else np.dtype(dtype))

    def _samples(self, rows: list[int], first: int, last: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """Samples of rows of the file, read in pieces."""
        step = max(PIECE, (1 << 24) // max(len(rows), 1))
        if rows and 0 < last - first <= step and kind == self.dtype:
            return self._read(rows, first, last)
        out = np.empty((len(rows), last - first), kind)
        if isinstance(self._read, _RowReader) and kind == self.dtype:
            self._read.read_into(out, rows, first, last)
            return out
        for start in range(first, last, step):
            stop = min(start + step, last)
            out[:, start - first : stop - first] = self._read(rows, start, stop)
        return out

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return self.filled(dtype)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        return getattr(ufunc, method)(*(x.filled() if isinstance(x, MappedSamples) else x for x in inputs), **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name not in _METHODS:
            raise AttributeError(f"MappedSamples has no attribute {name!r}; numpy.asarray makes an array of it")
        return getattr(self.filled(), name)

    def changed_by(self, change: Callable[[NDArray[Any], Sequence[int], int, int], NDArray[Any]], dtype: DTypeLike) -> MappedSamples:
        """The samples as ``change(samples, rows, first, last)`` makes them, each time they are read; rows and samples of this view."""
        base, span = self, self.shape

        def read(rows: Sequence[int], first: int, last: int) -> NDArray[Any]:
            return change(base[list(rows), first:last].filled(), rows, first, last)

        return MappedSamples(read, span, dtype)


def pieces(data: Any, length: int = PIECE) -> Iterator[tuple[int, NDArray[Any]]]:
    """Consecutive stretches of all rows (rows, n_samples), as (first sample, samples): arrays of at most ``length`` samples.

    >>> [(first, part.shape) for first, part in pieces(np.zeros((2, 5)), 3)]
    [(0, (2, 3)), (3, (2, 2))]
    """
    for first in range(0, data.shape[1], length):
        yield first, np.asarray(data[:, first : first + length])


class _MemmapReader:
    """Rows of a memory map, whose pages go when they are read: they would count as memory of the process."""

    def __init__(self, data: np.memmap[Any, Any]) -> None:
        self._data, self._map, self._read_since = data.view(np.ndarray), data._mmap, 0  # type: ignore[attr-defined]

    def __call__(self, rows: Sequence[int], first: int, last: int) -> NDArray[Any]:
        out = np.empty((len(rows), last - first), self._data.dtype.newbyteorder("="))
        for i, row in enumerate(rows):
            out[i] = self._data[row, first:last]
        self._read_since += out.nbytes
        flags = getattr(mmap, "MADV_DONTNEED", None)
        if flags is not None and self._read_since > MAPPED_FROM // 8:
            self._map.madvise(flags)
            self._read_since = 0
        return out


def mapped_memmap(data: np.memmap[Any, Any]) -> MappedSamples:
    """A large read-only memory map as samples in a file."""
    rows, samples = data.shape
    return MappedSamples(_MemmapReader(data), (rows, samples), data.dtype.newbyteorder("="))


@dataclass(frozen=True)
class _RowReader:
    file: StoredFile
    rows: tuple[StoredRow, ...]
    dtype: np.dtype[Any]

    def __call__(self, wanted: Sequence[int], first: int, last: int) -> NDArray[Any]:
        out = np.empty((len(wanted), last - first), self.dtype)
        self.read_into(out, wanted, first, last)
        return out

    def read_into(self, out: NDArray[Any], wanted: Sequence[int], first: int, last: int) -> None:
        """Fill ``out`` straight from the file, without a copy where the format allows it."""
        for i, k in enumerate(wanted):
            row = self.rows[k]
            raw = out[i] if row.dtype == self.dtype else np.empty(last - first, row.dtype)
            self.file.read_into(row.offset + first * row.dtype.itemsize, memoryview(raw.view(np.uint8)))  # type: ignore[arg-type]
            if row.dtype != self.dtype:
                out[i] = raw
            if row.factor != 1.0:
                with np.errstate(over="ignore", invalid="ignore"):  # numbers of a damaged file
                    out[i] *= self.dtype.type(row.factor)


def mapped_rows(file: StoredFile, rows: Sequence[StoredRow], samples: int, dtype: DTypeLike) -> MappedSamples:
    """Channels that lie one after the other in a file, so many samples each, given in a type of floats."""
    return MappedSamples(_RowReader(file, tuple(rows), np.dtype(dtype)), (len(rows), samples), dtype)


class _Filled:
    """Rows that are put together part by part: in memory, or in a temporary file where they are large."""

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)
        large = shape[0] * shape[1] * self.dtype.itemsize >= MAPPED_FROM
        self.stream: Any = tempfile.TemporaryFile() if large else None  # noqa: SIM115  (it stays as long as the samples do)
        self.samples: Any = None if large else np.zeros(shape, self.dtype)

    def __call__(self, row: int, first: int, values: NDArray[Any]) -> None:
        if self.stream is None:
            self.samples[row, first : first + values.size] = values
            return
        self.stream.seek((row * self.shape[1] + first) * self.dtype.itemsize)
        self.stream.write(np.ascontiguousarray(values, self.dtype).view(np.uint8).data)

    def finish(self) -> None:
        """Make ``samples`` of what was put."""
        if self.stream is None:
            return
        self.stream.flush()
        self.stream.truncate(self.shape[0] * self.shape[1] * self.dtype.itemsize)
        step = self.shape[1] * self.dtype.itemsize
        rows = [StoredRow(i * step, self.dtype) for i in range(self.shape[0])]
        self.samples = mapped_rows(StoredFile(Path("temporary file"), self.stream), rows, self.shape[1], self.dtype)


@contextmanager
def filling(shape: tuple[int, int], dtype: DTypeLike) -> Iterator[_Filled]:
    """A function (row, first sample, values) that puts rows together part by part; ``samples`` of it holds them when the block ends.

    What is larger than ``MAPPED_FROM`` lies in a temporary file (in the folder that TMPDIR names).

    >>> with filling((2, 4), np.float64) as put:
    ...     put(1, 2, np.full(2, 5.0))
    >>> np.asarray(put.samples)[1, 2:].tolist()
    [5.0, 5.0]
    """
    try:
        filled = _Filled(shape, dtype)
        yield filled
        filled.finish()
    except OSError as error:
        hint = "make room there, or name another folder by the environment variable TMPDIR"
        raise WriteError(
            f"a temporary file cannot be written: {error.strerror or error}", where=tempfile.gettempdir(), hint=hint
        ) from error


def scaled_rows(data: Any, factors: Sequence[float]) -> Any:
    """Rows (n_channels, n_samples), each times its factor; samples in a file are multiplied as they are read."""
    if all(factor == 1.0 for factor in factors):
        return data

    def times(samples: NDArray[Any], which: Sequence[int], first: int, last: int) -> NDArray[Any]:
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of a damaged file; the raw-data checks tell what is not finite
            return np.stack([row * factors[k] if factors[k] != 1.0 else row for row, k in zip(samples, which, strict=True)])

    return data.changed_by(times, data.dtype) if isinstance(data, MappedSamples) else times(data, range(len(data)), 0, data.shape[1])


@dataclass(frozen=True, eq=False)
class RowStatistics(ByContent):
    """Statistics of each channel over its finite samples.

    Parameters
    ----------
    finite : (n,) bool array
        Whether all samples are finite.
    mean, std, low, high : (n,) arrays
        Standard deviation 0 where all samples are equal, or there is none.
    """

    finite: NDArray[np.bool_]
    mean: NDArray[np.float64]
    std: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def flat(self) -> NDArray[np.bool_]:
        """Whether all finite samples are equal."""
        return ~(self.high > self.low)


def _stretches(data: Any) -> Iterator[tuple[int, NDArray[Any]]]:
    """Row and samples of it, of at most ``PIECE`` samples: all rows in turn, or one after the other where a row lies apart."""
    if isinstance(data, MappedSamples) and not data.rows_apart:
        for _, part in pieces(data):
            yield from enumerate(part)
        return
    for i in range(data.shape[0]):
        for first in range(0, data.shape[1], PIECE):
            yield i, np.asarray(data[i, first : first + PIECE])


def row_statistics(data: NDArray[Any] | MappedSamples) -> RowStatistics:
    """Statistics of the rows of a record, in one pass; made once for samples in a file."""
    if not isinstance(data, MappedSamples):
        return _row_statistics(data)
    if data._statistics is None:
        data._statistics = _row_statistics(data)
    return data._statistics


def _row_statistics(data: Any) -> RowStatistics:
    """The same, made anew.

    Sums are taken about the mean of each row's beginning, which keeps the digits of a small signal on a large offset.
    """
    n = data.shape[0]
    finite = np.ones(n, bool)
    about, total, square, count = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    real = np.dtype(np.float32 if data.dtype == np.float32 else np.float64)
    work, ones = np.empty(PIECE, real), np.ones(PIECE, real)
    for i, raw in _stretches(data):
        least, most = float(raw.min()), float(raw.max())
        if not np.isfinite(most - least):  # NaN and infinity show in one of them
            good = np.isfinite(raw)
            finite[i] &= bool(good.all())
            raw = raw[good]
            if not raw.size:
                continue
            least, most = float(raw.min()), float(raw.max())
        if not count[i]:
            about[i] = raw.mean()
        low[i], high[i] = min(low[i], least), max(high[i], most)
        x = np.subtract(raw, real.type(about[i]), out=work[: raw.size])
        with np.errstate(over="ignore"):
            squares = x @ x
        if not np.isfinite(squares):  # beyond the range of single precision
            x = x.astype(float)
            squares = x @ x
        total[i] += x @ ones[: x.size]  # a product of BLAS is faster than the sum
        square[i] += squares
        count[i] += x.size
    some = np.maximum(count, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        variance = np.maximum(square / some - (total / some) ** 2, 0)
    return RowStatistics(finite, about + total / some, np.where(high > low, np.sqrt(variance), 0.0), low, high)
