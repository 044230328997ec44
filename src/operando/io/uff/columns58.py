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
LONGEST = 1 << 10
"""Characters of a line; those of the standard have 82."""
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
_SIGN = np.zeros(1 + ord("-") - ord(" "))
"""Of a character by its place behind the blank; 0 for what is no sign."""
_SIGN[[0, ord("+") - ord(" ")]], _SIGN[ord("-") - ord(" ")] = 1.0, -1.0
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
    """Where the digits of the numbers of a line stand."""

    # low, span (LINES·length,): least character of each column, and how far above it one may lie, for all lines that are taken at once
    low: NDArray[np.uint8]
    span: NDArray[np.uint8]
    length: int  # characters of a line, its end included
    # width, repeats: columns of a group of numbers, and how often it stands in a line: mostly a number alone
    width: int
    repeats: int
    # signs, exponent_signs (numbers,): columns of the signs in a group
    signs: NDArray[np.intp]
    exponent_signs: NDArray[np.intp]
    weights: NDArray[np.float32]  # (3·numbers, width): makes the upper and the lower digits and the exponents of the digits of a group
    decimals: NDArray[np.float64]  # (numbers,): digits behind the point

    def values(self, text: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """Numbers of some whole lines, at most ``LINES``; None where a line has other columns."""
        above = text - self.low[: text.size]  # what lies below wraps around and is far above
        if (above > self.span[: text.size]).any():
            return None
        groups = above.reshape(-1, self.length)[:, : self.width * self.repeats].astype(np.float32).reshape(-1, self.width)
        exponent_signs = groups.T[self.exponent_signs]
        if (exponent_signs == 1).any():
            return None
        parts = (self.weights @ groups.T).astype(np.float64)
        k = self.decimals.size
        upper, lower, power = parts[:k], parts[k : 2 * k], parts[2 * k :]
        upper *= 10.0**GROUP
        upper += lower
        power *= 1.0 - exponent_signs
        power -= self.decimals[:, np.newaxis]
        out = scaled(upper, power.astype(np.intp))
        signs = _SIGN[groups.T[self.signs].astype(np.uint8)]
        if not signs.all():
            return None
        out *= signs
        return out.T.ravel()


def scaled(whole: NDArray[np.float64], power: NDArray[np.intp]) -> NDArray[np.float64]:
    """whole·10^power, rounded once: the bits that ``float`` makes of the text. Whole numbers 0 to below 2⁵³, powers −113 to 99."""
    if not power.size:
        return whole * 1.0
    least, most = power.min(), power.max()
    at = power - _LEAST
    out = whole * _TIMES[at] if most > 0 else whole.copy()
    out /= _OVER[at]
    if least < -EXACT_POWER or most > EXACT_POWER:
        far = np.abs(power) > EXACT_POWER
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
    """Columns of the numbers of a line with its end; None where it is very long or holds anything but numbers such as `` -1.25E-03``."""
    return _columns_of(line.translate(_SAME)) if len(line) <= LONGEST else None


@lru_cache(maxsize=16)
def _columns_of(line: bytes) -> Columns | None:
    fields = list(_FIELD.finditer(line))
    rest = _FIELD.sub(b"", line)
    if not fields or rest.strip(b" ") not in (b"\n", b"\r\n"):
        return None
    low = np.frombuffer(line, np.uint8).copy()
    span = np.zeros_like(low)
    for field in fields:
        letter = field.start() + 3 + len(field[1])
        span[field.start()] = ord("-") - ord(" ")
        low[letter], span[letter] = ord("D") if line[letter : letter + 1] == b"E" else ord("d"), 1
        low[letter + 1], span[letter + 1] = ord("+"), 2
        span[[field.start() + 1, *range(field.start() + 3, letter), letter + 2, letter + 3]] = 9
    width = fields[0].end()
    repeats = len(fields)
    if fields[-1].end() != repeats * width or any((a[: repeats * width].reshape(-1, width) != a[:width]).any() for a in (low, span)):
        width, repeats = fields[-1].end(), 1
    fields = [field for field in fields if field.end() <= width]
    k = len(fields)
    weights = np.zeros((3 * k, width), np.float32)
    for j, field in enumerate(fields):
        letter = field.start() + 3 + len(field[1])
        for place, column in enumerate([*range(letter - 1, field.start() + 2, -1), field.start() + 1]):
            weights[j + (0 if place >= GROUP else k), column] = 10 ** (place % GROUP)
        weights[2 * k + j, letter + 2 : letter + 4] = 10, 1
    starts = np.array([field.start() for field in fields])
    decimals_of = np.array([len(field[1]) for field in fields])
    all_low, all_span = np.tile(low, LINES), np.tile(span, LINES)
    return Columns(all_low, all_span, low.size, width, repeats, starts, starts + 4 + decimals_of, weights, decimals_of.astype(float))


def numbers_in_columns(text: bytes | memoryview, columns: Columns) -> NDArray[Any] | None:
    """Numbers of whole lines of one length; None where one deviates."""
    characters, step = np.frombuffer(text, np.uint8), columns.low.size
    parts = [columns.values(characters[start : start + step]) for start in range(0, characters.size, step)]
    found = [values for values in parts if values is not None]
    if len(found) < len(parts):
        return None
    return found[0] if len(found) == 1 else np.concatenate(found)
