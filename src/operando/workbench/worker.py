"""A process that does one piece of work for the workbench: the task a line on stdin, what it says lines on what was stdout.

It ends when the workbench does, however that ends: the end of stdin says so.
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable
from typing import Any

from operando.children import end_with_stdin, speaker


def main() -> None:
    """Do the task and end."""
    say = speaker()
    task = json.loads(sys.stdin.readline())
    end_with_stdin()
    say(done(task, lambda stage, message: say({"stage": stage, "message": message})))


def done(task: dict[str, Any], progress: Callable[[str, str], None]) -> dict[str, Any]:
    """What came of a task: ``{"words": [...]}``, or ``{"error": ...}`` as in ``operando/error/1``.

    The task holds ``do`` (run, add, candidate, suggested or remove), ``folder``, ``test`` with ``changes`` (its own kinds of effects are
    imported), and what each needs.
    """
    from operando.errors import OperandoError

    try:
        return {"words": _words(task, progress)}
    except OperandoError as error:
        return {"error": error.to_dict()}
    except Exception as error:
        traceback.print_exc()
        text = f"unexpected {type(error).__name__}: {error}"
        return {"error": OperandoError(text, where="operando itself", hint="a fault of the program, not of your data").to_dict()}


def _words(task: dict[str, Any], progress: Callable[[str, str], None]) -> list[str]:
    from operando.config import load_test

    folder, what = task["folder"], task["do"]
    test = None if task.get("test") is None else load_test(task["test"], task.get("changes", ()))
    if what == "run":
        from operando.pipeline import run
        from operando.pipeline.summary import failure

        assert test is not None
        results = run(test, folder, progress=progress)
        failed = failure(results, folder)
        if failed is not None:
            raise failed
        return [words for name, words in results.facts().items() if name != "Test" and words]
    from operando.pipeline import by_hand

    if what == "add":
        return list(by_hand.add_effects(folder, task["effects"], fix=task["fix"], progress=progress).words)
    if what == "candidate":
        return list(by_hand.add_candidate(folder, task["number"], progress=progress).words)
    if what == "suggested":
        return list(by_hand.add_suggested(folder, progress=progress).words)
    return list(by_hand.remove_effect(folder, task["step"], progress=progress).words)
