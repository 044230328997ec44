"""A first test file from the files in a folder: what each was taken for, why, and what is unsure."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from operando.atomic import replacing
from operando.errors import ConfigError, MissingError, OperandoError
from operando.scaffold.band import excited_band, held_band, proposed_band
from operando.scaffold.labels import Seen, labelled
from operando.scaffold.text import can_be_named, file_text

IDLE_WORDS = ("idle", "rest", "still", "standstill", "stopped", "parked", "off", "ema", "static", "cold")
CHECK_WORDS = ("check", "verification", "verify", "validation", "judge", "proof")
OPERATING_WORDS = ("operating", "operation", "operational", "running", "oma", "ambient", "on", "load", "loaded")
SILENT = 0.01
"""Share of the largest rms of a force channel in the folder below which it is silent (a hammer lying beside the running machine): a force
40 dB below that of another run cannot be what judges a model; converters and IEPE sensors are quieter by another 40 dB."""
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


def scaffold(folder: str | Path, target: str | Path | None = None) -> Scaffold:
    """Look at the files in a folder and propose a test file.

    Records with a force and responses are taken as idle, or as check where folder or file names say so; records with responses only, or
    whose force channels are silent, as operating; FRFs as idle FRFs; coordinates as geometry. Every file is listed, with the reason where
    it is not used.

    Parameters
    ----------
    folder : path
        Searched with its subfolders; hidden ones and results folders are listed and passed over.
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
    seen = Seen()
    drafts = [_look(file, folder, reason, seen) for file, reason in _listed(folder)]
    taken = tuple(_of_one_kind(draft if isinstance(draft, Taken) else _decide(draft, folder, seen), seen) for draft in drafts)
    if not any(t.role.split()[-1] in ("records", "frfs") for t in taken):
        tried = [t for t in taken if not t.sure] or taken
        raise MissingError(
            "no measurement was found",
            where=str(folder),
            hint="; ".join(f"{t.file.name}: {t.reason}" for t in tried[:4])
            or "it holds no file of a known format (UFF, MATLAB, CSV, HDF5, LVM, TDMS, NumPy, WAV)",
        )
    notes = _notes(taken, seen)
    band = proposed_band(taken, seen)
    return Scaffold(file_text(folder, base, taken, seen, notes, band), taken, tuple(notes))


def _of_one_kind(taken: Taken, seen: Seen) -> Taken:
    """A table without a header line only if its columns are those of most: a test file holds one answer."""
    most = max(seen.columns, key=lambda c: len(seen.columns[c]), default=())
    for columns, names in seen.columns.items():
        if columns != most and taken.file in names:
            reason = f"a table without a header line, columns perhaps {', '.join(columns)}, those of others {', '.join(most)}"
            return Taken(taken.file, "ignored", f"{reason}: give it a header line", sure=False)
    return taken


def _listed(folder: Path) -> list[tuple[Path, str]]:
    """Every file below a folder with the reason why it is not looked at (empty: it is); a hidden or results folder stands as one."""
    found: list[tuple[Path, str]] = []
    for root, folders, files in os.walk(folder):
        place = Path(root)
        if "summary.json" in files and place != folder:
            found.append((place, "a results folder"))
            folders.clear()
            continue
        found += [(place / f, "a hidden folder") for f in folders if f.startswith(".")]
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        found += [(place / f, _passed_over(place / f)) for f in files]
    return sorted(found, key=lambda p: [int(s) if s.isdigit() else s.lower() for s in re.split(r"(\d+)", p[0].as_posix())])


def _passed_over(file: Path) -> str:
    suffix = file.suffix.lower()
    if file.name.startswith("."):
        return "a hidden file"
    if suffix == ".toml":
        return "a test file or settings, no measurement"
    if suffix in ("", ".txt") and file.stem.lower() in ("license", "licence", "copying", "readme", "notice", "changelog", "citation"):
        return "not read: a text about the files"
    if not can_be_named(file):
        return "its name is no Unicode and cannot stand in a test file: rename it"
    return f"not read: {suffix} files hold no measurement" if suffix in SKIPPED_SUFFIXES else ""


