"""A first test file from the files in a folder: what each was taken for, why, and what is unsure."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from operando.errors import ConfigError, MissingError, OperandoError

IDLE_WORDS = ("idle", "rest", "still", "standstill", "stopped", "parked", "off", "ema", "static", "cold")
CHECK_WORDS = ("check", "verification", "verify", "validation", "judge", "proof")
OPERATING_WORDS = ("operating", "operation", "operational", "running", "oma", "ambient", "on", "load", "loaded")
MOTION = ("acceleration", "velocity", "displacement")
DRIVE_POINT = 0.01
"""Share of the lines at which power flows out of the structure, beyond three standard deviations: no more at the response that is guessed
to sit at the force, twice as much at all others. At a true drive point it is 0 but for noise (0.1 % of lines) and phase errors; F-16
ground vibration test: 0 % at the shaker, 9 and 3 % on the wing."""
SKIPPED_SUFFIXES = (
    ".toml", ".md", ".json", ".html", ".pdf", ".png", ".jpg", ".jpeg", ".svg", ".py", ".ipynb", ".zip", ".gz", ".doc", ".docx",
    ".xls", ".xlsx", ".log", ".yaml", ".yml", ".m", ".exe", ".part",
)  # fmt: skip


@dataclass(frozen=True)
class Taken:
    """What one file was taken for.

    Parameters
    ----------
    file : Path
    role : str
        ``idle records``, ``idle frfs``, ``operating records``, ``check records``, ``check frfs``, ``geometry`` or ``ignored``.
    reason : str
    sure : bool
    """

    file: Path
    role: str
    reason: str
    sure: bool = True

    def to_dict(self) -> dict[str, Any]:
        """JSON object."""
        return {"file": str(self.file), "role": self.role, "reason": self.reason, "sure": self.sure}


@dataclass(frozen=True)
class Scaffold:
    """A test file to be written, and how it came about.

    Parameters
    ----------
    text : str
        The test file.
    taken : tuple of Taken
        One a file.
    notes : tuple of str
        What to look at: units, labels, doubts.
    """

    text: str
    taken: tuple[Taken, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON object."""
        return {"taken": [t.to_dict() for t in self.taken], "notes": list(self.notes), "text": self.text}


@dataclass
class _Seen:
    """What the files lack, gathered while reading; ``labels`` are guesses, channel name → what [channels] would say of it."""

    unitless: dict[str, set[str]] = field(default_factory=dict)
    unlabelled: dict[str, str] = field(default_factory=dict)
    rates: set[float] = field(default_factory=set)
    labels: dict[str, dict[str, Any]] = field(default_factory=dict)
    guesses: list[str] = field(default_factory=list)


