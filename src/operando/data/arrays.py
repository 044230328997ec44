"""Read-only, checked arrays, and objects that hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from operando.errors import DataError


def frozen(value: ArrayLike, dtype: DTypeLike | None = None, ndim: int | None = None, name: str = "array") -> NDArray[Any]:
    """Read-only array of ``value``: a copy, so that no change of the caller's reaches it, unless nobody can write into it as it is.

    Masked values, and complex ones where real ones are due, are errors: they would lose what they say.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        n = int(np.ma.count_masked(value))
        raise DataError(f"{name} has {n} masked values", hint="fill them (NaN where values may be missing), or leave out what holds them")
    try:
        array = np.asarray(value)
        wanted = array.dtype if dtype is None else np.dtype(dtype)
        real = array.real if np.iscomplexobj(array) and wanted.kind != "c" else array
        if wanted.kind in "iu" and real.dtype.kind == "f" and not np.all(real == np.floor(real)):
            raise ValueError
        made = np.array(real, wanted) if _writable(real) or real.dtype != wanted else real
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{name} is {value!r:.60}: no numbers", hint="give an array of numbers") from error
    if real is not array and np.any(array.imag):
        raise DataError(f"{name} is complex, real numbers are due", hint="give its real part or its modulus, whichever is meant")
    if ndim is not None and made.ndim != ndim:
        raise DataError(f"{name} has {made.ndim} dimensions, expected {ndim}")
    made.flags.writeable = False
    return made


def owned(array: NDArray[Any]) -> NDArray[Any]:
    """An array that nobody else holds, read-only from now on: objects take it without a copy."""
    array.flags.writeable = False
    return array


def is_complex(value: Any) -> bool:
    """Whether numbers, in whatever they are given, are complex; not where they are none."""
    try:
        return bool(np.iscomplexobj(value))
    except ValueError:
        return False


def _writable(array: Any) -> bool:
    """Whether the memory of an array can be written through it or through one it is a view of; what stays in a file is not copied."""
    if isinstance(array, np.memmap):
        return False
    while isinstance(array, np.ndarray):
        if array.flags.writeable:
            return True
        array = array.base
    return False


def check_covariance(covariance: NDArray[np.float64], n: int) -> None:
    """Refuse what cannot be the covariance of ``n`` parameters: another size, infinite or lopsided entries, variances below 0."""
    if covariance.shape != (n, n):
        raise DataError(f"covariance has shape {covariance.shape}, expected {(n, n)}")
    variances = np.diag(covariance)
    rounding = 1e-12 * variances.max(initial=0.0)  # of products that cancel, where a parameter is known far better than others
    if not np.all(np.isfinite(covariance)) or np.any(variances < -rounding):
        raise DataError("covariance holds values that are not finite, or variances below 0", hint="leave it out where it is not known")
    if np.array_equal(covariance, covariance.T):
        return
    deviations = np.sqrt(np.maximum(variances, 0))
    if np.any(np.abs(covariance - covariance.T) > 1e-6 * np.outer(deviations, deviations) + rounding):
        raise DataError("covariance is not symmetric", hint="give E[δ δᵀ] of all parameters, in their order")


def complex_of(real: ArrayLike, imaginary: ArrayLike) -> NDArray[np.complex128]:
    """Complex numbers of two parts; an infinite part leaves the other one as it is, which a product with i would not."""
    first = np.asarray(real, float)
    out = np.empty(first.shape, complex)
    out.real, out.imag = first, imaginary
    return out


def numbers_of(values: Any, what: str, hint: str) -> NDArray[np.float64]:
    """Numbers as they are given, or an error that says ``what`` they are for and, as ``hint``, what to give instead."""
    try:
        if is_complex(values):
            raise TypeError
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{what} {values!r:.200}: no numbers", hint=hint) from error


def number_of(value: Any, what: str, hint: str, least: float = -np.inf) -> float:
    """One finite number, not below ``least``, or an error that says ``what`` it is for and what to give instead."""
    number = numbers_of(value, what, hint)
    if number.ndim or not np.isfinite(number):
        raise DataError(f"{what} {value!r:.200} is not one finite number", hint=hint)
    if number < least:
        raise DataError(f"{what} {value!r:.200} is below {least:g}", hint=hint)
    return float(number)


