"""Effects chosen by hand in records with measured force: fitted together, and tested on the level that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from operando.compare.measures import misfit
from operando.data import Geometry, ModalModel, TimeRecord
from operando.diagnosis.applied import refuse_failed, words_of
from operando.diagnosis.records.case import RecordsCase, Sets, make_case
from operando.diagnosis.records.closed_loop import closed_loop_force
from operando.diagnosis.records.conclude import effect_of, equivalents_of, log_score, pictures_of, simulated
from operando.diagnosis.records.day import Day
from operando.diagnosis.records.diagnose import wanted_kinds
from operando.diagnosis.records.fit_laws import fit_law
from operando.diagnosis.records.hold_out import judged_on, lines_of, step_row
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.refine import OF_ALL_RUNS, of_all_runs, refined, std_of
from operando.diagnosis.records.result import RecordsApplied, linear_model
from operando.diagnosis.records.spot import Spot, examine, rank_places, weighed
from operando.diagnosis.records.steps import Tried, choose, search_step, settle_law, with_law
from operando.dof import match_dofs
from operando.errors import ConfigError, DataError
from operando.structure import with_masses
from operando.structure.effects import Effect
from operando.structure.force_law import ForceLaw, law_of
from operando.threads import one_blas_thread

ENOUGH = 1.5
"""A reduced chi-square of the hold-out set above this after an effect was added is held against the best effect that the search finds."""

SWEEPS = 2
"""Times that several effects are fitted in turn, the others as they stand."""


def apply_to_records(
    idle: ModalModel,
    effects: Sequence[Effect],
    records: Sequence[TimeRecord],
    *,
    geometry: Geometry | None = None,
    band: tuple[float, float] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    refit: bool = True,
    progress: Callable[[str], None] | None = None,
    day: Day | None = None,
) -> RecordsApplied:
    """Put effects into the idle model in order, fit all of them in records, and test each step on the level that nothing was fitted to.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent ones, springs and dampers; values that an effect fixes are held. Point masses among them come first and are held:
        they are part of the model that the others are fitted with.
    records : sequence of TimeRecord
        Of the running state with measured force.
    geometry : Geometry, optional
        For the model with the effects.
    band, exclude_bands, progress, day
        As in :func:`operando.diagnosis.diagnose_records`; on another day no masses are put in.
    refit : bool
        False holds all values as they are given.

    Raises
    ------
    DataError
        If the idle model has no scale.
    ConfigError
        If an effect has no restoring force of displacement and velocity, or only some of its values are to be held.
    IdentificationError
        If the fit with an effect ends farther from the records it is fitted to than without it.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so no effect has a size in it", hint="give the units of force and acceleration")
    say = progress or (lambda message: None)
    if day is not None:
        idle, records = day.idle, [day.corrected(record) for record in records]
    with one_blas_thread():
        masses = [e for e in effects if e.kind == "point_mass"]
        running, effects = with_masses(idle, effects)
        if not effects and masses:
            law_of(masses[0], idle)  # refused: records alone size none
        # The idle model, with one mass more each, and with all of them.
        models = [with_masses(idle, masses[:k])[0] for k in range(len(masses))]
        before = [make_case(model, records, band, None, exclude_bands) for model in models]
        first = make_case(running, records, band, None, exclude_bands, day)
        held = [not refit or _held(e) for e in effects]
        # The noise of each line is what no force at the best place explains: what is added has no part in it.
        first = weighed(first, rank_places(first, first.places)[0][1])
        tried: list[Tried] = []
        for k, effect in enumerate(effects):
            say(f"fit {effect.kind}" + (f" at {effect.place}" if effect.place else ""))
            tried.append(_fitted(_with_laws(first, tried), effect, law_of(effect, running)[0], held[k]))
            for _ in range(SWEEPS if k else 0):
                for i in range(k + 1):
                    others = [t for j, t in enumerate(tried) if j != i]
                    tried[i] = _fitted(_with_laws(first, others), effects[i], tried[i].law, held[i])
        steps = _steps(first, effects, tried)
        weighted = [Weighted.of(r) for r in first.runs]
        errors = [[r.error for r in first.runs], *(t.spot.errors(t.law) for t in steps)]
        rows = [
            step_row(k, masses[k - 1] if k else None, first, weighted, [r.error for r in case.runs])
            for k, case in enumerate([*before, first])
        ]
        n, given = len(first.fitted), len(masses)
        left = [misfit(lines_of(weighted[:n], of_runs[:n])) or 0.0 for of_runs in errors]
        final = [t if np.isnan(t.selection) else of_all_runs(t) for t in tried]  # values that stand were not selected
        stated: list[Effect] = []
        for k, (effect, t) in enumerate(zip(effects, final, strict=True)):
            std = {} if held[k] else std_of(t, day)
            stated.append(replace(effect, values={n: abs(v) for n, v in t.law.values.items()}, std=std))
            # The spot saw the records without the earlier effects already.
            rows.append(step_row(given + k + 1, stated[-1], first, weighted, errors[k + 1]))
            if not held[k] and not effect.removed:
                refuse_failed(stated[-1], left[k], left[k + 1])
        better = tuple((given + k, other, chi) for k, other, chi in _better(first, rows[given:], steps, say))
        notes: list[str] = []
        picture = pictures_of(first, stated, final, notes)
        simulation = simulated(first, steps, notes)
        same = ((),) * given + equivalents_of(first, stated, final)
        every = (*masses, *stated)
        notes += [OF_ALL_RUNS] if any(one is not other for one, other in zip(final, tried, strict=True)) else []
        words = (*_words(every, rows, better), *notes)
        return RecordsApplied(
            linear_model(idle, every, same, geometry),
            every,
            tuple(rows),
            words,
            judged_on(first),
            better=better,
            log_score=log_score(zip(weighted, errors[-1], strict=True)),
            picture=picture,
            simulation=simulation,
            equivalents=same,
        )


