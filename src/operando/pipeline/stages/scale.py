"""What the stages that need FRFs of unit modal mass ask of the idle modes first."""

from __future__ import annotations

from collections.abc import Sequence

from operando.data import Finding, ModalModel
from operando.errors import IdentificationError
from operando.pipeline.stages.work import Lacking


def scaled(idle: ModalModel, findings: Sequence[Finding], what: str) -> None:
    """Ask for unit modal mass in SI: Lacking where the data never had it, IdentificationError where a fault of the measurement hides it."""
    from operando.scaling.no_scale import no_scale

    cause = no_scale(idle, findings)
    if cause is not None:
        text = f"the idle modes have no scale, so {what}: {cause[0]}"
        raise IdentificationError(text, hint=cause[1]) if cause[2] else Lacking(text, hint=cause[1])
