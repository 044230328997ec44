"""One summary.json against one answer, and many of them together. Shares no code with operando."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import beta

FREQUENCY_TOLERANCE = 0.005  # of the true frequency, or …
WIDTHS = 1.5  # … so many half widths ζf of the half-power peak, whichever is more
LEAST_MAC = 0.8
FLAGS = ("flagged", "flag", "flags", "doubtful")  # any of these, if not empty, says that a mode is reported with a doubt
WITHIN = 1.96  # standard deviations of a 95 % interval


def _signed(name: str) -> tuple[str, float]:
    """DOF without its sign, and the sign."""
    match = re.fullmatch(r"(\d+)([+-]?)(.*)", name)
    if match is None:
        return name, 1.0
    return match[1] + match[3], -1.0 if match[2] == "-" else 1.0


def shape_of(shape: dict[str, Any]) -> dict[str, complex]:
    """Values by unsigned DOF, in its positive sense; JSON has numbers or [re, im]."""
    out: dict[str, complex] = {}
    for name, value in shape.items():
        if value is None:
            continue
        place, sign = _signed(name)
        out[place] = sign * (complex(*value) if isinstance(value, list) else complex(value))
    return out


def mac(first: dict[str, complex], second: dict[str, complex]) -> float:
    """Modal assurance criterion over the DOFs both have; 0 where there are none."""
    common = sorted(first.keys() & second.keys())
    if not common:
        return 0.0
    a, b = np.array([first[d] for d in common]), np.array([second[d] for d in common])
    size = np.vdot(a, a).real * np.vdot(b, b).real
    return float(abs(np.vdot(a, b)) ** 2 / size) if size else 0.0


def _seen(mode: dict[str, Any]) -> dict[str, Any]:
    """Shape that the measurement holds: at the places that were hit, where the answer has it."""
    shape: dict[str, Any] = mode.get("shape_as_hit") or mode["shape"]
    return shape


def _tolerance(mode: dict[str, Any]) -> float:
    hz = mode["frequency_hz"]
    return max(FREQUENCY_TOLERANCE * hz, WIDTHS * mode["damping_ratio"] * hz)


def _match(true: Sequence[dict[str, Any]], found: Sequence[dict[str, Any]]) -> tuple[dict[int, int], np.ndarray, np.ndarray]:
    """Index of the true mode for each found one: as many as can be, then the nearest in frequency and shape; distances, MAC."""
    distance = np.array([[abs(f["frequency_hz"] - t["frequency_hz"]) / _tolerance(t) for t in true] for f in found]).reshape(
        len(found), len(true)
    )
    alike = np.array([[mac(shape_of(_seen(t)), shape_of(f["shape"])) for t in true] for f in found]).reshape(len(found), len(true))
    allowed = (distance <= 1) & (alike > LEAST_MAC)
    rows, columns = linear_sum_assignment(np.where(allowed, distance + 1 - alike, 1e3))
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if allowed[i, j]}, distance, alike


def judge(truth: dict[str, Any], summary: dict[str, Any] | None) -> dict[str, Any]:
    """Figures of one case; without a summary every visible mode is missed."""
    low, high = truth["band_hz"]
    true = truth["modes"]
    wanted = [j for j, t in enumerate(true) if t["in_band"] and t["visible"]]
    row: dict[str, Any] = {
        "wanted": len(wanted),
        "not_counted": sum(t["in_band"] and not t["visible"] for t in true),
        "found": 0,
        "invented": 0,
    }
    row |= {"flagged": 0, "found_but_flagged": 0, "reported": 0, "modes": [], "missed_hz": [], "invented_hz": [], "scaled": None}
    part = (summary or {}).get(truth["state"]) or {}
    modes = [m for m in part.get("modes", []) if m.get("in_band", True) is not False and low <= m["frequency_hz"] <= high]
    plain = [m for m in modes if not any(m.get(k) for k in FLAGS)]
    doubtful = [m for m in modes if any(m.get(k) for k in FLAGS)]
    row |= {"reported": len(plain), "flagged": len(doubtful)}
    matched, distance, alike = _match(true, plain)
    for i, j in matched.items():
        if j in wanted:
            row["found"] += 1
            row["modes"].append(_errors(true[j], plain[i], float(alike[i, j])))
    for i in set(range(len(plain))) - set(matched):
        # Near a true mode that is not counted (hardly visible, or outside the band): neither found nor invented.
        if not any(distance[i, j] <= 1 and j not in wanted and j not in matched.values() for j in range(len(true))):
            row["invented"] += 1
            row["invented_hz"].append(round(plain[i]["frequency_hz"], 4))
    lost = [j for j in wanted if j not in matched.values()]
    row["missed_hz"] = [round(true[j]["frequency_hz"], 4) for j in lost]
    again, _, _ = _match([true[j] for j in lost], doubtful)
    row["found_but_flagged"] = len(again)
    if truth["scaled"] and row["found"]:
        row["scaled"] = part.get("scaling") not in (None, "unscaled") and part.get("si") is not False
        if not row["scaled"]:
            for mode in row["modes"]:
                mode["scale_error"] = None
    return row


def _errors(true: dict[str, Any], found: dict[str, Any], likeness: float) -> dict[str, Any]:
    """Errors of one mode; ``scale_error`` is that of the residue at the sensors together, as a share of it."""
    out: dict[str, Any] = {"hz": round(true["frequency_hz"], 4), "mac": round(likeness, 4)}
    out["mac_at_points"] = round(mac(shape_of(true["shape"]), shape_of(found["shape"])), 4)
    truths = {"frequency": true["frequency_hz"], "damping": true["damping_ratio"]}
    values = {"frequency": found["frequency_hz"], "damping": found["damping_ratio"]}
    sigmas = {"frequency": found.get("frequency_std_hz"), "damping": found.get("damping_ratio_std")}
    for name, value in truths.items():
        error = values[name] - value
        out[f"{name}_error"] = float(f"{error / value:.4g}")
        out[f"{name}_z"] = None if not sigmas[name] or not true.get("intervals", True) else float(f"{error / sigmas[name]:.4g}")
    if "frequency_plain_mean_hz" in true and sigmas["frequency"] and true.get("intervals", True):
        out["frequency_plain_z"] = float(f"{(found['frequency_hz'] - true['frequency_plain_mean_hz']) / sigmas['frequency']:.4g}")
    a, b = shape_of(_seen(true)), shape_of(found["shape"])
    common = sorted(a.keys() & b.keys())
    t, e = np.array([a[d] for d in common]), np.array([b[d] for d in common])
    size = np.vdot(t, t).real
    out["dofs"] = round(len(common) / len(a), 3)
    out["scale_error"] = float(f"{abs(np.vdot(t, e)) ** 2 / size**2 - 1:.4g}") if size else None
    return out


def interval(hits: int, of: int) -> list[float] | None:
    """Clopper–Pearson 95 % interval of a share."""
    if not of:
        return None
    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, of - hits + 1))
    high = 1.0 if hits == of else float(beta.ppf(0.975, hits + 1, of - hits))
    return [low, high]


def _share(hits: int, of: int) -> dict[str, Any]:
    return {"hits": hits, "of": of, "share": hits / of if of else None, "interval": interval(hits, of)}


def _spread(values: Iterable[float | None]) -> dict[str, float | None]:
    kept = [v for v in values if v is not None]
    return {"median": float(np.median(kept)) if kept else None, "max": float(np.max(kept)) if kept else None}


def together(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Aggregate over cases. Modes of cases that did not finish count as missed in ``found``, not in ``found_where_finished``."""
    done = [r for r in rows if r["outcome"] == "done"]
    modes = [m for r in done for m in r["modes"]]
    out: dict[str, Any] = {"cases": len(rows), "outcomes": {}}
    for row in rows:
        out["outcomes"][row["outcome"]] = out["outcomes"].get(row["outcome"], 0) + 1
    out["found"] = _share(sum(r["found"] for r in rows), sum(r["wanted"] for r in rows))
    out["found_where_finished"] = _share(sum(r["found"] for r in done), sum(r["wanted"] for r in done))
    out["found_but_flagged"] = sum(r["found_but_flagged"] for r in done)
    out["not_counted"] = sum(r["not_counted"] for r in rows)
    out["invented"] = _share(sum(r["invented"] for r in done), sum(r["reported"] for r in done))
    # a hit beside its point sees another shape: found, but not the shape at the points
    out["other_shape_at_points"] = sum(m["mac_at_points"] <= LEAST_MAC for m in modes)
    for name in ("frequency", "frequency_plain", "damping"):
        z = [m.get(f"{name}_z") for m in modes]
        out[f"{name}_coverage"] = _share(sum(v is not None and abs(v) <= WITHIN for v in z), sum(v is not None for v in z))
        out[f"{name}_abs_z"] = _spread(abs(v) for v in z if v is not None)  # median 0.67 where intervals are right and errors normal
        if name != "frequency_plain":
            out[f"{name}_error"] = _spread(abs(m[f"{name}_error"]) for m in modes)
    out["dofs"] = float(np.mean([m["dofs"] for m in modes])) if modes else None  # a sensor left out is no wrong mode, but a loss
    scalable = [r for r in done if r["scaled"] is not None]
    out["scaled"] = _share(sum(bool(r["scaled"]) for r in scalable), len(scalable))
    out["scale_error"] = _spread(abs(m["scale_error"]) for r in scalable if r["scaled"] for m in r["modes"] if m["scale_error"] is not None)
    out["cpu_s"] = _spread(r.get("cpu_s") for r in rows)
    out["memory_mb"] = _spread(r.get("memory_mb") for r in rows)
    return out


