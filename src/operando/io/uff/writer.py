"""Writing of UFF files; the functions (58, 58b) here, the text sets in :mod:`operando.io.uff.text_sets`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from operando.atomic import replacing
from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.dof import Dof, Node
from operando.errors import DataError
from operando.io.content import FileHeader
from operando.io.uff.components import NodeNumbers
from operando.io.uff.frfs import STANDARD_DEVIATION
from operando.io.uff.header58 import Axis
from operando.io.uff.increments import restore_start, restore_step, tidy_rate
from operando.io.uff.lines import OWN_LINES, print_date
from operando.io.uff.text_sets import field_of, number13, write_geometry, write_header, write_modes, write_units
from operando.units import UFF_QUANTITIES

_CODES = {name: code for code, (name, _) in UFF_QUANTITIES.items() if name not in ("unknown", "general")}
_CODES |= {"angular_acceleration": 12, "angular_velocity": 11, "angle": 8, "moment": 13}
_EXPONENTS = {
    "acceleration": (1, 0, 0), "velocity": (1, 0, 0), "displacement": (1, 0, 0), "force": (0, 1, 0), "moment": (1, 1, 0),
    "pressure": (-2, 1, 0), "mass": (-1, 1, 0), "temperature": (0, 0, 1),
}  # fmt: skip
_LABELS = {"time": "Time", "frequency": "Frequency", "acceleration": "Acceleration", "force": "Force"}
_NUMERATOR = {"accelerance": ("acceleration", "m/s2"), "mobility": ("velocity", "m/s"), "receptance": ("displacement", "m")}
_ANGULAR = {"acceleration": ("angular_acceleration", "rad/s2"), "velocity": ("angular_velocity", "rad/s"), "displacement": ("angle", "rad")}
_TIME = Axis(17, (0, 0, 0), "Time", "s")
_FREQUENCY = Axis(18, (0, 0, 0), "Frequency", "Hz")


@dataclass(frozen=True)
class Function:
    """Everything of one set 58 but the number format of its values."""

    kind: int
    response: Dof | None
    reference: Dof | None
    name: str
    abscissa: Axis
    ordinate: Axis
    denominator: Axis
    start: float
    step: float
    frequencies: NDArray[np.float64] | None
    values: NDArray[Any]
    ids: tuple[str, ...]


def write_uff(
    path: str | Path,
    *objects: TimeRecord | Frf | ModalModel | Geometry,
    binary: bool = True,
    single: bool | None = None,
    big_endian: bool = False,
    header: FileHeader | None = None,
    node_set: int = 2411,
    passthrough: Iterable[bytes] = (),
) -> None:
    """Write objects into one UFF file, which appears whole or not at all.

    Records become one set 58 (function type 1) a channel; FRFs one a pair (type 4), beside it their coherence (type 6) and, where the
    variance is known, the standard deviation of each line (type 0, named in the first ID line); modes sets 55 whose ID lines state the
    scaling, residual terms further sets 55; geometries sets 2411 or 15, 2420, 82, 2412. Units are SI, stated in the labels and, if
    everything is SI, in a set 164. Shapes have the six digits of the standard; functions keep all. Start and step of an even axis and
    the poles fill their 13 columns (8 to 11 digits); where that is not exact, an ID line holds all digits, which operando reads
    (an uneven axis in ASCII has 8 digits). The date line holds when the data were measured, where that is known, never the time of
    writing: the same objects make the same bytes.

    Parameters
    ----------
    path : path
        File to write.
    *objects : TimeRecord, Frf, ModalModel or Geometry
        What to write, in this order.
    binary : bool
        58b (IEEE 754) or ASCII (13 digits).
    single : bool, optional
        Single precision; default: as the data are (records may be single, FRFs are double). Binary only.
    big_endian : bool
        Byte order of binary data.
    header : FileHeader, optional
        Set 151 at the beginning.
    node_set : {2411, 15}
        Nodes in double precision, or with the six digits of the older set.
    passthrough : iterable of bytes
        Raw sets with their separators, written behind as they are.

    Raises
    ------
    DataError
        If an object has no form in UFF.
    MissingError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile, operando
    >>> geometry = operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]], ((1, 2),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/geometry.uff", geometry)
    ...     operando.read(f"{folder}/geometry.uff").geometry.coordinates.tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    for obj in objects:
        if not isinstance(obj, TimeRecord | Frf | ModalModel | Geometry):
            raise DataError(f"{type(obj).__name__} has no form in UFF", hint="TimeRecord, Frf, ModalModel or Geometry")
    numbers = NodeNumbers.of(numbered_nodes(objects))
    if header is None and numbers.components:
        header = FileHeader(writer="operando")
    with replacing(path) as stream:
        if header is not None:
            write_header(stream, header, numbers)
        if objects and all(_is_si(obj) for obj in objects):
            write_units(stream)
        for obj in sorted(objects, key=lambda o: not isinstance(o, Geometry)):
            if isinstance(obj, Geometry):
                write_geometry(stream, obj, numbers, node_set)
            elif isinstance(obj, ModalModel):
                write_modes(stream, obj, numbers)
            else:
                for function in record_functions(obj) if isinstance(obj, TimeRecord) else frf_functions(obj):
                    _write_function(stream, function, binary, single, big_endian)
        for raw in passthrough:
            stream.write(raw if raw.endswith(b"\n") else raw + b"\n")


def numbered_nodes(objects: Iterable[Any]) -> list[Node]:
    """Nodes that stand as bare numbers in the file: those of geometries and modes; functions name the component."""
    nodes: list[Node] = []
    for obj in objects:
        if isinstance(obj, Geometry):
            nodes += obj.nodes
        elif isinstance(obj, ModalModel):
            nodes += [dof.node for dof in obj.dofs]
    return nodes


def _is_si(obj: Any) -> bool:
    if isinstance(obj, TimeRecord):
        return all(channel.unit for channel in obj.channels)
    if isinstance(obj, Frf):
        return obj.si
    return obj.unit_known if isinstance(obj, Geometry) else True


def record_functions(record: TimeRecord) -> Iterable[Function]:
    for row, channel in zip(record.data, record.channels, strict=True):
        ordinate = _axis(channel.quantity, channel.unit)
        yield Function(
            1, channel.dof, None, channel.name, _TIME, ordinate, Axis(), record.start_s, 1 / record.sampling_hz, None, row,
            (channel.name, f"{OWN_LINES[2]} {channel.label}", print_date(record.provenance.measured), "", ""),
        )  # fmt: skip


def frf_functions(frf: Frf) -> Iterable[Function]:
    start, step, frequencies = _even(frf.frequencies_hz)
    averages = "" if frf.averages is None else f"averages={frf.averages:.17g}"
    date = print_date(frf.provenance.measured)
    for j, reference in enumerate(frf.references):
        for i, response in enumerate(frf.responses):
            if np.all(np.isnan(frf.data[i, j])):
                continue
            quantity, unit = _NUMERATOR[frf.quantity]
            if response.axis.startswith("R"):
                quantity, unit = _ANGULAR[quantity]
            below = ("moment", "N m") if reference.axis.startswith("R") else ("force", "N")
            ordinate = _axis(quantity, unit if frf.si else "")
            denominator = _axis(below[0], below[1] if frf.si else "")
            ids = (f"{frf.quantity} {response}/{reference}", OWN_LINES[0], date, "", averages)
            yield Function(4, response, reference, "", _FREQUENCY, ordinate, denominator, start, step, frequencies, frf.data[i, j], ids)
            if frf.coherence is not None and not np.all(np.isnan(frf.coherence[i, j])):
                ids = (f"coherence {response}/{reference}", *ids[1:])
                values = frf.coherence[i, j]
                yield Function(6, response, reference, "", _FREQUENCY, Axis(), Axis(), start, step, frequencies, values, ids)
            if frf.variance is not None and not np.all(np.isnan(frf.variance[i, j])):
                ids = (f"{STANDARD_DEVIATION} {frf.quantity} {response}/{reference}", OWN_LINES[1], *ids[2:])
                values = np.sqrt(frf.variance[i, j])
                yield Function(0, response, reference, "", _FREQUENCY, ordinate, denominator, start, step, frequencies, values, ids)


def _even(frequencies: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float64] | None]:
    """Start, step and None for an even axis; the lines themselves for an uneven one."""
    n = frequencies.size
    if n == 1:
        return float(frequencies[0]), 1.0, None
    step = float(frequencies[-1] - frequencies[0]) / (n - 1)
    off = np.abs(frequencies - (frequencies[0] + step * np.arange(n)))
    if float(off.max()) <= 1e-13 * float(frequencies[-1]) * 8:
        return float(frequencies[0]), step, None
    return 0.0, 0.0, frequencies


