"""Holds one results folder against the answer of its case. Reads files only; the rules are those of the contract."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
from hidden import SENSOR

SKEW = ("gyroscopic", "circulatory")
PRIMARY = ("mass", "stiffness", "damping", "coefficient", "change", "gain", "delay", "force", "frequency")


def judge(answer: dict, results: Path, exact=None) -> dict:
    """Everything the tally needs of one run; ``exact(hz)`` is the operating accelerance (sensors, references, lines), or None."""
    row: dict = {"identification": None, "diagnosis": None, "ofrf_db": {}}
    summary = _load(results / "summary.json")
    if summary is None:
        return row
    row["timings_s"] = (_load(results / "timings.json") or {}).get("seconds", {})
    row["left_out"] = summary.get("left_out", {})
    row["findings"] = sorted({f["kind"] for f in summary.get("findings", [])})
    row["identification"] = identification(answer, summary)
    diagnosis = _load(results / "diagnosis.json")
    if diagnosis is not None:
        row["diagnosis"] = compare_diagnosis(answer, diagnosis)
        if "seconds" in diagnosis:  # through_library.py
            row["timings_s"]["diagnose"] = diagnosis["seconds"]
    comparison = _load(results / "comparison.json")
    if comparison is not None:
        models = {k: v for k, v in comparison["models"].items() if v}
        row["comparison_misfit"] = {k: v["misfit"] for k, v in models.items()}
        # A model without variance has the floor of the measurement alone.
        row["noise_db"] = (models.get("msf_all") or {}).get("noise_floor_db")
    if exact is not None:
        for route, name in (("hybrid", "ofrf.uff"), ("effect", "ofrf_effect.uff")):
            if (results / name).exists():
                row["ofrf_db"][route] = ofrf_error(answer, results / name, exact)
    return row


def _load(path: Path) -> dict | None:
    return json.loads(path.read_text()) if path.exists() else None


# Identification


def _signed(label: str) -> tuple[str, int]:
    """A DOF label without its sign, and the sign."""
    return label.replace("-", "+"), -1 if "-" in label else 1


def _rows(labels: list[str], wanted: list[str], values: np.ndarray) -> np.ndarray:
    """Rows of values (labels, …) in the order and sense of the wanted labels; NaN where one is missing."""
    index = {_signed(label)[0]: (i, _signed(label)[1]) for i, label in enumerate(labels)}
    out = np.full((len(wanted), *values.shape[1:]), np.nan, values.dtype)
    for k, label in enumerate(wanted):
        name, sign = _signed(label)
        if name in index:
            i, own = index[name]
            out[k] = values[i] * own * sign
    return out


def identification(answer: dict, summary: dict) -> dict:
    """Modes found, missed and spurious in band, errors and how many lie within two stated standard deviations; both states."""
    low, high = answer["band_hz"]
    out: dict = {"misfit": summary["idle"].get("misfit") if summary.get("idle") else None}
    for state in ("idle", "operating"):
        if not summary.get(state):
            continue
        truth = answer[state]
        shapes = truth["shapes_unit_modal_mass"] if state == "idle" else truth["shapes_unit_norm"]
        true_shapes = np.array(shapes) if state == "idle" else np.array(shapes[0]) + 1j * np.array(shapes[1])
        out[state] = _modes(answer, truth, true_shapes, summary[state]["modes"], low, high, scaled=state == "idle")
    orders = answer.get("harmonics_hz", [])
    if summary.get("operating"):
        found = summary["operating"].get("harmonics_hz", [])
        modes = [m["frequency_hz"] for m in summary["operating"]["modes"]]
        out["orders"] = {
            "hidden": orders,
            "found": found,
            "missed": [f for f in orders if not any(abs(f / g - 1) < 2e-3 for g in found)],
            "false": [g for g in found if not any(abs(f / g - 1) < 2e-3 for f in orders)],
            "taken_for_modes": [f for f in orders if any(abs(f / g - 1) < 2e-3 for g in modes)],
        }
    return out


def _modes(answer: dict, truth: dict, true_shapes: np.ndarray, modes: list[dict], low: float, high: float, *, scaled: bool) -> dict:
    hz, zeta = np.array(truth["frequency_hz"]), np.array(truth["damping_ratio"])
    out: dict = {"found": 0, "missed": [], "spurious": [], "pairs": []}
    taken: set[int] = set()
    for i in np.flatnonzero((hz > low) & (hz < high)):
        best, best_mac = None, 0.0
        for k, mode in enumerate(modes):
            if k in taken or abs(mode["frequency_hz"] / hz[i] - 1) > 0.02:
                continue
            shape, _ = _shape(mode, answer["dofs"])
            mac = _mac(shape, true_shapes[:, i]) - 20 * abs(mode["frequency_hz"] / hz[i] - 1)
            if mac > best_mac:
                best, best_mac = k, mac
        if best is None or best_mac < 0.5:
            out["missed"].append(round(float(hz[i]), 3))
            continue
        taken.add(best)
        mode = modes[best]
        shape, std = _shape(mode, answer["dofs"])
        known = np.isfinite(shape)
        a, b = shape[known], true_shapes[known, i]
        pair = {
            "hz": float(hz[i]),
            "f_error": mode["frequency_hz"] / hz[i] - 1,
            "zeta_error": mode["damping_ratio"] / zeta[i] - 1,
            "f_z": _over(mode["frequency_hz"] - hz[i], mode.get("frequency_std_hz")),
            "zeta_z": _over(mode["damping_ratio"] - zeta[i], mode.get("damping_ratio_std")),
            "mac": _mac(shape, true_shapes[:, i]),
        }
        if scaled:
            scale = float((a @ b) / (b @ b))
            a = a * np.sign(scale)
            pair["mass_error"] = 1 / scale**2 - 1
            pair["shape_error"] = float(np.linalg.norm(a - b) / np.linalg.norm(b))
            if std is not None:
                z = (a - b) / std[known]
                pair["shape_within"] = float(np.mean(np.abs(z) < 2))
        out["pairs"].append(pair)
    out["found"] = len(out["pairs"])
    margin = 0.02 * (high - low)
    for k, mode in enumerate(modes):
        f = mode["frequency_hz"]
        if k not in taken and mode.get("in_band", True) and low < f < high and not _near_edge(f, hz, low, high, margin):
            out["spurious"].append(round(f, 3))
    return out


def _near_edge(f: float, hz: np.ndarray, low: float, high: float, margin: float) -> bool:
    """A mode just within the band that is one just outside it."""
    return (f < low + margin or f > high - margin) and bool(np.abs(hz / f - 1).min() < 0.02)


def _shape(mode: dict, dofs: list[str]) -> tuple[np.ndarray, np.ndarray | None]:
    labels = list(mode["shape"])
    values = np.array([complex(*v) if isinstance(v, list) else v for v in mode["shape"].values()])
    std = mode.get("shape_std")
    spread = None
    if std and all(isinstance(v, int | float) for v in std.values()):
        spread = np.abs(_rows(list(std), dofs, np.array(list(std.values()), float)))
    return _rows(labels, dofs, values), spread


def _mac(a: np.ndarray, b: np.ndarray) -> float:
    known = np.isfinite(a)
    a, b = a[known], b[known]
    return float(abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a).real * np.vdot(b, b).real))


def _over(error: float, std: float | None) -> float | None:
    return float(error / std) if std else None


# Diagnosis


def same_place(kind: str, found: dict, true: dict, answer: dict) -> bool:
    """The very DOFs; for a mass any DOF of the node; between sensors half a sensor spacing; of a missing mode the half-power width."""
    if kind == "missing_mode":
        f, wanted = (e["parameters"].get("frequency", {}).get("value") for e in (found, true))
        return f is not None and abs(f / wanted - 1) <= 2 * true["parameters"]["damping_ratio"]["value"]
    if "position" in true:
        position = found.get("position")
        if position is None and len(found["location"]) == 1:
            position = answer["positions"].get(_known(found["location"][0], answer))
        if position is None:
            return False
        return float(np.linalg.norm(np.array(position) - np.array(true["position"]))) <= 0.5 * answer["sensor_spacing_m"] + 1e-9
    if found.get("position") is not None and not found["location"]:
        return False
    a, b = (sorted(_signed(str(d))[0] for d in e["location"]) for e in (found, true))
    if kind in ("point_mass", "sensor_mass"):
        a, b = ([d.split("+")[0] for d in names] for names in (a, b))
    return a == b


def _known(label: str, answer: dict) -> str:
    return next((d for d in answer["dofs"] if _signed(d)[0] == _signed(label)[0]), label)


def matches(found: dict, true: dict, answer: dict) -> bool:
    return found["kind"] == true["kind"] and same_place(true["kind"], found, true, answer)


def compare_diagnosis(answer: dict, diagnosis: dict) -> dict:
    """Verdict, whether kind and place are right at the top and in the set, sizes with their intervals."""
    truth, effects = answer["effects"], diagnosis.get("effects", [])
    alike = [*effects, *diagnosis.get("ambiguous_with", [])]
    ladder = diagnosis.get("ladder", [])
    key = "heldout_misfit"
    steps = [s[key] for s in ladder if s.get(key) is not None]
    row: dict = {
        "verdict": diagnosis["verdict"],
        "effects": [_short(e) for e in effects],
        "ambiguous_with": [_short(e) for e in diagnosis.get("ambiguous_with", [])][:8],
        "proposed_measurement": diagnosis.get("proposed_measurement"),
        "candidate": _short(diagnosis["candidates"][0]) if diagnosis.get("candidates") else None,
        "heldout": steps,
        "monotone": all(b <= a * 1.001 for a, b in pairwise(steps)),
        "false_alarm": not truth and (diagnosis["verdict"] != "no_misfit" or bool(effects)),
        "extra": len(effects) - len(truth),
    }
    if diagnosis.get("simulation"):
        row["closed_loop_gain_db"] = diagnosis["simulation"].get("gain_db")
    if truth:
        row["kind_top"] = bool(effects) and effects[0]["kind"] in [t["kind"] for t in truth]
        row["right"] = [any(matches(e, t, answer) for e in effects) for t in truth]
        row["top"] = bool(effects) and any(matches(effects[0], t, answer) for t in truth)
        row["place_top"] = bool(effects) and any(same_place(t["kind"], effects[0], t, answer) for t in truth)
        row["in_set"] = all(any(matches(e, t, answer) for e in alike) for t in truth)
        row["kinds_in_set"] = sorted({e["kind"] for e in alike})
        row["named_sensor"] = bool(effects) and all(e["kind"] in SENSOR for e in effects)
        row["sizes"] = [
            size for t in truth for size in _sizes(next((e for e in effects if matches(e, t, answer)), None), t, answer["check"])
        ]
    return row


def _short(effect: dict) -> str:
    place = ",".join(map(str, effect["location"])) or (str(np.round(effect["position"], 2).tolist()) if effect.get("position") else "")
    values = ",".join(f"{k}:{v['value']:.4g}" for k, v in effect.get("parameters", {}).items() if v.get("value") is not None)
    return effect["kind"] + (f"@{place}" if place else "") + (f"={values}" if values else "")


def _sizes(found: dict | None, true: dict, check: bool) -> list[dict]:
    """Error and interval of each parameter; the first is the size. A rubber's reference frequency is turned into the stated one."""
    if found is None:
        return []
    out = []
    names = sorted(true["parameters"], key=lambda n: PRIMARY.index(n) if n in PRIMARY else 99)
    for i, name in enumerate(names):
        given = found["parameters"].get(name)
        if given is None or given.get("value") is None:
            continue
        value, wanted = given["value"], true["parameters"][name]["value"]
        if true["kind"] in SKEW and (not check or found["location"] != true["location"]):
            value, wanted = abs(value), abs(wanted)
        std = given.get("std")
        out.append(
            {
                "kind": true["kind"],
                "name": name,
                "primary": i == 0,
                "error": value / wanted - 1,
                "z": _over(value - wanted, std),
                "std": std and abs(std / wanted),
            }
        )
    return out


