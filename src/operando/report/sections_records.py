"""The part of the diagnosis section that records with measured force speak for: restoring force, levels, simulation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from operando.report import figures_records
from operando.report.parts import Numbering, paragraph
from operando.report.text import esc, finite, number
from operando.report.words_diagnosis import EffectWords, effect_words, found_by_itself


def restoring_forces(found: Mapping[str, Any], numbering: Numbering) -> str:
    """Restoring force at each place found with the law over it, what it is equivalent to at each level, and how that was seen."""
    pictures = (found.get("picture") or {}).get("restoring_force") or []
    out = [_seen(found.get("detection") or {})]
    for picture in pictures:
        effect = _effect(picture, found)
        title = " and ".join(map(str, picture.get("location") or [])) + ("" if effect is None else f": {effect.name} {effect.size}")
        caption = "Restoring force that the records ask for at the place found, without asking for a law, over the motion across it; and "
        caption += "the law fitted, on the same lines. "
        if finite(picture.get("goodness")):
            caption += f"The law explains {number(100 * float(picture['goodness']), 4)} % of the force. "
        shares = picture.get("parity") or {}
        if shares:
            caption += f"Over the displacement {number(100 * shares['even'], 2)} % of its mean square is even and "
            caption += f"{number(100 * shares['odd'], 2)} % odd beyond a straight line. "
        caption += "A gap shows as a flat part, a cubic spring bends upwards, a saturating one downwards; friction is a step over velocity."
        out.append(numbering.figure(figures_records.force_figure(picture, title), esc(caption)))
        if len(picture.get("equivalent") or []) > 1:
            caption = "The spring and the damper that come nearest to the law in the mean square at the level of each record (its force "
            caption += "at the dot): what a linear model would find there. FRFs of the model with effects use the lowest level."
            out.append(numbering.figure(figures_records.level_figure(picture["equivalent"], title), esc(caption)))
    levels = (found.get("picture") or {}).get("levels") or {}
    if levels.get("curves"):
        caption = (
            "What an FRF measurement finds depends on the force. Model with the effects under a random force of each level measured and of "
        )
        caption += "twice the highest, by springs and dampers that are equivalent in the mean square; other levels and pairs by "
        caption += "operando ofrf DIR --route effect --level N."
        out.append(numbering.figure(figures_records.frf_figure(levels), esc(caption)))
    out.append(_simulation(found.get("simulation") or {}, numbering))
    return "".join(out)


def _simulation(simulation: Mapping[str, Any], numbering: Numbering) -> str:
    """The closed loop against the record that judges."""
    figure = simulation.get("figure") or {}
    if not figure.get("time_s") or not finite(simulation.get("gain_db")):
        return ""
    records = ", ".join(f"{r['name']}: {number(r['gain_db'], 3)} dB" for r in simulation.get("records") or [])
    text = (
        "Simulated in the closed loop, the model with the effects makes the motion itself: only the measured force, and the state at the "
    )
    text += (
        f"beginning of each window of {number(simulation['horizon_s'], 3)} s, come from the record. Over all responses the error falls by "
    )
    text += f"{number(simulation['gain_db'], 3)} dB against the idle model ({records})."
    caption = f"Measured and simulated side by side on {figure['record']}, which nothing was fitted to unless it is the only level; "
    caption += "in the band compared, around the largest response."
    return paragraph(text) + numbering.figure(figures_records.simulation_figure(figure), esc(caption))


def _seen(detection: Mapping[str, Any]) -> str:
    """What was seen before anything was named."""
    if not detection:
        return ""
    levels, coherence = detection.get("levels_n") or [], detection.get("coherence") or []
    text = ""
    if finite(detection.get("inhomogeneity")):
        ratio = number(float(detection["inhomogeneity"]), 3)
        text = f"FRFs of the lowest and the highest level differ by {ratio} times what their scatter allows. "
    if levels and len(levels) == len(coherence):
        pairs = f"{number(coherence[0], 3)} at {number(levels[0], 3)} N and {number(coherence[-1], 3)} at {number(levels[-1], 3)} N rms"
        text += f"Coherence of force and response in the mean: {pairs}."
    return paragraph(text) if text else ""


def _effect(picture: Mapping[str, Any], found: Mapping[str, Any]) -> EffectWords | None:
    here = list(map(str, picture.get("location") or ()))
    for e in found_by_itself(found):
        if e.get("kind") == picture.get("kind") and list(map(str, e.get("location") or ())) == here:
            return effect_words(e)
    return None
