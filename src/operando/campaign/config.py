"""The campaign file: which tests, their parameters, the baseline, and what they run on."""

from __future__ import annotations

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from typing_extensions import TypedDict

from operando.campaign.parameters import Row, Value, axis_of, read_table, row_of, shown, value_of
from operando.campaign.store import in_store, matches
from operando.config import Test, load_test, parse_text, text_of, toml_table
from operando.entries import Entry, lines_of
from operando.errors import ConfigError
from operando.pipeline import STAGES
from operando.values import Count, Expected, Name, choice, listed, nearest, read

CLUSTERS = ("slurm", "kubernetes")
_HOLE = re.compile(r"\{([A-Za-z_]\w*)\}")
_GIVES = 'give tests = ["runs/{speed}/test.toml"], or template = "test.toml" with table = "runs.csv"'


@dataclass(frozen=True)
class Workers:
    """What the tests run on."""

    processes: Count | None = None  # local processes (None: one a processor)
    scheduler: Name | None = None  # address of a Dask scheduler
    # a cluster to be started through dask-jobqueue or dask-kubernetes
    cluster: Annotated[str, choice(CLUSTERS)] | None = None
    jobs: Count = 1  # its workers
    options: dict[str, Any] = field(default_factory=dict)  # for the cluster's own constructor (queue, memory, image …)


class Entries(TypedDict, total=False):
    """The campaign file as it is written."""

    name: Name
    tests: Annotated[list[Name], Expected("a list of paths", first=listed)]
    template: Name
    table: Name
    rows: Annotated[list[Any], Expected("a list", hint="write rows = [{speed = 600}, {speed = 900}]")]
    units: dict[str, Name]
    over: Name
    baseline: Any
    until: Annotated[str, choice(STAGES)]
    workers: Workers


@dataclass(frozen=True)
class Member:
    """One test of a campaign."""

    number: int  # its place in the campaign file, from 1
    name: str  # unique, and the name of its results folder
    path: Path | str  # test file, its URL in an object store, or the template
    template: str | None  # text of the template; None: the file as it is
    row: Row

    @property
    def text(self) -> str | None:
        """The template filled in."""
        if self.template is None:
            return None
        return _HOLE.sub(lambda m: self.row.texts.get(m[1], m[0]), self.template)


def load_member(path: str | Path, text: str | None, title: str, changes: Sequence[str]) -> Test:
    """The test of a file, or of a template's text filled in; the tests of one template are told apart by their titles."""
    path = Path(path)
    if text is None:
        return load_test(path, changes)
    test = parse_text(text, path, changes)
    return replace(test, name=f"{test.name}, {title}")


