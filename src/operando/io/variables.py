"""Arrays with names (MATLAB, NumPy): which are time histories, which FRFs, and what the names beside them say."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import QUANTITIES, Finding, FrequencyAxis, Frf, Provenance, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DataError, DofError, FormatError, UnitError
from operando.io.columns import NoLines, NoRate
from operando.io.content import Content, SetInfo
from operando.io.quantities import (
    ChannelSpecs,
    Units,
    find_spec,
    note_unused,
    possible_coherence,
    resolve,
    spec_dof,
    stated_hz,
    stated_rate,
)  # fmt: skip
from operando.io.sep005 import make_record
from operando.io.uff.increments import even_step, tidy_rate
from operando.io.uff.reader import provenance_of
from operando.printable import first_few
from operando.units import SI_UNIT

_RATE = re.compile(r"^(fs|f_s|freq|sampling_?(hz|freq\w*|rate)|sample_?rate|srate|sf|rate|fsamp)$", re.IGNORECASE)
_STEP = re.compile(r"^(dt|delta_?t|ts|time_?step|inc|increment)$", re.IGNORECASE)
_TIME = re.compile(r"^(t|time|tt|time_?axis|x_?time)$", re.IGNORECASE)
_FREQUENCY = re.compile(r"^(f|freq|freqs|frequency|frequencies|freq_?axis|hz|f_?axis)$", re.IGNORECASE)
_NAMES = re.compile(r"^(channels?|channel_?names?|names?|labels?)$", re.IGNORECASE)
_UNITS = re.compile(r"^(units?|unit_?str|channel_?units?)$", re.IGNORECASE)
_COHERENCE = re.compile(r"^C\d+_\d+$")
_SPECTRUM = re.compile(r"^(G|P|psd|asd|auto|spec|coh)", re.IGNORECASE)
_STRUCTURE = re.compile(r"^(nodes?|coord\w*|xyz|grid|geometry|points|lines|elements|faces)$", re.IGNORECASE)
"""Names of arrays that describe the structure: they lack no sampling rate."""
_SMALLEST = 8
RESPONSES = {"accelerance": "acceleration", "mobility": "velocity", "receptance": "displacement"}
"""FRF → quantity of its response."""


@dataclass(frozen=True)
class Variable:
    """One array or list of texts with its path (``structure.field``)."""

    path: str
    value: Any

    @property
    def name(self) -> str:
        return self.path.rsplit(".", 1)[-1]

    @property
    def home(self) -> str:
        """Path of the structure it stands in."""
        return self.path.rpartition(".")[0]


@dataclass
class Source:
    """A file with what all its variables say together, and what the user adds."""

    where: str
    variables: list[Variable]
    units: Units | None
    channels: ChannelSpecs | None
    provenance: Provenance

    def __post_init__(self) -> None:
        self.arrays = [v for v in self.variables if isinstance(v.value, np.ndarray)]
        self.names = texts_named(self.variables, _NAMES)
        self.unit_texts = texts_named(self.variables, _UNITS)
        self.rate = stated_rate(self.units, [])
        self.step = stated_hz(self.units, "frequency_step_hz")


def content_of(variables: list[Variable], path: Path, kind: str, units: Units | None, channels: ChannelSpecs | None) -> Content:
    """Records and FRFs among named arrays.

    A real matrix is a record, its long side time, with a rate from ``fs``, ``dt`` or a time vector; vectors of one length with the same
    time vector or rate beside them are the channels of one record; a matrix of two columns whose first increases evenly is a time
    history [time value] or, if complex, an FRF [frequency value]. Other complex arrays are FRFs with a frequency vector beside them.
    """
    source = Source(str(path), variables, units, channels, provenance_of(path))
    records: list[TimeRecord] = []
    frfs: list[Frf] = []
    findings: list[Finding] = []
    notes: dict[str, str] = {}
    lacking: NoLines | None = None
    broken: DataError | None = None
    rateless = False
    groups = Groups(source)
    for variable in source.arrays:
        value = np.squeeze(variable.value)
        try:
            named = _named_shape(value, variable, source)
            if named is None and not _is_data(value, variable):
                used = _is_axis(value, variable)
                notes[variable.path] = "" if used else "neither data nor an axis of data"
                continue
            notes[variable.path] = groups.take(value, variable) if named is None else "alone"
            if notes[variable.path] != "alone":
                continue
            if np.iscomplexobj(value):
                frf, found = _frf(value, named, variable, source)
                frfs.append(frf)
                findings += found
            else:
                records.append(_table_record(value, variable, source))
            notes[variable.path] = ""
        except (FormatError, DataError) as error:
            notes[variable.path] = error.message
            lacking = error if isinstance(error, NoLines) else lacking
            rateless |= isinstance(error, NoRate) and not _STRUCTURE.match(variable.name)
            broken = error if isinstance(error, DataError) and error.hint else broken
    for group, found in groups.frfs():
        frfs.append(group)
        findings += found
    records += groups.records()
    findings += [f for record in records for f in record.findings]
    infos = tuple(
        SetInfo(i, 0, f"{v.path} ({'×'.join(str(n) for n in v.value.shape)})", "ignored" if notes[v.path] else "used", notes[v.path])
        for i, v in enumerate(source.arrays)
    )
    if not records and not frfs and lacking is not None:
        raise NoLines(lacking.lines, str(path))
    if not records and not frfs and broken is not None:
        raise FormatError(broken.message, where=str(path), hint=broken.hint)
    if not records and not frfs:
        seen = "; ".join(f"{s.title}: {s.note}" for s in infos[:6]) or "no arrays"
        message, hint = f"no data with a time or frequency axis found ({seen})", "or save fs or a time vector beside the data"
        if rateless:
            raise NoRate(
                str(path),
                message,
                f"give the rate of the recorder in the test file, [units] sampling_hz (for example 1024, in Hz), {hint}",
            )
        raise FormatError(message, where=str(path), hint=f"give [units] sampling_hz, {hint}")
    return Content(str(path), kind, tuple(records), tuple(frfs), sets=infos, findings=tuple(findings))


class Groups:
    """Vectors that share an axis: the channels of one record, the responses of one FRF."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._vectors: dict[tuple[Any, ...], list[tuple[str, NDArray[Any]]]] = {}
        self._lines: dict[bytes, list[tuple[str, NDArray[Any]]]] = {}
        self._coherence: dict[str, NDArray[Any]] = {}

    def take(self, value: NDArray[Any], variable: Variable) -> str:
        """Take a vector or a pair of axis and values; ``alone`` if it is neither, else why it is not used (empty: it is)."""
        source = self.source
        if value.ndim == 1 and not np.iscomplexobj(value):
            sampling = _sampling(variable, source.arrays, value.size, source.rate)
            if sampling is None:
                return "no sampling rate or time vector beside it"
            self._vectors.setdefault((variable.home, *sampling, value.size), []).append((variable.name, value))
            return ""
        stated = not np.iscomplexobj(value) and _sampling(variable, source.arrays, max(value.shape), source.rate) is not None
        table = value.T if value.ndim == 2 and value.shape[1] == 2 else value
        if stated or value.ndim != 2 or table.shape[0] != 2 or not _is_even_axis(table[0]):
            return "alone"
        axis = np.real(table[0]).astype(float)
        if np.iscomplexobj(value):
            self._lines.setdefault(axis.tobytes(), []).append((variable.name, table[1]))
        elif _COHERENCE.match(variable.name):
            self._coherence[variable.name[1:]] = table[1]
        elif _SPECTRUM.match(variable.name):
            return "a spectrum without phase"
        else:
            sampling = _rate_of_axis(axis, variable.path)
            self._vectors.setdefault(("pairs", *sampling, axis.size), []).append((variable.name, table[1]))
        return ""

    def records(self) -> list[TimeRecord]:
        """One record for each axis."""
        out = []
        for (home, rate, start, _), rows in self._vectors.items():
            names = [name for name, _ in rows]
            stated = self.source.unit_texts.get(home, self.source.unit_texts.get("", []))
            labels = self.source.names.get(home, self.source.names.get("", []))
            units = stated if len(stated) == len(rows) else [""] * len(rows)
            title = first_few(names, 4)
            labels = labels if len(labels) == len(rows) else names
            out.append(_record(np.stack([row for _, row in rows]), labels, units, (rate, start), title, self.source))
        return out

    def frfs(self) -> list[tuple[Frf, list[Finding]]]:
        """One set of FRFs for each axis, with the coherence whose name differs in the first letter only (H1_2, C1_2)."""
        out = []
        for axis, rows in self._lines.items():
            names = [name for name, _ in rows]
            lines = np.frombuffer(axis)
            coherence = [self._coherence.get(name[1:]) for name in names]
            known = [c for c in coherence if c is not None and c.size == lines.size]
            stack = np.stack(known)[:, None] if len(known) == len(rows) else None
            table = np.stack([row for _, row in rows])[:, None]
            out.append(make_frf(table, lines, ", ".join(names[:4]), self.source, names, coherence=stack))
        return out


