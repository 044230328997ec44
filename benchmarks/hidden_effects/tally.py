"""The figures the issue asks for, pooled and by kind, from the rows score.py keeps.

python benchmarks/hidden_effects/tally.py RESULTS.jsonl
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from contacts import NONLINEAR
from hidden import LINEAR, SENSOR

QUIET = ("none", "orders")
DAMPERS = ("ground_damper", "coupling_damper")
SURE = ("cubic_stiffness", "quadratic_damping", "clearance", "one_sided_contact", "saturating_spring")
HARD = ("coulomb_friction", "bilinear_stiffness", "hysteresis")
TENTH = ("cubic_stiffness", "clearance", "one_sided_contact")
ROUTES = ("ground_spring", "point_mass", "coupling_spring", "gyroscopic")


def share(rows: Iterable[dict], test: Callable[[dict], bool]) -> str:
    rows = list(rows)
    count = sum(bool(test(r)) for r in rows)
    return f"{count}/{len(rows)}" + (f" = {100 * count / len(rows):.1f} %" if rows else "")


def report(rows: list[dict]) -> str:
    """All tables as text."""
    failed = [r for r in rows if r.get("exit")]
    parts = [f"{len(rows)} runs, {len(failed)} failed"]
    parts += [f"  FAILED {r['case']}: {r['stderr'].strip()[-200:]}" for r in failed]
    parts.append(identification(rows))
    told = [r for r in rows if r.get("diagnosis")]
    silent = [r for r in rows if not r.get("exit") and not r.get("diagnosis")]
    if silent:
        reasons = sorted({r["no_diagnosis"] for r in silent})
        parts.append(f"No diagnosis in {len(silent)} runs: {'; '.join(reasons)}. They are not in the figures below.")
    aside = sum(r.get("diagnosed_by") == "library" for r in told)
    if aside:
        parts.append(f"{aside} of {len(told)} diagnoses came through the Python interface, not the command line.")
    usual = [r for r in told if not r.get("days") and not r.get("complex")]
    if usual:
        parts += [must_show(usual), level_dependent(usual), by_kind(usual), sizes(usual), routes(usual), wrong(usual)]
    for title, key in (("Two days in a laboratory", "days"), ("Complex modes at rest", "complex")):
        group = [r for r in told if r.get(key)]
        if group:
            parts += [apart(title, group), by_kind(group), sizes(group), routes(group), wrong(group)]
    return "\n\n".join(parts)


def _top(row: dict) -> bool:
    return bool(row["diagnosis"].get("top"))


def _set(row: dict) -> bool:
    return bool(row["diagnosis"].get("in_set"))


def _kinds(row: dict) -> list[str]:
    """Kinds of the effects named."""
    return [e.split("@")[0].split("=")[0] for e in row["diagnosis"]["effects"]]


def _structural(row: dict) -> bool:
    return any(kind not in SENSOR for kind in _kinds(row))


def swallowed(row: dict) -> bool:
    """Whether a pair is called explained although one effect is missing that changes the FRFs by more than twice the noise."""
    shows = row.get("weaker_db") is not None and row.get("noise_db") is not None and row["weaker_db"] > 2 * row["noise_db"]
    return shows and row["diagnosis"]["verdict"] == "explained" and not all(row["diagnosis"]["right"])


def must_show(rows: list[dict]) -> str:
    """Each line of the issue: figure, and what is asked."""
    linear = [r for r in rows if r["kind"] in LINEAR and r["check"]]
    sensor = [r for r in rows if r["kind"] in SENSOR]
    quiet = [r for r in rows if r["kind"] in QUIET]
    blind = [r for r in rows if r["kind"] in LINEAR and not r["check"]]
    one, three = ([r for r in linear if r["references"] == n] for n in (1, 3))
    special = ("unmeasured", "outside", "one_mode", "two", "uneven")
    unmeasured, outside, lonely, two, uneven = ([r for r in rows if r["kind"] == k] for k in special)
    lines = [
        ("linear, 3 references: kind and place at the top", share(three, _top), "95 %"),
        ("linear, 1 reference: kind and place at the top", share(one, _top), "90 %"),
        ("linear: in the ambiguity set", share(linear, _set), "99 %"),
        ("linear: only the hidden effect, no second one", share(linear, lambda r: _top(r) and r["diagnosis"]["extra"] <= 0), ""),
        ("sensor faults: kind and place at the top", share(sensor, _top), "98 %"),
        ("sensor faults named as sensor", share(sensor, lambda r: r["diagnosis"]["named_sensor"]), "100 %"),
        ("nothing hidden: false alarms", share(quiet, lambda r: r["diagnosis"]["false_alarm"]), "at most 2 of 100"),
        ("output-only, no dampers: top", share([r for r in blind if r["kind"] not in DAMPERS], _top), "90 %"),
        ("output-only dampers: top", share([r for r in blind if r["kind"] in DAMPERS], _top), "60 %"),
        ("output-only dampers: in the set", share([r for r in blind if r["kind"] in DAMPERS], _set), "98 %"),
        ("unmeasured place: kind", share(unmeasured, lambda r: r["diagnosis"]["kind_top"]), "90 %"),
        ("unmeasured place: within half a spacing", share(unmeasured, lambda r: r["diagnosis"]["place_top"]), "85 %"),
        ("outside the catalogue: called explained", share(outside, lambda r: r["diagnosis"]["verdict"] == "explained"), "0"),
        (
            "one mode in band: ≥ 2 kinds and a proposed measurement",
            share(lonely, lambda r: len(r["diagnosis"]["kinds_in_set"]) >= 2 and r["diagnosis"]["proposed_measurement"]),
            "100 %",
        ),
        ("two effects: both right", share(two, lambda r: all(r["diagnosis"]["right"])), "80 %"),
        ("uneven pairs: explained, the weaker one (twice the noise) missing", share(uneven, swallowed), "0"),
        ("uneven pairs: both right", share(uneven, lambda r: all(r["diagnosis"]["right"])), ""),
        ("two effects: ladder monotone", share(two, lambda r: r["diagnosis"]["monotone"]), "100 %"),
    ]
    times = [r["timings_s"]["diagnose"] for r in rows if r.get("timings_s", {}).get("diagnose") is not None and r["check"]]
    blind_times = [r["timings_s"]["diagnose"] for r in rows if r.get("timings_s", {}).get("diagnose") is not None and not r["check"]]
    for name, seconds, wanted in (("with check", times, "5 s"), ("output-only", blind_times, "20 s")):
        if seconds:
            lines.append((f"diagnosis, {name}: median, worst", f"{np.median(seconds):.1f}, {np.max(seconds):.1f} s", wanted))
    return "Must show\n" + "\n".join(f"  {name:58s} {value:>22s}   asked: {wanted}" for name, value, wanted in lines)


def level_dependent(rows: list[dict]) -> str:
    """What is asked of the kinds that depend on the level, and that no such kind is named where there is none."""
    own = [r for r in rows if r["kind"] in NONLINEAR]
    others = [r for r in rows if r["kind"] not in NONLINEAR]
    named = lambda r: any(kind in NONLINEAR for kind in _kinds(r))  # noqa: E731
    sure, hard, quintic = ([r for r in own if r["kind"] in kinds] for kinds in (SURE, HARD, ("quintic",)))
    lines = [
        ("cubic, quadratic damping, clearance, contact, saturating", share(sure, _top), "90 %"),
        ("Coulomb, bilinear, hysteresis", share(hard, _top), "75 %"),
        ("quadratic stiffness", share([r for r in own if r["kind"] == "quadratic_stiffness"], _top), ""),
        ("of all: at a DOF", share([r for r in own if r["kind"] != "quintic" and len(r["truth"][0]["location"]) == 1], _top), ""),
        ("of all: between two", share([r for r in own if r["kind"] != "quintic" and len(r["truth"][0]["location"]) == 2], _top), ""),
        ("only the hidden effect, no second one", share([r for r in own if _top(r)], lambda r: r["diagnosis"]["extra"] <= 0), ""),
        ("quintic: place", share(quintic, lambda r: r["diagnosis"].get("place_top")), "80 %"),
        ("quintic: partial or unexplained", share(quintic, lambda r: r["diagnosis"]["verdict"] in ("partial", "unexplained")), "80 %"),
        ("none or linear: a level-dependent kind named", share(others, named), "none of 40"),
    ]
    right = [r for r in own if _top(r)]
    for title, kinds, name, asked in (
        ("size, cubic and contacts", TENTH, None, "10 % median"),
        ("size, the others", tuple(k for k in NONLINEAR if k not in TENTH), None, "5 % median"),
        ("gap", NONLINEAR, "gap", "5 % median"),
    ):
        found = [s for r in right if r["kind"] in kinds for s in r["diagnosis"]["sizes"]]
        values = 100 * np.abs([s["error"] for s in found if (s["primary"] if name is None else s["name"] == name)])
        if values.size:
            lines.append((title, f"{np.median(values):.2f} %, worst {values.max():.1f}", asked))
    floor = [10 * np.log10(r["diagnosis"]["heldout"][-1]) for r in right if r["diagnosis"]["heldout"]]
    if floor:
        lines.append(
            ("residual of the judge records over the floor: median", f"{np.median(floor):.1f} dB, worst {np.max(floor):.1f}", "3 dB")
        )
        lines.append(("  within 3 dB", f"{sum(f <= 3 for f in floor)}/{len(floor)}", "all"))
    looped = [r["diagnosis"] for r in right if r["diagnosis"].get("closed_loop_gain_db") is not None]
    gains, shows = [d["closed_loop_gain_db"] for d in looped], [10 * np.log10(d["heldout"][0]) for d in looped]
    if gains:
        lines.append(("closed-loop gain: median, least", f"{np.median(gains):.1f} dB, {np.min(gains):.1f}", "8 dB"))
        lines.append(("  8 dB or more", f"{sum(g >= 8 for g in gains)}/{len(gains)}", "all"))
        # Where the judge records hardly show the effect there is no more to gain than that.
        seen = [g for g, shown in zip(gains, shows, strict=True) if shown > 11]
        lines.append(("  of those whose judge records show it by 11 dB over the floor", f"{sum(g >= 8 for g in seen)}/{len(seen)}", "all"))
    return "Level-dependent\n" + "\n".join(f"  {name:58s} {value:>22s}   asked: {wanted}" for name, value, wanted in lines)


def apart(title: str, rows: list[dict]) -> str:
    """Cases whose structure at rest is not quite the one that runs, or is not quite of the model's form: what is found, what is made up."""
    hidden, quiet = [r for r in rows if r["truth"]], [r for r in rows if not r["truth"]]
    one, two = ([r for r in hidden if (len(r["truth"]) == 1) == single] for single in (True, False))
    lines = []
    for name, some in (
        ("3 references", [r for r in one if r["references"] == 3]),
        ("1 reference", [r for r in one if r["references"] == 1]),
    ):
        lines.append((f"one effect, {name}: kind and place at the top", share(some, _top)))
    beside = [len(r["diagnosis"]["effects"]) - sum(r["diagnosis"]["right"]) for r in one]
    first = [s for r in one for s in r["diagnosis"]["sizes"] if s["primary"]]
    known = [s for s in first if s["z"] is not None]
    lines += [
        ("one effect: right at any rank", share(one, lambda r: all(r["diagnosis"]["right"]))),
        ("one effect: in the ambiguity set", share(one, _set)),
        ("one effect: none named beside it", f"{sum(b == 0 for b in beside)}/{len(beside)}, {sum(beside)} in all"),
        ("one effect: size inside its 95 % interval", f"{sum(abs(s['z']) < 1.96 for s in known)}/{len(known)}"),
    ]
    for name, kinds in (("dampers", (*DAMPERS, "global_damping")), ("other kinds", tuple(k for k in LINEAR if "damp" not in k))):
        errors = np.abs([s["error"] for s in first if s["kind"] in kinds])
        if errors.size:
            lines.append((f"one effect: size error of {name}", f"{errors.size}: {spread(errors, 100)}"))
    if two:
        lines.append(("two effects: both right", share(two, lambda r: all(r["diagnosis"]["right"]))))
    lines += [
        ("nothing hidden: structural effects named", share(quiet, _structural)),
        ("nothing hidden: sensor or force effects named", share(quiet, lambda r: any(kind in SENSOR for kind in _kinds(r)))),
        ("nothing hidden: anything but no_misfit", share(quiet, lambda r: r["diagnosis"]["false_alarm"])),
    ]
    changes = [r["between_db"] for r in rows if r.get("between_db") is not None]
    if changes:
        lines.append(("change of the FRFs by the days alone, rms: median", f"{np.median(changes):.1f} dB"))
    return f"{title} ({len(rows)} runs)\n" + "\n".join(f"  {name:58s} {value:>22s}" for name, value in lines)


