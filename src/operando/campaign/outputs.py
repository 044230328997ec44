"""Files of a campaign: one document, one table, one report."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from operando.atomic import replacing, write_json
from operando.campaign.page import render

_MODE = (
    "track", "mode", "frequency_hz", "frequency_std_hz", "damping_ratio", "damping_ratio_std", "mac_before", "mac_baseline",
    "change_percent", "changed", "scale", "scale_std", "class",
)  # fmt: skip
_MODELS = ("idle", "ofrf", "effect")
_ERRORS = ("error_db", "relative_error", "misfit", "noise_floor_db")


def write_outputs(out: Path, document: Mapping[str, Any]) -> None:
    """Write ``campaign.json``, ``campaign.csv``, ``report.html``, and ``campaign.parquet`` where pyarrow is installed."""
    write_json(out / "campaign.json", document)
    head, rows = columns_of(document), list(rows_of(document))
    text = io.StringIO()
    writer = csv.DictWriter(text, head, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with replacing(out / "campaign.csv", "w", encoding="utf-8", newline="") as stream:
        stream.write(text.getvalue())
    _write_parquet(out / "campaign.parquet", head, rows)
    with replacing(out / "report.html", "w", encoding="utf-8", newline="\n") as stream:
        stream.write(render(document))


def columns_of(document: Mapping[str, Any]) -> list[str]:
    """Columns of the table: the test, its parameters, one mode of it, its errors and what it lacks."""
    parameters = [f"parameter {p['name']}" + (f" [{p['unit']}]" if p["unit"] else "") for p in document["parameters"]]
    errors = [f"{model}_{key}" for model in _MODELS for key in _ERRORS]
    return [
        "number",
        "test",
        *parameters,
        "state",
        "reason",
        "of",
        *_MODE,
        "scaling",
        *errors,
        "verdict",
        "missing",
        "stands_out",
        "results",
    ]


def rows_of(document: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of the table: one a mode of a test, at rest and in operation; one without a mode for a test that has none."""
    modes: dict[str, list[dict[str, Any]]] = {}
    for kind in ("idle", "operating"):
        for track in document[kind]["tracks"]:
            for point in track["points"]:
                modes.setdefault(point["test"], []).append({"of": kind, "track": track["track"], **{k: point.get(k) for k in _MODE[1:]}})
    for row in document["tests"]:
        common = {"number": row["number"], "test": row["name"], "state": row["state"], "reason": row["reason"]}
        for p in document["parameters"]:
            common[f"parameter {p['name']}" + (f" [{p['unit']}]" if p["unit"] else "")] = row["parameters"].get(p["name"])
        common |= {f"{m}_{k}": (row["errors"].get(m) or {}).get(k) for m in _MODELS for k in _ERRORS}
        common |= {"scaling": row["scaling"], "verdict": (row["diagnosis"] or {}).get("verdict"), "missing": "; ".join(row["missing"])}
        common |= {"stands_out": "; ".join(row["stands_out"]), "results": row["results"]}
        for mode in modes.get(row["name"]) or [{}]:
            yield common | mode


def _write_parquet(path: Path, head: list[str], rows: list[dict[str, Any]]) -> None:
    """The same table as parquet; without pyarrow none, and no older one that would not fit the others."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        path.unlink(missing_ok=True)
        return
    arrays = {}
    for name in head:
        values = [row.get(name) for row in rows]
        if {type(v) for v in values} >= {str, float}:  # a parameter that is a number in some rows and a text in others
            values = [None if v is None else str(v) for v in values]
        arrays[name] = values
    with replacing(path) as stream:
        pyarrow.parquet.write_table(pyarrow.table(arrays), stream)
