"""Physical quantities and conversion to SI."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import lru_cache
from typing import Final

from operando.errors import UnitError

G_STANDARD: Final = 9.80665
"""Standard acceleration of gravity [m/s²]."""

# UFF 58 specific data type code -> (quantity, SI unit)
UFF_QUANTITIES: Final[dict[int, tuple[str, str]]] = {
    0: ("unknown", ""),
    1: ("general", ""),
    2: ("stress", "Pa"),
    3: ("strain", "m/m"),
    5: ("temperature", "K"),
    6: ("heat_flux", "W/m2"),
    8: ("displacement", "m"),
    9: ("reaction_force", "N"),
    11: ("velocity", "m/s"),
    12: ("acceleration", "m/s2"),
    13: ("force", "N"),
    15: ("pressure", "Pa"),
    16: ("mass", "kg"),
    17: ("time", "s"),
    18: ("frequency", "Hz"),
    19: ("rpm", "rpm"),
    20: ("order", ""),
}

SI_UNIT: Final[dict[str, str]] = {
    "acceleration": "m/s2", "velocity": "m/s", "displacement": "m", "force": "N", "strain": "m/m", "pressure": "Pa",
    "voltage": "V", "moment": "N m", "angular_acceleration": "rad/s2", "angular_velocity": "rad/s", "angle": "rad",
    "temperature": "K", "time": "s", "frequency": "Hz", "rpm": "rpm", "mass": "kg", "unknown": "", "general": "",
    "stress": "Pa", "order": "", "heat_flux": "W/m2", "reaction_force": "N",
}  # fmt: skip

# unit (normalised text) -> (quantity, factor to SI)
_UNITS: Final[dict[str, tuple[str, float]]] = {
    "m/s2": ("acceleration", 1.0), "mm/s2": ("acceleration", 1e-3), "cm/s2": ("acceleration", 1e-2),
    "g": ("acceleration", G_STANDARD), "gn": ("acceleration", G_STANDARD), "mg": ("acceleration", G_STANDARD * 1e-3),
    "gal": ("acceleration", 1e-2), "in/s2": ("acceleration", 0.0254), "ft/s2": ("acceleration", 0.3048),
    "um/s2": ("acceleration", 1e-6),
    "m/s": ("velocity", 1.0), "mm/s": ("velocity", 1e-3), "cm/s": ("velocity", 1e-2), "um/s": ("velocity", 1e-6),
    "in/s": ("velocity", 0.0254), "ft/s": ("velocity", 0.3048), "km/h": ("velocity", 1 / 3.6),
    "m": ("displacement", 1.0), "mm": ("displacement", 1e-3), "cm": ("displacement", 1e-2),
    "um": ("displacement", 1e-6), "nm": ("displacement", 1e-9), "in": ("displacement", 0.0254),
    "ft": ("displacement", 0.3048), "mil": ("displacement", 2.54e-5),
    "n": ("force", 1.0), "mn": ("force", 1e-3), "kn": ("force", 1e3), "lbf": ("force", 4.4482216152605),
    "lb": ("force", 4.4482216152605), "kip": ("force", 4448.2216152605), "kgf": ("force", 9.80665),
    "kp": ("force", 9.80665), "dyn": ("force", 1e-5), "ozf": ("force", 0.27801385095378125),
    "rad": ("angle", 1.0), "deg": ("angle", 0.017453292519943295), "rad/s": ("angular_velocity", 1.0),
    "rad/s2": ("angular_acceleration", 1.0), "n*m": ("moment", 1.0), "lbf*in": ("moment", 0.1129848290276167),
    "m/m": ("strain", 1.0), "um/m": ("strain", 1e-6), "ue": ("strain", 1e-6), "ustrain": ("strain", 1e-6),
    "pa": ("pressure", 1.0), "kpa": ("pressure", 1e3), "mpa": ("pressure", 1e6), "bar": ("pressure", 1e5),
    "psi": ("pressure", 6894.757293168361),
    "v": ("voltage", 1.0), "mv": ("voltage", 1e-3), "uv": ("voltage", 1e-6),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "min": ("time", 60.0),
    "hz": ("frequency", 1.0), "khz": ("frequency", 1e3), "rpm": ("rpm", 1.0),
    "kg": ("mass", 1.0), "lbm": ("mass", 0.45359237), "k": ("temperature", 1.0),
}  # fmt: skip

# Texts that differ only in case from another unit keep their case: mN and MN, mPa and MPa.
_CASED: Final[dict[str, tuple[str, float]]] = {
    "MN": ("force", 1e6), "mN": ("force", 1e-3), "MPa": ("pressure", 1e6), "mPa": ("pressure", 1e-3),
    "Nm": ("moment", 1.0), "N m": ("moment", 1.0), "N-m": ("moment", 1.0), "N.m": ("moment", 1.0), "G": ("acceleration", G_STANDARD),
}  # fmt: skip


def normalise_unit(text: str) -> str:
    """Unit text in one spelling: ``m/s^2``, ``m/sec**2``, ``m/s²`` become ``m/s2``."""
    unit = text.strip().strip("[]()").strip()
    unit = unit.replace("²", "2").replace("µ", "u").replace("μ", "u").replace("·", "*").replace("ε", "e")
    unit = re.sub(r"\*\*|\^", "", unit)
    unit = re.sub(r"\s+", "", unit).lower()
    unit = re.sub(r"sec(ond)?s?", "s", unit)
    unit = re.sub(r"(?<![a-z])(inch(es)?|\")", "in", unit)
    unit = {"m/s/s": "m/s2", "mm/s/s": "mm/s2", "in/s/s": "in/s2", "newton": "n", "newtons": "n", "meter": "m", "gs": "g",
            "metre": "m", "volt": "v", "volts": "v", "g's": "g", "g0": "g", "lbs": "lbf", "pound": "lbf"}.get(unit, unit)  # fmt: skip
    return unit


@lru_cache(maxsize=512)
def parse_unit(text: str, quantity: str | None = None) -> tuple[str, float]:
    """Quantity and factor to SI of a unit text.

    Parameters
    ----------
    text : str
        Unit as written, for example ``g``, ``m/s^2``, ``lbf``, ``mm``.
    quantity : str, optional
        The quantity that is expected; it decides where a text is ambiguous.

    Returns
    -------
    quantity : str
        Physical quantity.
    factor : float
        Multiply a value in ``text`` by this to get SI.

    Raises
    ------
    UnitError
        If the unit is unknown, or of another quantity than expected.
    """
    stripped = text.strip().strip("[]()").strip()
    found = _CASED.get(stripped) or _UNITS.get(normalise_unit(text))
    if found is None:
        raise UnitError(
            f"unknown unit {text!r}" + (f" for {quantity}" if quantity else ""),
            hint="known: " + ", ".join(sorted([u for u, v in _UNITS.items() if v[0] == quantity] or _UNITS)),
        )
    if quantity not in (None, "unknown", "general", "") and found[0] != quantity:
        alternatives = {u: v for u, v in {**_UNITS, **_CASED}.items() if v[0] == quantity}
        raise UnitError(
            f"{text!r} is a unit of {found[0]}, not of {quantity}",
            hint="for example: " + ", ".join(list(alternatives)[:8]),
        )
    return found


def stated_unit(text: str, quantity: str = "unknown") -> tuple[str, str, float]:
    """Quantity, SI unit and factor to SI of what is stated of a channel.

    Parameters
    ----------
    text : str
        Unit as written, empty where not known.
    quantity : str
        Physical quantity, ``unknown`` where the unit tells it.

    Returns
    -------
    quantity : str
    unit : str
        SI unit; empty where no unit is stated.
    factor : float
        Multiply a value in ``text`` by this to get SI; 1 where no unit is stated.

    Raises
    ------
    UnitError
        If the quantity or the unit is unknown, or the unit is of another quantity.

    Examples
    --------
    >>> from operando.units import stated_unit
    >>> stated_unit("kN", "force")
    ('force', 'N', 1000.0)
    """
    if not isinstance(quantity, str) or quantity not in SI_UNIT:
        near = get_close_matches(str(quantity).strip().lower(), SI_UNIT, 1, 0.4)
        hint = (f"did you mean {near[0]!r}? " if near else "") + "one of " + ", ".join(SI_UNIT)
        raise UnitError(f"unknown quantity {quantity!r}", hint=hint)
    if not isinstance(text, str):
        raise UnitError(f"the unit is {text!r:.60}, no text", hint='write for example "m/s2", and "" where it is not known')
    if not text or text == SI_UNIT[quantity]:
        return quantity, text, 1.0
    found, factor = parse_unit(text, {"stress": "pressure", "reaction_force": "force"}.get(quantity, quantity))
    return (found if quantity in ("unknown", "general") else quantity), SI_UNIT[found], factor


def si_factor(text: str, quantity: str | None = None) -> float:
    """Factor from the unit ``text`` to SI (see :func:`parse_unit`)."""
    return parse_unit(text, quantity)[1]


_LARGE = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""))
_SMALL = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
_PREFIXES = {
    "N/m": _LARGE,
    "N s/m": _LARGE,
    "N": (*_LARGE, *_SMALL[1:]),
    "kg": ((1.0, "kg"), (1e-3, "g"), (1e-6, "mg")),
    "m": ((1.0, ""), (1e-4, "m"), (1e-7, "µ"), (1e-10, "n")),
    "m/s": _SMALL,
    "s": _SMALL,
}
"""Sizes from which on an SI unit is written with a prefix; millimetres from 0.1 mm on."""


def written_unit(unit: str) -> str:
    """An SI unit as people write it: ``N·s/m`` for ``N s/m``."""
    return unit.replace("N s", "N·s").replace("m3", "m³").replace("m2", "m²").replace("s2", "s²")


def engineering_unit(size: float, unit: str) -> tuple[float, str]:
    """The unit in which engineers write a value of that size.

    Parameters
    ----------
    size : float
        Magnitude in the SI unit.
    unit : str
        SI unit; units without a customary prefix are returned as they are.

    Returns
    -------
    factor : float
        Divide a value in the SI unit by this.
    text : str
        The unit with its prefix.

    Examples
    --------
    >>> engineering_unit(149994.0, "N/m")
    (1000.0, 'kN/m')
    >>> engineering_unit(4e-4, "m")
    (0.001, 'mm')
    >>> engineering_unit(0.15, "kg")
    (0.001, 'g')
    """
    steps = _PREFIXES.get(unit)
    if steps is None or size == 0:
        return 1.0, written_unit(unit)
    least, prefix = next(((f, p) for f, p in steps if abs(size) >= f), steps[-1])
    if unit == "kg":
        return least, prefix
    return {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "µ": 1e-6, "n": 1e-9}[prefix], prefix + written_unit(unit)
