"""``operando diagnose``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, own_option, table
from operando.cli.sources import not_made
from operando.cli.summary import open_report, run_to
from operando.cli.test_file import need_stage, open_option, output_option, read_test, results_folder, set_option

if TYPE_CHECKING:
    from operando.pipeline.by_hand import Refit


@click.command("diagnose", epilog="Example: operando diagnose pump-results")
@click.argument("source", metavar="DIR|TEST", type=click.Path())
@output_option
@set_option
@open_option
@own_option
@answers
def diagnose(source: str, output: str | None, changes: tuple[str, ...], show: bool) -> Answer:
    """Where the error of the idle model lies in operation, and what is missing.

    A results folder shows its diagnosis; a test file is run up to this stage first.
    """
    from operando.store import load_results

    path = folder = Path(source)
    if (path.is_file() and path.suffix == ".toml") or (
        path.is_dir() and not (path / "model.h5").exists() and (path / "test.toml").exists()
    ):
        test = read_test(path, changes)
        need_stage(test, "diagnose")
        folder = results_folder(test.name, output)
        results = run_to(test, folder, "diagnose", report=show or None)
    elif changes or output is not None:
        raise click.UsageError("--set and -o belong to a test file; the results folder given has its settings")
    else:
        results = load_results(source, only=("name", "diagnosis", "left_out"))
    if results.diagnosis is None:
        raise not_made("there is no diagnosis", "diagnose", results, str(folder))
    if show:
        open_report((folder.parent if folder.is_file() else folder) / "report.html")
    return Answer(results.diagnosis, text_of(results.name, results.diagnosis))


def text_of(name: str | None, document: dict[str, Any]) -> str:
    """The diagnosis for people in the words of the report: answer first (left out without a name, where it stands above), then by step."""
    from operando.report.words_diagnosis import diagnosis_words, found_intro

    words = diagnosis_words(document)
    lines = [] if name is None else [f"{name}: {words.verdict} - {words.title[:1].lower()}{words.title[1:]}."]
    intro = found_intro(words)
    lines += [intro] if intro else []
    lines += [f"  {sentence}" if intro else sentence for sentence in words.found]
    lines += [*words.sentences, *words.decide]
    parts = ["\n".join(lines), steps_table(document["ladder"])]  # the hold-out set is named above
    if words.ladder.decibel and words.ladder.shown_floor is not None:
        parts[-1] += f"\nnoise floor {words.ladder.shown_floor:.4g} dB"
    if document.get("notes"):
        parts.append("\n".join(f"note: {n}" for n in document["notes"]))
    return "\n\n".join(parts)


def steps_table(ladder: list[dict[str, Any]], judged_on: Mapping[str, Any] | None = None) -> str:
    """The error before and after each step, on all lines and on those that nothing was fitted to; these are named."""
    from operando.report.words_diagnosis import lines_words
    from operando.structure.effects import place_words

    rows = []
    for row in ladder:
        added = row["added"]
        label = (
            "idle model" if added is None else f"+ {'removed ' if added.get('removed') else ''}{added['kind']} {place_words(added)}".strip()
        )
        rows.append([row["step"], label, row["error_db"], row["heldout_error_db"], row["misfit"], row["heldout_misfit"]])
    said = lines_words(judged_on or {})
    head = table(rows, ["step", "model", "error dB", "hold-out dB", "χ²", "hold-out χ²"])
    used = "\ndB: rms over the lines that the diagnosis uses; a comparison of models takes all lines in band"
    used = used if any(row["error_db"] is not None for row in ladder) else ""
    days = [str(row["step"]) for row in ladder if row.get("with_between")]
    used += f"\nwith what differs between the two measurements: step {', '.join(days)}" if days else ""
    return f"{head}{used}\nχ²: reduced chi-square, 1 = as good as the noise allows" + (f"; hold-out set: {said}" if said else "")


def refit_answer(refit: Refit, folder: str, show: bool) -> Answer:
    """What `add` and `remove` did: in words, and as the error before and after."""
    done = refit.document
    if show:
        open_report(Path(folder) / "report.html")
    return Answer({"schema": "operando/ladder/1", **done}, "\n".join([*refit.words, "", steps_table(done["ladder"], done["judged_on"])]))
