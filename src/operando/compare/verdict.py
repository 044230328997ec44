"""Verdict of a diagnosis from its figures (specification, "Verdicts"): one rule for FRF lines, operational modes and records of force."""

from __future__ import annotations

import math
from collections.abc import Sequence

GOOD = 1.5
"""Reduced chi-square on the validation lines below which the data allow no better (contract)."""

PARTLY = 0.8
"""Part of the idle model's chi-square that the effects of ``partial`` explain (contract)."""

SURE = ("explained", "no_misfit", "ambiguous")
"""Verdicts that leave nothing to be explained."""

FLOOR_DB = 3.0
"""Noise floor above which dB have no meaning: FRFs that are known to a factor of √2 only. Of records by level, whose diagnosis states no
sizes that would have been found, nothing can be said to be missing or not above it."""


def verdict_of(
    holdout: Sequence[float], *, unseen: str | None = None, more: str | None = None, ambiguous: bool = False, within: bool = False
) -> tuple[str, str | None]:
    """Verdict, and what stands in the way of a better one.

    ``holdout`` is the reduced chi-square on the hold-out set at each step, that of the idle model first. ``unseen`` says why a change that
    counts could have passed unseen, ``more`` why another effect may be missing beside those found (None where one was looked for and none
    improved the model), ``ambiguous`` whether another kind or a far place does as well, ``within`` whether the last step leaves no more
    than the noise and the discrepancy allowed to it (specification), whatever its chi-square.
    """
    if holdout[0] < GOOD and unseen is not None:
        return "inconclusive", unseen
    if len(holdout) < 2:
        return ("no_misfit" if holdout[0] < GOOD else "unexplained"), None
    left = more or unseen
    if (within or holdout[-1] < GOOD) and left is None:
        return ("ambiguous" if ambiguous else "explained"), None
    left = left or f"the validation lines keep a reduced chi-square of {holdout[-1]:.3g}, where less than {GOOD:g} is asked"
    remains = min(holdout[-1], GOOD) if within else holdout[-1]
    return ("partial" if remains < (1 - PARTLY) * holdout[0] else "unexplained"), left


def floor_reason(noise_floor_db: float | None) -> str | None:
    """Why a noise floor hides what is looked for, or None."""
    if noise_floor_db is None or noise_floor_db <= FLOOR_DB:
        return None
    floor = f"the noise floor (measurement and idle model together) is {noise_floor_db:.3g} dB"
    return f"{floor}, and above {FLOOR_DB:g} dB an agreement says nothing"


def floor_text(floor: float | None, none: str = "-") -> str:
    """A noise floor in dB, as far as dB hold for uncertainties of its size; ``none`` where there is none."""
    if floor is None or not math.isfinite(floor):
        return none
    return f"> {FLOOR_DB:g}" if floor > FLOOR_DB else f"{floor:.2f}"
