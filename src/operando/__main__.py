"""``operando`` and ``python -m operando``: the command line, which Ctrl-C ends at once from here on."""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn


def main() -> None:
    """Run the command line.

    Ctrl-C ends the process where it stands: whatever it writes appears whole or not at all, and nothing has to be unwound. An exception
    instead would be lost, or shown as a traceback, wherever it meets the import of an extension module or a callback. Where the caller
    has the signal ignored, it stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupted)
    import gc

    gc.set_threshold(10_000, 20, 50)  # figures are some hundred thousand small objects that live on: looked through less often
    from operando.cli import main as command

    command(prog_name="operando")


def _interrupted(signum: int, frame: object) -> NoReturn:
    hint = "finished stages are kept; the same command goes on from there"
    atomic = sys.modules.get("operando.atomic")
    if atomic is not None and hasattr(atomic, "remove_unfinished"):
        atomic.remove_unfinished()
    answer = sys.modules.get("operando.cli.answer")
    if "--json" in sys.argv and not getattr(answer, "printing", False):
        document = f'{{"schema": "operando/error/1", "error": "interrupted", "where": null, "hint": "{hint}"}}\n'
        os.write(1, document.encode())
    if getattr(sys.modules.get("operando.cli.progress"), "active", False):
        os.write(2, b"\r\x1b[2K\x1b[?25h")  # the bar goes, the cursor comes back
    os.write(2, f"operando: interrupted ({hint})\n".encode())
    os._exit(130)


if __name__ == "__main__":
    main()
