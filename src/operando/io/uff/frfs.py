"""FRFs from the function sets of a UFF file: types 4 (FRF), 6 (coherence), 26 (multiple coherence)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import FrequencyAxis, Frf
from operando.dof import Dof, Node
from operando.errors import DataError, FormatError, UnitError
from operando.io.quantities import Scale, code_quantity, find_spec, possible_coherence, resolve, spec_dof, split_ratio
from operando.io.uff.header58 import Header58
from operando.io.uff.inventory import Inventory
from operando.io.uff.split import RawSet
from operando.io.uff.values58 import read_values
from operando.units import parse_unit

_NUMERATORS = {
    "acceleration": "accelerance", "angular_acceleration": "accelerance", "velocity": "mobility", "angular_velocity": "mobility",
    "displacement": "receptance", "angle": "receptance",
}  # fmt: skip
_FORCES = ("force", "moment")
STANDARD_DEVIATION = "standard deviation of"
"""Beginning of the first ID line of a set of function type 0 that holds the error of an FRF."""


@dataclass
class _Function:
    raw: RawSet
    header: Header58
    response: Dof
    reference: Dof
    quantity: str
    si: bool
    factor: float
    axis_key: tuple[Any, ...]
    frequencies: NDArray[np.float64]
    values: NDArray[Any]


def assemble_frfs(functions: list[RawSet], inventory: Inventory) -> tuple[Frf, ...]:
    """One FRF object for each quantity and frequency axis, coherences matched to it."""
    measured = [f for position, raw in enumerate(_of_type(functions, 4)) if (f := _frf_function(raw, position, inventory)) is not None]
    groups: dict[tuple[Any, ...], list[_Function]] = {}
    for function in measured:
        groups.setdefault((function.axis_key, function.quantity, function.si), []).append(function)
    coherences = _real_functions(_of_type(functions, 6, 26), inventory)
    errors = _real_functions([raw for raw in _of_type(functions, 0) if _is_deviation(raw)], inventory)
    frfs = tuple(frf for group in groups.values() if (frf := _frf(group, coherences, errors, inventory)) is not None)
    for raw, _, _, _, used in (*coherences, *errors):
        if not used and raw.index not in inventory.status:
            _leave(raw, "no FRF of the same DOFs and frequency lines in the file", inventory)
    _note_unequal(list(groups), inventory)
    return frfs


def _leave(raw: RawSet, reason: str, inventory: Inventory) -> None:
    """Leave a function out that would be expected to be used, with a finding."""
    inventory.ignore(raw, _title(raw), reason)
    inventory.note("unused_function", f"set {raw.index} ({_title(raw)}) is not used: {reason}", raw, severity="info")


def _note_unequal(keys: list[tuple[Any, ...]], inventory: Inventory) -> None:
    """A finding where the FRFs of one quantity lie on different lines."""
    for quantity in dict.fromkeys(key[1] for key in keys):
        count = len({key[0] for key in keys if key[1] == quantity})
        if count > 1:
            inventory.note(
                "unequal_lines", f"the FRFs ({quantity}) of the file lie on {count} different sets of frequency lines",
                consequence=f"they became {count} objects", action="export all functions with the same lines",
            )  # fmt: skip


def _of_type(functions: list[RawSet], *types: int) -> list[RawSet]:
    return [raw for raw in functions if raw.header is not None and raw.header.function_type in types]


def _is_deviation(raw: RawSet) -> bool:
    return raw.header is not None and any(line.startswith(STANDARD_DEVIATION) for line in raw.header.ids)


def _title(raw: RawSet) -> str:
    assert raw.header is not None
    return raw.header.title


def _frf_function(raw: RawSet, position: int, inventory: Inventory) -> _Function | None:
    header = raw.header
    assert header is not None
    spec = find_spec(inventory.channels, header.name, header.response, False, position)
    reference_spec = find_spec(inventory.channels, "", header.reference, True)
    for entry in (spec, reference_spec):
        if entry.get("exclude"):
            inventory.ignore(raw, header.title, "excluded by [channels]: " + str(entry.get("reason") or "no reason given"))
            return None
    response, reference = spec_dof(spec, header.response), spec_dof(reference_spec, header.reference)
    if response is None or reference is None:
        response, reference = _stand_in(raw, response, reference, position, inventory)
    scales = _scales(raw, header, spec, reference_spec, inventory)
    if scales is None:
        return None
    numerator, denominator, quantity = scales
    si = numerator.known and denominator.known
    if not header.is_complex:
        inventory.note("real_frf", f"FRF {response}/{reference} is real", raw, str(response), consequence="its phase is 0 or 180 degrees")
    try:
        key, frequencies, values = _lines(raw, header, inventory)
    except (FormatError, DataError) as error:
        inventory.refuse(raw, header.title, error.message)
        return None
    factor = numerator.factor / denominator.factor if si else 1.0
    return _Function(raw, header, response, reference, quantity, si, factor, key, frequencies, values)


def _stand_in(raw: RawSet, response: Dof | None, reference: Dof | None, position: int, inventory: Inventory) -> tuple[Dof, Dof]:
    """DOFs for a function that names none: scalars by position, and 0 for the reference."""
    missing = [name for name, dof in (("response", response), ("reference", reference)) if dof is None]
    response = Dof(position + 1) if response is None else response
    reference = Dof(0) if reference is None else reference
    inventory.note(
        "missing_dof", f"set {raw.index} names no {' and no '.join(missing)} DOF: taken as {response}/{reference}", raw, str(response),
        consequence="the function cannot be placed on the structure", action="give the DOF in [channels] of the test file",
    )  # fmt: skip
    return response, reference


def _scales(raw: RawSet, header: Header58, spec: Any, reference_spec: Any, inventory: Inventory) -> tuple[Scale, Scale, str] | None:
    """Scales of numerator and denominator and the FRF quantity; None where the function is no response over force."""
    system = inventory.system_at(raw.index)
    text, below = header.ordinate.unit, header.denominator.unit
    ratio = split_ratio(text) if text else None
    if ratio is not None:
        text, below = ratio
    top = code_quantity(header.ordinate.code, header.response)
    bottom = code_quantity(header.denominator.code, header.reference)
    if bottom == "unknown":
        # A function of type 4 without a denominator: by far the most programs mean a force.
        bottom = "unknown" if below else ("moment" if header.reference is not None and header.reference.axis.startswith("R") else "force")
    numerator = resolve(top, text, inventory.units, spec, system, header.ordinate.exponents, header.title)
    denominator = resolve(bottom, below, inventory.units, reference_spec, system, header.denominator.exponents, header.title)
    quantity = _NUMERATORS.get(numerator.quantity)
    if numerator.quantity == "unknown" or denominator.quantity == "unknown":
        quantity = quantity or "accelerance"
        inventory.note(
            "missing_unit", f"set {raw.index} ({header.title}) does not say what it measures: taken as accelerance without unit", raw,
            consequence="frequencies and damping can be found, the scaling to unit modal mass cannot",
            action='say it in [channels]: quantity = "acceleration", unit = "m/s2"',
        )  # fmt: skip
    elif quantity is None or denominator.quantity not in _FORCES:
        _leave(raw, f"{numerator.quantity} over {denominator.quantity} is no response over force", inventory)
        return None
    elif not (numerator.known and denominator.known):
        lacking = [s.quantity for s in (numerator, denominator) if not s.known]
        inventory.note(
            "missing_unit", f"the file states no unit for the {' and the '.join(lacking)} of FRF {header.title}", raw,
            None if header.response is None else str(header.response),
            consequence="the numbers are kept as they are: frequencies and damping can be found, the scaling to unit modal mass cannot",
            action="give it in the test file: [units] " + ", ".join(f'{q} = "…"' for q in lacking),
        )  # fmt: skip
    for scale in (numerator, denominator):
        if scale.problem:
            inventory.note("unit_conflict", f"set {raw.index}: {scale.problem}", raw, action="say the unit in [channels] of the test file")
    return numerator, denominator, quantity or "accelerance"


def _lines(raw: RawSet, header: Header58, inventory: Inventory) -> tuple[tuple[Any, ...], NDArray[np.float64], NDArray[Any]]:
    """Key of the axis, frequencies [Hz] and values of a function over frequency."""
    factor = 1.0
    if header.abscissa.unit:
        try:
            found, factor = parse_unit(header.abscissa.unit)
            factor = {"frequency": factor, "angular_velocity": 1 / (2 * np.pi), "rpm": 1 / 60}.get(found, 1.0)
        except UnitError:
            inventory.note("unit_conflict", f"set {raw.index}: frequency axis in {header.abscissa.unit!r}, taken as Hz", raw)
    abscissa, values = read_values(inventory.buffer, raw)
    if abscissa is None:
        start, step = header.start * factor, header.step * factor
        key: tuple[Any, ...] = (float(f"{start:.9g}"), float(f"{step:.9g}"), header.points)
        return key, _even_lines(start, step, header.points), values
    frequencies = FrequencyAxis(abscissa * factor).values
    return (header.points, frequencies.tobytes()), frequencies, values


@lru_cache(maxsize=2)
def _even_lines(start: float, step: float, points: int) -> NDArray[np.float64]:
    """Even lines [Hz], checked: the functions of a file mostly share them."""
    with np.errstate(over="ignore"):  # a step of a damaged file; the axis refuses what is not finite
        return FrequencyAxis(np.asarray(start + step * np.arange(points), np.float64)).values


_Beside = list[Any]
"""[raw, header, axis key, values, used]"""


def _real_functions(functions: list[RawSet], inventory: Inventory) -> list[_Beside]:
    """Functions that belong to FRFs: coherences and standard deviations."""
    out: list[_Beside] = []
    for raw in functions:
        assert raw.header is not None
        try:
            key, _, values = _lines(raw, raw.header, inventory)
        except (FormatError, DataError) as error:
            inventory.refuse(raw, raw.header.title, error.message)
            continue
        out.append([raw, raw.header, key, np.real(values).astype(float), False])
    return out


def _frf(group: list[_Function], coherences: list[_Beside], errors: list[_Beside], inventory: Inventory) -> Frf | None:
    responses: dict[tuple[Node, str], Dof] = {}
    references: dict[tuple[Node, str], Dof] = {}
    for f in group:
        responses.setdefault(f.response.key, f.response)
        references.setdefault(f.reference.key, f.reference)
    rows, columns = {k: i for i, k in enumerate(responses)}, {k: i for i, k in enumerate(references)}
    data = np.full((len(rows), len(columns), group[0].frequencies.size), np.nan + 0j)
    filled: dict[tuple[int, int], int] = {}
    for f in group:
        i, j = rows[f.response.key], columns[f.reference.key]
        if (i, j) in filled:
            inventory.ignore(f.raw, f.header.title, f"the same pair of DOFs as set {filled[i, j]}, which is used")
            inventory.note(
                "duplicate_set", f"FRF {f.response}/{f.reference} is in sets {filled[i, j]} and {f.raw.index}", f.raw, str(f.response),
                consequence=f"set {filled[i, j]} is used", action="put repeated measurements into files of their own",
            )  # fmt: skip
            continue
        # One DOF measured in both senses is one row: the sense of its first set.
        sign = f.response.sign * list(responses.values())[i].sign * f.reference.sign * list(references.values())[j].sign
        factor = f.factor * sign
        if factor == 1.0:
            data[i, j] = f.values
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                data[i, j] = f.values * factor
        filled[i, j] = f.raw.index
        inventory.use(f.raw, f.header.title, "SI" if f.si else "numbers kept: unit unknown")
    coherence = _matched(coherences, group, rows, columns, data, "coherence of the FRF", inventory)
    coherence, wrong = possible_coherence(coherence, inventory.file)
    inventory.findings.extend(wrong)
    deviation = _matched(errors, group, rows, columns, data, "standard deviation of the FRF", inventory)
    averages = _averages(group, inventory)
    with np.errstate(over="ignore", invalid="ignore"):
        variance = line_variance(data, coherence, averages) if deviation is None else (deviation * abs(group[0].factor)) ** 2
    return Frf(
        data, FrequencyAxis(group[0].frequencies), tuple(responses.values()), tuple(references.values()), group[0].quantity,
        variance=variance, coherence=coherence, averages=averages, si=group[0].si,
        name=inventory.file, provenance=inventory.provenance,
    )  # fmt: skip


def _matched(beside: list[_Beside], group: list[_Function], rows: dict[Any, int], columns: dict[Any, int], data: NDArray[Any],
             title: str, inventory: Inventory) -> NDArray[np.float64] | None:  # fmt: skip
    out: NDArray[np.float64] | None = None
    codes = {0, *(f.header.ordinate.code for f in group)}  # a coherence has no quantity, a standard deviation that of its FRF
    for entry in beside:
        raw, header, key, values, _ = entry
        if key != group[0].axis_key or header.response is None or header.ordinate.code not in codes:
            continue
        i = rows.get(header.response.key)
        reference = header.reference
        j = None if reference is None else columns.get(reference.key)
        everywhere = header.function_type == 26 or (reference is None and len(columns) == 1)
        if i is None or (j is None and not everywhere) or np.all(np.isnan(data[i, slice(None) if everywhere else j])):
            continue
        if out is None:
            out = np.full(data.shape, np.nan)
        columns_here = slice(None) if everywhere else j
        if not np.all(np.isnan(out[i, columns_here])):
            inventory.note("duplicate_set", f"the {title} at {header.title} is there more than once: the first is used", raw)
            inventory.ignore(raw, header.title, "the same pair of DOFs as an earlier set, which is used")
            continue
        out[i, columns_here] = values
        entry[4] = True
        inventory.use(raw, header.title, title)
    return out


def line_variance(data: NDArray[Any], coherence: NDArray[np.float64] | None, averages: float | None) -> NDArray[np.float64] | None:
    """E|ΔH|² = |H|²(1−γ²)/(γ²·n) of each line, where coherence γ² and averages n are known (Bendat & Piersol, random error of H1)."""
    if coherence is None or not averages:
        return None
    gamma = np.clip(coherence, 1e-12, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.abs(data) ** 2 * (1 - gamma) / (gamma * averages)


def _averages(group: list[_Function], inventory: Inventory) -> float | None:
    """Number of averages where an ID line states it (``averages=25``, ``Averages: 25``); of different ones the smallest."""
    found = set()
    for f in group:
        for line in f.header.ids:
            if "verage" not in line.lower():
                continue
            match = re.search(r"\baverages?\s*[:=]\s*([0-9]+(?:\.[0-9]+)?)", line, re.IGNORECASE)
            if match is not None and float(match[1]) > 0:
                found.add(float(match[1]))
    if len(found) > 1:
        stated = ", ".join(f"{n:g}" for n in sorted(found)[:8])
        inventory.note("few_averages", f"the FRFs state different numbers of averages: {stated}", consequence="the smallest counts for all")
    return min(found) if found else None
