"""First step of stage ``compare``: the FRFs of the check measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from operando.config import State
from operando.data import Finding
from operando.pipeline.stages.estimate import estimate
from operando.pipeline.stages.work import Work
from operando.results import CheckRun


def check_runs(work: Work) -> dict[str, Any]:
    """Check FRFs: all runs in one where they agree, else by level."""
    from operando.frf import check_frf
    from operando.pipeline.levels import check_frfs

    check = work.test.check
    runs: list[CheckRun] = []
    if check.records:
        records = work.inputs.records(check, force=True)
        rejected = work.test.rejected_hits(check)
        # the references of the idle FRFs do not bind those of the validation measurement
        runs = check_frfs(records, lambda part: estimate(part, replace(work.analysis, references=None), rejected))
    for file in check.frfs:
        runs.append(CheckRun(work.inputs.label(file), "as given", work.inputs.frf(State(frfs=(file,)))))
    checked = [replace(run, frf=check_frf(run.frf, work.analysis.band)) for run in runs]
    return {"check": of_check(checked)}


def of_check(runs: list[CheckRun]) -> list[CheckRun]:
    """The runs with findings that say that they are about the validation measurement, and which one where two say unlike things."""
    told: dict[tuple[str, str | None], set[str]] = {}
    for f in (f for run in runs for f in run.frf.findings if f.file is None):
        told.setdefault((f.kind, f.dof), set()).add(f.message)
    levels = len({run.level for run in runs}) == len(runs)

    def named(run: CheckRun, f: Finding) -> Finding:
        which = f" at {run.level}" if levels else f" {run.name}"
        apart = f.file is None and len(told[f.kind, f.dof]) > 1
        return replace(f, message=f"validation measurement{which if apart else ''}: {f.message}")

    return [replace(run, frf=replace(run.frf, findings=tuple(named(run, f) for f in run.frf.findings))) for run in runs]
