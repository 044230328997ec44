"""Modal models from sets 55, geometry from sets 15, 2411, 82, 2412."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from operando.data import Geometry, ModalModel
from operando.dof import AXES, Dof
from operando.errors import DataError, FormatError
from operando.io.quantities import resolve
from operando.io.uff.inventory import Inventory, title_of
from operando.io.uff.small import ModeSet, NodeSet, read_elements, read_mode, read_nodes, read_traces
from operando.io.uff.split import RawSet
from operando.io.uff.systems import System, read_systems, to_global

UNIT_MODAL_MASS = "scaling: unit modal mass, kg^-0.5"
UNSCALED = "scaling: unscaled"
RESIDUAL = "residual mode"


def assemble_models(sets: list[RawSet], inventory: Inventory) -> tuple[ModalModel, ...]:
    """One model for each kind of mode (real, complex) and set of nodes among the sets 55."""
    groups: dict[tuple[Any, ...], list[tuple[RawSet, ModeSet]]] = {}
    for raw in sets:
        mode = _attempt(raw, inventory, lambda raw=raw: read_mode(raw.raw(inventory.buffer)))  # type: ignore[misc]
        if mode is not None:
            key = (np.iscomplexobj(mode.values), mode.nodes, mode.values.shape[1], _scaling(mode))
            groups.setdefault(key, []).append((raw, mode))
    models = []
    for group in groups.values():
        try:
            models.append(_model(group, inventory))
        except DataError as error:
            for raw, _ in group:
                inventory.refuse(raw, title_of(raw), error.message)
            continue
        for raw, mode in group:
            text = f"{'real' if mode.kind == 2 else 'complex'} mode {mode.mode}: {mode.frequency_hz:.6g} Hz"
            inventory.use(raw, text, _scaling(mode).replace("_", " "))
    return tuple(models)


def _attempt(raw: RawSet, inventory: Inventory, action: Callable[[], Any]) -> Any:
    """The result of a reader, or None: then the set is kept as not understood."""
    try:
        return action()
    except FormatError as error:
        inventory.status[raw.index] = ("not understood", title_of(raw), error.message)
        inventory.note(
            "unknown_set", f"set {raw.index} of type {raw.number} ({title_of(raw)}) is not understood: {error.message}", raw,
            consequence="it is not used; a conversion to UFF passes it on as it is",
        )  # fmt: skip
        return None


def _scaling(mode: ModeSet) -> str:
    stated = any(UNIT_MODAL_MASS in line for line in mode.ids)
    return "unit_modal_mass" if stated and not np.iscomplexobj(mode.values) else "unscaled"


def _model(group: list[tuple[RawSet, ModeSet]], inventory: Inventory) -> ModalModel:
    modes = [mode for _, mode in sorted(group, key=lambda pair: pair[1].frequency_hz)]
    first = modes[0]
    per_node = first.values.shape[1]
    axes = {1: [""], 3: list(AXES[1:4]), 6: list(AXES[1:])}.get(per_node)
    if axes is None:
        raise DataError(f"{per_node} values a node are neither 1, 3 nor 6")
    if len(set(first.nodes)) != len(first.nodes) or min(first.nodes) < 0:
        raise DataError("a node number appears twice, or is negative")
    dofs = [Dof(node, axis) for node in first.nodes for axis in axes]
    shapes = np.column_stack([mode.values.ravel() for mode in modes])
    # Set 55 has a value for every direction of a node: those that are zero in all modes were not measured.
    measured = np.any(shapes != 0, axis=1)
    if not np.any(measured):
        measured[:] = True
    residual = np.array([any(line == RESIDUAL for line in mode.ids) for mode in modes])
    return ModalModel.from_terms(
        np.array([m.frequency_hz for m in modes]), np.array([m.damping_ratio for m in modes]), shapes[measured],
        tuple(d for d, keep in zip(dofs, measured, strict=True) if keep), _scaling(first), residual=residual,
        si=_scaling(first) == "unit_modal_mass", provenance=inventory.provenance,
    )  # fmt: skip


def assemble_geometry(sets: list[RawSet], inventory: Inventory) -> Geometry | None:
    """Geometry of the nodes, traces and elements of a file; None without nodes."""
    positions: dict[int, np.ndarray] = {}
    lines: list[tuple[int, ...]] = []
    faces: list[tuple[int, ...]] = []
    unit_known = True
    systems = _read_systems(sets, inventory)
    for raw in sets:
        if raw.number in (15, 2411):
            nodes = _attempt(raw, inventory, lambda raw=raw: read_nodes(raw.number, raw.raw(inventory.buffer)))  # type: ignore[misc]
            if nodes is not None:
                unit_known &= _add_nodes(raw, nodes, systems, positions, inventory)
        elif raw.number == 82:
            traces = _attempt(raw, inventory, lambda raw=raw: read_traces(raw.raw(inventory.buffer)))  # type: ignore[misc]
            if traces is not None:
                lines += traces
                inventory.use(raw, f"{len(traces)} trace lines")
        elif raw.number == 2412:
            elements = _attempt(raw, inventory, lambda raw=raw: read_elements(raw.raw(inventory.buffer)))  # type: ignore[misc]
            if elements is not None:
                lines += elements[0]
                faces += elements[1]
                inventory.use(raw, f"{len(elements[0])} line elements, {len(elements[1])} faces")
    if not positions:
        return None
    known = [line for line in lines if all(n in positions for n in line)]
    known_faces = [face for face in faces if all(n in positions for n in face)]
    lost = len(lines) + len(faces) - len(known) - len(known_faces)
    if lost:
        inventory.note("missing_node", f"{lost} lines or faces name nodes that the file does not hold: left out", severity="info")
    return Geometry(
        tuple(positions), np.array(list(positions.values())), tuple(known), tuple(known_faces), inventory.file, unit_known,
        inventory.provenance,
    )  # fmt: skip


def _add_nodes(raw: RawSet, nodes: NodeSet, systems: dict[int, System], positions: dict[int, np.ndarray], inventory: Inventory) -> bool:
    """Add nodes in metres; false where the unit of length is not known."""
    system = inventory.system_at(raw.index)
    units = inventory.units
    given = units.get("length") or units.get("coordinates") or units.get("geometry")
    scale = resolve("displacement", "", {"displacement": given} if given else None, None, system, (1, 0, 0))
    if not scale.known:
        inventory.note(
            "missing_unit", f"set {raw.index} does not say in which unit its coordinates are", raw, severity="info",
            consequence="the geometry is drawn as it is; distances are not known in metres",
            action='give it in the test file: [geometry] units = "m"',
        )  # fmt: skip
    clashes = 0
    for number, position in zip(nodes.numbers, _in_global(raw, nodes, systems, inventory) * scale.factor, strict=True):
        if number in positions and not np.allclose(positions[number], position, rtol=1e-6):
            clashes += 1
        positions.setdefault(number, position)
    if clashes:
        inventory.note("duplicate_node", f"{clashes} nodes of set {raw.index} stand elsewhere earlier in the file: that is used", raw)
    inventory.use(raw, f"{len(nodes.numbers)} nodes", f"{scale.source_unit} → m" if scale.known else "unit of length unknown")
    return scale.known


def _read_systems(sets: list[RawSet], inventory: Inventory) -> dict[int, System]:
    systems: dict[int, System] = {}
    for raw in sets:
        if raw.number == 18:
            found = _attempt(raw, inventory, lambda raw=raw: read_systems(raw.raw(inventory.buffer)))  # type: ignore[misc]
            if found is not None:
                systems |= found
                inventory.use(raw, f"{len(found)} coordinate systems")
    return systems


def _in_global(raw: RawSet, nodes: NodeSet, systems: dict[int, System], inventory: Inventory) -> np.ndarray:
    """Coordinates of a set in the global system, and findings about what is local.

    Set 2411 gives coordinates in the global system of the part whatever its system numbers say.
    """
    turned = sorted({n for n in nodes.displacement if n in systems and not systems[n].has_global_axes})
    if turned:
        count = sum(n in turned for n in nodes.displacement)
        inventory.note(
            "local_directions", f"{count} nodes of set {raw.index} have directions of their own (coordinate systems of set 18)", raw,
            severity="info", consequence="X, Y, Z of their DOFs are local: shapes are drawn along the global axes",
        )  # fmt: skip
    if raw.number != 15 or not any(nodes.definition):
        return nodes.coordinates
    coordinates, left = to_global(nodes.coordinates, nodes.definition, systems)
    if left and systems:
        inventory.note(
            "local_coordinates", f"nodes of set {raw.index} are given in coordinate systems {left[:8]} that cannot be applied", raw,
            consequence="they are taken as global and drawn in the wrong place", action="export the geometry in global coordinates",
        )  # fmt: skip
    return coordinates
