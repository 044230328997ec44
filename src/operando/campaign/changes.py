"""What changes from state to state: effects against the baseline, steps, and single states that stand out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.indicators import INTERVAL
from operando.report.words_diagnosis import effect_key, effect_words

LEAST = 7
"""States from which a usual scatter can be told: a running median of five, and at least three states it judges."""
BEYOND = 5.0
"""Scatters beyond which a value stands out: 20 000 values (1000 tests of 20 modes) of normal scatter give one beyond 4.1, so five
leaves a false alarm in a hundred such campaigns."""
MOST_STRETCHES = 3
"""Stretches of states that are told one by one; an effect that comes and goes more often is counted."""


@dataclass(frozen=True)
class Stretch:
    """States, one after another, in which an effect differs from the baseline."""

    what: str  # appears, is gone, everywhere, scattered
    effect: Mapping[str, Any]  # as it is at the first of them
    last: Mapping[str, Any]  # as it is at the last of them
    states: tuple[int, ...]  # those that show it
    open: bool  # whether it holds to the last diagnosed state


def told(diagnosis: Mapping[str, Any] | None) -> bool:
    """Whether a diagnosis says what is missing, or that nothing is."""
    return diagnosis is not None and diagnosis.get("verdict") not in (None, "inconclusive")


def stretches(diagnoses: Sequence[Mapping[str, Any] | None], baseline: int) -> list[Stretch]:
    """Effects that come, go, or are everywhere in states in order, against the baseline; one not diagnosed counts as if it had none."""
    own = [{effect_key(e): e for e in (d or {}).get("effects") or []} for d in diagnoses]
    others = [{effect_key(e): e for e in (d or {}).get("ambiguous_with") or []} for d in diagnoses]
    known = [told(d) for d in diagnoses]
    keys = list(dict.fromkeys(key for effects in own for key in effects))
    out: list[Stretch] = []
    for key in keys:
        shows = [None if not known[i] else key in own[i] or (bool(own[i]) and key in others[i]) for i in range(len(own))]
        in_baseline = bool(shows[baseline])
        wanted = not in_baseline
        runs = _runs(shows, wanted)
        at = lambda i, key=key: own[i].get(key) or others[i].get(key) or {}  # noqa: E731
        if in_baseline:
            everywhere = tuple(i for i, s in enumerate(shows) if s)
            out.append(Stretch("everywhere", at(everywhere[0]), at(everywhere[-1]), everywhere, not runs))
        if len(runs) > MOST_STRETCHES:
            states = tuple(i for run in runs for i in run)
            out.append(_stretch("scattered" if wanted else "is gone", at, states, baseline, shows, wanted))
        else:
            out += [_stretch("appears" if wanted else "is gone", at, tuple(run), baseline, shows, wanted) for run in runs]
    return sorted(
        out, key=lambda s: (s.what == "everywhere", s.what == "scattered", -len(s.states) if s.what == "appears" else 0, s.states)
    )


def _stretch(what: str, at: Any, states: tuple[int, ...], baseline: int, shows: Sequence[bool | None], wanted: bool) -> Stretch:
    effect, last = (at(states[0]), at(states[-1])) if wanted else (at(baseline), at(baseline))
    after = [s for s in shows[states[-1] + 1 :] if s is not None]
    return Stretch(what, effect, last, states, not after)


def _runs(shows: Sequence[bool | None], wanted: bool) -> list[list[int]]:
    """Runs of states that show something; those that say nothing do not break one."""
    runs: list[list[int]] = []
    go_on = False
    for i, value in enumerate(shows):
        if value is None:
            continue
        if value == wanted:
            if go_on:
                runs[-1].append(i)
            else:
                runs.append([i])
        go_on = value == wanted
    return runs


def size_change(first: Mapping[str, Any], last: Mapping[str, Any]) -> str:
    """The size of an effect; of two states, both sizes where they differ by more than their 95 % intervals."""
    one, two = effect_words(first).size, effect_words(last).size
    if one == two or not two:
        return one
    a, b = (next(iter((e.get("parameters") or {}).values()), None) for e in (first, last))
    if not isinstance(a, Mapping) or not isinstance(b, Mapping) or a.get("value") is None or b.get("value") is None:
        return one
    spread = INTERVAL * float(np.hypot(a.get("std") or 0.0, b.get("std") or 0.0))
    return f"{one} at first, {two} at last" if abs(float(a["value"]) - float(b["value"])) > spread else one


def outliers(values: Sequence[float], stds: Sequence[float | None]) -> list[int]:
    """Places of single values that stand out from their neighbours: a spike, not a change that stays.

    The value is compared with the running median of five, which a change that stays, or goes on, passes through untouched. The first
    and last two values are not tested: nothing tells a spike from a change there. The scatter counts as no smaller than the deviations.
    """
    x: NDArray[np.float64] = np.array(values, float)
    found: list[int] = []
    while x.size >= LEAST and len(found) < x.size // 2:
        rest = np.abs(x[2:-2] - np.median(np.lib.stride_tricks.sliding_window_view(x, 5), axis=1))
        worst = int(np.argmax(rest))
        if rest[worst] <= BEYOND * _scatter(rest, stds, x):
            break
        found.append(worst + 2)
        x[worst + 2] = (x[worst + 1] + x[worst + 3]) / 2  # it moves the medians beside it, too: they are judged without it
    return sorted(set(found))


def steps(
    values: Sequence[float], stds: Sequence[float | None], places: Sequence[float], without: Sequence[int] = ()
) -> list[tuple[int, int]]:
    """Pairs of neighbouring values between which there is a step: a change beyond five scatters of the usual one.

    The usual change is one a length of the axis, where all places are apart. Values that stand out alone are left out.
    """
    keep = [i for i in range(len(values)) if i not in set(without)]
    if len(keep) < LEAST:
        return []
    x, at = np.asarray(values, float)[keep], np.asarray(places, float)[keep]
    apart = np.diff(at)
    change = np.diff(x)
    usual = np.median(change / apart) * apart if np.all(apart > 0) else np.full_like(change, np.median(change))
    rest = np.abs(change - usual)
    limit = BEYOND * _scatter(rest, [None if stds[i] is None else np.sqrt(2) * float(stds[i] or 0) for i in keep], x)
    return [(keep[int(i)], keep[int(i) + 1]) for i in np.flatnonzero(rest > limit)]


def _scatter(rest: NDArray[np.float64], stds: Sequence[float | None], x: NDArray[np.float64]) -> float:
    """Robust scatter of what remains, no smaller than the values' own deviations or a millionth of them."""
    known = [s for s in stds if s is not None]
    floor = 1e-6 * float(np.median(np.abs(x)))
    return float(max(1.4826 * np.median(rest), np.median(known) if known else 0.0, floor))
