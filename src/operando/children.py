"""Processes of operando's own that work for this one and speak JSON, one document a line: how they are started, and what they do first."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

Say = Callable[[dict[str, Any]], None]

ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1") | {"MPLBACKEND": "Agg"}
"""One thread for each process, and no display."""


def started(module: str, *options: str, stderr: Any = None) -> subprocess.Popen[str]:
    """A process that runs ``main`` of a module; raises an OSError where there is none to be had."""
    code = f"import sys; sys.path.insert(0, sys.argv[1]); from {module} import main; main()"
    # -P: a folder of measurements is no place to import from
    command = [sys.executable, "-P", *options, "-c", code, str(Path(__file__).resolve().parents[1])]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "encoding": "utf-8"}
    return subprocess.Popen(command, stderr=stderr, env=os.environ | ENVIRONMENT, **pipes)


def speaker() -> Say:
    """What says a document to the process that asks; called first in the one that answers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks; its end is ours
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no answer
    return lambda document: print(json.dumps(document), file=answers, flush=True)


def end_with_stdin(take: Callable[[str], object] = len) -> None:
    """Let ``take`` have what comes on stdin, line by line, and end the process with it, also in the middle of its work."""

    def listen() -> None:
        for line in sys.stdin:
            take(line)
        atomic = sys.modules.get("operando.atomic")
        if atomic is not None:
            atomic.remove_unfinished()
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