def by_kind(rows: list[dict]) -> str:
    """Counts by kind, with and without check."""
    out = [f"  {'kind':32s}{'runs':>5s}{'top':>6s}{'place':>6s}{'kind':>6s}{'set':>6s}  verdicts"]
    for check in (True, False):
        for kind in sorted({r["kind"] for r in rows if r["check"] == check}):
            some = [r["diagnosis"] for r in rows if r["kind"] == kind and r["check"] == check]
            verdicts = {v: sum(d["verdict"] == v for d in some) for v in sorted({d["verdict"] for d in some})}
            counts = [sum(bool(d.get(k)) for d in some) for k in ("top", "place_top", "kind_top", "in_set")]
            name = kind if check else f"{kind} (output-only)"
            out.append(
                f"  {name:32s}{len(some):5d}"
                + "".join(f"{c:6d}" for c in counts)
                + "  "
                + ", ".join(f"{v} {n}" for v, n in verdicts.items())
            )
    return "By kind\n" + "\n".join(out)


def sizes(rows: list[dict]) -> str:
    """Errors of the sizes found, coverage of their intervals and their width over the scatter, where kind and place were right."""
    out = []
    for title, chosen in (
        ("linear with check", [r for r in rows if r["kind"] in LINEAR and r["check"]]),
        ("sensor", [r for r in rows if r["kind"] in SENSOR]),
        ("output-only", [r for r in rows if r["kind"] in LINEAR and not r["check"]]),
    ):
        every = [s for r in chosen for s in r["diagnosis"].get("sizes", [])]
        errors = np.abs([s["error"] for s in every if s["primary"]])
        if errors.size:
            out.append(f"  {title:22s} n {errors.size:4d}  {spread(errors, 95)}  {coverage(every)}")
    kinds = sorted({s["kind"] for r in rows for s in r["diagnosis"].get("sizes", [])})
    for kind in kinds:
        some = [s for r in rows if r["check"] for s in r["diagnosis"].get("sizes", []) if s["kind"] == kind]
        for name in sorted({s["name"] for s in some}):
            part = [s for s in some if s["name"] == name]
            errors = np.abs([s["error"] for s in part])
            out.append(f"    {kind + ' ' + name:38s} n {errors.size:4d}  {spread(errors, 100)}  {coverage(part)}")
    asked = "asked for linear kinds: 2 % median, 6 % at the 95th; 95 % intervals cover 90–98 %, width ≤ 1.5 × scatter"
    return f"Sizes ({asked})\n" + "\n".join(out)


