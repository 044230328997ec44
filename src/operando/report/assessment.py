"""The answer in words: how good the operational FRFs are, and which assumption of the method does not hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.compare import recommended
from operando.compare.route import CLOSE_DB, Route, is_good
from operando.data import Finding, names_text
from operando.indicators import phase_collinearity
from operando.report.agreement import MODEL_NAMES as MODEL_NAMES
from operando.report.agreement import agreement, close_words
from operando.report.class_words import shapes_counted
from operando.report.derive import (
    ModePair,
    all_findings,
    analysis_band,
    comparison_models,
    level_difference,
    mode_pairs,
    pairing_of,
    reciprocity,
    scaling_of,
    validation_run,
)
from operando.report.idle_check import idle_against_check
from operando.report.text import band_text, count, decibel, finite, fixed, listing, number
from operando.report.words_diagnosis import effect_words, found_by_itself
from operando.results import Results
from operando.scaling.methods import IN_WORDS
from operando.scaling.no_scale import no_scale

RECIPROCITY = "Reciprocity in operation"

SCALE_DOUBT_DB = 0.5
"""Median error of the modal scale against the check from which an unchanged mass is doubted."""


@dataclass(frozen=True)
class Assumption:
    """One assumption of the method and what the data say about it.

    ``state`` is ``holds``, ``doubtful``, ``fails`` or ``untested``.
    """

    name: str
    state: str
    text: str


@dataclass(frozen=True)
class Headline:
    """The answer: a verdict word, its colour class (``good``, ``fair``, ``poor``, ``none``), sentences, and what limits it."""

    verdict: str
    grade: str
    sentences: tuple[str, ...]
    limits: tuple[str, ...]


def scope(results: Results) -> str:
    """``ema`` or ``oma`` for a test that has one state and its modes, else ``all``."""
    failed = [reason for reason in results.left_out.values() if reason.startswith("failed")]
    if failed or results.hybrid is not None or results.check or results.diagnosis:
        return "all"
    if results.idle is not None and results.operating is None:
        return "ema"
    alone = results.operating is not None and results.idle is None and results.idle_frf is None
    return "oma" if alone else "all"


def headline(results: Results) -> Headline:
    """What the operational FRFs are and how far they can be trusted, in a few sentences with numbers; the modes of a test of one state."""
    states = assumptions(results)
    limits = [f"{a.name}: {a.text}" for a in states if a.state == "fails"]
    if scope(results) != "all":
        return _modes_alone(results, tuple(limits))
    if results.hybrid is None:
        return Headline(_idle_alone(results), "none", _without_hybrid(results), tuple(limits))
    sentences = [_what_they_are(results)]
    models = comparison_models(results)
    ofrf = models.get("ofrf")
    if not ofrf or not finite(ofrf.get("error_db")):
        reason = (
            "there is no validation measurement (operating state, force measured)" if not results.check else "the comparison was not made"
        )
        sentences.append(
            f"How far they are from the truth is not known: {reason}. "
            "The 95 % bands below hold what the identification is unsure of, no more."
        )
        if any(a.state == "fails" and a.name == RECIPROCITY for a in states):
            verdict = "Operational FRFs made, not validated; non-reciprocal behaviour cannot be represented"
        else:
            verdict = "Operational FRFs made, not validated"
        return Headline(verdict, "poor" if limits else "fair", tuple(sentences), tuple(limits))
    error = float(ofrf["error_db"])
    others = [(name, float(m["error_db"])) for name, m in models.items() if name not in ("ofrf", "effect") and finite(m.get("error_db"))]
    sentences += agreement(ofrf, others)
    by_level = _levels_text(results)
    if by_level:
        sentences.append(by_level)
    idle = next((e for name, e in others if name == "idle"), None)
    if is_good(ofrf) and error >= CLOSE_DB:
        verdict, grade = "The operational FRFs agree with the validation measurement as well as the noise allows", "good"
    elif error < CLOSE_DB:
        verdict, grade = close_words(ofrf)
    elif idle is not None and error > 0.95 * idle:
        measured = validation_run(results)
        where = f" at {measured.level}" if measured is not None and _levels_text(results) else ""
        verdict, grade = f"The operational FRFs are no better than the idle model{where}", "poor"
    else:
        against = f", the idle model by {decibel(idle)}" if idle is not None else ""
        verdict, grade = f"The operational FRFs are off by {decibel(error)}{against}", "fair"
    if results.diagnosis:
        grade = "none"  # one verdict on a page: the diagnosis and the route it recommends have it
    best = min(others, key=lambda item: item[1], default=None)
    if best is not None and 0.98 * error <= best[1] <= 1.02 * error:
        limits.append(f"A simpler model is as close here: {MODEL_NAMES.get(best[0], best[0])} is at {decibel(best[1])}.")
    elif best is not None and best[1] < error:
        limits.append(
            f"A simpler model is closer here: {MODEL_NAMES.get(best[0], best[0])} is at {decibel(best[1])}, "
            f"the operational FRFs at {decibel(error)}."
        )
    return Headline(verdict, grade, tuple(sentences), tuple(limits))


def route_of(results: Results) -> Route | None:
    """The route to the operational FRFs that diagnosis and comparison recommend together."""
    return recommended(results.comparison, results.diagnosis, results.hybrid is not None)


def route_words(results: Results) -> str:
    """The recommended route in one sentence, each error once."""
    route = route_of(results)
    if route is None:
        return ""
    text = f"Recommended operational FRFs: {MODEL_NAMES[route.model]} (operando ofrf --route {route.name})"
    if route.error_db is None:
        return f"{text}; {route.reason}."
    name = ((results.comparison or {}).get("judged_on") or {}).get("level_name")
    level = [f"level {name}"] if name else []
    idle, said = route.idle_error_db, lambda error: f" {error:.2f} dB" in f" {route.reason}"
    beside = [] if idle is None or route.model == "idle" or said(idle) else [f"idle model: {decibel(idle)}"]
    if said(route.error_db):
        further = "; ".join(beside + level)
        return f"{text}; {route.reason}{f' ({further})' if further else ''}."
    text += ", ".join([f", off by {decibel(route.error_db)} from the validation measurement in operation", *level])
    return f"{text}{f' ({beside[0]})' if beside else ''}; {route.reason}."


def joint_grade(results: Results, grade: str) -> str:
    """The colour class of the one verdict: of the diagnosis, no better and no worse than the FRFs by the recommended route allow."""
    route = route_of(results)
    if route is None or route.good is None or grade == "none":
        return grade
    if grade == "good" and not route.good:
        return "fair"
    return "fair" if grade == "poor" and route.good else grade


def _what_they_are(results: Results) -> str:
    pairing, scaling = pairing_of(results), scaling_of(results)
    modal = getattr(results.hybrid, "modal", None)
    dofs = len(modal.dofs) if modal is not None else 0
    parts = shapes_counted(pairing)
    residual = modal.n_residuals if modal is not None else 0
    text = (
        f"Operational FRFs between {count(dofs, 'DOF')} ({dofs * dofs} pairs), {band_text(analysis_band(results))}, "
        f"are the sum over {count(len(pairing), 'operational mode')}: {listing(parts)}"
    )
    text += (
        f"; {count(residual, 'residual mode')} of the idle model stand{'s' if residual == 1 else ''} for modes outside the band."
        if residual
        else "."
    )
    moved = {p.percent or 0.0: p for p in shifted(results)}
    if moved:
        worst = moved[max(moved, key=abs)]
        text += (
            f" Against the idle state the frequencies moved by {fixed(min(moved), 2, sign=True)} to {fixed(max(moved), 2, sign=True)} %, "
            f"most at {number(worst.idle_hz, 4)} Hz (now {number(worst.operating_hz, 4)} Hz)."
        )
    kappa = scaling.get("kappa")
    if scaling.get("method"):
        words = IN_WORDS.get(scaling["method"], f"method {scaling['method']}")
        text += f" Scaling: {words}" + (f" (κ = {number(kappa, 3)})." if finite(kappa) else ".")
    return text


def _levels_text(results: Results) -> str:
    """Errors at each level where they differ: an operational FRF stands for the level of operation."""
    rows = []
    for run in (results.comparison or {}).get("by_run") or []:
        errors = [((run.get("models") or {}).get(k) or {}).get("error_db") for k in ("ofrf", "idle")]
        if all(finite(e) for e in errors):
            rows.append((str(run.get("level_name") or run.get("name")), float(errors[0] or 0), float(errors[1] or 0)))
    if len(rows) < 2 or max(r[1] for r in rows) < 1.3 * min(r[1] for r in rows):
        return ""
    parts = [f"at {level} the operational FRFs are off by {decibel(a)} and the idle model by {decibel(b)}" for level, a, b in rows]
    return (
        f"The level matters: {listing(parts)}. The lowest level is the validation level; operational FRFs stand for the level of operation."
    )


def _modes_alone(results: Results, limits: tuple[str, ...]) -> Headline:
    """The answer of a test of one state: its modes, how well they fit, and what the other state would add."""
    ema = results.idle is not None
    model: Any = results.idle if ema else results.operating
    inside = model.in_band
    f, z = model.frequencies_hz[inside], 100 * model.damping_ratios[inside]
    verdict = f"{count(f.size, 'idle mode' if ema else 'operational mode')} in {band_text(analysis_band(results))}"
    sentences = []
    if f.size:
        text = f"Frequencies from {number(f.min(), 4)} to {number(f.max(), 4)} Hz, damping ratios from {number(z.min(), 2)} to "
        sentences.append(text + f"{number(z.max(), 2)} %.")
    good = f.size > 0
    if ema and finite(model.misfit):
        good &= float(model.misfit) < 2
        sentences.append(f"On hold-out lines the reduced chi-square is {number(model.misfit, 3)}; 1 = as good as the noise allows.")
    why = results.left_out.get("oma" if ema else "ema", "").rstrip(".")
    missing = f" ({why})" if why else ""
    if ema and model.scaling == "unit_modal_mass":
        sentences.append(f"Shapes have unit modal mass. Operational FRFs need a measurement in operation besides{missing}.")
    elif ema:
        cause = no_scale(model, results.findings)
        text = "The shapes have no mass scaling" + (f": {cause[0]} ({cause[1]})." if cause else ".")
        sentences.append(f"{text} Operational FRFs need it, and a measurement in operation{missing}.")
    else:
        sentences.append(f"Shapes are of arbitrary scale: operational FRFs need an idle measurement with a known force besides{missing}.")
    wrong = [f for f in all_findings(results) if f.severity == "error"]
    limits += tuple(_with_files(wrong))[:3]
    return Headline(verdict, "good" if good and not limits else "fair", tuple(sentences), limits)


def _with_files(wrong: Sequence[Finding]) -> list[str]:
    """Errors of the data, each with the files it is in, once."""
    files: dict[str, dict[str, None]] = {}
    for f in wrong:
        text = f.message + (f": {f.consequence}." if f.consequence else ".")
        files.setdefault(text, {}).update(dict.fromkeys([f.file] if f.file and f.file not in text else []))
    return [f"{names_text(names)}: {text}" if names else text for text, names in files.items()]


def _idle_alone(results: Results) -> str:
    """What is said first of a test without operational FRFs: how far the idle model is off, where that was measured."""
    error = (comparison_models(results).get("idle") or {}).get("error_db")
    return f"The idle model is off by {decibel(error)} from the validation measurement" if finite(error) else "No operational FRFs"


def _without_hybrid(results: Results) -> tuple[str, ...]:
    have = []
    if results.idle is not None:
        have.append(f"the idle model has {count(results.idle.n_modes, 'mode')}")
    elif results.idle_frf is not None:
        have.append("idle FRFs were measured")
    if results.operating is not None:
        have.append(f"the operating state has {count(results.operating.n_modes, 'mode')}")
    text = "Operational FRFs were not made"
    for stage in ("ofrf", "oma", "ema", "frf"):
        if stage in results.left_out:
            text += f" ({results.left_out[stage].rstrip('.')})"
            break
    else:
        if results.idle is not None and (cause := no_scale(results.idle, results.findings)) is not None:
            text += f", because the idle shapes have no mass scaling: {cause[0]} ({cause[1]})"
        elif results.operating is None:
            text += ", because there are no operational modes"
        elif results.idle is None:
            text += ", because there is no idle model"
    said = (text + ".", (listing(have)[:1].upper() + listing(have)[1:] + ".") if have else "Nothing has been identified yet.")
    return said[::-1] if idle_against_check(results) else said  # such a test asks for no operational FRFs


def shifted(results: Results) -> list[ModePair]:
    """The modes that both states have."""
    return [p for p in mode_pairs(results) if p.percent is not None]


def assumptions(results: Results) -> list[Assumption]:
    """Each assumption of the method (Shen & Lu 2024, Section 2) with what the data say about it."""
    found = all_findings(results)
    linear = _linear(results, found)
    return [
        _light_and_real(results, found),
        _dominant_modes(results),
        _same_mass(results, nonlinear=linear.state == "fails"),
        _ema_better(results),
        _reciprocal(results, found, nonlinear=linear.state == "fails"),
        linear,
    ]


def _light_and_real(results: Results, found: list[Finding]) -> Assumption:
    name = "Light damping, real modes"
    models = [model for model in (results.idle, results.operating) if model is not None]
    if not models:
        return Assumption(name, "untested", "No modes were identified.")
    top = max((z for model in models for z in model.damping_ratios.tolist()), default=float("nan"))
    text = f"Greatest damping ratio {fixed(100 * top, 2)} %."
    idle = [f.message.rstrip(".") for f in found if f.kind == "complex_modes"]
    if idle:
        text += f" Idle modes that are not real: {'; '.join(idle)}. The shapes stated are real."
    operating, complex_modes = results.operating, []
    for hz, shape in () if operating is None else zip(operating.frequencies_hz, operating.shapes.T, strict=True):
        mpc = phase_collinearity(shape)
        if mpc < 0.9:
            complex_modes.append(f"{number(hz, 4)} Hz ({mpc:.2f})")
    if complex_modes:
        text += f" Operating shapes that are not real (modal phase collinearity below 0.9): {listing(complex_modes)}; "
        text += "their imaginary part is lost in the operational FRFs."
    elif results.operating is not None:
        text += " All operating shapes are close to real (modal phase collinearity 0.9 or more)."
    return Assumption(name, "holds" if top < 0.05 and not idle and not complex_modes else "doubtful", text)


def _dominant_modes(results: Results) -> Assumption:
    name = "The idle model has the dominant modes"
    if results.idle is None:
        return Assumption(name, "untested", "There is no idle model.")
    misfit, alone = results.idle.misfit, [p for p in pairing_of(results) if p.get("class") in ("unpaired", "beyond_idle_band")]
    residual = results.idle.n_residuals
    text = f"{count(results.idle.n_modes, 'idle mode')} and {count(residual, 'residual mode')}; "
    if finite(misfit):
        text += f"reduced chi-square on hold-out lines {number(misfit, 3)} (1 = as good as the noise allows)."
    else:
        text += "no reduced chi-square on hold-out lines was computed"
        on_fitted = getattr(results.idle.details, "fit_misfit", None)
        text += f"; on the fitted lines it is {number(on_fitted, 3)}." if finite(on_fitted) else "."
    state = "holds" if finite(misfit) and float(misfit or 0) < 2 else "doubtful" if finite(misfit) else "untested"
    if alone:
        text += f" {count(len(alone), 'operational mode')} without a partner among the idle modes in band."
        state = "doubtful" if state == "holds" else state
    return Assumption(name, state, text)


def _same_mass(results: Results, nonlinear: bool) -> Assumption:
    name = "Same mass, idle and operating"
    models = comparison_models(results)
    if results.diagnosis:
        masses = [e for e in found_by_itself(results.diagnosis) if str(e.get("kind")).endswith("mass")]
        if masses:
            return Assumption(
                name, "fails", "The diagnosis found a change of mass (see Diagnosis): modes scaled by the idle mass are off by it."
            )
    named = [f for f in all_findings(results) if f.kind == "mass_changed" and f.severity != "info"]
    if named:
        text = named[0].message[:1].upper() + named[0].message[1:].rstrip(".")
        return Assumption(name, "fails", f"{text}; {named[0].consequence.rstrip('.')}.")
    text, state = "", "untested"
    evidence = scaling_of(results).get("evidence") or {}
    by_mass, by_stiffness, noise = (evidence.get(k) for k in ("off_diagonal_mass", "off_diagonal_stiffness", "shape_noise"))
    if finite(by_mass) and finite(by_stiffness):
        text = f"In the idle modes the operating shapes are off orthogonality by {number(by_mass, 2)} in mass and "
        text += f"{number(by_stiffness, 2)} in stiffness (shape noise {number(noise, 2)}): no change of mass is seen in them. "
        state = "holds"
    by_mode = (models.get("ofrf") or {}).get("by_mode") or []
    scales = _scale_errors_db([] if nonlinear else by_mode)  # modes that move with the level have no one scale
    if scales.size:
        typical = float(np.median(np.abs(scales)))
        text += "Against the validation measurement the scale of the modes (peak height times damping) has an error of "
        text += f"{decibel(typical)} in the median, where a change of mass would show."
        state = "doubtful" if typical >= SCALE_DOUBT_DB else state
    return Assumption(name, state, text or _mass_untested(results))


def _mass_untested(results: Results) -> str:
    if not results.check:
        return "Shapes and frequencies alone say nothing here; a validation measurement would."
    text = "A validation measurement shows a change of mass in the scale of operational modes; there are none with a scale to compare."
    return text + (" The diagnosis looks for added masses by itself (see Diagnosis)." if results.diagnosis else "")


def _scale_errors_db(by_mode: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Error of each mode's residue [dB]: a peak is residue over damping, so the damping error is taken out of the height error."""
    pairs = [(r.get("height_error_db"), r.get("damping_error_percent")) for r in by_mode]
    good = [(float(h), float(z)) for h, z in pairs if finite(h) and finite(z) and float(z or 0) > -100]  # type: ignore[arg-type]
    return np.array([h + 20 * np.log10(1 + z / 100) for h, z in good])


