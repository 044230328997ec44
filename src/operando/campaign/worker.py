"""A process that runs tests one after another: a task a line on stdin, an answer a line on what was stdout.

It ends when its driver does, however that ends: the end of stdin says so, also while a test is running.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading


def main() -> None:
    """Serve until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the driver; its end is ours
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints belongs to the log
    tasks: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()

    from operando import threads
    from operando.campaign.task import Task, perform

    threads.limit(1)
    _say(answers, {"ready": os.getpid()})
    while True:
        _say(answers, perform(Task.from_dict(json.loads(tasks.get()))))


def _say(answers: object, document: dict[str, object]) -> None:
    print(json.dumps(document), file=answers, flush=True)  # type: ignore[call-overload]


def _listen(tasks: queue.Queue[str]) -> None:
    for line in sys.stdin:
        tasks.put(line)
    atomic = sys.modules.get("operando.atomic")
    if atomic is not None:
        atomic.remove_unfinished()
    os._exit(0)


if __name__ == "__main__":
    main()
