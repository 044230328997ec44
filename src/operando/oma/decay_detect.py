"""Free decays among operating records: a sudden start, then a steady fall of power by orders of magnitude."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import row_statistics

FALL = 50.0
"""Fall of power (17 dB) within a record from which on it is a decay. The power of a stationary record in windows of two or more periods of
its lowest mode changes by less than that for good: it comes back (``RISE``) within some correlation times."""
ONSET = 10.0
"""Rise of power from a window to the next but one at which a decay begins."""
RISE = 3.0
"""A window may exceed the lowest of those before it so many times while the decay lasts (beating of close modes), no more."""
FLOOR = 4.0
"""The decay ends where its power is so many times that of the quietest tenth of the record."""
LEAST_WINDOWS, MOST_WINDOWS = 12, 200
INSIDE = 0.9
"""Part of the power above the noise that must lie in the decays."""
LEAST_FALL_PIECE = 10.0
"""A piece between two onsets must fall so far to be analysed (a knock that came too early leaves little)."""


def find_decays(run: NDArray[Any], rate: float, lowest_hz: float) -> list[tuple[int, int]]:
    """Free decays in a record: (first sample, one past the last) of each; empty if the record is no record of decays.

    Power is taken in windows of two periods of the lowest frequency (at least 12, at most 200 windows), as the mean over channels, each
    over the quietest tenth of its windows. A record of decays begins with its loudest window, or with a quiet stretch and a sudden rise;
    from each rise on the power falls, with ripples, down to the noise or the next rise; in all it falls by 17 dB or more. A record that is
    loud for long and then dies away (a machine that stops) is none.
    """
    samples = run.shape[1]
    end = row_statistics(run[:, -max(samples // 10, 1) :]).mean[:, None]
    count = int(np.clip(samples / rate * lowest_hz / 2, LEAST_WINDOWS, MOST_WINDOWS))
    length = samples // count
    if length < 4:
        return []

    def squares(window: int) -> NDArray[np.float64]:
        return np.asarray((np.asarray(run[:, window * length : (window + 1) * length]) - end) ** 2)

    by_channel = np.array([squares(window).mean(axis=1) for window in range(count)]).T
    quiet = np.sort(by_channel, axis=1)[:, : max(count // 10, 1)].mean(axis=1)
    quiet = np.maximum(quiet, 1e-8 * by_channel.max(axis=1) + 1e-300)
    level = np.mean(by_channel / quiet[:, None], axis=0)
    floor = float(np.sort(level)[: max(count // 10, 1)].mean())
    if level.max() < FALL * floor:
        return []
    onsets = _onsets(level)
    pieces = []
    for first, stop in zip(onsets, [*onsets[1:], count], strict=True):
        last = _end(level[first:stop], floor)
        if last is None:
            return []  # power that does not fall, or rises on the way: forces act on
        if level[first] >= LEAST_FALL_PIECE * level[first + last]:
            begin = first * length + int(np.argmax(np.mean(squares(first) / quiet[:, None], axis=0)))
            pieces.append((begin, (first + last + 1) * length))
    above = np.maximum(level - 2 * floor, 0)
    inside = sum(above[max(a // length - 2, 0) : b // length].sum() for a, b in pieces)  # with the rise before
    return pieces if inside > INSIDE * above.sum() else []


def _onsets(level: NDArray[np.float64]) -> list[int]:
    """Windows in which a decay begins: loudest after a sudden rise (or at the start of the record)."""
    top = float(level.max())
    found: list[int] = []
    for k in range(level.size):
        before = float(level[max(k - 2, 0) : k].min()) if k else 0.0
        here = float(level[k])
        following = float(level[k + 1]) if k + 1 < level.size else 0.0
        if here > ONSET * before and here >= following and here > top / FALL and (not found or k - found[-1] > 2):
            found.append(k)
    return found or [int(np.argmax(level))]


def _end(level: NDArray[np.float64], floor: float) -> int | None:
    """Last window of a decay before it is lost in the noise; None where power rises on the way, or hardly falls."""
    lowest = level[0]
    for k in range(1, level.size):
        if level[k] < FLOOR * floor:
            return k - 1 if k > 1 else None
        if level[k] > RISE * lowest:
            return None
        lowest = min(lowest, level[k])
    return level.size - 1 if level.size > 2 and level[0] > LEAST_FALL_PIECE * level[-1] else None
