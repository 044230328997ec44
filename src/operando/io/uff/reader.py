"""Reading of UFF files: splitting, then records, FRFs, modes, geometry; everything accounted for."""

from __future__ import annotations

import hashlib
import io
import mmap
import re
from pathlib import Path
from typing import IO

from operando.data import Finding, Provenance, file_hash
from operando.errors import FormatError, MissingError
from operando.io.content import Content, FileHeader
from operando.io.quantities import ChannelSpecs, Units
from operando.io.uff.components import NodeNumbers, evidence_of_components, with_components
from operando.io.uff.frfs import assemble_frfs
from operando.io.uff.geometry import assemble_geometry
from operando.io.uff.information import read_header, read_qualifiers, read_units
from operando.io.uff.inventory import SET_NAMES, Inventory, title_of
from operando.io.uff.lines import OWN_LINES, body_lines, parse_date
from operando.io.uff.models import assemble_models
from operando.io.uff.records import assemble_records, is_time_function
from operando.io.uff.split import RawSet, outside_sets, split_sets
from operando.io.uff.textform import Buffer, in_one_form
from operando.paths import near_path
from operando.printable import first_few

_FULL_HASH = 1 << 25
_LINES = {164: 3, 151: 7, 1858: 7}
"""Most lines of the sets that tell of others, by the standard: more of them are another set whose separators are damaged."""


