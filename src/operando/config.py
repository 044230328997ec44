"""The test file: what was measured, where the files lie, how it is analysed."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from typing_extensions import TypedDict

from operando import values
from operando.dof import Dof
from operando.entries import Entry, Given, lines_of
from operando.errors import ConfigError, OperandoError
from operando.own_effects import load_effects
from operando.paths import path_of
from operando.states import Span as Span
from operando.states import State as State
from operando.states import find_files, record_named, state_of


@dataclass(frozen=True)
class Analysis:
    """Settings of the analysis; every one has a default, and the ones used are stated in every output.

    Parameters
    ----------
    band : (float, float) or None
        Analysis band [Hz]. Default: chosen from the data.
    block_seconds : float or None
        Block length of the FRF estimate [s]. Default: chosen from the force and the length of the records.
    overlap : float or None
        Overlap of the blocks as a share, 0 to below 1.
    window : str or None
        Window of the blocks, or of the hits.
    estimator : str or None
        FRF estimator: ``h1``, ``h2``, ``hv``, ``lrm`` (local rational model) or ``periodic``. Default: chosen from the force.
    hits : str
        Hammer records: ``auto`` (consistent single hits), ``all``, or ``off`` (a record is taken as continuous).
    hits_reject : tuple of str
        Hits not to be used, as ``FILE#NUMBER``: numbers from 0, as in the findings, the inventory and the report.
    references : tuple of str or None
        Force DOFs to use. Default: all.
    max_order : int or None
        Largest model order of the EMA.
    ema : {"auto", "linear", "polished"}
        Which answer of the EMA to give: the linear stage, the maximum-likelihood fit, or what the data support.
    modes_hz : tuple of float
        Exactly these idle modes [Hz]: the nearest stable pole of each, within 1 %; an error where there is none, or two reach one pole.
    select_hz : tuple of float
        Idle modes besides the automatic ones [Hz].
    reject_hz : tuple of float
        Automatic idle modes to leave out [Hz]: the one nearest to each.
    threshold : float
        MAC from which an operational mode counts as unchanged.
    scaling : str
        Scaling method; ``auto`` chooses by evidence and says why.
    known_harmonics_hz : tuple of float
        Rotor orders and other harmonics of the operating state [Hz].
    exclude_bands : tuple of (float, float)
        Bands [Hz] that neither fit nor comparison nor diagnosis use.
    kinds : tuple of str or None
        Kinds of effects that the diagnosis may look for. Default: all.
    places : tuple of str or None
        DOFs at which the diagnosis may look. Default: all.
    oma_max_order : int or None
        Largest model order of the OMA.
    oma_references : tuple of str or None
        Reference channels of the OMA. Default: chosen.
    oma_select_hz : tuple of float
        Operational modes besides the automatic ones [Hz].
    oma_reject_hz : tuple of float
        Automatic operational modes to leave out [Hz].
    second_opinion : bool
        Whether sdypy-EMA and pyOMA-2 fit the same data for comparison.
    """

    band: values.Band | None = None
    block_seconds: values.Positive | None = None
    overlap: values.Share | None = None
    window: values.Window | None = None
    estimator: values.Estimator | None = None
    hits: values.HitChoice = "auto"
    hits_reject: values.Hits = ()
    references: values.Dofs | None = None
    max_order: values.Order | None = None
    ema: values.EmaAnswer = "auto"
    modes_hz: values.Frequencies = ()
    select_hz: values.Frequencies = ()
    reject_hz: values.Frequencies = ()
    threshold: values.Mac = 0.7
    scaling: values.Scaling = "auto"
    known_harmonics_hz: values.Frequencies = ()
    exclude_bands: values.Bands = ()
    kinds: values.Texts | None = None
    places: values.Dofs | None = None
    oma_max_order: values.Order | None = None
    oma_references: values.Dofs | None = None
    oma_select_hz: values.Frequencies = ()
    oma_reject_hz: values.Frequencies = ()
    second_opinion: values.Flag = False

    def to_dict(self) -> dict[str, Any]:
        """All settings with defaults, as JSON values."""
        return {key: _plain(value) for key, value in asdict(self).items()}


@dataclass(frozen=True, repr=False)
class Test:
    """One test: the files of each state, units and channels where the files are silent, settings.

    Parameters
    ----------
    path : Path or None
        The test file (None for a test made in Python).
    geometry_units : str or None
        Unit of the coordinates where the file does not say.
    units : dict
        Quantity → unit, used where a file is silent; ``length`` for coordinates, ``sampling_hz`` for tables without a time column.
    channels : dict
        Channel name or DOF → dict of ``dof, quantity, unit, sensitivity, exclude, reason``.
    directions : dict
        DOF in its positive sense → unit vector in the geometry's frame, for DOFs that are no axes.
    between : dict
        What may differ between the measurements at rest and in operation beside the missing physics → one standard deviation.
    report : dict
        The title block of the report: ``object, date, operator, sensors, comments``.
    effects : tuple of Path
        Python files with kinds of effects of the user's own, imported when the test file is read.
    given : mapping
        Which line or option gave each entry, for messages.
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
    between: dict[str, float] = field(default_factory=dict)
    report: dict[str, str] = field(default_factory=dict)
    effects: tuple[Path, ...] = ()
    given: Given = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        usual, counted = Analysis(), lambda n, noun: f"{n} {noun}{'' if n == 1 else 's'}"
        states = [
            f"{name} {' and '.join(counted(len(f), noun) for f, noun in ((of.records, 'record'), (of.frfs, 'FRF file')) if f)}"
            for name, of in self.states.items()
            if of
        ]
        chosen = {f.name: getattr(self.analysis, f.name) for f in fields(Analysis)}
        analysis = ", ".join(f"{key} {value}" for key, value in chosen.items() if value != getattr(usual, key))
        sections = [f"[{key}]" for key in ("units", "channels", "directions", "between", "report") if getattr(self, key)]
        geometry = "" if self.geometry_file is None else f"geometry {self.geometry_file.name}"
        return f"<Test: {'; '.join(part for part in (self.name, *states, geometry, analysis, ' '.join(sections)) if part)}>"

    def where(self, section: str, key: str = "") -> str:
        """An entry of the test file in words: file, line, section, key."""
        return str(Entry(str(self.path or "test"), section, key, self.given))

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
        given["between"] = dict(self.between)
        given["report"] = dict(self.report)
        given["effects"] = {"modules": [self.label(file) for file in self.effects]}
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
            name = record_named(file, labels, self.where("analysis", "hits_reject"), f"#{number}")
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
        checked = values.read(Analysis, changes, Entry("settings", "analysis"))
        return _fitting(replace(self, analysis=replace(self.analysis, **{key: getattr(checked, key) for key in changes})))


