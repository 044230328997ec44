"""First step of stage ``compare``: the FRFs of the check measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from operando.config import Analysis, State
from operando.data import Finding, Frf
from operando.pipeline.stages.estimate import estimate
from operando.pipeline.stages.work import Work
from operando.results import CheckRun


def check_runs(work: Work) -> dict[str, Any]:
    """Check FRFs: all runs in one where they agree, else by level."""
    from operando.frf import check_frf
    from operando.pipeline.levels import check_frfs

    check = work.test.check
    findings: list[Finding] = []
    runs: list[CheckRun] = []
    if check.records:
        records = work.inputs.records(check, force=True)
        rejected = work.test.rejected_hits(check)
        runs = check_frfs(records, lambda part: estimate(part, _judging(work.analysis), findings, rejected))
    for file in check.frfs:
        runs.append(CheckRun(work.inputs.label(file), "as given", work.inputs.frf(State(frfs=(file,)))))
    checked = [replace(run, frf=_of_check(check_frf(run.frf, work.analysis.band))) for run in runs]
    return {"check": checked, "findings": list(dict.fromkeys(findings))}


def _of_check(frf: Frf) -> Frf:
    """Findings that say that they are about the check measurement."""
    return replace(frf, findings=tuple(replace(f, message=f"validation measurement: {f.message}") for f in frf.findings))


def _judging(analysis: Analysis) -> Analysis:
    """Settings of the check FRFs: the references of the idle FRFs do not bind them."""
    return replace(analysis, references=None)
