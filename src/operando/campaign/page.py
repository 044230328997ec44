"""The report of a campaign as one HTML file: the answer first, then figures over the parameter, then every test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from operando.campaign import figures
from operando.report import parts
from operando.report.page import render_page
from operando.report.text import DASH, count, fixed, number, plus_minus

MOST_TRACKS = 20
"""Modes drawn in a figure: those seen in most states."""
MOST_EFFECTS = 24
MODEL_WORDS = {"idle": "idle model", "ofrf": "operational FRFs, hybrid route", "effect": "operational FRFs, idle model + effects"}
KIND_WORDS = {"idle": "In the idle state", "operating": "In operation"}
STATE_WORDS = {"done": ("done", "good"), "incomplete": ("a stage failed", "fair"), "failed": ("failed", "poor")}
VERDICT_GRADES = {"no_misfit": "good", "explained": "good", "unexplained": "poor"}


def render(document: Mapping[str, Any]) -> str:
    """HTML text of the report on a document ``operando/campaign/1``."""
    numbering = parts.Numbering()
    makers = (
        ("answer", "Answer: what changes over the tests", "changes", _changes(document)),
        ("operating", "Operating state: modes over the parameter", "modes", _modes(document, "operating")),
        ("idle", "Idle state (reference): modes over the parameter", "modes", _modes(document, "idle")),
        ("errors", "Error of the operational FRFs", "errors", _errors(document)),
        ("effects", "What is missing in the idle model", "effects", _effects(document)),
        ("tests", "All tests", "tests", _tests(document)),
        ("how", "How this was made", "how", {"counts": document["counts"]}),
    )
    shared = {"states": STATE_WORDS, "file": "report.html" if document["until"] in (None, "report") else ""}
    sections = [
        parts.Section(anchor, title, parts.render(f"{template}.html.j2", numbering, "campaign", **shared, **values))
        for anchor, title, template, values in makers
    ]
    counts = document["counts"]
    meta = f"{count(len(document['tests']), 'test')}, {counts['failed']} failed · over {document['over']['label']}"
    return render_page(
        f"{document['name']}: campaign", document["name"], "Operational frequency response functions · campaign report", meta, sections
    )


def headline(document: Mapping[str, Any]) -> str:
    """One line: how many tests, and the first thing that changes."""
    counts, total = document["counts"], len(document["tests"])
    text = f"{document['name']}: {counts['done'] + counts['incomplete']} of {total} tests"
    text += f", {counts['incomplete']} with a stage that failed" if counts["incomplete"] else ""
    text += f", {counts['failed']} failed" if counts["failed"] else ""
    said = said_of(document)
    return f"{text}. {said[0]}." if said else f"{text}."


def said_of(document: Mapping[str, Any]) -> list[str]:
    """What changes, most telling first: effects against the baseline, steps, crossings, frequencies."""
    said = [e["words"] for e in document["effects"] if e["what"] in ("appears", "is gone")]
    lasting = [e["words"] for e in document["effects"] if e["what"] not in ("appears", "is gone")]
    modes = []
    for kind in ("operating", "idle"):
        modes += [s["words"] for s in document[kind]["steps"]]
        modes += [f"{KIND_WORDS[kind].lower()}, {c['words']}" for c in document[kind]["crossings"]]
        if (widest := _widest(document, kind)) is not None:
            modes.append(widest)
    if not (said or modes or lasting) and document["counts"]["done"] + document["counts"]["incomplete"] > 1:
        if not (any(document[kind]["tracks"] for kind in ("operating", "idle")) or any(row["diagnosis"] for row in document["tests"])):
            return ["No test has modes or a diagnosis, so nothing was compared with the baseline"]
        said = ["no mode and no effect differs from the baseline by more than its 95 % interval"]
    return [text[:1].upper() + text[1:] for text in (*said, *lasting, *modes)]


def _widest(document: Mapping[str, Any], kind: str) -> str | None:
    """The mode whose frequency differs most from the baseline."""
    part = document[kind]
    changes = [(p, t) for t in part["tracks"] for p in t["points"] if p["change_percent"] is not None and p["changed"]]
    if part.get("same_everywhere") or not changes:
        return None
    point, track = max(changes, key=lambda item: abs(item[0]["change_percent"]))
    change = f"{point['change_percent']:+.2f}".replace("-", "−")
    where = f"{change} % in {_title(document, point['test'])}, at {point['frequency_hz']:.5g} Hz"
    return f"{KIND_WORDS[kind].lower()}, mode {track['track']} differs most from the baseline: {where}"


def _changes(document: Mapping[str, Any]) -> dict[str, Any]:
    """The answer, the tests that failed, and those that stand out with what few others show."""
    counts, tests, base = document["counts"], document["tests"], document["baseline"]
    failed = [row for row in tests if row["state"] != "done"]
    odd = [(row, _own_findings(row, tests)) for row in tests if row["stands_out"]]
    return {
        "grade": "good" if not failed and not odd else "fair" if counts["done"] else "poor",
        "usable": counts["done"] + counts["incomplete"], "tests": tests, "said": said_of(document), "failed": failed, "odd": odd,
        "base": base and f"{_title(document, base['test'])} ({base['chosen']})",
    }  # fmt: skip


def _own_findings(row: Mapping[str, Any], tests: Sequence[Mapping[str, Any]]) -> list[str]:
    """Findings of kinds that fewer than a fifth of the tests have."""
    rare = [f for f in row["findings"] if sum(any(g["kind"] == f["kind"] for g in r["findings"]) for r in tests) < max(2, len(tests) / 5)]
    return [f["message"] for f in rare[:4]]


def _title(document: Mapping[str, Any], name: str) -> str:
    row = next(r for r in document["tests"] if r["name"] == name)
    return f"test {row['number']} ({row['title']})"


def _modes(document: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """The modes of one state: figures over the parameter, what crosses and steps, one row a mode."""
    part = document[kind]
    shared = bool(part.get("same_everywhere"))
    found = {"state": KIND_WORDS[kind].lower(), "rows": [_track_row(t) for t in part["tracks"]], "shared": shared, "most": MOST_TRACKS}
    if shared or not part["tracks"]:
        return found
    over, base = document["over"]["label"], _places(document).get((document["baseline"] or {}).get("test", ""))
    often = sorted(part["tracks"], key=lambda t: -t["seen"])[:MOST_TRACKS]
    tracks = sorted(often, key=lambda t: t["track"])
    scaled = any(p.get("scale") is not None for t in tracks for p in t["points"])
    drawn = {
        "frequency": figures.mode_figure(tracks, figures.frequency, over, "Frequency [Hz]", baseline=base),
        "damping": figures.mode_figure(tracks, figures.damping, over, "Damping [%]", True, base),
        "scale": figures.mode_figure(tracks, figures.scale, over, "Scale", True, base) if scaled else None,
    }
    return found | {"drawn": drawn, "crossings": part["crossings"], "steps": part["steps"]}


def _track_row(track: Mapping[str, Any]) -> list[str]:
    points = track["points"]
    hz, ratio = [p["frequency_hz"] for p in points], [100 * p["damping_ratio"] for p in points]
    known = [p for p in points if p["change_percent"] is not None]
    base = next((p for p in known if p["change_percent"] == 0 and p["mac_baseline"] is not None), None)
    far = max(known, key=lambda p: abs(p["change_percent"]), default=None)
    macs = [p["mac_baseline"] for p in points if p["mac_baseline"] is not None]
    return [
        str(track["track"]), str(track["seen"]),
        DASH if base is None else plus_minus(base["frequency_hz"], base["frequency_std_hz"]),
        f"{number(min(hz), 4)} … {number(max(hz), 4)}", f"{number(min(ratio), 3)} … {number(max(ratio), 3)}",
        DASH if far is None else fixed(far["change_percent"], 2, sign=True), DASH if far is None else far["test"],
        fixed(min(macs), 3) if macs else DASH,
    ]  # fmt: skip


def _places(document: Mapping[str, Any]) -> dict[str, float]:
    return {r["name"]: r["place"] for r in document["tests"] if r["place"] is not None}


def _errors(document: Mapping[str, Any]) -> dict[str, Any]:
    """The error of each model over the parameter."""
    places = _places(document)
    series: dict[str, list[tuple[float, float]]] = {}
    for key, words in MODEL_WORDS.items():
        found = [(places[r["name"]], (r["errors"].get(key) or {}).get("error_db")) for r in document["tests"] if r["name"] in places]
        points = sorted((x, float(y)) for x, y in found if y is not None)
        if points:
            series[words] = points
    return {"drawn": figures.error_figure(series, document["over"]["label"]) if series else None}


def _effects(document: Mapping[str, Any]) -> dict[str, Any]:
    """Verdicts, and which effects are missing where."""
    told = [r for r in document["tests"] if (r["diagnosis"] or {}).get("verdict")]
    verdicts = Counter(r["diagnosis"]["verdict"].replace("_", " ") for r in told)
    effects, places = document["effects"], _places(document)
    by_effect: dict[str, set[str]] = {}
    for e in effects:
        if e["what"] != "is gone":
            by_effect.setdefault(e["label"], set()).update(e["tests"])
    diagnosed = {r["name"]: places[r["name"]] for r in told if r["name"] in places}
    rows = []
    for name in list(by_effect)[:MOST_EFFECTS] if told else ():
        shown = [place for test, place in diagnosed.items() if test in by_effect[name]]
        rows.append((name, shown, [place for test, place in diagnosed.items() if test not in by_effect[name]]))
    drawn = figures.effect_figure(rows, document["over"]["label"], list(places.values())) if rows else None
    return {"verdicts": [f"{n} × {verdict}" for verdict, n in verdicts.items()], "effects": effects, "drawn": drawn}


def _tests(document: Mapping[str, Any]) -> dict[str, Any]:
    """Each test with the error of its idle model, the least one of its operational FRFs, and its verdict."""
    rows = []
    for r in document["tests"]:
        errors = r["errors"]
        best = min((e["error_db"] for k in ("ofrf", "effect") if (e := errors.get(k)) and e.get("error_db") is not None), default=None)
        rows.append((r, (errors.get("idle") or {}).get("error_db"), best, (r["diagnosis"] or {}).get("verdict")))
    return {"tests": rows, "grades": VERDICT_GRADES, "base": (document["baseline"] or {}).get("test")}