def _ema_better(results: Results) -> Assumption:
    name = "EMA is more certain than OMA"
    idle, operating = results.idle, results.operating
    if idle is None or operating is None or idle.frequency_std_hz is None or operating.frequency_std_hz is None:
        return Assumption(name, "untested", "Uncertainties of both models are needed.")
    if not idle.n_modes or not operating.n_modes:
        return Assumption(name, "untested", "One of the two models has no mode.")
    a = np.median(idle.frequency_std_hz / idle.frequencies_hz)
    b = np.median(operating.frequency_std_hz / operating.frequencies_hz)
    text = f"Median relative standard deviation of frequency: idle {number(100 * a, 2)} %, operating {number(100 * b, 2)} %."
    return Assumption(name, "holds" if a <= b else "doubtful", text)


def _of_kind(found: list[Finding], kind: str) -> list[Finding]:
    return [f for f in found if f.kind == kind and f.severity != "info"]


def _at_rest(results: Results, finding: Finding) -> bool:
    """Whether a finding comes from the idle FRFs."""
    return results.idle_frf is not None and finding in results.idle_frf.findings


def _reciprocal(results: Results, found: list[Finding], nonlinear: bool) -> Assumption:
    name = RECIPROCITY
    consequence = "A sum over real shapes is symmetric: operational FRFs cannot represent gyroscopic or circulatory effects; "
    consequence += "only the route idle model + effect can."
    run = validation_run(results)
    rows = reciprocity(run.frf, analysis_band(results)) if run is not None else []
    text, measured = "", None
    if rows:
        worst = max(rows, key=lambda r: r["ratio"] if r["ratio"] is not None else r["relative"])
        text = f"H at {worst['pair'][0]} from {worst['pair'][1]} and the reverse differ by {number(100 * worst['relative'], 2)} % of "
        text += "their size"
        text += f", {number(worst['ratio'], 3)} times the noise variance" if worst["ratio"] is not None else ""
        measured = not ((worst["ratio"] if worst["ratio"] is not None else np.inf) > 3 and worst["relative"] > 0.1)
    named = [f for f in _of_kind(found, "not_reciprocal") if not _at_rest(results, f)]
    by_shapes = [f for f in named if not any(f in run.frf.findings for run in results.check)]
    faults = [e.label for e in map(effect_words, found_by_itself(results.diagnosis or {})) if e.group in ("sensor", "force")]
    if measured is False and faults and not by_shapes:
        return Assumption(
            name, "doubtful", f"{text}; yet the diagnosis found a fault of the measurement that does this ({listing(faults)})."
        )
    if measured is False and nonlinear and not by_shapes:
        return Assumption(name, "doubtful", f"{text}; a response that depends on the level does this by itself.")
    if measured is False or (named and measured is None):
        first = text if measured is False else named[0].message.rstrip(".")
        return Assumption(name, "fails", f"{first}. {consequence}")
    if named:
        return Assumption(name, "doubtful", f"{named[0].message.rstrip('.')}; yet in the validation measurement {text}.")
    if measured is None:
        return Assumption(name, "untested", "Not tested: it takes a validation measurement with two forced points. " + consequence)
    return Assumption(name, "holds", text + ".")


