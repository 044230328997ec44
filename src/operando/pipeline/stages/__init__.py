"""The stages of the pipeline in order, each in a file of its own; pure in their inputs, settings and upstream results.

What code a stage depends on is found by following the imports of its file; what data and settings it depends on stands here, and a
test holds it against what the stages read.
"""

from __future__ import annotations

from operando.config import Test
from operando.pipeline.names import FREQUENCIES
from operando.pipeline.stages.check import check_runs
from operando.pipeline.stages.compare import comparison
from operando.pipeline.stages.diagnose import missing_physics
from operando.pipeline.stages.ema import automatic_modes, idle_modes, runs_behind
from operando.pipeline.stages.files import inspect_files
from operando.pipeline.stages.frf import idle_frf
from operando.pipeline.stages.libraries import idle_libraries, operating_libraries
from operando.pipeline.stages.ofrf import hybrid
from operando.pipeline.stages.oma import operational_modes
from operando.pipeline.stages.work import Lacking, Stage, Work, none_read

__all__ = ["STEPS", "Lacking", "Stage", "Work", "none_read", "runs_behind"]

_ESTIMATING = ("references", "estimator", "block_seconds", "overlap", "window", "hits", "hits_reject")
_EMA_SETTINGS = ("band", "hits_reject", "max_order", "ema", "exclude_bands")
_OMA_SETTINGS = ("oma_max_order", "oma_references", "known_harmonics_hz", "oma_select_hz", "oma_reject_hz")


def _libraries(test: Test) -> bool:
    return test.analysis.second_opinion


STEPS: tuple[Stage, ...] = (
    Stage(
        "inspect",
        "inspect",
        inspect_files,
        settings=("hits_reject", "references", "oma_references", "band", "exclude_bands", "places", *FREQUENCIES),
        states=("idle", "operating", "check", "geometry"),
    ),
    Stage("frf", "frf", idle_frf, settings=("band", *_ESTIMATING), states=("idle",)),
    Stage("automatic", "ema", automatic_modes, ("frf",), _EMA_SETTINGS, ("idle",)),
    Stage("ema", "ema", idle_modes, ("frf", "automatic"), (*_EMA_SETTINGS, "modes_hz", "select_hz", "reject_hz"), ("idle",)),
    Stage("oma", "oma", operational_modes, (), ("band", "exclude_bands", *_OMA_SETTINGS), ("operating",)),
    Stage("idle_libraries", "ema", idle_libraries, ("frf", "ema"), ("second_opinion",), wanted=_libraries),
    Stage("operating_libraries", "oma", operating_libraries, ("oma",), ("second_opinion",), ("operating",), _libraries),
    Stage("ofrf", "ofrf", hybrid, ("ema", "oma"), ("threshold", "scaling")),
    Stage("check", "compare", check_runs, (), ("band", *_ESTIMATING), ("check",)),
    Stage("compare", "compare", comparison, ("ema", "ofrf", "check"), ("band", "threshold", "exclude_bands")),
    Stage(
        "diagnose",
        "diagnose",
        missing_physics,
        ("inspect", "ema", "oma", "ofrf", "check", "compare"),
        ("band", "exclude_bands", "hits_reject", "kinds", "places"),
    ),
)