def load_test(path: str | Path, changes: Sequence[str] = ()) -> Test:
    """Read a test file.

    Parameters
    ----------
    path : path
        ``test.toml``, or a folder that holds one. Paths and globs inside are relative to the file.
    changes : sequence of str, optional
        Entries that take the place of those in the file, each ``section.key=value`` with the value as TOML.

    Returns
    -------
    Test

    Raises
    ------
    ConfigError
        If the file is no TOML, a key is unknown (the nearest known one is named), a value is wrong, or a pattern matches no file.

    Examples
    --------
    >>> import tempfile, operando
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     operando.write_uff(f"{folder}/idle.uff", operando.Frf([[[1.0, 2.0]]], [1.0, 2.0], "1+Z", "1+Z"))
    ...     _ = Path(folder, "test.toml").write_text('name = "pump"\\n[idle]\\nfrfs = ["idle.uff"]')
    ...     operando.load_test(folder, ["analysis.band=[1,2]"]).analysis.band
    (1.0, 2.0)
    """
    path = path_of(path, "a test is loaded from its test file", "give the path of test.toml")
    if path.is_dir():
        if (path / "model.h5").exists() and not (path / "test.toml").exists():
            hint = "give the test file; `operando report`, `ofrf`, `diagnose` and `compare` take a results folder"
            raise ConfigError("is a results folder, expected a test file", where=str(path), hint=hint)
        path = path / "test.toml"
    return parse_text(text_of(path), path, changes)


def parse_text(text: str, path: Path, changes: Sequence[str] = ()) -> Test:
    """Test of the text of a test file that lies, or would lie, at ``path``; see :func:`load_test`."""
    table = toml_table(text, path, lambda: _not_a_test(path))
    given = lines_of(text)
    if isinstance(changes, str) or not all(isinstance(change, str) for change in changes):
        raise ConfigError(f"changes are {changes!r:.200}", hint='give a list of texts, as ["analysis.band=[5,220]"]')
    for change in changes:
        given[_apply(table, change)] = "--set"
    return parse_test(table, path, given)