def table(groups: dict[str, dict[str, Any]]) -> str:
    """Markdown."""
    head = ["kind", "cases", "not finished", "found", "of finished", "of these another shape at the points", "invented"]
    head += ["f in 95 % (median error/σ)", "ζ in 95 % (median error/σ)", "error of f, median, max", "error of ζ, median, max"]
    head += ["DOFs in shapes", "scaled", "error of residues, median, max", "CPU s, median, max", "MB, max"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name, g in groups.items():
        bad = ", ".join(f"{n} {what}" for what, n in g["outcomes"].items() if what != "done") or "–"
        cells = [
            name,
            str(g["cases"]),
            bad,
            _percent(g["found"]),
            _percent(g["found_where_finished"]),
            str(g["other_shape_at_points"]),
            _percent(g["invented"]),
        ]
        cells += [_coverage(g, "frequency"), _coverage(g, "damping")]
        cells += [_pair(g["frequency_error"], 100, " %"), _pair(g["damping_error"], 100, " %")]
        scaled = g["scaled"]
        cells += [f"{100 * g['dofs']:.0f} %" if g["dofs"] is not None else "–"]
        cells += [f"{scaled['hits']}/{scaled['of']}" if scaled["of"] else "–", _pair(g["scale_error"], 100, " %")]
        cells += [_pair(g["cpu_s"], 1, ""), f"{g['memory_mb']['max']:.0f}" if g["memory_mb"]["max"] is not None else "–"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _percent(share: dict[str, Any]) -> str:
    return f"{share['hits']}/{share['of']} = {100 * share['share']:.1f} %" if share["of"] else "–"


def _coverage(group: dict[str, Any], name: str) -> str:
    share = group[f"{name}_coverage"]
    if not share["of"]:
        return "–"
    low, high = (100 * v for v in share["interval"])
    return f"{_percent(share)}, {low:.0f}–{high:.0f} % ({group[f'{name}_abs_z']['median']:.2g})"


def _pair(spread: dict[str, Any], factor: float, unit: str) -> str:
    if spread["median"] is None:
        return "–"
    median, largest = (f"{v:.2g}" if v < 99.5 else f"{v:.0f}" for v in (factor * spread["median"], factor * spread["max"]))
    return f"{median}, {largest}{unit}"
