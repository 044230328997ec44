"""The test file: what was measured, where the files lie, how it is analysed."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from operando.dof import Dof
from operando.errors import ConfigError, DofError, UnitError
from operando.io.columns import check_columns
from operando.states import Span as Span
from operando.states import State as State
from operando.states import check_keys, find_files, is_number, record_named, state_of
from operando.units import SI_UNIT, parse_unit

ESTIMATORS = ("auto", "h1", "h2", "hv", "lrm", "periodic")
HITS = ("auto", "all", "off")
EMA_ANSWERS = ("auto", "linear", "polished")
SCALINGS = ("auto", "msf_all", "eq13", "eq15", "eq20", "idle_shapes")
_CHANNEL_KEYS = ("dof", "quantity", "unit", "sensitivity", "exclude", "reason")


@dataclass(frozen=True)
class Analysis:
    """Settings of the analysis; every one has a default, and the ones used are stated in every output.

    Parameters
    ----------
    band : (float, float) or None
        Analysis band [Hz]; None: chosen from the data.
    block_seconds, overlap, window, estimator : optional
        Block length [s], overlap (0 ≤ overlap < 1), window name, and ``h1``, ``h2``, ``hv``, ``lrm`` or ``periodic`` of the FRF
        estimate (None: chosen from the force and the length of the records).
    hits : str
        Hammer records: ``auto`` (consistent single hits), ``all``, or ``off`` (a record is taken as continuous).
    hits_reject : tuple of str
        Hits not to be used, as ``FILE#NUMBER``: numbers from 0, as in the findings, the inventory and the report.
    references : tuple of str or None
        Force DOFs to use (None: all).
    max_order : int or None
        Largest model order of the EMA.
    ema : {"auto", "linear", "polished"}
        Which answer of the EMA to give.
    modes_hz : tuple of float
        Exactly these idle modes [Hz].
    select_hz, reject_hz : tuple of float
        Idle modes besides the automatic ones, and automatic ones to leave out, by hand [Hz].
    threshold : float
        MAC from which an operational mode counts as unchanged.
    scaling : str
        Scaling method.
    known_harmonics_hz : tuple of float
        Rotor orders and other harmonics of the operating state [Hz].
    exclude_bands : tuple of (float, float)
        Bands [Hz] that neither fit nor comparison use.
    kinds, places : tuple of str or None
        What the diagnosis may look for, and where (None: everything, everywhere).
    oma_max_order, oma_references, oma_select_hz, oma_reject_hz : optional
        The same for the operational modes: largest order, reference channels, modes by hand [Hz].
    second_opinion : bool
        Whether sdypy-EMA and pyOMA-2 are asked as well.
    """

    band: tuple[float, float] | None = None
    block_seconds: float | None = None
    overlap: float | None = None
    window: str | None = None
    estimator: str | None = None
    hits: str = "auto"
    hits_reject: tuple[str, ...] = ()
    references: tuple[str, ...] | None = None
    max_order: int | None = None
    ema: str = "auto"
    modes_hz: tuple[float, ...] = ()
    select_hz: tuple[float, ...] = ()
    reject_hz: tuple[float, ...] = ()
    threshold: float = 0.7
    scaling: str = "auto"
    known_harmonics_hz: tuple[float, ...] = ()
    exclude_bands: tuple[tuple[float, float], ...] = ()
    kinds: tuple[str, ...] | None = None
    places: tuple[str, ...] | None = None
    oma_max_order: int | None = None
    oma_references: tuple[str, ...] | None = None
    oma_select_hz: tuple[float, ...] = ()
    oma_reject_hz: tuple[float, ...] = ()
    second_opinion: bool = False

    def to_dict(self) -> dict[str, Any]:
        """All settings with defaults, as JSON values."""
        return {key: _plain(value) for key, value in asdict(self).items()}


@dataclass(frozen=True)
class Test:
    """One test: the files of each state, units and channels where the files are silent, settings.

    Parameters
    ----------
    name : str
    path : Path or None
        The test file (None for a test made in Python).
    idle, operating, check : State
    geometry_file : Path or None
    geometry_units : str or None
        Unit of the coordinates where the file does not say.
    units : dict
        Quantity → unit, used where a file is silent; ``length`` for coordinates, ``sampling_hz`` for tables without a time column.
    channels : dict
        Channel name or DOF → dict of ``dof, quantity, unit, sensitivity, exclude, reason``.
    analysis : Analysis
    directions : dict
        DOF in its positive sense → unit vector in the geometry's frame, for DOFs that are no axes.
    """

    __test__: ClassVar[bool] = False  # not a test class, whatever its name suggests to a collector

    name: str
    path: Path | None = None
    idle: State = field(default_factory=State)
    operating: State = field(default_factory=State)
    check: State = field(default_factory=State)
    geometry_file: Path | None = None
    geometry_units: str | None = None
    units: dict[str, Any] = field(default_factory=dict)
    channels: dict[str, dict[str, Any]] = field(default_factory=dict)
    analysis: Analysis = field(default_factory=Analysis)
    directions: dict[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def files(self) -> tuple[Path, ...]:
        """All files the test names, each once."""
        extra = () if self.geometry_file is None else (self.geometry_file,)
        return tuple(dict.fromkeys((*self.idle.files, *self.operating.files, *self.check.files, *extra)))

    @property
    def parts(self) -> tuple[tuple[Path, Span | None], ...]:
        """All files with the part of each that counts, each once: a file of which two parts are used stands there twice."""
        named = [run for s in self.states.values() for run in (*s.runs, *((file, None) for file in s.frfs))]
        have = {file for file, _ in named}
        return tuple(dict.fromkeys((*named, *((file, None) for file in self.files if file not in have))))

    @property
    def states(self) -> dict[str, State]:
        """The three states by name."""
        return {"idle": self.idle, "operating": self.operating, "check": self.check}

    def label(self, file: Path, span: Span | None = None) -> str:
        """Name of a file in all outputs: relative to the test file where it lies below it; with the span where several parts are used."""
        folder = None if self.path is None else self.path.parent
        name = file.relative_to(folder).as_posix() if folder is not None and file.is_relative_to(folder) else file.name
        if span is not None and len({part for state in self.states.values() for path, part in state.runs if path == file}) > 1:
            return f"{name} ({span})"
        return name

    def settings(self) -> dict[str, Any]:
        """Settings as exported with every output: those of [analysis] with defaults, what else is given, parts of records."""
        given: dict[str, Any] = {"units": dict(self.units), "channels": {k: dict(v) for k, v in self.channels.items()}}
        given["directions"] = {k: list(v) for k, v in self.directions.items()}
        parts = [
            {"state": name, "file": self.label(file), "start_s": span.start_s, "stop_s": span.stop_s}
            for name, state in self.states.items()
            for file, span in state.runs
            if span is not None
        ]
        return self.analysis.to_dict() | given | {"parts_of_records": parts}

    def rejected_hits(self, state: State) -> tuple[str, ...]:
        """``[analysis] hits_reject`` as far as it names records of a state, each file by its label.

        Raises
        ------
        ConfigError
            If a name is no record of [idle] or [check]; the nearest one is named.
        """
        labels = {self.label(*run) for s in (self.idle, self.check) for run in s.runs}
        mine = {self.label(*run) for run in state.runs}
        out = []
        for text in self.analysis.hits_reject:
            file, _, number = text.rpartition("#")
            name = record_named(file, labels, f"{self.path or 'test'} [analysis] hits_reject")
            if name in mine:
                out.append(f"{name}#{int(number)}")
        return tuple(dict.fromkeys(out))

    def with_analysis(self, **changes: Any) -> Test:
        """The same test with other settings.

        Raises
        ------
        ConfigError
            If a setting is unknown or its value is wrong.
        """
        checked = _analysis(changes, "analysis settings")
        changed = replace(self, analysis=replace(self.analysis, **{key: getattr(checked, key) for key in changes}))
        changed.rejected_hits(changed.idle)
        return changed


def load_test(path: str | Path) -> Test:
    """Read a test file.

    Parameters
    ----------
    path : path
        ``test.toml``, or a folder that holds one. Paths and globs inside are relative to the file.

    Raises
    ------
    ConfigError
        If the file is no TOML, a key is unknown (the nearest known one is named), a value is wrong, or a pattern matches no file.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "test.toml"
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(
            "there is no such test file", where=str(path), hint="`operando init DIR` writes one from the files in DIR"
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"not a text in UTF-8 (byte {error.start})", where=str(path), hint="a test file is TOML text") from None
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        hint = (
            "write Windows paths in single quotes or with /"
            if "escape" in str(error).lower()
            else "see the contract of test.toml in the README"
        )
        raise ConfigError(f"not valid TOML: {error}", where=str(path), hint=hint) from None
    return parse_test(table, path)