def _is_even_axis(values: NDArray[Any]) -> bool:
    """Whether numbers increase in even steps, to a hundredth of a step: what a clock or a frequency line does and no measurement."""
    if np.iscomplexobj(values) and np.any(values.imag != 0):
        return False
    axis = np.real(values).astype(float)
    if axis.size < _SMALLEST or not np.all(np.isfinite(axis)):
        return False
    step = (axis[-1] - axis[0]) / (axis.size - 1)
    return step > 0 and bool(np.max(np.abs(np.diff(axis) - step)) < 0.01 * step)


def _rate_of_axis(time: NDArray[np.float64], name: str) -> tuple[float, float]:
    """Rate [Hz] and start [s] of a time vector."""
    if not np.all(np.diff(time) > 0):
        raise FormatError(f"the time vector {name} does not increase")
    step, off = even_step(time)
    if off > 0.5:
        raise FormatError(f"the time vector {name} is not even")
    return tidy_rate(step), float(time[0])


def texts_named(variables: list[Variable], pattern: re.Pattern[str]) -> dict[str, list[str]]:
    """Lists of texts whose name matches, by the structure they stand in."""
    return {v.home: v.value for v in variables if isinstance(v.value, list) and pattern.match(v.name)}


def _beside(variable: Variable, arrays: list[Variable], pattern: re.Pattern[str], test: Any) -> Variable | None:
    """An axis for some data: in the same structure first, then at the top."""
    for place in dict.fromkeys((variable.home, "")):
        for other in arrays:
            if other.home == place and pattern.match(other.name) and other is not variable and test(np.ravel(other.value)):
                return other
    return None


