"""What a campaign keeps of one test: modes, scale, errors, what is missing, in one small JSON document."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from operando.jsonable import jsonable
from operando.results import Results

SCHEMA = "operando/campaign-test/1"
MOST_FINDINGS = 20
"""Warnings and errors kept of one test; all stand in its own summary.json."""


def record_of(results: Results) -> dict[str, Any]:
    """The document of a test that was run; its ``state`` is ``done``, or ``incomplete`` where a stage failed."""
    failed = {stage: why.removeprefix("failed: ") for stage, why in results.left_out.items() if why.startswith("failed: ")}
    heavy = sorted((f for f in results.findings if f.severity != "info"), key=lambda f: f.severity != "error")
    document = {
        "schema": SCHEMA,
        "state": "incomplete" if failed else "done",
        "reason": "; ".join(f"stage {stage} failed: {why}" for stage, why in failed.items()) or None,
        "title": results.name,
        "left_out": {k: v for k, v in results.left_out.items() if k not in failed},
        "idle": _modes(results.idle),
        "operating": _modes(results.operating),
        "pairing": [] if results.hybrid is None else results.hybrid.to_dict()["pairing"],
        "scaling": None if results.hybrid is None else results.hybrid.method,
        "errors": _errors(results.comparison),
        "diagnosis": _diagnosis(results.diagnosis),
        "findings": [{"kind": f.kind, "severity": f.severity, "message": f.message} for f in heavy[:MOST_FINDINGS]],
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def _modes(model: Any) -> list[dict[str, Any]]:
    """Modes in band, each with its number in the test's own files."""
    if model is None:
        return []
    keys = ("frequency_hz", "frequency_std_hz", "damping_ratio", "damping_ratio_std", "in_band", "shape")
    modes = model.to_dict()["modes"]
    return [{"mode": i} | {k: mode.get(k) for k in keys if k != "in_band"} for i, mode in enumerate(modes) if mode.get("in_band")]


def _errors(comparison: Mapping[str, Any] | None) -> dict[str, Any]:
    keys = ("error_db", "relative_error", "misfit", "noise_floor_db")
    return {name: {k: m.get(k) for k in keys} for name, m in (comparison or {}).get("models", {}).items()}


def _diagnosis(document: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if document is None:
        return None
    keys = ("verdict", "effects", "ambiguous_with", "reason", "data", "proposed_measurement")
    return {key: document.get(key) for key in keys}
