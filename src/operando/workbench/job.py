"""One piece of work in the background: a process of its own, followed by a thread, stopped at any moment."""

from __future__ import annotations

import json
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from operando.children import started
from operando.pipeline import STAGES
from operando.pipeline.share import WORDS, Share, duration, share_of

NAMES = {
    "run": "Run the test", "add": "Add an effect and refit the model", "candidate": "Add a candidate and refit the model",
    "suggested": "Add the suggested effects and refit the model", "remove": "Take an effect back and refit the model",
}  # fmt: skip


class Job:
    """Work in a process of its own, begun by the constructor; its task is that of :func:`operando.workbench.worker.done`."""

    def __init__(self, task: dict[str, Any]) -> None:
        self.name = NAMES[task["do"]]
        self.error: dict[str, Any] | None = None
        self.words: list[str] = []
        self.lines: list[str] = []
        self.stopped = self.over = False
        self._message = ""
        self._share: Share = share_of(STAGES if task["do"] == "run" else (), Path(task["folder"]))
        self._process = started("operando.workbench.worker")
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(json.dumps(task) + "\n")
            self._process.stdin.flush()
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        assert self._process.stdout is not None
        answer: dict[str, Any] = {}
        for line in self._process.stdout:
            with suppress(ValueError):
                answer = json.loads(line)
            if "stage" in answer:
                self._share.at(answer["stage"], answer["message"])
                self._message = answer["message"].strip()
                if not answer["message"].startswith("  "):
                    self.lines.append(f"{WORDS.get(answer['stage'], answer['stage'])}: {self._message}")
        code = self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        self.error, self.words = answer.get("error"), answer.get("words", [])
        if self.error is None and "words" not in answer and not self.stopped:
            self.error = {"error": f"the process ended (exit status {code})", "where": self.name, "hint": "not enough memory?"}
        self.over = True

    def stop(self) -> None:
        """End the work; what was finished of it is kept, and files appear whole or not at all."""
        if not self.over:
            self.stopped = True
            self._process.terminate()

    def wait(self, seconds: float | None = None) -> None:
        """Wait for the end."""
        self._thread.join(seconds)

    def state(self) -> dict[str, Any]:
        """What a page shows: name, share (None where there are no stages to count), stage and message in words, time, how it ended."""
        left = self._share.left_s
        time = f"{duration(self._share.elapsed_s)} so far" if left is None or not self._share.counts else f"about {duration(left)} left"
        return {
            "name": self.name, "over": self.over, "stopped": self.stopped, "error": self.error, "words": self.words, "lines": self.lines,
            "share": self._share.share if self._share.counts else None, "stage": WORDS.get(self._share.stage, self._share.stage),
            "message": self._message, "time": time,
        }  # fmt: skip
