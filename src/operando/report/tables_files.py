"""Tables of what was read and how it was set: files, settings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from operando.report.tables import table
from operando.report.text import DASH, esc, listing, plain, size_text

_INVENTORY_SHOWN: tuple[str, ...] = (
    "file",
    "path",
    "used_for",
    "role",
    "format",
    "sets",
    "used",
    "ignored",
    "not_understood",
    "channels",
    "forces",
    "responses",
)
_INVENTORY_SHOWN += ("units", "sampling_hz", "duration_s", "samples", "n_findings", "error", "sha256", "findings", "set_types", "dofs")
_INVENTORY_SHOWN += ("frf_references", "frf_responses", "frf_band_hz", "frf_lines", "geometry_nodes", "models")


def inventory_table(inventory: Sequence[Mapping[str, Any]]) -> str:
    """One row a file: what it holds, what was used, ignored and not understood; keys it does not know get columns of their own."""
    extra = [k for k in dict.fromkeys(k for row in inventory for k in row) if k not in _INVENTORY_SHOWN]
    extra = [k for k in extra if any(row.get(k) not in (None, [], (), {}, "") for row in inventory)]
    rows = []
    for row in inventory:
        cells = [_cell("file", row.get("file") or row.get("path")), esc(row.get("used_for") or row.get("role") or DASH)]
        cells += [esc(row.get("format") or "not readable"), _sets_cell(row), _content_cell(row), _units_cell(row)]
        cells += [
            _cell("sampling_hz", row.get("sampling_hz")),
            _cell("duration_s", row.get("duration_s")),
            _cell("", row.get("n_findings")),
        ]
        rows.append([*cells, *(_cell(k, row.get(k)) for k in extra)])
    head = ["File", "Used for", "Format", "Sets", "Holds", "Units", "Sampling<br>[Hz]", "Duration<br>[s]", "Findings"]
    head += [esc(k.replace("_", " ").capitalize()) for k in extra]
    return table(head, rows, numeric=(6, 7, 8), caption="<b>Files read.</b>", wide=True)


def _sets_cell(row: Mapping[str, Any]) -> str:
    if row.get("error"):
        return esc(row["error"])
    total = row.get("sets")
    parts = [f"{row[k]} {k.replace('_', ' ')}" for k in ("used", "ignored", "not_understood") if isinstance(row.get(k), int) and row[k]]
    if not isinstance(total, int):
        return _cell("", total)
    if row.get("used") == total:
        return f"{total}, all used"
    return esc(f"{total}: {', '.join(parts)}" if parts else str(total))


def _content_cell(row: Mapping[str, Any]) -> str:
    parts = []
    channels = row.get("channels")
    if channels:
        parts.append(f"{channels if isinstance(channels, int) else len(channels)} channels")
    if row.get("forces"):
        parts.append("force " + listing(row["forces"], 6))
    if row.get("responses"):
        parts.append(f"{len(row['responses'])} responses")
    if row.get("dofs"):
        parts.append("DOFs " + listing(row["dofs"], 14))
    if row.get("frf_lines"):
        parts.append(f"FRFs of {len(row.get('frf_responses') or ())} responses, references {listing(row.get('frf_references') or (), 6)}")
    if row.get("geometry_nodes"):
        parts.append(f"geometry of {row['geometry_nodes']} nodes")
    if row.get("models"):
        parts.append(f"{row['models']} modal models")
    return esc("; ".join(parts)) or DASH


def _units_cell(row: Mapping[str, Any]) -> str:
    """Units as the file states them."""
    if row.get("units"):
        return _cell("units", row["units"])
    channels = row.get("channels")
    if not isinstance(channels, list | tuple):
        return DASH
    names = dict.fromkeys(
        f"{c.get('quantity', '?')} [{c.get('source_unit') or c.get('unit') or 'not stated'}]" for c in channels if isinstance(c, Mapping)
    )
    return esc(", ".join(names)) or DASH


def _cell(key: str, value: Any) -> str:
    if value in (None, [], (), {}, ""):
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key in ("path", "file"):
        parts = PurePath(str(value)).parts
        return f'<span class="mono">{esc("/".join(parts[-2:]))}</span>'
    if key in ("bytes", "size", "size_bytes"):
        return size_text(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return plain(value, 7)
    if isinstance(value, Mapping):
        return esc("; ".join(f"{k}: {v}" for k, v in value.items()))
    if isinstance(value, list | tuple):
        if key == "hits":
            return esc("; ".join(f"#{h['number']} {h['time_s']:.2f} s, {plain(h['peak'], 3)} {h['unit']}".rstrip() for h in value))
        if value and isinstance(value[0], Mapping):
            return esc(f"{len(value)}")
        texts = [str(v) for v in value]
        shown = ", ".join(texts[:14])
        return esc(shown if len(texts) <= 14 else f"{shown}, … ({len(texts)})")
    return esc(value)


def settings_table(settings: Mapping[str, Any]) -> str:
    """All settings, nested ones with dotted names."""
    rows = [[f'<span class="mono">{esc(k)}</span>', f'<span class="mono">{esc(v)}</span>'] for k, v in _flatten(settings)]
    return table(["Setting", "Value"], rows, caption="<b>Settings used</b>, defaults included.")


def _tidy(value: Any) -> Any:
    """Floats to ten digits, so that 180.614 is not shown as 180.61400000000003."""
    if isinstance(value, float):
        return float(f"{value:.10g}")
    return [_tidy(v) for v in value] if isinstance(value, list | tuple) else value


def _flatten(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            rows += _flatten(value, f"{name}.")
        elif value is None or value in ([], {}, ()):
            rows.append((name, "not set"))
        else:
            try:
                rows.append((name, json.dumps(_tidy(value), ensure_ascii=False, default=str)))
            except (TypeError, ValueError):
                rows.append((name, str(value)))
    return rows
