"""Effects chosen by hand in records with measured force: fitted together, and tested on the level that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from operando.data import ModalModel, TimeRecord
from operando.dof import match_dofs
from operando.effects import Effect
from operando.errors import ConfigError, DataError
from operando.nonlinear.conclude import effect_of, pictures_of, simulated
from operando.nonlinear.forward import by_loop
from operando.nonlinear.hold_out import judged_on, step_row
from operando.nonlinear.laws import LawFit, fit_law
from operando.nonlinear.place import Weighted
from operando.nonlinear.polish import polished, std_of
from operando.nonlinear.records import wanted_kinds
from operando.nonlinear.search import Case, Field, Spot, examine, make_case, rank_places, settled
from operando.nonlinear.simulate import law_of
from operando.nonlinear.steps import Tried, choose, search_step, settle_law, weighed, with_law
from operando.threads import one_blas_thread

ENOUGH = 1.5
"""A judge misfit above this after an effect was added is held against the best effect that the search finds."""

SWEEPS = 2
"""Times that several effects are fitted in turn, the others as they stand."""


@dataclass(frozen=True)
class AppliedToRecords:
    """Effects chosen by hand, refitted in records.

    Parameters
    ----------
    effects : tuple of Effect
        In the order given.
    ladder : tuple of dict
        One row a step, as in ``diagnosis.json``.
    better : tuple of (int, Effect, float)
        Step, and an effect that lowers the chi-square of that step to less than half of what the chosen one leaves, with that chi-square.
    picture, simulation : dict
        As in :class:`operando.nonlinear.NonlinearDiagnosis`.
    noise_floor_db : float or None
    notes : tuple of str
    judged_on : dict
        State, level and lines of the hold-out figures.
    """

    effects: tuple[Effect, ...]
    ladder: tuple[dict[str, Any], ...]
    better: tuple[tuple[int, Effect, float], ...]
    picture: dict[str, Any]
    simulation: dict[str, Any]
    noise_floor_db: float | None
    notes: tuple[str, ...]
    judged_on: dict[str, Any]


def apply_to_records(
    idle: ModalModel,
    effects: Sequence[Effect],
    records: Sequence[TimeRecord],
    *,
    band: tuple[float, float] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    refit: bool = True,
    progress: Callable[[str], None] | None = None,
) -> AppliedToRecords:
    """Put effects into the idle model in order, fit all of them in records, and test each step on the level that nothing was fitted to.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent ones, springs and dampers; values that an effect fixes are held.
    records : sequence of TimeRecord
        Of the running state with measured force.
    band, exclude_bands, progress
        As in :func:`operando.nonlinear.diagnose_records`.
    refit : bool
        False holds all values as they are given.

    Raises
    ------
    DataError
        If the idle model has no scale.
    ConfigError
        If an effect has no restoring force of displacement and velocity, or only some of its values are to be held.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so no effect has a size in it", hint="give the units of force and acceleration")
    say = progress or (lambda message: None)
    with one_blas_thread():
        first = make_case(idle, records, band, None, exclude_bands)
        held = [not refit or _held(e) for e in effects]
        # The noise of each line is what no force at the best place explains: what is added has no part in it.
        ranked = rank_places(first, first.places)
        first = weighed(first, ranked[0][1])
        tried: list[Tried] = []
        for k, effect in enumerate(effects):
            say(f"fit {effect.kind}" + (f" at {effect.place}" if effect.place else ""))
            tried.append(_fitted(_case_with(first, tried), effect, _law(effect, idle), held[k]))
            for _ in range(SWEEPS if k else 0):
                for i in range(k + 1):
                    others = [t for j, t in enumerate(tried) if j != i]
                    tried[i] = _fitted(_case_with(first, others), effects[i], tried[i].law, held[i])
        steps = _steps(first, effects, tried)
        weights = [Weighted.of(r) for r in (*first.fitted, *first.validation)]
        errors = [r.error for r in (*first.fitted, *first.validation)]
        n = len(first.fitted)
        rows = [step_row(0, None, weights, n, errors)]
        stated: list[Effect] = []
        for k, (effect, t) in enumerate(zip(effects, steps, strict=True)):
            std = {} if held[k] else std_of(t)
            stated.append(replace(effect, values={n: abs(v) for n, v in t.law.values.items()}, std=std))
            # The spot saw the records without the earlier effects already.
            errors = [m.along.weighted.error / m.along.weighted.root + m.along.h * _force(t, m) for m in t.spot.whole]
            rows.append(step_row(k + 1, stated[-1], weights, n, errors))
        notes: list[str] = []
        better = _better(first, rows, steps, say)
        return AppliedToRecords(
            tuple(stated),
            tuple(rows),
            better,
            pictures_of(first, stated, steps, notes),
            simulated(first, steps, notes),
            rows[0].get("noise_floor_db"),
            tuple(notes),
            judged_on(first),
        )


