"""What all commands share: the answer as text or JSON, errors without tracebacks, progress on stderr."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from operando.errors import OperandoError
from operando.jsonable import json_text
from operando.printable import printable


@dataclass(frozen=True)
class Answer:
    """What a command found: one JSON document, a short text, the error if part of the work failed, and what goes on after it is said."""

    document: dict[str, Any]
    text: str
    failure: OperandoError | None = None
    then: Callable[[], None] | None = None


_VERBOSITY = "operando.verbosity"
_OWN = "operando.own"


def _keep_own(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> None:
    ctx.meta[_OWN] = value


own_option = click.option(
    "--own",
    multiple=True,
    expose_value=False,
    callback=_keep_own,
    type=click.Path(),
    metavar="FILE",
    help="Python file with kinds of effects of your own, or the test file that names it; may be repeated.",
)
"""Option of commands on results in which kinds of the user's own may stand: nothing but what is named here is imported."""


def _load_own(files: Sequence[str]) -> None:
    """Import the files of ``--own``; a test file imports those that it names."""
    from operando.config import load_test
    from operando.own_effects import load_effects

    for file in files:
        if file.endswith(".toml"):
            load_test(file)
        else:
            load_effects([file], "--own")


def verbosity() -> int:
    """-1 with -q (the answer, warnings and errors alone), 1 with -v (also what goes on inside a stage), else 0."""
    context = click.get_current_context(silent=True)
    return 0 if context is None else int(context.meta.get(_VERBOSITY, 0))


printing = False
"""Whether the document is on its way to stdout: Ctrl-C puts no second one behind it from then on."""


def print_json(document: dict[str, Any]) -> None:
    """One JSON document on stdout."""
    global printing
    text = json_text(document)
    printing = True
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def answers(function: Callable[..., Answer]) -> Callable[..., int]:
    """Turn a function that returns an :class:`Answer` into the body of a click command with ``--json``, ``-q`` and ``-v``."""

    @click.option("-v", "--verbose", is_flag=True, help="Also what goes on inside each stage.")
    @click.option("-q", "--quiet", is_flag=True, help="No progress; warnings and errors only.")
    @click.option("--json", "as_json", is_flag=True, help="One JSON document on stdout.")
    @functools.wraps(function)
    def body(*args: Any, as_json: bool, quiet: bool, verbose: bool, **kwargs: Any) -> int:
        if quiet and verbose:
            raise click.UsageError("-q and -v exclude each other")
        click.get_current_context().meta[_VERBOSITY] = verbose - quiet
        warnings.formatwarning = _short_warning
        try:
            # what a library prints belongs to stderr: stdout holds the answer alone
            with contextlib.redirect_stdout(sys.stderr):
                _load_own(click.get_current_context().meta.get(_OWN, ()))
                answer = function(*args, **kwargs)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except KeyboardInterrupt:
            return _fail(OperandoError("interrupted", hint="finished stages are kept; the same command goes on from there"), as_json, 130)
        except BrokenPipeError:
            raise
        except OperandoError as error:
            return _fail(error, as_json)
        except OSError as error:
            return _fail(
                OperandoError(error.strerror or str(error), where=None if error.filename is None else str(error.filename)), as_json
            )
        except MemoryError:
            return _fail(OperandoError("not enough memory", hint="use a shorter record, fewer channels, or a narrower band"), as_json)
        except Exception as error:  # a fault of the program: explained, with the traceback in a file
            return _fail(_unexpected(error), as_json)
        if as_json:
            # the error of a part that failed comes first; what the rest found stands under "partial"
            failed = None if answer.failure is None else answer.failure.to_dict() | {"partial": answer.document}
            print_json(answer.document if failed is None else failed)
        elif answer.text:
            say(answer.text, err=False)
        if answer.failure is not None:
            say(f"operando: {answer.failure}")
            return 1
        if answer.then is not None:
            answer.then()
        return 0

    return body


def apart_from_runs(output: str | None, doing: str, *sources: str | Path) -> None:
    """Until the command ends, keep runs away from the results folder that a file to be written lies in; refuse to write over a source."""
    if output is not None:
        from operando.atomic import refuse_source
        from operando.pipeline.folder import apart_from_runs as held

        refuse_source(output, *sources)
        click.get_current_context().with_resource(held(output, doing))


def _fail(error: OperandoError, as_json: bool, code: int = 1) -> int:
    if as_json:
        print_json(error.to_dict())
    say(f"operando: {error}")
    return code


def _unexpected(error: Exception) -> OperandoError:
    log = write_log(traceback.format_exc())
    return OperandoError(
        f"unexpected {type(error).__name__}: {error}",
        where="operando itself",
        hint=f"this is a fault of the program, not of your data; the traceback is in {log}",
    )


def write_log(text: str) -> Path:
    """Keep a text in a new log file and return its path."""
    handle, name = tempfile.mkstemp(prefix="operando-", suffix=".log", text=True)
    with os.fdopen(handle, "w", encoding="utf-8") as stream:
        stream.write(printable(time.strftime("%Y-%m-%d %H:%M:%S\n") + " ".join(sys.argv) + "\n" + text, lines=True))
    return Path(name)


def _short_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    return f"warning: {printable(message)}\n"


def say(text: str, err: bool = True) -> None:
    """Text on stderr or stdout; what a file put into it cannot act on the terminal. A stderr that takes nothing ends no work."""
    try:
        click.echo(printable(text, lines=True), err=err)
    except OSError as error:
        if not err or isinstance(error, BrokenPipeError):
            raise


def table(rows: Iterable[Sequence[object]], head: Sequence[str]) -> str:
    """A plain text table; numbers to the right."""
    body = [[printable(cell if isinstance(cell, str) else _cell(cell)) for cell in row] for row in rows]
    widths = [max(len(h), *(len(r[i]) for r in body)) if body else len(h) for i, h in enumerate(head)]
    numeric = [_looks_numeric([r[i] for r in body]) for i in range(len(head))]
    lines = [list(head), *body]
    return "\n".join("  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in zip(r, widths, numeric, strict=True)).rstrip() for r in lines)


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _looks_numeric(cells: list[str]) -> bool:
    def number(text: str) -> bool:
        try:
            float(text.removeprefix("> "))
        except ValueError:
            return text in ("", "-")
        return True

    return all(number(c) for c in cells)
