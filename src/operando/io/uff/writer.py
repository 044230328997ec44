"""Writing of UFF files: functions (58, 58b), modes (55), geometry (15, 82, 2412), units (164)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.dof import AXES, Dof
from operando.errors import DataError
from operando.io.atomic import replacing
from operando.io.uff.header58 import Axis
from operando.io.uff.increments import restore_start, restore_step, tidy_rate
from operando.io.uff.models import RESIDUAL, UNIT_MODAL_MASS, UNSCALED
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
class _Function:
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
    passthrough: Iterable[bytes] = (),
) -> None:
    """Write objects into one UFF file, which appears whole or not at all.

    Records become one set 58 (function type 1) a channel; FRFs one a pair (type 4), their coherence beside it (type 6); modes sets 55
    whose ID lines state the scaling; geometries sets 15, 82, 2412. Units are SI, stated in the labels and, if everything is SI, in
    a set 164. Shapes and coordinates have the six digits of the standard; functions keep all, and so do step and start of even axes
    (an uneven axis in ASCII has 8 digits).

    Parameters
    ----------
    path : path
    objects : TimeRecord, Frf, ModalModel or Geometry
    binary : bool
        58b (IEEE 754) or ASCII (13 digits).
    single : bool, optional
        Single precision; default: as the data are (records may be single, FRFs are double). Binary only.
    big_endian : bool
        Byte order of binary data.
    passthrough : iterable of bytes
        Raw sets with their separators, written behind as they are.

    Raises
    ------
    DataError
        If an object has no form in UFF.
    MissingError
        If the file cannot be written.
    """
    for obj in objects:
        if not isinstance(obj, TimeRecord | Frf | ModalModel | Geometry):
            raise DataError(f"{type(obj).__name__} has no form in UFF", hint="TimeRecord, Frf, ModalModel or Geometry")
    with replacing(path) as stream:
        if objects and all(_is_si(obj) for obj in objects):
            _write_units(stream)
        for obj in sorted(objects, key=lambda o: not isinstance(o, Geometry)):
            if isinstance(obj, Geometry):
                _write_geometry(stream, obj)
            elif isinstance(obj, ModalModel):
                _write_modes(stream, obj)
            else:
                for function in _record_functions(obj) if isinstance(obj, TimeRecord) else _frf_functions(obj):
                    _write_function(stream, function, binary, single, big_endian)
        for raw in passthrough:
            stream.write(raw if raw.endswith(b"\n") else raw + b"\n")


def _is_si(obj: Any) -> bool:
    if isinstance(obj, TimeRecord):
        return all(channel.unit for channel in obj.channels)
    if isinstance(obj, Frf):
        return obj.si
    return obj.unit_known if isinstance(obj, Geometry) else True


def _record_functions(record: TimeRecord) -> Iterable[_Function]:
    for row, channel in zip(record.data, record.channels, strict=True):
        ordinate = _axis(channel.quantity, channel.unit)
        yield _Function(
            1, channel.dof, None, channel.name, _TIME, ordinate, Axis(), record.start_s, 1 / record.sampling_hz, None, row,
            (channel.name, "operando time record", "", "", ""),
        )  # fmt: skip


def _frf_functions(frf: Frf) -> Iterable[_Function]:
    start, step, frequencies = _even(frf.frequencies_hz)
    averages = "" if frf.averages is None else f"averages={frf.averages:.17g}"
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
            ids = (f"{frf.quantity} {response}/{reference}", "H = response/force, e^(+i w t)", "", "", averages)
            yield _Function(4, response, reference, "", _FREQUENCY, ordinate, denominator, start, step, frequencies, frf.data[i, j], ids)
            if frf.coherence is not None and not np.all(np.isnan(frf.coherence[i, j])):
                ids = (f"coherence {response}/{reference}", *ids[1:])
                values = frf.coherence[i, j]
                yield _Function(6, response, reference, "", _FREQUENCY, Axis(), Axis(), start, step, frequencies, values, ids)


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


def _write_function(stream: IO[bytes], f: _Function, binary: bool, single: bool | None, big_endian: bool) -> None:
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
        stream.write(b"\n    -1\n")
    else:
        _write_numbers(stream, numbers.reshape(-1), _line_format(f.frequencies is None, complex_values))
        stream.write(b"    -1\n")


def _header(f: _Function, binary: bool, kind: int, n_bytes: int, big_endian: bool) -> bytes:
    first = f"{58:6d}"
    if binary:
        first += f"b{2 if big_endian else 1:6d}{2:6d}{11:12d}{n_bytes:12d}{0:6d}{0:6d}{0:12d}{0:12d}"
    even = f.frequencies is None
    start, step = f"{f.start:13.5E}", f"{f.step:13.5E}"
    ids = list(f.ids)
    if even and not _survives(f, start, step):
        ids[3] = f"step={f.step!r} start={f.start!r}"
    ends = [(_field(f.name, 10), f.response), (_field("", 10), f.reference)]
    record6 = f"{f.kind:5d}{1:10d}{0:5d}{0:10d}".encode()
    for name, dof in ends:
        record6 += b" " + name + (f"{dof.node:10d}{dof.uff_code:4d}" if dof is not None else f"{0:10d}{0:4d}").encode()
    record7 = f"{kind:10d}{f.values.size:10d}{int(even):10d}{start}{step}{0.0:13.5E}".encode()
    lines = [first.encode(), *(_field(text, 80) for text in ids), record6, record7]
    lines += [_axis_line(axis) for axis in (f.abscissa, f.ordinate, f.denominator, Axis())]
    return b"\n".join(line.rstrip() if len(line) == 80 else line for line in lines) + b"\n"


def _survives(f: _Function, start: str, step: str) -> bool:
    """Whether a reader gets the exact axis from the six printed digits."""
    restored = restore_step(step, f.values.size, f.kind != 1)
    same_step = restored == f.step or tidy_rate(restored) == tidy_rate(f.step)
    return same_step and restore_start(start, restored) == f.start


def _field(text: str, width: int) -> bytes:
    """Text in a field of so many bytes, NONE where there is none; a character is not cut in two."""
    clean = " ".join(text.split()) or "NONE"
    raw = clean.encode("utf-8")[:width].decode("utf-8", errors="ignore").encode("utf-8")
    return raw.ljust(width)


def _axis_line(axis: Axis) -> bytes:
    length, force, temperature = axis.exponents
    return f"{axis.code:10d}{length:5d}{force:5d}{temperature:5d} ".encode() + _field(axis.label, 20) + b" " + _field(axis.unit, 20)


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


def _set(stream: IO[bytes], number: int, lines: Iterable[str]) -> None:
    stream.write(f"    -1\n{number:6d}\n".encode())
    for line in lines:
        stream.write(line.encode("utf-8") + b"\n")
    stream.write(b"    -1\n")


def _write_units(stream: IO[bytes]) -> None:
    factors = f"{1.0:25.17E}{1.0:25.17E}{1.0:25.17E}\n{273.15:25.17E}"
    _set(stream, 164, [f"{1:10d}{'SI: Meter (newton)':<20}{2:10d}", factors])


def _write_geometry(stream: IO[bytes], geometry: Geometry) -> None:
    rows = zip(geometry.nodes, geometry.coordinates, strict=True)
    _set(stream, 15, [f"{n:10d}{0:10d}{0:10d}{1:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for n, (x, y, z) in rows])
    if geometry.lines:
        nodes = [n for line in geometry.lines for n in (*line, 0)]
        rows_of_8 = ["".join(f"{n:10d}" for n in nodes[i : i + 8]) for i in range(0, len(nodes), 8)]
        _set(stream, 82, [f"{1:10d}{len(nodes):10d}{1:10d}", "lines", *rows_of_8])
    if geometry.faces:
        lines = []
        for i, face in enumerate(geometry.faces):
            if len(face) not in (3, 4):
                raise DataError(f"a face of {len(face)} nodes has no form in UFF 2412", hint="use triangles and quadrilaterals")
            lines.append(f"{i + 1:10d}{91 if len(face) == 3 else 94:10d}{1:10d}{1:10d}{1:10d}{len(face):10d}")
            lines.append("".join(f"{n:10d}" for n in face))
        _set(stream, 2412, lines)


def _write_modes(stream: IO[bytes], model: ModalModel) -> None:
    nodes, columns, per_node = _node_table(model.dofs)
    terms = model.terms
    for r in range(terms.n):
        shape = np.zeros((len(nodes), per_node), terms.shapes.dtype)
        for (i, j, sign), value in zip(columns, terms.shapes[:, r], strict=True):
            shape[i, j] = sign * value
        _set(stream, 55, _mode_lines(model, r, nodes, shape))


def _node_table(dofs: Sequence[Dof]) -> tuple[list[int], list[tuple[int, int, int]], int]:
    """Nodes, (row, column, sign) of each DOF in the table of nodes, and values a node."""
    if all(d.axis == "" for d in dofs):
        nodes = [d.node for d in dofs]
        if len(set(nodes)) != len(nodes):
            raise DataError("a scalar DOF appears twice in the modal model")
        return nodes, [(i, 0, 1) for i in range(len(nodes))], 1
    if any(d.axis == "" for d in dofs):
        raise DataError("a modal model with and without directions has no form in UFF 55")
    nodes = list(dict.fromkeys(d.node for d in dofs))
    rows = {n: i for i, n in enumerate(nodes)}
    per_node = 6 if any(d.axis.startswith("R") for d in dofs) else 3
    return nodes, [(rows[d.node], AXES.index(d.axis) - 1, d.sign) for d in dofs], per_node


def _mode_lines(model: ModalModel, r: int, nodes: list[int], shape: NDArray[Any]) -> list[str]:
    is_complex, terms = np.iscomplexobj(shape), model.terms
    frequency, damping = float(terms.frequencies_hz[r]), float(terms.damping_ratios[r])
    per_node = shape.shape[1]
    scaled = model.scaling == "unit_modal_mass"
    ids = [
        f"operando mode {r + 1}",
        UNIT_MODAL_MASS if scaled and model.si else (UNSCALED if not scaled else "scaling: unit modal mass, units of the input"),
        "NONE",
        f"frequency_hz={frequency:.17g} damping_ratio={damping:.17g}",
        RESIDUAL if terms.residual[r] else "NONE",
    ]
    characteristic = {1: 1, 3: 2, 6: 3}[per_node]
    lines = [*ids, "".join(f"{n:10d}" for n in (1, 3 if is_complex else 2, characteristic, 8, 5 if is_complex else 2, per_node))]
    if is_complex:
        pole = terms.poles[r]
        lines.append(f"{2:10d}{6:10d}{1:10d}{r + 1:10d}")
        numbers = [pole.real, pole.imag, 0.0, 0.0, 0.0, 0.0]
    else:
        lines.append(f"{2:10d}{4:10d}{1:10d}{r + 1:10d}")
        numbers = [frequency, 1.0 if scaled else 0.0, damping, 0.0]
    lines.append("".join(f"{v:13.5E}" for v in numbers))
    for node, row in zip(nodes, shape, strict=True):
        values = np.column_stack([row.real, row.imag]).ravel() if is_complex else row
        lines.append(f"{node:10d}")
        lines += ["".join(f"{v:13.5E}" for v in values[i : i + 6]) for i in range(0, len(values), 6)]
    return lines
