"""Tables of nodes and their coordinates: a geometry as spreadsheets and campaigns bring it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from operando.data import Finding, Geometry
from operando.dof import Node, node_label, split_node
from operando.errors import DofError, FormatError
from operando.io.columns import is_node_column
from operando.io.content import Content, SetInfo
from operando.io.quantities import Units
from operando.units import si_factor

AXES = ("x", "y", "z")


def read_node_table(
    names: Sequence[str], texts: Sequence[str], rows: Sequence[tuple[int, Sequence[str]]], decimal: str, path: Path, units: Units | None
) -> Content:
    """Geometry of a table with a column of nodes and the columns x, y and z; each row is its line of the file and its cells."""
    from operando.io.uff.reader import provenance_of

    where = str(path)
    lower = [name.lower() for name in names]
    node = next(i for i, name in enumerate(lower) if is_node_column(name))
    columns = [lower.index(axis) for axis in AXES]
    unit = next((texts[i] for i in columns if texts[i]), "") or str((units or {}).get("length", ""))  # x [mm], y, z means one unit
    stated = [texts[i] or unit for i in columns]
    known = bool(unit)
    factors = np.array([si_factor(text, "displacement") for text in stated]) if known else np.ones(3)
    found: dict[Node, list[float]] = {}
    for line, cells in rows:
        if len(cells) <= max(node, *columns):
            raise FormatError(f"line {line}: {len(cells)} cells, but {len(names)} columns", where=where)
        label = _node(cells[node], line, where)
        if label in found:
            raise FormatError(f"line {line}: node {label} stands there a second time", where=where, hint="each node has one row")
        found[label] = [_coordinate(cells[i], decimal, f"line {line}: {axis}", where) for i, axis in zip(columns, AXES, strict=True)]
    provenance = provenance_of(path)
    geometry = Geometry(tuple(found), np.array(list(found.values())) * factors, name=path.stem, unit_known=known, provenance=provenance)
    used = {node, *columns}
    sets = tuple(
        SetInfo(i, 0, f"column {name or i}", "used" if i in used else "ignored", "" if i in used else "neither node nor coordinate")
        for i, name in enumerate(names)
    )
    return Content(where, "csv", geometry=geometry, sets=sets, findings=() if known else (_without_unit(where),))


def _without_unit(where: str) -> Finding:
    return Finding(
        "missing_unit", "the table does not say in which unit its coordinates are", "info", where,
        consequence="the geometry is drawn as it is; distances are not known in metres",
        action='write it in the header, as in x [mm], or give it in the test file: [geometry] units = "m"',
    )  # fmt: skip


def _node(text: str, line: int, where: str) -> Node:
    """A node as a number, also where a table has it as 12.0, or a component and a number."""
    clean = text.strip().strip("\"'")
    try:
        number = float(clean)
        if number == int(number):
            return int(number)
    except (ValueError, OverflowError):
        pass
    try:
        return node_label(*split_node(clean))
    except DofError:
        hint = "a whole number, as in the DOFs measured, or a component and a number, as in FRAM:12"
        raise FormatError(f"line {line}: {clean[:40]!r} is no node", where=where, hint=hint) from None


def _coordinate(text: str, decimal: str, what: str, where: str) -> float:
    try:
        value = float(text.strip().strip("\"'").replace(decimal, "."))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise FormatError(f"{what} is {text.strip()[:40]!r}, expected a coordinate", where=where)
    return value
