"""The sets that say something about a file or its functions: header (151), units (164), qualifiers of functions (1858)."""

from __future__ import annotations

from dataclasses import dataclass

from operando.errors import FormatError
from operando.io.content import FileHeader
from operando.io.quantities import UnitSystem
from operando.io.uff.lines import body_lines, checked_floats, ints_of, said

_INCH, _POUND = 1 / 0.0254, 1 / 4.4482216152605
_FACTORS = {
    1: (1.0, 1.0), 2: (_INCH / 12, _POUND), 3: (1.0, 1 / 9.80665), 4: (_INCH / 12, 1 / 0.138254954376), 5: (1e3, 1e3), 6: (1e2, 1e2),
    7: (_INCH, _POUND), 8: (1e3, 1 / 9.80665), 10: (1e3, 1.0),
}  # fmt: skip
_WINDOWS = ("", "Hanning narrow", "Hanning broad", "flat top", "exponential", "impact", "impact and exponential")


@dataclass(frozen=True)
class Qualifiers:
    """What a set 1858 adds to a function: window, and the damping factor of an exponential one (0 where there is none)."""

    window: str
    exponential_factor: float

    @property
    def exponential(self) -> bool:
        """Whether the function was measured under an exponential window."""
        return "exponential" in self.window


def read_header(raw: bytes) -> FileHeader:
    """Header of a file, set 151."""
    lines = [said(line) for line in body_lines(raw)]
    lines += [""] * (7 - len(lines))
    return FileHeader(*lines[:7])


def read_units(raw: bytes) -> tuple[UnitSystem, str]:
    """Unit factors of a set 164, and what contradicts its own unit code in words (empty where nothing does)."""
    lines = body_lines(raw)
    if len(lines) < 2:
        raise FormatError(f"set 164 has {len(lines)} lines, expected at least 2")
    description = said(lines[0][10:30])
    try:
        code = int(lines[0][:10])
    except ValueError:
        code = 9  # user defined: nothing to compare with
    factors = checked_floats(lines[1], "the factors of set 164")
    if len(factors) < 2:
        raise FormatError(f"the factors of set 164 cannot be read: {lines[1].strip()[:80]!r}")
    length, force = factors[:2]
    if not (0 < length < 1e30 and 0 < force < 1e30):
        raise FormatError(f"unit factors {length}, {force} of set 164 are not positive numbers")
    problem = ""
    if code in _FACTORS:
        expected = _FACTORS[code]
        # Files print between 6 and 17 digits of these factors.
        if abs(length / expected[0] - 1) > 1e-5 or abs(force / expected[1] - 1) > 1e-5:
            problem = (
                f"the factors {length:g} (length) and {force:g} (force) are not those of the stated unit code {code} "
                f"({expected[0]:g} and {expected[1]:g})"
            )
    return UnitSystem(length, force, description), problem


def read_qualifiers(raw: bytes) -> Qualifiers:
    """Qualifiers of a function, set 1858."""
    lines = body_lines(raw)
    if len(lines) < 4:
        raise FormatError(f"set 1858 has {len(lines)} lines, expected at least 4")
    window = ints_of(lines[1], 2, "record 2 of set 1858")[1]
    if not 0 <= window < len(_WINDOWS):
        raise FormatError(f"window type {window} of set 1858 is unknown")
    factors = checked_floats(lines[3], "record 4 of set 1858")
    return Qualifiers(_WINDOWS[window], factors[4] if len(factors) > 4 else 0.0)
