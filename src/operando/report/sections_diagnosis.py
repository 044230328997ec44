"""Sections on the diagnosis: the answer with the ladder, then where the idle model fails, what is found there, and the evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from operando.report import derive, derive_diagnosis, figures_compare, figures_diagnosis, figures_frf, tables
from operando.report.assessment import joint_grade, route_words
from operando.report.parts import Numbering, left_out, missing, paragraph
from operando.report.sections_records import restoring_forces
from operando.report.text import decibel, esc, finite, fixed, listing, number
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


def answer(results: Results, numbering: Numbering) -> str:
    """The answer of the diagnosis first: verdict, effect with size and place, and the ladder of the error."""
    words = diagnosis_words(results.diagnosis or {})
    badge = tables.tag(kind_words(words.verdict), words.grade)
    body = _found(words) + "".join(paragraph(s) for s in (*words.sentences, route_words(results)) if s)
    out = [f'<div class="answer {joint_grade(results, words.grade)}"><h2>{esc(words.title)} {badge}</h2>{body}</div>']
    if words.ladder.rungs:
        svg = figures_diagnosis.ladder_figure(words.ladder, words.verdict, words.grade)
        out.append(numbering.figure(svg, esc(_ladder_caption(words))))
    else:
        out.append(missing("The diagnosis holds no ladder of the error."))
    out += [paragraph(s) for s in words.decide]
    out.append('<p><a href="#diagnosis">The evidence: where the idle model fails, what was looked at, FRFs before and after.</a></p>')
    return "".join(out)


def _found(words: DiagnosisWords) -> str:
    intro = found_intro(words)
    if len(words.found) == 1:
        return f"<p>{esc(intro)} <b>{esc(words.found[0])}</b></p>"
    items = "".join(f"<li><b>{esc(s)}</b></li>" for s in words.found)
    return (f"<p>{esc(intro)}</p>" if intro else "") + (f"<ul>{items}</ul>" if items else "")


def _ladder_caption(words: DiagnosisWords) -> str:
    ladder = words.ladder
    what = "rms level error" if ladder.decibel else "misfit (mean squared error over its variance, noise is 1)"
    on = "operating frequencies, damping ratios and shapes" if words.output_only else "lines of the check"
    text = f"The ladder: {what} on {on} {'that nothing was fitted to' if ladder.held_out else 'all together'}, step by step."
    if ladder.held_out:
        text += " Open circles: on all of them, fitted ones included."
    if ladder.floor is not None:
        text += " The dashed line is what noise and the model's own uncertainty explain: no model can do better."
    return text + (" ± is the 95 % interval." if any("±" in e.size for e in words.effects) else "")


def diagnosis(results: Results, numbering: Numbering) -> str:
    """Where the idle model fails, the picture at the place found, FRFs before and after, candidates, and the two routes."""
    found = results.diagnosis
    if not found:
        return missing(left_out(results, "diagnose", "No diagnosis was made"))
    words = diagnosis_words(found)
    model = derive_diagnosis.effect_model(results)
    parts = [
        paragraph(f"Verdict: {kind_words(found.get('verdict') or 'none')}. {words.title}."),
        "<h3>Where the idle model fails</h3>",
        _where(results, numbering, words, model),
        "<h3>What acts there</h3>",
        _picture(found, numbering, words),
        "<h3>Before and after</h3>",
        _before_after(results, numbering, words, model),
        "<h3>What was looked at</h3>",
        _candidates(found, words),
        "<h3>Two routes to the operating FRFs</h3>",
        _routes(results, numbering, words, model),
    ]
    if found.get("notes"):
        notes = "".join(f"<li>{esc(n)}</li>" for n in found["notes"])
        parts.append(f"<h3>How it was judged</h3><ul>{notes}</ul>")
    return "".join(parts)


def _judge(results: Results, numbering: Numbering, model: Any) -> tuple[CheckRun | None, Any, Any]:
    """The check run that judges, and idle model and model with effects on its lines and pairs."""
    run = derive.judge_run(results)
    if run is None:
        return None, None, None
    idle = numbering.once("idle on check", lambda: derive.model_frf(derive.scaled_idle(results), run.frf))
    return run, idle, numbering.once("effect on check", lambda: derive_diagnosis.predicted(model, run.frf))


def _where(results: Results, numbering: Numbering, words: DiagnosisWords, model: Any) -> str:
    band = derive.analysis_band(results)
    run, idle, after = _judge(results, numbering, model)
    if run is None or idle is None or band is None:
        return _by_mode(results, numbering)
    edges = derive.band_edges(band)
    # Of effects that depend on the level the FRFs are equivalents at one level: they say nothing of what the records show.
    shown = after is not None and words.effects and not words.on_records
    models = [("Idle model", idle)] + ([("With the effects", after)] if shown else [])
    if words.ladder.by_phase:  # levels would show nothing
        maps = [(t, derive_diagnosis.relative_by_dof_band(np.abs(m.data - run.frf.data) ** 2, run.frf, edges)) for t, m in models]
        noise = None if run.frf.variance is None else derive_diagnosis.relative_by_dof_band(run.frf.variance, run.frf, edges)
        measure, value = "Relative error of the complex FRF [%]", lambda v: f"{number(v, 3)} %"
    else:
        maps = [(t, derive.error_by_dof_band(m, run.frf, edges)) for t, m in models]
        noise = derive_diagnosis.noise_by_dof_band(run.frf, edges)
        measure, value = "Level error, rms [dB]", decibel
    if noise is not None:
        maps.append(("Noise floor", noise))
    worst = np.where(np.isfinite(maps[0][1]), maps[0][1], -1.0)
    i, j = (int(v) for v in np.unravel_index(int(np.argmax(worst)), worst.shape))
    text = ""
    if worst[i, j] > 0:
        where = f"{run.frf.responses[i]} in {number(edges[j], 3)} to {number(edges[j + 1], 3)} Hz"
        then = f", with the effects {value(maps[1][1][i, j])}" if len(models) > 1 else ""
        text = paragraph(f"The idle model fails most at {where}: {value(worst[i, j])}{then}.")
    svg = figures_compare.error_maps(maps, [str(d) for d in run.frf.responses], edges, measure)
    caption = (
        f"{measure[: measure.index(' [')].replace(', rms', '')} against the check by response DOF and frequency band, over all references"
    )
    caption += "; the last map is what the noise of the check alone makes" if noise is not None else ""
    return text + numbering.figure(svg, caption + "; a dash where no line stands clear of the noise.")


def _by_mode(results: Results, numbering: Numbering) -> str:
    rows = [r for r in ((results.diagnosis or {}).get("where") or {}).get("by_mode") or [] if finite(r.get("frequency_hz"))]
    rows = [r for r in rows if finite(r.get("idle_misfit")) or finite(r.get("misfit"))]
    if not rows:
        return missing("There is no check measurement, and no misfit by mode, to say where the idle model fails.")
    value = lambda r, key: float(r[key]) if finite(r.get(key)) else np.nan  # noqa: E731
    idle = [value(r, "idle_misfit" if "idle_misfit" in r else "misfit") for r in rows]
    after = [value(r, "misfit") for r in rows] if "idle_misfit" in rows[0] and (results.diagnosis or {}).get("effects") else None
    k = int(np.nanargmax(idle))
    after_text = "." if after is None else f", with the effects {number(after[k], 3)}."
    text = paragraph(
        "There is no check measurement: operating modes alone are judged. The idle model fails most at "
        f"{number(rows[k]['frequency_hz'], 4)} Hz: misfit {number(idle[k], 3)}{after_text}"
    )
    svg = figures_diagnosis.mode_misfit([r["frequency_hz"] for r in rows], idle, after)
    return text + numbering.figure(
        svg, "Misfit of each operating mode (frequency, damping ratio and shape over their standard deviations)."
    )


HOW_TO_READ = {
    "spring": "the real part is flat and positive (negative where the spring is missing), the imaginary part zero",
    "damper": "the imaginary part grows in proportion to frequency, the real part is zero",
    "hysteretic spring": "both parts are flat: the imaginary one is the loss",
    "rubber": "both parts rise slowly with frequency",
    "mass": "the real part falls as the square of frequency (rises where mass is missing), the imaginary part is zero",
    "tuned absorber": "a resonance: the real part swings through zero and the imaginary part peaks at the absorber's own frequency",
}
"""End of a kind's name → what its dynamic stiffness looks like."""


