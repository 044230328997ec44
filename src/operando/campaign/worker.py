"""A process that runs tests one after another: a task a line on stdin, an answer a line on what was stdout.

It ends when its driver does, however that ends: the end of stdin says so, also while a test is running.
"""

from __future__ import annotations

import json
import os
import queue

from operando.children import end_with_stdin, speaker


def main() -> None:
    """Serve until stdin ends."""
    say = speaker()
    tasks: queue.Queue[str] = queue.Queue()
    end_with_stdin(tasks.put)

    from operando import threads
    from operando.campaign.task import Task, perform

    threads.limit(1)
    say({"ready": os.getpid()})
    while True:
        say(perform(Task.from_dict(json.loads(tasks.get()))))
