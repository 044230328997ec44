"""A diagnosis: verdict, effects, and what stands behind them; the document ``diagnosis.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from operando.data import Geometry, ModalModel, Short, counted
from operando.diagnosis.drawn import Drawn
from operando.results import CheckRun
from operando.structure import Model
from operando.structure.effects import Effect


@dataclass(frozen=True, repr=False, eq=False)
class Diagnosis(Drawn, Short):
    """What is missing in the idle model, with evidence.

    Parameters
    ----------
    verdict : {"no_misfit", "inconclusive", "explained", "partial", "unexplained", "ambiguous"}
    effects : tuple of Effect
        Accepted, in order, refitted together.
    ambiguous_with : tuple of Effect
        Effects the data cannot tell from the accepted ones.
    proposed_measurement : str or None
        What would decide.
    ladder : tuple of dict
        One row a step: error and reduced chi-square, on all lines and on those that were never fitted.
    candidates : tuple of dict
        Ranked, with their evidence.
    where : dict
        ``by_dof``, ``by_band``, ``by_mode``: where the idle model fails.
    noise_floor_db : float or None
    data : tuple of str
        What was used.
    picture : dict
        Dynamic stiffness δz(ω) at the place found, and the kind-free ranking of places.
    notes : tuple of str
    idle : ModalModel or None
        As it was before.
    model : Model or None
        Idle model (shapes at the effects' places refitted), the accepted effects, and the covariance of both.
    judged_on : mapping
        State, level and lines of the figures on lines that were never fitted.
    detectable : tuple of dict
        The least size of each kind at each place that would have been seen.
    reason : str or None
        What stands in the way of a better verdict.
    between, discrepancy : tuple of dict and dict, optional
        What differs between the two measurements and is no missing physics; the share of the FRFs that no parameter explains.
    by_level : tuple of dict, optional
        Modes of the validation FRFs, run by run; None without such FRFs.

    Examples
    --------
    >>> import operando
    >>> found = operando.Diagnosis("no_misfit", (), (), None, (), (), {}, None)
    >>> found
    <Diagnosis: no_misfit>
    >>> found.to_dict()["verdict"]
    'no_misfit'
    """

    verdict: str
    effects: tuple[Effect, ...]
    ambiguous_with: tuple[Effect, ...]
    proposed_measurement: str | None
    ladder: tuple[dict[str, Any], ...]
    candidates: tuple[dict[str, Any], ...]
    where: dict[str, Any]
    noise_floor_db: float | None
    data: tuple[str, ...] = ("check_frf",)
    picture: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    idle: ModalModel | None = None
    model: Model | None = None
    judged_on: Mapping[str, Any] = field(default_factory=dict)
    detectable: tuple[dict[str, Any], ...] = ()
    reason: str | None = None
    between: tuple[dict[str, Any], ...] | None = None
    discrepancy: dict[str, Any] | None = None
    by_level: tuple[dict[str, Any], ...] | None = None

    def facts(self) -> dict[str, str]:
        """What the short form says; ± is the 95 % interval."""
        left = self.ladder[-1].get("heldout_error_db") if self.ladder else None
        return {
            "Verdict": self.verdict,
            "Effects": " + ".join(e.short for e in self.effects),
            "Alternatives": "or " + ", ".join(e.short for e in self.ambiguous_with) if self.ambiguous_with else "",
            "Validation": f"{left:.2f} dB on the hold-out set" if left is not None else "",
            "Reason": f"reason: {self.reason}" if self.reason else "",
            "Proposed measurement": f"proposed: {self.proposed_measurement}" if self.proposed_measurement else "",
            "Notes": counted(len(self.notes), "note") if self.notes else "",
        }

    def to_dict(self) -> dict[str, Any]:
        """``diagnosis.json``."""
        return {
            "schema": "operando/diagnosis/2",
            "data": list(self.data),
            "verdict": self.verdict,
            "effects": [e.to_dict() for e in self.effects],
            "ambiguous_with": [e.to_dict() for e in self.ambiguous_with],
            "proposed_measurement": self.proposed_measurement,
            "ladder": [dict(row) for row in self.ladder],
            "candidates": [dict(c) for c in self.candidates],
            "where": self.where,
            "noise_floor_db": self.noise_floor_db,
            "picture": self.picture,
            "notes": list(self.notes),
            "judged_on": dict(self.judged_on),
            "reason": self.reason,
            "detectable": [dict(row) for row in self.detectable],
            "between": None if self.between is None else [dict(row) for row in self.between],
            "discrepancy": self.discrepancy,
            "by_level": None if self.by_level is None else [dict(row) for row in self.by_level],
        }


def where_and_levels(
    idle: ModalModel, check: Sequence[CheckRun], band: tuple[float, float] | None, compared: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], tuple[dict[str, Any], ...]]:
    """``where``, of the idle model on the runs of the lowest level, and ``by_level``: both as the comparison has them."""
    from operando.compare import compare_all

    document = compared or compare_all({"idle": idle}, check, band)
    where = {key: document["models"]["idle"][key] for key in ("by_dof", "by_band", "by_mode")}
    measured = ("frequency_hz", "frequency_std_hz", "damping_ratio", "damping_ratio_std")
    by_level = tuple(
        {key: run[key] for key in ("name", "level", "unit", "level_name")}
        | {"modes": [{key: mode[key] for key in measured} for mode in run["models"]["idle"]["by_mode"]]}
        for run in document["by_run"]
    )
    return where, by_level


def spacing(geometry: Geometry | None) -> float:
    """Median distance from a sensor to its nearest neighbour [m]; 0 without geometry."""
    if geometry is None or len(geometry.nodes) < 2:
        return 0.0
    x = geometry.coordinates
    d = np.linalg.norm(x[:, None] - x[None], axis=2)
    np.fill_diagonal(d, np.inf)
    near = d.min(axis=1)
    return float(np.median(near[near > 0])) if np.any(near > 0) else 0.0
