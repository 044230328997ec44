"""Exact sampling steps from printed ones: 1.95312E-03 stands for 1/512."""

from __future__ import annotations

import math
import re
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

_NUMBER = re.compile(r"^\s*[+-]?(\d*)\.?(\d*)(?:[EeDd]?([+-]?\d+))?\s*$")


def parse_float(text: str) -> float:
    """A number as Fortran prints it: ``1.5D-03``, ``1.5-103``, ``1.5E-03``."""
    clean = text.strip().replace("D", "E").replace("d", "e")
    try:
        return float(clean)
    except ValueError:
        return float(re.sub(r"(?<=[\d.])([+-]\d+)$", r"E\1", clean))


def printed_rounding(text: str) -> float:
    """Half a unit of the last printed digit: 5e-9 for ``1.95312E-03``; 0 if the text is no decimal number."""
    match = _NUMBER.match(text)
    if match is None or not (match[1] or match[2]):
        return 0.0
    exponent = int(match[3] or 0)
    if abs(exponent) > 300:
        return 0.0
    return 0.5 * 10.0 ** (exponent - len(match[2]))


@lru_cache(maxsize=256)
def restore_step(text: str, points: int, spectral: bool = False) -> float:
    """The step that was meant by its printed digits.

    Of all numbers that print as ``text``, the one whose own value, whose inverse (sampling rate) or whose span over the
    points is the roundest. The value never leaves the rounding interval of the printed digits. Of a frequency step (``spectral``) the span
    over a power of two of lines is half a sampling rate, and as good as a round inverse.
    """
    step = parse_float(text)
    if not (math.isfinite(step) and step > 0):
        return step
    half = printed_rounding(text) * 1.0001
    if not 0 < half < 0.01 * step:
        return step
    low, high = step - half, step + half
    best, best_digits = step, _digits(step)
    inverse = _roundest(1 / high, 1 / low)
    if inverse and inverse[0][0] < best_digits:
        best_digits, best = inverse[0][0], 1 / inverse[0][1]
    for count in (points - 1, points):
        if count > 1:
            span = _roundest(low * count, high * count)
            # A round span is weaker evidence than a round rate: it must save two digits.
            saved = 0 if spectral and count >= 64 and count & (count - 1) == 0 else 2
            if span and span[0][0] <= 4 and span[0][0] + saved <= best_digits:
                best_digits, best = span[0][0], span[0][1] / count
    return best if low <= best <= high else step


@lru_cache(maxsize=256)
def restore_start(text: str, step: float) -> float:
    """The first abscissa: the multiple of the step that prints as ``text``, else the number as printed."""
    start = parse_float(text)
    if start == 0 or not math.isfinite(start) or not step > 0:
        return start
    nearest = round(start / step) * step
    half = printed_rounding(text) * 1.0001
    return nearest if half < 0.1 * step and abs(nearest - start) <= half else start


def restore_step_of_values(first: float, last: float, points: int) -> float:
    """Step of an evenly sampled axis known by its first and last value: the rate is rounded where it is round to 1e-9."""
    step = (last - first) / (points - 1)
    rate = _roundest((1 - 1e-9) / step, (1 + 1e-9) / step)
    own = _roundest(step * (1 - 1e-9), step * (1 + 1e-9))
    best_rate, best_own = (rate[0] if rate else (99, 0.0)), (own[0] if own else (99, 0.0))
    if min(best_rate[0], best_own[0]) > 7:
        return step
    return 1 / best_rate[1] if best_rate[0] < best_own[0] else best_own[1]


def even_step(values: NDArray[np.float64]) -> tuple[float, float]:
    """Step of an axis by its first and last value, and how far the others are off in steps: 0 where all stand evenly."""
    step = restore_step_of_values(float(values[0]), float(values[-1]), values.size)
    return step, float(np.max(np.abs(values - values[0] - step * np.arange(values.size)))) / step


def _digits(value: float) -> int:
    """Significant decimal digits of a number, at most 17."""
    mantissa = f"{value:.16e}".split("e")[0].replace(".", "").replace("-", "")
    short = f"{value!r}".lower().split("e")[0].replace(".", "").replace("-", "").strip("0")
    return min(len(mantissa.rstrip("0")), len(short))


def _roundest(low: float, high: float) -> list[tuple[int, float]]:
    """Roundest number in an interval, with the digits it takes (a power of two times an odd part counts the odd part + 1)."""
    found: list[tuple[int, float]] = []
    if not (0 < low <= high < 1e300):
        return found
    exponent = math.floor(math.log10(high))
    for digits in range(1, 12):
        scale = Fraction(10) ** (exponent - digits + 1)
        n = math.ceil(Fraction(low) / scale)
        if n * scale <= Fraction(high):
            found.append((digits, float(n * scale)))
            break
    for power in range(24, 5, -1):
        n = math.ceil(low / 2**power)
        if n >= 1 and n * 2**power <= high:
            found.append((len(str(n)) + 1, float(n * 2**power)))
            break
    return sorted(found)


@lru_cache(maxsize=256)
def tidy_rate(step: float) -> float:
    """1/step without the last bits of rounding: 25000 and not 24999.999999999996."""
    rate = 1 / step
    short = float(f"{rate:.13g}")
    return short if abs(short * step - 1) < 4e-16 * 4 else rate
