"""Stage ``ofrf``: operational modes with the scale of the idle ones."""

from __future__ import annotations

from typing import Any

from operando.pipeline.stages.scale import scaled
from operando.pipeline.stages.work import Lacking, Work, needed


def hybrid(work: Work) -> dict[str, Any]:
    """Operational modes with the scale of the idle ones."""
    from operando.scaling import scale_operational

    idle = needed(work.results.idle, "idle modes")
    operating = needed(work.results.operating, "operational modes")
    scaled(idle, work.results.findings, "there is none to carry over")
    if not operating.n_modes:
        raise Lacking(
            "the operational records show no mode in the band",
            hint="the stabilisation diagram of the operating state shows what was rejected and why; try a wider band or a longer record",
        )
    from operando.quality import check_shapes

    made = scale_operational(idle, operating, work.analysis.threshold, work.analysis.scaling)
    pairs = [(p.idle, p.operating) for p in made.pairing.pairs if p.idle is not None]
    return {"hybrid": made, "findings": check_shapes(idle, operating.without_residuals(), pairs)}
