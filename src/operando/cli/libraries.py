"""``operando compare-libraries``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from operando.cli.answer import Answer, answers, table
from operando.cli.summary import open_report, run_to
from operando.cli.test_file import open_option, output_option, read_test, results_folder, set_option

if TYPE_CHECKING:
    from operando.contrib import LibraryComparison


@click.command("compare-libraries", epilog="Example: operando compare-libraries pump/test.toml -o pump-results")
@click.argument("test", type=click.Path())
@output_option
@set_option
@open_option
@answers
def compare_libraries(test: str, output: str | None, changes: tuple[str, ...], show: bool) -> Answer:
    """The same data through operando, sdypy-EMA and pyOMA-2: frequencies, damping, MAC and time, mode by mode.

    A test up to its modes, as with `second_opinion = true` in [analysis]; the report has the same tables.
    """
    from operando.contrib import LibraryComparison
    from operando.pipeline.summary import failure

    loaded = read_test(test, changes, second_opinion=True)
    out = results_folder(loaded.name, output)
    results = run_to(loaded, out, "oma", report=True)
    found = [LibraryComparison.from_dict(entry) for entry in results.libraries]
    if show:
        open_report(out / "report.html")
    document: dict[str, Any] = {"schema": "operando/libraries/1", "test": results.name, "results": str(out)}
    document |= {"libraries": [comparison.to_dict() for comparison in found], "left_out": results.left_out}
    return Answer(document, _text(results.name, found, out), failure(results, out))


def _text(name: str, found: list[LibraryComparison], out: Path) -> str:
    parts = [f"{name}: " + ("; ".join(f"{c.facts()['Library']}: {c.facts()['Modes']}" for c in found) or "no modes to compare") + "."]
    for c in found:
        if c.note:
            continue
        number = lambda v, digits: "" if v is None else f"{v:.{digits}f}"  # noqa: E731
        rows = [
            [
                number(m.frequency_hz, 4),
                number(m.other_frequency_hz, 4),
                number(None if m.damping_ratio is None else 100 * m.damping_ratio, 3),
                number(None if m.other_damping_ratio is None else 100 * m.other_damping_ratio, 3),
                number(m.mac, 3),
                "yes" if m.agrees else "no",
                m.reference or "",
            ]
            for m in c.modes
        ]
        head = ["Hz", "other Hz", "damping %", "other %", "MAC", "agrees", "reference"]
        if not any(row[-1] for row in rows):
            head, rows = head[:-1], [row[:-1] for row in rows]
        times = [f"{c.library} {c.seconds:.1f} s" if c.seconds is not None else ""]
        times += [f"operando {c.own_seconds:.1f} s, with uncertainties" if c.own_seconds is not None else ""]
        parts.append(f"{c.library}, {c.state} state ({c.method}):\n{table(rows, head)}\n{c.rule}\ntime: {', '.join(t for t in times if t)}")
    report = out / "report.html"
    return "\n\n".join([*parts, f"Report: {report}" if report.exists() else f"Results: {out}"])
