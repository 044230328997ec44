"""Sections on the diagnosis: the answer with the error by step, then where the idle model fails, what acts there, the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from operando.compare import clear_lines, error_map, level_error_db, rms_over
from operando.plots.location import marks
from operando.report import derive, derive_diagnosis, figures_compare, figures_diagnosis, figures_frf, figures_records
from operando.report.assessment import joint_grade, route_words
from operando.report.parts import Numbering
from operando.report.svg import Drawing
from operando.report.text import decibel, finite, listing, number
from operando.report.words_diagnosis import (
    DiagnosisWords,
    EffectWords,
    diagnosis_words,
    effect_key,
    effect_words,
    found_by_itself,
    found_intro,
    kind_words,
    plain_powers,
)
from operando.results import CheckRun, Results

SHOWN_CANDIDATES = 8
"""Candidates shown before the table is folded."""

APART_DB = 0.5
"""Difference of the two routes up to which they are said to agree."""


def answer(results: Results, page: Numbering) -> dict[str, Any]:
    """The answer of the diagnosis first: verdict, effect with size and place, and the error by step."""
    words = diagnosis_words(results.diagnosis or {})
    drawn = figures_diagnosis.steps_figure(words.ladder, words.verdict, words.grade) if words.ladder.rows else None
    grade, route = joint_grade(results, words.grade), route_words(results)
    return {
        "said": words,
        "intro": found_intro(words),
        "grade": grade,
        "route": route,
        "drawn": drawn,
        "location": _location(results),
        "kind_words": kind_words,
    }


def _location(results: Results) -> Drawing | None:
    """The machine with the effects marked; None where no effect has a location on the geometry."""
    geometry, found = results.geometry, results.diagnosis or {}
    if geometry is None or not any(marks(found.get(key) or (), geometry) for key in ("effects", "ambiguous_with")):
        return None
    return figures_diagnosis.location_figure(found, geometry)


def diagnosis(results: Results, page: Numbering) -> dict[str, Any]:
    """Where the idle model fails, the picture at the place found, FRFs before and after, candidates, and the two routes."""
    found = results.diagnosis
    if not found:
        return {"found": None}
    words = diagnosis_words(found)
    model = page.once("effect model", lambda: derive_diagnosis.effect_model(results))
    return {
        "found": found, "said": words, "kind_words": kind_words, "where": _where(results, page, words, model),
        "records": _records(found), "picture": _picture(found), "frfs": _before_after(results, page, words, model),
        "candidates": candidate_words(found), "shown": SHOWN_CANDIDATES,
        "alike": [effect_words(e) for e in found.get("ambiguous_with") or []],
        "routes": _routes(results, words, model), "apart": APART_DB,
    }  # fmt: skip


def _validation(results: Results, page: Numbering, model: Any) -> tuple[CheckRun | None, Any, Any]:
    """The validation measurement of the comparison, and idle model and model with effects on its lines and pairs."""
    run, _, idle = derive.validation(results, page)
    if run is None:
        return None, None, None
    return run, idle, page.once("effect on check", lambda: derive.model_frf(model, run.frf))


def _where(results: Results, page: Numbering, words: DiagnosisWords, model: Any) -> dict[str, Any] | None:
    """Maps of the error with the worst cell, or the chi-square by mode where there is no check; None where there is neither."""
    band = derive.analysis_band(results)
    run, idle, after = _validation(results, page, model)
    if run is None or idle is None or band is None:
        return _by_mode(results)
    edges = derive.band_edges(band)
    # Of effects that depend on the level the FRFs are equivalents at one level: they say nothing of what the records show.
    shown = after is not None and words.effects and not words.on_records
    models = [("Idle model", idle)] + ([("With the effects", after)] if shown else [])
    if words.ladder.by_phase:  # levels would show nothing
        maps = [(t, derive_diagnosis.relative_by_dof_band(np.abs(m.data - run.frf.data) ** 2, run.frf, edges)) for t, m in models]
        noise = None if run.frf.variance is None else derive_diagnosis.relative_by_dof_band(run.frf.variance, run.frf, edges)
        measure, value = "Relative error of the complex FRF [%]", lambda v: f"{number(v, 3)} %"
    else:
        maps = [(t, error_map(m, run.frf, edges)) for t, m in models]
        noise = derive_diagnosis.noise_by_dof_band(run.frf, edges)
        measure, value = "Level error, rms [dB]", decibel
    maps += [] if noise is None else [("Noise floor", noise)]
    worst = np.where(np.isfinite(maps[0][1]), maps[0][1], -1.0)
    i, j = (int(v) for v in np.unravel_index(int(np.argmax(worst)), worst.shape))
    most = (run.frf.responses[i], edges[j], edges[j + 1], value(worst[i, j]), value(maps[1][1][i, j]) if len(models) > 1 else "")
    return {
        "most": most if worst[i, j] > 0 else None, "noise": noise is not None, "measure": measure.partition(" [")[0].replace(", rms", ""),
        "drawn": figures_compare.error_maps(maps, [str(d) for d in run.frf.responses], edges, measure),
    }  # fmt: skip


def _by_mode(results: Results) -> dict[str, Any] | None:
    found = results.diagnosis or {}
    rows = [r for r in (found.get("where") or {}).get("by_mode") or [] if finite(r.get("frequency_hz"))]
    rows = [r for r in rows if finite(r.get("idle_misfit")) or finite(r.get("misfit"))]
    if not rows:
        return None
    value = lambda r, key: float(r[key]) if finite(r.get(key)) else np.nan  # noqa: E731
    idle = [value(r, "idle_misfit" if "idle_misfit" in r else "misfit") for r in rows]
    after = [value(r, "misfit") for r in rows] if "idle_misfit" in rows[0] and found.get("effects") else None
    k = int(np.nanargmax(idle))
    drawn = figures_diagnosis.mode_errors([r["frequency_hz"] for r in rows], idle, after)
    return {"by_mode": (rows[k]["frequency_hz"], idle[k], None if after is None else after[k]), "drawn": drawn}


HOW_TO_READ = {
    "spring": "the real part is flat and positive (negative where the spring is missing), the imaginary part zero",
    "damper": "the imaginary part grows in proportion to frequency, the real part is zero",
    "hysteretic spring": "both parts are flat: the imaginary one is the loss",
    "rubber": "both parts rise slowly with frequency",
    "mass": "the real part falls as the square of frequency (rises where mass is missing), the imaginary part is zero",
    "tuned absorber": "a resonance: the real part swings through zero and the imaginary part peaks at the absorber's own frequency",
}
"""End of a kind's name → what its dynamic stiffness looks like."""


