"""Stage ``ema``: the idle modes, chosen automatically and by hand."""

from __future__ import annotations

from typing import Any

from operando.data import Finding, Frf, TimeRecord
from operando.pipeline.stages.estimate import whole_records
from operando.pipeline.stages.work import Work, needed


def automatic_modes(work: Work) -> dict[str, Any]:
    """Idle modes of unit modal mass, chosen automatically."""
    from operando.ema import fit_ema

    analysis = work.analysis
    findings: list[Finding] = []
    frf = needed(work.results.idle_frf, "idle FRFs")
    records = whole_records(work, work.test.idle, findings, lambda all_: runs_behind(frf, all_)) if work.test.idle.records else None
    found = fit_ema(
        frf,
        band=analysis.band,
        exclude_bands=analysis.exclude_bands,
        records=records,
        max_order=analysis.max_order,
        ema=analysis.ema,
        progress=work.say,
    )
    return {"automatic": found, "findings": findings}


def idle_modes(work: Work) -> dict[str, Any]:
    """The automatic modes with those named by hand; complex where the FRFs ask for it."""
    from operando.diagnosis import with_complex_modes
    from operando.ema import fit_ema

    analysis = work.analysis
    found = needed(work.results.automatic, "idle modes")
    frf = needed(work.results.idle_frf, "idle FRFs")
    if analysis.modes_hz or analysis.select_hz or analysis.reject_hz:
        found = fit_ema(
            frf,
            band=analysis.band,
            exclude_bands=analysis.exclude_bands,
            modes_hz=analysis.modes_hz,
            select_hz=analysis.select_hz,
            reject_hz=analysis.reject_hz,
            automatic=found,
        )
    return {"idle": with_complex_modes(found, frf, progress=work.say)}


def runs_behind(frf: Frf, records: list[TimeRecord]) -> list[TimeRecord]:
    """The runs and channels the FRFs were made of: what was set aside there must not come back through the raw spectra."""
    used = {path for path, _ in frf.provenance.inputs}
    calls = set(frf.provenance.calls)

    def behind(record: TimeRecord) -> bool:
        cuts = [call for call in record.provenance.calls if call.startswith("cut(")]  # of two parts of a file one may be used
        return any(path in used for path, _ in record.provenance.inputs) and all(call in calls for call in cuts)

    runs = [r for r in records if behind(r)] or records
    measured, driven = ({d.key for d in dofs} for dofs in (frf.responses, frf.references))
    out = []
    for run in runs:
        at = [None if (d := c.dof) is None else d.key for c in run.channels]
        keep = [i for i in run.response_indices if at[i] in measured] + [i for i in run.force_indices if at[i] in driven]
        if len(keep) == len(run.response_indices) + len(run.force_indices):
            out.append(run)
        elif all(at[i] in driven for i in run.force_indices) and any(i in keep for i in run.response_indices):
            out.append(run.select(sorted(keep)))
    return out
