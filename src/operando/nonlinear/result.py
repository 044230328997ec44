"""What a diagnosis from records says, as an object and as ``diagnosis.json``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from operando.effects import Effect


@dataclass(frozen=True)
class NonlinearDiagnosis:
    """Level-dependent effects found in records with measured force.

    Parameters
    ----------
    verdict : {"no_misfit", "inconclusive", "explained", "partial", "unexplained", "ambiguous"}
        As in the specification.
    effects : tuple of Effect
        Accepted, in order; springs and dampers that turned out to be linear among them.
    ambiguous_with : tuple of Effect
        Effects that the records cannot tell from the accepted ones.
    proposed_measurement : str or None
    ladder : tuple of dict
        Error and chi-square of the records step by step.
    candidates : tuple of dict
        Ranked.
    where : dict
        ``by_dof``, ``by_band``, ``by_mode`` of the idle model on the validation records.
    noise_floor_db : float or None
    detection : dict
        What was seen before anything was named: homogeneity over levels, even share, coherence.
    picture : dict
        ``restoring_force``: for each level-dependent effect the force over displacement and velocity at its place, with the law over it,
        and the spring and damper it is equivalent to at each level.
    simulation : dict
        The model with its effects in the closed loop against the validation record.
    notes : tuple of str
    judged_on : dict
        State, level and lines of the hold-out figures.
    discrepancy : float or None
        Part of the responses that the effects leave beyond the noise.
    reason : str or None
        What stands in the way of a better verdict.
    """

    verdict: str
    effects: tuple[Effect, ...]
    ambiguous_with: tuple[Effect, ...] = ()
    proposed_measurement: str | None = None
    ladder: tuple[dict[str, Any], ...] = ()
    candidates: tuple[dict[str, Any], ...] = ()
    where: dict[str, Any] = field(default_factory=dict)
    noise_floor_db: float | None = None
    detection: dict[str, Any] = field(default_factory=dict)
    picture: dict[str, Any] = field(default_factory=dict)
    simulation: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    judged_on: dict[str, Any] = field(default_factory=dict)
    discrepancy: float | None = None
    reason: str | None = None

    @property
    def nonlinear(self) -> tuple[Effect, ...]:
        """The accepted effects that depend on the level."""
        return tuple(e for e in self.effects if e.definition.level_dependent)

    def to_dict(self) -> dict[str, Any]:
        """``diagnosis.json``."""
        return {
            "schema": "operando/diagnosis/2",
            "data": ["check_records"],
            "verdict": self.verdict,
            "effects": [e.to_dict() for e in self.effects],
            "ambiguous_with": [e.to_dict() for e in self.ambiguous_with],
            "proposed_measurement": self.proposed_measurement,
            "ladder": [dict(row) for row in self.ladder],
            "candidates": [dict(row) for row in self.candidates],
            "where": self.where,
            "noise_floor_db": self.noise_floor_db,
            "detection": self.detection,
            "picture": self.picture,
            "simulation": self.simulation,
            "notes": list(self.notes),
            "judged_on": self.judged_on,
            "reason": self.reason,
            "discrepancy": None if self.discrepancy is None else {"value": self.discrepancy, "std": None},
        }
