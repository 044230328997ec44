"""The diagnosis in words: verdicts, effects with 95 % intervals, the steps of the steps, the answer."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from operando.compare.verdict import FLOOR_DB
from operando.errors import OperandoError
from operando.indicators import INTERVAL
from operando.report.agreement import against_the_floor
from operando.report.text import decibel, finite, listing, number, plus_minus
from operando.structure.effects import Effect
from operando.units import engineering_unit

VERDICTS: dict[str, tuple[str, str]] = {
    "no_misfit": ("Nothing is missing: the idle model predicts the operating state", "good"),
    "inconclusive": ("Whether anything is missing cannot be decided from these data", "fair"),
    "explained": ("Cause found", "good"),
    "ambiguous": ("Something is missing; these data do not distinguish between several effects", "fair"),
    "partial": ("Part of the cause found", "fair"),
    "unexplained": ("Something is missing that no effect looked for explains", "poor"),
}
"""Verdict → what it means, and the colour class."""

FAULT = "The measurement is at fault, not the structure"
"""What ``explained`` means where only channels are to blame."""

BY_HAND = ("changed_by_hand", "Effects were added or taken out by hand", "none")
"""What stands in the place of verdict, title and colour class then."""

MOST_NAMED = 4
"""Effects named one by one in a sentence; the rest are counted."""


@dataclass(frozen=True)
class EffectWords:
    """One effect for people."""

    name: str  # the kind in words: "point mass"
    place: str  # empty where it has none
    size: str  # values with 95 % intervals
    sentence: str  # what it does, with place and size
    confirm: str  # the test that would confirm it
    group: str = "structure"  # ``structure``, ``idle``, ``sensor``, ``force`` or ``excitation``
    removed: bool = False  # whether it was taken away
    sure: bool = True  # whether its 95 % interval leaves zero out

    @property
    def label(self) -> str:
        """Kind and place, and whether it was taken away."""
        name = f"removed {self.name}" if self.removed else self.name
        return f"{name} at {self.place}" if self.place else name


@dataclass(frozen=True)
class StepError:
    """One step: what was added, and the error on hold-out lines and on all lines (dB or chi-square; NaN where not known)."""

    step: int
    effect: EffectWords | None
    heldout: float
    everything: float
    with_between: bool = False  # whether the model has what differs between the two measurements


@dataclass(frozen=True)
class ErrorByStep:
    """The steps of the error."""

    rows: tuple[StepError, ...] = ()
    decibel: bool = True  # level errors, else chi-squares (1 is the noise)
    on_hold_out: bool = True  # whether they were computed on data that nothing was fitted to
    floor: float | None = None  # what noise and the model's own uncertainty explain, in the same measure
    by_phase: bool = False  # whether chi-squares stand because levels hardly change

    @property
    def shown_floor(self) -> float | None:
        """The floor; None where it is so high that an agreement says nothing: its dB are those of small errors."""
        return None if self.floor is None or (self.decibel and self.floor > FLOOR_DB) else self.floor

    def text(self, value: float) -> str:
        """A value with its unit."""
        return decibel(value) if self.decibel else f"{number(value, 3)}"


@dataclass(frozen=True)
class DiagnosisWords:
    """The answer of a diagnosis."""

    verdict: str  # as in the document; ``changed_by_hand`` where the effects are not the diagnosis' own
    title: str  # what it means
    grade: str  # colour class
    found: tuple[str, ...]  # one sentence an effect in the model
    sentences: tuple[str, ...]  # how far the idle model is off without and with them, and what they cannot be distinguished from
    decide: tuple[str, ...]  # the measurement that would decide or confirm
    ladder: ErrorByStep
    effects: tuple[EffectWords, ...] = ()
    output_only: bool = False  # whether operational modes alone were used
    on_records: bool = False  # whether records of force were used


def kind_words(kind: Any) -> str:
    """Name of a kind as read by people."""
    return str(kind).replace("_", " ")


def effect_words(document: Mapping[str, Any]) -> EffectWords:
    """An effect of ``diagnosis.json`` in words, its sizes with 95 % intervals; as it stands where the kind is not known here."""
    try:
        effect = Effect.from_dict(document)
        sentence = _typeset(effect.definition.explain(effect.place, _marked(effect), effect.removed))
        sentence = sentence[:1].upper() + sentence[1:]
        names = effect.definition.names[:1]
        sure = not names or names[0] not in effect.std or abs(effect.values[names[0]]) > INTERVAL * effect.std[names[0]]
        return EffectWords(
            kind_words(effect.kind), effect.place, _typeset(effect.size), sentence, effect.confirm, effect.definition.group,
            effect.removed, bool(sure),
        )  # fmt: skip
    except (OperandoError, KeyError, TypeError, ValueError):
        place = listing(document.get("location") or [])
        name = kind_words(document.get("kind"))
        sentence = str(document.get("explanation") or (f"{name} at {place}" if place else name))
        return EffectWords(
            name, place, _plain_size(document), sentence, str(document.get("confirm") or ""), removed=bool(document.get("removed"))
        )


def _marked(effect: Effect) -> str:
    """The size with the interval named, in brackets unless it stands in brackets already."""
    size = effect.size
    if "±" not in size:
        return size
    text = effect.definition.explain(effect.place, size, effect.removed)
    at = text.find(size)
    closed = at >= 0 and text[at + len(size) : at + len(size) + 1] == ")"
    return f"{size}, 95 % interval" if closed else f"{size} (95 %)"


def plain_powers(text: str) -> str:
    """2.516e+04 in a sentence as 25160."""
    return re.sub(r"\d(?:\.\d+)?e\+\d+", lambda m: f"{float(m[0]):.0f}", text)


def _typeset(text: str) -> str:
    """True minus signs, and 1e-07 as 1·10⁻⁷."""
    powers = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    text = re.sub(r"(?<=\d)e([-+]?\d+)", lambda m: "·10" + str(int(m[1])).translate(powers), text)
    return re.sub(r"(?<![^ (])-(?=\d)", "−", text)


def _plain_size(document: Mapping[str, Any]) -> str:
    parts = []
    parameters = document.get("parameters") or {}
    for name, entry in parameters.items():
        value = entry if isinstance(entry, Mapping) else {"value": entry}
        if not finite(value.get("value")):
            continue
        size, si = float(value["value"]), str(value.get("unit") or "")
        std: Any = value.get("std")
        factor, unit = engineering_unit(size, si)
        text = (plus_minus(size / factor, float(std) / factor) if finite(std) else number(size / factor, 4)) + f" {unit}".rstrip()
        parts.append(text if len(parameters) == 1 else f"{kind_words(name)} {text}")
    return ", ".join(parts)


def error_by_step(document: Mapping[str, Any]) -> ErrorByStep:
    """The steps of a diagnosis in dB on hold-out lines; as chi-squares, or on all lines, where it has no others.

    Chi-squares are shown also where the levels hardly change and the chi-square does: a fault of phase alone has no dB.
    A step is named by the effect as it stands after the last refit of all.
    """
    rows = [row for row in document.get("ladder") or [] if isinstance(row, Mapping)]
    final = {effect_key(e): e for e in document.get("effects") or []}
    in_decibel = bool(rows) and all(finite(r.get("heldout_error_db")) or finite(r.get("error_db")) for r in rows)
    channels = all(effect_words(r["added"]).group in ("sensor", "force") for r in rows if isinstance(r.get("added"), Mapping))
    by_phase = in_decibel and channels and _phase_only(rows)
    keys = ("heldout_error_db", "error_db") if in_decibel and not by_phase else ("heldout_misfit", "misfit")
    on_hold_out = bool(rows) and all(finite(r.get(keys[0])) for r in rows)
    value = lambda row, key: float(row[key]) if finite(row.get(key)) else float("nan")  # noqa: E731
    steps = []
    for i, row in enumerate(rows):
        added = row.get("added")
        words = effect_words(final.get(effect_key(added), added)) if isinstance(added, Mapping) else None
        errors = value(row, keys[0 if on_hold_out else 1]), value(row, keys[1])
        steps.append(StepError(int(row.get("step", i)), words, *errors, bool(row.get("with_between"))))
    steps = [s for s in steps if finite(s.heldout)]
    floor: Any = document.get("noise_floor_db") if keys[1] == "error_db" else 1.0
    return ErrorByStep(tuple(steps), keys[1] == "error_db", on_hold_out, float(floor) if finite(floor) else None, by_phase)


def _phase_only(rows: Sequence[Mapping[str, Any]]) -> bool:
    """Whether the chi-square fell by more than half and the level error by less than a tenth."""
    ends = []
    for keys in (("heldout_error_db", "error_db"), ("heldout_misfit", "misfit")):
        first, last = ([r[k] for k in keys if finite(r.get(k))][:1] for r in (rows[0], rows[-1]))
        if not first or not last or float(first[0]) <= 0:
            return False
        ends.append(float(last[0]) / float(first[0]))
    return len(rows) > 1 and ends[0] > 0.9 and ends[1] < 0.5


def effect_key(effect: Any) -> tuple[Any, ...]:
    """Kind and place, by which two effects are the same one."""
    if not isinstance(effect, Mapping):
        return ()
    return (effect.get("kind"), tuple(map(str, effect.get("location") or ())), tuple(effect.get("position") or ()))


def diagnosis_words(document: Mapping[str, Any]) -> DiagnosisWords:
    """The answer of ``diagnosis.json``: what is missing, how far the idle model is off without and with it, and what would confirm it."""
    verdict = str(document.get("verdict") or "none")
    title, grade = VERDICTS.get(verdict, (f"Diagnosis: {kind_words(verdict)}", "none"))
    effects = tuple(effect_words(e) for e in document.get("effects") or [])
    by_hand = changed_by_hand(document)
    if by_hand:
        verdict, title, grade = BY_HAND
    elif verdict == "explained" and effects and all(e.group in ("sensor", "force") for e in effects):
        title = FAULT
    ladder = error_by_step(document)
    output_only = not any(str(d).startswith("check") for d in document.get("data") or ["check_frf"])
    others = _diagnosed(document) if by_hand else (_others(document, verdict, effects),)
    judged_on, last = document.get("judged_on") or {}, (document.get("ladder") or [{}])[-1]
    misfit = last.get("heldout_misfit") if ladder.on_hold_out else last.get("misfit")
    where = f"Hold-out set: {lines_words(judged_on)}." if judged_on and not output_only else ""
    hidden = "" if by_hand else _hidden(document)
    differ = "" if by_hand else between_words(document)
    of_records = judged_on.get("measured") == "spectra of records"
    sentences = (_none_left(effects) if by_hand else "", _errors(ladder, output_only, misfit, of_records), where, hidden, differ, *others)
    found = tuple(_found(e) for e in effects)
    decide = _deciding(document, verdict, effects)
    said = tuple(s for s in sentences if s)
    return DiagnosisWords(verdict, title, grade, found, said, decide, ladder, effects, output_only, _on_records(document))


def _on_records(document: Mapping[str, Any]) -> bool:
    return "check_records" in (document.get("data") or ())


def _hidden(document: Mapping[str, Any]) -> str:
    """What would have been seen, where nothing was found; else why the verdict is no better."""
    verdict, seen = document.get("verdict"), [row for row in document.get("detectable") or [] if finite(row.get("value"))]
    if verdict == "no_misfit" and (effects := _would_have_been_seen(seen)):
        found = f"Of effects of these sizes, depending on the location, 95 % would have been found: {effects}."
        if (document.get("judged_on") or {}).get("level") is None:
            return found
        return f"{found} A force that depends on the level counts with its mean spring and damper at the levels measured."
    if verdict == "no_misfit" and seen:
        worst = max(seen, key=lambda row: float(row["value"]))
        factor, unit = engineering_unit(float(worst["value"]), worst["unit"])
        least = f"{number(float(worst['value']) / factor, 2)} {unit}"
        return f"A mode that moves by {least} or more would have been seen (least well the {worst['parameter']})."
    if verdict in ("inconclusive", "partial", "unexplained") and document.get("reason"):
        text = str(document["reason"])
        return f"{text[:1].upper()}{text[1:]}."
    return ""


def _would_have_been_seen(rows: Sequence[Mapping[str, Any]]) -> str:
    """Smallest sizes of each kind, from the place where it is seen best to the one where it is seen least."""
    sizes: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row.get("kind") != "frequency_shift":
            sizes.setdefault(str(row["kind"]), []).append(row)
    parts = []
    for kind, some in sizes.items():
        values = sorted(float(row["value"]) for row in some)
        factor, unit = engineering_unit(values[-1], some[0]["unit"])
        span = " … ".join(number(v / factor, 2) for v in dict.fromkeys((values[0], values[-1])))
        parts.append(f"{kind_words(kind)} {span} {unit}")
    return listing(parts, len(parts))


def between_words(document: Mapping[str, Any]) -> str:
    """What differs between the two measurements, and whether days in a laboratory do."""
    rows = document.get("between") or []
    parts = []
    for what, name in (("sensor_gain", "gains of sensors"), ("force_gain", "of forces")):
        off = [abs(float(r["value"]) - 1) for r in rows if r["what"] == what]
        if off:
            parts.append(f"{name} by up to {number(100 * max(off), 2)} %")
    for what, name, zero in (("stiffness", "stiffness", 0.0), ("damping", "damping", 1.0)):
        for r in rows:
            if r["what"] == what:
                change = float(r["value"]) - zero
                parts.append(f"{name} by {'+' if change >= 0 else ''}{plus_minus(change, r['std'], 2, 100.0)} %")
    if not parts:
        return ""
    whole_first = sorted((r for r in rows if r.get("unusual")), key=lambda r: bool(r["location"]))
    unusual = [f"{kind_words(r['what'])} {listing(r['location'])}".strip() for r in whole_first]
    listed = listing(parts, len(parts))
    if not unusual:
        return _typeset(f"Between the two measurements differ, as days in a laboratory do: {listed}.")
    return _typeset(
        f"Between the two measurements differ: {listed}. Farther than days in a laboratory: {listing(unusual, MOST_NAMED)}; that may be "
        "part of what has changed."
    )


def _found(effect: EffectWords) -> str:
    owner = ""
    if effect.group == "structure" and effect.place:
        owner = f"; the idle model {'still has' if effect.removed else 'does not have'} it"
    unsure = "" if effect.sure else " (its size is known but roughly: the 95 % interval reaches zero)"
    return f"{effect.sentence}{owner}{unsure}."


def found_intro(words: DiagnosisWords) -> str:
    """What stands before the effects: nothing before one that is believed."""
    if not words.found:
        return ""
    if words.verdict == BY_HAND[0]:
        return "In the model now:"
    if words.verdict == "unexplained":
        return "The best try, which explains too little to be believed:"
    if words.verdict == "ambiguous":
        return "The likeliest:" if len(words.found) == 1 else "The likeliest, together:"
    return "" if len(words.found) == 1 else f"{len(words.found)} effects together:"


def changed_by_hand(document: Mapping[str, Any]) -> bool:
    """Whether the effects in the model are others than those the diagnosis found by itself."""
    return {effect_key(e) for e in document.get("effects") or []} != {effect_key(e) for e in found_by_itself(document)}


def found_by_itself(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The effects the diagnosis accepted, whatever was added or taken out by hand since."""
    by_hand = document.get("by_hand")
    return list((by_hand.get("found") if isinstance(by_hand, Mapping) else document.get("effects")) or [])


