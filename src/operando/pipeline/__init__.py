"""A test in, a results folder out: stages cached by the content of their inputs, resumable.

The stages are imported when one is to be run: a test that is unchanged needs none of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from operando.pipeline.lacks import lacking

if TYPE_CHECKING:
    from operando.pipeline.runner import run as run

STAGES = ("inspect", "frf", "ema", "oma", "ofrf", "compare", "diagnose", "report")
"""Stages of the contract, in order."""

__all__ = ["STAGES", "lacking", "run"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name != "run":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from operando.pipeline.runner import run

        return run
