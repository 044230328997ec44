"""Small helpers for read-only, checked arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from operando.errors import DataError


def frozen(value: ArrayLike, dtype: DTypeLike | None = None, ndim: int | None = None, name: str = "array") -> NDArray[Any]:
    """Read-only view or copy of ``value``; the caller's array stays writable."""
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{name} is {value!r:.60}: no numbers", hint="give an array of numbers") from error
    if ndim is not None and array.ndim != ndim:
        raise DataError(f"{name} has {array.ndim} dimensions, expected {ndim}")
    view = array.view()
    view.flags.writeable = False
    return view


def complex_of(real: ArrayLike, imaginary: ArrayLike) -> NDArray[np.complex128]:
    """Complex numbers of two parts; an infinite part leaves the other one as it is, which a product with i would not."""
    first = np.asarray(real, float)
    out = np.empty(first.shape, complex)
    out.real, out.imag = first, imaginary
    return out


def numbers_of(values: Any, what: str, hint: str) -> NDArray[np.float64]:
    """Numbers as they are given, or an error that says ``what`` they are for and, as ``hint``, what to give instead."""
    try:
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