def _picture(found: Mapping[str, Any]) -> dict[str, Any]:
    """Dynamic stiffness at the places found, and places ranked."""
    picture = found.get("picture") or {}
    out: dict[str, Any] = {"stiffness": None, "places": None}
    shown = [p for p in picture.get("dynamic_stiffness") or [] if p.get("frequency_hz") and p.get("real")][:3]
    if shown:
        effects = [_at_place(p, found, k) for k, p in enumerate(shown)]
        titles = [_title(p, e) for p, e in zip(shown, effects, strict=True)]
        names = dict.fromkeys(e.name for e in effects if e is not None)
        out["how"] = [f"{name}: {text}" for name in names for end, text in HOW_TO_READ.items() if name.endswith(end)][:3]
        out["stiffness"] = figures_diagnosis.stiffness_figure(shown, titles)
    places = [p for p in picture.get("places") or [] if p.get("location") and finite(p.get("remains"))]
    if places:
        here = [frozenset(map(str, e.get("location") or ())) for e in found.get("effects") or []]
        out |= {
            "places": figures_diagnosis.places_figure(places, here), "best": " and ".join(map(str, places[0]["location"])),
            "top": 100 * (1 - float(places[0]["remains"])), "green": any(frozenset(map(str, p["location"])) in here for p in places[:10]),
            "whole": bool(here) and not any(e.get("location") or e.get("position") for e in found_by_itself(found)),
        }  # fmt: skip
    return out


def _records(found: Mapping[str, Any]) -> dict[str, Any]:
    """What records with measured force speak for: restoring force and equivalents at each place, FRFs at levels, simulation."""
    picture, simulation, detection = found.get("picture") or {}, found.get("simulation") or {}, found.get("detection") or {}
    forces = []
    for p in picture.get("restoring_force") or []:
        named = _same(p, found_by_itself(found))
        effect = None if named is None else effect_words(named)
        title = " and ".join(map(str, p.get("location") or [])) + ("" if effect is None else f": {effect.name} {effect.size}")
        equivalents = (_same(p, found.get("effects") or []) or {}).get("equivalents") or []
        levels = figures_records.level_figure(equivalents, title) if len(equivalents) > 1 else None
        forces.append((p, figures_records.force_figure(p, title), levels))
    simulated = (simulation.get("figure") or {}).get("time_s") and finite(simulation.get("gain_db"))
    frfs = picture.get("levels") or {}
    coherence, levels_n = detection.get("coherence") or [], detection.get("levels_n") or []
    return {
        "forces": forces, "frfs": figures_records.frf_figure(frfs) if frfs.get("curves") else None, "simulation": simulation,
        "simulated": figures_records.simulation_figure(simulation["figure"]) if simulated else None,
        "inhomogeneity": detection.get("inhomogeneity"), "coherence": coherence if levels_n and len(levels_n) == len(coherence) else [],
        "levels": levels_n,
    }  # fmt: skip


