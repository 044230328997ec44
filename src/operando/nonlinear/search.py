"""The search over places and kinds in records with measured force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from operando.data import ModalModel, TimeRecord, one_level
from operando.effects import kind_of
from operando.errors import MissingError
from operando.nonlinear.laws import LawFit, Motion
from operando.nonlinear.outside import Doubt, Outside, force_columns, look
from operando.nonlinear.place import Along, Crossing, Weighted
from operando.nonlinear.run import Modes, Real, Run, make_run
from operando.threads import each

FIRST_LINES, RANK_LINES = 300, 600
"""Lines of a run on which all places are compared, and the best of them again."""

LOOKED, KEPT = 20, 4
"""Places looked at with what lies outside the band; places at which laws are fitted."""

WITHIN = 40.0
"""A place whose remaining misfit is more than this times the best is not worth a law."""

SET_LINES = 3000
"""Lines of a run in the fit and select sets together."""

BLOCKS = 18
WALKED = 4
"""Turns in which motion and a law that remembers are brought together: each walks through the whole record."""

NOISE_FLOOR = 1e-3
"""Least noise over rms of a response: the idle model is no better than this."""


@dataclass(frozen=True)
class Case:
    """Records against the idle model, with sets fixed before anything is fitted.

    Parameters
    ----------
    idle : ModalModel
    modes : Modes
    fitted : tuple of Run
        Runs of the highest level of each reference.
    validation : tuple of Run
        Runs of another level, which nothing is fitted to; empty where there is one level alone.
    band : (float, float)
    doubt : Doubt
        How far the idle model may be off by what lies outside the band.
    """

    idle: ModalModel
    modes: Modes
    fitted: tuple[Run, ...]
    validation: tuple[Run, ...]
    band: tuple[float, float]
    doubt: Doubt
    places: tuple[tuple[int, ...], ...]

    @property
    def n_dofs(self) -> int:
        """DOFs of the idle model."""
        return len(self.idle.dofs)

    def b(self, place: tuple[int, ...]) -> Real:
        """Weights of the DOFs: one, or the difference first − second."""
        out = np.zeros(self.n_dofs)
        out[place[0]] = 1
        if len(place) == 2:
            out[place[1]] = -1
        return out


def make_case(
    idle: ModalModel,
    records: Sequence[TimeRecord],
    band: tuple[float, float] | None = None,
    places: Sequence[Sequence[int]] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
) -> Case:
    """Runs, levels and sets; lines inside ``exclude_bands`` [Hz] are not used.

    Raises
    ------
    MissingError
        If there is no record.
    """
    if not records:
        raise MissingError("no record of the running structure with a measured force")
    modes = Modes.of(idle)
    proper = idle.frequencies_hz[np.asarray(idle.in_band)]
    band = band or idle.band_hz or (0.6 * float(proper.min()), 1.08 * float(proper.max()))
    runs = [without(make_run(r, idle, modes, band), exclude_bands) for r in records]
    driven: dict[tuple[int, ...], list[Run]] = {}
    for run in runs:
        driven.setdefault(run.forces_at, []).append(run)
    fitted: list[Run] = []
    validation: list[Run] = []
    for group in driven.values():
        top = max(r.force_level for r in group)
        for run in group:
            (fitted if one_level(run.force_level, top) else validation).append(run)
    if not validation and len(fitted) > 1:
        validation = [fitted.pop()]
    measured = sorted({int(i) for r in runs for i in r.rows})
    everywhere = [(i,) for i in measured] + list(combinations(measured, 2))
    wanted = everywhere if places is None else [tuple(int(i) for i in p) for p in places]
    return Case(idle, modes, tuple(fitted), tuple(validation), band, Doubt.of(idle, modes, band), tuple(wanted))


def without(run: Run, bands: Sequence[tuple[float, float]]) -> Run:
    """The run without the lines inside the bands [Hz]."""
    keep = np.ones(run.hz.size, bool)
    for low, high in bands:
        keep &= (run.hz < low) | (run.hz > high)
    return run if keep.all() else run.on(keep)


def strided(run: Run, lines: int) -> slice:
    """Evenly spread lines of a run."""
    return slice(None, None, max(1, run.hz.size // lines))


def rank_places(
    case: Case, places: Sequence[tuple[int, ...]], say: Callable[[str], None] | None = None
) -> list[tuple[float, tuple[int, ...]]]:
    """Places by what no force there explains, the best first: all of them without, the best with what lies outside the band."""
    none = Outside.none(case.fitted, case.n_dofs, case.band[1])

    def compared(some: Sequence[tuple[int, ...]], lines: int, turns: int) -> list[tuple[float, tuple[int, ...]]]:
        few = [Weighted.of(r.on(strided(r, lines))) for r in case.fitted]
        return sorted(each(lambda p: (look(few, case.modes, case.b(p), case.doubt, none, turns).misfit, p), some))

    if say:
        say(f"{min(LOOKED, len(places))} of {len(places)} locations")
    best = [p for _, p in compared(places, FIRST_LINES, 1)[:LOOKED]] if len(places) > LOOKED else places
    return compared(best, RANK_LINES, 3)


@dataclass
class Field:
    """Weighted runs on all lines and on the sets; what does not depend on the place."""

    case: Case
    fitted: list[Weighted]
    validation_runs: list[Weighted]
    fit_lines: list[np.ndarray]
    select_lines: list[np.ndarray]
    validation_lines: list[np.ndarray]
    fit: list[Weighted] = field(default_factory=list)
    select: list[Weighted] = field(default_factory=list)
    validation: list[Weighted] = field(default_factory=list)

    @classmethod
    def of(cls, case: Case) -> Field:
        """Weights and sets of a case."""
        fitted = [Weighted.of(r) for r in case.fitted]
        runs = [Weighted.of(r) for r in case.validation]
        fit_lines, select_lines, validation_lines = [], [], []
        for run in case.fitted:
            index = np.arange(run.hz.size)[strided(run, SET_LINES)]
            block = np.minimum(index * BLOCKS // run.hz.size, BLOCKS - 1)
            third = 3 if not case.validation else 2
            fit_lines.append(index[block % third == 0])
            select_lines.append(index[block % third == 1])
            validation_lines.append(index[block % third == 2])
        out = cls(case, fitted, runs, fit_lines, select_lines, validation_lines)
        out.fit = [Weighted.of(r.on(k)) for r, k in zip(case.fitted, fit_lines, strict=True)]
        out.select = [Weighted.of(r.on(k)) for r, k in zip(case.fitted, select_lines, strict=True)]
        # A run of another level judges; with one level alone a third of the blocks of lines does.
        out.validation = runs or [Weighted.of(r.on(k)) for r, k in zip(case.fitted, validation_lines, strict=True)]
        return out


@dataclass
class Spot:
    """A place with its corrections, the motion across it, and the sets."""

    place: tuple[int, ...]
    b: Real
    outside: Outside
    free: float
    whole: list[Motion]
    fit: list[Motion]
    select: list[Motion]
    validation: list[Motion]


def examine(stage: Field, place: tuple[int, ...], b: Real | None = None) -> Spot:
    """Restoring force and motion at a place on all lines of all runs; ``b`` where the senses of its DOFs are others."""
    case = stage.case
    b = case.b(place) if b is None else b
    none = Outside.none([w.run for w in stage.fit], case.n_dofs, case.band[1])
    outside = look(stage.fit, case.modes, b, case.doubt, none, 4).outside
    runs = [*case.fitted, *case.validation]
    weights = [*stage.fitted, *stage.validation_runs]
    feed = {r.forces_at: outside.forces[i] for i, r in enumerate(case.fitted)}
    same_rows = {r.forces_at: tuple(r.rows.tolist()) for r in case.fitted}
    alongs = []
    for i, (run, w) in enumerate(zip(runs, weights, strict=True)):
        key, known = run.forces_at, None
        if i < len(case.fitted):
            known = outside.forces[i]
        elif key in feed and same_rows[key] == tuple(run.rows.tolist()):
            known = feed[key]
        error = run.error
        if known is not None:
            error = error - known @ force_columns(run, case.band[1])
        h = run.accelerance(case.modes, b) + outside.accelerance(run)
        alongs.append(Along.of(w.with_error(error), b, h))
    whole = []
    rest, count = 0.0, 0
    for i, along in enumerate(alongs):
        rough, _, _ = along.free_force()
        # A force no larger than the typical one keeps lines without information from swamping the motion.
        spread = smooth_size(rough)
        force, amplitudes, _ = along.free_force(spread)
        _, _, remaining = along.free_force()
        if i < len(case.fitted):
            rest += remaining
            count += (along.run.rows.size - 1) * along.run.hz.size
        crossing = Crossing.of(along, case.modes, amplitudes, outside.compliance(along.run.all_hz, b))
        everywhere = np.zeros(along.run.forces.shape[1], complex)
        everywhere[along.run.lines] = force
        x, v = crossing.move(everywhere)
        whole.append(Motion(x, v, 1 / (along.run.sampling_hz * crossing.fine), along, crossing, force, along.taken(spread)))
    n = len(case.fitted)

    def part(weights: Sequence[Weighted], lines: Sequence[np.ndarray]) -> list[Motion]:
        return [replace(m, along=m.along.on(w, k)) for m, w, k in zip(whole[:n], weights, lines, strict=True)]

    validation = whole[n:] or part(stage.validation, stage.validation_lines)
    return Spot(
        place, b, outside, rest / max(count, 1), whole, part(stage.fit, stage.fit_lines), part(stage.select, stage.select_lines), validation
    )


def settled(spot: Spot, case: Case, law: LawFit) -> Spot:
    """The spot with the motions settled under a law."""
    remembers = bool(getattr(kind_of(law.kind), "has_state", False))
    turns = WALKED if remembers else 12
    return moving(spot, case, each(lambda m: m.settled(lambda x, v: law.force(x, v, m.step), turns, remembers), spot.whole))


def moving(spot: Spot, case: Case, whole: list[Motion]) -> Spot:
    """The spot with other motions of all runs."""
    n = len(case.fitted)

    def renew(parts: Sequence[Motion]) -> list[Motion]:
        return [replace(p, x=m.x, v=m.v, made=m.made, closed=m.closed) for p, m in zip(parts, whole[:n], strict=True)]

    return replace(spot, whole=whole, fit=renew(spot.fit), select=renew(spot.select), validation=whole[n:] or renew(spot.validation))


def smooth_size(force: Any, width: int = 61) -> Real:
    """Local rms of a spectrum from running medians of its square: robust against lines that are all noise."""
    power = np.abs(force) ** 2
    pad = np.pad(power, width // 2, mode="reflect")
    median = np.median(np.lib.stride_tricks.sliding_window_view(pad, width)[::8], axis=1)
    centre = np.arange(power.size)[::8][: median.size]
    local = np.interp(np.arange(power.size), centre, median) / np.log(2)
    # Noise only adds: where the spectrum rises towards the ends of the band it is noise, not force.
    level = np.median(local)
    return np.asarray(np.sqrt(np.minimum(local, 9 * level)))