def _sampling(variable: Variable, arrays: list[Variable], samples: int, rate: float | None) -> tuple[float, float] | None:
    """Rate and start of data with so many samples."""
    if rate:
        return rate, 0.0
    positive = lambda v: v.size == 1 and np.isrealobj(v) and float(v[0]) > 0  # noqa: E731
    start = _beside(variable, arrays, re.compile(r"^(start|t0|start_s)$"), lambda v: v.size == 1)
    start_s = 0.0 if start is None else float(np.ravel(start.value)[0])
    found = _beside(variable, arrays, _RATE, positive)
    if found is not None:
        return float(np.ravel(found.value)[0]), start_s
    found = _beside(variable, arrays, _STEP, positive)
    if found is not None:
        return tidy_rate(float(np.ravel(found.value)[0])), start_s
    found = _beside(variable, arrays, _TIME, lambda v: v.size == samples and samples > 1)
    if found is not None:
        return _rate_of_axis(np.ravel(found.value).astype(float), found.path)
    return None


def _is_axis(value: NDArray[Any], variable: Variable) -> bool:
    return value.ndim <= 1 and any(p.match(variable.name) for p in (_RATE, _STEP, _TIME, _FREQUENCY, re.compile("^(start|t0|start_s|si)$")))


def _is_data(value: NDArray[Any], variable: Variable) -> bool:
    if value.ndim == 0 or value.ndim > 3 or max(value.shape) < _SMALLEST or value.dtype.kind not in "fciu":
        return False
    if value.ndim == 1 and not np.iscomplexobj(value) and any(p.match(variable.name) for p in (_TIME, _FREQUENCY, _RATE)):
        return False
    return np.iscomplexobj(value) or value.ndim <= 2


def _record(value: NDArray[Any], labels: Sequence[str], unit_texts: Sequence[str], sampling: tuple[float, float], name: str,
            source: Source) -> TimeRecord:  # fmt: skip
    """Record of (n_channels, n_samples) numbers; float32 holds the samples of 16-bit converters exactly."""
    small = value.dtype == np.float32 or (value.dtype.kind in "iu" and value.dtype.itemsize <= 2)
    data = np.ascontiguousarray(value, np.float32 if small else np.float64)
    record = make_record(data, sampling[0], labels, unit_texts, start_s=sampling[1], units=source.units, channels=source.channels,
                         source=source.where, provenance=source.provenance)  # fmt: skip
    return replace(record, name=f"{source.where}:{name}")


