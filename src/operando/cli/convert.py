"""``operando convert``."""

from __future__ import annotations

from typing import Any

import click

from operando.cli.answer import Answer, answers


@click.command("convert", epilog="Example: operando convert run1.mat run1.uff")
@click.argument("source", metavar="IN", type=click.Path())
@click.argument("target", metavar="OUT", type=click.Path(dir_okay=False))
@answers
def convert(source: str, target: str) -> Answer:
    """Convert a file; the format of OUT follows its ending.

    Lossless where both formats can hold what is there, else it says what is lost.
    """
    from operando.io import convert as convert_file

    found: Any = convert_file(source, target)
    document: dict[str, Any] = {"schema": "operando/convert/1", "in": source, "out": target}
    lines = [f"{source} → {target}"]
    if isinstance(found, dict):
        document |= found
    findings = found.get("findings", []) if isinstance(found, dict) else (found or [])
    shown = [f if isinstance(f, dict) else f.to_dict() for f in findings if isinstance(f, dict) or hasattr(f, "to_dict")]
    document["findings"] = shown
    lines += [f"  {f.get('severity', 'info')}: {f.get('message', '')}" for f in shown]
    return Answer(document, "\n".join(lines))
