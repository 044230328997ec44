"""Sections on the answer: the headline, and the operating FRFs against the check and the idle model."""

from __future__ import annotations

from typing import Any

import numpy as np

from operando.data import Frf
from operando.report import derive, figures_compare, figures_frf, tables
from operando.report.assessment import MODEL_NAMES, assumptions, frequency_shifts, headline
from operando.report.parts import Numbering, left_out, missing, paragraph
from operando.report.text import decibel, esc, finite, fixed, number, short_names
from operando.results import CheckRun, Results


def answer(results: Results, numbering: Numbering) -> str:
    """The answer first: verdict, numbers, the best picture, the mode table, the assumptions."""
    head = headline(results)
    body = "".join(paragraph(s) for s in head.sentences)
    if head.limits:
        body += "<p><b>What does not hold:</b></p><ul>" + "".join(f"<li>{esc(t)}</li>" for t in head.limits) + "</ul>"
    tiles = _tiles(results)
    out = [f'<div class="answer {head.grade}"><h2>{esc(head.verdict)}</h2>{body}{tiles}</div>']
    models = derive.comparison_models(results)
    keys = [k for k in MODEL_NAMES if k in models and finite(models[k].get("error_db"))]
    if "ofrf" in keys:
        floor: Any = models["ofrf"].get("noise_floor_db")
        svg = figures_compare.error_bars(
            [MODEL_NAMES[k] for k in keys], keys, [float(models[k]["error_db"]) for k in keys], float(floor) if finite(floor) else None
        )
        caption = "Level error of each model against the check measurement. The dashed line is what measurement noise and the model's own "
        caption += "uncertainty explain."
        out.append(numbering.figure(svg, caption))
    run, hybrid_frf, rest = _judged(results, numbering)
    if run is not None and hybrid_frf is not None:
        pairs = derive.choose_pairs(run.frf, _pair_error(hybrid_frf, run.frf, results), 1, 0)[:1]
        svg = figures_frf.ofrf_pairs(
            run.frf, derive.with_variance(results.hybrid, hybrid_frf, pairs), rest, pairs, derive.analysis_band(results)
        )
        caption = 'One operating FRF with its 95 % band, the check that judges it, and the idle model (<a href="#ofrf">more pairs</a>).'
        out.append(numbering.figure(svg, caption))
    if results.idle is not None or results.operating is not None:
        out.append(tables.mode_table(results))
    else:
        out.append(missing("No modes were identified."))
    out.append(tables.assumption_table(assumptions(results)))
    return "".join(out)


def _judged(results: Results, numbering: Numbering) -> tuple[CheckRun | None, Frf | None, Frf | None]:
    """The check that judges, the operating FRFs and the idle model on its lines and pairs."""

    def make() -> tuple[CheckRun | None, Frf | None, Frf | None]:
        run = derive.judge_run(results)
        if run is None:
            return None, None, None
        return run, derive.model_frf(results.hybrid, run.frf), derive.model_frf(derive.scaled_idle(results), run.frf)

    kept: tuple[CheckRun | None, Frf | None, Frf | None] = numbering.once("judged", make)
    return kept


def _pair_error(model: Frf, measured_frf: Frf, results: Results) -> Any:
    mask = derive.clear_lines(measured_frf, derive.analysis_band(results))
    return derive.rms_over(derive.level_error_db(model, measured_frf), mask, axis=2)