def _none_left(effects: Sequence[EffectWords]) -> str:
    return "" if effects else "No effect is in the model now."


def _diagnosed(document: Mapping[str, Any]) -> tuple[str, ...]:
    """What the refit said of the changes, and what the diagnosis had found by itself."""
    said = [
        re.sub(r"^(removed )?[a-z_]+(?= at )", lambda m: kind_words(m[0]), plain_powers(str(w).replace("`", "")))
        for w in document["by_hand"].get("words") or []
    ]
    own = [effect_words(e).sentence for e in found_by_itself(document)]
    verdict = kind_words(document.get("verdict") or "none")
    found = f"The diagnosis by itself ({verdict}) found: {'. '.join(own)}." if own else f"The diagnosis by itself said: {verdict}."
    return (*(f"{w[:1].upper()}{w[1:]}." for w in said), found)


def _errors(ladder: ErrorByStep, output_only: bool, misfit: Any, of_records: bool = False) -> str:
    if not ladder.rows:
        return ""
    first, last = ladder.rows[0].heldout, ladder.rows[-1].heldout
    added = len(ladder.rows) - 1
    modes = "operating frequencies, damping ratios and shapes"
    lines = "spectra of the validation records (responses, not FRFs)" if of_records else "lines of the validation measurement"
    where = (
        f"{'the hold-out set' if ladder.on_hold_out else 'all'} of {modes}"
        if output_only
        else f"{'hold-out' if ladder.on_hold_out else 'all'} {lines}"
    )
    value = decibel if ladder.decibel else _deviations
    differs = "what differs between the two measurements"
    text = f"On {where}, the error of the idle model {f'with {differs} ' if ladder.rows[0].with_between else ''}is {value(first)}"
    more = f" and {differs}" if ladder.rows[-1].with_between else ""
    text += f", with {'the effect' if added == 1 else 'the effects'}{more} {value(last)}" if added else ""
    if ladder.decibel:
        both = "noise and the model's own uncertainty"
        return text + ("" if ladder.floor is None else against_the_floor(last, ladder.floor, misfit, both)) + "."
    text += (
        f" (reduced chi-square {number(first, 3)}" + (f", then {number(last, 3)}" if added else "") + "; 1 = as good as the noise allows)"
    )
    return text + ("; it is the phase that is wrong, levels in dB hardly show it." if ladder.by_phase else ".")