def _look(file: Path, folder: Path, reason: str, seen: Seen) -> Taken | _Draft:
    """What a file holds; what it is taken for is decided when all are known."""
    from operando.io import NoHeader, NoLines, NoMeasurement, NoRate, read

    if reason:
        return Taken(file, "ignored", reason)
    try:
        try:
            content = read(file)
        except NoHeader as error:
            if not error.guess:
                raise
            content = read(file, units={"columns": error.guess})
            seen.columns.setdefault(error.guess, []).append(file)
        except NoLines as error:
            content = read(file, units={"frequency_step_hz": 1.0})
            seen.lineless[file.name] = error.lines
        except NoRate:
            content = read(file, units={"sampling_hz": 1.0})
            seen.rateless.append(file.name)
    except NoMeasurement as error:
        return Taken(file, "ignored", f"{error.message}: {error.hint}", sure=False)
    except OperandoError as error:
        return Taken(file, "ignored", f"cannot be read: {error.message}", sure=False)
    if not (content.records or content.frfs):
        if content.geometry is not None:
            return Taken(file, "geometry", f"coordinates of {len(content.geometry.nodes)} nodes")
        if content.models:
            return Taken(file, "ignored", "holds modes, not a measurement")
        return Taken(file, "ignored", "holds nothing a test can use", sure=False)
    if content.frfs and not content.records:
        return _look_at_frfs(file, folder, content, seen)
    return _look_at_record(file, content, seen)


def _look_at_frfs(file: Path, folder: Path, content: Any, seen: Seen) -> Taken:
    state, words, sure = _state(file, folder, "idle")
    state = "check" if state == "operating" else state
    if not all(h.si for h in content.frfs):
        seen.unitless.setdefault("acceleration", set()).add(file.name)
        seen.unitless.setdefault("force", set()).add(file.name)
    if any(finding.kind == "missing_dof" for finding in content.findings):
        seen.unlabelled |= {f"ch{i + 1}": file.name for h in content.frfs for i in range(len(h.responses))}
        seen.unlabelled_force |= any(len(h.references) == 1 for h in content.frfs)
    pairs = frozenset((str(d), str(r)) for h in content.frfs for d in h.responses for r in h.references)
    seen.pairs.setdefault(frozenset({*pairs, ("", state)}), []).append(file)
    if file.name in seen.lineless:
        return Taken(
            file, f"{state} frfs", f"{len(pairs)} FRFs of {seen.lineless[file.name]} lines without frequencies; {words}", sure=False
        )
    lines = [h.frequencies_hz for h in content.frfs]
    seen.bands[str(file)] = (min(float(f[0]) for f in lines), max(float(f[-1]) for f in lines))
    return Taken(file, f"{state} frfs", f"{len(pairs)} FRFs; {words}", sure)


@dataclass(frozen=True)
class _Draft:
    """A file of records before it is decided what it is taken for; ``forces``: rms of each force channel."""

    file: Path
    what: str
    forces: dict[str, float]
    responses: int


def _look_at_record(file: Path, content: Any, seen: Seen) -> _Draft:
    import numpy as np

    record = max(content.records, key=lambda r: r.data.size)
    timed = file.name not in seen.rateless
    if timed:
        seen.rates.add(record.sampling_hz)
        seen.held[str(file)] = held_band(record)
    record = labelled(record, seen)
    for channel in record.channels:
        if channel.name in seen.labels and "exclude" in seen.labels[channel.name]:
            continue
        if channel.dof is None or channel.quantity == "unknown":
            seen.unlabelled.setdefault(channel.name or f"channel {len(seen.unlabelled) + 1}", file.name)
        elif channel.unit == "":
            seen.unitless.setdefault(channel.quantity, set()).add(file.name)
    forces = {record.channels[i].label: float(np.sqrt(np.nanmean(np.square(record.data[i], dtype=float)))) for i in record.force_indices}
    for label, rms in forces.items():
        seen.loudest[label] = max(rms, seen.loudest.get(label, 0.0))
    if forces and record.response_indices and timed:
        band = excited_band(record)
        if band is not None:
            seen.bands[str(file)] = band
    length = f"{record.duration_s:.4g} s at {record.sampling_hz:.6g} Hz" if timed else f"{record.n_samples} samples without a sampling rate"
    what = f"{len(forces)} force and {len(record.response_indices)} response channels, {length}"
    return _Draft(file, what, forces, len(record.response_indices))