def _channels_first(value: NDArray[Any], variable: Variable, source: Source) -> bool:
    """Whether the rows of a matrix are channels: by a time vector, or names or units of the channels, that fit one side alone."""
    rows, columns = value.shape
    home = variable.home
    for fits in (
        lambda n: _beside(variable, source.arrays, _TIME, lambda v: v.size == n) is not None,
        lambda n: len(source.names.get(home, source.names.get("", []))) != n,
        lambda n: len(source.unit_texts.get(home, source.unit_texts.get("", []))) != n,
    ):
        if fits(rows) != fits(columns):
            return bool(fits(columns))
    return rows < columns


def _table_record(value: NDArray[Any], variable: Variable, source: Source) -> TimeRecord:
    """Record of one matrix: what stands beside it says which side is the time, else it is the long one."""
    table = value if _channels_first(value, variable, source) else value.T
    sampling = _sampling(variable, source.arrays, table.shape[1], source.rate)
    if sampling is None:
        raise NoRate(source.where, "no sampling rate or time vector beside it")
    found = source.names.get(variable.home, source.names.get("", []))
    labels = found if len(found) == len(table) else [variable.name if len(table) == 1 else f"ch{i + 1}" for i in range(len(table))]
    stated = source.unit_texts.get(variable.home, source.unit_texts.get("", []))
    return _record(table, labels, stated if len(stated) == len(table) else [""] * len(table), sampling, variable.path, source)


