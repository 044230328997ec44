"""What is said of merged set-ups: which were merged, what did not match, where the joint estimate differs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, ModalModel
from operando.oma.details import JointCheck, SetUp

DIFFERS = 3.0
"""The merged modes and the joint estimate are said to differ from so many standard deviations of their difference on (both use the
same records, so that the difference is smaller than independent ones)."""

SAME_RATIO = 0.003
"""Ratios of frequencies that count as one (relative): three standard deviations of a frequency known to 0.1 %."""


def listed(texts: Sequence[str], most: int = 8) -> str:
    """The first texts and how many more there are."""
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def common_ratio(hz: NDArray[np.float64], others_hz: NDArray[np.float64]) -> float | None:
    """Factor at which nearly all frequencies lie from others in the same order; None where there is none, or it is near 1.

    Each pair proposes its ratio; the one with most pairs within ``SAME_RATIO`` counts, if at least three and four in five modes have it.
    """
    ratios = hz[:, None] / others_hz[None, :]
    best, factor = 0, 1.0
    for ratio in ratios[(ratios > 0.5) & (ratios < 2.0)]:
        near = np.abs(ratios / ratio - 1) < SAME_RATIO
        count = min(int(near.any(axis=1).sum()), int(near.any(axis=0).sum()))
        if count > best:
            best, factor = count, float(np.median(ratios[near]))
    enough = best >= max(3, 0.8 * min(hz.size, others_hz.size))
    return factor if enough and abs(factor - 1) > SAME_RATIO else None


def setup_findings(setups: Sequence[SetUp], hints: Sequence[str], model: ModalModel) -> list[Finding]:
    """What was merged, which set-ups are left out, which of their modes."""
    good = [s for s in setups if not s.failed]
    shared = list(dict.fromkeys(d for s in good for d in s.shared))
    out = [
        Finding(
            "setups_merged",
            f"{len(good)} set-ups of {len(model.dofs)} sensors in all are merged by {listed(shared)}: {model.n_modes} modes",
            "info",
            consequence="frequencies and damping are weighted means over the set-ups, deviations hold the scatter between them",
        )
    ]
    for s, hint in zip(setups, hints, strict=True):
        if s.failed:
            out.append(
                Finding(
                    "setup_left_out",
                    f"set-up with {listed(s.sensors)}: {s.failed}",
                    "warning",
                    file=s.name,
                    consequence="its sensors are in no merged shape",
                    action=hint or "look at this file by itself",
                )
            )
            continue
        alone = [f"{f:.5g} Hz" for f, reason in zip(s.frequencies_hz, s.reasons, strict=True) if reason]
        factor = common_ratio(s.frequencies_hz, model.frequencies_hz) if len(alone) > 0.5 * s.frequencies_hz.size else None
        if factor is not None:
            out.append(
                Finding(
                    "sampling_rate",
                    f"the modes of this set-up lie at {factor:.4f} times the merged ones",
                    "warning",
                    file=s.name,
                    consequence="they are not merged; a wrong sampling rate shifts all modes by one factor, as does a stiffness or "
                    "mass that changed everywhere",
                    action="compare the sampling rate in its header with those of the other files and of the measuring system",
                )
            )
        if alone:
            out.append(
                Finding(
                    "setup_mode_unmatched",
                    f"{len(alone)} of {s.frequencies_hz.size} modes of this set-up match none of another: {listed(alone)}",
                    "info" if len(alone) < 0.5 * s.frequencies_hz.size else "warning",
                    file=s.name,
                    consequence="they are not among the merged modes",
                    action="take one over with select_hz (oma_select_hz in a test file) if it is local to these sensors",
                )
            )
    return out


def unseen_findings(model: ModalModel, seen: NDArray[np.bool_], check: JointCheck) -> list[Finding]:
    """Modes that some set-ups do not see."""
    out = []
    for r in np.flatnonzero(~seen.all(axis=0)):
        gap = [str(d) for d, s in zip(model.dofs, seen[:, r], strict=True) if not s]
        known = np.isfinite(check.frequencies_hz[r])
        out.append(
            Finding(
                "mode_not_in_all_setups",
                f"mode at {model.frequencies_hz[r]:.5g} Hz is not seen by the set-ups of {listed(gap)}",
                "info" if known else "warning",
                consequence="its shape there is that of the joint estimate" if known else "its shape there is set to zero and uncertain",
            )
        )
    return out


def joint_findings(model: ModalModel, check: JointCheck) -> list[Finding]:
    """Where the joint estimate says something else."""
    if not np.any(np.isfinite(check.frequencies_hz)):
        return [Finding("no_joint_estimate", check.text, "info", consequence="the merged modes stand alone")]
    out = []
    f_std, z_std = model.frequency_std_hz, model.damping_ratio_std
    assert f_std is not None
    assert z_std is not None
    for r in np.flatnonzero(np.isfinite(check.frequencies_hz)):
        f, z = float(model.frequencies_hz[r]), float(model.damping_ratios[r])
        df, dz = float(check.frequencies_hz[r]) - f, float(check.damping_ratios[r]) - z
        wide = (np.hypot(f_std[r], check.frequency_std_hz[r]), np.hypot(z_std[r], check.damping_ratio_std[r]))
        if abs(df) > DIFFERS * wide[0] or abs(dz) > DIFFERS * wide[1] or check.mac[r] < 0.9:
            out.append(
                Finding(
                    "joint_estimate_differs",
                    f"mode at {f:.5g} Hz: the joint estimate has {df:+.2g} Hz, damping ratio {100 * (z + dz):.3g} % for "
                    f"{100 * z:.3g} %, MAC {check.mac[r]:.2f}",
                    "info",
                    consequence="the merged values (set-up by set-up) are used; the difference shows how far they depend on the way",
                )
            )
    return out
