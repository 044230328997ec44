"""Find the missing physics from check FRFs: the search, its ladder, and the document ``diagnosis.json``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare.measures import Lines, error_db, noise_floor_db
from operando.compare.verdict import GOOD, floor_reason, verdict_of
from operando.data import Frf, Geometry, ModalModel, TimeRecord
from operando.diagnose.between import between_sensors
from operando.diagnose.drawn import Drawn
from operando.diagnose.law import alone_by_free_law, gain_by_free_law
from operando.diagnose.learn import learn, on_all_lines
from operando.diagnose.localise import localise
from operando.diagnose.measurement import propose
from operando.diagnose.model import Model
from operando.diagnose.places import candidates as all_candidates
from operando.diagnose.power import unseen, what_hides
from operando.diagnose.problem import EARNED, Problem, Tried
from operando.diagnose.refit import Fit, model_variance, predicted
from operando.diagnose.result import effects_of, model_of
from operando.diagnose.search import EXCUSED, MAX_EFFECTS, other_orders, search
from operando.diagnose.sensor_mass import of_a_sensor, renamed
from operando.diagnose.sets import JUDGE, LEVEL_LIMIT, CheckLines, split_lines
from operando.diagnose.support import further, noise_alone, taken_out, weakest
from operando.diagnose.verdict import FURTHER_PART, ambiguous_with, one_mode
from operando.effects import Effect
from operando.errors import DataError, MissingError
from operando.results import CheckRun
from operando.threads import one_blas_thread

Array = NDArray[Any]


@dataclass(frozen=True)
class Diagnosis(Drawn):
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
        One row a step: error and misfit, on all lines and on the judge set.
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
        State, level and lines of the held-out figures.
    detectable : tuple of dict
        The least change of each mode's frequency that would have been seen.
    reason : str or None
        What stands in the way of a better verdict.
    between, discrepancy : tuple of dict and dict, optional
        What differs between the two measurements and is no missing physics; the share of the FRFs that no parameter explains.
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
            "by_level": None,  # not estimated yet
        }


def diagnose(
    idle: ModalModel,
    *,
    check: Sequence[CheckRun] = (),
    operating: ModalModel | None = None,
    geometry: Geometry | None = None,
    hybrid: Any = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
    records: Sequence[TimeRecord] = (),
    idle_frf: Frf | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    compared: Mapping[str, Any] | None = None,
) -> Diagnosis:
    """Name the physical effect that the idle model lacks, where it acts and how large it is.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, with residual modes and covariance.
    check : sequence of CheckRun
        FRFs of the running structure.
    operating : ModalModel, optional
        Operational modes, used where there is no check.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    hybrid : HybridModel, optional
        Not used from check FRFs.
    kinds, places : sequences, optional
        Look only for these.
    band : (float, float), optional
        Lines used [Hz]; default the idle model's band.
    progress : callable, optional
        Told what is being done.
    records : sequence of TimeRecord, optional
        The check's records, force and responses: where the running structure is not linear they are looked at.
    idle_frf : Frf, optional
        FRFs at rest: how much of the responses is not proportional to the force there.
    exclude_bands : sequence of (float, float)
        Lines of the records left out [Hz].
    compared : mapping, optional
        Errors of the idle model against these runs, as :func:`operando.compare.compare_all` gives them; made where not given.

    Raises
    ------
    DataError
        If the idle model is not scaled to unit modal mass.
    MissingError
        If there is neither a check nor operational modes.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so it predicts no FRF to fail", hint="give the units of force and acceleration")
    if records:
        from operando.diagnose.from_records import diagnose_levels

        asked: dict[str, Any] = {
            "geometry": geometry,
            "kinds": kinds,
            "places": places,
            "band": band,
            "progress": progress,
            "compared": compared,
        }
        linear = (lambda: diagnose(idle, check=check, operating=operating, hybrid=hybrid, **asked)) if check else None
        return diagnose_levels(linear, idle, check, records, idle_frf=idle_frf, exclude_bands=exclude_bands, **asked)
    if not check:
        if operating is None:
            raise MissingError("neither check FRFs nor operational modes to diagnose from")
        from operando.diagnose.output_only import diagnose_output_only

        return diagnose_output_only(idle, operating, geometry=geometry, kinds=kinds, places=places, band=band, progress=progress)
    with one_blas_thread():
        problem = make_problem(idle, check, kinds, places, band or idle.band_hz, progress)
        return _search(problem, check, operating, geometry, band or idle.band_hz, compared)


