"""Small helpers for read-only, checked arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from operando.errors import DataError


def frozen(value: ArrayLike, dtype: DTypeLike | None = None, ndim: int | None = None, name: str = "array") -> NDArray[Any]:
    """Read-only view or copy of ``value``; the caller's array stays writable.

    Raises
    ------
    DataError
        If it holds no numbers, or the number of dimensions is not ``ndim``.
    """
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name} is {value!r:.60}: no numbers", hint="give an array of numbers") from error
    if ndim is not None and array.ndim != ndim:
        raise DataError(f"{name} has {array.ndim} dimensions, expected {ndim}")
    view = array.view()
    view.flags.writeable = False
    return view


def complex_of(real: ArrayLike, imaginary: ArrayLike) -> NDArray[np.complex128]:
    """Complex numbers of two parts; an infinite part leaves the other one as it is, which a product with i would not.

    Parameters
    ----------
    real : array
        Real parts.
    imaginary : array
        Imaginary parts.

    Returns
    -------
    complex array

    Examples
    --------
    >>> complex_of([1.0, 2.0], [0.0, -1.0]).tolist()
    [(1+0j), (2-1j)]
    """
    first = np.asarray(real, float)
    out = np.empty(first.shape, complex)
    out.real, out.imag = first, imaginary
    return out


def numbers_of(values: Any, what: str, hint: str) -> NDArray[np.float64]:
    """Numbers as they are given, or an error that says what they are for.

    Parameters
    ----------
    values : number or array_like
        What was given.
    what : str
        What it is, in words.
    hint : str
        What to give instead.

    Returns
    -------
    float array

    Raises
    ------
    DataError
        If they are none.

    Examples
    --------
    >>> numbers_of([5, 70], "band", "give [low, high] in Hz")
    array([ 5., 70.])
    """
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise DataError(f"{what} {values!r}: no numbers", hint=hint) from error


def frequencies_of(values: Any, what: str) -> tuple[float, ...]:
    """Frequencies named by hand [Hz], one alone as a list of one.

    Parameters
    ----------
    values : number or array_like, optional
        What was given; None is none.
    what : str
        What it is, in words.

    Returns
    -------
    tuple of float

    Raises
    ------
    DataError
        If they are no list of positive numbers.

    Examples
    --------
    >>> frequencies_of(27.2, "modes_hz"), frequencies_of([27.2, 58.5], "modes_hz")
    ((27.2,), (27.2, 58.5))
    """
    hint = "give frequencies in Hz, as [12.1, 15.5]"
    hz = np.atleast_1d(numbers_of(() if values is None else values, what, hint))
    if hz.ndim != 1 or not np.all(np.isfinite(hz) & (hz > 0)):
        raise DataError(f"{what} {values!r}: expected a list of positive frequencies", hint=hint)
    return tuple(float(f) for f in hz)


def band_limits(band: Any) -> tuple[float, float]:
    """Both limits of a band [Hz], whatever their order.

    Parameters
    ----------
    band : (float, float)
        Band.

    Returns
    -------
    (float, float)

    Raises
    ------
    DataError
        If it is no pair of numbers.

    Examples
    --------
    >>> band_limits([5, 70])
    (5.0, 70.0)
    """
    limits = numbers_of(band, "band", "give [low, high] in Hz")
    if limits.shape != (2,):
        raise DataError(f"band {band!r} is no pair of frequencies", hint="give [low, high] in Hz")
    return float(limits[0]), float(limits[1])


def ordered_band(band: Any) -> tuple[float, float]:
    """Limits of a band [Hz], the lower one first.

    Parameters
    ----------
    band : (float, float)
        Band.

    Returns
    -------
    (float, float)

    Raises
    ------
    DataError
        If it is no pair of numbers, or the limits are reversed.

    Examples
    --------
    >>> ordered_band([5, 70])
    (5.0, 70.0)
    """
    low, high = band_limits(band)
    if low > high:
        raise DataError(f"the band of {low:g} to {high:g} Hz is reversed", hint=f"give the lower limit first: ({high:g}, {low:g})")
    return low, high


def positive_band(band: Any) -> tuple[float, float]:
    """Limits of a band that is analysed [Hz]: not below 0 Hz, the upper one above the lower one.

    Parameters
    ----------
    band : (float, float)
        Band.

    Returns
    -------
    (float, float)

    Raises
    ------
    DataError
        If it is no such band.

    Examples
    --------
    >>> positive_band([5, 70])
    (5.0, 70.0)
    """
    low, high = ordered_band(band)
    if low < 0:
        raise DataError(f"the band of {low:g} to {high:g} Hz begins below 0 Hz", hint="give [low, high] in Hz, from 0 on")
    if not low < high:
        raise DataError(f"the band of {low:g} to {high:g} Hz is empty", hint="give [low, high] in Hz")
    return low, high
