"""What the sections on the measurements, and on how the results were made, show."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from operando.data import Finding, unit_of
from operando.report import derive
from operando.report.parts import Numbering, some, tail
from operando.report.text import DASH, band_text, plain, short_names, size_text
from operando.results import Results

SEVERITY_WORDS = {"error": ("error", "poor"), "warning": ("warning", "fair"), "info": ("note", "none")}
_KNOWN = (
    "file", "path", "used_for", "role", "format", "sets", "used", "ignored", "not_understood", "channels", "forces", "responses",
    "units", "sampling_hz", "duration_s", "samples", "n_findings", "error", "sha256", "findings", "set_types", "dofs",
    "frf_references", "frf_responses", "frf_band_hz", "frf_lines", "geometry_nodes", "models",
)  # fmt: skip
"""What the columns of the inventory hold; keys beside these get columns of their own."""


def measured(results: Results, page: Numbering) -> dict[str, Any]:
    """Inventory of files and findings about the data."""
    return {"unit_of": unit_of, "raw": raw_data(results)} | inventory(results.inventory) | findings(derive.all_findings(results))


def raw_data(results: Results) -> list[dict[str, Any]]:
    """Figures of the raw records of each state."""
    from operando.report.figures_raw import raw_densities, raw_hits, raw_records

    model = results.idle if results.idle is not None else results.operating
    band = None if model is None or model.band_hz is None else (model.band_hz[0], model.band_hz[1])
    states = []
    for state, name in (("idle", "Idle state"), ("operating", "Operating state"), ("check", "Validation measurement")):
        seen = [raw for raw in results.raw if raw.state == state]
        if not seen:
            continue
        hammered = [raw for raw in seen if raw.pulses]
        first = next((raw for raw in seen if not raw.pulses and raw.densities.size), None)
        total = sum("duration_s" in row and row.get("used_for", "").startswith(state) for row in results.inventory)
        shown, of = (0, 0) if first is None else (len(first.outline.channels), first.n_channels)
        states.append({
            "name": name, "count": len(seen), "total": max(total, len(seen)), "time": raw_records(seen),
            "force": any(raw.outline.force_indices for raw in seen), "hits": raw_hits(hammered, band) if hammered else None,
            "spectra": None if first is None else raw_densities(first, band),
            "shown": f"{shown} of {of} channels" if shown < of else "all channels",
        })  # fmt: skip
    return states


def inventory(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The files, the keys that have columns of their own, and how their values are said."""
    extra = [k for k in dict.fromkeys(k for row in rows for k in row) if k not in _KNOWN]
    return {
        "inventory": rows, "extra": [k for k in extra if any(row.get(k) not in (None, [], (), {}, "") for row in rows)],
        "cell": cell, "units": _units,
    }  # fmt: skip


def findings(found: Sequence[Finding]) -> dict[str, Any]:
    """Findings grouped where only the place differs, the gravest first."""
    groups: dict[tuple[str, ...], list[Finding]] = {}
    for f in found:
        groups.setdefault((f.severity, f.kind, f.consequence, f.action), []).append(f)
    counts = {s: sum(f.severity == s for f in found) for s in SEVERITY_WORDS}
    return {"groups": list(groups.values()), "severities": SEVERITY_WORDS, "counts": counts, "place": _place, "places": _places}


def _places(group: Sequence[Finding]) -> list[str]:
    return list(dict.fromkeys(where for f in group if (where := _place(f))))


def _place(f: Finding) -> str:
    parts = [PurePath(f.file).name if f.file else "", f"set {f.set}" if f.set is not None else "", f.dof or ""]
    if f.time_s is not None:
        parts.append(f"{plain(f.time_s[0])}–{plain(f.time_s[1])} s")
    if f.band_hz is not None:
        parts.append(band_text(f.band_hz))
    return ", ".join(p for p in parts if p)


def _units(row: Mapping[str, Any]) -> str:
    """Units as the file states them."""
    channels = row.get("channels")
    if row.get("units") or not isinstance(channels, list | tuple):
        return cell("units", row.get("units"))
    given = [c for c in channels if isinstance(c, Mapping)]
    names = dict.fromkeys(f"{c.get('quantity', '?')} [{c.get('source_unit') or c.get('unit') or 'not stated'}]" for c in given)
    return ", ".join(names) or DASH


def cell(key: str, value: Any) -> str:
    """A value of the inventory in words."""
    if value in (None, [], (), {}, ""):
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key in ("bytes", "size", "size_bytes"):
        return size_text(value)
    if isinstance(value, float):
        return plain(value, 7)
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {v}" for k, v in value.items())
    if isinstance(value, list | tuple):
        if key == "hits":
            return "; ".join(f"#{h['number']} {h['time_s']:.2f} s, {plain(h['peak'], 3)} {h['unit']}".rstrip() for h in value)
        return str(len(value)) if isinstance(value[0], Mapping) else some(value, 14)
    return str(value)


def provenance(results: Results, page: Numbering) -> dict[str, Any]:
    """Settings, stages left out, versions, inputs with their hashes, processing calls."""
    import platform
    from importlib.metadata import version

    from operando import __version__
    from operando.data import Provenance

    names = [("operando", __version__), ("Python", platform.python_version())]
    names += [(package, version(package)) for package in ("numpy", "scipy", "matplotlib")]
    parts = [results.idle_frf, results.idle, results.operating, *(run.frf for run in results.check), results.geometry]
    merged = Provenance.merge(*(p.provenance for p in parts if p is not None))
    inputs = {str(row["sha256"]): tail(row.get("file")) for row in results.inventory if row.get("sha256")}
    inputs |= {digest: short_names(path) for path, digest in merged.inputs if digest not in inputs}
    return {"settings": _flat(results.settings), "versions": names, "inputs": inputs, "calls": merged.calls}


def _tidy(value: Any) -> Any:
    """Floats to ten digits, so that 180.614 is not shown as 180.61400000000003."""
    if isinstance(value, float):
        return float(f"{value:.10g}")
    return [_tidy(v) for v in value] if isinstance(value, list | tuple) else value


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """All settings as text, nested ones with dotted names."""
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            rows += _flat(value, f"{prefix}{key}.")
        elif value is None or value in ([], {}, ()):
            rows.append((f"{prefix}{key}", "not set"))
        else:
            try:
                rows.append((f"{prefix}{key}", json.dumps(_tidy(value), ensure_ascii=False, default=str)))
            except (TypeError, ValueError):
                rows.append((f"{prefix}{key}", str(value)))
    return rows
