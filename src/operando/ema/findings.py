"""What the fit noticed about the data: missing drive points and units, wrong senses, modes nobody scales, reduced chi-square."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, counted
from operando.dof import Dof
from operando.ema.answers import LinearModes
from operando.ema.doubts import Evidence
from operando.ema.linear import LinearFit
from operando.ema.unit_mass import SEEN, UnitMassShapes
from operando.frf import reversing

NOTABLE_DRIFT = 5e-4
"""Twice the drift that a day in a laboratory makes of itself (1–3·10⁻⁴ on seven states of a plate)."""

NOTABLE_QUADRATURE = 0.15
"""A phase of 9°: real modes with 5 % errors of single pairs stay below 0.13 on a bridge and a plate."""

NOTABLE_ERROR = 0.03

NOTABLE_OFFSET = 0.03
"""As much as an explanation may leave (contract, "Verdicts"): it is 1.0 % on a bookcase, 1.3 % on a bridge, 37 % on a plate."""

NOTABLE_RESIDUE = 0.05
"""A drive-point residue of less than this part of the mode's largest one stands near a node: a neighbour or a phase makes it negative, as
of a close mode of the same size that is 3° out of phase (sin 3° = 0.05, projection.QUADRATURE_GUESS)."""

NOTABLE_MISFIT = 1.5
"""Reduced chi-square of the model over that of the fit behind it (at least 1) from which a finding says so: something is left above 1.5
(contract, "Verdicts"). Where real shapes are true the two differ by 0.12 at most
(tests/test_ema_handed_out.py)."""

_LEFT_OUT = {
    "phase": (
        "real shapes do not describe them; the standard deviations of the shapes hold the part that is left out",
        "try complex modes: operando.diagnosis.with_complex_modes(model, idle_frf), as operando run does by itself, takes them where they "
        "explain more; local dampers look like this",
    ),
    "shape": (
        "residues of the pairs contradict one shape of unit modal mass",
        "check reciprocity, and gains, senses and positions of force and sensors at the DOFs of large reduced chi-square",
    ),
    "shift": (
        "modes differ between the pairs, and the model has one frequency for all",
        "measure all rows in one go at constant temperature, or with lighter roving sensors, or dummy masses",
    ),
    "outside": (
        "the residual terms do not describe what lies outside the band",
        "widen the band to the nearest modes beside it; damping of a suspension below the band, and an offset of the sensors, which no "
        "structure has, look alike",
    ),
}
"""Consequence and action by what the model goes without most."""


def turned_finding(dof: str) -> Finding:
    """Force and accelerometer at ``dof`` have opposite senses; the fit reversed the polarity of the force."""
    return Finding(
        "drive_point_sign",
        f"the drive-point residues at {dof} are negative: force and accelerometer there have opposite senses",
        "error",
        dof=dof,
        consequence="modes and their scale are right: the fit reversed the polarity of the one of the two that stays, and so do "
        "comparison and diagnosis with measured FRFs; idle_frf.uff keeps the measured one",
        action=reversing(Dof.parse(dof)),
    )


@dataclass(frozen=True)
class DriveResidues:
    """Modes to which no drive point gives a scale.

    In those of ``absent_hz`` none moves by more than three standard deviations: as at a node. In those of ``negative_hz`` a drive-point
    residue is below zero by more than that, and no small part of the mode: a negative modal mass.
    """

    absent_hz: tuple[float, ...] = ()
    negative_hz: tuple[float, ...] = ()


def drive_residues(fit: LinearFit, mass: UnitMassShapes, sure: NDArray[np.bool_]) -> DriveResidues:
    """What the drive points say of the modes that are no doubtful poles."""
    if not mass.drive:
        return DriveResidues()
    hz, a = fit.mean_hz, fit.projection.a
    notable = NOTABLE_RESIDUE * np.max(np.abs(a), axis=0)
    negative = sure & np.any([(t < -SEEN) & (a[pair] < -notable) for pair, t in mass.drive], axis=0)
    absent = sure & ~mass.scaled & ~negative
    return DriveResidues(tuple(map(float, hz[absent])), tuple(map(float, hz[negative])))


def fit_findings(frf: Frf, band: tuple[float, float], drive: DriveResidues) -> list[Finding]:
    """Findings of one fit."""
    out = []
    if not frf.drive_points():
        out.append(
            Finding(
                "missing_drive_point",
                "no reference has a response on its own DOF",
                "error",
                consequence="the shapes keep an arbitrary scale, at the responses alone (at the references, if there are more of these): "
                "no unit modal mass, no FRF of the model, no operational FRF",
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
    if absent := [h for h in drive.absent_hz if band[0] <= h <= band[1]]:
        out.append(
            Finding(
                "drive_point_at_node",
                f"no drive point moves beyond its uncertainty in {_at(absent)}",
                "info",
                band_hz=(0.98 * min(absent), 1.02 * max(absent)),
                consequence="the scale of these modes is uncertain",
                action="add a reference that sees these modes, if their scale is wanted",
            )
        )
    if wrong := [h for h in drive.negative_hz if band[0] <= h <= band[1]]:
        out.append(
            Finding(
                "drive_point_sign",
                f"a drive-point residue of {_at(wrong)} has the wrong sign: negative modal mass",
                "warning",
                band_hz=(0.98 * min(wrong), 1.02 * max(wrong)),
                consequence="that drive point contradicts the others and gives these modes no scale",
                action="check the sense of the force sensor and the accelerometer there, and whether both sit at the same point",
            )
        )
    return out


def misfit_findings(misfit: float, free: float = float("nan"), parts: Mapping[str, float] | None = None) -> list[Finding]:
    """That the model does not describe the FRFs to within noise, where it does not: as the fit behind it does, or nothing does.

    Both reduced chi-squares are of lines the fit did not use, ``free`` that of the fit behind the model
    (:class:`operando.ema.handed_out.Left`; NaN where there is none); ``parts`` is what stands between the two.
    """
    said = f"the reduced chi-square of the idle model on lines the fit did not use is {misfit:.3g}"
    if parts and misfit > NOTABLE_MISFIT * max(free, 1.0):
        said += f"; the fit behind it, with unknowns of its own in each pair, has {free:.3g}"
        consequence, action = _LEFT_OUT[max(parts, key=lambda name: parts[name])]
        return [
            Finding("misfit", said, "warning", consequence=f"FRFs of the model are off by more than noise: {consequence}", action=action)
        ]
    if not (np.isfinite(misfit) and misfit > 3):
        return []
    return [
        Finding(
            "misfit",
            said,
            "warning",
            consequence="noise does not limit this model: real modes, linearity or stationarity fail; intervals are widened",
            action="look at the reduced chi-square by DOF, at complex shapes, and at the level dependence of the FRFs",
        )
    ]


def unfinished_finding(steps: int, reduced_chi_square: float) -> Finding:
    """The maximum-likelihood fit ended before its minimum."""
    return Finding(
        "not_converged",
        f"the maximum-likelihood fit of the idle modes ended after {steps} steps before its minimum (reduced chi-square "
        f"{reduced_chi_square:.3g})",
        "warning",
        consequence="modes may be off their most probable values by more than their standard deviations say",
        action='end the band between two modes, or take ema = "linear"',
    )


def _at(hz: Sequence[float]) -> str:
    """«the mode at 12.3 Hz», «the modes at 12.3, 14.5, … Hz (7 in all)»."""
    if len(hz) == 1:
        return f"the mode at {hz[0]:.4g} Hz"
    shown = ", ".join(f"{h:.4g}" for h in hz[:6])
    return f"the modes at {shown}{f', … Hz ({len(hz)} in all)' if len(hz) > 6 else ' Hz'}"


def linear_findings(modes: LinearModes, band: tuple[float, float], undriven: int) -> list[Finding]:
    """What the linear stage noticed: modes that move between pairs, complex ones, poles in doubt, a large model error."""
    out = []
    inside = [(h, e) for h, e in zip(modes.frequencies_hz, modes.evidence, strict=True) if band[0] <= h <= band[1]]
    moving = [(float(h), e.drift) for h, e in inside if e.drift > NOTABLE_DRIFT and not e.doubts]
    if moving:
        out.append(
            Finding(
                "mode_drift",
                f"the frequency of {_at([h for h, _ in moving])} differs between the pairs, "
                f"by up to {100 * max(d for _, d in moving):.2g} % rms",
                "info",
                band_hz=(min(h for h, _ in moving), max(h for h, _ in moving)),
                consequence="each pair has its own small shift in the fit; the frequency stated is the mean",
                action="measure all rows in one go at constant temperature, or with lighter roving sensors, or dummy masses",
            )
        )
    turned = [(float(h), e.quadrature) for h, e in inside if e.quadrature > NOTABLE_QUADRATURE and not e.doubts]
    if turned:
        out.append(
            Finding(
                "complex_modes",
                f"residues of {_at([h for h, _ in turned])} are not in phase (quadrature part {100 * max(q for _, q in turned):.0f} % rms)",
                "info",
                band_hz=(min(h for h, _ in turned), max(h for h, _ in turned)),
                consequence="the fit of the FRFs is complex; the shapes stated are the real parts",
                action="local dampers, close modes and modes that move between rows look like this",
            )
        )
    pairs = [float(h) for h, e in inside if any(code == "close_pair" for code, _ in e.doubts)]
    if pairs:
        out.append(
            Finding(
                "close_pair",
                f"the residues of {_at(pairs)} make two shapes: two modes too close to tell their frequencies",
                "info",
                band_hz=(0.98 * min(pairs), 1.02 * max(pairs)),
                consequence="one mode is reported for both, and the second shape is a residual term: FRFs are those of both, and shapes "
                "are any two of the plane that the two modes span",
                action="FRFs with less noise, with their coherence, or more lines and references tell more",
            )
        )
    out += doubtful_findings(inside)
    if modes.model_error > NOTABLE_ERROR:
        out.append(
            Finding(
                "model_error",
                f"the FRFs differ from any set of modes by {100 * modes.model_error:.2g} % of themselves"
                " (median of the pairs, each with residues of its own)",
                "warning" if modes.model_error > 0.1 else "info",
                consequence="this error, not the noise, sets the uncertainties",
                action="hits, temperature, level and mounting are the usual reasons",
            )
        )
    if modes.sensor_offset > NOTABLE_OFFSET:
        share = f"{100 * modes.sensor_offset:.2g} %"
        out.append(
            Finding(
                "sensor_offset",
                f"a term 1/s, as an offset of the sensors makes, is {share} of the FRFs (median over lines and pairs)",
                "warning" if modes.sensor_offset > 0.1 else "info",
                consequence="the fit takes it into account, and the model leaves it out as no part of the structure: between the peaks, "
                "and most below the first of them, its FRFs differ from the measured ones by that much",
                action="subtract the mean before each hit, and look for a step of the base line after it (cable, overload, temperature); "
                "strong damping of a suspension just below the band looks alike",
            )
        )
    if undriven:
        out.append(
            Finding(
                "local_compliance",
                f"{undriven} DOFs were not driven, and the model is too large for a local term at each",
                "info",
                consequence="synthesised drive-point FRFs of these DOFs lack the compliance of their own surroundings",
                action="drive a DOF whose drive-point FRF is needed",
            )
        )
    return out


def quantity_finding(taken_as: str) -> Finding:
    """FRFs whose residues stand at 90°: labelled as another quantity than they are."""
    return Finding(
        "wrong_quantity",
        "at their resonances the FRFs are rotated by 90° against an accelerance",
        "error",
        consequence=f"they were taken for {taken_as}",
        action="check quantity and unit of response and force in the files, or give them in [channels]",
    )


def doubtful_findings(poles: Sequence[tuple[float, Evidence]]) -> list[Finding]:
    """The finding that names poles in band [Hz] that are not reported as modes."""
    doubtful = [(h, e) for h, e in poles if e.doubts]
    if not doubtful:
        return []
    first = "; ".join(f"{h:.5g} Hz: {e.doubts[0][1]}" for h, e in doubtful[:4])
    return [
        Finding(
            "doubtful_pole",
            f"{counted(len(doubtful), 'pole')} in band not reported among the modes ({first}{'; …' if len(doubtful) > 4 else ''})",
            "info",
            consequence="they stay in the synthesis of the FRFs as residual terms",
            action="name those that are modes in select_hz",
        )
    ]