def _force(tried: Tried, motion: Any) -> Any:
    return motion.under(tried.law)


def _held(effect: Effect) -> bool:
    """Whether the values of an effect stand fast.

    Raises
    ------
    ConfigError
        If only some of them do.
    """
    names = set(effect.definition.names)
    fixed = names & set(effect.fixed)
    if fixed and fixed != names:
        raise ConfigError(
            f"{effect.kind} is fitted to records with all of its values or none",
            where=effect.place or None,
            hint=f"fix {', '.join(sorted(names))}, or none of them",
        )
    return bool(fixed)


def _law(effect: Effect, idle: ModalModel) -> LawFit:
    return law_of(effect, idle)[0]


def _case_with(case: Case, known: Sequence[Tried]) -> Case:
    for t in known:
        case = with_law(case, t)
    return case


def _spot(stage: Field, effect: Effect) -> Spot:
    """The place of an effect as it is written: the senses of its DOFs count."""
    _, b = law_of(effect, stage.case.idle)
    rows, _ = match_dofs(effect.location, stage.case.idle.dofs)
    return examine(stage, tuple(int(i) for i in rows), b=b)


def _fitted(case: Case, effect: Effect, law: LawFit, held: bool) -> Tried:
    """An effect in a case whose other effects are known; as it stands where it is held or no size of it lowers the chi-square."""
    stage = Field.of(case)
    spot = _spot(stage, effect)
    found = None if held or effect.removed else fit_law(spot.fit, law.kind)
    if found is not None:
        return by_loop(case, polished(case, settle_law(stage, spot, found)))
    return by_loop(case, Tried(settled(spot, case, law), law, np.nan, np.nan), fitted=False)


def _steps(case: Case, effects: Sequence[Effect], tried: Sequence[Tried]) -> list[Tried]:
    """Each effect, with the values found, in records from which the earlier ones alone are taken."""
    if len(tried) < 2:
        return list(tried)
    out: list[Tried] = []
    for effect, t in zip(effects, tried, strict=True):
        stage = Field.of(_case_with(case, out))
        here = Tried(settled(_spot(stage, effect), stage.case, t.law), t.law, t.selection, t.validation)
        out.append(by_loop(stage.case, here, fitted=False))
    return out


def _better(
    case: Case, rows: Sequence[dict[str, Any]], steps: Sequence[Tried], say: Callable[[str], None]
) -> tuple[tuple[int, Effect, float], ...]:
    """Steps that leave much where another effect would leave less than half of it."""
    out = []
    for k in range(1, len(rows)):
        left = rows[k]["heldout_misfit"]
        if left > ENOUGH and rows[k - 1]["heldout_misfit"] > ENOUGH:
            say("look for what would do better")
            found = search_step(_case_with(case, steps[: k - 1]), wanted_kinds(None), None, rows[0]["misfit"])
            if found.tried and (best := choose(found.tried)).validation < 0.5 * left:
                out.append((k, effect_of(case, best), best.validation))
    return tuple(out)
