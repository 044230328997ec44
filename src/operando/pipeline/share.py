"""How far a run is: the share done and the time left, from the seconds that each stage is expected to take."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

WORDS = {
    "inspect": "looking at the files",
    "frf": "idle FRFs",
    "ema": "idle modes",
    "oma": "operational modes",
    "ofrf": "operational FRFs",
    "compare": "comparison with the validation measurement",
    "diagnose": "diagnosis",
    "report": "report",
    "store": "writing the results",
    "refit": "refit with the effects",
}
TYPICAL_S = {"inspect": 0.4, "frf": 2.7, "ema": 16.0, "oma": 3.2, "ofrf": 0.4, "compare": 5.6, "diagnose": 35.0, "report": 5.7}
"""Seconds of the stages on the packaged example; of them only the proportions count, where the folder holds no timings of its own."""
_PART = 0.95
"""Share of a stage that counts as done at most before the next one begins."""


class Share:
    """Share done and time left, from the seconds that each stage is expected to take (``expected_s``, in order).

    Where these are not ``known`` from an earlier run, only their proportions count, and the first stage that is done sets the pace.
    """

    def __init__(self, expected_s: Mapping[str, float], known: bool = False, now: Callable[[], float] = time.monotonic) -> None:
        self._left = dict(expected_s)
        self._spent_s = self._done_s = 0.0
        self._pace: float | None = 1.0 if known else None
        self._now = now
        self._begun = now()
        self.stage = ""
        self.start_s = now()

    @property
    def counts(self) -> bool:
        """Whether there are stages to count."""
        return bool(self._left)

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return self._now() - self.start_s

    def at(self, stage: str, message: str) -> None:
        """Take note of what a stage says."""
        if stage not in self._left:
            if stage != self.stage and self.stage in self._left:  # what follows the last stage
                self._finish()
            self.stage = stage
            return
        if stage != self.stage:
            self._finish()
            for earlier in list(self._left)[: list(self._left).index(stage)]:
                self._left[earlier] = 0.0  # passed without a word
            self.stage, self._begun = stage, self._now()
        if message.startswith(("unchanged", "left out")):
            self._left[stage] = 0.0

    def _finish(self) -> None:
        seconds = self._left.get(self.stage, 0.0)
        if seconds:
            took = self._now() - self._begun
            self._done_s += seconds
            self._left[self.stage] = 0.0
            self._spent_s += took
            self._pace = self._spent_s / self._done_s

    def _inside(self) -> float:
        """Expected seconds of the present stage that are done."""
        return min(_PART * self._left.get(self.stage, 0.0), (self._now() - self._begun) / (self._pace or 1.0))

    @property
    def share(self) -> float:
        """Part of the expected work that is done, 0 to 1."""
        total = self._done_s + sum(self._left.values())
        return (self._done_s + self._inside()) / total if total > 0 else 1.0

    @property
    def left_s(self) -> float | None:
        """Seconds to the end, None where nothing tells the pace yet."""
        return None if self._pace is None else max(sum(self._left.values()) - self._inside(), 0.0) * self._pace


def duration(seconds: float) -> str:
    """Seconds in words, as coarse as they are known."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def share_of(stages: Sequence[str], folder: Path | None) -> Share:
    """What counts the stages of a run; the timings of the last run in the folder say how long each takes."""
    try:
        told = json.loads((folder / "timings.json").read_text(encoding="utf-8"))["seconds"] if folder is not None else {}
        seconds = {stage: float(told[stage]) for stage in stages}
        return Share(seconds, known=bool(stages))
    except (OSError, ValueError, KeyError, TypeError):
        return Share({stage: TYPICAL_S[stage] for stage in stages})