def spread(errors: np.ndarray, upper: int) -> str:
    """Median and an upper percentile of relative errors, in percent."""
    name = "worst" if upper == 100 else f"{upper}th"
    return f"median {100 * np.median(errors):7.2f} %  {name} {100 * np.percentile(errors, upper):7.2f} %"


def coverage(some: list[dict]) -> str:
    z = np.array([s["z"] for s in some if s["z"] is not None])
    if not z.size:
        return "no intervals"
    scatter = 1.4826 * np.median(np.abs(z))
    return f"covered {100 * np.mean(np.abs(z) < 1.96):.0f} % of {z.size}, width/scatter {1 / max(scatter, 1e-12):.2f}"


def routes(rows: list[dict]) -> str:
    """Errors of the OFRFs against the exact ones, on the reference columns."""
    out = []
    for route in ("hybrid", "effect"):
        values = np.array([r["ofrf_db"][route]["references"] for r in rows if route in r.get("ofrf_db", {})])
        if values.size:
            out.append(f"  {route:8s} n {values.size:4d}  median {np.median(values):.2f} dB  worst {values.max():.2f}")
    for kind in ROUTES:
        both = [r["ofrf_db"] for r in rows if r["kind"] == kind and len(r.get("ofrf_db", {})) == 2]
        if both:
            effect, hybrid = (np.median([b[k]["references"] for b in both]) for k in ("effect", "hybrid"))
            out.append(f"    {kind:24s} n {len(both):3d}  effect {effect:.2f} dB, hybrid {hybrid:.2f} dB (asked: at most half)")
    return "OFRF error on the reference columns (asked of the effect route: 0.3 dB median, 0.7 dB worst)\n" + "\n".join(out)


