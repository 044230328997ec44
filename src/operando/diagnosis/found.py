"""What a search ends with."""

from __future__ import annotations

from dataclasses import dataclass, field

from operando.diagnosis.posterior import State

Key = tuple[tuple[str, tuple[int, ...]], ...]


@dataclass
class Found:
    """What a search ends with.

    ``best`` is the most probable state, ``empty`` the one without effects; ``pool`` are all fitted states, by kinds and places. ``unnamed``
    has what explains the lines where nothing else does, and is no effect of the catalogue at a location: a force law of no kind, or one on
    motions that no sensor shows. ``as_well`` may stand in the place of the best, where evidence does not tell them apart; ``odds`` are log
    odds that nothing was touched between the measurements, where both hypotheses were tried. ``left_out`` says which effects the validation
    lines speak against.
    """

    best: State
    empty: State
    pool: dict[Key, State]
    unnamed: State | None = None
    as_well: list[State] = field(default_factory=list)
    odds: float | None = None
    left_out: tuple[str, ...] = ()
