"""The document of a campaign: tests, tracked modes, effects against the baseline, what stands out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from operando.campaign.changes import Stretch, outliers, size_change, steps, stretches, told
from operando.campaign.config import Campaign, Member
from operando.campaign.parameters import Axis, axis_of, shown
from operando.campaign.tracks import Track, crossings, follow
from operando.indicators import INTERVAL
from operando.jsonable import jsonable
from operando.printable import first_few
from operando.report.words_diagnosis import effect_words

SCHEMA = "operando/campaign/1"
OFTEN = 0.8
"""Share of the states that show a mode from which its absence in one is said."""

Reader = Callable[[Sequence[Member]], Iterable[dict[str, Any]]]


def document_of(campaign: Campaign, read: Reader, counts: Mapping[str, Any]) -> dict[str, Any]:
    """The document ``operando/campaign/1`` with the counts of what the call did.

    ``read`` gives the records of members one by one; it is called several times, so that the shapes of few states are held at once.
    """
    members = list(campaign.members)
    rows = [_row(campaign, member, record) for member, record in zip(members, read(members), strict=True)]
    usable = [i for i, row in enumerate(rows) if row["state"] != "failed"]
    axis = axis_of(campaign.over, [members[i].row.parameters for i in usable], campaign.units)
    order = sorted(range(len(usable)), key=lambda k: (axis.places[k], usable[k]))
    states = [usable[k] for k in order]
    places = [axis.places[k] for k in order]
    if axis.kind == "order":
        places = [float(members[i].number) for i in states]
    for place, i in zip(places, states, strict=True):
        rows[i]["place"] = place
    base, chosen = _baseline(campaign, rows, states)
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "name": campaign.name,
        "parameters": [{"name": name, "unit": campaign.units.get(name)} for name in campaign.columns],
        "over": {"name": campaign.over if axis.kind != "order" else None, "label": axis.label, "kind": axis.kind},
        "until": campaign.until,
        "baseline": None if base is None else {"test": rows[states[base]]["name"], "chosen": chosen},
        "counts": {s: sum(row["state"] == s for row in rows) for s in ("done", "incomplete", "failed")} | dict(counts),
        "tests": rows,
    }
    named = [members[i] for i in states]
    tell = _Teller(rows, states, places, campaign, axis)
    for kind in ("idle", "operating"):
        modes = lambda kind=kind: (record.get(kind) or [] for record in read(named))  # noqa: E731
        tracks = follow(modes(), modes(), -1 if base is None else base)
        document[kind] = _mode_part(tracks, places, base, tell, kind)
    if _same_everywhere(document["idle"], len(states)):
        document["idle"]["same_everywhere"] = True
    _add_scale(document["operating"], rows)
    document["effects"] = [] if base is None else [tell.stretch(s, base) for s in stretches([rows[i]["diagnosis"] for i in states], base)]
    _add_error_outliers(tell)
    for row in rows:
        row.pop("pairing", None)
    plain: dict[str, Any] = jsonable(document)
    return plain


def _row(campaign: Campaign, member: Member, record: Mapping[str, Any]) -> dict[str, Any]:
    """A test without its modes."""
    diagnosis = record.get("diagnosis")
    return {
        "number": member.number,
        "name": member.name,
        "title": campaign.title(member),
        "parameters": dict(member.row.parameters),
        "place": None,
        "test": str(member.path),
        "state": record["state"],
        "reason": record.get("reason"),
        "left_out": record.get("left_out") or {},
        "results": f"tests/{member.name}",
        "seconds": record.get("seconds"),
        "cpu_seconds": record.get("cpu_seconds"),
        "scaling": record.get("scaling"),
        "errors": record.get("errors") or {},
        "diagnosis": diagnosis,
        "missing": [_effect_text(e) for e in (diagnosis or {}).get("effects") or []],
        "findings": record.get("findings") or [],
        "stands_out": [],
        "pairing": record.get("pairing") or [],
    }


def _effect_text(effect: Mapping[str, Any]) -> str:
    words = effect_words(effect)
    return f"{words.label}, {words.size}" if words.size else words.label


def _baseline(campaign: Campaign, rows: Sequence[Mapping[str, Any]], states: Sequence[int]) -> tuple[int | None, str]:
    """Place of the baseline among the states, and how it was chosen."""
    chosen = "named in the campaign file" if campaign.baseline_given else "the first test; baseline in the campaign file names another"
    for place, i in enumerate(states):
        if rows[i]["name"] == campaign.baseline:
            return place, chosen
    if not states:
        return None, "no test could be used"
    first = min(range(len(states)), key=lambda place: states[place])
    return first, f"the first test that could be used: {campaign.baseline}, {chosen.split(';')[0]}, failed"


class _Teller:
    """Puts states into words."""

    def __init__(self, rows: list[dict[str, Any]], states: Sequence[int], places: Sequence[float], campaign: Campaign, axis: Axis) -> None:
        self.rows, self.states, self.places, self.axis = rows, states, places, axis
        self._campaign = campaign

    def place(self, value: float) -> str:
        """A place on the axis: ``speed 1430 rpm``."""
        rounded = float(f"{value:.4g}")
        if self.axis.kind == "number" and self._campaign.over is not None:
            return shown(self._campaign.over, rounded, self._campaign.units)
        return f"{self.axis.label} {rounded:g}"

    def row(self, state: int) -> dict[str, Any]:
        """The test of a state."""
        return self.rows[self.states[state]]

    def test(self, state: int) -> str:
        """``test 23 (speed 2300 rpm)``."""
        row = self.row(state)
        return f"test {row['number']} ({row['title']})"

    def span(self, states: Sequence[int], open_: bool) -> str:
        """States in words."""
        if len(states) == 1:
            return f"in {self.test(states[0])}" + ("" if open_ and states[0] == len(self.states) - 1 else " alone")
        if open_:
            return f"from {self.test(states[0])} on"
        return f"from {self.test(states[0])} to {self.test(states[-1])}"

    def stretch(self, s: Stretch, base: int) -> dict[str, Any]:
        """An effect against the baseline."""
        words = effect_words(s.effect)
        size = size_change(s.effect, s.last)
        what = f"{words.label}" + (f", {size}" if size else "")
        first = f"{self.span(s.states, s.open)}: "
        if s.what == "appears":
            known = told(self.row(base)["diagnosis"])
            text = f"{first}{what}, is missing in the idle model; " + (
                "it is not in the baseline" if known else "the baseline is not diagnosed"
            )
        elif s.what == "is gone":
            text = f"{first}{what}, which the baseline has, is gone"
        elif s.what == "everywhere":
            diagnosed = sum(told(self.row(i)["diagnosis"]) for i in range(len(self.states)))
            text = f"in {len(s.states)} of {diagnosed} diagnosed tests, the baseline among them: {what}, is missing in the idle model"
        else:
            named = first_few((self.row(i)["number"] for i in s.states), 12)
            text = f"in {len(s.states)} tests, not in one stretch (tests {named}): {what}"
        return {
            "what": s.what,
            "kind": s.effect.get("kind"),
            "location": s.effect.get("location") or [],
            "label": words.label,
            "size": size,
            "first": self.row(s.states[0])["name"],
            "last": self.row(s.states[-1])["name"],
            "lasts": s.open,
            "tests": [self.row(i)["name"] for i in s.states],
            "words": text[:1].upper() + text[1:],
        }


def _mode_part(tracks: Sequence[Track], places: Sequence[float], base: int | None, tell: _Teller, kind: str) -> dict[str, Any]:
    out, found_steps = [], []
    for track in tracks:
        reference = None if base is None else track.by_state.get(base)
        points = []
        for p in track.points:
            change = significant = None
            if reference is not None:
                change = 100 * (p.frequency_hz / reference.frequency_hz - 1)
                spread = INTERVAL * float(np.hypot(p.frequency_std_hz or 0.0, reference.frequency_std_hz or 0.0))
                significant = abs(p.frequency_hz - reference.frequency_hz) > spread
            points.append(
                {
                    "test": tell.row(p.state)["name"],
                    "place": places[p.state],
                    "mode": p.mode,
                    "frequency_hz": p.frequency_hz,
                    "frequency_std_hz": p.frequency_std_hz,
                    "damping_ratio": p.damping_ratio,
                    "damping_ratio_std": p.damping_ratio_std,
                    "mac_before": p.mac_before,
                    "mac_baseline": p.mac_baseline,
                    "change_percent": change,
                    "changed": significant,
                }
            )
        out.append({"track": track.number, "seen": len(points), "points": points})
        found_steps += _steps_at(track, places, tell, kind)
    cross = [
        {
            "tracks": [c.first, c.second],
            "between": [tell.row(c.after)["name"], tell.row(c.before)["name"]],
            "place": c.place,
            "frequency_hz": c.frequency_hz,
            "words": f"modes {c.first} and {c.second} cross near {tell.place(c.place)}, at {c.frequency_hz:.4g} Hz, "
            f"between {tell.test(c.after)} and {tell.test(c.before)}",
        }
        for c in crossings(tracks, places)
    ]
    return {"tracks": out, "crossings": cross, "steps": found_steps}


def _steps_at(track: Track, places: Sequence[float], tell: _Teller, kind: str) -> list[dict[str, Any]]:
    """Steps of a mode's frequency; values that stand out go to their tests."""
    states = [p.state for p in track.points]
    hz, ratio = [p.frequency_hz for p in track.points], [p.damping_ratio for p in track.points]
    hz_std = [p.frequency_std_hz for p in track.points]
    alone = outliers(hz, hz_std)
    name = f"{'operational' if kind == 'operating' else kind} mode {track.number}"
    for i in alone:
        tell.row(states[i])["stands_out"].append(f"{name}: {hz[i]:.5g} Hz, between {hz[i - 1]:.5g} and {hz[i + 1]:.5g} Hz beside it")
    for i in outliers(ratio, [p.damping_ratio_std for p in track.points]):
        beside = f"between {100 * ratio[i - 1]:.3g} and {100 * ratio[i + 1]:.3g} %"
        tell.row(states[i])["stands_out"].append(f"{name}: damping {100 * ratio[i]:.3g} %, {beside} beside it")
    if OFTEN * len(tell.states) <= len(states) < len(tell.states):
        for state in sorted(set(range(len(tell.states))) - set(states)):
            tell.row(state)["stands_out"].append(f"{name} (near {np.median(hz):.4g} Hz) is not seen")
    out = []
    for i, j in steps(hz, hz_std, [places[s] for s in states], alone):
        change = f"{100 * (hz[j] / hz[i] - 1):+.2f} %".replace("-", "−")
        text = f"{name} goes from {hz[i]:.5g} to {hz[j]:.5g} Hz ({change}) from {tell.test(states[i])} to {tell.test(states[j])}"
        out.append({"track": track.number, "between": [tell.row(states[i])["name"], tell.row(states[j])["name"]], "words": text})
    return out