def lines_words(judged_on: Mapping[str, Any]) -> str:
    """State, level and lines of the hold-out figures."""
    if not judged_on:
        return ""
    blocks = "hold-out blocks of lines" if judged_on.get("ranges_hz") is not None else "all lines, those of the fit included,"
    part = "whole runs" if judged_on.get("whole_run") else blocks
    runs = listing([str(r) for r in judged_on.get("runs") or []], MOST_NAMED)
    text = f"{judged_on['state']} state, {judged_on['measured']}"
    text += f", {part} of {runs}" if runs else ""
    text += f", level {judged_on['level_name']}" if judged_on.get("level_name") else ""
    band, count = judged_on.get("band_hz"), judged_on.get("n_lines")
    text += f", {number(band[0], 4)} … {number(band[1], 4)} Hz" if band else ""
    return text + (f", {count} complex values" if count else "")


def _deviations(misfit: float) -> str:
    return f"{number(max(misfit, 0.0) ** 0.5, 2)} standard deviations"


def _others(document: Mapping[str, Any], verdict: str, effects: Sequence[EffectWords]) -> str:
    others = [effect_words(e).label for e in document.get("ambiguous_with") or []]
    if others and not effects:
        return f"Too faint to be accepted, but not excluded: {listing(others, MOST_NAMED)}."
    if others:
        return f"These data do not distinguish {'it' if len(effects) < 2 else 'them'} from: {listing(others, MOST_NAMED)}."
    if verdict == "explained" and effects:
        return "Nothing else in the catalogue does as well."
    if verdict == "partial":
        return "No further effect was found, and the rest is more than noise."
    if verdict == "no_misfit" and not effects:
        return "No effect of the catalogue improves the model."
    return ""


def _deciding(document: Mapping[str, Any], verdict: str, effects: Sequence[EffectWords]) -> tuple[str, ...]:
    out = []
    proposed = str(document.get("proposed_measurement") or "").replace("_", " ")
    confirmed = [e for e in effects[:2] if e.confirm] if verdict in ("explained", "partial") else []
    if proposed and verdict != BY_HAND[0] and proposed not in [e.confirm for e in confirmed]:
        out.append(_stopped(f"What would decide: {proposed}"))
    for e in confirmed:
        out.append(_stopped(f"To confirm{'' if len(effects) == 1 else f' the {e.label}'}: {e.confirm}"))
    return tuple(out)


def _stopped(text: str) -> str:
    return text if text.endswith(("?", ".")) else f"{text}."