def _named_shape(value: NDArray[Any], variable: Variable, source: Source) -> tuple[int, int, int] | None:
    """Lines, responses and references of complex numbers in that order, where the file names the latter two beside a frequency vector."""
    counts = [len(texts_named(source.variables, re.compile(f"^{n}$")).get(variable.home, [])) for n in ("responses", "references")]
    if not np.iscomplexobj(value) or not all(counts):
        return None
    shape = (value.size // (counts[0] * counts[1]), counts[0], counts[1])
    vector = _beside(variable, source.arrays, _FREQUENCY, lambda v: v.size == shape[0])
    return shape if vector is not None and value.shape == tuple(n for n in shape if n > 1) else None


def _frf(value: NDArray[Any], named: tuple[int, int, int] | None, variable: Variable, source: Source) -> tuple[Frf, list[Finding]]:
    """FRFs of an array: as the file names its sides, else with the longest one for the lines."""
    side = 0 if named is not None else int(np.argmax(value.shape))
    table = np.moveaxis(value if named is None else value.reshape(named), side, -1)
    frequencies = _frequencies(variable, source, table.shape[-1])
    table = table[:, None] if table.ndim == 2 else table.reshape((1,) * (3 - table.ndim) + table.shape)
    responses = _stated_dofs(variable, source.variables, "responses", table.shape[0])
    references = _stated_dofs(variable, source.variables, "references", table.shape[1])
    stated = texts_named(source.variables, re.compile("^quantity$")).get(variable.home, [""])[0]
    si = stated in QUANTITIES and _flag(variable, source.arrays, "si")
    if si:
        note_unused_si(source.units, stated, variable.path)
    names = [""] * len(table) if len(table) > 1 else [variable.name]
    return make_frf(table, frequencies, variable.path, source, names, responses, references, stated, si)


def note_unused_si(units: Units | None, quantity: str, name: str) -> None:
    """Note the entries of [units] for motion and force of FRFs that a file holds in SI."""
    for part in (RESPONSES.get(quantity, ""), "force"):
        note_unused(units, part, SI_UNIT.get(part, ""), 1.0, name)


def make_frf(table: NDArray[Any], frequencies: NDArray[Any], title: str, source: Source, names: Sequence[str],
             responses: tuple[Dof, ...] | None = None, references: tuple[Dof, ...] | None = None, stated: str = "", si: bool = False,
             coherence: NDArray[Any] | None = None) -> tuple[Frf, list[Finding]]:  # fmt: skip
    """FRFs of an array (responses, references, lines), and what is not known of them.

    ``title`` is their name in findings, ``names`` those of the responses in the file, ``stated`` the quantity where the file names it;
    ``si`` whether the numbers are in SI already.
    """
    findings: list[Finding] = []
    channels = source.channels
    known = None if responses is None else list(responses)
    specs = [find_spec(channels, names[i], known[i] if known else None, False, i) for i in range(table.shape[0])]
    keep = [i for i, spec in enumerate(specs) if not spec.get("exclude")]
    if not keep:
        raise DataError("no response is left", where=source.where, hint="[channels] excludes them all")
    force = find_spec(channels, "force", None, True)
    unlabelled = known is None and any(not specs[i].get("dof") for i in keep)
    if unlabelled or (references is None and not force.get("dof")):
        findings.append(_missing_dof(title, source.where, unlabelled))
    dofs = tuple(spec_dof(specs[i], known[i] if known else Dof(i + 1)) or Dof(i + 1) for i in keep)
    if references is None:
        given = spec_dof(force, None)
        references = (given or Dof(0),) if table.shape[1] == 1 else tuple(Dof(1001 + j) for j in range(table.shape[1]))
    if si:
        data, quantity = table[keep], stated
    else:
        kind = RESPONSES.get(stated, "acceleration")
        data, quantity, si = _scaled(table[keep], [specs[i] for i in keep], kind, source.units, channels)
    if not si:
        findings.append(_missing_unit(title, quantity, source.where))
    coherence, wrong = possible_coherence(None if coherence is None else coherence[keep], source.where)
    findings += wrong
    frf = Frf(data, FrequencyAxis(frequencies), dofs, references, quantity, coherence=coherence, si=si,
              name=f"{source.where}:{title}", provenance=source.provenance)  # fmt: skip
    return frf, findings


def _stated_dofs(variable: Variable, variables: list[Variable], name: str, count: int) -> tuple[Dof, ...] | None:
    """DOFs named by a list of labels beside the data."""
    labels = texts_named(variables, re.compile(f"^{name}$")).get(variable.home, [])
    if len(labels) != count:
        return None
    try:
        return tuple(Dof.parse(label) for label in labels)
    except DofError:
        return None


def _flag(variable: Variable, arrays: list[Variable], name: str) -> bool:
    found = _beside(variable, arrays, re.compile(f"^{name}$"), lambda v: v.size == 1)
    return found is not None and bool(np.ravel(found.value)[0])


def _scaled(table: NDArray[Any], specs: list[Any], quantity: str, units: Units | None,
            channels: ChannelSpecs | None) -> tuple[NDArray[Any], str, bool]:  # fmt: skip
    """FRFs in SI where response and force units are known; numbers kept where not."""
    scales = [resolve(quantity, "", units, spec) for spec in specs]
    force = resolve("force", "", units, find_spec(channels, "force", None, True))
    kinds = {s.quantity for s in scales}
    if len(kinds) != 1 or next(iter(kinds)) not in RESPONSES.values():
        raise ConfigError(f"one FRF array cannot represent {', '.join(sorted(kinds)) or 'nothing'}", where="[channels]")
    name = {v: k for k, v in RESPONSES.items()}[kinds.pop()]
    if not (force.known and all(s.known for s in scales)):
        return np.asarray(table, complex), name, False
    return table * (np.array([s.factor for s in scales]) / force.factor)[:, None, None], name, True


def _missing_dof(path: str, where: str, responses: bool) -> Finding:
    """The finding where the responses, or else the force alone, have no DOF."""
    what = "the file names no DOFs; responses are 1, 2, …, references 0 (or 1001, 1002, …)"
    action = 'give them in [channels]: "ch1" = {dof = "12+Z"}, and "force" = {dof = "12+Z"} where the force acts'
    if not responses:
        what, action = "where the force acts is not said; the reference is called 0", 'give it in [channels]: "force" = {dof = "12+Z"}'
    return Finding(
        "missing_dof", f"{path}: {what}", "warning", where,
        consequence="shapes cannot be drawn, drive points are not known" if responses else "drive points are not known, modes get no scale",
        action=action,
    )  # fmt: skip


def _missing_unit(path: str, quantity: str, where: str) -> Finding:
    return Finding(
        "missing_unit", f"{path}: the file states no units; taken as {quantity}", "warning", where,
        consequence="frequencies and damping can be found, the scaling to unit modal mass cannot",
        action='give them in the test file: [units] acceleration = "…", force = "…"',
    )  # fmt: skip


def _frequencies(variable: Variable, source: Source, lines: int) -> NDArray[np.float64]:
    """Frequency lines [Hz]: the vector beside the data, else from 0 in the step or up to half the rate that file or user states."""
    vector = _beside(variable, source.arrays, _FREQUENCY, lambda v: v.size == lines)
    if vector is not None:
        return np.ravel(vector.value).astype(float)
    if source.step is not None:
        return np.asarray(source.step * np.arange(lines), np.float64)
    try:
        sampling = _sampling(variable, source.arrays, lines, source.rate)
    except (FormatError, UnitError):
        sampling = None
    if sampling is None:
        raise NoLines(lines)
    return np.asarray(sampling[0] / (2 * (lines - 1)) * np.arange(lines), np.float64)
