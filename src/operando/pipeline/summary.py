"""``summary.json``, and the first stage that failed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from operando.errors import IdentificationError, OperandoError
from operando.jsonable import jsonable
from operando.results import Results


def summary(results: Results) -> dict[str, Any]:
    """``operando/summary/1`` of results; null where a stage made nothing."""
    scaled = {"pairing": [], "scaling": None} if results.hybrid is None else results.hybrid.to_dict()
    document: dict[str, Any] = {
        "schema": "operando/summary/1",
        "test": results.name,
        "settings": results.settings,
        "findings": [f.to_dict() for f in results.findings],
        "idle": _idle(results),
        "operating": _operating(results),
        "pairing": scaled["pairing"],
        "scaling": scaled["scaling"],
        "libraries": results.libraries,
        "left_out": results.left_out,
        "inventory": results.inventory,
        "geometry": None if results.geometry is None else {"nodes": len(results.geometry.nodes), "unit_known": results.geometry.unit_known},
        "check": [
            {"name": r.name, **r.stated_level(), "references": _texts(r.frf.references), "averages": r.frf.averages} for r in results.check
        ],
    }
    plain: dict[str, Any] = jsonable(document)
    return plain


def _idle(results: Results) -> dict[str, Any] | None:
    if results.idle is None and results.idle_frf is None:
        return None
    out: dict[str, Any] = {"modes": [], "residual_modes": 0, "misfit": None, "scaling": None, "band_hz": None}
    if results.idle is not None:
        out |= results.idle.to_dict() | {"band_hz": results.idle.band_hz, "si": results.idle.si, "calls": results.idle.provenance.calls}
        details = results.idle.details
        linear = getattr(details, "linear", None)
        if linear is not None:
            out |= {"answer": {"used": details.answer, "reason": details.answer_reason}, "linear": linear.to_dict()}
    frf = results.idle_frf
    if frf is not None:
        from operando.frf import reciprocity_error

        out["frf"] = {
            "references": _texts(frf.references),
            "responses": _texts(frf.responses),
            "averages": frf.averages,
            "reciprocity_error": reciprocity_error(frf),
            "lines": len(frf.axis),
            "band_hz": [float(frf.frequencies_hz[0]), float(frf.frequencies_hz[-1])],
            "si": frf.si,
            "calls": frf.provenance.calls,
        }
    return out


def _operating(results: Results) -> dict[str, Any] | None:
    if results.operating is None:
        return None
    details = results.operating.details
    harmonics = getattr(details, "harmonics_hz", ())
    setups, joint = getattr(details, "setups", ()), getattr(details, "joint", None)
    merged = {"setups": [s.to_dict() for s in setups], "joint": None if joint is None else joint.to_dict()} if setups else {}
    return (
        results.operating.to_dict()
        | merged
        | {"harmonics_hz": [float(f) for f in harmonics], "band_hz": results.operating.band_hz, "calls": results.operating.provenance.calls}
    )


def _texts(dofs: Any) -> list[str]:
    return [str(d) for d in dofs]


def failure(results: Results, out: str | Path) -> OperandoError | None:
    """The first stage that failed, as an error."""
    for stage, reason in results.left_out.items():
        if reason.startswith("failed: "):
            for finding in results.findings:
                if finding.kind == "stage_failed" and finding.message.startswith(f"stage {stage}: "):
                    hint = finding.action or f"what the other stages found stands in {out}"
                    return IdentificationError(finding.message, where=finding.file, hint=hint)
            return IdentificationError(f"stage {stage}: {reason.removeprefix('failed: ')}")
    return None
