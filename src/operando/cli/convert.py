"""``operando convert``."""

from __future__ import annotations

from typing import Any

import click

from operando.cli.answer import Answer, answers, apart_from_runs


@click.command("convert", epilog="Example: operando convert run1.mat run1.uff")
@click.argument("source", metavar="IN", type=click.Path())
@click.argument("target", metavar="OUT", type=click.Path(dir_okay=False))
@answers
def convert(source: str, target: str) -> Answer:
    """Convert a file; the format of OUT follows its ending (.uff, .unv, .h5, .mat, .csv).

    Lossless where both formats can hold what is there, else it says what is lost.
    """
    from operando.io import convert as convert_file

    apart_from_runs(target, "convert")
    found: dict[str, Any] = convert_file(source, target)
    lines = [f"{target} written ({found['format_out']}, from {found['format_in']}):"]
    lines += [f"  {text}" for text in found["written"]]
    if found["passed_on"]:
        lines.append(f"  {len(found['passed_on'])} sets passed on unchanged")
    lines += [f"  lost: {text}" for text in found["lost"]]
    lines += [f"  {f['severity']}: {f['message']}" for f in found["findings"]]
    return Answer({"schema": "operando/convert/1"} | found, "\n".join(lines))
