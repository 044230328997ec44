"""Writing the text sets of UFF: header (151), units (164), geometry (15 or 2411, 2420, 82, 2412), modes (55)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Geometry, ModalModel
from operando.dof import AXES, Dof, Node
from operando.errors import DataError
from operando.io.content import FileHeader
from operando.io.uff.components import NodeNumbers
from operando.io.uff.lines import in_uff, print_date
from operando.io.uff.models import RESIDUAL, UNIT_MODAL_MASS, UNSCALED, Check

MAX_TRACE_NODES = 250
"""A set 82 holds no more nodes by the standard; a longer trace line goes on in a further set."""

_SUM = "H = sum -w2 p pT/(wr2-w2+2i zr wr w)"
"""How FRFs come from the sets 55 of a model of unit modal mass, for whoever reads the file."""


def field_of(text: str, width: int) -> bytes:
    """Text in a field of so many bytes, NONE where there is none; a character is not cut in two."""
    clean = " ".join(text.split()) or "NONE"
    raw = clean.encode("utf-8")[:width].decode("utf-8", errors="ignore").encode("utf-8")
    return raw.ljust(width)


def number13(value: float) -> str:
    """A number in 13 columns, the first one blank, with as many digits as there is room for; E13.5 where that is exact."""
    usual = f"{value:13.5E}"
    if float(usual) == value or not np.isfinite(value):
        return usual
    forms = [f"{value:.{digits}{kind}}" for digits in range(11, 5, -1) for kind in "gE"]
    fitting = [form for form in forms if len(form) <= 12 and "." in form]
    return f"{min([usual, *fitting], key=lambda form: abs(float(form) - value)):>13}"


def write_set(stream: IO[bytes], number: int, lines: Iterable[str | bytes]) -> None:
    """One set of text lines between its separators."""
    stream.write(f"    -1\n{number:6d}\n".encode())
    for line in lines:
        stream.write((line if isinstance(line, bytes) else line.encode("utf-8")).rstrip() + b"\n")
    stream.write(b"    -1\n")


def write_header(stream: IO[bytes], header: FileHeader, numbers: NodeNumbers) -> None:
    """Set 151; where nodes have components, the description says which numbers stand for which."""
    if numbers.components and len(numbers.text.encode()) > 80:
        raise DataError(
            f"{len(numbers.components)} components do not fit the header of a UFF file",
            hint="write them to files of their own, or to HDF5",
        )
    created, saved, written = (in_uff(text) for text in (header.created, header.saved, header.written))
    texts = (header.name, numbers.text or header.description, header.program, created, saved, header.writer, written)
    write_set(stream, 151, [field_of(text, 80) for text in texts])


def write_units(stream: IO[bytes]) -> None:
    """Set 164: SI."""
    factors = f"{1.0:25.17E}{1.0:25.17E}{1.0:25.17E}\n{273.15:25.17E}"
    write_set(stream, 164, [f"{1:10d}{'SI: Meter (newton)':<20}{2:10d}", factors])


def write_geometry(stream: IO[bytes], geometry: Geometry, numbers: NodeNumbers, node_set: int) -> None:
    """Coordinate systems, nodes (set 15, six digits; or 2411, double precision), trace lines and faces with names and colours."""
    if geometry.systems:
        _write_systems(stream, geometry)
    _write_nodes(stream, geometry, numbers, node_set)
    _write_traces(stream, geometry, numbers)
    if geometry.faces:
        lines = []
        colors = geometry.appearance.face_colors or (1,) * len(geometry.faces)
        for i, (face, color) in enumerate(zip(geometry.faces, colors, strict=True)):
            if len(face) not in (3, 4):
                raise DataError(f"a face of {len(face)} nodes has no form in UFF 2412", hint="use triangles and quadrilaterals")
            lines.append(f"{i + 1:10d}{91 if len(face) == 3 else 94:10d}{1:10d}{1:10d}{color:10d}{len(face):10d}")
            lines.append("".join(f"{numbers.number(n):10d}" for n in face))
        write_set(stream, 2412, lines)


# Double precision is written with E and not D: every reader of Fortran numbers takes both, many others E only.


def _write_systems(stream: IO[bytes], geometry: Geometry) -> None:
    lines: list[str | bytes] = [f"{1:10d}", field_of(geometry.name, 40)]
    for system in geometry.systems:
        lines.append(f"{system.number:10d}{system.kind:10d}{system.color:10d}")
        lines.append(field_of(system.name, 40))
        lines += ["".join(f"{v:25.16E}" for v in row) for row in (*system.axes, system.origin)]
    write_set(stream, 2420, lines)


def _write_nodes(stream: IO[bytes], geometry: Geometry, numbers: NodeNumbers, node_set: int) -> None:
    lines = []
    for node, position in zip(geometry.nodes, geometry.coordinates, strict=True):
        head = (numbers.number(node), 0, geometry.node_systems.get(node, 0), geometry.appearance.node_colors.get(node, 1))
        words = "".join(f"{n:10d}" for n in head)
        if node_set == 15:
            lines.append(words + "".join(f"{v:13.5E}" for v in position))
        else:
            lines += [words, "".join(f"{v:25.16E}" for v in position)]
    write_set(stream, node_set, lines)


def _write_traces(stream: IO[bytes], geometry: Geometry, numbers: NodeNumbers) -> None:
    for i, (name, color, nodes) in enumerate(trace_sets(geometry, numbers)):
        rows = ["".join(f"{n:10d}" for n in nodes[k : k + 8]) for k in range(0, len(nodes), 8)]
        write_set(stream, 82, [f"{i + 1:10d}{len(nodes):10d}{color:10d}", field_of(name, 80), *rows])


def trace_sets(geometry: Geometry, numbers: NodeNumbers) -> list[tuple[str, int, list[int]]]:
    """Name, colour and nodes of each set 82: lines of one name and colour share a set, as far as its nodes go; 0 ends a line."""
    shown = geometry.appearance
    names = shown.line_names or ("",) * len(geometry.lines)
    colors = shown.line_colors or (1,) * len(geometry.lines)
    sets: list[tuple[str, int, list[int]]] = []
    for line, name, color in zip(geometry.lines, names, colors, strict=True):
        nodes = [numbers.number(n) for n in line]
        while nodes:
            part, nodes = nodes[: MAX_TRACE_NODES - 1], nodes[MAX_TRACE_NODES - 2 :] if len(nodes) >= MAX_TRACE_NODES else []
            if not sets or sets[-1][:2] != (name, color) or len(sets[-1][2]) + len(part) + 1 > MAX_TRACE_NODES:
                sets.append((name, color, []))
            sets[-1][2].extend([*part, 0])
    return sets


def write_modes(stream: IO[bytes], model: ModalModel, numbers: NodeNumbers) -> None:
    """One set 55 a mode, then one a residual term; together they make the FRFs of the model, as the check in the ID lines proves."""
    model.sums_of_squares("UFF 55")
    nodes, columns, per_node = node_table(model.dofs)
    terms = model.terms
    check = Check.of(model)
    for r in range(terms.n):
        shape = np.zeros((len(nodes), per_node), terms.shapes.dtype)
        for (i, j, sign), value in zip(columns, terms.shapes[:, r], strict=True):
            shape[i, j] = sign * value
        write_set(stream, 55, _mode_lines(model, r, [numbers.number(n) for n in nodes], shape, "" if check is None else check.text))


def node_table(dofs: Sequence[Dof]) -> tuple[list[Node], list[tuple[int, int, int]], int]:
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


def mode_ids(model: ModalModel, r: int, check: str = "") -> tuple[str, ...]:
    """The five ID lines of the set 55 of a mode or residual term."""
    terms = model.terms
    scaled = f"{UNIT_MODAL_MASS}; {_SUM}" if model.si else "scaling: unit modal mass, units of the input"
    return (
        f"operando residual term {r + 1 - model.n_modes} of {model.n_residuals}" if terms.residual[r] else
        f"operando mode {r + 1} of {model.n_modes}",
        scaled if model.scaling == "unit_modal_mass" else UNSCALED,
        print_date(model.provenance.measured),
        f"frequency_hz={float(terms.frequencies_hz[r]):.17g} damping_ratio={float(terms.damping_ratios[r]):.17g}",
        "; ".join(filter(None, (RESIDUAL if terms.residual[r] else "", check))),
    )  # fmt: skip


def _mode_lines(model: ModalModel, r: int, nodes: list[int], shape: NDArray[Any], check: str) -> list[str | bytes]:
    is_complex, terms = np.iscomplexobj(shape), model.terms
    frequency, damping = float(terms.frequencies_hz[r]), float(terms.damping_ratios[r])
    per_node = shape.shape[1]
    scaled = model.scaling == "unit_modal_mass"
    characteristic = {1: 1, 3: 2, 6: 3}[per_node]
    lines: list[str | bytes] = [field_of(text, 80) for text in mode_ids(model, r, check)]
    lines.append("".join(f"{n:10d}" for n in (1, 3 if is_complex else 2, characteristic, 8, 5 if is_complex else 2, per_node)))
    if is_complex:
        pole = terms.poles[r]
        lines.append(f"{2:10d}{6:10d}{1:10d}{r + 1:10d}")
        numbers = [pole.real, pole.imag, 0.0, 0.0, 0.0, 0.0]
    else:
        lines.append(f"{2:10d}{4:10d}{1:10d}{r + 1:10d}")
        numbers = [frequency, 1.0 if scaled else 0.0, damping, 0.0]
    lines.append("".join(number13(v) for v in numbers))
    for node, row in zip(nodes, shape, strict=True):
        values = np.column_stack([row.real, row.imag]).ravel() if is_complex else row
        lines.append(f"{node:10d}")
        lines += ["".join(f"{v:13.5E}" for v in values[i : i + 6]) for i in range(0, len(values), 6)]
    return lines
