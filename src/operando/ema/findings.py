"""What the fit noticed about the data: missing drive points and units, wrong senses, modes nobody scales, misfit."""

from __future__ import annotations

import numpy as np

from operando.data import Finding, Frf
from operando.dof import Dof
from operando.ema.order import OrderLog
from operando.ema.polish_model import Real


def turned_finding(dof: str) -> Finding:
    """Force and accelerometer at ``dof`` have opposite senses; the fit turned the force."""
    return Finding(
        "drive_point_sign",
        f"the drive-point residues at {dof} are negative: force and accelerometer there have opposite senses",
        "error",
        dof=dof,
        consequence="the fit used the force with the opposite sense; FRFs of this reference in idle_frf.uff keep the measured one",
        action="check the direction of the force sensor and of the accelerometer at this DOF, and correct the label or the polarity",
    )


def fit_findings(frf: Frf, dofs: tuple[Dof, ...], hz: Real, band: tuple[float, float], log: OrderLog, misfit: float) -> list[Finding]:
    """Findings of one fit."""
    out = []
    drive = [r for r in frf.references if any(r.same_axis(d) for d in frf.responses)]
    if not drive:
        out.append(
            Finding(
                "missing_drive_point",
                "no reference has a response on its own DOF",
                "error",
                consequence="the shapes keep an arbitrary scale: no unit modal mass, no FRF of undriven pairs, no operational FRF",
                action="measure the response at one of the references",
            )
        )
    if not frf.si:
        out.append(
            Finding(
                "missing_unit",
                "the units of force or response are not known",
                "warning",
                consequence="frequencies and damping are right, the scaling to unit modal mass is left out",
                action="give acceleration and force in [units] of the test file",
            )
        )
    for h in log.unseen_hz:
        if drive and band[0] <= h <= band[1]:
            out.append(
                Finding(
                    "drive_point_sign",
                    f"no drive point gives the mode at {h:.4g} Hz a positive modal mass",
                    "warning",
                    band_hz=(0.98 * h, 1.02 * h),
                    consequence="its scale rests on the maximum-likelihood fit alone and is uncertain",
                    action="check the sense of force and response at the drive points, or add a reference that sees this mode",
                )
            )
    for h, value in log.wrong_sign:
        if h not in log.unseen_hz and band[0] <= h <= band[1]:
            out.append(
                Finding(
                    "drive_point_sign",
                    f"a drive-point residue of the mode at {h:.4g} Hz has the wrong sign ({value:.3g} 1/kg): negative modal mass",
                    "warning",
                    band_hz=(0.98 * h, 1.02 * h),
                    consequence="that drive point contradicts the others",
                    action="check the sense of the force sensor and the accelerometer there",
                )
            )
    if np.isfinite(misfit) and misfit > 3:
        out.append(
            Finding(
                "misfit",
                f"the idle model misses held-out lines by {misfit:.3g} times their variance",
                "warning",
                consequence="noise does not limit this model: real modes, linearity or stationarity fail; intervals are widened",
                action="look at the misfit by DOF, at complex shapes, and at the level dependence of the FRFs",
            )
        )
    return out