def wrong(rows: list[dict]) -> str:
    """Every run whose answer was not right, to be looked at."""
    out = []
    for r in rows:
        d = r["diagnosis"]
        bad = (
            d["false_alarm"]
            if r["kind"] in QUIET
            else d["verdict"] == "explained"
            if r["kind"] == "outside"
            else r["kind"] != "one_mode" and not all(d.get("right", [True]))
        )
        if bad:
            true = " + ".join(t["kind"] + "@" + ",".join(t["location"]) for t in r["truth"]) or "nothing"
            found = " + ".join(d["effects"]) or f"(first candidate {d['candidate']})"
            change = "" if r["change_db"] is None else f" ({r['change_db']:.1f} dB)"
            out.append(f"  {r['case']}: {true}{change}; {d['verdict']}: {found}" + (" [in the set]" if d.get("in_set") else ""))
    return f"Not right ({len(out)})\n" + "\n".join(out)


# Identification


def identification(rows: list[dict]) -> str:
    """Modes found, errors, intervals, misfits and times."""
    known = [r for r in rows if r.get("identification")]
    out = []
    for state in ("idle", "operating"):
        found = [r["identification"][state] for r in known if state in r["identification"]]
        pairs = [p for f in found for p in f["pairs"]]
        missed, spurious = sum(len(f["missed"]) for f in found), sum(len(f["spurious"]) for f in found)
        out.append(f"  {state}: {len(pairs)} modes found of {len(pairs) + missed}, {spurious} spurious, in {len(found)} runs")
        for key, title in (("f_error", "frequency"), ("zeta_error", "damping"), ("mass_error", "modal mass"), ("shape_error", "shape")):
            values = 100 * np.abs([p[key] for p in pairs if key in p])
            if values.size:
                middle, most, worst = np.percentile(values, (50, 95, 100))
                out.append(f"    {title:12s} error in %: median {middle:.4f}, 95th {most:.3f}, worst {worst:.2f}")
        for key, title in (("f_z", "frequency"), ("zeta_z", "damping")):
            z = np.abs([p[key] for p in pairs if p.get(key) is not None])
            if z.size:
                out.append(f"    {title:12s} within 2 stated std: {100 * np.mean(z < 2):.0f} % (95 % expected), largest {z.max():.1f} std")
        within = [p["shape_within"] for p in pairs if "shape_within" in p]
        if within:
            out.append(f"    {'shape':12s} within 2 stated std: {100 * np.mean(within):.0f} %, worst mode {100 * np.min(within):.0f} %")
    misfits = np.array([r["identification"]["misfit"] for r in known if r["identification"]["misfit"]])
    if misfits.size:
        high = int(np.sum(misfits > 1.5))
        out.append(f"  idle misfit: median {np.median(misfits):.3f}, worst {misfits.max():.2f}, above 1.5 in {high} of {misfits.size}")
    orders = [r["identification"]["orders"] for r in known if "orders" in r["identification"]]
    hidden = sum(len(o["hidden"]) for o in orders)
    out.append(
        f"  rotor orders: {hidden} hidden, {sum(len(o['missed']) for o in orders)} missed, {sum(len(o['false']) for o in orders)} false, "
        f"{sum(len(o['taken_for_modes']) for o in orders)} taken for modes"
    )
    seconds = np.array([r["seconds"] for r in known if "seconds" in r])
    if seconds.size:
        out.append(f"  time a run: median {np.median(seconds):.1f} s, worst {seconds.max():.1f} s")
    for r in known:
        notes = _defects(r)
        if notes:
            out.append(f"    {r['case']}: " + "; ".join(notes))
    return f"Identification ({len(known)} runs)\n" + "\n".join(out)