def _same_everywhere(part: Mapping[str, Any], states: int) -> bool:
    """Whether all states have the very same modes: they share the measurement."""
    return states > 1 and all(
        t["seen"] == states and len({p["frequency_hz"] for p in t["points"]}) == 1 for t in part["tracks"]
    )  # fmt: skip


def _add_scale(part: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Scale, its relative deviation and class of each operational mode from the pairing of its test."""
    pairing = {(row["name"], p["operating"]): p for row in rows for p in row["pairing"]}
    for track in part["tracks"]:
        for point in track["points"]:
            pair = pairing.get((point["test"], point["mode"])) or {}
            scale = pair.get("scale")
            point["scale"] = None if scale is None else float(np.hypot(*scale))
            point["scale_std"] = pair.get("scale_std")
            point["class"] = pair.get("class")


def _add_error_outliers(tell: _Teller) -> None:
    """Tests whose operational FRFs are further off than those beside them."""
    for model, name in (("ofrf", "operational FRFs"), ("effect", "operational FRFs of idle model and effects")):
        have = [i for i in range(len(tell.states)) if (tell.row(i)["errors"].get(model) or {}).get("error_db") is not None]
        errors = [float(tell.row(i)["errors"][model]["error_db"]) for i in have]
        for k in outliers(errors, [None] * len(errors)):
            if errors[k] > max(errors[k - 1], errors[k + 1]):
                text = f"{name}: {errors[k]:.2f} dB off, beside it {errors[k - 1]:.2f} and {errors[k + 1]:.2f} dB"
                tell.row(have[k])["stands_out"].append(text)