def _periodic_linear(results: Results, found: list[Finding]) -> Assumption | None:
    """What periodic forces say: distortion repeats with them, noise does not."""
    distorted = [f for f in found if f.kind == "nonlinear_distortion"]
    one_level = "The FRFs stand for the level they were measured at; a second level shows how they change with it."
    if distorted:
        worst = distorted[0]
        text = f"{'Idle' if _at_rest(results, worst) else 'In operation'}: {worst.message.rstrip('.')}. {one_level}"
        return Assumption("Linear behaviour", "holds" if worst.severity == "info" else "doubtful", text)
    if any(f.kind == "periodic_excitation" for f in found):
        return Assumption("Linear behaviour", "holds", f"Periods of the force show no distortion beyond their noise. {one_level}")
    return None


def _linear(results: Results, found: list[Finding]) -> Assumption:
    name = "Linear behaviour"
    named = _of_kind(found, "nonlinear")
    if named:
        where = "Idle" if _at_rest(results, named[0]) else "In operation"
        return Assumption(name, "fails", f"{where}: {named[0].message.rstrip('.')}. The FRFs stand for the level they were measured at.")
    periodic = _periodic_linear(results, found)
    if periodic is not None and periodic.state == "doubtful":
        return periodic
    levels = level_difference(results.check, analysis_band(results))
    if levels is None:
        agree = [run for run in results.check if run.levels_agree]
        if agree:
            return Assumption(
                name, "holds", f"Validation measurements at several levels ({agree[0].level}) differ by no more than their noise."
            )
        return periodic or Assumption(name, "untested", "It takes validation measurements at two levels of force.")
    percent = number(100 * (levels["relative"] or 0), 2)
    text = f"FRFs of levels {levels['levels'][0]} and {levels['levels'][1]} differ by {percent} % of their size"
    ratio = levels["ratio"]
    if ratio is None:
        return Assumption(name, "untested", text + ".")
    text += f", {number(ratio, 3)} times the noise variance."
    return Assumption(name, "holds" if ratio < 2 else "doubtful" if ratio < 10 else "fails", text)