def _defects(row: dict) -> list[str]:
    found = row["identification"]
    notes = []
    if found["misfit"] and found["misfit"] > 1.5:
        notes.append(f"idle misfit {found['misfit']:.2f}")
    for state in ("idle", "operating"):
        if state not in found:
            notes.append(f"no {state} model")
            continue
        if found[state]["missed"]:
            notes.append(f"{state} modes missed {found[state]['missed']}")
        if found[state]["spurious"]:
            notes.append(f"{state} modes spurious {found[state]['spurious']}")
        far = [
            f"{p['hz']:.1f} Hz ({key[:-2]} {p[key]:+.1f} std)"
            for p in found[state]["pairs"]
            for key in ("f_z", "zeta_z")
            if p.get(key) and abs(p[key]) > 4
        ]
        heavy = [f"{p['hz']:.1f} Hz {100 * p['mass_error']:+.1f} %" for p in found[state]["pairs"] if abs(p.get("mass_error", 0)) > 0.05]
        if heavy:
            notes.append(f"modal mass off: {', '.join(heavy)}")
        narrow = [f"{p['hz']:.1f} Hz {100 * p['shape_within']:.0f} %" for p in found[state]["pairs"] if p.get("shape_within", 1) < 0.6]
        if narrow:
            notes.append(f"shape entries within 2 std: {', '.join(narrow)}")
        if far:
            notes.append(f"{state} intervals missed: {', '.join(far)}")
    if "orders" in found:
        notes += [f"orders {k} {found['orders'][k]}" for k in ("missed", "false", "taken_for_modes") if found["orders"][k]]
    return notes


def main() -> None:
    rows = {}
    for line in Path(sys.argv[1]).read_text().splitlines():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:  # cut off by an interruption
            continue
        rows[row["case"]] = row
    print(report(list(rows.values())))


if __name__ == "__main__":
    main()
