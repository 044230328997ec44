"""Why modes have no scale: the cause that the findings name, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

from operando.data import Finding, ModalModel

DRIVE_POINT = ("swapped", "inverted", "drive_point_sign", "missing_drive_point")
"""Findings that explain a missing scale where units are known, the surest first."""


FAULTS = ("swapped", "inverted", "drive_point_sign")
"""Those of them that are faults of the measurement: what it should have given fails, where otherwise it was never there."""


def no_scale(idle: ModalModel, findings: Sequence[Finding]) -> tuple[str, str, bool] | None:
    """Cause, advice, and whether a fault is to blame, where the idle modes are not of unit modal mass in SI; None where they are."""
    if idle.scaling == "unit_modal_mass" and idle.si:
        return None
    by_kind = {f.kind: f for f in reversed(findings)}
    if not idle.si:
        found = by_kind.get("missing_unit")
        text = f": {found.message}" if found is not None else ""
        return (
            f"the units of force or response are not known{text}",
            "give the units the files do not state in [units] or [channels]",
            False,
        )
    for kind in DRIVE_POINT:
        if kind in by_kind:
            return f"{by_kind[kind].message}: {by_kind[kind].consequence}", by_kind[kind].action or "check the drive point", kind in FAULTS
    return "no drive point shows the modes", "measure the response where a force acts, and move the force to where the modes move", False
