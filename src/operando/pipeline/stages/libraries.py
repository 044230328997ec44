"""Steps of the stages ``ema`` and ``oma``: sdypy-EMA and pyOMA-2 on the same data, where the test asks for them."""

from __future__ import annotations

from typing import Any

from operando.pipeline.stages.work import Work, needed


def idle_libraries(work: Work) -> dict[str, Any]:
    """sdypy-EMA beside the idle modes."""
    from operando.contrib import compare_libraries

    frf, model = needed(work.results.idle_frf, "idle FRFs"), needed(work.results.idle, "idle modes")
    taken = work.results.timings_s.get("ema")
    found = compare_libraries(frf, idle=model, own_seconds={} if taken is None else {"idle": taken})
    return {"idle_libraries": [c.to_dict() for c in found]}


def operating_libraries(work: Work) -> dict[str, Any]:
    """pyOMA-2 beside the operational modes."""
    from operando.contrib import compare_libraries

    model = needed(work.results.operating, "operational modes")
    records = work.inputs.records(work.test.operating, force=False)
    taken = work.results.timings_s.get("oma")
    found = compare_libraries(records=records, operating=model, own_seconds={} if taken is None else {"operating": taken})
    return {"operating_libraries": [c.to_dict() for c in found]}
