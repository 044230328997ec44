"""The report of a campaign as one HTML file: the answer first, then figures over the parameter, then every test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from operando.campaign import figures
from operando.report.page import render_page
from operando.report.parts import Numbering, Section, missing, paragraph, shown, table, tag
from operando.report.text import DASH, count, decibel, esc, fixed, listing, number, plus_minus

MOST_TRACKS = 20
"""Modes drawn in a figure: those seen in most states."""
MOST_EFFECTS = 24
MODEL_WORDS = {"idle": "idle model", "ofrf": "operational FRFs, hybrid route", "effect": "operational FRFs, idle model + effects"}
KIND_WORDS = {"idle": "In the idle state", "operating": "In operation"}
STATE_WORDS = {"done": ("done", "good"), "incomplete": ("a stage failed", "fair"), "failed": ("failed", "poor")}
VERDICT_GRADES = {"no_misfit": "good", "explained": "good", "unexplained": "poor"}


def render(document: Mapping[str, Any]) -> str:
    """HTML text of the report.

    Parameters
    ----------
    document : mapping
        ``operando/campaign/1``.
    """
    numbering = Numbering()
    makers = (
        ("answer", "Answer: what changes over the tests", _answer),
        ("operating", "Operating state: modes over the parameter", lambda d, n: _modes(d, n, "operating")),
        ("idle", "Idle state (reference): modes over the parameter", lambda d, n: _modes(d, n, "idle")),
        ("errors", "Error of the operational FRFs", _errors),
        ("effects", "What is missing in the idle model", _effects),
        ("tests", "All tests", _tests),
        ("how", "How this was made", _how),
    )
    sections = [Section(anchor, title, make(document, numbering)) for anchor, title, make in makers]
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


def _answer(document: Mapping[str, Any], numbering: Numbering) -> Markup:
    counts, tests = document["counts"], document["tests"]
    said = said_of(document)
    failed = [row for row in tests if row["state"] != "done"]
    out = [r for r in tests if r["stands_out"]]
    grade = "good" if not failed and not out else "fair" if counts["done"] else "poor"
    title = f"{counts['done'] + counts['incomplete']} of {count(len(tests), 'test')} could be used"
    base = document["baseline"]
    html = [Markup('<div class="answer {}"><h2>{}</h2>').format(grade, title)]
    if base is not None:
        html.append(paragraph(f"Every state is compared with the baseline {_title(document, base['test'])} ({base['chosen']})."))
    html.append(_items(said[:8]))
    if len(said) > 8:
        html.append(paragraph(f"{len(said) - 8} more below."))
    html.append(Markup("</div>"))
    if failed:
        rows = [[_link(document, r), tag(*STATE_WORDS[r["state"]]), esc(r["reason"] or DASH)] for r in failed]
        html.append(
            table(
                ["Test", "State", "Reason"],
                rows,
                title="Tests that failed, whole or in part.",
                caption=" The next call tries those that failed whole again.",
                wide=True,
            )
        )
    if out:
        rows = [[_link(document, r), Markup("<br>").join(esc(t) for t in r["stands_out"]), _own_findings(r, tests)] for r in out]
        head = ["Test", "What stands out", "What its own data show that few others do"]
        html.append(Markup("<h3>Tests that stand out</h3>") + table(head, rows, wide=True))
    elif len(tests) < 7:
        html.append(paragraph("Whether single tests stand out is decided from seven tests on."))
    return Markup("").join(html)


def _own_findings(row: Mapping[str, Any], tests: Sequence[Mapping[str, Any]]) -> str:
    """Findings of kinds that fewer than a fifth of the tests have."""
    rare = [f for f in row["findings"] if sum(any(g["kind"] == f["kind"] for g in r["findings"]) for r in tests) < max(2, len(tests) / 5)]
    return Markup("<br>").join(esc(f["message"]) for f in rare[:4]) or DASH


def _title(document: Mapping[str, Any], name: str) -> str:
    row = next(r for r in document["tests"] if r["name"] == name)
    return f"test {row['number']} ({row['title']})"


def _link(document: Mapping[str, Any], row: Mapping[str, Any]) -> str:
    """Number and name of a test, linked to its own report, or to its folder where the campaign ends before the report."""
    text = esc(f"{row['number']}. {row['title']}")
    file = "report.html" if document["until"] in (None, "report") else ""
    return text if row["state"] == "failed" else Markup(f'<a href="{quote(row["results"])}/{file}">{text}</a>')


def _modes(document: Mapping[str, Any], numbering: Numbering, kind: str) -> Markup:
    part = document[kind]
    if not part["tracks"]:
        return missing(f"No test has modes {KIND_WORDS[kind].lower()}.")
    if part.get("same_everywhere"):
        return paragraph("All tests share one idle measurement, and so its modes.") + _track_table(part)
    over, base = document["over"]["label"], _places(document).get((document["baseline"] or {}).get("test", ""))
    often = sorted(part["tracks"], key=lambda t: -t["seen"])
    tracks = sorted(often[:MOST_TRACKS], key=lambda t: t["track"])
    out = []
    if len(often) > MOST_TRACKS:
        out.append(
            paragraph(f"Drawn are the {MOST_TRACKS} of {len(often)} modes that most tests show; the table and campaign.csv hold all.")
        )
    followed = "Modes are followed from test to test by MAC and frequency; bars are 95 % intervals"
    out.append(
        numbering.figure(figures.mode_figure(tracks, figures.frequency, over, "Frequency [Hz]", baseline=base), f"Frequency. {followed}.")
    )
    out.append(numbering.figure(figures.mode_figure(tracks, figures.damping, over, "Damping [%]", True, base), "Damping ratio."))
    if any(p.get("scale") is not None for t in tracks for p in t["points"]):
        caption = "Scale of the operational shapes: what each is multiplied by for unit modal mass."
        out.append(numbering.figure(figures.mode_figure(tracks, figures.scale, over, "Scale", True, base), caption))
    for title, found in (("Crossings", part["crossings"]), ("Steps", part["steps"])):
        if found:
            out += [Markup("<h3>{}</h3>").format(title), _items([item["words"][:1].upper() + item["words"][1:] for item in found[:40]])]
            out += [paragraph(f"{len(found) - 40} more in campaign.json.")] if len(found) > 40 else []
    return Markup("").join(out) + _track_table(part)


def _items(texts: Sequence[str]) -> Markup:
    """Sentences as a list."""
    return Markup("<ul>{}</ul>").format(Markup("").join(Markup("<li>{}.</li>").format(shown(text)) for text in texts))


def _track_table(part: Mapping[str, Any]) -> Markup:
    rows = []
    for t in part["tracks"]:
        points = t["points"]
        hz, ratio = [p["frequency_hz"] for p in points], [100 * p["damping_ratio"] for p in points]
        known = [p for p in points if p["change_percent"] is not None]
        base = next((p for p in known if p["change_percent"] == 0 and p["mac_baseline"] is not None), None)
        far = max(known, key=lambda p: abs(p["change_percent"]), default=None)
        macs = [p["mac_baseline"] for p in points if p["mac_baseline"] is not None]
        rows.append([
            str(t["track"]), str(t["seen"]),
            DASH if base is None else plus_minus(base["frequency_hz"], base["frequency_std_hz"]),
            f"{number(min(hz), 4)} … {number(max(hz), 4)}", f"{number(min(ratio), 3)} … {number(max(ratio), 3)}",
            DASH if far is None else fixed(far["change_percent"], 2, sign=True), DASH if far is None else esc(far["test"]),
            fixed(min(macs), 3) if macs else DASH,
        ])  # fmt: skip
    head = [
        "Mode",
        "Seen in tests",
        "Baseline [Hz]",
        "Frequency [Hz]",
        "Damping [%]",
        "Largest change [%]",
        "in test",
        "Least MAC with baseline",
    ]
    caption = " Numbers count from 0, by frequency in the baseline; ± is the 95 % interval."
    modes = table(head, rows[:60], numeric=(0, 1, 2, 3, 4, 5, 7), title="Modes.", caption=caption, wide=True)
    return modes + (paragraph(f"{len(rows) - 60} more in campaign.csv.") if len(rows) > 60 else "")


def _places(document: Mapping[str, Any]) -> dict[str, float]:
    return {r["name"]: r["place"] for r in document["tests"] if r["place"] is not None}


def _errors(document: Mapping[str, Any], numbering: Numbering) -> Markup:
    places = _places(document)
    series: dict[str, list[tuple[float, float]]] = {}
    for key, words in MODEL_WORDS.items():
        found = [(places[r["name"]], (r["errors"].get(key) or {}).get("error_db")) for r in document["tests"] if r["name"] in places]
        points = sorted((x, float(y)) for x, y in found if y is not None)
        if points:
            series[words] = points
    if not series:
        return missing("No test has a validation measurement ([check]) to compare operational FRFs with.")
    caption = "Error (rms, dB) of the models on the validation measurement of each test."
    return numbering.figure(figures.error_figure(series, document["over"]["label"]), caption)


def _effects(document: Mapping[str, Any], numbering: Numbering) -> Markup:
    told = [r for r in document["tests"] if (r["diagnosis"] or {}).get("verdict")]
    if not told:
        return missing("No test was diagnosed: that needs idle modes, and modes or a validation measurement in operation.")
    effects, places = document["effects"], _places(document)
    verdicts: dict[str, int] = {}
    for r in told:
        verdicts[r["diagnosis"]["verdict"]] = verdicts.get(r["diagnosis"]["verdict"], 0) + 1
    out = [paragraph("Verdicts: " + listing([f"{n} × {v.replace('_', ' ')}" for v, n in verdicts.items()]) + ".")]
    if not effects:
        return Markup("").join([*out, paragraph("No effect is missing in any of them.")])
    by_effect: dict[str, set[str]] = {}
    for e in effects:
        if e["what"] != "is gone":
            by_effect.setdefault(e["label"], set()).update(e["tests"])
    names = list(by_effect)[:MOST_EFFECTS]
    diagnosed = {r["name"]: places[r["name"]] for r in told if r["name"] in places}
    rows = []
    for name in names:
        shown = [place for test, place in diagnosed.items() if test in by_effect[name]]
        rows.append((name, shown, [place for test, place in diagnosed.items() if test not in by_effect[name]]))
    if rows:
        caption = "Effects missing in the idle model: full where the diagnosis of a test finds it, empty where it does not."
        out.append(numbering.figure(figures.effect_figure(rows, document["over"]["label"], list(places.values())), caption))
    cells = [[esc(e["words"]), esc(e["label"]), esc(e["size"] or DASH), str(len(e["tests"]))] for e in effects]
    head = ["Against the baseline", "Effect", "Size (95 %)", "Tests"]
    more = paragraph(f"{len(cells) - 80} more in campaign.json.") if len(cells) > 80 else Markup()
    return Markup("").join(out) + table(head, cells[:80], numeric=(3,), wide=True) + more


def _tests(document: Mapping[str, Any], numbering: Numbering) -> Markup:
    rows = []
    for r in document["tests"]:
        errors, verdict = r["errors"], (r["diagnosis"] or {}).get("verdict")
        idle = (errors.get("idle") or {}).get("error_db")
        best = min((e["error_db"] for k in ("ofrf", "effect") if (e := errors.get(k)) and e.get("error_db") is not None), default=None)
        rows.append([
            _link(document, r), tag(*STATE_WORDS[r["state"]]), esc(r["scaling"] or DASH), decibel(idle), decibel(best),
            tag(verdict.replace("_", " "), VERDICT_GRADES.get(verdict, "fair")) if verdict else DASH,
            Markup("<br>").join(esc(m) for m in r["missing"][:4]) or DASH, DASH if r["seconds"] is None else f"{r['seconds']:.1f}",
        ])  # fmt: skip
    head = ["Test", "State", "Scaling", "Error of idle model", "Error of operational FRFs", "Verdict", "Missing in the idle model", "s"]
    base = (document["baseline"] or {}).get("test")
    mine = [i for i, r in enumerate(document["tests"]) if r["name"] == base]
    caption = ", each linked to its own results; the baseline is set off."
    return table(head, rows, numeric=(3, 4, 7), title="All tests", caption=caption, wide=True, mine=mine)


def _how(document: Mapping[str, Any], numbering: Numbering) -> Markup:
    counts = document["counts"]
    text = (
        f"{counts['run']} tests were run by the last call, {counts['unchanged']} had not changed since an earlier one; "
        f"{counts['seconds']:.0f} s, {counts['work_seconds']:.0f} s of them in tests."
    )
    rules = (
        "A mode belongs to the one before where their MAC is above 0.5 and their frequencies differ by less than 30 %; of several the "
        "best of MAC weighted by nearness in frequency is taken. A crossing is named where two modes change order by more than their "
        "95 % intervals. A value stands out where it differs from the running median of five tests by more than five times the usual "
        "scatter; the first and last two tests are left out. A step is a change between two tests beyond five times the usual scatter "
        "of changes. An effect counts as another than the baseline's where the diagnosis of one has it and that of the other has not."
    )
    return (
        paragraph(text)
        + paragraph(rules)
        + paragraph("campaign.csv holds one row a mode of a test; campaign.json everything on this page.")
    )
