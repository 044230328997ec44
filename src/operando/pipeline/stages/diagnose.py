"""Stage ``diagnose``: which physics the idle model lacks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from operando.data import Finding
from operando.pipeline.stages.estimate import whole_records
from operando.pipeline.stages.files import ITSELF, data_twice
from operando.pipeline.stages.scale import scaled
from operando.pipeline.stages.work import Lacking, Work, analysis_band, needed


def missing_physics(work: Work) -> dict[str, Any]:
    """Where the idle model fails in operation and which effect is missing; the comparison gains the idle model with it."""
    from operando.compare import with_effect
    from operando.diagnosis import diagnose
    from operando.diagnosis.at_level import following
    from operando.structure import Model

    results = work.results
    idle = needed(results.idle, "idle modes")
    scaled(idle, work.results.findings, "no effect has a size")
    runs = [replace(run, frf=run.frf.without_bands(work.analysis.exclude_bands)) for run in results.check]
    if not runs and results.operating is None:
        raise Lacking("there are neither validation FRFs nor operational modes")
    used = "check" if runs else "operating"
    if any({one, other} == {"idle", used} for (one, _), (other, _) in data_twice(results.inventory)):
        raise Lacking(f"the data of [{used}] are those of [idle]: {ITSELF}", hint="name in each section the files measured in that state")
    compared = results.comparison if runs and results.comparison is not None and "idle" in results.comparison["models"] else None
    findings: list[Finding] = []
    found = diagnose(
        idle,
        check=runs,
        operating=results.operating,
        geometry=results.geometry,
        kinds=work.analysis.kinds or None,
        places=work.analysis.places or None,
        band=analysis_band(work),
        progress=work.say,
        records=whole_records(work, work.test.check, findings) if runs and work.test.check.records else (),
        idle_frf=None if results.idle_frf is None else results.idle_frf.without_bands(work.analysis.exclude_bands),
        exclude_bands=work.analysis.exclude_bands,
        between=work.test.between,
        compared=compared,
    )
    document = found.to_dict()
    comparison = results.comparison
    model = found.model or Model(idle, tuple(found.effects), results.geometry)
    if runs and comparison is not None and found.effects:
        comparison = with_effect(comparison, following(model, document, analysis_band(work)), runs, analysis_band(work))
    made: dict[str, Any] = {
        "diagnosis": document,
        "comparison": comparison,
        "effect_covariance": model.covariance,
        "effect_idle": replace(model.idle, details=None),  # those of the idle model
        "findings": findings,
    }
    # A place between sensors at which an effect was found is a node from here on.
    return made if model.geometry is None else made | {"geometry": model.geometry}
