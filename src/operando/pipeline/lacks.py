"""What a test lacks for a stage: asked before a run whose purpose it is, and by every run."""

from __future__ import annotations

from operando.config import Test
from operando.errors import ObjectError


def lacking(test: Test, stage: str) -> str | None:
    """Why a stage cannot be made of this test, None where it can.

    Parameters
    ----------
    test : Test
    stage : str
        One of ``operando.pipeline.STAGES``.

    Raises
    ------
    ObjectError
        If the first argument is no test.
    """
    if not isinstance(test, Test):
        raise ObjectError(f"test of lacking is {type(test).__name__}, expected Test", hint="load_test(path) reads one")
    no_idle = None if test.idle else "the test has no [idle] measurement"
    no_operation = None if test.operating else "the test has no [operating] records"
    if stage in ("frf", "ema"):
        return no_idle
    if stage == "oma":
        return no_operation
    if stage == "ofrf":
        return no_idle or no_operation
    if stage == "compare":
        return no_idle or (None if test.check else "the test has no [check] measurement")
    if stage == "diagnose":
        return no_idle or (None if test.check or test.operating else "the test has neither [check] nor [operating] measurements")
    return None
