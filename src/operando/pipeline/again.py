"""An unchanged test run again: what was said of it lies in its results folder, and is said again without reading the results.

That holds while everything a run depends on is the same: the content of the input files, the test, the code. And while everything a run
leaves behind is: each file of the results folder, by its content. Else the stages are asked one by one, as without it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from operando.atomic import write_json
from operando.config import Span, State, Test
from operando.errors import ConfigError
from operando.files import file_hash
from operando.own_effects import effects_hash
from operando.pipeline.code import whole_code_hash
from operando.pipeline.folder import HIDDEN, ResultsFolder, key_of, results_folder

if TYPE_CHECKING:
    from operando.results import Results

ANSWER = f"{HIDDEN}/answer.json"
"""What the last run said, in the results folder."""

Progress = Callable[[str, str], None]
Tell = Callable[["Results"], dict[str, Any]]


@dataclass(frozen=True)
class Said:
    """What a run says."""

    told: dict[str, Any]  # what ``tell`` made of its results, as plain JSON values
    results: Results | None = None  # the results themselves; None where nothing had changed


def run_and_tell(
    test: Test, out: Path, tell: Tell, *, until: str | None = None, progress: Progress | None = None, report: bool | None = None
) -> Said:
    """Run a test (:func:`operando.pipeline.run`) and tell what it found; of an unchanged test what was told before.

    ``tell`` makes plain JSON values of the results; it depends on nothing but them and ``out``.
    """
    results_go_to(out)
    with results_folder(out, "run", make=True) as folder:
        folder.came_from(test.path, progress)
        key = key_of_run(test, until, report, str(out))
        kept = _kept(folder, key)
        if kept is not None:
            for stage, message in kept["said"] if progress is not None else ():
                progress(stage, message)  # type: ignore[misc]
            return Said(kept["told"])
        from operando.pipeline.runner import run_in

        results, said, unwanted = run_in(folder, test, until, progress, report)
        told = tell(results)
        if said is not None:
            _keep(folder, key, {"schema": "operando/answer/1", "said": said, "told": told}, unwanted)
        return Said(told, results)


def results_go_to(out: Path) -> None:
    """Refuse a file where a folder is expected."""
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file, expected a folder for the results", where=str(out), hint="choose another name with -o")


def key_of_run(test: Test, *how: Any) -> str:
    """Key of everything that a run depends on: the test with its files by content, how it is asked for, the code."""
    states = [(name, _files(test, state)) for name, state in test.states.items()]
    geometry = None if test.geometry_file is None else (test.label(test.geometry_file), file_hash(test.geometry_file))
    effects = effects_hash(test.effects) if test.effects else None
    return key_of(test.name, test.settings(), test.geometry_units, states, geometry, effects, how, whole_code_hash())


def _files(test: Test, state: State) -> list[tuple[str, str, str]]:
    """Name, part that counts and content of the files of a state."""
    parts: list[tuple[Path, Span | None]] = [*state.runs, *((file, None) for file in state.frfs)]
    return [(test.label(file), repr(span), file_hash(file)) for file, span in parts]


def _kept(folder: ResultsFolder, key: str) -> dict[str, Any] | None:
    """What was said of a run under this key, if all that it left behind is as it was."""
    entry = folder.entry(ANSWER, key)
    if entry is None or not {"files", "unwanted"} <= entry.keys():
        return None
    if not folder.holds(entry["files"]) or any((folder.path / name).exists() for name in entry["unwanted"]):
        return None
    found: dict[str, Any] = json.loads((folder.path / ANSWER).read_text(encoding="utf-8"))
    return found


def _keep(folder: ResultsFolder, key: str, document: dict[str, Any], unwanted: Iterable[str]) -> None:
    folder.stage(ANSWER, key, lambda path: write_json(path, document), files=folder.hashes(ANSWER), unwanted=sorted(unwanted))
    folder.commit()