def count_of(value: Any, what: str, example: int) -> int | None:
    """A whole number from 1 on; None where it is chosen from the data."""
    if value is not None and not (isinstance(value, int | np.integer) and value >= 1):
        raise DataError(f"{what} = {value!r:.60} is no count", hint=f"give a whole number from 1 on, for example {example}")
    return None if value is None else int(value)


def frequencies_of(values: Any, what: str) -> tuple[float, ...]:
    """Positive frequencies named by hand [Hz], one alone as a list of one; None is none.

    >>> frequencies_of(27.2, "modes_hz"), frequencies_of([27.2, 58.5], "modes_hz")
    ((27.2,), (27.2, 58.5))
    """
    hint = "give frequencies in Hz, as [12.1, 15.5]"
    hz = np.atleast_1d(numbers_of(() if values is None else values, what, hint))
    if hz.ndim != 1 or not np.all(np.isfinite(hz) & (hz > 0)):
        raise DataError(f"{what} {values!r}: expected a list of positive frequencies", hint=hint)
    return tuple(float(f) for f in hz)


def positions_of(which: Any, n: int, what: str) -> NDArray[np.intp]:
    """Positions among ``n`` things, given as positions or as a mask, or an error that says what there is."""
    try:
        return np.asarray(np.arange(n)[which if isinstance(which, np.ndarray) and which.size else list(which)], np.intp).reshape(-1)
    except (IndexError, TypeError) as error:
        raise DataError(f"{which!r:.60} names no {what} of {n}", hint="give positions from 0, or a mask") from error


def band_limits(band: Any) -> tuple[float, float]:
    """Both limits of a band [Hz], whatever their order."""
    limits = numbers_of(band, "band", "give [low, high] in Hz")
    if limits.shape != (2,):
        raise DataError(f"band {band!r} is no pair of frequencies", hint="give [low, high] in Hz")
    return float(limits[0]), float(limits[1])


def ordered_band(band: Any) -> tuple[float, float]:
    """Limits of a band [Hz]; an error where the lower one is not first."""
    low, high = band_limits(band)
    if low > high:
        raise DataError(f"the band of {low:g} to {high:g} Hz is reversed", hint=f"give the lower limit first: ({high:g}, {low:g})")
    return low, high


def positive_band(band: Any) -> tuple[float, float]:
    """Limits of a band that is analysed [Hz]: not below 0 Hz, the upper one above the lower one."""
    low, high = ordered_band(band)
    if low < 0:
        raise DataError(f"the band of {low:g} to {high:g} Hz begins below 0 Hz", hint="give [low, high] in Hz, from 0 on")
    if not low < high:
        raise DataError(f"the band of {low:g} to {high:g} Hz is empty", hint="give [low, high] in Hz")
    return low, high


def bands_of(bands: Any, what: str) -> tuple[tuple[float, float], ...]:
    """Bands in a list [Hz], each with its lower limit first."""
    hint = "give a list of bands in Hz, as [(24, 25), (49, 50)]"
    pairs = numbers_of(bands, what, hint)
    if pairs.size and (pairs.ndim != 2 or pairs.shape[1] != 2):
        raise DataError(f"{what} {bands!r:.200} is no list of bands", hint=hint)
    return tuple(map(positive_band, pairs.reshape(-1, 2)))


class ByContent:
    """Equal where all that two objects hold is equal, NaN in one place included. For dataclasses that hold arrays (``eq=False``)."""

    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        return _same(self, other) if type(self) is type(other) else NotImplemented


def _same(one: Any, two: Any) -> bool:
    """Whether two values are equal, arrays and what holds them by their content."""
    if one is two:
        return True
    if is_dataclass(one):
        return type(one) is type(two) and all(_same(getattr(one, f.name), getattr(two, f.name)) for f in fields(one) if f.compare)
    if hasattr(one, "dtype") or hasattr(two, "dtype"):
        a, b = np.asarray(one), np.asarray(two)
        return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fc" and b.dtype.kind in "fc"))
    if isinstance(one, list | tuple):
        return type(one) is type(two) and len(one) == len(two) and all(map(_same, one, two))
    if isinstance(one, Mapping):
        return isinstance(two, Mapping) and one.keys() == two.keys() and all(_same(one[k], two[k]) for k in one)
    return bool(one == two) or (one != one and two != two)