def parse_test(table: Mapping[str, Any], path: Path) -> Test:
    """Test of a parsed TOML table; ``path`` is the file it came from (see :func:`load_test`)."""
    where = str(path)
    known = ("name", "idle", "operating", "check", "geometry", "units", "channels", "analysis", "directions")
    check_keys(table, known, where)
    for section in known[1:]:
        if section in table and not isinstance(table[section], Mapping):
            raise ConfigError(f"{section!r} is a value, expected a table", where=where, hint=f"write [{section}] on a line of its own")
    name = table.get("name", path.parent.resolve().name)
    if not isinstance(name, str) or not name.strip():
        raise ConfigError(f"name is {name!r}, expected a text", where=where)
    folder = path.parent
    states = {key: state_of(table.get(key, {}), folder, f"{where} [{key}]") for key in ("idle", "operating", "check")}
    if not (states["idle"] or states["operating"]):
        raise ConfigError("names no measurement", where=where, hint='give [idle] or [operating] with records = ["idle/*.uff"]')
    if states["idle"].records and states["idle"].frfs:
        raise ConfigError("gives both records and frfs", where=f"{where} [idle]", hint="keep one: raw records if there are any")
    if states["operating"].frfs:
        raise ConfigError(
            "FRFs cannot be measured where the force is unknown", where=f"{where} [operating]", hint="a run with force belongs to [check]"
        )
    geometry = table.get("geometry", {})
    check_keys(geometry, ("file", "units"), f"{where} [geometry]")
    file = geometry.get("file")
    geometry_units = geometry.get("units")
    directions = _directions(table.get("directions", {}), f"{where} [directions]")
    channels = _channels(table.get("channels", {}), f"{where} [channels]")
    _check_declared(channels, directions, f"{where} [channels]")
    if geometry_units is not None:
        _unit(geometry_units, "displacement", f"{where} [geometry] units")
    test = Test(
        name=name.strip(),
        path=path,
        **states,
        geometry_file=None if file is None else find_files([file], folder, f"{where} [geometry] file")[0],
        geometry_units=geometry_units,
        units=_units(table.get("units", {}), f"{where} [units]"),
        channels=channels,
        analysis=_analysis(table.get("analysis", {}), f"{where} [analysis]"),
        directions=directions,
    )
    test.rejected_hits(test.idle)
    return test


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def _unit(text: Any, quantity: str | None, where: str) -> str:
    if not isinstance(text, str):
        raise ConfigError(f"{text!r} is no unit", where=where, hint='write a text such as "g" or "lbf"')
    try:
        parse_unit(text, quantity)
    except UnitError as error:
        raise ConfigError(error.message, where=where, hint=error.hint) from None
    return text


