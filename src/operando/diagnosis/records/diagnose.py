"""Diagnosis from records with measured force: which level-dependent effect is missing in the idle model, where and how large."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from operando.data import Geometry, ModalModel, TimeRecord
from operando.diagnosis.records.case import RecordsCase, make_case
from operando.diagnosis.records.closed_loop import closed_loop_force
from operando.diagnosis.records.conclude import conclude, effect_of
from operando.diagnosis.records.day import Day
from operando.diagnosis.records.detect import detect, distortion
from operando.diagnosis.records.refine import refined
from operando.diagnosis.records.result import RecordsDiagnosis
from operando.diagnosis.records.steps import ALIKE_AT_MOST, SearchStep, Tried, choose, improves, search_step, with_law
from operando.dof import Dof, match_dofs, parse_dofs
from operando.errors import DataError
from operando.structure.effects import catalogue, kind_of
from operando.threads import one_blas_thread

MAX_EFFECTS = 3
ONE_PLACE = 1.5
"""Where one force at the place found leaves no more than this misfit nothing acts elsewhere."""


def diagnose_records(
    idle: ModalModel,
    records: Sequence[TimeRecord],
    *,
    geometry: Geometry | None = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    progress: Callable[[str], None] | None = None,
    day: Day | None = None,
    at_most: int = MAX_EFFECTS,
) -> RecordsDiagnosis:
    """Name the level-dependent effect that is missing in the idle model in records of the running state with measured force.

    Reverse path with a known linear part (Bendat & Piersol, Random Data): the idle model is the underlying linear system, so the only
    unknowns are the place, the law and its few values. Searched in response space, weighted by the model and the noise.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, residual modes included.
    records : sequence of TimeRecord
        Force and responses of the running state, best at two levels: the lower one is the hold-out set.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    kinds, places : sequences, optional
        Look only for these; a place is a DOF or a pair of DOFs.
    band : (float, float), optional
        Lines used [Hz]; default the idle model's band, and up to its last mode.
    exclude_bands : sequence of (float, float)
        Lines left out [Hz], as those of a rotor's orders.
    progress : callable, optional
        Told what is being done.
    day : Day, optional
        Another day than that of the idle model, on which the records were taken; they are corrected for its gains.
    at_most : int
        Number of effects to look for.

    Returns
    -------
    RecordsDiagnosis

    Raises
    ------
    DataError
        If the idle model is not scaled to unit modal mass, or a force is not at one of its DOFs.
    MissingError
        If there is no record.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so it predicts no response to fail", hint="give the units of force and acceleration")
    if day is not None:
        idle, records = day.idle, [day.corrected(record) for record in records]
    with one_blas_thread():
        case = make_case(idle, records, band, None if places is None else place_rows(idle, places), exclude_bands, day)
        wanted = wanted_kinds(kinds)
        return _diagnose(case, wanted, geometry, progress, at_most)


def measured_distortion(
    idle: ModalModel,
    records: Sequence[TimeRecord],
    band: tuple[float, float] | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
) -> float | None:
    """How much more than at the lowest level is not proportional to the force at the highest.

    Cheap: nothing is searched. None where there is one level.

    Raises
    ------
    DataError
        If a force is not at a DOF of the idle model.
    MissingError
        If there is no record.
    """
    with one_blas_thread():
        return distortion(make_case(idle, records, band, (), exclude_bands))


def place_rows(idle: ModalModel, places: Sequence[Any]) -> list[tuple[int, ...]]:
    """Rows of the idle model of DOFs or pairs of DOFs."""
    each = (places,) if isinstance(places, (str, Dof)) else places
    return [tuple(match_dofs(parse_dofs(place), idle.dofs)[0]) for place in each]


def wanted_kinds(kinds: Sequence[str] | None) -> list[str]:
    """Level-dependent kinds, and spring and damper, which a linear effect is told from them by."""
    nonlinear = [name for name, kind in catalogue().items() if kind.acts == "pseudo_force"]
    if kinds is None:
        return ["ground_spring", "ground_damper", *nonlinear]
    return [k for k in (kind_of(k).kind for k in kinds) if k in (*nonlinear, "ground_spring", "ground_damper")] or nonlinear


def _diagnose(
    case: RecordsCase, kinds: list[str], geometry: Geometry | None, say: Callable[[str], None] | None, at_most: int
) -> RecordsDiagnosis:
    first = case
    steps: list[SearchStep] = []
    accepted: list[Tried] = []
    more: str | None = None
    while True:
        step = search_step(case, kinds, say, steps[0].base_select if steps else None)
        steps.append(step)
        case = step.case
        if not step.tried:
            break
        best = choose(step.tried)
        if not improves(step, best, accepted):
            break
        best = as_far_as_known(case, step, closed_loop_force(case, refined(best)), accepted)
        accepted.append(best)
        if len(accepted) >= at_most:
            more = f"no search for more than {at_most} effects is made" if at_most > 1 else "no search for more than one effect is made"
            break
        case = with_law(case, best)
        if best.spot.free < ONE_PLACE:
            case = replace(case, places=(best.spot.place,))
        if say:
            say(f"{best.law.kind} accepted, look for more")
    detection = replace(detect(first), location=tuple(map(str, first.located(steps[0].place))))
    return conclude(first, steps, accepted, more, detection, geometry)


def as_far_as_known(case: RecordsCase, step: SearchStep, best: Tried, before: Sequence[Tried]) -> Tried:
    """A law whose values the data tell, in place of one that contains it, is hardly nearer and has values that they leave open."""
    contained = [t for t in step.tried if t.spot.place == best.spot.place and t.law.kind in best.law.definition.contains]
    contained = [t for t in contained if improves(step, t, before) and t.selection <= (1 + ALIKE_AT_MOST) * best.selection]
    if contained and not effect_of(case, best).determined:
        for simpler in contained:
            found = closed_loop_force(case, refined(simpler))
            if effect_of(case, found).determined:
                return found
    return best
