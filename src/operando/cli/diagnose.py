"""``operando diagnose``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from operando.cli.answer import Answer, answers, table


@click.command("diagnose", epilog="Example: operando diagnose pump-results")
@click.argument("source", metavar="DIR|TEST", type=click.Path())
@click.option("-o", "--output", type=click.Path(file_okay=False), help="Results folder for a test file (default: results/NAME here).")
@answers
def diagnose(source: str, output: str | None) -> Answer:
    """Where the idle model fails in operation, and what is missing.

    A results folder shows (or makes) its diagnosis; a test file is run up to this stage first.
    """
    from operando.errors import MissingError
    from operando.store import load_results

    path = Path(source)
    if path.is_file() and path.suffix == ".toml":
        from operando.cli.run import default_output
        from operando.cli.story import Clock
        from operando.config import load_test
        from operando.pipeline import run

        test = load_test(path)
        out = default_output(test.name) if output is None else Path(output)
        results = run(test, out, until="diagnose", progress=Clock())
    else:
        results = load_results(source, only=("name", "diagnosis", "left_out"))
    if results.diagnosis is None:
        reason = results.left_out.get("diagnose", "the run ended before it")
        raise MissingError(f"there is no diagnosis: {reason}", where=source, hint="run `operando run test.toml` on the test")
    return Answer(results.diagnosis, text_of(results.name, results.diagnosis))


VERDICTS = {
    "no_misfit": "the idle model predicts the running machine; nothing is missing",
    "explained": "what is missing is found",
    "ambiguous": "something is missing; the data cannot tell which of several effects it is",
    "partial": "part of what is missing is found",
    "unexplained": "something is missing that no effect of the catalogue explains",
}


def text_of(name: str, document: dict[str, Any]) -> str:
    """The diagnosis for people: answer first."""
    lines = [f"{name}: {document['verdict']} - {VERDICTS[document['verdict']]}."]
    for effect in document["effects"]:
        lines.append(f"  {effect['explanation']}")
        lines.append(f"  to confirm: {effect['confirm']}")
    if document["ambiguous_with"]:
        lines.append("Cannot be told from: " + "; ".join(e["explanation"] for e in document["ambiguous_with"]))
    if document.get("proposed_measurement"):
        lines.append(f"What would decide: {document['proposed_measurement']}")
    parts = ["\n".join(lines), ladder_table(document["ladder"])]
    if document.get("notes"):
        parts.append("\n".join(f"note: {n}" for n in document["notes"]))
    return "\n\n".join(parts)


def ladder_table(ladder: list[dict[str, Any]]) -> str:
    """The error before and after each step, on all lines and on those that nothing was fitted to."""
    rows = []
    for row in ladder:
        added = row["added"]
        label = "idle model" if added is None else f"+ {added['kind']} {', '.join(added['location'])}".strip()
        rows.append([row["step"], label, row["error_db"], row["heldout_error_db"], row["misfit"], row["heldout_misfit"]])
    return table(rows, ["step", "model", "error dB", "held-out dB", "misfit", "held-out misfit"])
