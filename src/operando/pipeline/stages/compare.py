"""Stage ``compare``: all models against the check measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from operando.data import Finding
from operando.errors import MissingError
from operando.pipeline.stages.scale import scaled
from operando.pipeline.stages.work import Lacking, Work, analysis_band
from operando.printable import first_few
from operando.results import CheckRun


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
            if model is not None and _measures_a_pair_of(model, results.check):
                models[name] = model
            else:
                message = f"baseline {name} cannot be made from these modes"
                if model is not None:
                    dofs = first_few([str(d) for d in model.dofs], 4)
                    message = f"{name} holds no response–reference pair of the validation measurement (its DOFs: {dofs})"
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


def _measures_a_pair_of(model: Any, check: Sequence[CheckRun]) -> bool:
    """Whether a response and a reference of some run are among the DOFs of a model; without a run nothing is said of it."""
    axes = {d.key for d in model.dofs}
    runs = [(run.frf.responses, run.frf.references) for run in check]
    return not runs or any(all(axes & {d.key for d in side} for side in run) for run in runs)