def _units(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    check_keys(table, (*SI_UNIT, "length", "sampling_hz", "columns"), where)
    out: dict[str, Any] = {}
    for quantity, text in table.items():
        here = f"{where} {quantity}"
        if quantity == "sampling_hz":
            out[quantity] = _positive(text, here)
        elif quantity == "columns":
            out[quantity] = list(check_columns(text, here))
        else:
            out[quantity] = _unit(text, "displacement" if quantity == "length" else quantity, here)
    return out


def _channels(table: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {}
    for name, entry in table.items():
        here = f"{where} {name!r}"
        if not isinstance(entry, Mapping):
            raise ConfigError(
                f"{entry!r} is no table", where=here, hint='write for example {dof = "12+Z", quantity = "acceleration", unit = "g"}'
            )
        check_keys(entry, _CHANNEL_KEYS, here)
        if "dof" in entry:
            try:
                Dof.parse(entry["dof"])
            except DofError as error:
                raise ConfigError(error.message, where=here, hint=error.hint) from None
        quantity = entry.get("quantity")
        if quantity is not None and quantity not in SI_UNIT:
            near = difflib.get_close_matches(str(quantity), SI_UNIT, 1, 0.5)
            raise ConfigError(
                f"unknown quantity {quantity!r}", where=here, hint=f"did you mean {near[0]!r}?" if near else "known: " + ", ".join(SI_UNIT)
            )
        if "unit" in entry:
            _unit(entry["unit"], quantity, f"{here} unit")
        if "sensitivity" in entry and (not is_number(entry["sensitivity"]) or entry["sensitivity"] == 0):
            raise ConfigError(f"sensitivity is {entry['sensitivity']!r}, expected a number other than 0", where=here)
        if not isinstance(entry.get("exclude", False), bool):
            raise ConfigError(f"exclude is {entry['exclude']!r}, expected true or false", where=here)
        if not isinstance(entry.get("reason", ""), str):
            raise ConfigError(f"reason is {entry['reason']!r}, expected a text", where=here)
        out[name] = dict(entry)
    return out


NOT_UNIT = 0.05
"""Largest difference of a direction's length from 1: three components rounded to two decimals keep within 1 %; more is no unit vector."""


def _directions(table: Mapping[str, Any], where: str) -> dict[str, tuple[float, ...]]:
    """DOF in its positive sense → vector of unit length."""
    out: dict[str, tuple[float, ...]] = {}
    for label, value in table.items():
        here = f"{where} {label!r}"
        try:
            dof = Dof.parse(label)
        except DofError as error:
            hint = "write node, sign and a name in lower case, as in 5+a, or the label the file has, as in 7+X"
            raise ConfigError(error.message, where=here, hint=hint) from None
        if dof.axis in ("", "RX", "RY", "RZ"):
            raise ConfigError(f"{dof} is a {'rotation' if dof.axis else 'scalar'}, which has no direction here", where=here)
        _check(value, isinstance(value, list | tuple) and len(value) == 3 and all(is_number(v) for v in value), "three numbers", here)
        length = sum(float(v) ** 2 for v in value) ** 0.5
        if abs(length - 1) > NOT_UNIT:
            raise ConfigError(f"the vector has length {length:.3g}, expected a unit vector", where=here, hint="divide it by its length")
        if str(dof.unsigned) in out:
            raise ConfigError(f"the direction of {dof.unsigned} is given twice", where=here)
        out[str(dof.unsigned)] = tuple(dof.sign * float(v) / length for v in value)
    return out


def _check_declared(channels: Mapping[str, Mapping[str, Any]], directions: Mapping[str, Any], where: str) -> None:
    """Every named direction in [channels] must stand in [directions]."""
    for name, entry in channels.items():
        if "dof" in entry and (dof := Dof.parse(entry["dof"])).named and str(dof.unsigned) not in directions:
            near = difflib.get_close_matches(str(dof.unsigned), directions, 1, 0.5)
            raise ConfigError(
                f"direction {dof.axis!r} of {dof} is not declared",
                where=f"{where} {name!r}",
                hint=f"did you mean {near[0]!r}?" if near else f'give its unit vector: [directions] "{dof.unsigned}" = [0.0, 0.6, 0.8]',
            )


def _check(value: Any, good: bool, expected: str, where: str) -> Any:
    if not good:
        raise ConfigError(f"{value!r} is not allowed; expected {expected}", where=where)
    return value


def _band(value: Any, where: str) -> tuple[float, float]:
    good = isinstance(value, list | tuple) and len(value) == 2 and all(is_number(v) for v in value) and 0 <= value[0] < value[1]
    _check(value, good, "two frequencies [low, high] in Hz with 0 <= low < high", where)
    return float(value[0]), float(value[1])


def _bands(value: Any, where: str) -> tuple[tuple[float, float], ...]:
    _check(value, isinstance(value, list | tuple), "a list of [low, high] in Hz", where)
    return tuple(_band(v, where) for v in value)


def _numbers(value: Any, where: str) -> tuple[float, ...]:
    good = isinstance(value, list | tuple) and all(is_number(v) and v > 0 for v in value)
    return tuple(float(v) for v in _check(value, good, "a list of frequencies in Hz", where))


def _texts(value: Any, where: str) -> tuple[str, ...]:
    return tuple(_check(value, isinstance(value, list | tuple) and all(isinstance(v, str) for v in value), "a list of texts", where))


def _dofs(value: Any, where: str) -> tuple[str, ...]:
    out = []
    for text in _texts(value, where):
        try:
            out.append(str(Dof.parse(text)))
        except DofError as error:
            raise ConfigError(error.message, where=where, hint=error.hint) from None
    return tuple(out)


def _hits(value: Any, where: str) -> tuple[str, ...]:
    texts = _texts(value, where)
    for text in texts:
        if not re.fullmatch(r".+#\d+", text):
            raise ConfigError(f"{text!r} names no hit", where=where, hint='write FILE#NUMBER, as in "idle/hammer1.uff#3"; numbers from 0')
    return texts


def _positive(value: Any, where: str) -> float:
    return float(_check(value, is_number(value) and value > 0, "a positive number", where))


def _overlap(value: Any, where: str) -> float:
    return float(_check(value, is_number(value) and 0 <= value < 1, "a number from 0 to below 1", where))


def _order(value: Any, where: str) -> int:
    return int(_check(value, isinstance(value, int) and not isinstance(value, bool) and value >= 2, "a whole number of at least 2", where))


def _threshold(value: Any, where: str) -> float:
    return float(_check(value, is_number(value) and 0 < value <= 1, "a MAC value above 0 and up to 1", where))


def _text(value: Any, where: str) -> str:
    return str(_check(value, isinstance(value, str) and value != "", "a text", where))


def _flag(value: Any, where: str) -> bool:
    return bool(_check(value, isinstance(value, bool), "true or false", where))


def _one_of(choices: tuple[str, ...]) -> Callable[[Any, str], str]:
    def check(value: Any, where: str) -> str:
        if isinstance(value, str) and value.lower() in choices:
            return value.lower()
        near = difflib.get_close_matches(str(value), choices, 1, 0.5)
        raise ConfigError(
            f"{value!r} is not allowed; expected one of {', '.join(choices)}",
            where=where,
            hint=f"did you mean {near[0]!r}?" if near else None,
        )

    return check


_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "band": _band, "block_seconds": _positive, "overlap": _overlap, "window": _text, "estimator": _one_of(ESTIMATORS),
    "hits": _one_of(HITS), "hits_reject": _hits, "references": _dofs, "max_order": _order, "ema": _one_of(EMA_ANSWERS),
    "modes_hz": _numbers, "select_hz": _numbers, "reject_hz": _numbers,
    "threshold": _threshold, "scaling": _one_of(SCALINGS), "known_harmonics_hz": _numbers, "exclude_bands": _bands, "kinds": _texts,
    "places": _texts, "oma_max_order": _order, "oma_references": _dofs, "oma_select_hz": _numbers, "oma_reject_hz": _numbers,
    "second_opinion": _flag,
}  # fmt: skip


def _analysis(table: Mapping[str, Any], where: str) -> Analysis:
    check_keys(table, (f.name for f in fields(Analysis)), where)
    return Analysis(**{key: _CHECKS[key](value, f"{where} {key}") for key, value in table.items()})