def _picture(found: Mapping[str, Any], numbering: Numbering, words: DiagnosisWords) -> str:
    picture = found.get("picture") or {}
    out = []
    if picture.get("restoring_force"):
        out.append(restoring_forces(found, numbering))
    shown = [p for p in picture.get("dynamic_stiffness") or [] if p.get("frequency_hz") and p.get("real")][:3]
    if shown:
        effects = [_at_place(p, found, k) for k, p in enumerate(shown)]
        titles = [_title(p, e) for p, e in zip(shown, effects, strict=True)]
        laws = dict.fromkeys(e.name for e in effects if e is not None)
        said = [f"{name}: {text}" for name in laws for end, text in HOW_TO_READ.items() if name.endswith(end)][:3]
        how = "How to read it: a spring is flat, a mass goes with −ω², a damper with iω, an absorber resonates. "
        how += f"Here – {'; '.join(said)}." if said else ""
        caption = (
            "Dynamic stiffness δz(ω) = force over displacement that the check asks for at the place found, without asking for its kind"
        )
        caption += ", and the law fitted. " + how
        out.append(numbering.figure(figures_diagnosis.stiffness_figure(shown, titles), esc(caption)))
    elif out:
        pass
    elif words.output_only:
        out.append(missing("Operating modes alone give no dynamic stiffness δz(ω): it takes a check measurement with a known force."))
    elif words.effects:
        out.append(missing("The effects found have no dynamic stiffness δz(ω) at one place to show (a channel, a rotor, or the whole)."))
    else:
        out.append(missing("No effect was found whose dynamic stiffness δz(ω) could be shown."))
    places = [p for p in picture.get("places") or [] if p.get("location") and finite(p.get("remains"))]
    if places:
        here = [frozenset(map(str, e.get("location") or ())) for e in found.get("effects") or []]
        best, top = " and ".join(map(str, places[0]["location"])), 100 * (1 - float(places[0]["remains"]))
        caption = f"Places ranked without asking for a kind: one free force at {best} explains {fixed(top, 1)} % of the idle model's error."
        caption += " Green: where the effects found act." if any(frozenset(map(str, p["location"])) in here for p in places[:10]) else ""
        if here and not any(e.get("location") or e.get("position") for e in found_by_itself(found)):
            caption += " No single place does: what was found acts on the whole."
        out.append(numbering.figure(figures_diagnosis.places_figure(places, here), esc(caption)))
    return "".join(out)


