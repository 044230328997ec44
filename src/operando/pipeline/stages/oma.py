"""Stage ``oma``: the operational modes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from operando.data import Finding
from operando.pipeline.stages.work import Work, analysis_band


def operational_modes(work: Work) -> dict[str, Any]:
    """Operational modes, complex and unscaled."""
    from operando.oma import fit_halves, fit_oma

    analysis = work.analysis
    records = work.inputs.records(work.test.operating, force=False)
    operating = fit_oma(
        records,
        band=analysis_band(work),
        max_order=analysis.oma_max_order,
        references=analysis.oma_references or None,
        known_harmonics_hz=analysis.known_harmonics_hz,
        select_hz=analysis.oma_select_hz,
        reject_hz=analysis.oma_reject_hz,
    )
    findings = []
    if analysis.exclude_bands:
        message = "setting exclude_bands has no effect on fit_oma"
        findings.append(Finding("setting_unused", message, "warning", consequence="this stage runs as if it were not set"))
    if work.test.idle and not work.test.check:
        # The diagnosis from operational modes chooses on one half of the record and is judged on the other.
        operating = replace(operating, details=replace(operating.details, halves=fit_halves(records, operating)))
    return {"operating": operating, "findings": findings}
