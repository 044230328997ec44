"""Stage ``frf``: the idle FRFs."""

from __future__ import annotations

from typing import Any

from operando.pipeline.stages.estimate import estimate
from operando.pipeline.stages.work import Work


def idle_frf(work: Work) -> dict[str, Any]:
    """Idle FRFs, estimated or as given, with drive-point, reciprocity and coherence checks."""
    from operando.frf import check_frf

    idle = work.test.idle
    if idle.frfs:
        frf = work.inputs.frf(idle)
        if work.analysis.references is not None:
            frf = frf.select(references=work.analysis.references)
    else:
        frf = estimate(work.inputs.records(idle, force=True), work.analysis, work.test.rejected_hits(idle))
    return {"idle_frf": check_frf(frf, work.analysis.band)}