# Operating FRFs

FRF = 4
"""Function type of a UFF 58 set."""


def read_frfs(path: Path) -> tuple[np.ndarray, dict[tuple[str, str], np.ndarray]]:
    """Lines [Hz] and FRFs of a file of evenly spaced complex 58b sets in double or single precision."""
    content, frfs, hz = path.read_bytes(), {}, np.zeros(0)
    for start in _sets(content):
        lines = []
        position = start
        for _ in range(12):
            end = content.index(b"\n", position)
            lines.append(content[position:end].decode("latin1"))
            position = end + 1
        size = int(lines[0].split()[4])
        dofs = lines[6]
        if int(dofs[:5]) != FRF:  # the band stands in further sets
            continue
        pair = (_dof(dofs[41:51], dofs[51:55]), _dof(dofs[66:76], dofs[76:80]))
        kind, count, _even, first, step = lines[7].split()[:5]
        data = np.frombuffer(content[position : position + size], {"5": "<c8", "6": "<c16"}[kind])
        hz = float(first) + float(step) * np.arange(int(count))
        frfs[pair] = data
    return hz, frfs


def _sets(content: bytes):
    position = 0
    while (start := content.find(b"\n    58b", position)) >= 0:
        yield start + 1
        position = start + int(content[start + 1 : start + 82].split()[4])


def _dof(node: str, direction: str) -> str:
    code = int(direction)
    return f"{int(node)}{'+' if code > 0 else '-'}{' XYZ'[abs(code)]}"


def ofrf_error(answer: dict, path: Path, exact) -> dict:
    """rms dB error over the lines in band, on the reference columns and on all."""
    hz, frfs = read_frfs(path)
    inside = (hz >= answer["band_hz"][0]) & (hz <= answer["band_hz"][1])
    true = exact(hz[inside])
    at = {_signed(d)[0]: (i, _signed(d)[1]) for i, d in enumerate(answer["dofs"])}
    driven = {_signed(d)[0] for d in answer["references"]}
    errors: dict[str, list[float]] = {"references": [], "all": []}
    for (response, reference), data in frfs.items():
        (i, _), (k, _) = at[_signed(response)[0]], at[_signed(reference)[0]]
        square = float(np.mean((20 * np.log10(np.abs(data[inside]) / np.abs(true[i, k]))) ** 2))
        errors["all"].append(square)
        if _signed(reference)[0] in driven:
            errors["references"].append(square)
    return {name: float(np.sqrt(np.mean(values))) for name, values in errors.items() if values}
