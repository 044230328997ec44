"""Header of UFF 58 and 58b: a function at nodal DOFs."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from operando.dof import Dof
from operando.errors import DofError, FormatError
from operando.io.uff.increments import parse_float, restore_start, restore_step
from operando.io.uff.lines import decode, said

if TYPE_CHECKING:
    from operando.io.uff.textform import Buffer

FUNCTION_TYPES = {
    0: "general function", 1: "time response", 2: "auto spectrum", 3: "cross spectrum", 4: "frequency response function",
    5: "transmissibility", 6: "coherence", 7: "auto correlation", 8: "cross correlation", 9: "power spectral density",
    10: "energy spectral density", 11: "probability density", 12: "spectrum", 13: "cumulative frequency distribution",
    14: "peaks and valleys", 15: "stress cycles", 16: "strain cycles", 17: "orbit", 18: "mode indicator function",
    19: "force pattern", 20: "partial power", 21: "partial coherence", 22: "eigenvalue", 23: "eigenvector",
    24: "shock response spectrum", 25: "impulse response filter", 26: "multiple coherence", 27: "order function",
}  # fmt: skip
"""Names of the function types of UFF 58, record 6."""

_COMPLEX = {5, 6}
_DOUBLE = {4, 6}
_RECORD6 = re.compile(r"^\s*(-?\d+)\s+(-?\d+)\s+(-?\d+)\s+(-?\d+)\s+(.*?)\s+(-?\d+)\s+(-?\d+)\s+(.*?)\s+(-?\d+)\s+(-?\d+)\s*$")
_MAX_POINTS = 1 << 40


@dataclass(frozen=True)
class Axis:
    """What an axis carries: data type code, unit exponents (length, force, temperature), label, unit text."""

    code: int = 0
    exponents: tuple[int, int, int] = (0, 0, 0)
    label: str = ""
    unit: str = ""


@dataclass(frozen=True)
class Header58:
    """Header of one measured function: the five ID lines, and start and step of an even axis as restored from the printed digits."""

    binary: bool
    big_endian: bool
    stated_bytes: int
    ids: tuple[str, ...]
    function_type: int
    response: Dof | None
    reference: Dof | None
    response_name: str
    reference_name: str
    is_complex: bool
    is_double: bool
    even: bool
    points: int
    start: float
    step: float
    abscissa: Axis
    ordinate: Axis
    denominator: Axis

    @property
    def numbers_per_point(self) -> int:
        """1 or 2, and one more where each point has its abscissa."""
        return (2 if self.is_complex else 1) + (0 if self.even else 1)

    @property
    def expected_bytes(self) -> int:
        """Length of the binary payload by the number of points."""
        return self.points * self.numbers_per_point * (8 if self.is_double else 4)

    @property
    def title(self) -> str:
        """Function type and DOFs in words."""
        text = FUNCTION_TYPES.get(self.function_type, f"function type {self.function_type}")
        if self.response is not None:
            text += f" {self.response}"
        elif self.response_name:
            text += f" {self.response_name}"
        if self.reference is not None and self.function_type != 1:
            text += f"/{self.reference}"
        return text

    @property
    def name(self) -> str:
        """Channel name: the entity name, or the first ID line (which holds it in full where the entity name was cut)."""
        first = self.ids[0]
        if self.response_name and not first.startswith(self.response_name):
            return self.response_name
        return first or self.response_name


def parse_header58(buffer: Buffer, at: int) -> tuple[Header58, int]:
    """Header whose first line (``58`` or ``58b``) starts at ``at``, and the offset of the data."""
    lines, data = _lines(buffer, at, 12)
    if len(lines) < 12:
        raise FormatError(f"the header of the function ends after {len(lines)} of 12 lines")
    binary, big_endian, stated = _first_line(lines[0])
    kind, points, even, step_text, start_text = _record7(lines[7])
    function_type, response, reference, response_name, reference_name = _record6(lines[6])
    ids = tuple(_id_text(line) for line in lines[1:6])
    try:
        axes = [_axis(line) for line in lines[8:11]]
        spectral = function_type != 1 and axes[0].code != 17
        step = restore_step(step_text, points, spectral) if even else 0.0
        exact = _exact(ids, "step")
        if exact is not None and math.isclose(exact, step, rel_tol=1e-5):
            step = exact
        start = restore_start(start_text, step) if even else 0.0
        exact = _exact(ids, "start")
        if exact is not None and even and math.isclose(exact, start, rel_tol=1e-5, abs_tol=1e-5 * step):
            start = exact
    except (ValueError, OverflowError) as error:
        raise FormatError(f"the abscissa of the function cannot be read: {lines[7][:80]!r}") from error
    if even and not (math.isfinite(step) and step > 0 and math.isfinite(start)):
        raise FormatError(f"the abscissa increment {step_text.strip()[:80]!r} is not positive")
    header = Header58(
        binary, big_endian, stated, ids, function_type, response, reference, response_name, reference_name,
        kind in _COMPLEX, kind in _DOUBLE, even, points, start, step, *axes,
    )  # fmt: skip
    return header, data


def _lines(buffer: Buffer, at: int, count: int) -> tuple[list[bytes], int]:
    # Twelve lines of the standard have 890 characters at most: cut at once; only longer lines are searched for one by one.
    head = bytes(buffer[at : at + 1024])
    found = head.split(b"\n", count)
    if len(found) > count:
        data = at + len(head) - len(found.pop())
        return [line.rstrip(b"\r") for line in found] if b"\r" in head else found, data
    lines: list[bytes] = []
    for _ in range(count):
        newline = buffer.find(b"\n", at, at + 65536)
        if newline < 0:
            break
        lines.append(bytes(buffer[at:newline]).rstrip(b"\r"))
        at = newline + 1
    return lines, at


@lru_cache(maxsize=256)
def _first_line(line: bytes) -> tuple[bool, bool, int]:
    text = line.decode("latin-1")
    match = re.match(r"\s*58\s*[bB]\b(.*)$", text)
    if match is None:
        return False, False, 0
    tokens = match[1].split()
    try:
        # Some programs shift the columns: the fields are taken in their order.
        byte_order, float_format, _, stated = (int(t) for t in tokens[:4])
    except ValueError:
        raise FormatError(f"the first line of the 58b set cannot be read: {text.strip()[:80]!r}") from None
    if float_format in (1, 3):
        name = {1: "VAX (DEC)", 3: "IBM 370"}[float_format]
        raise FormatError(f"binary data in {name} floating point are not supported", hint="export them as IEEE 754 or ASCII")
    if float_format != 2 or byte_order not in (1, 2):
        raise FormatError(f"byte order {byte_order} and floating-point format {float_format} of the 58b set are unknown")
    return True, byte_order == 2, stated


@lru_cache(maxsize=256)
def _record7(line: bytes) -> tuple[int, int, bool, str, str]:
    text = line.decode("latin-1")
    tokens = re.sub(r"(?<=\d)(?=[+-]\d*\.)", " ", text).split()
    choices = [tokens, [text[a:b] for a, b in ((0, 10), (10, 20), (20, 30), (30, 43), (43, 56), (56, 69))]]
    for fields in choices:
        try:
            kind, points, spacing = (int(f) for f in fields[:3])
            start, step = fields[3], fields[4]
            parse_float(start), parse_float(step)
        except (ValueError, IndexError):
            continue
        if kind not in (2, 4, 5, 6):
            raise FormatError(f"ordinate data type {kind} is none of 2 (real single), 4 (real double), 5, 6 (complex)")
        if not 0 < points < _MAX_POINTS:
            raise FormatError(f"the function declares {points} points")
        return kind, points, spacing != 0, step, start
    raise FormatError(f"record 7 of the function (type, points, abscissa) cannot be read: {text.strip()[:80]!r}")


def _record6(line: bytes) -> tuple[int, Dof | None, Dof | None, str, str]:
    names = [line[30:41], line[55:66]]
    try:
        numbers = [int(line[0:5]), int(line[41:51]), int(line[51:55]), int(line[66:76] or 0), int(line[76:80] or 0)]
    except ValueError:
        text = line.decode("latin-1").ljust(80)
        match = _RECORD6.match(text)
        if match is None:
            kind = re.match(r"\s*(\d+)", text)
            if kind is None:
                raise FormatError(f"record 6 of the function (type, DOFs) cannot be read: {text.strip()[:80]!r}") from None
            numbers, names = [int(kind[1]), 0, 0, 0, 0], [b"", b""]
        else:
            numbers = [int(match[i]) for i in (1, 6, 7, 9, 10)]
            names = [match[5].encode("latin-1"), match[8].encode("latin-1")]
    kind_number, node, code, reference_node, reference_code = numbers
    return (
        kind_number,
        _dof(node, code),
        _dof(reference_node, reference_code),
        said(decode(names[0])),
        said(decode(names[1])),
    )


@lru_cache(maxsize=1024)
def _dof(node: int, code: int) -> Dof | None:
    """DOF of node and direction; none where the file leaves both at 0 or states what is no DOF."""
    if node == 0 and code == 0:
        return None
    try:
        return Dof.from_uff(node, code)
    except DofError:
        return None


@lru_cache(maxsize=256)
def _axis(line: bytes) -> Axis:
    head, label, unit = line[:25], line[25:46], line[46:67]
    numbers = [head[0:10], head[10:15], head[15:20], head[20:25]]
    try:
        code, *exponents = (int(n.strip() or b"0") for n in numbers)
    except ValueError:
        tokens = line.split(None, 4)
        try:
            code, *exponents = (int(t) for t in tokens[:4])
        except ValueError:
            return Axis()
        rest = re.split(rb"\s{2,}", tokens[4].strip()) if len(tokens) > 4 else []
        label, unit = (rest[0] if rest else b""), (rest[1] if len(rest) > 1 else b"")
    if len(exponents) != 3:
        return Axis()
    return Axis(code, (exponents[0], exponents[1], exponents[2]), said(decode(label)), said(decode(unit)))


@lru_cache(maxsize=256)
def _id_text(line: bytes) -> str:
    return said(decode(line[:4096]))


def _exact(ids: tuple[str, ...], name: str) -> float | None:
    """Value that operando wrote into an ID line because the standard field is too narrow."""
    for line in ids:
        if f"{name}=" not in line:
            continue
        match = re.search(rf"\b{name}=([-+0-9.eE]+)", line)
        if match is not None:
            try:
                return float(match[1])
            except ValueError:
                return None
    return None
