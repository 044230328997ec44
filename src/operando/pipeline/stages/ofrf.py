"""Stage ``ofrf``: operational modes with the scale of the idle ones."""

from __future__ import annotations

from typing import Any

from operando.pipeline.scale import no_scale
from operando.pipeline.stages.work import Lacking, Work, needed


def hybrid(work: Work) -> dict[str, Any]:
    """Operational modes with the scale of the idle ones."""
    from operando.scaling import scale_operational

    idle = needed(work.results.idle, "idle modes")
    operating = needed(work.results.operating, "operational modes")
    if (cause := no_scale(idle, work.results.findings)) is not None:
        raise Lacking(f"the idle modes are not scaled to unit modal mass, so there is no scale to carry over: {cause[0]}", hint=cause[1])
    from operando.quality import check_shapes

    made = scale_operational(idle, operating, work.analysis.threshold, work.analysis.scaling)
    pairs = [(p.idle, p.operating) for p in made.pairing.pairs if p.idle is not None]
    return {"hybrid": made, "findings": check_shapes(idle, operating.without_residuals(), pairs)}
