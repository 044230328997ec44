"""Effects added and taken away by hand: refit of all, the error of each step on lines that were never fitted, and words about each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from operando.data import Frf, Geometry, ModalModel, expect, positive_band, several
from operando.diagnosis.applied import Applied, failed, refuse_failed, words_of
from operando.diagnosis.arguments import UNKNOWN_UNITS, chosen_run, searched, validation_runs
from operando.diagnosis.between import SAME_SET_UP, spreads_of
from operando.diagnosis.case import Case
from operando.diagnosis.corrected import effects_of, model_of
from operando.diagnosis.criteria import EXPLAINED, LOOSE, MOST_CHI_SQUARE, tolerated
from operando.diagnosis.days import strained
from operando.diagnosis.discrepancy import discrepancy_row, most_likely
from operando.diagnosis.document import another_day, between_rows, judged_on, ladder, step_row
from operando.diagnosis.forward import Point
from operando.diagnosis.idle import Idle
from operando.diagnosis.lacking import with_lacking
from operando.diagnosis.measured import Measured
from operando.diagnosis.midway import Midway, at_position, located, with_midway
from operando.diagnosis.posterior import State, approach, fit, left_on
from operando.diagnosis.rival import fitted_if_can_be, started
from operando.diagnosis.scan import LinearScan, robust_scan
from operando.diagnosis.terms import SEARCHED, Term
from operando.dof import match_dofs
from operando.errors import ConfigError, DataError, MissingError
from operando.results import CheckRun
from operando.structure.effects import Effect, parse_effect
from operando.threads import one_blas_thread

_PARTS = (1e-2, 1e-4, 1e-6)
"""Of the start value of an effect, from which a refit begins again where it ended farther from the lines than without the effect."""

_HANDLED = ("dynamic_stiffness", "sensor_map", "modal_change", "added_mode")


def apply_effects(
    idle: ModalModel,
    effects: Effect | str | Sequence[Effect | str],
    *,
    check: Frf | CheckRun | Sequence[Frf | CheckRun],
    geometry: Geometry | None = None,
    band: tuple[float, float] | None = None,
    refit: bool = True,
    progress: Callable[[str], None] | None = None,
    idle_frf: Frf | None = None,
    between: Mapping[str, float] | None = None,
) -> Applied:
    """Put effects into the idle model, refit all of them together, and test each step on lines that were never fitted.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : Effect, str, or several
        In order; values are starting values unless an effect fixes them.
    check : Frf, CheckRun, or several
        FRFs of the running structure, as for :func:`operando.diagnose`.
    geometry : Geometry, optional
        For effects at places without a sensor.
    band : (float, float), optional
        Lines used [Hz]; default the idle model's band.
    refit : bool
        False holds all values as they are given.
    progress : callable, optional
    idle_frf : Frf, optional
        FRFs at rest: what the idle model leaves of them, and which DOFs were driven.
    between : mapping, optional
        What may differ between the measurements, as for :func:`operando.diagnose`.

    Returns
    -------
    Applied
        The model with the effects refitted, the error of each step, and words about each effect.

    Raises
    ------
    DataError
        If the idle model has no scale, or an effect stands at a place without a sensor and there is no geometry.
    MissingError
        If there is no check.
    ConfigError
        If FRFs say nothing of an effect.
    IdentificationError
        If the refit with an effect ends farther from the lines it is fitted to than without it.

    Examples
    --------
    >>> import numpy as np, operando
    >>> shapes = np.array([[0.85, 0.53], [0.53, -0.85]])
    >>> known = np.diag(np.repeat([1e-6, 1e-4], [2, 6]) ** 2)
    >>> idle = operando.ModalModel([12.0, 31.0], [0.01, 0.01], shapes, "1+Z, 2+Z", "unit_modal_mass", covariance=known)
    >>> running = operando.Model(idle).add("point_mass@2+Z=mass:0.1").frf(np.arange(5, 45, 0.2), variance=False)
    >>> operando.apply_effects(idle, "point_mass@2+Z", check=running)
    <Applied: point_mass at 2+Z, 100.0 ± 0.1 g; 4.01 dB before, 0.00 dB after on the hold-out set>
    """
    expect(idle, ModalModel, "effects are added to idle modes", "fit_ema(frf) gives them")
    expect(geometry, Geometry | None, "effects stand on a geometry", "read(file).geometry is one")
    band = None if band is None else positive_band(band)
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so no effect has a size in it", hint="give the units of force and acceleration")
    runs = validation_runs(check)
    if not runs:
        raise MissingError(
            "no FRFs of a validation measurement to test an added effect on", hint="measure the running structure with a known force"
        )
    say = progress or (lambda text: None)
    given = several(effects, (Effect, str), "effects are added", 'write effects, or texts as "point_mass@3+Z"')
    wanted = [parse_effect(e, band or idle.band_hz) if isinstance(e, str) else e for e in given]
    if not refit:
        wanted = [replace(e, fixed=e.definition.names) for e in wanted]
    for e in wanted:
        if e.definition.acts not in _HANDLED:
            raise ConfigError(
                f"{e.kind} cannot be tested on FRFs", hint="name a linear kind, or give the records of the validation measurement"
            )
    with one_blas_thread():
        run = chosen_run(runs)
        states, geometry = fitted_to(idle, wanted, run, say, band=band, geometry=geometry, idle_frf=idle_frf, between=between)
        for last, state in pairwise(states):
            if len(state.terms[-1].fixed) < len(state.terms[-1].values):
                refuse_failed(effects_of(state)[-1], _left(last, last.alpha), _left(state, last.alpha))
        final = estimated(states[-1])
        rows = ladder(final)
        words, days = [], another_day(final)
        without = [step_row(final, 0), *rows[1:]]  # what differs between the days, or can be fitted, is no merit of the first effect
        for k, state in enumerate(states[1:], 1):
            before, after = without[k - 1]["heldout_misfit"], rows[k]["heldout_misfit"]
            words.append(words_of(effects_of(state)[-1], before, after, days))
            if min(before, after) > MOST_CHI_SQUARE and (better := _better(states[k - 1], 0.5 * after)) is not None:
                words.append(
                    f"the data speak for another one: {better[0]} would lower it to {better[1]:.4g}; `operando remove` takes step {k} back"
                )
        if not run.frf.si:
            words.append(UNKNOWN_UNITS)
        return Applied(
            model_of(idle, final, geometry),
            effects_of(final),
            tuple(rows),
            tuple(words),
            judged_on(final, run),
            tuple(between_rows(final)),
            discrepancy_row(final),
        )


def fitted_to(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, say: Callable[[str], None], **options: Any
) -> tuple[list[State], Geometry | None]:
    """Fits to FRFs of the idle model with none of the effects, the first one, and so on; and the geometry with their positions.

    With one set-up or another day: what explains the FRFs better with all effects.

    ``options`` are ``band``, ``geometry``, ``idle_frf`` and ``between`` of :func:`apply_effects`.
    """
    cases, terms, geometry = _posed(idle, effects, run, say, **options)
    states = _steps(cases[0], terms, say)
    for other_day in cases[1:]:
        if states[-1].alpha > LOOSE or _explains_better(other_day, states[-1]):
            steps = _steps(other_day, terms, say)
            if not strained(steps[-1]) and steps[-1].log_evidence > states[-1].log_evidence:
                states = steps
    return states, geometry


def fitted_at_once(
    idle: ModalModel, effects: Sequence[Effect], run: CheckRun, say: Callable[[str], None], *, may_strain: bool = False, **options: Any
) -> State:
    """The fit with all effects, begun as at rest: with one set-up or another day, what is more probable.

    Days that would have to differ by more than days do stand for what is missing, and only ``may_strain`` takes them.
    """
    cases, terms, _ = _posed(idle, effects, run, say, **options)
    found = [fitted_if_can_be(case, started(case, tuple(terms)), LOOSE) for case in cases]
    usual = [state for state in found if state is not None and (may_strain or state.case is cases[0] or not strained(state))]
    if not usual:
        named = ", ".join(f"{e.kind} at {e.place}" for e in effects)
        raise DataError(f"the FRFs of {run.name} cannot be fitted", where=named or None, hint="give other start values")
    return max(usual, key=lambda state: state.log_evidence)


def _posed(
    idle: ModalModel,
    effects: Sequence[Effect],
    run: CheckRun,
    say: Callable[[str], None],
    *,
    band: tuple[float, float] | None,
    geometry: Geometry | None,
    idle_frf: Frf | None,
    between: Mapping[str, float] | None,
) -> tuple[list[Case], list[Term], Geometry | None]:
    """The FRFs with one set-up and, where the test does not say, with another day; effects as terms; geometry with their positions."""
    measured = Measured.of(idle, run.frf, idle_frf, band, say)
    known, places, geometry = _placed(measured.model, effects, geometry)
    kinds = searched(None, measured.poor)

    def of_check(model: Idle, spreads: Mapping[str, float]) -> Case:
        return Case(model.with_near(measured.band, fitted=True), measured.frf, measured.band, dict(spreads), kinds=kinds)

    lacking = next((e for e in effects if e.kind == "missing_mode"), None)
    if lacking is not None:
        bare = of_check(known, {})
        hz = float(lacking.values["frequency"])
        grown = with_lacking(fit(bare, bare.forward.start), hz)
        if grown is None:
            raise DataError(f"no mode near {hz:.4g} Hz adds to the FRFs at their drive points", hint="name another frequency")
        known = grown
    spreads = [spreads_of(between)] if between else [SAME_SET_UP, spreads_of({})]
    return [of_check(known, s) for s in spreads], [Term.of(e, p) for e, p in zip(effects, places, strict=True)], geometry


def estimated(state: State) -> State:
    """The state with what a test does not state estimated: spreads of what differs between the days, and the discrepancy."""
    return most_likely(fit(state.case, state.x, state.alpha, own_spreads=True) if state.alpha < EXPLAINED else state)


def _placed(idle: Idle, effects: Sequence[Effect], geometry: Geometry | None) -> tuple[Idle, list[tuple[int, ...]], Geometry | None]:
    """DOFs of each effect, with a further one for each place without a sensor."""
    there: list[tuple[int, ...]] = []
    middles: list[Midway] = []
    for effect in effects:
        if effect.position is not None:
            if geometry is None:
                raise DataError(f"{effect.kind} at {effect.place} needs the positions of the sensors", hint="give a geometry")
            there.append((len(idle.dofs) + len(middles),))
            middles.append(at_position(idle.dofs, geometry, effect.position, effect.direction))
            continue
        places = tuple(int(i) for i in match_dofs(effect.location, idle.dofs)[0])
        if effect.definition.coordinates == "node" and places:
            first = idle.dofs[places[0]]
            turning = first.axis.startswith("R")
            places = tuple(i for i, d in enumerate(idle.dofs) if d.node == first.node and d.axis.startswith("R") == turning)
        there.append(places)
    if middles:
        assert geometry is not None
        grown = with_midway(idle, geometry, middles)
        assert grown is not None
        return grown, there, located(geometry, grown)
    return idle, there, geometry


def _steps(case: Case, terms: Sequence[Term], say: Callable[[str], None]) -> list[State]:
    """Fits of the idle model with the first effects, one more each time; each new one from its values, or from those the lines prefer."""
    states = [fit(case, case.forward.start)]
    for term in terms:
        say(f"refit with {term.kind}")
        last = states[-1]
        starts = [term]
        if term.kind in SEARCHED and not term.fixed and term.values:
            starts += [t for _, t, _ in robust_scan(case, last.x, [replace(term, values=())])][:1]
        found: list[State] = []
        for start in starts:
            x = last.carried([*last.terms, start])
            # What was fitted without the effect may stand for it. Where a fit explains the lines, another way to it is not tried.
            for begin, alpha in _begun(case, x, last.alpha):
                state = fitted_if_can_be(case, begin, alpha, floor=max((s.log_evidence for s in found), default=-np.inf))
                found += [] if state is None else [state]
                if state is not None and state.alpha < LOOSE:
                    break
        if not found:
            raise DataError(f"no FRF has {term.kind} with these values", hint="give other start values")
        best = max(found, key=lambda s: s.log_evidence)
        for part in _PARTS:
            if not failed(_left(last, last.alpha), _left(best, last.alpha)) or (faint := _faint(term, part)) is None:
                break
            say(f"the refit failed: again from {part:g} times the start value")
            state = fitted_if_can_be(case, last.carried([*last.terms, faint]), last.alpha)
            best = best if state is None or _left(state, last.alpha) > _left(best, last.alpha) else state
        states.append(best)
    return states


def _begun(case: Case, x: Point, alpha: float) -> Iterator[tuple[Point, float]]:
    """Points to begin a fit at with the discrepancy there: everything else as at rest, as it was fitted without, and nearer."""
    yield started(case, x.terms), LOOSE
    yield x, alpha
    yield approach(case, x)[1], 0.03


def _faint(term: Term, part: float) -> Term | None:
    """The term with a small part of its size to start from; None where that says nothing, or its size is held."""
    if 0 in term.fixed or not term.values or not (term.linear or term.structural):
        return None
    first = part * term.values[0] if term.linear else term.values[0] + float(np.log(part))
    return replace(term, values=(first, *term.values[1:]))


def _left(state: State, alpha: float) -> float:
    """Reduced chi-square of the fitted lines under a discrepancy."""
    return left_on(state.case, state.x, tolerated(alpha), state.case.lines.fit)[0]


def _explains_better(case: Case, state: State) -> bool:
    """Whether the same effects in another case, begun as at rest, are more probable."""
    other = fitted_if_can_be(case, started(case, state.terms), state.alpha, floor=state.log_evidence)
    return other is not None and other.log_evidence > state.log_evidence


def _better(state: State, misfit: float) -> tuple[Effect, float] | None:
    """An effect more at another place or of another kind that leaves less than so much of the lines that were never fitted."""
    case = state.case
    if state.alpha > LOOSE:
        starts = [approach(case, state.carried([*state.terms, term]))[1] for _, term, _ in robust_scan(case, state.x)[:2]]
    else:
        starts = [state.carried([*state.terms, row.term], row.start) for row in LinearScan(state).run()[0][:2]]
    for start in starts:
        try:
            other = fit(case, start, min(state.alpha, 0.03))
        except np.linalg.LinAlgError:
            continue
        left = step_row(other, len(other.terms))["heldout_misfit"]
        if left < misfit:
            return effects_of(other)[-1], left
    return None
