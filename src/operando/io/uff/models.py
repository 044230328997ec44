"""Modal models from the sets 55 and 2414 of a file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from operando.data import ModalModel
from operando.dof import AXES, Dof
from operando.errors import DataError, DofError
from operando.io.uff.inventory import Inventory, title_of
from operando.io.uff.lines import parse_date
from operando.io.uff.shapes import NORMAL_MODE, ModeSet, read_analysis, read_mode
from operando.io.uff.split import RawSet

UNIT_MODAL_MASS = "scaling: unit modal mass, kg^-0.5"
UNSCALED = "scaling: unscaled"
RESIDUAL = "residual mode"
ODD_AMONG = 3
"""Among so many modes a direction with values in one alone is noted: of two modes, one may well be zero along a direction."""
CHECK_DB = 0.05
"""Largest error of the stated FRF value: six digits of shapes leave below 0.001 dB, and a term that matters changes it by more."""


@dataclass(frozen=True)
class Check:
    """One value of the FRFs (accelerance [(m/s²)/N] at a driving point) that all sets 55 of a model make together: it proves the sum."""

    dof: Dof
    frequency_hz: float
    value: complex

    @classmethod
    def of(cls, model: ModalModel) -> Check | None:
        """Largest driving point at the mode where it is largest: no other term hides there. None for a model that makes no FRFs."""
        if model.scaling != "unit_modal_mass" or not model.si or not model.n_modes or np.any(model.damping_ratios <= 0):
            return None
        i, r = np.unravel_index(int(np.argmax(model.shapes**2 / model.damping_ratios)), model.shapes.shape)
        frequency = float(f"{model.frequencies_hz[r]:.10g}")
        return cls(model.dofs[i], frequency, cls._sum(model, model.dofs[i], frequency))

    @classmethod
    def read(cls, ids: Iterable[str]) -> Check | None:
        """The check that an ID line states."""
        for line in ids:
            match = re.search(r"check H (\S+)/\S+ at (\S+) Hz = (\S+) (\S+)i", line)
            if match is not None:
                try:
                    return cls(Dof.parse(match[1]), float(match[2]), complex(float(match[3]), float(match[4])))
                except ValueError:
                    return None
        return None

    @property
    def text(self) -> str:
        """As it stands in an ID line."""
        return f"check H {self.dof}/{self.dof} at {self.frequency_hz:.10g} Hz = {self.value.real:.7g} {self.value.imag:.7g}i"

    def error_db(self, model: ModalModel) -> float:
        """How far the FRFs of a model are from it [dB]; infinite where the model lacks the DOF."""
        try:
            made = self._sum(model, self.dof, self.frequency_hz)
        except (DofError, DataError):  # no such DOF, or no such frequency
            return float("inf")
        error = abs(20 * float(np.log10(1 + abs(made - self.value) / abs(self.value)))) if self.value else 0.0
        return error if np.isfinite(error) else float("inf")

    @staticmethod
    def _sum(model: ModalModel, dof: Dof, frequency: float) -> complex:
        with np.errstate(all="ignore"):  # modes of a damaged file
            return complex(model.frf([frequency], [dof], [dof], variance=False).data[0, 0, 0])


def assemble_models(sets: list[RawSet], inventory: Inventory) -> tuple[ModalModel, ...]:
    """One model for each kind of mode (real, complex) and set of nodes among the sets 55, and among the sets 2414."""
    groups: dict[tuple[Any, ...], list[tuple[RawSet, ModeSet]]] = {}
    readers = {55: read_mode, 2414: read_analysis}
    for raw in sets:
        mode = inventory.attempt(raw, readers[raw.number])
        if mode is not None:
            key = (raw.number, np.iscomplexobj(mode.values), mode.nodes, mode.values.shape[1], _scaling(mode))
            groups.setdefault(key, []).append((raw, mode))
    _note_unequal(list(groups), inventory)
    models = []
    for group in groups.values():
        try:
            models.append(_model(group, inventory))
        except DataError as error:
            for raw, _ in group:
                inventory.refuse(raw, title_of(raw), error.message)
            continue
        for raw, mode in group:
            if mode.extra.get("modal_mass") and _scaling(mode) == "unscaled":
                inventory.unkept.append("modal masses of modes that are not of unit modal mass")
            if any(mode.ids) and not mode.ids[0].startswith("operando "):
                inventory.unkept.append("ID lines of the modes")
            text = f"{'real' if mode.kind == NORMAL_MODE else 'complex'} mode {mode.mode}: {mode.frequency_hz:.6g} Hz"
            inventory.use(raw, text, _scaling(mode).replace("_", " "))
    return tuple(models)


def _note_unequal(keys: list[tuple[Any, ...]], inventory: Inventory) -> None:
    """A finding where modes of one kind lie at different nodes."""
    kinds: dict[tuple[Any, ...], list[tuple[int, ...]]] = {}
    for number, is_complex, nodes, per_node, scaling in keys:
        kinds.setdefault((number, is_complex, per_node, scaling), []).append(nodes)
    for (number, *_), nodes_of in kinds.items():
        if len(nodes_of) > 1:
            inventory.note(
                "unequal_nodes", f"the modes of the file (sets {number}) lie at {len(nodes_of)} different sets of nodes, of "
                f"{', '.join(str(len(nodes)) for nodes in nodes_of[:8])} nodes",
                consequence=f"they became {len(nodes_of)} models", action="export all modes with the same nodes",
            )  # fmt: skip


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
    dofs = [Dof(inventory.node_numbers.node(node), axis) for node in first.nodes for axis in axes]
    shapes = np.column_stack([mode.values.ravel() for mode in modes])
    # Set 55 has a value for every direction of a node: those that are zero in all modes were not measured.
    measured = np.any(shapes != 0, axis=1)
    if not np.any(measured):
        measured[:] = True
    odd = np.count_nonzero(shapes, axis=1) == 1
    if len(modes) >= ODD_AMONG and np.any(odd):
        names = ", ".join(str(d) for d, is_odd in zip(dofs, odd, strict=True) if is_odd)
        inventory.note(
            "odd_direction", f"one mode alone has values at {names[:80]}", group[0][0],
            consequence="these DOFs count as measured, with zeros in the other modes", action="look whether the file is damaged there",
        )  # fmt: skip
    date = inventory.provenance.measured or min((d for mode in modes for line in mode.ids if (d := parse_date(line))), default="")
    residual = np.array([any(line.startswith(RESIDUAL) for line in mode.ids) for mode in modes])
    model = ModalModel.from_terms(
        np.array([m.frequency_hz for m in modes]), np.array([m.damping_ratio for m in modes]), shapes[measured],
        tuple(d for d, keep in zip(dofs, measured, strict=True) if keep), _scaling(first), residual=residual,
        si=_scaling(first) == "unit_modal_mass", provenance=replace(inventory.provenance, measured=date),
    )  # fmt: skip
    check = Check.read(first.ids) if model.scaling == "unit_modal_mass" else None
    if check is not None and check.error_db(model) > CHECK_DB:
        inventory.note(
            "modes_incomplete", f"the {len(modes)} sets 55 do not make the FRF value that they state ({check.text})", group[0][0],
            consequence="a mode or residual term is missing or changed: FRFs made of them are wrong", action="export the file again",
        )  # fmt: skip
    return model
