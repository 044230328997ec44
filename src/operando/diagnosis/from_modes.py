"""Find the missing physics from operational modes alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from operando.compare.measures import band_edges, band_masks
from operando.data import Frf, Geometry, ModalModel
from operando.diagnosis.arguments import kinds_asked, places_asked
from operando.diagnosis.between import SAME_SET_UP, spreads_of
from operando.diagnosis.case import Case
from operando.diagnosis.corrected import effects_of, model_of
from operando.diagnosis.criteria import MOST_CHI_SQUARE
from operando.diagnosis.discrepancy import discrepancy_row
from operando.diagnosis.document import between_rows, candidate_rows, detectable_rows, ladder, odds_text, restricted
from operando.diagnosis.found import Found
from operando.diagnosis.hypotheses import Hypotheses
from operando.diagnosis.idle import Idle
from operando.diagnosis.modes_case import TOLD_BY_MODES, ModesCase
from operando.diagnosis.operating_modes import OperatingModes
from operando.diagnosis.posterior import AtRest, State, at_rest
from operando.diagnosis.result import Diagnosis
from operando.diagnosis.search import search
from operando.diagnosis.verdict import no_other_answer, verdict, with_validation
from operando.dof import Dof
from operando.errors import ConfigError, DataError
from operando.frf import with_fewer_references
from operando.structure.effects import Effect
from operando.threads import one_blas_thread

_FEW = 4  # modes from which some values can be set apart


def diagnose_modes(
    idle: ModalModel,
    operating: ModalModel,
    *,
    halves: Sequence[ModalModel] | None = None,
    idle_frf: Frf | None = None,
    geometry: Geometry | None = None,
    kinds: Sequence[str] | None = None,
    places: Sequence[Any] | None = None,
    band: tuple[float, float] | None = None,
    progress: Callable[[str], None] | None = None,
    between: Mapping[str, float] | None = None,
) -> Diagnosis:
    """Name the physical effect that turns the idle modes into the operating ones.

    The statistical model and the search of :func:`diagnose_frf`, with other observations: frequency, damping and shape of each
    operational mode under their covariance (Döhler & Mevel, Mech. Syst. Signal Process. 38, 2013, 346–366), predicted by the
    eigenproblem of the idle model with effects. A discrepancy moves poles and shapes as it would a resonance of an FRF.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass, with residual terms and covariance.
    operating : ModalModel
        Complex shapes of arbitrary scale, with covariance.
    halves : (ModalModel, ModalModel), optional
        Modes of the first and of the second half of the record (:func:`operando.oma.fit_halves`): the second is predicted from the
        first, with the effects that the whole record chose. Default: those that ``operating.details`` carries, if any.
    idle_frf : Frf, optional
        FRFs at rest: which DOFs were driven, and a better idle model where its modes are complex.
    geometry : Geometry, optional
        Sensor positions, for what counts as a neighbour.
    kinds, places : sequences, optional
        Look only for these.
    band : (float, float), optional
        Hz; default the idle model's band.
    progress : callable, optional
        Told what is being done.
    between : mapping, optional
        What may differ between the measurements at rest and in operation, as for :func:`diagnose_frf`.

    Raises
    ------
    DataError
        If the idle model has no scale, or nothing in common is measured.
    ConfigError
        If no kind asked for can be told from modes.
    """
    if idle.scaling != "unit_modal_mass":
        raise DataError("the idle shapes have no scale: no effect can be sized", hint="give units to the idle test")
    say = progress or (lambda text: None)
    idle_frf = None if idle_frf is None else with_fewer_references(idle_frf)
    with one_blas_thread():
        parts = list(getattr(operating.details, "halves", ()) if halves is None else halves)
        if band is not None:
            operating, *parts = (_within(model, band) for model in (operating, *parts))
        band = band or idle.band_hz or (0.5 * float(idle.frequencies_hz.min()), 1.1 * float(idle.frequencies_hz.max()))
        asked = told_by_modes(kinds)
        model, rest = Idle.of(idle, band, driven_dofs(idle, idle_frf)), None
        if idle_frf is not None and not (idle.misfit is not None and idle.misfit < MOST_CHI_SQUARE):
            say("idle model on the idle FRFs")
            rest = at_rest(model, idle_frf, band)
            model = rest.idle
        lines = OperatingModes(model, operating, parts)
        where = places_asked(idle, places)

        def cases(model: Idle) -> list[Case]:
            """Two days in a laboratory and one set-up, or what the test states."""
            days = ModesCase(model, lines, band, spreads_of(between or {}), asked, where)
            return [days] if between else [days, ModesCase(model, lines, band, SAME_SET_UP, asked, where, like=days)]

        both = cases(model)
        if between:
            found = search(both[0], say)
        else:
            again = cases if kinds is None and places is None else None
            found = Hypotheses(both[0], both[1], say, 0.0 if rest is None else rest.state.alpha, again).run()
        return _diagnosis(idle, with_validation(found), rest, geometry)


def told_by_modes(kinds: Sequence[str] | None) -> tuple[str, ...]:
    """Those of the kinds asked for that operational modes tell; all that they tell where no kind is asked for."""
    asked = kinds_asked(kinds)
    known = tuple(k for k in TOLD_BY_MODES if asked is None or k in asked)
    if not known:
        raise ConfigError("none of the kinds asked for shows in operational modes", hint="kinds: " + ", ".join(TOLD_BY_MODES))
    return known


def driven_dofs(idle: ModalModel, idle_frf: Frf | None) -> tuple[Dof, ...]:
    """DOFs driven at rest: as the FRFs say, or all but those to which a residual term of their own was given."""
    if idle_frf is not None:
        return idle_frf.references
    terms = idle.terms
    shapes = np.abs(np.asarray(terms.shapes)[:, np.asarray(terms.residual)])
    own = shapes[:, np.count_nonzero(shapes, axis=0) == 1]
    return tuple(d for d, row in zip(terms.dofs, own, strict=True) if not row.any())


def _within(model: ModalModel, band: tuple[float, float]) -> ModalModel:
    return model.select_modes((model.frequencies_hz >= band[0]) & (model.frequencies_hz <= band[1]))


def _diagnosis(idle: ModalModel, found: Found, rest: AtRest | None, geometry: Geometry | None) -> Diagnosis:
    """The diagnosis of a search."""
    best = found.best
    lines: OperatingModes = best.case.lines  # type: ignore[assignment]
    said = verdict(found, None if rest is None else rest.state)
    name, why, rivals = said.name, said.why, said.rivals
    if name == "ambiguous" and all(no_other_answer(best, rival, geometry) for rival in rivals):
        name, why = "explained", ""
    shown = best.terms if said.terms and name != "unexplained" else ()
    final = best if shown else found.empty
    have = {t.key for t in best.terms}
    ambiguous = tuple(e for rival in rivals for e in effects_of(rival, [t for t in rival.terms if t.key not in have]))
    return Diagnosis(
        name,
        effects_of(final) if shown else (),
        tuple({e.kind + e.place: e for e in ambiguous}.values()),
        _proposal(name, effects_of(best), ambiguous),
        tuple(row | {"error_db": None, "heldout_error_db": None} for row in ladder(final)),
        tuple(candidate_rows(found)),
        _where(final),
        None,
        ("operating_modes",),
        notes=tuple(_notes(found.best.case, lines, rest, found.odds)),
        idle=idle,
        model=model_of(idle, final, geometry),
        judged_on={"state": "operating", "measured": _validated_on(lines)},
        detectable=tuple(detectable_rows(final, said)),
        reason=why or None,
        between=tuple(between_rows(final)),
        discrepancy=discrepancy_row(best),
    )


def _where(final: State) -> dict[str, list[dict[str, Any]]]:
    """Mean squared standardised differences of the idle model as it is, by sensor, band and mode; of each mode with what was found, too.

    A sensor's is that of its part of the shapes, which are scaled to the measured ones.
    """
    case, forward = final.case, final.case.forward
    lines: OperatingModes = case.lines  # type: ignore[assignment]
    one, w = lines.sets[0], lines.w[lines.fit]
    idle, after = (forward.predict(x, w, derivatives=False).h for x in (forward.start, final.x))
    by_mode, by_sensor = [], []
    for k, f in enumerate(one.f):
        at = lines.fit[k * one.per_mode : (k + 1) * one.per_mode]
        misfit, its = (float(np.mean(2 * lines.rows((lines.h[at] - h[at])[..., None], at) ** 2)) for h in (after, idle))
        off = (idle[at] - lines.h[at])[:, 0, 0]
        frequency, damping = (100 * float(np.expm1(v)) for v in off[:2])
        errors = {"frequency_error_percent": frequency, "height_error_db": None, "damping_error_percent": damping}
        by_mode.append({"frequency_hz": float(f)} | errors | {"misfit": misfit, "idle_misfit": its})
        across, noise = one.across[k], lines.noise[np.ix_(at[2:], at[2:])]
        variance = np.sum((across @ noise) * across, axis=1)
        seen = variance > 1e-12 * variance.max(initial=0.0)  # of the sensor that alone moves a shape says nothing
        by_sensor.append(np.where(seen, (across @ off[2:]) ** 2 / np.where(seen, variance, 1), np.nan).reshape(2, -1))
    edges, left = band_edges(*case.band), np.array([row["idle_misfit"] for row in by_mode])
    by_band = [
        {"band_hz": [float(low), float(high)], "error_db": None, "misfit": _mean(left[mask])}
        for low, high, mask in zip(edges[:-1], edges[1:], band_masks(one.f, edges), strict=True)
    ]
    sensors = np.moveaxis(np.array(by_sensor).reshape(-1, 2, lines.responses.size), 2, 0)
    by_dof = [{"dof": str(case.dofs[i]), "error_db": None, "misfit": _mean(v)} for i, v in zip(lines.responses, sensors, strict=True)]
    return {"by_dof": by_dof, "by_band": by_band, "by_mode": by_mode}


def _mean(values: Any) -> float | None:
    """Of those that are there; None where there is none."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(known.mean()) if known.size else None