def _same(picture: Mapping[str, Any], effects: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The effect that a picture of a restoring force belongs to."""
    here = list(map(str, picture.get("location") or ()))
    same = (e for e in effects if e.get("kind") == picture.get("kind") and list(map(str, e.get("location") or ())) == here)
    return next(same, None)


def _title(picture: Mapping[str, Any], effect: EffectWords | None) -> str:
    place = listing(picture.get("location") or []) or (effect.place if effect is not None else "") or "the location found"
    return place if effect is None else f"{place}: {effect.name}{' (taken away)' if effect.removed else ''} {effect.size}"


def _at_place(picture: Mapping[str, Any], found: Mapping[str, Any], k: int) -> EffectWords | None:
    """The accepted effect a picture belongs to: the one named in it, else the k-th with this place."""
    here = list(map(str, picture.get("location") or ()))
    same = [e for e in found_by_itself(found) if list(map(str, e.get("location") or ())) == here]
    if picture.get("kind"):
        same = [e for e in same if e.get("kind") == picture["kind"]] or same
    earlier = sum(list(map(str, p.get("location") or ())) == here for p in (found.get("picture") or {})["dynamic_stiffness"][:k])
    return effect_words(same[min(earlier, len(same) - 1)]) if same else None


def _before_after(results: Results, page: Numbering, words: DiagnosisWords, model: Any) -> dict[str, Any]:
    """FRFs before and after at telling pairs with the hold-out lines, or the sentence why there are none."""
    run, idle, after = _validation(results, page, model)
    if run is None:
        return {"why": "There is no validation measurement to draw FRFs before and after against."}
    if idle is None:
        return {"why": "The idle model has no scale."}
    if not words.effects:
        return {"why": "There is no effect in the model: before and after are the same."}
    if after is None:
        return {
            "why": "The model with the effects has no FRFs: an effect depends on the level, or what it is made of is not in the results."
        }
    band = derive.analysis_band(results)
    clear = clear_lines(run.frf, band)
    error = rms_over(level_error_db(idle, run.frf), clear, axis=2)
    places = [str(d) for e in (results.diagnosis or {}).get("effects") or [] for d in e.get("location") or ()]
    pairs = derive_diagnosis.telling_pairs(run.frf, error, places)
    ranges, everything = derive_diagnosis.hold_out_ranges(results, run)
    banded = derive.with_variance(model, after, pairs)
    return {
        "why": "", "drawn": figures_frf.ofrf_pairs(run.frf, banded, idle, pairs, band, "idle model + effects", ranges), "ranges": ranges,
        "everything": everything, "banded": banded.variance is not None,
        "errors": [rms_over(level_error_db(m, run.frf), clear) for m in (idle, after)],
    }  # fmt: skip


def candidate_words(found: Mapping[str, Any]) -> list[tuple[EffectWords, Any, str, tuple[str, str] | None]]:
    """Each candidate in words with its chi-square, the evidence, and a tag where something became of it."""
    accepted = {effect_key(e) for e in found_by_itself(found)}
    added = {effect_key(e) for e in found.get("effects") or []} - accepted
    rivals = {effect_key(e) for e in found.get("ambiguous_with") or []}
    tags = ((accepted, ("accepted", "good")), (rivals, ("not distinguished", "fair")), (added, ("added by hand", "none")))
    rows = []
    for c in found.get("candidates") or []:
        evidence = plain_powers(str(c.get("evidence") or "")).replace(" (-", " (−")
        tag = next((tag for keys, tag in tags if effect_key(c) in keys), None)
        rows.append((effect_words(c), c.get("selection_misfit"), evidence, tag))
    return rows


def _routes(results: Results, words: DiagnosisWords, model: Any) -> dict[str, Any] | None:
    """How far the two routes lie apart, and from the check; None where there is one."""
    two = derive_diagnosis.routes(results, model)
    if two is None or not finite(two.total_db):
        return None
    against = None
    if two.hybrid_db is not None and two.effect_db is not None:
        against = [float(np.sqrt(np.nanmean(v**2))) for v in (two.hybrid_db, two.effect_db)]
    names = [f"from {r}: {decibel(v)} rms" for r, v in zip(two.references, two.rms_db, strict=True)]
    return {
        "two": two, "against": against if against and all(map(finite, against)) else None,
        "drawn": figures_diagnosis.routes_figure(two.frequencies_hz, two.difference_db, names),
        "one_way": any(e.name in ("gyroscopic", "circulatory") for e in words.effects),
        "by_reference": listing((f"from {r} {decibel(v)}" for r, v in zip(two.references, two.rms_db, strict=True)), 4),
    }  # fmt: skip