def _title(picture: Mapping[str, Any], effect: EffectWords | None) -> str:
    place = listing(picture.get("location") or []) or (effect.place if effect is not None else "") or "the place found"
    return place if effect is None else f"{place}: {effect.name}{' (taken away)' if effect.removed else ''} {effect.size}"


def _at_place(picture: Mapping[str, Any], found: Mapping[str, Any], k: int) -> EffectWords | None:
    """The accepted effect a picture belongs to: the one named in it, else the k-th with this place."""
    here = list(map(str, picture.get("location") or ()))
    same = [e for e in found_by_itself(found) if list(map(str, e.get("location") or ())) == here]
    if picture.get("kind"):
        same = [e for e in same if e.get("kind") == picture["kind"]] or same
    earlier = sum(list(map(str, p.get("location") or ())) == here for p in (found.get("picture") or {})["dynamic_stiffness"][:k])
    return effect_words(same[min(earlier, len(same) - 1)]) if same else None


def _before_after(results: Results, numbering: Numbering, words: DiagnosisWords, model: Any) -> str:
    run, idle, after = _judge(results, numbering, model)
    if run is None:
        return missing("There is no check measurement to draw FRFs before and after against.")
    if idle is None or not words.effects:
        return missing(
            "There is no effect in the model: before and after are the same." if idle is not None else "The idle model has no scale."
        )
    if after is None:
        return missing("The model with the effects has no FRFs: an effect depends on the level, or the results lack what it is made of.")
    band = derive.analysis_band(results)
    error = derive.rms_over(derive.level_error_db(idle, run.frf), derive.clear_lines(run.frf, band), axis=2)
    places = [str(d) for e in (results.diagnosis or {}).get("effects") or [] for d in e.get("location") or ()]
    pairs = derive_diagnosis.telling_pairs(run.frf, error, places)
    ranges, everything = derive_diagnosis.held_out_ranges(results, run)
    banded = derive.with_variance(model, after, pairs)
    svg = figures_frf.ofrf_pairs(run.frf, banded, idle, pairs, band, "idle model + effects", ranges)
    caption = "FRFs before (idle model) and after (with the effects) against the check. "
    caption += "Shaded ranges judged: nothing was fitted to them. " if ranges else ""
    caption += "Nothing was fitted to any line of this run. " if everything else ""
    caption += "The band is 95 % from the covariance of idle model and effects." if banded.variance is not None else ""
    clear = derive.clear_lines(run.frf, band)
    pair = [derive.rms_over(derive.level_error_db(m, run.frf), clear) for m in (idle, after)]
    text = ""
    if words.ladder.by_phase:
        text = paragraph("A fault of phase does not show in these magnitudes; the relative errors above show it.")
    elif all(finite(e) for e in pair):
        over = "Over all lines in band and all pairs of this check"
        text = paragraph(f"{over} the idle model is off by {decibel(pair[0])}, with the effects by {decibel(pair[1])}.")
    return text + numbering.figure(svg, esc(caption))


