"""Sections on the two states: at rest (FRFs, idle model) and running (spectra, operational modes)."""

from __future__ import annotations

from typing import Any

import numpy as np

from operando.contrib import library_rows
from operando.data import Frf, ModalModel
from operando.report import derive, figures_frf, figures_stabilization, sections_setups, tables
from operando.report.parts import Numbering, left_out, missing, paragraph
from operando.report.text import band_text, count, esc, finite, listing, number
from operando.results import Results


def idle(results: Results, numbering: Numbering) -> str:
    """FRFs at rest, stabilisation, rejected poles, residual modes, misfit, reciprocity, second opinion."""
    frf, model, band = results.idle_frf, results.idle, derive.analysis_band(results)
    out = []
    if model is None:
        out.append(missing(left_out(results, "ema", "There is no idle model")))
    else:
        out.append(paragraph(_idle_text(results)))
        out.append(_fit_text(model))
        if model.scaling != "unit_modal_mass":
            text = "The shapes have no mass scaling, since units of force or acceleration are not known; give them under [units]."
            out.append(missing(text))
    if frf is None:
        out.append(missing(left_out(results, "frf", "There are no idle FRFs")))
    else:
        synthesised = _synthesised(results, frf)
        out.append("<h3>Measured and synthesised FRFs</h3>")
        caption = "All idle FRFs together (rms over pairs)."
        if synthesised is not None:
            caption += " The difference between measurement and model should lie on the noise level."
        out.append(numbering.figure(figures_frf.frf_overview(frf, synthesised, band), caption))
        error = None
        if synthesised is not None:
            error = _misfit_by_pair(synthesised, frf, results)
        pairs = derive.choose_pairs(frf, error)
        where = "at drive points" if error is None else "at drive points and where the model fits worst"
        caption = f"Idle FRFs {where}: magnitude, phase and coherence; outside the analysis band shaded."
        out.append(numbering.figure(figures_frf.frf_pairs(frf, synthesised, pairs, band), caption))
        out.append(_reciprocity_text(frf, results))
    out.append("<h3>Stabilisation diagram</h3>" + _stabilization(model, numbering, results, "idle"))
    if model is not None:
        caption = (
            "<b>Idle modes.</b> Shapes have unit modal mass."
            if model.scaling == "unit_modal_mass"
            else "<b>Idle modes.</b> Shapes are not scaled."
        )
        out.append(tables.modal_table(model, caption))
        out.append(_second_opinion(model, results))
    return "".join(out)


def _synthesised(results: Results, frf: Frf) -> Frf | None:
    """Synthesised idle FRF; the fit's own one where the shapes have no scale."""
    out = derive.model_frf(derive.scaled_idle(results), frf)
    if out is None and results.idle is not None:
        for name in ("synthesis", "synthesised", "frf"):
            kept = getattr(results.idle.details, name, None)
            if isinstance(kept, Frf) and kept.data.shape == frf.data.shape:
                return kept
    return out