def toml_table(text: str, path: Path, hint: Callable[[], str]) -> dict[str, Any]:
    """The table of a TOML text."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        line = re.search(r"at line (\d+)", str(error))
        advice = "write Windows paths in single quotes or with /" if "escape" in str(error).lower() else hint()
        where = f"{path}, line {line[1]}" if line else str(path)
        raise ConfigError(f"not valid TOML: {error}", where=where, hint=advice) from None


def text_of(path: Path) -> str:
    """The text of a test file."""
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        hint = "`operando init DIR` writes one from the files in DIR"
        raise ConfigError("there is no such test file", where=str(path), hint=hint) from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"not a text in UTF-8 (byte {error.start})", where=str(path), hint=_not_a_test(path)) from None


def _not_a_test(path: Path) -> str:
    """What to do with a file that is no TOML: it may be data."""
    if path.suffix.lower() == ".toml":
        return 'a test file is TOML text with lines such as [idle] and records = ["idle/*.uff"]'
    from operando.io import detect_format

    try:
        kind = detect_format(path)
    except (OperandoError, OSError):
        kind = ""
    if not kind or (kind == "csv" and path.suffix.lower() != ".csv"):  # any text may be a table
        return "a test file is TOML text; `operando init DIR` writes one from the files in DIR"
    return f"this is a measurement file ({kind}): `operando init {path.parent}` writes a test file, `operando inspect` shows what is in it"


def _apply(table: dict[str, Any], change: str) -> tuple[str, str]:
    """Put ``section.key=value`` into the table; returns section and key."""
    name, equals, text = change.partition("=")
    section, dot, key = (part.strip().strip("\"'") for part in name.partition("."))
    if not (equals and section) or (dot and not key):
        hint = "write SECTION.KEY=VALUE, as in analysis.band=[5,220] or analysis.scaling=eq13"
        raise ConfigError(f"{change!r:.200} names no entry", where="--set", hint=hint)
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        value = text.strip()  # a text without its quotes, as shells leave it
    if not dot:
        section, key, target = "", section, table
    else:
        target = table.setdefault(section, {})
        if not isinstance(target, dict):
            hint = values.nearest(section, [*Sections.__annotations__][1:])
            raise ConfigError(f"{section!r} is a value, not a section", where="--set", hint=hint)
    target[key] = value
    return section, key


class Sections(TypedDict, total=False):
    """The test file as it is written: its sections and their keys."""

    name: values.Name
    idle: values.StateFiles
    operating: values.StateFiles
    check: values.StateFiles
    geometry: values.GeometryFile
    units: values.Units
    channels: dict[str, values.Channel]
    analysis: Analysis
    between: values.Between
    directions: values.Directions
    report: values.TitleBlock
    effects: values.OwnEffects


def parse_test(table: Mapping[str, Any], path: Path, given: Given | None = None) -> Test:
    """Test of a parsed TOML table; ``path`` is the file it came from, ``given`` the line of each entry (see :func:`load_test`)."""
    where = Entry(str(path), given=given or {})
    names = ("idle", "operating", "check")
    if not any(name in table for name in names) and any(name in table for name in ("tests", "template", "rows")):
        hint = f"run it with `operando campaign {path}`"
        raise ConfigError("is a campaign file, expected a test file", where=str(path), hint=hint)
    found = {"name": path.parent.resolve().name, **values.read(Sections, table, where)}
    folder = path.parent
    states: dict[str, Any] = {name: state_of(found.pop(name, {}), folder, where.within(name)) for name in names}
    if not (states["idle"] or states["operating"]):
        hint = 'give [idle] or [operating] with records = ["idle/*.uff"]'
        raise ConfigError("names no measurement", where=str(where), hint=hint)
    if states["idle"].records and states["idle"].frfs:
        raise ConfigError("gives both records and frfs", where=str(where.within("idle")), hint="keep one: raw records if there are any")
    if states["operating"].frfs:
        hint = "a run with force belongs to [check]"
        text = "FRFs cannot be measured where the force is unknown"
        raise ConfigError(text, where=str(where.within("operating").at("frfs")), hint=hint)
    geometry, here = found.pop("geometry", {}), where.within("geometry").at("file")
    files = find_files([geometry["file"]], folder, here) if "file" in geometry else ()
    if len(files) > 1:
        raise ConfigError(f"{geometry['file']!r} matches {len(files)} files, expected one", where=str(here))
    effects = tuple(dict.fromkeys(folder / name for name in found.pop("effects", {}).get("modules", ())))
    load_effects(effects, str(where.within("effects").at("modules")))
    found |= {"geometry_file": next(iter(files), None), "geometry_units": geometry.get("units")}
    return _fitting(Test(**found, **states, path=path, effects=effects, given=where.given))


def _fitting(test: Test) -> Test:
    """The test, if its entries fit together: kinds are known, directions declared, rejected hits of its records."""
    values.check_kinds(test.analysis.kinds or (), test.where("analysis", "kinds"))
    for name, entry in test.channels.items():
        if "dof" in entry and (dof := Dof.parse(entry["dof"])).named and str(dof.unsigned) not in test.directions:
            near = difflib.get_close_matches(str(dof.unsigned), test.directions, 1, 0.5)
            raise ConfigError(
                f"direction {dof.axis!r} of {dof} is not declared",
                where=test.where("channels", name),
                hint=f"did you mean {near[0]!r}?" if near else f'give its unit vector: [directions] "{dof.unsigned}" = [0.0, 0.6, 0.8]',
            )
    test.rejected_hits(test.idle)
    return test


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value
