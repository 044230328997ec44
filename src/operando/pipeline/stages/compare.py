"""Stage ``compare``: all models against the check measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from operando.data import Finding
from operando.errors import MissingError
from operando.pipeline.stages.scale import scaled
from operando.pipeline.stages.work import Lacking, Work, analysis_band


def comparison(work: Work) -> dict[str, Any]:
    """Idle model, baselines and operational FRFs against the check."""
    from operando.compare import compare_all

    results, findings = work.results, []
    models: dict[str, Any] = {}
    if results.idle is not None and results.idle.scaling == "unit_modal_mass" and results.idle.si:
        models["idle"] = results.idle
    if results.hybrid is not None:
        named = {name: results.hybrid.alternative_models.get(name) for name in ("idle_shapes", "msf_all")} | {"ofrf": results.hybrid.modal}
        for name, model in named.items():
            if model is not None:
                models[name] = model
            else:
                message = f"baseline {name} cannot be made from these modes"
                findings.append(Finding("baseline_failed", message, "warning", consequence="it is not compared"))
    if not models:
        if results.idle is not None:
            scaled(results.idle, results.findings, "no model predicts the validation measurement")
        raise Lacking("there is no model to compare with the validation measurement")
    if not results.check:
        raise MissingError("no validation FRF")
    band = analysis_band(work)
    if results.idle_frf is not None:
        from operando.quality import check_gains

        findings += [f for run in results.check for f in check_gains(results.idle_frf, run.frf, run.name, band)]
    runs = [replace(run, frf=run.frf.without_bands(work.analysis.exclude_bands)) for run in results.check]
    return {"comparison": compare_all(models, runs, band_hz=band), "findings": findings}