def _candidates(found: Mapping[str, Any], words: DiagnosisWords) -> str:
    rows = found.get("candidates") or []
    accepted = {effect_key(e) for e in found_by_itself(found)}
    added = {effect_key(e) for e in found.get("effects") or []} - accepted
    alike = found.get("ambiguous_with") or []
    rivals = {effect_key(e) for e in alike}
    cells, by_hand = [], tables.tag("added by hand", "none")
    for n, c in enumerate(rows, start=1):
        e, key = effect_words(c), effect_key(c)
        state = (
            tables.tag("accepted", "good")
            if key in accepted
            else tables.tag("not told apart", "fair")
            if key in rivals
            else by_hand
            if key in added
            else ""
        )
        evidence = plain_powers(str(c.get("evidence") or "")).replace(" (-", " (−")
        removed = " (taken away)" if e.removed else ""
        cells.append(
            [str(n), esc(e.name + removed), esc(e.place or "–"), esc(e.size), number(c.get("selection_misfit"), 4), esc(evidence), state]
        )
    head = ["", "Effect", "Place", "Size (± 95 %)", "Misfit<br>[1 = noise]", "Evidence", ""]
    out = []
    if cells:
        caption = "<b>Candidates</b> of the first step, best first, each by itself; judged on data it was not fitted to."
        out.append(tables.table(head, cells[:SHOWN_CANDIDATES], numeric=(0, 4), caption=caption, wide=True))
        if len(cells) > SHOWN_CANDIDATES:
            rest = tables.table(head, cells[SHOWN_CANDIDATES:], numeric=(0, 4), wide=True)
            out.append(f"<details><summary>{len(cells) - SHOWN_CANDIDATES} more candidates</summary>{rest}</details>")
    else:
        out.append(missing("No candidates were kept."))
    if alike:
        items = "".join(f"<li>{esc(effect_words(e).sentence)}.</li>" for e in alike)
        opened = " open" if len(alike) <= 4 else ""
        what = "Could not be told apart from" if words.effects else "Not excluded"
        out.append(f"<details{opened}><summary>{what} ({len(alike)})</summary><ul>{items}</ul></details>")
    elif words.effects and words.verdict == "explained":
        out.append(paragraph("No other candidate does as well within what the data can tell."))
    proposed = [s for s in words.decide if s.startswith("What would decide")]
    out += [paragraph(s) for s in proposed]
    if words.effects:
        tests = [[esc(e.label), esc(e.size), esc(e.confirm)] for e in words.effects]
        out.append(tables.table(["Effect in the model", "Size (± 95 %)", "How to confirm it"], tests, wide=True))
    return "".join(out)


def _routes(results: Results, numbering: Numbering, words: DiagnosisWords, model: Any) -> str:
    two = derive_diagnosis.routes(results, model)
    if two is None or not finite(two.total_db):
        return missing(left_out(results, "ofrf", "Only one route to the operating FRFs is there, so nothing checks it"))
    second = "idle model with the effects" if words.effects else "idle model as it is (nothing was added)"
    text = f"Two routes lead to the operating FRFs: the hybrid one (idle shapes, operating poles) and the {second}. "
    text += f"They differ by {decibel(two.total_db)} rms ({_by_reference(two.references, two.rms_db)}). "
    if two.total_db <= APART_DB:
        text += "Each confirms the other."
    else:
        text += f"At least one of them is off by half of that, {decibel(two.total_db / 2)}, or more."
    if two.hybrid_db is not None and two.effect_db is not None:
        hybrid, effect = (float(np.sqrt(np.nanmean(v**2))) for v in (two.hybrid_db, two.effect_db))
        if finite(hybrid) and finite(effect):
            nearer = "the second route is nearer" if effect < hybrid else "the hybrid route is nearer"
            text += f" Against the check the hybrid route is off by {decibel(hybrid)}, the second by {decibel(effect)}: {nearer}."
    if any(e.name in ("gyroscopic", "circulatory") for e in words.effects):
        text += " The hybrid route is symmetric by construction and cannot hold the effect found; trust the second."
    names = [f"from {r}: {decibel(v)} rms" for r, v in zip(two.references, two.rms_db, strict=True)]
    svg = figures_diagnosis.routes_figure(two.frequencies_hz, two.difference_db, names)
    caption = "Level difference of the two routes, rms over the responses, for each reference."
    rows = []
    if two.hybrid_db is not None and two.effect_db is not None:
        for k, r in enumerate(two.references):
            rows.append([esc(r), fixed(two.rms_db[k], 2), fixed(two.hybrid_db[k], 2), fixed(two.effect_db[k], 2)])
    head = ["Reference", "Difference of the<br>routes [dB]", "Hybrid against<br>check [dB]", "Idle + effects<br>against check [dB]"]
    return paragraph(text) + numbering.figure(svg, caption) + (tables.table(head, rows, numeric=(1, 2, 3)) if rows else "")


def _by_reference(references: Sequence[str], values: Any) -> str:
    return listing((f"from {r} {decibel(v)}" for r, v in zip(references, values, strict=True)), 4)
