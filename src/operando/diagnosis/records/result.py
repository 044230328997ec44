"""What a diagnosis from records says beside one from FRFs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from operando.data import Geometry, ModalModel
from operando.diagnosis.applied import Applied
from operando.diagnosis.records.detect import Detection
from operando.diagnosis.result import Diagnosis
from operando.dof import Dof
from operando.structure import Model
from operando.structure.effects import Effect
from operando.structure.linearization import LinearEquivalent, linear_effects

Equivalents = tuple[tuple[LinearEquivalent, ...], ...]
"""Spring and damper at each level for each effect; none for a linear one."""


@dataclass(frozen=True)
class FoundLaws:
    """Force laws that the search of records accepted, whether the verdict keeps them or not.

    Attributes
    ----------
    effects, equivalents : tuples
        As of a diagnosis.
    log_score : float
        In nats a line: the less, the more probable are the records (:func:`operando.diagnosis.records.conclude.log_score`).
    locations : tuple of tuple of Dof
        Where a force may act that is missing in the idle model: where any force law explains most, and where those that have a formula
        leave least (:data:`operando.diagnosis.records.conclude.OF_THEIR_OWN_DAY`).
    model : Model or None
        The idle model with what these are equivalent to at the lowest level.
    """

    effects: tuple[Effect, ...] = ()
    equivalents: Equivalents = ()
    log_score: float = float("inf")
    locations: tuple[tuple[Dof, ...], ...] = ()
    model: Model | None = None


@dataclass(frozen=True, repr=False, eq=False)
class RecordsDiagnosis(Diagnosis):
    """A diagnosis from records with measured force, level-dependent effects among its effects.

    Parameters
    ----------
    detection : Detection
        What was seen before anything was named.
    simulation : dict
        The model with its effects in the closed loop against the validation records.
    equivalents : tuple of tuple of LinearEquivalent
        For each effect the spring and damper it is equivalent to at each level; empty for a linear one.
    found : FoundLaws
        What the search found before the verdict.
    """

    detection: Detection = field(default_factory=Detection)
    simulation: dict[str, Any] = field(default_factory=dict)
    equivalents: Equivalents = ()
    found: FoundLaws = field(default_factory=FoundLaws)

    @property
    def nonlinear(self) -> tuple[Effect, ...]:
        """The accepted effects that depend on the level."""
        return tuple(e for e in self.effects if e.definition.level_dependent)

    def to_dict(self) -> dict[str, Any]:
        """``diagnosis.json``, with ``detection``, ``simulation`` and the equivalents of level-dependent effects beside."""
        effects = stated(self.effects, self.equivalents)
        return super().to_dict() | {"effects": effects, "detection": self.detection.to_dict(), "simulation": self.simulation}


@dataclass(frozen=True, repr=False, eq=False)
class RecordsApplied(Applied):
    """Effects chosen by hand, level-dependent ones among them, fitted to records.

    Parameters
    ----------
    better : tuple of (int, Effect, float)
        Step, and an effect that lowers the chi-square of that step to less than half of what the chosen one leaves, with that chi-square.
    log_score : float
        As in :class:`FoundLaws`, with all effects.
    picture, simulation, equivalents
        As in :class:`RecordsDiagnosis`.
    """

    better: tuple[tuple[int, Effect, float], ...] = ()
    log_score: float = float("inf")
    picture: dict[str, Any] = field(default_factory=dict)
    simulation: dict[str, Any] = field(default_factory=dict)
    equivalents: Equivalents = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON object: effects, errors by step, words; ``picture`` and ``simulation`` as in ``diagnosis.json``."""
        effects = stated(self.effects, self.equivalents)
        return super().to_dict() | {"effects": effects, "picture": self.picture, "simulation": self.simulation}


def stated(effects: Sequence[Effect], equivalents: Equivalents) -> list[dict[str, Any]]:
    """Effects as in ``diagnosis.json``, level-dependent ones with their ``equivalents``."""
    return [
        e.to_dict() | ({"equivalents": [row.to_dict() for row in rows]} if rows else {})
        for e, rows in zip(effects, equivalents, strict=True)
    ]


def linear_model(idle: ModalModel, effects: Sequence[Effect], equivalents: Equivalents, geometry: Geometry | None) -> Model:
    """The idle model with linear effects, and of level-dependent ones the equivalents at the lowest level."""
    linear = [part for e, rows in zip(effects, equivalents, strict=True) for part in (linear_effects(e, rows) if rows else [e])]
    return Model(idle, tuple(linear), geometry)