def _validated_on(lines: OperatingModes) -> str:
    if lines.apart:
        text = "the whole record chose the effects and gave the sizes; its second half, identified apart, was predicted from the first"
        if lines.left_out:
            text += f"; {lines.left_out} mode{'s' if lines.left_out > 1 else ''} that one half alone showed stayed out"
        return text
    if lines.sets[0].n < _FEW:
        return f"{lines.sets[0].n} operational modes are too few to set some apart: the validation values were fitted"
    return "one third of the values (of each mode its frequency, damping or shape, in turn) was predicted from the others"


def _notes(case: Case, lines: OperatingModes, rest: AtRest | None, one_set_up: float | None) -> list[str]:
    notes = [_validated_on(lines), *restricted(case, TOLD_BY_MODES)]
    if one_set_up is not None and one_set_up > 0:
        notes.append(
            f"the data say that nothing was touched between the idle and the operating measurement ({odds_text(one_set_up)}); "
            "gains, positions of sensors, temperature and damping count as the same"
        )
    if rest is not None and rest.again:
        notes.append(
            f"the idle model was fitted to the idle FRFs again, with complex modes; {100 * rest.state.alpha:.2g} % stay unexplained"
        )
    return notes


def _proposal(name: str, effects: Sequence[Effect], ambiguous: Sequence[Effect]) -> str | None:
    """Which measurement would decide."""
    one = next(iter(effects), None)
    if ambiguous:
        other = ambiguous[0]
        first, second = (_named(e) if e else "nothing" for e in (one, other))
        at = (one.place if one else "") or other.place or "two points"
        return (
            f"operational modes alone do not tell {first} from {second}: measure FRFs in operation with a force at {at}; or {other.confirm}"
        )
    if name in ("partial", "unexplained", "inconclusive"):
        return "measure FRFs in operation with a known force: they tell more than operational modes"
    return None


def _named(effect: Effect) -> str:
    return f"{effect.kind} at {effect.place}" if effect.place else effect.kind