def scaffold(folder: str | Path, target: str | Path | None = None) -> Scaffold:
    """Look at the files in a folder and propose a test file.

    Records with a force channel and responses are taken as idle, or as check where folder or file names say so; records with
    responses only as operating; FRFs as idle FRFs; coordinates as geometry.

    Parameters
    ----------
    folder : path
        Searched with its subfolders; hidden ones and results folders are passed over.
    target : path, optional
        Where the test file will lie (paths inside are relative to it); default ``folder/test.toml``.

    Raises
    ------
    MissingError
        If there is no folder, or no measurement in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingError("there is no such folder", where=str(folder))
    base = Path(target).parent if target is not None else folder
    seen = _Seen()
    taken = tuple(_take(file, folder, seen) for file in _candidates(folder))
    if not any(t.role.split()[-1] in ("records", "frfs") for t in taken):
        raise MissingError(
            "no measurement was found",
            where=str(folder),
            hint="; ".join(f"{t.file.name}: {t.reason}" for t in taken[:4])
            or "it holds no file of a known format (UFF, MATLAB, CSV, HDF5)",
        )
    notes = _notes(taken, seen)
    return Scaffold(_text(folder, base, taken, seen, notes), taken, tuple(notes))


def _candidates(folder: Path) -> list[Path]:
    found = []
    for root, folders, files in os.walk(folder):
        if "summary.json" in files:  # a results folder
            folders.clear()
            continue
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        found += [Path(root) / f for f in files if not f.startswith(".") and Path(f).suffix.lower() not in SKIPPED_SUFFIXES]
    return sorted(found, key=lambda p: [int(s) if s.isdigit() else s.lower() for s in re.split(r"(\d+)", p.as_posix())])


def _take(file: Path, folder: Path, seen: _Seen) -> Taken:
    from operando.io import read

    try:
        content = read(file)
    except OperandoError as error:
        return Taken(file, "ignored", f"cannot be read: {error.message}", sure=False)
    if not (content.records or content.frfs):
        if content.geometry is not None:
            return Taken(file, "geometry", f"coordinates of {len(content.geometry.nodes)} nodes")
        if content.models:
            return Taken(file, "ignored", "holds modes, not a measurement")
        return Taken(file, "ignored", "holds nothing a test can use", sure=False)
    if content.frfs and not content.records:
        state, reason, sure = _state(file, folder, "idle")
        state = "check" if state == "operating" else state
        pairs = sum(len(h.responses) * len(h.references) for h in content.frfs)
        if not all(h.si for h in content.frfs):
            seen.unitless.setdefault("acceleration", set()).add(file.name)
            seen.unitless.setdefault("force", set()).add(file.name)
        return Taken(file, f"{state} frfs", f"{pairs} FRFs; {reason}", sure)
    return _take_record(file, folder, content, seen)


def _take_record(file: Path, folder: Path, content: Any, seen: _Seen) -> Taken:
    record = max(content.records, key=lambda r: r.data.size)
    seen.rates.add(record.sampling_hz)
    record = _labelled(record, seen)
    for channel in record.channels:
        if channel.name in seen.labels and "exclude" in seen.labels[channel.name]:
            continue
        if channel.dof is None or channel.quantity == "unknown":
            seen.unlabelled.setdefault(channel.name or f"channel {len(seen.unlabelled) + 1}", file.name)
        elif channel.unit == "":
            seen.unitless.setdefault(channel.quantity, set()).add(file.name)
    forces, responses = len(record.force_indices), len(record.response_indices)
    what = f"{forces} force and {responses} response channels, {record.duration_s:.4g} s at {record.sampling_hz:.6g} Hz"
    if responses == 0:
        return Taken(file, "operating records", f"{what}: channels are not labelled; a guess", sure=False)
    if forces == 0:
        state, reason, _ = _state(file, folder, "operating")
        if state == "operating":
            return Taken(file, "operating records", f"{what}; no force: {reason}")
        return Taken(file, "operating records", f"{what}; no force, though its name says {state}", sure=False)
    state, reason, sure = _state(file, folder, "idle")
    if state == "operating":
        return Taken(file, "check records", f"{what}; in operation and with force: it can judge the model", sure=False)
    return Taken(file, f"{state} records", f"{what}; {reason}", sure)


def _labelled(record: Any, seen: _Seen) -> Any:
    """The record with guessed DOFs where no channel has one but names or units tell quantities; the guesses go into ``seen``."""
    from dataclasses import replace

    from operando.dof import Dof

    motion = [c for c in record.channels if c.quantity in MOTION]
    if not motion or any(c.dof is not None for c in record.channels) or any(not c.name for c in record.channels):
        return record
    fresh = any(c.name not in seen.labels for c in record.channels)
    for channel in motion:
        taken = {label["dof"] for label in seen.labels.values() if "dof" in label and label["quantity"] in MOTION}
        if channel.name not in seen.labels:
            seen.labels[channel.name] = {"dof": _dof_of_name(channel.name, taken), "quantity": channel.quantity}
    channels = [replace(c, dof=Dof.parse(seen.labels[c.name]["dof"])) if c in motion else c for c in record.channels]
    forces = [c for c in record.channels if c.is_force]
    for force in forces:
        if force.name not in seen.labels:
            dof, why = _dof_of_force(record, channels, force)
            seen.labels[force.name] = {"dof": dof, "quantity": force.quantity}
            seen.guesses.append(f"{force.name} taken as the force at {dof}: {why}")
    for channel in record.channels:
        if channel not in motion and channel not in forces and channel.quantity != "unknown":
            seen.labels[channel.name] = {"exclude": True, "reason": f"{channel.quantity} is neither a force nor a motion"}
    if fresh:
        seen.guesses.append(
            f"DOFs guessed from the order and the names of the channels ({', '.join(c.name for c in motion[:4])}"
            f"{' …' if len(motion) > 4 else ''}); +Z stands for a direction the file does not say: correct them in [channels]"
        )
    named = {name: Dof.parse(label["dof"]) for name, label in seen.labels.items() if "dof" in label}
    return replace(record, channels=tuple(replace(c, dof=named.get(c.name)) for c in record.channels))


def _dof_of_name(name: str, taken: set[str]) -> str:
    """A DOF no other channel has: the number in a channel name and a direction at its end, else the next free node along +Z."""
    match = re.search(r"(\d+)\D*$", name)
    axis = re.search(r"(?:\d|[_\s:.\-])([+-]?)([xyz])$", name, re.IGNORECASE)
    direction = f"{axis[1] or '+'}{axis[2].upper()}" if axis else "+Z"
    node = int(match[1]) if match else 1
    while f"{node}{direction}" in taken:
        node += 1
    return f"{node}{direction}"


def _dof_of_force(record: Any, channels: Sequence[Any], force: Any) -> tuple[str, str]:
    """Where a force without a label acts: at the one response into which it puts power at every line, else at a node of its own."""
    from dataclasses import replace

    from operando.dof import Dof
    from operando.frf import estimate_frf, power_signs

    nodes = [c.dof.node for c in channels if c.dof is not None]
    own = Dof(max(nodes, default=0) + 1, "Z")
    rows = [i for i, c in enumerate(channels) if c.dof is not None or c is force or c.name == force.name]
    labelled = tuple(replace(c, dof=own) if c.name == force.name else c for c in channels)
    try:
        frf = estimate_frf(replace(record, channels=labelled, findings=()).select(rows))
    except OperandoError as error:
        return str(own), f"a node of its own, for its FRFs cannot be estimated ({error.message})"
    signs = {str(d): power_signs(frf, i, 0) for i, d in enumerate(frf.responses)}
    drive = [d for d, (inward, outward) in signs.items() if outward <= DRIVE_POINT and inward > 10 * DRIVE_POINT]
    others = [outward for d, (_, outward) in signs.items() if d not in drive]
    if len(drive) == 1 and min(others, default=1.0) > 2 * DRIVE_POINT:
        inward, outward = signs[drive[0]]
        second = f"; at the others it flows out at {100 * min(others):.0f} % or more" if others else ""
        return drive[0], (
            f"as at a drive point, power flows into the structure there at {100 * inward:.0f} % of the lines and out at "
            f"{100 * outward:.0f} %{second}"
        )
    return str(own), "a node of its own: the measurement does not tell one response as its drive point (label them alike if you know it)"


def _state(file: Path, folder: Path, default: str) -> tuple[str, str, bool]:
    """State by the words of folder and file names, the innermost first."""
    parts = [file.stem, *reversed(file.relative_to(folder).parts[:-1])]
    for part in parts:
        words = re.findall(r"[a-z]+", part.lower())
        for state, known in (("check", CHECK_WORDS), ("idle", IDLE_WORDS), ("operating", OPERATING_WORDS)):
            if any(word in known for word in words):
                return state, f"named {part!r}", True
    return default, f"no name says otherwise, taken as {default}", default == "operating"


def _notes(taken: Sequence[Taken], seen: _Seen) -> list[str]:
    notes = [f"guessed: {guess}" for guess in seen.guesses]
    notes += [f"unsure: {t.file.name} taken as {t.role}: {t.reason}" for t in taken if not t.sure]
    for quantity, files in sorted(seen.unitless.items()):
        notes.append(
            f"no unit of {quantity} in {len(files)} files: give it in [units]; without it there is no mass scaling and no FRF in SI"
        )
    if seen.unlabelled:
        names = list(seen.unlabelled)
        shown = ", ".join(names[:6]) + (" …" if len(names) > 6 else "")
        notes.append(f"{len(names)} channels without DOF or quantity ({shown}): label them in [channels]")
    if len(seen.rates) > 1:
        notes.append("records of different sampling rates: " + ", ".join(f"{r:.6g} Hz" for r in sorted(seen.rates)))
    roles = {t.role.split()[0] for t in taken}
    for state, loss in (
        ("idle", "no scaled model, no operational FRFs"),
        ("operating", "idle modes only"),
        ("check", "nothing judges the result"),
    ):
        if state not in roles:
            notes.append(f"no {state} measurement: {loss}")
    if sum(t.role == "geometry" for t in taken) > 1:
        notes.append("several geometry files: the first one is used")
    return notes


def write_test(made: Scaffold, path: str | Path, *, overwrite: bool = False) -> None:
    """Write the test file.

    Raises
    ------
    ConfigError
        If the file exists and ``overwrite`` is not set.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ConfigError("exists already", where=str(path), hint="choose another name with -o, or --force to write over it")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        beside.write_text(made.text, encoding="utf-8")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
