"""Text numbers in equal columns, many lines at once.

Programs write the lines of an ASCII function with one format, so the first line tells where the digits of all lines stand. The digits of
a number are two whole numbers of up to seven digits, which single precision holds exactly: a product with a matrix of powers of ten makes
them for all lines at once, in whatever order it adds. The double is rounded once, as ``float`` does it. Lines that deviate are left to
the reader of words.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

LINES = 1 << 11
"""Lines taken at once: with their digits in single precision they stay in the cache of a core (0.7 MB at 80 characters a line)."""
GROUP = 7
"""Digits that single precision adds up exactly: 9 999 999 < 2²⁴."""
EXACT_POWER = 22
"""Largest power of ten that is a double: 5²² < 2⁵³. A whole number below 2⁵³ times or over such a power is rounded once (Clinger 1990)."""
_SPLIT = 2.0**27 + 1
"""Splits a double into two halves whose products are exact (Dekker 1971)."""
_DOUBT = 2.0**-98
"""Relative error allowed to a product of a number and a power of ten kept in two doubles; what is neglected is below 2⁻¹⁰²."""

_SAME = bytes.maketrans(b"123456789+-Dd", b"000000000  Ee")
_FIELD = re.compile(rb" 0\.(0{1,13})[Ee] 00(?![0-9.])")
_LEAST = -99 - 2 * GROUP
_POWERS = range(_LEAST, 100)


def _table(power: int) -> tuple[float, float, float, float]:
    exact = Fraction(10) ** power
    high = float(exact)
    low = float(exact - Fraction(high))
    small = abs(power) <= EXACT_POWER
    return (10.0**power if small and power >= 0 else 1.0), (10.0**-power if small and power < 0 else 1.0), high, low


_TIMES, _OVER, _HIGH, _LOW = np.array([_table(power) for power in _POWERS]).T.copy()


@dataclass(frozen=True)
class Columns:
    """Where the digits of the numbers of a line stand.

    Parameters
    ----------
    low, span : (length,) uint8 arrays
        Least character of each column, and how far above it one may lie.
    signs, exponent_signs : (numbers,) int arrays
        Columns of the signs.
    weights : (3·numbers, length) float32 array
        Makes the upper and the lower digits and the exponents of the digits of a line.
    decimals : (numbers,) float array
        Digits behind the point.
    """

    low: NDArray[np.uint8]
    span: NDArray[np.uint8]
    signs: NDArray[np.intp]
    exponent_signs: NDArray[np.intp]
    weights: NDArray[np.float32]
    decimals: NDArray[np.float64]

    @property
    def length(self) -> int:
        """Characters of a line, its end included."""
        return self.low.size

    def values(self, text: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """Numbers of some lines, (lines, length) characters; None where a line has other columns."""
        above = text - self.low  # what lies below wraps around and is far above
        if (above > self.span).any():
            return None
        signs, exponent_signs = above.T[self.signs], above.T[self.exponent_signs]
        negative = signs == ord("-") - ord(" ")
        if not (negative | (signs == 0) | (signs == ord("+") - ord(" "))).all() or (exponent_signs & 1).any():
            return None
        parts = (self.weights @ above.astype(np.float32).T).astype(np.float64)
        k = self.decimals.size
        upper, lower, power = parts[:k], parts[k : 2 * k], parts[2 * k :]
        upper *= 10.0**GROUP
        upper += lower
        power *= 1.0 - exponent_signs
        power -= self.decimals[:, np.newaxis]
        out = scaled(upper, power.astype(np.intp))
        out *= 1.0 - 2.0 * negative
        return out.T.ravel()


def scaled(whole: NDArray[np.float64], power: NDArray[np.intp]) -> NDArray[np.float64]:
    """whole·10^power, rounded once: the bits that ``float`` makes of the text.

    Parameters
    ----------
    whole : float array
        Whole numbers from 0 to below 2⁵³.
    power : int array
        From −113 to 99.
    """
    at = power - _LEAST
    out = whole * _TIMES[at]
    out /= _OVER[at]
    far = np.abs(power) > EXACT_POWER
    if far.any():
        out[far] = _scaled_far(whole[far], power[far])
    return out


def _scaled_far(whole: NDArray[np.float64], power: NDArray[np.intp]) -> NDArray[np.float64]:
    """The same with powers that are no doubles: by their two halves, and by ``float`` where the error could turn the rounding."""
    high, low = _HIGH[power - _LEAST], _LOW[power - _LEAST]
    product = whole * high
    (a, b), (c, d) = _halves(whole), _halves(high)
    rest = ((a * c - product) + a * d + b * c) + b * d + whole * low
    doubt = product * _DOUBT
    out = product + (rest + doubt)
    for i in np.flatnonzero(out != product + (rest - doubt)):
        out[i] = float(f"{int(whole[i])}e{int(power[i])}")
    return out


def _halves(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    t = _SPLIT * x
    upper = t - (t - x)
    return upper, x - upper


def columns_of(line: bytes) -> Columns | None:
    """Columns of the numbers of a line with its end; None where it holds anything but numbers such as `` -1.25E-03``."""
    return _columns_of(line.translate(_SAME))


@lru_cache(maxsize=16)
def _columns_of(line: bytes) -> Columns | None:
    fields = list(_FIELD.finditer(line))
    rest = _FIELD.sub(b"", line)
    if not fields or rest.strip(b" ") not in (b"\n", b"\r\n"):
        return None
    low = np.frombuffer(line, np.uint8).copy()
    span = np.zeros_like(low)
    k = len(fields)
    weights = np.zeros((3 * k, low.size), np.float32)
    for j, field in enumerate(fields):
        sign, decimals = field.start(), len(field[1])
        digits = [sign + 1, *range(sign + 3, sign + 3 + decimals)]
        letter = sign + 3 + decimals
        span[sign] = ord("-") - ord(" ")
        low[letter], span[letter] = ord("D") if line[letter : letter + 1] == b"E" else ord("d"), 1
        low[letter + 1], span[letter + 1] = ord("+"), 2
        span[[*digits, letter + 2, letter + 3]] = 9
        for place, column in enumerate(reversed(digits)):
            weights[j + (0 if place >= GROUP else k), column] = 10 ** (place % GROUP)
        weights[2 * k + j, letter + 2 : letter + 4] = 10, 1
    starts = np.array([field.start() for field in fields])
    decimals_of = np.array([len(field[1]) for field in fields])
    return Columns(low, span, starts, starts + 4 + decimals_of, weights, decimals_of.astype(float))


def numbers_in_columns(text: bytes | memoryview, columns: Columns) -> NDArray[Any] | None:
    """Numbers of whole lines of one length; None where one deviates."""
    return columns.values(np.frombuffer(text, np.uint8).reshape(-1, columns.length))
