"""``operando workbench``."""

from __future__ import annotations

import click

from operando.cli.answer import Answer, answers, say
from operando.cli.test_file import output_option, set_option


@click.command("workbench", epilog="Example: operando workbench pump-results")
@click.argument("source", metavar="DIR|TEST", type=click.Path())
@output_option
@set_option
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on 127.0.0.1 (default: a free one).")
@click.option("--no-open", is_flag=True, help="Do not open the browser.")
@answers
def workbench(source: str, output: str | None, changes: tuple[str, ...], port: int, no_open: bool) -> Answer:
    """Choose modes, effects, channels and bands in the browser, and run the test again; Ctrl-C ends it.

    DIR is a results folder, TEST a test file (its results folder: -o, else results/NAME here). What is done by hand is shown as lines of
    the test file first and written into it on demand. Only this machine can open the page, with the address printed here.
    """
    from operando.workbench import Bench, Served

    served = Served(Bench(source, output, changes), port)
    bench = served.bench
    test = None if bench.test_path is None else str(bench.test_path)
    document = {"schema": "operando/workbench/1", "address": served.address, "folder": str(bench.folder), "test": test,
                "writes": bench.draft is not None, "why_not": bench.why_not or None}  # fmt: skip
    lines = [f"Workbench: {served.address}", f"Results:   {bench.folder}", f"Test file: {test}" if test else "", bench.why_not]
    text = "\n".join(line for line in [*lines, "Ctrl-C ends it."] if line)

    def show() -> None:
        import webbrowser

        if not webbrowser.open(served.address):
            say("operando: no browser could be started; open the address above")

    def serve() -> None:
        import threading

        if not no_open:
            threading.Thread(target=show, daemon=True).start()  # a browser in the terminal returns when it is left
        served.forever()

    return Answer(document, text, then=serve)