def read_uff(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read a UFF file (ASCII, binary, mixed).

    Parameters
    ----------
    path : path
        File.
    units : mapping, optional
        Quantity → unit text where the file is silent; ``length`` for coordinates.
    channels : mapping, optional
        Channel name or DOF label → dof, quantity, unit, sensitivity, exclude, reason.

    Returns
    -------
    Content

    Raises
    ------
    FormatError
        If the file is no UFF, or everything in it is damaged.
    MissingError
        If there is no such file.

    Examples
    --------
    >>> import tempfile, operando
    >>> frf = operando.Frf([[[1.0, 2.0]]], [5.0, 6.0], "7+Z", "1+Z")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/frf.uff", frf)
    ...     len(read_uff(f"{folder}/frf.uff").frfs)
    1
    """
    path = Path(path)
    with open_file(path) as stream, map_file(stream, str(path)) as mapped:
        buffer, changed = _one_form(mapped, str(path))
        sets = split_sets(buffer, str(path))
        inventory = Inventory(str(path), buffer, sets, units or {}, channels or {}, provenance_of(path, mapped, _measured(sets)))
        if changed:
            inventory.note("format", f"{changed}: read all the same", severity="info")
        _note_outside(inventory)
        return _read(stream if buffer is mapped else io.BytesIO(buffer), inventory)


def read_uff_sets(path: str | Path) -> list[tuple[RawSet, bytes]]:
    """All sets of a file as they stand: position, type, header of functions, and the raw bytes with separators.

    Parameters
    ----------
    path : path
        File.

    Returns
    -------
    list of (RawSet, bytes)

    Raises
    ------
    FormatError
        If the file is no UFF.

    Examples
    --------
    >>> import tempfile, operando
    >>> geometry = operando.Geometry((1, 2), [[0, 0, 0], [1, 0, 0]], ((1, 2),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/geometry.uff", geometry)
    ...     [found.number for found, _ in read_uff_sets(f"{folder}/geometry.uff")]
    [164, 2411, 82]
    """
    path = Path(path)
    with open_file(path) as stream, map_file(stream, str(path)) as mapped:
        buffer, _ = _one_form(mapped, str(path))
        return [(raw, raw.raw(buffer)) for raw in split_sets(buffer, str(path))]


def _one_form(mapped: mmap.mmap, where: str) -> tuple[Buffer, str]:
    try:
        return in_one_form(mapped)
    except FormatError as error:
        raise FormatError(error.message, where=where, hint=error.hint) from error


def _measured(sets: list[RawSet]) -> str:
    """When the functions were measured: the earliest date of their ID lines (the third, by the standard)."""
    dates = (parse_date(line) for raw in sets if raw.header is not None for line in raw.header.ids if ":" in line)
    return min((date for date in dates if date), default="")


_SET_WITHIN = re.compile(rb"(?:^|[\r\n])[ \t]{0,8}(\d{2,4})[ \t]*(?:[bB][ \t]|[\r\n])")


def _note_outside(inventory: Inventory) -> None:
    """One finding for each stretch of bytes outside the sets: a damaged separator hides a set."""
    for start, stop in outside_sets(inventory.buffer, inventory.sets):
        gap = bytes(inventory.buffer[start:stop])
        lost = next((int(m[1]) for m in _SET_WITHIN.finditer(gap) if int(m[1]) in SET_NAMES), None)
        after = sum(raw.start < start for raw in inventory.sets)
        place = "before the first set" if after == 0 else f"after set {after - 1}"
        message = f"{stop - start} bytes from byte {start} on ({place}) belong to no set"
        if lost is None:
            inventory.note("outside_sets", message, consequence="they are not used", action="look whether they are data")
        else:
            inventory.note(
                "outside_sets", f"{message}; they look like a set of type {lost} ({SET_NAMES[lost]}) whose separator is damaged",
                severity="error", consequence="its data are missing from every result", action="export the file again",
            )  # fmt: skip


def open_file(path: Path) -> IO[bytes]:
    """Open for reading; a missing or unreadable file is an error that says so."""
    try:
        return open(path, "rb")
    except FileNotFoundError as error:
        raise MissingError("no such file", where=str(path), hint=near_path(path)) from error
    except OSError as error:
        raise MissingError(f"cannot be opened: {error.strerror}", where=str(path)) from error


def map_file(stream: IO[bytes], where: str) -> mmap.mmap:
    """Map a file into memory for searching."""
    try:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except ValueError as error:
        raise FormatError("the file is empty", where=where) from error


def provenance_of(path: Path, mapped: mmap.mmap | None = None, measured: str = "") -> Provenance:
    """Where what was read of a file comes from."""
    return Provenance(((str(path), quick_hash(path, mapped)),), (f"read {path.name}",), measured)


def quick_hash(path: Path, mapped: mmap.mmap | None = None) -> str:
    """SHA-256 of a file; above 32 MB of its size and 64 blocks spread over it (the text then starts with ``sampled:``).

    A file that is mapped already is hashed where it lies.
    """
    size = path.stat().st_size
    if size <= _FULL_HASH:
        return file_hash(path) if mapped is None else hashlib.sha256(mapped).hexdigest()
    digest = hashlib.sha256(str(size).encode())
    with open(path, "rb") as stream:
        for i in range(64):
            stream.seek((size - 65536) * i // 63)
            digest.update(stream.read(65536))
    return "sampled:" + digest.hexdigest()


def _read(stream: IO[bytes], inventory: Inventory) -> Content:
    header = _read_information(inventory)
    _read_components(header, inventory)
    for raw in inventory.sets:
        for note in raw.notes if not raw.problem else ():
            inventory.note("format", f"set {raw.index}: {note}", raw, severity="info")
    functions = _functions(inventory)
    records = assemble_records(stream, [raw for raw in functions if raw.header and is_time_function(raw.header)], inventory)
    frfs = assemble_frfs(functions, inventory)
    _ignore_other_functions(functions, inventory)
    models = assemble_models([raw for raw in inventory.sets if raw.number in (55, 2414) and not raw.problem], inventory)
    geometry = assemble_geometry([raw for raw in inventory.sets if not raw.problem], inventory)
    _name_unknown(inventory)
    statuses = [status for status, _, _ in inventory.status.values()]
    if inventory.damaged and not any(s != "not understood" for s in statuses):
        more = "" if len(inventory.damaged) == 1 else f" (and {len(inventory.damaged) - 1} more sets)"
        raise FormatError(
            "nothing in the file can be used: " + inventory.damaged[0] + more,
            where=inventory.file,
            hint="the file is damaged or was cut short: copy or export it again",
        )
    return Content(
        inventory.file, "uff", records, frfs, models, geometry, inventory.set_infos(), tuple(_condensed(inventory)), header,
        tuple(dict.fromkeys([*_unkept_lines(functions), *inventory.unkept])),
    )  # fmt: skip


def _unkept_lines(functions: list[RawSet]) -> list[str]:
    """Whether functions have ID lines that say more than name and date; those that operando wrote do not."""
    for raw in functions:
        assert raw.header is not None
        ids = raw.header.ids
        if not ids[1].startswith(OWN_LINES) and any(line and not parse_date(line) for line in ids[1:]):
            return ["ID lines of the functions but name, date and averages"]
    return []


def _read_information(inventory: Inventory) -> FileHeader | None:
    """Units, header and qualifiers: what other sets are understood by."""
    header = None
    for raw in inventory.sets:
        _note_surplus(raw, inventory)
        if raw.number == 164:
            try:
                system, problem = read_units(raw.raw(inventory.buffer))
            except FormatError as error:
                inventory.refuse(raw, "units", error.message)
                continue
            inventory.systems[raw.index] = system
            inventory.use(raw, "units", f"{system.description or 'no name'}: length 1/{system.length:g} m, force 1/{system.force:g} N")
            if problem:
                inventory.note("unit_conflict", f"set {raw.index}: {problem}: the factors are used", raw, action="look which is meant")
        elif raw.number == 151:
            own = read_header(raw.raw(inventory.buffer))
            if header is None:
                inventory.use(raw, "header", own.program or own.writer)
            else:
                inventory.ignore(raw, "header", "a further header; the first one counts")
            header = header or own
        elif raw.number == 1858:
            _read_qualifiers(raw, inventory)
    return header


def _note_surplus(raw: RawSet, inventory: Inventory) -> None:
    """A finding where a set goes on behind its last line: a set with a damaged separator is in it."""
    if raw.number not in _LINES:
        return
    lines = [line for line in body_lines(raw.raw(inventory.buffer)) if line.strip()]
    surplus = len(lines) - _LINES[raw.number]
    if surplus > 0:
        inventory.note(
            "outside_sets", f"set {raw.index} ({title_of(raw)}) has {surplus} lines more than a set of type {raw.number}", raw,
            severity="error", consequence="if they are another set, its data are missing from every result", action="export the file again",
        )  # fmt: skip


def _read_components(header: FileHeader | None, inventory: Inventory) -> None:
    """Take entity names as components of the nodes where the file says that they are."""
    inventory.node_numbers = NodeNumbers.stated("" if header is None else header.description)
    functions = [raw.header for raw in inventory.sets if raw.header is not None and not raw.problem]
    reason = evidence_of_components(functions, header)
    if not reason:
        return
    inventory.sets = [with_components(raw) for raw in inventory.sets]
    dofs = [d for raw in inventory.sets if raw.header is not None for d in (raw.header.response, raw.header.reference) if d is not None]
    names = sorted({d.component for d in dofs if d.component})
    if names:
        first = min(d for d in dofs if d.component)
        inventory.note(
            "components", f"the names {first_few(names, 8)} are components of the structure: {reason}",
            severity="info", consequence=f"DOFs are written with them, as {first}",
            action="if they are names of sensors, give the DOFs in [channels] of the test file",
        )  # fmt: skip


def _read_qualifiers(raw: RawSet, inventory: Inventory) -> None:
    found = inventory.attempt(raw, read_qualifiers)
    if found is None:
        return
    window = f"{found.window} window" if found.window else "no window stated"
    inventory.ignore(raw, f"qualifiers of a function: {window}", "read for what it says of the window; a conversion to UFF passes it on")
    if found.exponential:
        inventory.note(
            "exponential_window", f"set {raw.index} says that a function was measured under an exponential window "
            f"(factor {found.exponential_factor:g})", raw, consequence="it raises the damping of every mode, and is not taken off",
            action="estimate the FRFs from the records, or take the window's part off the damping ratios",
        )  # fmt: skip


def _functions(inventory: Inventory) -> list[RawSet]:
    good = []
    for raw in inventory.sets:
        if raw.number != 58 and raw.number != 0:
            continue
        if raw.problem or raw.header is None:
            inventory.refuse(raw, title_of(raw), raw.problem or "the header cannot be read")
        else:
            good.append(raw)
    return good


def _ignore_other_functions(functions: list[RawSet], inventory: Inventory) -> None:
    for raw in functions:
        assert raw.header is not None
        if raw.index not in inventory.status:
            inventory.ignore(raw, raw.header.title, f"{raw.header.title}: neither time record, FRF nor coherence; not needed")


def _name_unknown(inventory: Inventory) -> None:
    """One finding for each set type nobody reads."""
    unknown: dict[int, list[RawSet]] = {}
    for raw in inventory.sets:
        if raw.index not in inventory.status:
            unknown.setdefault(raw.number, []).append(raw)
    for number, sets in unknown.items():
        many = f"{len(sets)} sets" if len(sets) > 1 else "set"
        inventory.note(
            "unknown_set", f"{many} of type {number} ({title_of(sets[0])}) not understood", sets[0], severity="info",
            consequence="not used; a conversion to UFF passes them on as they are",
        )  # fmt: skip


def _condensed(inventory: Inventory) -> list[Finding]:
    """Findings, with the same message about many sets said once."""
    from dataclasses import replace

    groups: dict[tuple[str, str, str, str], list[Finding]] = {}
    for finding in inventory.findings:
        key = (finding.kind, finding.severity, finding.consequence, finding.action)
        groups.setdefault(key, []).append(finding)
    out = []
    for same in groups.values():
        if len(same) <= 3:
            out += same
        else:
            out.append(replace(same[0], message=f"{same[0].message}; and {len(same) - 1} more of this kind", dof=None))
    return out
