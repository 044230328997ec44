"""MATLAB files: versions 5 to 7, and 7.3 through h5py; data found by their shape and the names beside them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import QUANTITIES, Finding, FrequencyAxis, Frf, Provenance, TimeRecord
from operando.dof import Dof
from operando.errors import ConfigError, DataError, DofError, FormatError, OperandoError, UnitError
from operando.io.atomic import replacing
from operando.io.content import Content, SetInfo
from operando.io.csv import stated_rate
from operando.io.mat5 import read_mat5
from operando.io.quantities import ChannelSpecs, Units, find_spec, resolve, spec_dof
from operando.io.safe import opened_hdf5
from operando.io.sep005 import make_record
from operando.io.uff.increments import restore_step_of_values, tidy_rate
from operando.io.uff.reader import open_file, quick_hash

_RATE = re.compile(r"^(fs|f_s|freq|sampling_?(hz|freq\w*|rate)|sample_?rate|srate|sf|rate|fsamp)$", re.IGNORECASE)
_STEP = re.compile(r"^(dt|delta_?t|ts|time_?step|inc|increment)$", re.IGNORECASE)
_TIME = re.compile(r"^(t|time|tt|time_?axis|x_?time)$", re.IGNORECASE)
_FREQUENCY = re.compile(r"^(f|freq|freqs|frequency|frequencies|freq_?axis|hz|f_?axis)$", re.IGNORECASE)
_NAMES = re.compile(r"^(channels?|channel_?names?|names?|labels?)$", re.IGNORECASE)
_UNITS = re.compile(r"^(units?|unit_?str|channel_?units?)$", re.IGNORECASE)
_SMALLEST = 8
_RESPONSES = {"accelerance": "acceleration", "mobility": "velocity", "receptance": "displacement"}


@dataclass(frozen=True)
class _Variable:
    """One array or list of texts with its path (``struct.field``)."""

    path: str
    value: Any

    @property
    def name(self) -> str:
        return self.path.rsplit(".", 1)[-1]


def read_matlab(path: str | Path, *, units: Units | None = None, channels: ChannelSpecs | None = None) -> Content:
    """Read time histories and transfer functions of a MATLAB file.

    Real matrices longer than 8 are time histories (long side time), with a rate from ``fs``, ``dt`` or a time vector of the same
    length; complex ones are FRFs, with lines from a frequency vector or from the rate (a one-sided spectrum). What was taken for
    what stands in ``Content.sets``; what is not known (DOFs, units) in ``Content.findings``.

    Raises
    ------
    FormatError
        If the file is damaged, or no data with a time or frequency axis are found.
    """
    path = Path(path)
    where = str(path)
    variables = [v for v in read_variables(path) if v.value is not None]
    provenance = Provenance(((where, quick_hash(path)),), (f"read {path.name}",))
    arrays = [v for v in variables if isinstance(v.value, np.ndarray)]
    names, texts = _texts(variables, _NAMES), _texts(variables, _UNITS)
    rate = stated_rate(units, [])
    records: list[TimeRecord] = []
    frfs: list[Frf] = []
    findings: list[Finding] = []
    infos: list[SetInfo] = []
    for i, variable in enumerate(arrays):
        made: Any = None
        note = "neither data nor an axis of data"
        value = np.squeeze(variable.value)
        if _is_data(value, variable, arrays):
            try:
                if np.iscomplexobj(value):
                    made, notes = _frf(value, variable, variables, rate, units, channels, where, provenance)
                    frfs.append(made)
                    findings += notes
                else:
                    made = _record(value, variable, arrays, rate, names, texts, units, channels, where, provenance)
                    records.append(made)
                    findings += made.findings
            except (FormatError, DataError) as error:
                note = error.message
        elif _is_axis(value, variable):
            made, note = True, ""
        shape = "×".join(str(n) for n in variable.value.shape)
        infos.append(
            SetInfo(i, 0, f"{variable.path} ({shape})", "used" if made is not None else "ignored", "" if made is not None else note)
        )
    if not records and not frfs:
        seen = "; ".join(f"{s.title}: {s.note}" for s in infos[:6]) or "no arrays"
        raise FormatError(
            f"no data with a time or frequency axis found ({seen})", where=where,
            hint="give [units] sampling_hz, or save fs or a time vector beside the data",
        )  # fmt: skip
    return Content(where, "matlab", tuple(records), tuple(frfs), sets=tuple(infos), findings=tuple(findings))


def write_matlab(path: str | Path, *objects: TimeRecord | Frf) -> None:
    """Write records (``data`` samples × channels, ``fs``, ``channel_names``, ``units``) and FRFs (``H`` lines × responses × references).

    Raises
    ------
    DataError
        If an object is neither record nor FRF.
    """
    from scipy.io import savemat

    variables: dict[str, Any] = {}
    for i, obj in enumerate(objects):
        if isinstance(obj, TimeRecord):
            names = [c.label or f"ch{k + 1}" for k, c in enumerate(obj.channels)]
            item: dict[str, Any] = {"data": obj.data.T, "fs": obj.sampling_hz, "start": obj.start_s}
            item |= {"channel_names": np.array(names, dtype=object), "units": np.array([c.unit for c in obj.channels], dtype=object)}
            variables[f"record{i + 1}"] = item
        elif isinstance(obj, Frf):
            item = {"H": np.moveaxis(obj.data, 2, 0), "frequency": obj.frequencies_hz, "quantity": obj.quantity, "si": obj.si}
            item |= {"responses": np.array([str(d) for d in obj.responses], dtype=object)}
            item |= {"references": np.array([str(d) for d in obj.references], dtype=object)}
            variables[f"frf{i + 1}"] = item
        else:
            raise DataError(f"{type(obj).__name__} is not written to MATLAB files", hint="records and FRFs are")
    with replacing(path) as stream:
        savemat(stream, variables, do_compression=False, oned_as="column")  # type: ignore[arg-type]


def read_variables(path: Path) -> list[_Variable]:
    """Arrays and lists of texts of a file, each with its path (``structure.field``), of any version from 5 on."""
    with open_file(path) as stream:
        version73 = stream.read(19).startswith(b"MATLAB 7.3")
    try:
        if version73:
            with opened_hdf5(path) as file:
                return list(_walk_hdf5(file, "", file))
        loaded = read_mat5(path)
    except OperandoError:
        raise
    except Exception as error:  # h5py and SciPy raise errors of many kinds on damaged files
        raise FormatError(f"the MATLAB file cannot be read: {error}", where=str(path)) from error
    return [v for name, value in loaded.items() for v in _walk(value, name)]


def _walk(value: Any, path: str) -> Iterator[_Variable]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _walk(item, f"{path}.{name}")
    elif isinstance(value, str):
        yield _Variable(path, [value])
    elif (isinstance(value, np.ndarray) and value.dtype.kind in "OU") or isinstance(value, list):
        items = value if isinstance(value, list) else np.ravel(value).tolist()
        items = ["" if isinstance(item, np.ndarray) and item.dtype.kind == "U" and not item.size else item for item in items]
        if items and all(isinstance(item, str) for item in items):
            yield _Variable(path, [str(item) for item in items])
        else:
            for i, item in enumerate(items):
                if isinstance(item, dict | np.ndarray):
                    yield from _walk(item, f"{path}{i}")
    elif isinstance(value, int | float | complex | np.number):
        yield _Variable(path, np.atleast_1d(np.asarray(value)))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufc":
        yield _Variable(path, value)


def _walk_hdf5(group: Any, path: str, file: Any) -> Iterator[_Variable]:
    import h5py

    for name, item in group.items():
        if name.startswith("#"):
            continue
        here = f"{path}.{name}" if path else str(name)
        if isinstance(item, h5py.Group):
            yield from _walk_hdf5(item, here, file)
        elif isinstance(item, h5py.Dataset):
            kind = item.attrs.get("MATLAB_class", b"")
            if kind == b"char":
                yield _Variable(here, [_characters(item)])
            elif kind == b"cell":
                cells = [file[ref] for ref in np.ravel(item[()]) if isinstance(ref, h5py.Reference)]
                chars = [c for c in cells if c.attrs.get("MATLAB_class", b"") == b"char"]
                if len(chars) == len(cells):
                    yield _Variable(here, [_characters(cell) for cell in chars])
            elif item.dtype.names == ("real", "imag"):
                raw = item[()]
                yield _Variable(here, (raw["real"] + 1j * raw["imag"]).T)
            elif item.dtype.kind in "biuf":
                yield _Variable(here, np.asarray(item[()]).T)


def _characters(item: Any) -> str:
    """Text of a dataset of UTF-16 code units; an empty text is stored as its size, two whole numbers of 64 bits."""
    units = np.ravel(item[()])
    return units[units != 0].astype("<u2").tobytes().decode("utf-16-le", "replace") if units.dtype == np.uint16 else ""


def _texts(variables: list[_Variable], pattern: re.Pattern[str]) -> dict[str, list[str]]:
    """Lists of texts whose name matches, by the structure they stand in."""
    return {v.path.rpartition(".")[0]: v.value for v in variables if isinstance(v.value, list) and pattern.match(v.name)}


def _beside(variable: _Variable, arrays: list[_Variable], pattern: re.Pattern[str], test: Any) -> _Variable | None:
    """An axis for some data: in the same structure first, then at the top."""
    home = variable.path.rpartition(".")[0]
    for place in dict.fromkeys((home, "")):
        for other in arrays:
            if (
                other.path.rpartition(".")[0] == place
                and pattern.match(other.name)
                and other is not variable
                and test(np.ravel(other.value))
            ):
                return other
    return None


def _sampling(variable: _Variable, arrays: list[_Variable], samples: int, rate: float | None) -> tuple[float, float] | None:
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
        time = np.ravel(found.value).astype(float)
        if not np.all(np.diff(time) > 0):
            raise FormatError(f"the time vector {found.path} does not increase")
        step = restore_step_of_values(float(time[0]), float(time[-1]), time.size)
        if float(np.max(np.abs(time - time[0] - step * np.arange(time.size)))) > 0.5 * step:
            raise FormatError(f"the time vector {found.path} is not even")
        return tidy_rate(step), float(time[0])
    return None


def _is_axis(value: NDArray[Any], variable: _Variable) -> bool:
    return value.ndim <= 1 and any(p.match(variable.name) for p in (_RATE, _STEP, _TIME, _FREQUENCY, re.compile("^(start|t0|start_s)$")))


def _is_data(value: NDArray[Any], variable: _Variable, arrays: list[_Variable]) -> bool:
    if value.ndim == 0 or value.ndim > 3 or max(value.shape) < _SMALLEST or value.dtype.kind not in "fciu":
        return False
    if value.ndim == 1 and not np.iscomplexobj(value) and any(p.match(variable.name) for p in (_TIME, _FREQUENCY, _RATE)):
        return False
    return np.iscomplexobj(value) or value.ndim <= 2


def _record(value: NDArray[Any], variable: _Variable, arrays: list[_Variable], rate: float | None, names: dict[str, list[str]],
            texts: dict[str, list[str]], units: Units | None, channels: ChannelSpecs | None, where: str,
            provenance: Provenance) -> TimeRecord:  # fmt: skip
    table = value[None, :] if value.ndim == 1 else (value.T if value.shape[0] >= value.shape[1] else value)
    sampling = _sampling(variable, arrays, table.shape[1], rate)
    if sampling is None:
        raise FormatError("no sampling rate or time vector beside it")
    home = variable.path.rpartition(".")[0]
    found = names.get(home, names.get("", []))
    labels = found if len(found) == len(table) else [variable.name if len(table) == 1 else f"ch{i + 1}" for i in range(len(table))]
    stated = texts.get(home, texts.get("", []))
    unit_texts = stated if len(stated) == len(table) else [""] * len(table)
    data = np.ascontiguousarray(table, np.float32 if table.dtype == np.float32 else np.float64)
    record = make_record(data, sampling[0], labels, unit_texts, start_s=sampling[1], units=units, channels=channels, source=where,
                         provenance=provenance)  # fmt: skip
    return replace(record, name=f"{where}:{variable.path}")


def _frf(value: NDArray[Any], variable: _Variable, variables: list[_Variable], rate: float | None, units: Units | None,
         channels: ChannelSpecs | None, where: str, provenance: Provenance) -> tuple[Frf, list[Finding]]:  # fmt: skip
    arrays = [v for v in variables if isinstance(v.value, np.ndarray)]
    side = int(np.argmax(value.shape))
    frequencies = _frequencies(variable, arrays, value.shape[side], rate)
    table = np.moveaxis(value, side, -1)
    table = table[:, None] if table.ndim == 2 else table.reshape((1,) * (3 - table.ndim) + table.shape)
    responses = _stated_dofs(variable, variables, "responses", table.shape[0])
    references = _stated_dofs(variable, variables, "references", table.shape[1])
    findings: list[Finding] = []
    if responses is None or references is None:
        findings.append(_missing_dof(variable.path, where))
        responses = tuple(Dof(i + 1) for i in range(table.shape[0]))
        references = (Dof(0),) if table.shape[1] == 1 else tuple(Dof(1001 + j) for j in range(table.shape[1]))
    specs = [find_spec(channels, "", dof if dof.axis else None, False, i) for i, dof in enumerate(responses)]
    keep = [i for i, spec in enumerate(specs) if not spec.get("exclude")]
    home = variable.path.rpartition(".")[0]
    stated = _texts(variables, re.compile("^quantity$")).get(home, [""])[0]
    if stated in QUANTITIES and _flag(variable, arrays, "si"):
        data, quantity, si = table[keep], stated, True
    else:
        data, quantity, si = _scaled(table[keep], [specs[i] for i in keep], _RESPONSES.get(stated, "acceleration"), units, channels)
    if not si:
        findings.append(_missing_unit(variable.path, quantity, where))
    dofs = tuple(spec_dof(specs[i], responses[i]) or responses[i] for i in keep)
    name = f"{where}:{variable.path}"
    return Frf(data, FrequencyAxis(frequencies), dofs, references, quantity, si=si, name=name, provenance=provenance), findings


def _stated_dofs(variable: _Variable, variables: list[_Variable], name: str, count: int) -> tuple[Dof, ...] | None:
    """DOFs named by a list of labels beside the data."""
    labels = _texts(variables, re.compile(f"^{name}$")).get(variable.path.rpartition(".")[0], [])
    if len(labels) != count:
        return None
    try:
        return tuple(Dof.parse(label) for label in labels)
    except DofError:
        return None


def _flag(variable: _Variable, arrays: list[_Variable], name: str) -> bool:
    found = _beside(variable, arrays, re.compile(f"^{name}$"), lambda v: v.size == 1)
    return found is not None and bool(np.ravel(found.value)[0])


def _scaled(table: NDArray[Any], specs: list[Any], quantity: str, units: Units | None,
            channels: ChannelSpecs | None) -> tuple[NDArray[Any], str, bool]:  # fmt: skip
    """FRFs in SI where response and force units are known; numbers kept where not."""
    scales = [resolve(quantity, "", units, spec) for spec in specs]
    force = resolve("force", "", units, find_spec(channels, "force", None, True))
    kinds = {s.quantity for s in scales}
    if len(kinds) != 1 or next(iter(kinds)) not in _RESPONSES.values():
        raise ConfigError(f"one FRF array cannot hold {', '.join(sorted(kinds)) or 'nothing'}", where="[channels]")
    name = {v: k for k, v in _RESPONSES.items()}[kinds.pop()]
    if not (force.known and all(s.known for s in scales)):
        return np.asarray(table, complex), name, False
    return table * (np.array([s.factor for s in scales]) / force.factor)[:, None, None], name, True


def _missing_dof(path: str, where: str) -> Finding:
    return Finding(
        "missing_dof", f"{path}: the file names no DOFs; responses are 1, 2, …, references 0 (or 1001, 1002, …)", "warning", where,
        consequence="shapes cannot be drawn, drive points are not known", action='give them in [channels]: "ch1" = {dof = "12+Z"}',
    )  # fmt: skip


def _missing_unit(path: str, quantity: str, where: str) -> Finding:
    return Finding(
        "missing_unit", f"{path}: the file states no units; taken as {quantity}", "warning", where,
        consequence="frequencies and damping can be found, the scaling to unit modal mass cannot",
        action='give them in the test file: [units] acceleration = "…", force = "…"',
    )  # fmt: skip


def _frequencies(variable: _Variable, arrays: list[_Variable], lines: int, rate: float | None) -> NDArray[np.float64]:
    vector = _beside(variable, arrays, _FREQUENCY, lambda v: v.size == lines)
    if vector is not None:
        return np.ravel(vector.value).astype(float)
    try:
        sampling = _sampling(variable, arrays, lines, rate)
    except (FormatError, UnitError):
        sampling = None
    if sampling is None:
        raise FormatError("no frequency vector and no sampling rate beside it")
    return np.asarray(sampling[0] / (2 * (lines - 1)) * np.arange(lines), np.float64)
