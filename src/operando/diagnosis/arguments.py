"""What a diagnosis is asked for: validation measurements, kinds, locations and bands as users give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.data import Frf, ModalModel, positive_band, several
from operando.diagnosis.terms import AT_ONE_LOCATION, IN_FRFS, SEARCHED
from operando.dof import match_dofs, parse_dofs
from operando.errors import ConfigError, DataError
from operando.limits import LEAST_LINES
from operando.results import CheckRun
from operando.structure.effects import kind_of

UNKNOWN_UNITS = (
    "the units of the validation measurement are not known: sizes are in units of the file; give the units of force and acceleration"
)


def validation_runs(check: Frf | CheckRun | Sequence[Frf | CheckRun]) -> list[CheckRun]:
    """FRFs of the running structure as validation runs, by the names of their files.

    A :class:`operando.CheckRun` states name and level; an :class:`operando.Frf` is called by its own name, else ``check``, and all of them
    are of one level.
    """
    hint = "give the FRFs that were measured while it runs, or CheckRun(name, level, frf) to name them and their level"
    given = several(check, (CheckRun, Frf), "check takes validation measurements", hint)
    numbers = [f" {i}" if len(given) > 1 else "" for i in range(1, len(given) + 1)]
    return [
        run if isinstance(run, CheckRun) else CheckRun(run.name or f"check{number}", "as given", run)
        for run, number in zip(given, numbers, strict=True)
    ]


def kinds_asked(kinds: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Kinds of effects by name, one alone as a list of one."""
    if kinds is None:
        return None
    names = tuple(several(kinds, str, "kinds of effects have names", "operando.catalogue() lists them"))
    for name in names:
        kind_of(name)
    return names


def places_asked(idle: ModalModel, places: Any) -> list[int] | None:
    """Rows of the idle model of the locations asked for."""
    return None if places is None else match_dofs(parse_dofs(places), idle.dofs)[0]


def band_asked(band: Any, frf: Frf) -> tuple[float, float] | None:
    """Limits of a band [Hz] in which the FRFs have lines."""
    if band is None:
        return None
    low, high = positive_band(band)
    f = frf.frequencies_hz
    count = int(np.sum((f > 0) & (f >= low) & (f <= high)))
    if count < LEAST_LINES:
        raise DataError(
            f"the band of {low:g} to {high:g} Hz holds {count} lines of the validation FRFs, which lie at {f[0]:g} to {f[-1]:g} Hz; "
            f"at least {LEAST_LINES} are needed",
            hint="choose another band",
        )
    return low, high


def chosen_run(check: Sequence[CheckRun]) -> CheckRun:
    """The run of the lowest level with the most finite values."""
    from operando.compare.comparison import lowest_level

    level = lowest_level(check)
    return max((r for r in check if r.level == level), key=lambda r: int(np.isfinite(r.frf.data).sum()))


def searched(kinds: Sequence[str] | None, poor: bool = False) -> tuple[str, ...]:
    """Kinds to look for; where none are named and the idle model is a poor one, those at one location."""
    if kinds is None:
        return AT_ONE_LOCATION if poor else SEARCHED
    known = [k for k in kinds if kind_of(k).acts in IN_FRFS]
    if not known:
        raise ConfigError(f"none of the kinds {', '.join(kinds)} can be found from FRFs", hint="name linear kinds, or give records")
    return tuple(known)
