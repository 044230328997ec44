"""One record of operational modes against one idle model: what was observed, its model, and the priors of the effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operando.diagnosis.between import SPREADS, Between
from operando.diagnosis.case import Array, Case
from operando.diagnosis.criteria import FIT_LINES
from operando.diagnosis.eigenmodes import Eigenmodes
from operando.diagnosis.forward import Forward, Point, Scannable
from operando.diagnosis.idle import Idle
from operando.diagnosis.operating_modes import OperatingModes
from operando.diagnosis.terms import SEARCHED
from operando.structure.effects import kind_of

TOLD_BY_MODES = tuple(kind for kind in SEARCHED if kind_of(kind).group == "structure")
"""Kinds looked for in operational modes where the test file names none: all of the structure, none of sensors or forces."""


class ModesCase(Case):
    """What a search in operational modes works on; arguments are as for :class:`Case`, the band in Hz."""

    lines: OperatingModes  # type: ignore[assignment]
    forward: Eigenmodes
    elsewhere = False

    def __init__(
        self,
        idle: Idle,
        lines: OperatingModes,
        band: tuple[float, float],
        spreads: dict[str, float] | None = None,
        kinds: Sequence[str] = TOLD_BY_MODES,
        places: Sequence[int] | None = None,
        like: Case | None = None,
    ) -> None:
        idle = replace(idle, first_order=False)  # residual terms stand in the eigenproblem, as shapes
        self.dofs, self.uncompressed, self.lines, self.band = idle.dofs, idle, lines, band
        self._look_for(kinds, places, like)
        none = np.zeros(0, int)
        self.between = Between(idle, none, band, SPREADS.copy() if spreads is None else spreads)
        self.forward = Eigenmodes(idle, self.between, lines.responses, none, band, lines)

    def base(self) -> tuple[Array, Scannable]:
        """Lines of the band [rad/s], and FRFs at rest there from the points that were driven."""
        if self._base is None:
            w = 2 * np.pi * np.linspace(*self.band, FIT_LINES)
            driven = np.flatnonzero(self.idle.driven)
            rest = Forward(self.idle, Between(self.idle, driven, self.band, {}), np.arange(len(self.dofs)), driven, self.band)
            self._base = w, rest.scannable(rest.start, w)
        return self._base

    def columns(self, x: Point, w: Array) -> Array:
        """FRFs of a state between all DOFs (lines, DOFs, DOFs)."""
        forward = self.forward
        return Forward(forward.idle, forward.between, forward.responses, forward.references, self.band).scannable(x, w).columns