@dataclass(frozen=True)
class Campaign:
    """Many tests and how they belong together.

    Parameters
    ----------
    name : str
    path : Path
    members : tuple of Member
    units : mapping
        Parameter → unit.
    over : str or None
        Parameter that results are shown over (None: the order of the tests).
    baseline : str
        Name of the test that every state is compared against.
    baseline_given : bool
        Whether the campaign file names it; else it is the first.
    until : str or None
        Last stage of each test.
    workers : Workers
    """

    name: str
    path: Path
    members: tuple[Member, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    over: str | None = None
    baseline: str = ""
    baseline_given: bool = False
    until: str | None = None
    workers: Workers = Workers()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(dict.fromkeys(name for member in self.members for name in member.row.parameters))

    def title(self, member: Member) -> str:
        """A test by its parameters, else by its name."""
        words = ", ".join(shown(k, v, self.units) for k, v in member.row.parameters.items())
        return words or member.name


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign file.

    Parameters
    ----------
    path : path
        ``campaign.toml``, or a folder that holds one. Paths and globs inside are relative to the file.

    Raises
    ------
    ConfigError
        If the file is no TOML, a key is unknown (the nearest known one is named), a value is wrong, or it names no test.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "campaign.toml"
    if not path.exists():
        raise ConfigError("there is no such campaign file", where=str(path), hint=_GIVES)
    text = text_of(path)
    table = toml_table(text, path, lambda: "a campaign file is TOML text with lines such as " + _GIVES.removeprefix("give "))
    where = Entry(str(path), given=lines_of(text))
    if "idle" in table or "operating" in table:
        hint = f'run it with `operando run {path}`, or name it in a campaign file: tests = ["{path.name}"]'
        raise ConfigError("is a test file, expected a campaign file", where=str(path), hint=hint)
    found: Entries = read(Entries, table, where)
    name = found.get("name", path.absolute().parent.name)
    members, units = _members(found, path.parent, where)
    campaign = Campaign(name, path, members, units | found.get("units", {}))
    for key in found.get("units", {}):
        if key not in campaign.columns:
            raise ConfigError(f"{key!r} is no parameter", where=str(where.within("units").at(key)), hint=nearest(key, campaign.columns))
    return replace(
        campaign,
        over=_over(found.get("over"), campaign, where.at("over")),
        baseline=_baseline(found.get("baseline"), campaign, where.at("baseline")),
        baseline_given="baseline" in found,
        until=found.get("until"),
        workers=found.get("workers", Workers()),
    )


def _members(table: Entries, folder: Path, where: Entry) -> tuple[tuple[Member, ...], dict[str, str]]:
    units: dict[str, str] = {}
    rows: list[Row] = []
    if "table" in table:
        rows, units = read_table(folder / table["table"])
    rows = [*rows, *(row_of(entry, f"{where.at('rows')}, row {i}") for i, entry in enumerate(table.get("rows", []), 1))]
    template = text = None
    if "template" in table:
        if in_store(table["template"]):
            hint = 'name test files there: tests = ["s3://bucket/{speed}/test.toml"]'
            raise ConfigError("a template cannot be in an object store", where=str(where.at("template")), hint=hint)
        template = _test_file(folder / table["template"])
        text = text_of(template)
        if not rows:
            hint = 'give table = "runs.csv", or rows = [{speed = 600}, {speed = 900}]'
            raise ConfigError("a template needs rows to fill it in", where=str(where.at("template")), hint=hint)
    found: list[tuple[Path | str, str | None, Row]] = []
    for row in rows:
        if row.test is not None:
            found.append((row.test if in_store(row.test) else _test_file(folder / row.test), None, row))
        elif template is None or text is None:
            hint = 'give template = "test.toml", or a column test with the test file of each row'
            raise ConfigError("the rows name no test", where=str(where.at("table" if "table" in table else "rows")), hint=hint)
        else:
            _check_filled(template, text, row, len(rows))
            found.append((template, text, row))
    for pattern in table.get("tests", []):
        found += [(path, None, row) for path, row in _matches(pattern, folder, where.at("tests"))]
    if not found:
        raise ConfigError("names no test", where=str(where), hint=_GIVES)
    _check_different(found, where)
    return _named(found), units


def _check_different(found: Sequence[tuple[Path | str, str | None, Row]], where: Entry) -> None:
    """Refuse a test that is named twice: it would count as two states that agree."""
    seen: dict[str, int] = {}
    for number, (path, _, row) in enumerate(found, 1):
        first = seen.setdefault(repr((str(path), sorted(row.texts.items()), sorted(row.changes))), number)
        if first != number:
            hint = "leave one of them out, or give the second its own file or a parameter that differs"
            raise ConfigError(f"tests {first} and {number} are the same ({row.name or Path(path).as_posix()})", where=str(where), hint=hint)


def _test_file(path: Path) -> Path:
    return path / "test.toml" if path.is_dir() else path


def _check_filled(template: Path, text: str, row: Row, rows: int) -> None:
    """Whether a row fills all holes of a template, and whether rows differ at all."""
    holes = set(_HOLE.findall(re.sub(r"#.*", "", text)))
    for hole in sorted(holes - set(row.texts)):
        raise ConfigError(f"no column fills {{{hole}}}", where=str(template), hint=nearest(hole, row.texts))
    for hole in holes:
        if re.search(r'["\'\\\n]', row.texts[hole]):
            raise ConfigError(f"{hole} is {row.texts[hole]!r:.200}: quotes cannot stand in a template", where=str(template))
    if not holes and rows > 1 and not row.changes:
        hint = "write {" + (next(iter(row.texts), "speed")) + '} where the value belongs, as in records = ["run{speed}/*.uff"]'
        raise ConfigError("uses no column of the table: every row would be the same test", where=str(template), hint=hint)


def _matches(pattern: str, folder: Path, where: Entry) -> list[tuple[Path | str, Row]]:
    """Test files of a glob; ``{speed}`` in it matches like ``*`` and names what it matched."""
    wild = _HOLE.sub("*", pattern)
    files: dict[str, Path | str]  # as the pattern is written
    if in_store(pattern):
        ending = "" if pattern.endswith(".toml") else "/test.toml"
        pattern = matches(pattern.rstrip("/") + ending)[0]
        files = dict(matches(wild.rstrip("/") + ending)[1])
    else:
        there = sorted(Path(f) for f in glob.glob(str(folder / wild), recursive=True))
        tests = [_test_file(f) for f in there if f.is_file() or (f / "test.toml").is_file()]
        files = {(f.relative_to(folder) if f.is_relative_to(folder) else f).as_posix(): f for f in tests}
    if not files:
        hint = "looked in the store" if in_store(wild) else f"looked in {folder.absolute()}"
        raise ConfigError(f"no test file matches {pattern!r:.200}", where=str(where), hint=hint)
    reading = re.compile(_regex(pattern))
    out = []
    for relative, file in files.items():
        match = reading.fullmatch(relative) or reading.fullmatch(relative.removesuffix("/test.toml"))
        texts = dict(match.groupdict()) if match else {}
        out.append((file, Row(str(file), None, {k: value_of(v) for k, v in texts.items()}, texts)))
    return sorted(out, key=lambda item: [(isinstance(v, str), v) for v in item[1].parameters.values()])


def _regex(pattern: str) -> str:
    parts = re.split(r"(\{[A-Za-z_]\w*\}|\*\*/|\*|\?)", pattern)
    seen: set[str] = set()
    out = []
    for part in parts:
        if (match := _HOLE.fullmatch(part)) is not None:
            out.append(f"(?P={match[1]})" if match[1] in seen else f"(?P<{match[1]}>[^/]+?)")
            seen.add(match[1])
        else:
            out.append({"**/": "(?:.*/)?", "*": "[^/]*", "?": "[^/]"}.get(part, re.escape(part)))
    return "".join(out)


def _named(found: Sequence[tuple[Path | str, str | None, Row]]) -> tuple[Member, ...]:
    """Members with unique names that can be folders: the row's name, else its parameters, else the folder or file of the test."""
    used: dict[str, int] = {}
    out = []
    for number, (path, template, row) in enumerate(found, 1):
        file = path.absolute() if isinstance(path, Path) else PurePosixPath(path)
        own = file.stem if file.stem != "test" else file.parent.name
        words = row.name or "_".join(f"{k}-{row.texts.get(k, v)}" for k, v in row.parameters.items()) or own
        name = re.sub(r"[^\w.+-]+", "-", words).strip(".-")[:80] or f"test-{number}"
        used[name.lower()] = again = used.get(name.lower(), 0) + 1
        if again > 1:
            name = f"{name}-{again}"
            used[name.lower()] = 1
        out.append(Member(number, name, path, template, row))
    return tuple(out)


def _over(value: Any, campaign: Campaign, where: Entry) -> str | None:
    columns = campaign.columns
    if value is None:
        parameters = [m.row.parameters for m in campaign.members]
        vary = [c for c in columns if len({p.get(c) for p in parameters}) > 1]
        measured = [c for c in vary if axis_of(c, parameters, {}).kind != "order"]
        return next(iter(measured or vary or columns), None)
    if value not in columns:
        raise ConfigError(f"{value!r:.200} is no parameter", where=str(where), hint=nearest(str(value), columns))
    return str(value)


def _baseline(value: Any, campaign: Campaign, where: Entry) -> str:
    """Name of the baseline test: by name, or by its parameters."""
    members = campaign.members
    if value is None:
        return members[0].name
    if isinstance(value, str):
        if value in (names := [m.name for m in members]):
            return value
        raise ConfigError(f"no test has the name {value!r:.200}", where=str(where), hint=nearest(value, names))
    wanted = row_of(value, str(where)).parameters
    for key in wanted:
        if key not in campaign.columns:
            raise ConfigError(f"{key!r} is no parameter", where=str(where), hint=nearest(key, campaign.columns))
    for member in members:
        if all(member.row.parameters.get(k) == v for k, v in wanted.items()):
            return member.name
    words = ", ".join(shown(k, v, campaign.units) for k, v in wanted.items())
    raise ConfigError(f"no test has {words}", where=str(where), hint="tests: " + ", ".join(m.name for m in members[:12]))


__all__ = ["CLUSTERS", "Campaign", "Member", "Value", "Workers", "load_campaign", "load_member"]
