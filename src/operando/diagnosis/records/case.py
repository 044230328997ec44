"""Records against the idle model: runs by level, and the sets of lines that are fixed before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from operando.data import ModalModel, TimeRecord, one_level
from operando.diagnosis.records.day import Day
from operando.diagnosis.records.out_of_band import Doubt
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.run import Run, make_run
from operando.dof import Dof
from operando.errors import MissingError
from operando.structure.modal_space import Modes, Real

SET_LINES = 3000
"""Lines of a run in the fit and select sets together."""

LOWEST, SURE_Z = 0.1, 2.0
"""Lines below the band down to this part of its first line show whether the structure stands: a decade, over which the motion of a mass
grows a hundredfold; farther down sensors drift. Standard errors that decide it (95 %)."""

BLOCKS = 18
"""Blocks of neighbouring lines that go to the sets in turn."""


@dataclass(frozen=True)
class RecordsCase:
    """Records against the idle model."""

    idle: ModalModel
    modes: Modes
    fitted: tuple[Run, ...]  # runs of the highest level of each reference
    validation: tuple[Run, ...]  # runs of another level, which nothing is fitted to; empty where there is one level alone
    band: tuple[float, float]
    doubt: Doubt  # how far the idle model may be off by what lies outside the band
    places: tuple[tuple[int, ...], ...]  # rows of the idle model: one, or two for the difference first − second
    day: Day | None = None

    @property
    def runs(self) -> tuple[Run, ...]:
        """All runs, the fitted ones first."""
        return (*self.fitted, *self.validation)

    def with_runs(self, runs: Sequence[Run]) -> RecordsCase:
        """The case with other errors or variances of all its runs."""
        n = len(self.fitted)
        return replace(self, fitted=tuple(runs[:n]), validation=tuple(runs[n:]))

    def hold_out(self) -> slice:
        """Of all runs those that nothing is fitted to; all where there is one level alone."""
        return slice(len(self.fitted) if self.validation else 0, None)

    def b(self, place: tuple[int, ...]) -> Real:
        """Weights of the DOFs: one, or the difference first − second."""
        out = np.zeros(len(self.idle.dofs))
        out[place[0]] = 1
        if len(place) == 2:
            out[place[1]] = -1
        return out

    def place_name(self, place: tuple[int, ...]) -> str:
        """DOFs of a place in words."""
        return ", ".join(map(str, self.located(place)))

    def located(self, place: tuple[int, ...]) -> tuple[Dof, ...]:
        """DOFs of a place."""
        return tuple(self.idle.dofs[i] for i in place)

    def by_reference(self) -> list[list[Run]]:
        """Runs of the same driven DOFs together, lowest level first."""
        louder = sorted(self.runs, key=lambda r: r.force_level)
        return [[r for r in louder if r.forces_at == reference] for reference in dict.fromkeys(r.forces_at for r in self.runs)]


def make_case(
    idle: ModalModel,
    records: Sequence[TimeRecord],
    band: tuple[float, float] | None = None,
    places: Sequence[Sequence[int]] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    day: Day | None = None,
) -> RecordsCase:
    """Runs, levels and places; lines inside ``exclude_bands`` [Hz] are not used; ``day`` is another one, with ``idle`` as it is then."""
    if not records:
        raise MissingError("no record of the running structure with a measured force")
    modes = Modes.of(idle)
    proper = idle.frequencies_hz[np.asarray(idle.in_band)]
    band = band or idle.band_hz or (0.6 * float(proper.min()), 1.08 * float(proper.max()))
    runs = [make_run(r, idle, modes, band, day).without(exclude_bands) for r in records]
    modes = replace(modes, grounded=contradicted(runs, modes))
    fitted: list[Run] = []
    validation: list[Run] = []
    for reference in dict.fromkeys(r.forces_at for r in runs):
        group = [r for r in runs if r.forces_at == reference]
        top = max(r.force_level for r in group)
        for run in group:
            (fitted if one_level(run.force_level, top) else validation).append(run)
    if not validation and len(fitted) > 1:
        validation = [fitted.pop()]
    measured = sorted({int(i) for r in runs for i in r.rows})
    everywhere = [(i,) for i in measured] + list(combinations(measured, 2))
    wanted = everywhere if places is None else [tuple(int(i) for i in p) for p in places]
    return RecordsCase(idle, modes, tuple(fitted), tuple(validation), band, Doubt.of(idle, modes, band), tuple(wanted), day)


def contradicted(runs: Sequence[Run], modes: Modes) -> bool:
    """Whether the lines below the band speak for a structure that is flat there, against what its residual modes predict.

    Residual modes that stand for a mass grow without bound below the band: of a structure that stands they are but errors of the fit.
    Each line of each response says which of the two predicts it better, in shares of what was measured and predicted there.
    """
    votes: list[Real] = []
    low = modes.hz < modes.low_hz
    for run in runs:
        first = float(run.hz[0])
        below = np.flatnonzero((run.all_hz >= LOWEST * first) & (run.all_hz < first))
        hz, drive, measured = run.all_hz[below], run.modal_forces[:, below], run.responses[:, below]
        free, flat = (
            -((2 * np.pi * hz) ** 2) * (modes.phi[run.rows] @ (kernel * drive))
            for kernel in (modes.receptance_kernel(hz), modes.bounded_kernel(hz, low, first))
        )
        worse = np.abs(measured - free) ** 2 - np.abs(measured - flat) ** 2
        votes.append((worse / (np.abs(measured) ** 2 + np.abs(free) ** 2 + 1e-300)).ravel())
    vote = np.concatenate(votes)
    return vote.size > 1 and bool(np.mean(vote) > SURE_Z * np.std(vote, ddof=1) / np.sqrt(vote.size))


def strided(run: Run, lines: int) -> slice:
    """Evenly spread lines of a run."""
    return slice(None, None, max(1, run.hz.size // lines))


@dataclass(frozen=True)
class Sets:
    """Weighted runs of a case on all lines and on the sets; what does not depend on the place."""

    case: RecordsCase
    whole: list[Weighted]
    lines: dict[str, list[np.ndarray]]
    """Lines of each fitted run in the sets ``fit`` and ``select``, and in ``validation`` where there is one level alone."""
    parts: dict[str, list[Weighted]]

    @classmethod
    def of(cls, case: RecordsCase) -> Sets:
        """Weights and sets of a case."""
        names = ("fit", "select") if case.validation else ("fit", "select", "validation")
        lines: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for run in case.fitted:
            index = np.arange(run.hz.size)[strided(run, SET_LINES)]
            block = np.minimum(index * BLOCKS // run.hz.size, BLOCKS - 1)
            for k, name in enumerate(names):
                lines[name].append(index[block % len(names) == k])
        parts = {name: [Weighted.of(r.on(k)) for r, k in zip(case.fitted, own, strict=True)] for name, own in lines.items()}
        whole = [Weighted.of(r) for r in case.runs]
        return cls(case, whole, lines, parts | ({"validation": whole[len(case.fitted) :]} if case.validation else {}))