def _axis(quantity: str, unit: str) -> Axis:
    exponents = _EXPONENTS.get(quantity, (0, 0, 0)) if unit else (0, 0, 0)
    return Axis(_CODES.get(quantity, 0), exponents, _LABELS.get(quantity, quantity.replace("_", " ").capitalize()), unit)


def _write_function(stream: IO[bytes], f: Function, binary: bool, single: bool | None, big_endian: bool) -> None:
    complex_values = np.iscomplexobj(f.values)
    if single is None:
        single = f.values.dtype in (np.dtype(np.float32), np.dtype(np.complex64))
    single = single and binary
    kind = (5 if complex_values else 2) + (0 if single else (1 if complex_values else 2))
    dtype = np.dtype((">" if big_endian else "<") + ("f4" if single else "f8"))
    columns = [f.values.real, f.values.imag] if complex_values else [f.values]
    if f.frequencies is not None:
        columns = [f.frequencies, *columns]
    if len(columns) == 1:
        numbers = np.ascontiguousarray(f.values, dtype)
    else:
        numbers = np.ascontiguousarray(np.column_stack(columns), dtype)
    stream.write(b"    -1\n" + _header(f, binary, kind, numbers.nbytes, big_endian))
    if binary:
        stream.write(numbers.reshape(-1).view(np.uint8).data)
        stream.write(b"    -1\n")  # no line end before it: other readers take one for data
    else:
        _write_numbers(stream, numbers.reshape(-1), _line_format(f.frequencies is None, complex_values))
        stream.write(b"    -1\n")


