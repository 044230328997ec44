"""Geometry from the sets 15, 2411 (nodes), 18, 2420 (coordinate systems), 82 (trace lines) and 2412 (elements) of a file."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from operando.data import Appearance, CoordinateSystem, Geometry
from operando.io.quantities import Scale, note_unused, resolve
from operando.io.uff.inventory import Inventory
from operando.io.uff.nodes import ElementSet, NodeSet, read_elements, read_nodes, read_traces
from operando.io.uff.split import RawSet
from operando.io.uff.systems import read_part_systems, read_systems, to_global

_Drawn = tuple[tuple[int, ...], str, int]
"""Nodes of a line or face, its name and colour."""


@dataclass
class _Found:
    """What the sets of a file have given so far; lengths in metres."""

    positions: dict[int, np.ndarray] = field(default_factory=dict)
    colors: dict[int, int] = field(default_factory=dict)
    node_systems: dict[int, int] = field(default_factory=dict)
    systems: dict[int, CoordinateSystem] = field(default_factory=dict)
    relative: set[int] = field(default_factory=set)
    lines: list[_Drawn] = field(default_factory=list)
    faces: list[_Drawn] = field(default_factory=list)
    unit_known: bool = True


def assemble_geometry(sets: list[RawSet], inventory: Inventory) -> Geometry | None:
    """Geometry of the nodes, traces and elements of a file; None without nodes."""
    found = _Found()
    for raw in sets:
        if raw.number in (18, 2420):
            _add_systems(raw, found, inventory)
    for raw in sets:
        if raw.number in (15, 2411):
            nodes = inventory.attempt(raw, partial(read_nodes, raw.number))
            if nodes is not None:
                _add_nodes(raw, nodes, found, inventory)
        elif raw.number == 82:
            traces = inventory.attempt(raw, read_traces)
            if traces is not None:
                name, color, lines = traces
                found.lines += [(nodes, name, color) for nodes in lines]
                inventory.use(raw, f"{len(lines)} trace lines", name)
        elif raw.number == 2412:
            elements = inventory.attempt(raw, read_elements)
            if elements is not None:
                _add_elements(raw, elements, found, inventory)
    return _geometry(found, inventory) if found.positions else None


def _geometry(found: _Found, inventory: Inventory) -> Geometry:
    lines = [drawn for drawn in found.lines if all(n in found.positions for n in drawn[0])]
    faces = [drawn for drawn in found.faces if all(n in found.positions for n in drawn[0])]
    lost = len(found.lines) + len(found.faces) - len(lines) - len(faces)
    if lost:
        inventory.note("missing_node", f"{lost} lines or faces name nodes that the file does not hold: left out", severity="info")
    node = inventory.node_numbers.node
    shown = Appearance(
        {node(n): color for n, color in found.colors.items()}, tuple(name for _, name, _ in lines), tuple(color for _, _, color in lines),
        tuple(color for _, _, color in faces),
    )  # fmt: skip
    return Geometry(
        tuple(node(n) for n in found.positions), np.array(list(found.positions.values())),
        tuple(tuple(node(n) for n in nodes) for nodes, _, _ in lines), tuple(tuple(node(n) for n in nodes) for nodes, _, _ in faces),
        inventory.file, found.unit_known, inventory.provenance,
        systems=tuple(found.systems.values()), node_systems={node(n): system for n, system in found.node_systems.items()}, appearance=shown,
    )  # fmt: skip


def _length(raw: RawSet, inventory: Inventory) -> Scale:
    units = inventory.units
    given = units.get("length") or units.get("coordinates") or units.get("geometry")
    scale = resolve("displacement", "", {"displacement": given} if given else None, None, inventory.system_at(raw.index), (1, 0, 0))
    if scale.origin != "[units]":
        note_unused(units, "length", scale.source_unit or "its own units", scale.factor, "the geometry")
    return scale


def _add_systems(raw: RawSet, found: _Found, inventory: Inventory) -> None:
    systems = inventory.attempt(raw, read_systems if raw.number == 18 else read_part_systems)
    if systems is None:
        return
    factor = _length(raw, inventory).factor
    for system, reference in systems:
        found.systems[system.number] = replace(system, origin=system.origin * factor)
        if reference:
            found.relative.add(system.number)
    inventory.use(raw, f"{len(systems)} coordinate systems", ", ".join(s.name for s, _ in systems if s.name)[:80])


def _add_elements(raw: RawSet, elements: ElementSet, found: _Found, inventory: Inventory) -> None:
    found.lines += [(nodes, "", color) for nodes, color in zip(elements.lines, elements.line_colors, strict=True)]
    found.faces += [(nodes, "", color) for nodes, color in zip(elements.faces, elements.face_colors, strict=True)]
    if elements.others:
        kinds = ", ".join(f"{count} of descriptor {kind}" for kind, count in sorted(elements.others.items()))
        inventory.note(
            "elements_left_out", f"{sum(elements.others.values())} elements of set {raw.index} are neither lines nor shells ({kinds})", raw,
            severity="info", consequence="they are not drawn, and a conversion leaves them out",
        )  # fmt: skip
    inventory.use(raw, f"{len(elements.lines)} line elements, {len(elements.faces)} faces")


def _add_nodes(raw: RawSet, nodes: NodeSet, found: _Found, inventory: Inventory) -> None:
    """Add nodes in metres; the unit of length may be unknown."""
    scale = _length(raw, inventory)
    if not scale.known:
        inventory.note(
            "missing_unit", f"set {raw.index} does not say in which unit its coordinates are", raw, severity="info",
            consequence="the geometry is drawn as it is; distances are not known in metres",
            action='give it in the test file: [geometry] units = "m"',
        )  # fmt: skip
    clashes = 0
    positions = _in_global(raw, nodes, scale.factor, found, inventory)
    for number, position, color, system in zip(nodes.numbers, positions, nodes.colors, nodes.displacement, strict=True):
        if number in found.positions:
            clashes += not np.allclose(found.positions[number], position, rtol=1e-6)
            continue
        found.positions[number] = position
        found.colors[number] = color
        if system in found.systems and not found.systems[system].has_global_axes:
            found.node_systems[number] = system
    if clashes:
        inventory.note("duplicate_node", f"{clashes} nodes of set {raw.index} stand elsewhere earlier in the file: that is used", raw)
    inventory.use(raw, f"{len(nodes.numbers)} nodes", f"{scale.source_unit} → m" if scale.known else "unit of length unknown")
    found.unit_known &= scale.known


def _in_global(raw: RawSet, nodes: NodeSet, factor: float, found: _Found, inventory: Inventory) -> np.ndarray:
    """Coordinates [m] of a set in the global system, and findings about what is local.

    Set 2411 gives coordinates in the global system of the part whatever its system numbers say.
    """
    systems = found.systems
    turned = {n for n in nodes.displacement if n in systems and not systems[n].has_global_axes}
    if turned:
        count = sum(n in turned for n in nodes.displacement)
        inventory.note(
            "local_directions", f"{count} nodes of set {raw.index} have directions of their own (coordinate systems of the file)", raw,
            severity="info", consequence="X, Y, Z of their DOFs are local: shapes are drawn along the global axes",
        )  # fmt: skip
    if raw.number != 15 or not any(nodes.definition):
        return nodes.coordinates * factor
    usable = {number: system for number, system in systems.items() if number not in found.relative}
    # Angles of cylindrical systems stay degrees: only lengths are scaled, so the systems go to the units of the set.
    in_file = {number: replace(system, origin=system.origin / factor) for number, system in usable.items()}
    coordinates, left = to_global(nodes.coordinates, nodes.definition, in_file)
    if left and systems:
        inventory.note(
            "local_coordinates", f"nodes of set {raw.index} are given in coordinate systems {left[:8]} that cannot be applied", raw,
            consequence="they are taken as global and drawn at the wrong location", action="export the geometry in global coordinates",
        )  # fmt: skip
    return coordinates * factor