def _held(effect: Effect) -> bool:
    """Whether the values of an effect stand fast."""
    names = set(effect.definition.names)
    fixed = names & set(effect.fixed)
    if fixed and fixed != names:
        raise ConfigError(
            f"{effect.kind} is fitted to records with all of its values or none",
            where=effect.place or None,
            hint=f"fix {', '.join(sorted(names))}, or none of them",
        )
    return bool(fixed)


def _with_laws(case: RecordsCase, known: Sequence[Tried]) -> RecordsCase:
    for t in known:
        case = with_law(case, t)
    return case


def _spot(case: RecordsCase, effect: Effect) -> Spot:
    """The place of an effect as it is written: the senses of its DOFs count."""
    _, b = law_of(effect, case.idle)
    rows, _ = match_dofs(effect.location, case.idle.dofs)
    return examine(Sets.of(case), tuple(int(i) for i in rows), b=b)


def _fitted(case: RecordsCase, effect: Effect, law: ForceLaw, held: bool) -> Tried:
    """An effect in a case whose other effects are known; as it stands where it is held or no size of it lowers the chi-square."""
    spot = _spot(case, effect)
    found = None if held or effect.removed else fit_law(spot.fit, law.kind)
    if found is not None:
        return closed_loop_force(case, refined(settle_law(spot, found)))
    return _standing(case, spot, law)


def _standing(case: RecordsCase, spot: Spot, law: ForceLaw) -> Tried:
    """A law whose values stay."""
    return closed_loop_force(case, Tried(spot.settled(law), law, np.nan, np.nan), fitted=False)


def _steps(case: RecordsCase, effects: Sequence[Effect], tried: Sequence[Tried]) -> list[Tried]:
    """Each effect, with the values found, in records from which the earlier ones alone are taken."""
    if len(tried) < 2:
        return list(tried)
    out: list[Tried] = []
    for effect, t in zip(effects, tried, strict=True):
        stage = _with_laws(case, out)
        out.append(_standing(stage, _spot(stage, effect), t.law))
    return out


def _better(
    case: RecordsCase, rows: Sequence[dict[str, Any]], steps: Sequence[Tried], say: Callable[[str], None]
) -> tuple[tuple[int, Effect, float], ...]:
    """Steps that leave much where another effect would leave less than half of it."""
    out = []
    for k in range(1, len(rows)):
        left = rows[k]["heldout_misfit"]
        if left > ENOUGH and rows[k - 1]["heldout_misfit"] > ENOUGH:
            say("look for what would do better")
            found = search_step(_with_laws(case, steps[: k - 1]), wanted_kinds(None), None, rows[0]["misfit"])
            if found.tried and (best := choose(found.tried)).validation < 0.5 * left:
                out.append((k, effect_of(case, best), best.validation))
    return tuple(out)


def _words(effects: Sequence[Effect], rows: Sequence[dict[str, Any]], better: Sequence[tuple[int, Effect, float]]) -> list[str]:
    """A sentence about each effect."""
    words = []
    for k, effect in enumerate(effects, 1):
        words.append(words_of(effect, rows[k - 1]["heldout_misfit"], rows[k]["heldout_misfit"]))
        words += [
            f"the data speak for another one: {other} would lower it to {left:.4g}; `operando remove` takes step {k} back"
            for step, other, left in better
            if step == k
        ]
    return words