def _misfit_by_pair(model: Frf, frf: Frf, results: Results) -> Any:
    """Mean |ΔH|² over the noise variance by pair, or relative error where there is none."""
    inside = derive.clear_lines(frf, derive.analysis_band(results))
    gap = np.abs(model.data - frf.data) ** 2
    weight = frf.variance if frf.variance is not None else np.nanmean(np.abs(frf.data) ** 2, axis=2, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return derive.rms_over(np.sqrt(gap / weight), inside & np.isfinite(gap / weight), axis=2)


def _idle_text(results: Results) -> str:
    model = results.idle
    assert model is not None
    inside = int(np.sum(np.asarray(model.in_band)))
    text = f"The idle model has {count(model.n_modes, 'mode')}, {inside} of them in the band {_band(model, results)}"
    if model.residuals is not None:
        where = derive.range_text(model.residuals.frequencies_hz)
        text += f", and {count(model.n_residuals, 'residual mode')} ({where}) that stand for what lies below and above; "
        text += "they take part in every synthesis and are never listed as modes"
    text += ". "
    if finite(model.misfit):
        text += f"On lines the fit did not use its misfit is {number(model.misfit, 3)}; 1 means that only measurement noise is left."
    else:
        text += "No misfit on unused lines was computed."
    return text


def _fit_text(model: ModalModel) -> str:
    """How the fit went: lines used, convergence, the worst DOF, the rounds of the search."""
    details, parts = model.details, []
    answer, reason = getattr(details, "answer", None), getattr(details, "answer_reason", "")
    if answer is not None:
        stage = "the linear stage" if answer == "linear" else "the maximum-likelihood fit that polishes the linear stage"
        parts.append(f"The modes are those of {stage}: {esc(reason)}.")
    fit_band, fit_misfit = getattr(details, "fit_band_hz", None), getattr(details, "fit_misfit", None)
    if fit_band is not None:
        text = f"The fit used lines in {band_text(fit_band)}"
        parts.append(text + (f" and left a misfit of {number(fit_misfit, 3)} on them." if finite(fit_misfit) else "."))
    if getattr(details, "converged", True) is False:
        parts.append("It did not converge: stated deviations may be too small.")
    by_dof = np.asarray(getattr(details, "misfit_by_dof", ()), float)
    if by_dof.shape == (len(model.dofs),) and np.any(np.isfinite(by_dof)):
        worst = int(np.nanargmax(by_dof))
        parts.append(
            f"On unused lines the misfit by DOF is {number(np.nanmedian(by_dof), 3)} in the median and "
            f"{number(by_dof[worst], 3)} at worst, at {model.dofs[worst]}."
        )
    out = paragraph(" ".join(parts)) if parts else ""
    rounds = tuple(getattr(details, "rounds", ()) or ())
    if rounds:
        lines = "".join(f"<li>{esc(r)}</li>" for r in rounds)
        out += f"<details><summary>Search for the number of modes ({count(len(rounds), 'step')})</summary><ul>{lines}</ul></details>"
    linear = getattr(details, "linear", None)
    return out if linear is None else out + tables.evidence_table(linear)


def _band(model: ModalModel, results: Results) -> str:
    return band_text(model.band_hz or derive.analysis_band(results))


def _reciprocity_text(frf: Frf, results: Results) -> str:
    rows = derive.reciprocity(frf, derive.analysis_band(results))
    if not rows:
        return missing("Reciprocity at rest cannot be checked: no two references are both driven and measured.")
    parts = []
    for r in rows:
        text = f"{r['pair'][0]} and {r['pair'][1]}: {number(100 * r['relative'], 2)} %"
        parts.append(text + (f" ({number(r['ratio'], 2)} times the noise variance)" if r["ratio"] is not None else ""))
    return paragraph(f"Reciprocity at rest, difference of H and its reverse against their size: {listing(parts)}.")


def _stabilization(model: ModalModel | None, numbering: Numbering, results: Results, which: str) -> str:
    details = getattr(model, "details", None)
    stabilization = getattr(details, "stabilization", None)
    rejected = getattr(details, "rejected", None) or getattr(stabilization, "rejected", ())
    told = tables.rejected_table(rejected) if rejected else missing("No candidate was rejected.") if details is not None else ""
    if model is None or stabilization is None:
        return missing("No stabilisation diagram was kept.") + told
    harmonics = _harmonics(results) if which == "operating" else []
    name = "First singular values of the spectra" if which == "operating" else "Mode indicator (CMIF)"
    svg = figures_stabilization.stabilization_diagram(
        stabilization, model.band_hz or derive.analysis_band(results), model.frequencies_hz, harmonics, name
    )
    caption = (
        f"Stabilisation diagram of the {which} state: poles of each model order, lettered by what is stable against the order below; "
        "lines are the modes taken, with their numbers; crosses are rejected candidates."
    )
    return numbering.figure(svg, caption) + told


def _harmonics(results: Results) -> list[float]:
    values = getattr(getattr(results.operating, "details", None), "harmonics_hz", None)
    return [] if values is None else [float(v) for v in values]


def _second_opinion(model: ModalModel, results: Results) -> str:
    """Where an independent program finds something else."""
    state = "idle" if model is results.idle else "operating"
    opinion = library_rows(results.libraries, state) or getattr(model.details, "second_opinion", None)
    if opinion is None or (not opinion and not results.settings.get("second_opinion")):
        return missing("No second opinion from another program was asked for.")
    out = "<h3>Second opinion</h3>"
    if isinstance(opinion, str):
        return out + paragraph(opinion)
    if isinstance(opinion, dict):
        out += "".join(paragraph(opinion[k]) for k in ("program", "text", "summary") if isinstance(opinion.get(k), str))
        opinion = opinion.get("modes") or ()
    rows = [dict(r) for r in opinion if isinstance(r, dict)]
    if not rows:
        return out + missing("The other program gave no modes to compare.")
    against = [r for r in rows if r.get("agrees") is False]
    if all("agrees" in r for r in rows):
        text = f"An independent program agrees on {len(rows) - len(against)} of {len(rows)} modes"
        where = listing(f"{number(r.get('frequency_hz'), 4)} Hz" for r in against if finite(r.get("frequency_hz")))
        out += paragraph(text + (f"; it disagrees at {where}." if where else "."))
    return out + tables.second_opinion_table(rows)


def operating(results: Results, numbering: Numbering) -> str:
    """Spectra, stabilisation, harmonics, rejected poles and modes of the running state."""
    model = results.operating
    if model is None:
        return missing(left_out(results, "oma", "There is no model of the running state"))
    details = model.details
    harmonics = _harmonics(results)
    text = f"From responses alone, {count(model.n_modes, 'mode')} in {_band(model, results)}. "
    if harmonics:
        text += f"Harmonics of rotation were found at {listing(number(h, 5) + ' Hz' for h in harmonics)} and kept out of the modes."
    else:
        text += "No harmonics of rotation were found."
    out = [paragraph(text)]
    f, values = _spectra(details)
    if f is None:
        out.append(missing("No spectra were kept."))
    else:
        modes = model.frequencies_hz
        unit = "(m/s²)²/Hz" if model.si else "units of the file squared per Hz"
        svg = figures_stabilization.singular_values(f, values, model.band_hz or derive.analysis_band(results), modes, harmonics, unit)
        out.append(numbering.figure(svg, "Singular values of the operating spectra with the modes taken (numbered) and harmonics."))
    out.append("<h3>Stabilisation diagram</h3>" + _stabilization(model, numbering, results, "operating"))
    out.append(tables.modal_table(model, "<b>Operating modes.</b> Shapes are complex and of arbitrary scale."))
    out.append(sections_setups.setups(model))
    out.append(_second_opinion(model, results))
    return "".join(out)


def _spectra(details: Any) -> tuple[Any, Any]:
    spectra = getattr(details, "spectra", None)
    if spectra is None:
        return None, None
    if isinstance(spectra, dict):
        f = next((spectra[k] for k in ("frequencies_hz", "frequencies", "hz") if k in spectra), None)
        values = next((spectra[k] for k in ("singular_values", "values") if k in spectra), None)
        return (f, values) if f is not None and values is not None else (None, None)
    if isinstance(spectra, tuple | list) and len(spectra) == 2:
        return spectra[0], spectra[1]
    f, values = getattr(spectra, "frequencies_hz", None), getattr(spectra, "singular_values", None)
    return (f, values) if f is not None and values is not None else (None, None)