def _tiles(results: Results) -> str:
    models = derive.comparison_models(results)
    tiles: list[tuple[str, str, bool]] = []
    if finite((models.get("ofrf") or {}).get("error_db")):
        tiles.append((decibel(models["ofrf"]["error_db"]), "operating FRFs against the check", True))
    for key in ("effect", "idle", "idle_shapes", "msf_all"):
        if finite((models.get(key) or {}).get("error_db")):
            tiles.append((decibel(models[key]["error_db"]), MODEL_NAMES[key], False))
    if finite((models.get("ofrf") or {}).get("noise_floor_db")):
        tiles.append((decibel(models["ofrf"]["noise_floor_db"]), "noise floor", False))
    if not tiles:
        if results.idle is not None:
            tiles.append((str(results.idle.n_modes), "idle modes", False))
            if finite(results.idle.misfit):
                tiles.append((number(results.idle.misfit, 3), "misfit of the idle model (1 = noise)", False))
        if results.operating is not None:
            tiles.append((str(results.operating.n_modes), "operating modes", False))
        shifts = frequency_shifts(results)
        if shifts:
            worst = max(shifts, key=lambda s: abs(s["percent"]))
            tiles.append(
                (fixed(worst["percent"], 2, sign=True) + " %", f"greatest frequency change, at {number(worst['idle_hz'], 4)} Hz", False)
            )
    if not tiles:
        return ""
    cells = (f'<div class="tile{" main" if main else ""}"><b>{value}</b><span>{esc(text)}</span></div>' for value, text, main in tiles)
    return '<div class="tiles">' + "".join(cells) + "</div>"


def ofrf(results: Results, numbering: Numbering) -> str:
    """Operating FRFs with band, check and idle model; errors by DOF, band, mode and run."""
    if results.hybrid is None:
        return missing(left_out(results, "ofrf", "There are no operating FRFs"))
    band, models = derive.analysis_band(results), derive.comparison_models(results)
    run, model, rest = _judged(results, numbering)
    out = []
    if run is None:
        out.append(
            missing("There is no check measurement (running, force measured), so the operating FRFs stand beside the idle model only.")
        )
        out.append(_unchecked(results, numbering))
        return "".join(out)
    out.append(tables.comparison_table(models) if models else missing(left_out(results, "compare", "The comparison was not made")))
    by_run = (results.comparison or {}).get("by_run") or []
    if len(by_run) > 1:
        out.append(tables.by_run_table(by_run))
    if model is None:
        out.append(missing("The operating FRFs cannot be made for the pairs of the check."))
        return "".join(out)
    pairs = derive.choose_pairs(run.frf, _pair_error(model, run.frf, results), 2, 4)
    level = f", level {esc(run.level)}" if run.level else ""
    caption = (
        f"Operating FRFs at drive points and at the worst pairs, against check run {esc(short_names(run.name))}{level} and the idle model. "
    )
    caption += "The band is 95 % from the covariances of EMA and OMA."
    out.append(
        numbering.figure(figures_frf.ofrf_pairs(run.frf, derive.with_variance(results.hybrid, model, pairs), rest, pairs, band), caption)
    )
    if band is not None:
        edges = derive.band_edges(band)
        maps = [("Operating FRFs", derive.error_by_dof_band(model, run.frf, edges))]
        if rest is not None:
            maps.append(("Idle model", derive.error_by_dof_band(rest, run.frf, edges)))
        caption = "Level error by response DOF and frequency band, over all references; a dash where no line stands clear of the noise."
        out.append(numbering.figure(figures_compare.error_maps(maps, [str(d) for d in run.frf.responses], edges), caption))
    out.append(tables.by_mode_table(models) or missing("No errors by mode were computed."))
    return "".join(out)


def _unchecked(results: Results, numbering: Numbering) -> str:
    """Operating FRFs beside the idle model where there is no check: at the idle drive points and the pairs that changed most."""
    frf = results.idle_frf
    if frf is None:
        return missing("There are no idle FRFs to show them beside.")
    model, rest = derive.model_frf(results.hybrid, frf), derive.model_frf(derive.scaled_idle(results), frf)
    if model is None or rest is None:
        return missing("The operating FRFs cannot be made for the pairs of the idle FRFs.")
    blank = Frf(np.full(frf.data.shape, np.nan), frf.axis, frf.responses, frf.references, frf.quantity, si=frf.si)
    band = derive.analysis_band(results)
    change = derive.rms_over(derive.level_error_db(model, rest), derive.clear_lines(rest, band), axis=2)
    pairs = [(i, j, why.replace("worst pair", "most changed")) for i, j, why in derive.choose_pairs(frf, change)]
    caption = "Operating FRFs with their 95 % band beside the idle model, at drive points and where they differ most."
    return numbering.figure(figures_frf.ofrf_pairs(blank, derive.with_variance(results.hybrid, model, pairs), rest, pairs, band), caption)
