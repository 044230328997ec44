"""Find the missing physics from check FRFs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from operando.compare import FOUND
from operando.data import Frf, Geometry, ModalModel, TimeRecord, expect
from operando.diagnosis.arguments import (
    UNKNOWN_UNITS,
    chosen_run,
    kinds_asked,
    places_asked,
    searched,
    validation_runs,
)
from operando.diagnosis.between import SAME_SET_UP, spreads_of
from operando.diagnosis.case import Case
from operando.diagnosis.confirmed import confirmed
from operando.diagnosis.corrected import effects_of, model_of
from operando.diagnosis.criteria import LOOSE
from operando.diagnosis.days import no_other_day, unlike_days, untouched
from operando.diagnosis.discrepancy import discrepancy_row
from operando.diagnosis.document import (
    between_rows,
    candidate_rows,
    detectable_rows,
    floor_db,
    judged_on,
    ladder,
    law_proposal,
    odds_text,
    picture,
    proposal,
    restricted,
)
from operando.diagnosis.elsewhere import search_between_sensors, search_lacking_mode
from operando.diagnosis.farther_off import farther_off
from operando.diagnosis.found import Found
from operando.diagnosis.free_law import with_free_law
from operando.diagnosis.hypotheses import AT_FIRST, Hypotheses
from operando.diagnosis.idle import Idle
from operando.diagnosis.measured import Measured
from operando.diagnosis.midway import between_sensors, located
from operando.diagnosis.poor_idle import one_effect
from operando.diagnosis.posterior import AtRest
from operando.diagnosis.result import Diagnosis, where_and_levels
from operando.diagnosis.rival import score
from operando.diagnosis.search import DEPTH, WAYS, search
from operando.diagnosis.sensor_mass import of_a_sensor
from operando.diagnosis.size_by_level import levels_disagree
from operando.diagnosis.suggested import suggested_by_modes
from operando.diagnosis.terms import AT_ONE_LOCATION, SEARCHED, Term, touched
from operando.diagnosis.verdict import (
    explains_lines,
    misses_idle_frfs,
    moved_peaks,
    no_other_answer,
    peaks_text,
    verdict,
    verdict_and_reason,
    with_validation,
)
from operando.errors import DataError, MissingError
from operando.results import CheckRun
from operando.threads import one_blas_thread


def diagnose_frf(
    idle: ModalModel,
    check: Sequence[CheckRun],
    *,
    idle_frf: Frf | None = None,
    geometry: Geometry | None = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
    compared: Mapping[str, Any] | None = None,
    between: Mapping[str, float] | None = None,
    operating: ModalModel | None = None,
) -> Diagnosis:
    """Name the physical effect that is missing in the idle model, where it acts and how large it is, from FRFs of the running structure.

    One statistical model: idle parameters with their covariance, what differs between two measurements, effects with priors, and a
    discrepancy in proportion to the FRFs, smooth over a resonance (Kennedy & O'Hagan, J. R. Stat. Soc. B 63, 2001, 425–464). Effects
    are chosen by the Laplace evidence (MacKay, Neural Computation 4, 1992, 415–447) of all kinds at all places; one third of the lines
    is the hold-out set.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, with residual terms and covariance.
    check : sequence of CheckRun
        FRFs of the running structure; the run of the lowest level with the most values is used.
    idle_frf : Frf, optional
        Idle FRFs: whether the idle model explains them, and which DOFs were driven.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    kinds, places : sequences, optional
        Look only for these.
    band : (float, float), optional
        Hz; default the idle model's band.
    progress : callable, optional
        Told what is being done.
    compared : mapping, optional
        ``comparison.json`` of the idle model and the check, as :func:`operando.compare.compare_all` gives it.
    between : mapping, optional
        What may differ between the idle and the operating measurement → one standard deviation (``[between]`` of a test file): of
        ``sensor_gain``, ``force_gain``, ``stiffness``, ``damping``, ``offset``, ``skew``; 0 where nothing was touched. Where nothing is
        stated, two days in a laboratory and one set-up are both tried, and the more probable one is told.
    operating : ModalModel, optional
        Operational modes: effects to begin with, and whether a mass found in the check was there without the sensors of the check.

    Returns
    -------
    Diagnosis

    Raises
    ------
    DataError
        If the idle model has no scale.
    DofError
        If the check and the idle model have no DOF in common.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so it predicts no FRF to fail", hint="give the units of force and acceleration")
    say = progress or (lambda text: None)
    with one_blas_thread():
        run = chosen_run(check)
        both_states = Measured.of(idle, run.frf, idle_frf, band, say)
        frf, band, model, rest, poor = both_states.frf, both_states.band, both_states.model, both_states.rest, both_states.poor
        asked: dict[str, Any] = {
            "kinds": searched(kinds, poor),
            "places": places_asked(idle, places),
            "fitted": None if rest is None or poor else rest.fitted,
        }

        def cases(model: Idle) -> list[Case]:
            """Two days in a laboratory and one set-up, or what the test states."""
            model = model.with_near(band, fitted=True)  # days move and damp modes just outside the band as well, and their flanks are seen
            days = Case(model, frf, band, spreads_of(between or {}), **asked)
            return [days] if between else [days, Case(model, frf, band, SAME_SET_UP, like=days, **asked)]

        def suggested() -> list[Term]:
            if operating is None:
                return []
            return suggested_by_modes(model, operating, band, asked["kinds"], asked["places"], say)

        both, asked_for_all = cases(model), kinds is None and places is None and not poor
        if poor:
            found = one_effect(both, say)
        elif between:
            found = search(both[0], say, depth=AT_FIRST)
        else:
            alpha = 0.0 if rest is None else rest.state.alpha
            again = cases if asked_for_all else None
            found = Hypotheses(both[0], both[1], say, alpha, again, AT_FIRST, geometry, suggested).run()

        def left() -> bool:
            """Whether something is left that another search may find; not where the idle model misses the idle FRFs themselves."""
            if found.unnamed is not None or poor or untouched(found.best):
                return False
            return verdict_and_reason(found, None)[0] in ("partial", "unexplained") or unlike_days(found.best)

        found = with_validation(found)
        # effects at two sensors may stand for one between them, and an absorber for a mode that is lacking
        elsewhere = AT_FIRST if left() else 1 if between_sensors(found.best, geometry) else 0
        # what differs between two days may stand for a mode, too: 1260 nats worse than with it (``benchmarks/hidden_effects/runs.md``)
        days_alone = found.odds is not None and found.odds <= 0 and found.empty.alpha < LOOSE
        modes = left() or days_alone or any(t.kind == "tuned_absorber" for t in found.best.terms)
        if asked_for_all and found.unnamed is None and (elsewhere or modes):
            there = search_between_sensors(found, cases, geometry, say, elsewhere)
            there = search_lacking_mode(there, found.empty, cases, say) if modes else there
            found = found if there is found else with_validation(there)
        if 0 < len(found.best.terms) < DEPTH and left() and not explains_lines(found.best) and not no_other_day(found.best):
            say("further effects:")
            found = with_validation(replace(search(found.best.case, say, start=found), odds=found.odds))
        # shapes between sensors can be made to be many a motion: a force at sensors, whose shapes are known, goes before one there
        behind = WAYS if found.best.case.idle.midway.keys() & set(touched(found.best.terms)) else 0.0
        if asked_for_all and found.unnamed is None and (left() or behind):
            laws = (with_free_law(case, found.best.log_evidence, say) for case in both)
            near = (law for law in laws if law is not None and score(law) > score(found.best) - behind)
            found.unnamed = max(near, key=score, default=None)
        if not poor and found.unnamed is None and (sure := confirmed(found, say)) is not found:
            found = with_validation(sure)
        geometry = located(geometry, found.best.case.idle)
        of_a_sensor(found.best, idle, operating, geometry)
        return told(idle, check, run, found, rest, geometry, band, compared)


def diagnose(
    idle: ModalModel,
    *,
    check: Frf | CheckRun | Sequence[Frf | CheckRun] = (),
    operating: ModalModel | None = None,
    geometry: Geometry | None = None,
    kinds: str | Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
    records: Sequence[TimeRecord] = (),
    idle_frf: Frf | None = None,
    exclude_bands: Sequence[tuple[float, float]] = (),
    compared: Mapping[str, Any] | None = None,
    between: Mapping[str, float] | None = None,
) -> Diagnosis:
    """Name the physical effect that is missing in the idle model, where it acts and how large it is.

    From FRFs of the running structure (:func:`diagnose_frf`), from its records where it is not linear, or from operational modes alone.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, with residual terms and covariance.
    check : Frf, CheckRun, or several, optional
        FRFs of the running structure; as :class:`operando.CheckRun` with a name and a level. The run of the lowest level is used.
    operating : ModalModel, optional
        Operational modes, used where there is no check.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    kinds : str or sequence of str, optional
        Look only for these kinds of :func:`operando.catalogue`.
    places : DOF labels, optional
        Look only at these DOFs of the idle model.
    band : (float, float), optional
        Hz; default the idle model's band.
    progress : callable, optional
        Told what is being done.
    records : sequence of TimeRecord, optional
        The check's records, force and responses: where the running structure is not linear they are looked at.
    idle_frf : Frf, optional
        Idle FRFs.
    exclude_bands : sequence of (float, float)
        Lines of the records left out [Hz].
    compared : mapping, optional
        ``comparison.json`` of the idle model and the check, as :func:`operando.compare.compare_all` gives it.
    between : mapping, optional
        What may differ between the idle and the operating measurement → one standard deviation (``[between]`` of a test file): of
        ``sensor_gain``, ``force_gain``, ``stiffness``, ``damping``, ``offset``, ``skew``; 0 where nothing was touched. Where nothing is
        stated, two days in a laboratory and one set-up are both tried, and the more probable one is told.

    Returns
    -------
    Diagnosis
        Verdict, effects with their sizes, and what stands behind them; ``.model`` predicts FRFs of the running structure.

    Raises
    ------
    DataError
        If the idle model is not scaled to unit modal mass, or the validation FRFs have too few lines in the band.
    DofError
        If a DOF of ``places`` is not in the idle model, or check and idle model have none in common.
    ConfigError
        If a kind, or a name in ``between``, is not known.
    MissingError
        If there is neither a check nor operational modes.

    Examples
    --------
    A mass of 100 g on a chain of two, found from the FRFs of the running structure:

    >>> import numpy as np, operando
    >>> shapes = np.array([[0.85, 0.53], [0.53, -0.85]])
    >>> known = np.diag(np.repeat([1e-6, 1e-4], [2, 6]) ** 2)
    >>> idle = operando.ModalModel([12.0, 31.0], [0.01, 0.01], shapes, "1+Z, 2+Z", "unit_modal_mass", covariance=known)
    >>> running = operando.Model(idle).add("point_mass@2+Z=mass:0.1").frf(np.arange(5, 45, 0.2), variance=False)
    >>> found = operando.diagnose(idle, check=running, kinds="point_mass")
    >>> found
    <Diagnosis: explained; point_mass at 2+Z, 100.0 ± 0.1 g; 0.00 dB on the hold-out set; 4 notes>
    >>> round(found.effects[0].values["mass"], 3)
    0.1
    """
    expect(idle, ModalModel, "a diagnosis needs idle modes first", "fit_ema(frf) gives them")
    expect(operating, ModalModel | None, "operating takes operational modes", "fit_oma(record) gives them")
    expect(geometry, Geometry | None, "effects stand on a geometry", "read(file).geometry is one")
    runs = validation_runs(check)
    asked: dict[str, Any] = {"geometry": geometry, "kinds": kinds_asked(kinds), "places": places, "band": band}
    asked |= {"progress": progress, "compared": compared, "idle_frf": idle_frf, "between": between}

    def from_frf() -> Diagnosis:
        return diagnose_frf(idle, runs, operating=operating, **asked)

    if records:
        from operando.diagnosis.from_records import diagnose_levels

        found = diagnose_levels(from_frf if runs else None, idle, runs, records, exclude_bands=exclude_bands, **asked)
    elif runs:
        found = from_frf()
    elif operating is not None:
        from operando.diagnosis.from_modes import diagnose_modes

        del asked["compared"]
        return diagnose_modes(idle, operating, **asked)
    else:
        raise MissingError(
            "neither FRFs of a validation measurement nor operational modes to diagnose from",
            hint="diagnose(idle, check=frf) or diagnose(idle, operating=modes)",
        )
    return found if all(run.frf.si for run in runs) else replace(found, notes=(UNKNOWN_UNITS, *found.notes))


def told(
    idle: ModalModel,
    check: Sequence[CheckRun],
    run: CheckRun,
    found: Found,
    rest: AtRest | None,
    geometry: Geometry | None,
    band: tuple[float, float],
    compared: Mapping[str, Any] | None,
) -> Diagnosis:
    """The diagnosis of a search."""
    case = found.best.case
    said = verdict(found, None if rest is None else rest.state)
    best, rivals = found.best, said.rivals
    name, why = said.name, said.why
    if name == "ambiguous" and all(no_other_answer(best, rival, geometry) for rival in rivals):
        name, why = "explained", ""
    law, one_set_up = found.unnamed, found.odds
    if law is not None:
        one_set_up = None if "stiffness" in law.case.between.spreads else score(law) - score(best)
    notes = notes_of(idle, check, run, found, rest, one_set_up)
    if levels_disagree(check, case.band) and name in ("explained", "no_misfit", "ambiguous"):
        name, why = ("partial" if said.terms else "unexplained"), "runs of different level disagree: no linear effect explains both"
    if name in FOUND and (worse := farther_off(best)):
        name, why = "partial", worse
    floor = floor_db(found.empty)
    where, by_level = where_and_levels(idle, check, band, compared)
    poor = rest is not None and misses_idle_frfs(rest.state)
    if name == "inconclusive" and (poor or not best.terms) and (moved := moved_peaks(where["by_mode"], case.between.spreads)):
        name, why = "unexplained", f"{why + '; ' if why else ''}{peaks_text(moved)}"
    shown = best.terms if said.terms and name != "unexplained" else ()
    final = best if shown else found.empty
    if shown:
        floor = floor_db(final)
    elif name == "unexplained":
        floor = floor_db(final, 0.0 if rest is None else min(rest.state.alpha, final.alpha))
    rows = ladder(final)  # what was found without support is a candidate, and the ladder ends where the model does
    elsewhere = [t for rival in rivals for t in rival.terms if t.key not in {o.key for o in best.terms}]
    ambiguous = [e for rival in rivals for e in effects_of(rival, [t for t in rival.terms if t in elsewhere])]
    return Diagnosis(
        name,
        effects_of(final) if shown else (),
        tuple({e.kind + e.place: e for e in ambiguous}.values()),
        proposal(found, replace(said, name=name), rivals, poor) if law is None else law_proposal(law),
        tuple(rows),
        tuple(candidate_rows(found)),
        where,
        floor,
        ("check_frf",),
        picture(law or final),
        notes,
        idle,
        model_of(idle, final, geometry),
        judged_on(final, run),
        tuple(detectable_rows(final, said)),
        why or None,
        tuple(between_rows(final if law is None else law)),
        discrepancy_row(law or best),
        by_level,
    )


def notes_of(
    idle: ModalModel, check: Sequence[CheckRun], run: CheckRun, found: Found, rest: AtRest | None, one_set_up: float | None
) -> tuple[str, ...]:
    """What was assumed or left out, with its consequence."""
    notes = []
    unused = [r.name for r in check if r is not run]
    if one_set_up is not None and one_set_up > 0:
        notes.append(
            f"the data say that nothing was touched between the idle and the operating measurement ({odds_text(one_set_up)}); "
            "gains, positions of sensors, temperature and damping count as the same"
        )
    notes += found.left_out
    if unused:
        notes.append(f"the diagnosis uses {run.name} alone; {', '.join(unused)} stand in the comparison only")
    if rest is None:
        notes.append("there are no idle FRFs: the idle model is taken as it is, and the noise of neighbouring lines as independent")
    elif rest.again and idle.coupling is None:  # else the idle model says it itself
        notes.append(
            f"the idle model was fitted to the idle FRFs again, with complex modes; {100 * rest.state.alpha:.2g} % of them stay "
            "unexplained. The FRFs of the model with the effects have what ties the modes to each other; its idle modes alone do not"
        )
    case = found.best.case
    unstated = [("validation", case.lines.noise_stated), ("idle", rest is None or rest.state.case.lines.noise_stated)]
    if which := " and ".join(name for name, stated in unstated if not stated):
        notes.append(
            f"the {which} FRFs state neither variance nor coherence: their noise is estimated from how much neighbouring lines differ, "
            "which is too little where a window makes the noise of neighbours alike"
        )
    if rest is not None and misses_idle_frfs(rest.state):
        notes.append(
            "what the idle model leaves of the idle FRFs counts as error of the operating measurement, too; one effect was looked for, "
            "none beside it, none between sensors, and no mode missing in the idle model"
        )
    if case.kinds == AT_ONE_LOCATION:
        notes.append(
            "effects between two locations (coupling, gyroscopic, circulatory) were not looked for: the error of the idle model on the "
            "idle FRFs themselves is too large for anything to be explained; name them in [analysis] kinds to look for them"
        )
    notes += restricted(case, SEARCHED, AT_ONE_LOCATION)
    count = len(case.dofs) - len(case.idle.midway) - case.forward.responses.size
    if count:
        notes.append(f"{count} DOFs of the idle model were not measured in operation: what happens there follows from the others alone")
    return tuple(notes)