def make_problem(
    idle: ModalModel,
    check: Sequence[CheckRun],
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Problem:
    """Lines, sets, variances and candidates, before anything is fitted."""
    from operando.compare.comparison import lowest_level
    from operando.dof import parse_dofs

    judge = lowest_level(check)
    ordered = sorted(check, key=lambda run: run.level != judge)
    lines = split_lines(ordered, idle, band)
    own = idle_variance(idle, lines)
    responses = [idle.dofs[i] for i in lines.responses]
    references = [idle.dofs[i] for i in lines.references]
    if band is None:
        band = (float(lines.hz.min()), float(lines.hz.max()))
    templates = all_candidates(idle, responses, references, band, kinds, None if places is None else parse_dofs(places))
    return Problem(idle, lines, own, templates, progress)


def idle_variance(idle: ModalModel, lines: CheckLines) -> Array:
    """The idle model's own variance of each line (receptance)."""
    if idle.covariance is None:
        return np.zeros(lines.data.shape)
    hz, back = np.unique(lines.hz, return_inverse=True)
    made = idle.frf(hz, [idle.dofs[i] for i in lines.responses], [idle.dofs[i] for i in lines.references], "receptance")
    assert made.variance is not None
    return np.moveaxis(made.variance, 2, 0)[back]


def _search(
    problem: Problem,
    check: Sequence[CheckRun],
    operating: ModalModel | None,
    geometry: Geometry | None,
    band: tuple[float, float] | None,
    compared: Mapping[str, Any] | None,
) -> Diagnosis:
    idle = problem.idle  # without the places between sensors that the search may add
    one_system = not problem.lines.disagreement > LEVEL_LIMIT
    judged = problem.sets[JUDGE]
    floor = noise_floor_db(flat(judged, problem.owns[JUDGE], predicted(problem.arrays, judged, problem.empty())[0]))
    if floor_reason(floor) is not None and len(problem.templates) > MANY:
        return _not_searched(problem, check, band, compared, floor)
    found = search(problem, MAX_EFFECTS if one_system else 1, lambda first: between_sensors(problem, geometry, first))
    if found.elsewhere is not None:
        problem, geometry, found = found.elsewhere
    most = MAX_EFFECTS if one_system and not one_mode(idle) else 1
    found, more = further(problem, found, most) if most > 1 else (found, None)
    fits, history, before, last = found.fits, found.history, found.before, found.last
    final = [problem.settled(f) if f.terms else f for f in fits]
    sensors = of_a_sensor(problem, final[-1], operating, geometry)
    rows, final = ladder(problem, [renamed(f, sensors) for f in final])
    if one_system and rises(rows) and rows[-1]["heldout_misfit"] < GOOD:
        # Effects that make up for each other: told in an order in which each helps, if there is one.
        for other_fits, other_history in other_orders(problem, fits[-1], history):
            again = [problem.settled(f) if f.terms else f for f in other_fits]
            other_rows, again = ladder(problem, [renamed(f, sensors) for f in again])
            if not rises(other_rows) and other_rows[-1]["heldout_misfit"] < GOOD:
                fits, history, rows, final = other_fits, other_history, other_rows, again
                break
    notes = list(problem.lines.notes)
    kept = lowering([r["heldout_misfit"] for r in rows]) if one_system else len(rows)
    dropped: list[Effect] = []
    if kept < len(rows):
        rows, final, fits, history = rows[:kept], final[:kept], fits[:kept], history[: kept - 1]
        notes.append("an effect that fitted was taken back: with it, lines the fit had not seen were predicted worse")
    rows, final = with_what_was_learnt(problem, rows, final)
    if kept < len(found.fits) and not noise_alone(problem, final[-1]):
        more = "something more is missing, but not what was found: it left lines the fit had not seen worse predicted"
    while (weak := weakest(final[-1])) is not None:
        dropped.append(effects_of(final[-1])[weak])
        notes.append(f"{dropped[-1].kind} at {dropped[-1].place or 'the whole'} is a candidate only: its 95 % interval holds zero")
        fits, history = taken_out(problem, fits, history, weak)
        rows, final = ladder(problem, [renamed(problem.settled(f) if f.terms else f, sensors) for f in fits])
        rows, final = with_what_was_learnt(problem, rows, final)
    if dropped and history and noise_alone(problem, final[-1]):
        more = None  # what was found beyond these effects has no support, and nothing but noise is left
    alternatives, other = ambiguous_with(problem, history, geometry) if history else ([], False)
    if history and rows[-1]["heldout_misfit"] >= GOOD:
        gain, odd = gain_by_free_law(problem, fits[-1])
        if odd is not None and gain < FURTHER_PART:
            place = ", ".join(map(str, odd.dofs)) or "the place found"
            more = (
                f"what acts at {place} does not follow the law of {odd.kind.plain}: "
                f"free to bend over frequency it lowers the misfit by {1 - gain:.0%}"
            )
    if not one_system:
        more = "the runs of different level are not one linear system: a linear effect cannot explain both"
    hidden, detectable = unseen(problem, floor, rows[0]["heldout_misfit"])
    judge = [r["heldout_misfit"] for r in rows]
    verdict, reason = verdict_of(judge, unseen=hidden, more=more, ambiguous=other)
    if verdict == "explained" and (alone := alone_by_free_law(problem, fits[-1], history[0][1])) is not None:
        place = ", ".join(map(str, alone.dofs)) or "one place"
        more = f"one effect at {place}, of a law that is not in the catalogue, explains about as much as the effects named together"
        verdict, reason = verdict_of(judge, unseen=hidden, more=more)
    if verdict in ("explained", "ambiguous", "partial"):
        if final[-1].learnt is not None:
            notes.append(CORRECTED)
        if verdict != "partial":
            whole = on_all_lines(problem, final[-1])
            if weakest(whole) is None:  # else the last fit has lost its way: the sizes that were judged stand
                final[-1] = whole
                rows[-1]["added"] = effects_of(whole)[-1].to_dict()
                notes.append(AFTERWARDS)
    elif history:
        dropped += effects_of(final[-1], problem.idle.dofs)
        rows, final, alternatives = rows[:1], final[:1], []
    effects = tuple(effects_of(final[-1], problem.idle.dofs))
    ranked = [
        *(unsupported_row(e, judge) for e in dropped),
        *(candidate_row(t, before) for t in (found.history[0][1] if found.history else last)),
    ]
    proposal = what_hides(problem) if verdict == "inconclusive" else propose(problem, final[-1], alternatives, verdict)
    where = where_it_fails(idle, check, band, compared)
    picture = localise(problem, effects, final[-1])
    return Diagnosis(
        verdict,
        effects,
        tuple(effects_of(t.fit)[-1] for t in alternatives),
        proposal,
        tuple(rows),
        tuple(ranked),
        where,
        floor,
        ("check_frf",),
        picture,
        tuple(notes),
        problem.idle,
        model_of(problem, final[-1], geometry),
        judged_on(problem, check),
        tuple(detectable),
        reason,
    )


def _not_searched(
    problem: Problem, check: Sequence[CheckRun], band: tuple[float, float] | None, compared: Mapping[str, Any] | None, floor: float | None
) -> Diagnosis:
    """The diagnosis where the noise floor hides what an effect does, and thousands of candidates would be fitted for nothing to believe."""
    idle = problem.idle
    rows, final = ladder(problem, [problem.empty()])
    hidden, detectable = unseen(problem, floor, rows[0]["heldout_misfit"])
    verdict, reason = verdict_of([rows[0]["heldout_misfit"]], unseen=hidden)
    return Diagnosis(
        verdict,
        (),
        (),
        what_hides(problem),
        tuple(rows),
        (),
        where_it_fails(idle, check, band, compared),
        floor,
        ("check_frf",),
        localise(problem, (), final[-1]),
        (*problem.lines.notes, f"no effect was looked for: {hidden}"),
        idle,
        model_of(problem, final[-1], None),
        judged_on(problem, check),
        tuple(detectable),
        reason or hidden,
    )


def lowering(judge: Sequence[float]) -> int:
    """How many steps of a ladder are left when effects, the last first, that leave the judge worse than an earlier step are taken back.

    Where the data allow no better, a rise within what noise does counts as none; of the first effect too, which may need the next.
    """
    kept = len(judge)
    while kept > 1 and judge[kept - 1] > (1 + EARNED if judge[kept - 1] < GOOD or kept == 2 else 1) * min(judge[: kept - 1]):
        kept -= 1
    return kept


def rises(rows: Sequence[dict[str, Any]]) -> bool:
    """Whether a step before the last raises the judge's misfit."""
    judge = [row["heldout_misfit"] for row in rows]
    return any(b > a for a, b in pairwise(judge[:-1]))


def flat(lines: CheckLines, own: Array, data: Array) -> Lines:
    """Lines for the error measures of the comparison."""
    good = np.isfinite(lines.variance)
    response = np.broadcast_to(lines.responses[None, :, None], lines.data.shape)
    hz = np.broadcast_to(lines.hz[:, None, None], lines.data.shape)
    return Lines(data[good], lines.data[good], lines.variance[good], own[good], response[good], hz[good])


def ladder(problem: Problem, fits: Sequence[Fit]) -> tuple[list[dict[str, Any]], list[Fit]]:
    """Error and misfit of each step, on all lines and on the judge set; the fits, their numbers no surer than the judge set lets them be.

    A step is judged by the idle model's variance as its effects carry it on; but effects that leave the data unexplained at places
    the idle model knows little of are not excused by that.
    """
    from operando.diagnose.refit import mean_misfit

    rows, told = [], []
    judge = problem.lines.group == JUDGE
    for number, fit in enumerate(fits):
        data, _ = predicted(problem.arrays, problem.lines, fit)
        carried = model_variance(problem.idle, problem.arrays, problem.lines, fit) if number else problem.own
        own = np.maximum(carried, problem.own)  # what the fit learnt of shapes it learnt within the model's own errors
        if mean_misfit(problem.lines.where(judge), own[judge], data[judge]) > EXCUSED:
            own = np.minimum(carried, problem.own)
        everything = flat(problem.lines, own, data)
        held = flat(problem.lines.where(judge), own[judge], data[judge])
        unseen = mean_misfit(problem.lines.where(judge), own[judge], data[judge])
        if fit.terms:
            fit = replace(fit, excess=max(fit.excess, unseen))
        told.append(fit)
        rows.append(
            {
                "step": number,
                "added": effects_of(fit)[-1].to_dict() if number else None,
                "error_db": error_db(everything),
                "heldout_error_db": error_db(held),
                "misfit": mean_misfit(problem.lines, own, data),
                "heldout_misfit": unseen,
            }
        )
    return rows, told


MANY = 1000
"""Candidates beyond which a search is made only where it can be believed: 13 sensors have hundreds, 81 have 10 000 and take minutes."""


CORRECTED = (
    "with the effects known, the check lines also corrected the frequencies, damping ratios and shapes of the idle model, "
    "within their uncertainty; the last step of the ladder has them corrected"
)


AFTERWARDS = (
    "after they had judged, the lines of the judge set counted for the values and the model, too; the ladder's errors are those unseen"
)


def with_what_was_learnt(problem: Problem, rows: list[dict[str, Any]], fits: list[Fit]) -> tuple[list[dict[str, Any]], list[Fit]]:
    """The last step with the idle model corrected by the lines: for effects that leave nothing but the idle model's own errors.

    Kept where lines that were not fitted are predicted better.
    """
    if not fits[-1].terms:
        return rows, fits
    corrected = learn(problem, fits[-1])
    again, _ = ladder(problem, [*fits[:-1], corrected])
    if corrected.learnt is None or again[-1]["heldout_misfit"] > rows[-1]["heldout_misfit"]:
        return rows, fits
    return again, [*fits[:-1], corrected]


def candidate_row(tried: Tried, before: Sequence[float]) -> dict[str, Any]:
    """One entry of ``candidates``."""
    effect = effects_of(tried.fit)[-1]
    fall = 1 - tried.selection / before[0]
    return effect.to_dict() | {
        "selection_misfit": tried.selection,
        "evidence": f"misfit on lines the fit has not seen {before[0]:.4g} → {tried.selection:.4g} ({100 * fall:.1f} % lower)",
    }


def unsupported_row(effect: Effect, judge: Sequence[float]) -> dict[str, Any]:
    """An entry of ``candidates`` for what was found and is not supported."""
    evidence = (
        f"found, but not supported: reduced chi-square on the validation lines {judge[0]:.4g} → {judge[-1]:.4g} with all that was found"
    )
    return effect.to_dict() | {"selection_misfit": None, "evidence": evidence}


def where_it_fails(
    idle: ModalModel, check: Sequence[CheckRun], band: tuple[float, float] | None, compared: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """``by_dof``, ``by_band``, ``by_mode`` of the idle model on the runs of the lowest level: the figures of the comparison."""
    from operando.compare import compare_all

    made = compared or compare_all({"idle": idle}, check, band)["models"]["idle"]
    return {key: made[key] for key in ("by_dof", "by_band", "by_mode")}


def judged_on(problem: Problem, check: Sequence[CheckRun]) -> dict[str, Any]:
    """State, level and lines of the ladder's figures on the judge set."""
    from operando.compare.comparison import lowest_level

    judge = problem.sets[JUDGE]
    return {
        "state": "operating",
        "measured": "FRF lines",
        "runs": [judge.runs[k] for k in np.unique(judge.run)],
        "level": lowest_level(check),
        "band_hz": [float(problem.lines.hz.min()), float(problem.lines.hz.max())],
        "n_lines": int(np.sum(np.isfinite(judge.variance))),
        "whole_run": bool(np.all(problem.lines.group[np.isin(problem.lines.run, judge.run)] == JUDGE)),
    }
