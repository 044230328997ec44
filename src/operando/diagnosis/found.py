"""What a search ends with."""

from __future__ import annotations

from dataclasses import dataclass, field

from operando.diagnosis.posterior import State

Key = tuple[tuple[str, tuple[int, ...]], ...]


@dataclass
class Found:
    """What a search ends with.

    Attributes
    ----------
    best, empty : State
        The most probable state, and the one without effects.
    pool : dict
        All fitted states, by kinds and places.
    unnamed : State, optional
        With what explains the lines where nothing else does, and is no effect of the catalogue at a location: a force law of no kind, or
        one on motions that no sensor shows.
    as_well : list of State
        What may stand in the place of the best, where evidence does not tell them apart.
    odds : float, optional
        Log odds that nothing was touched between the measurements, where both hypotheses were tried.
    """

    best: State
    empty: State
    pool: dict[Key, State]
    unnamed: State | None = None
    as_well: list[State] = field(default_factory=list)
    odds: float | None = None