def _decide(draft: _Draft, folder: Path, seen: Seen) -> Taken:
    """What a file of records is taken for: by the forces in it, then by the names of file and folders."""
    file, what = draft.file, draft.what
    if draft.responses == 0:
        return Taken(file, "operating records", f"{what}: channels are not labelled; a guess", sure=False)
    driving = [label for label, rms in draft.forces.items() if rms > SILENT * seen.loudest[label]]
    if not driving:
        state, reason, _ = _state(file, folder, "operating")
        silent = "its force channels are silent" if draft.forces else "no force"
        if state == "operating":
            return Taken(file, "operating records", f"{what}; {silent}: {reason}")
        return Taken(file, "operating records", f"{what}; {silent}, though its name says {state}", sure=False)
    state, reason, sure = _state(file, folder, "idle")
    if state == "operating":
        return Taken(file, "check records", f"{what}; in operation and with force: it can validate the model", sure=False)
    return Taken(file, f"{state} records", f"{what}; {reason}", sure)


def _state(file: Path, folder: Path, default: str) -> tuple[str, str, bool]:
    """State by the words of folder and file names, the innermost first."""
    parts = [file.stem, *reversed(file.relative_to(folder).parts[:-1])]
    for part in parts:
        words = re.findall(r"[a-z]+", part.lower())
        for state, known in (("check", CHECK_WORDS), ("idle", IDLE_WORDS), ("operating", OPERATING_WORDS)):
            if any(word in known for word in words):
                return state, f"named {part!r}", True
    return default, f"no name says otherwise, taken as {default}", default == "operating"


def _notes(taken: Sequence[Taken], seen: Seen) -> list[str]:
    from operando.data import counted, names_text

    notes = [f"guessed: {guess}" for guess in seen.guesses]
    notes += [f"guessed: columns of {names[0].name} are {', '.join(columns)}" for columns, names in seen.columns.items()]
    unsure: dict[tuple[str, str], list[str]] = {}
    for one in taken:
        if not one.sure:
            unsure.setdefault((one.role, one.reason), []).append(one.file.name)
    for (role, reason), names in unsure.items():
        said = f"not used: {names_text(names)}" if role == "ignored" else f"unsure: {names_text(names)} taken as {role}"
        notes.append(f"{said}: {reason}")
    for quantity, files in sorted(seen.unitless.items()):
        notes.append(
            f"no unit of {quantity} in {counted(len(files), 'file')}: give it in [units]; without it there is no mass scaling, no FRF in SI"
        )
    if seen.lineless:
        notes.append(f"{', '.join(seen.lineless)}: the file states no frequencies: give [units] frequency_step_hz, nothing runs without")
    if seen.rateless:
        notes.append(f"{', '.join(seen.rateless[:4])}: no sampling rate is stated: give [units] sampling_hz, nothing runs without")
    for alike in seen.pairs.values():
        if len(alike) > 1:
            names = [file.name for file in alike]
            notes.append(
                f"{', '.join(names[:4])}{' …' if len(names) > 4 else ''} hold FRFs of the same DOFs: keep one, "
                "or move them into folders idle and check"
            )
    if seen.unlabelled:
        names = list(seen.unlabelled)
        shown = ", ".join(names[:6]) + (" …" if len(names) > 6 else "")
        notes.append(f"{len(names)} channels without DOF or quantity ({shown}): label them in [channels]")
    if len(seen.rates) > 1:
        notes.append("records of different sampling rates: " + ", ".join(f"{r:.6g} Hz" for r in sorted(seen.rates)))
    roles = {t.role.split()[0] for t in taken}
    for state, name, loss in (
        ("idle", "idle", "no scaled model, no operational FRFs"),
        ("operating", "operating", "idle modes only"),
        ("check", "validation", "nothing validates the result"),
    ):
        if state not in roles:
            notes.append(f"no {name} measurement: {loss}")
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
    with replacing(path, "w", encoding="utf-8") as stream:
        stream.write(made.text)
