"""How near the operational FRFs come to the validation measurement, in words: over the lines, at the peaks, against the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from operando.compare.route import CLOSE_DB
from operando.compare.verdict import FLOOR_DB, GOOD
from operando.report.text import count, decibel, finite, fixed, number

MODEL_NAMES = {
    "ofrf": "hybrid route",
    "effect": "idle model + effects",
    "msf_all": "operating shapes, all scaled by MSF",
    "idle_shapes": "idle shapes with operating poles",
    "idle": "idle model",
}


def worst_peak(model: Mapping[str, Any]) -> dict[str, Any] | None:
    """The row of ``by_mode`` whose peak height is farthest off; None where no peak was compared."""
    rows = [row for row in model.get("by_mode") or [] if finite(row.get("height_error_db"))]
    return max(rows, key=lambda row: abs(float(row["height_error_db"])), default=None)


def close_words(model: Mapping[str, Any]) -> tuple[str, str]:
    """Verdict and colour class of operational FRFs whose rms error is below ``CLOSE_DB``: good where no peak is off by that much either."""
    lines, worst = f"{decibel(model['error_db'])} rms over the lines", worst_peak(model)
    if worst is None:
        return f"The operational FRFs agree with the validation measurement: {lines}", "good"
    height = abs(float(worst["height_error_db"]))
    said = f"{lines}, peaks up to {fixed(height, 1)} dB"
    if height < CLOSE_DB:
        return f"The operational FRFs agree with the validation measurement: {said}", "good"
    return f"The operational FRFs are nearer to the validation measurement over the lines than at its peaks: {said}", "fair"


def agreement(ofrf: Mapping[str, Any], others: Sequence[tuple[str, float]]) -> list[str]:
    """Sentences on the error of the operational FRFs: beside other models, against the noise, and of the peak farthest off."""
    text = f"Against the validation measurement (known force, operating state) their error is {decibel(ofrf['error_db'])} rms"
    if others:
        text += " (" + ", ".join(f"{MODEL_NAMES.get(name, name)}: {decibel(e)}" for name, e in others) + ")"
    misfit = ofrf.get("misfit")
    if finite(ofrf.get("noise_floor_db")):
        both, share = "noise of that measurement and the model's own uncertainty", ofrf.get("model_share")
        larger = "" if not finite(share) else ", the larger part " + ("the model's uncertainty" if float(share or 0) > 0.5 else "noise")
        text += against_the_floor(float(ofrf["error_db"]), float(ofrf["noise_floor_db"]), misfit, both, larger)
        if ofrf["error_db"] < ofrf["noise_floor_db"] <= FLOOR_DB and (not finite(misfit) or float(misfit or 0) < 1):
            text += ", and the intervals are rather too wide than too narrow"
    if finite(misfit):
        text += f" (reduced chi-square {number(misfit, 3)}, 1 = as good as the noise allows)"
    sentences = [text + "."]
    worst = worst_peak(ofrf)
    if worst is not None:
        n = sum(finite(row.get("height_error_db")) for row in ofrf["by_mode"])
        damping = worst.get("damping_error_percent")
        beside = f" (damping {fixed(damping, 1, sign=True)} %)" if finite(damping) else ""
        where = f", at {number(worst['frequency_hz'], 4)} Hz" if finite(worst.get("frequency_hz")) else ""
        most = "The peak compared is off" if n == 1 else f"Of {count(n, 'peak')} compared the worst is off"
        sentences.append(f"{most} by {fixed(worst['height_error_db'], 2, sign=True)} dB in height{beside}{where}.")
    return sentences


def against_the_floor(error: float, floor: float, misfit: Any, both: str, larger: str = "") -> str:
    """What noise and the model's own uncertainty (``both``, in words) make of an error [dB, rms], as the end of a sentence.

    dB above ``FLOOR_DB`` are no longer those of small errors. Where the floor is above the error nothing is left to explain, unless the
    reduced chi-square of the same lines, which the few near antiresonances do not rule, says that something is.
    """
    if floor > FLOOR_DB:
        return f"; {both} alone may make more than {FLOOR_DB:g} dB, so how much of it is an error of the model cannot be stated"
    if floor <= error:
        return f"; {both} explain {decibel(floor)} of it"
    text = f"; that is no larger than what {both} make ({decibel(floor)}{larger}), "
    some = finite(misfit) and float(misfit) >= GOOD
    return text + ("but the reduced chi-square says that something is left" if some else "so nothing is left to explain")
