"""What the pages of the workbench show, as plain values, and the templates that show it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

from operando.report import parts
from operando.report.sections_diagnosis import candidate_words
from operando.report.words_diagnosis import diagnosis_words, effect_key, effect_words, found_by_itself, found_intro, kind_words, lines_words
from operando.results import Results
from operando.structure.effects import catalogue
from operando.units import written_unit


def render(template: str, **values: Any) -> Markup:
    """HTML of a template; every value in it is shown as text."""
    return parts.render(template, None, "workbench", **values)


def effects(results: Results) -> dict[str, Any]:
    """Verdict, effects in the model, error by step and candidates; ``words`` is None without a diagnosis.

    A step has label, size, error and chi-square on all lines and on hold-out lines; a candidate its number in the document, words,
    chi-square, evidence and tag.
    """
    document = results.diagnosis
    shown: dict[str, Any] = {"words": None, "left_out": results.left_out.get("diagnose"), "can_add": bool(results.idle and results.check)}
    shown["suggests"] = document is not None and bool(found_by_itself(document))
    shown |= {"kinds": _kinds(results), "dofs": [] if results.idle is None else [str(d) for d in results.idle.dofs]}
    if document is None:
        return shown
    words = diagnosis_words(document)
    rows = document.get("ladder") or []
    sizes = {effect_key(e): effect_words(e) for e in document.get("effects") or []}
    steps = []
    for row in rows:
        added = row.get("added")
        effect = None if added is None else sizes.get(effect_key(added)) or effect_words(added)
        errors = [row.get(k) for k in ("error_db", "heldout_error_db", "misfit", "heldout_misfit")]
        steps.append({"step": row["step"], "label": "idle model" if effect is None else effect.label,
                      "size": "" if effect is None else effect.size, "errors": errors})  # fmt: skip
    tried = [(number, *row) for number, row in enumerate(candidate_words(document))]
    return shown | {"words": words, "intro": found_intro(words), "steps": steps, "candidates": tried, "name": kind_words(words.verdict),
                    "lines": lines_words(document.get("judged_on") or {})}  # fmt: skip


def _kinds(results: Results) -> list[dict[str, Any]]:
    """The catalogue for the form: name, words, least and greatest number of DOFs, parameters with starting values."""
    band = None if results.idle is None else results.idle.band_hz
    out = []
    for name, kind in catalogue().items():
        counts = {kind.places, *kind.alternative_places}
        parameters = [
            {"name": p.name, "unit": written_unit(p.unit), "plain": p.plain, "start": f"{p.start(band or (5.0, 145.0)):.4g}"}
            for p in kind.parameters
        ]
        out.append({"kind": name, "name": kind_words(name), "plain": kind.plain, "least": min(counts), "most": max(counts),
                    "parameters": parameters})  # fmt: skip
    return out


def channels(results: Results, table: Mapping[str, Any]) -> dict[str, Any]:
    """Channels with their findings, those left out, and the bands; ``table`` is the test file with its changes."""
    entries: Mapping[str, Any] = table.get("channels", {})
    rows: dict[str, dict[str, Any]] = {}
    for file in results.inventory:
        for label, name, quantity, unit in _measured(file):
            force = quantity in ("force", "moment")
            key = _entry_of(entries, label, name, force)
            row = rows.setdefault(key, {"key": key, "label": label, "name": name, "quantity": quantity, "states": {}, "units": set()})
            row["states"].setdefault(file.get("used_for") or "unused", []).append(file["file"])
            row["units"].add(unit)
            row["findings"] = [f for f in results.findings if f.dof and f.dof in (label, name, key)]
    for key, row in rows.items():
        row["excluded"] = bool(entries.get(key, {}).get("exclude"))
    gone = [
        {"key": key, "reason": entry.get("reason", ""), "to_come": key in rows} for key, entry in entries.items() if entry.get("exclude")
    ]
    analysis: Mapping[str, Any] = table.get("analysis", {})
    band = analysis.get("band")
    used = results.settings.get("band") or (None if results.idle is None else results.idle.band_hz)
    return {"rows": [row for row in rows.values() if not row["excluded"]], "gone": gone, "band": band, "used": used,
            "excluded": analysis.get("exclude_bands") or [], "findings": results.findings}  # fmt: skip


def _measured(file: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """DOF, name, quantity and stated unit of what a file measures: its channels, or the responses and references of its FRFs."""
    for channel in file.get("channels") or ():
        yield str(channel.get("dof") or ""), str(channel.get("name") or ""), channel["quantity"], channel.get("source_unit") or "not stated"
    for key, quantity in (("frf_responses", "response of FRFs"), ("frf_references", "force")):
        for label in file.get(key) or ():
            yield str(label), "", quantity, ""


def _entry_of(entries: Mapping[str, Any], label: str, name: str, force: bool) -> str:
    """Key of a channel in [channels]: the one that it has there, else its DOF, else its name."""
    by_dof = f"{label}:force" if force else label
    for key in (name, by_dof):
        if key and key in entries:
            return key
    given = next((key for key, entry in entries.items() if label and entry.get("dof") == label and not force), None)
    return given or (by_dof if label else name)