def _header(f: Function, binary: bool, kind: int, n_bytes: int, big_endian: bool) -> bytes:
    first = f"{58:6d}"
    if binary:
        first += f"b{2 if big_endian else 1:6d}{2:6d}{11:12d}{n_bytes:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    even = f.frequencies is None
    start, step = number13(f.start), number13(f.step)
    ids = list(f.ids)
    if even and not _survives(f, start, step):
        ids[3] = f"step={f.step!r} start={f.start!r}"
    record6 = f"{f.kind:5d}{1:10d}{0:5d}{0:10d}".encode()
    for name, dof in ((f.name, f.response), ("", f.reference)):
        entity = field_of(dof.component if dof is not None and dof.component else name, 10)
        record6 += b" " + entity + (f"{dof.number:10d}{dof.uff_code:4d}" if dof is not None else f"{0:10d}{0:4d}").encode()
    record7 = f"{kind:10d}{f.values.size:10d}{int(even):10d}{start}{step}{0.0:13.5E}".encode()
    lines = [first.encode(), *(field_of(text, 80) for text in ids), record6, record7]
    lines += [_axis_line(axis) for axis in (f.abscissa, f.ordinate, f.denominator, Axis())]
    return b"\n".join(line.rstrip() if len(line) == 80 else line for line in lines) + b"\n"


def _survives(f: Function, start: str, step: str) -> bool:
    """Whether a reader gets the exact axis from the six printed digits."""
    restored = restore_step(step, f.values.size, f.kind != 1)
    same_step = restored == f.step or tidy_rate(restored) == tidy_rate(f.step)
    return same_step and restore_start(start, restored) == f.start


def _axis_line(axis: Axis) -> bytes:
    length, force, temperature = axis.exponents
    return f"{axis.code:10d}{length:5d}{force:5d}{temperature:5d} ".encode() + field_of(axis.label, 20) + b" " + field_of(axis.unit, 20)


def _line_format(even: bool, complex_values: bool) -> tuple[int, str]:
    """Numbers a line, and its format: 4E20.12, or one point a line with an abscissa that fills its 13 columns (8 digits)."""
    if even:
        return 4, "%20.12E" * 4 + "\n"
    return (3, "%13.7E%20.12E%20.12E\n") if complex_values else (2, "%13.7E%20.12E\n")


def _write_numbers(stream: IO[bytes], numbers: NDArray[Any], layout: tuple[int, str]) -> None:
    count, line = layout
    whole = numbers.size // count * count
    rows = 4096
    for start in range(0, whole, rows * count):
        part = numbers[start : min(start + rows * count, whole)]
        stream.write(((line * (part.size // count)) % tuple(part.tolist())).encode())
    rest = numbers[whole:].tolist()
    if rest:
        stream.write(("%20.12E" * len(rest) % tuple(rest) + "\n").encode())
