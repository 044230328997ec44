"""Numbers and words as plain text: values with matching uncertainty digits, counts, lists; the page escapes them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Any

from operando.indicators import INTERVAL
from operando.structure.effects import with_spread

DASH = "–"
POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def finite(value: Any) -> bool:
    """Whether a value is a finite number (None, NaN and text are not)."""
    try:
        return value is not None and math.isfinite(float(value))
    except (TypeError, ValueError):
        return False


def number(value: Any, digits: int = 3) -> str:
    """A number with so many significant digits in plain notation where that is readable; a dash where there is none."""
    if not finite(value):
        return DASH
    x = float(value)
    if x == 0:
        return "0"
    exponent = math.floor(math.log10(abs(x)))
    if exponent < -4 or exponent > 6:
        mantissa = f"{x / 10.0**exponent:.{max(digits - 1, 0)}f}"
        return f"{mantissa}·10{str(exponent).translate(POWERS)}".replace("-", "−")
    return f"{x:.{max(digits - 1 - exponent, 0)}f}".replace("-", "−")


def fixed(value: Any, decimals: int = 2, sign: bool = False) -> str:
    """A number with so many decimals, a true minus sign, a dash where there is none."""
    if not finite(value):
        return DASH
    text = f"{float(value):{'+' if sign else ''}.{decimals}f}"
    if float(text) == 0:
        text = f"{0.0:.{decimals}f}"
    return text.replace("-", "−")


def decibel(value: Any) -> str:
    """A level in dB: two decimals below 10 dB, one above."""
    if not finite(value):
        return DASH
    return fixed(value, 2 if abs(float(value)) < 9.995 else 1) + " dB"


def plus_minus(value: Any, std: Any, digits: int = 5, factor: float = 1.0) -> str:
    """Value ± its 95 % interval, as effects are written: the interval with one digit, the value to the same digit.

    Without a deviation the value stands alone with ``digits`` significant digits. Both are multiplied by ``factor`` (100 for per cent).
    """
    if not finite(value):
        return DASH
    x = float(value) * factor
    if not finite(std) or float(std) <= 0:
        return number(x, digits)
    return with_spread(x, INTERVAL * float(std) * factor).replace("-", "−")


def percent(share: Any, digits: int = 2) -> str:
    """A share as per cent without the sign, a dash where there is none."""
    if not finite(share):
        return DASH
    return "< 0.01" if abs(float(share)) < 1e-4 else number(100 * float(share), digits)


def count(n: int, noun: str, plural: str | None = None) -> str:
    """``1 mode``, ``3 modes``, ``no modes``."""
    many = plural or noun + "s"
    return f"no {many}" if n == 0 else f"{n} {noun if n == 1 else many}"


def listing(items: Iterable[object], most: int = 8) -> str:
    """``a, b and c``; the rest is counted where there are more than ``most``."""
    texts = [str(i) for i in items]
    if len(texts) > most:
        return ", ".join(texts[:most]) + f" and {len(texts) - most} more"
    if len(texts) < 2:
        return "".join(texts)
    return ", ".join(texts[:-1]) + " and " + texts[-1]


def band_text(band: Sequence[float] | None) -> str:
    """``5.4–142.2 Hz``; one frequency where both ends read the same."""
    if band is None:
        return DASH
    low, high = plain(band[0]), plain(band[1])
    return f"{low} Hz" if low == high else f"{low}–{high} Hz"


def plain(value: Any, digits: int = 5) -> str:
    """A given (not estimated) number without trailing zeros."""
    return f"{float(value):.{digits}g}".replace("-", "−") if finite(value) else DASH


def short_names(names: str) -> str:
    """File names of a comma-separated list of paths, each with its folder only where names would repeat."""
    paths = [PurePath(part.strip()) for part in names.split(",")]
    bare = [p.name for p in paths]
    shown = bare if len(set(bare)) == len(bare) else ["/".join(p.parts[-2:]) for p in paths]
    return ", ".join(shown)


def size_text(n_bytes: Any) -> str:
    """File size in kB or MB."""
    if not finite(n_bytes):
        return DASH
    n = float(n_bytes)
    return f"{n / 1e6:.1f} MB" if n >= 1e6 else f"{n / 1e3:.0f} kB" if n >= 1e3 else f"{n:.0f} B"
