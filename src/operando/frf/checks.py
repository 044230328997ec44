"""Checks of an FRF matrix: sign and phase of drive points, reciprocity, coherence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import QUANTITIES, Finding, Frf
from operando.dof import Dof
from operando.frf.leakage import resonance_peaks
from operando.printable import first_few

Array = NDArray[Any]

SIGN_SHARE = 0.8
NOT_RECIPROCAL = 0.05
LOW_COHERENCE = 0.8


def _significant(frf: Frf, i: int, j: int) -> NDArray[np.bool_]:
    """Lines of a pair that are finite and whose power exceeds ten times the variance."""
    h = frf.data[i, j]
    good = np.isfinite(h) & (np.abs(h) > 0)
    if frf.variance is not None:
        variance = frf.variance[i, j]
        good &= ~(np.abs(h) ** 2 < 10 * np.where(np.isfinite(variance), variance, 0))
    return np.asarray(good)


def _dissipated(frf: Frf, response: int, reference: int) -> tuple[NDArray[np.bool_], Array, Array]:
    """Lines of a pair that count; there the factor to accelerance, and the imaginary accelerance in the positive senses."""
    f = frf.frequencies_hz
    good = _significant(frf, response, reference) & (f > 0)
    factor = (2j * np.pi * f[good]) ** (QUANTITIES.index("accelerance") - QUANTITIES.index(frf.quantity))
    sign = frf.responses[response].sign * frf.references[reference].sign
    return good, factor, np.imag(sign * frf.data[response, reference, good] * factor)


def power_share(frf: Frf, response: int, reference: int) -> float:
    """Share of a drive point's dissipated power that has the right sign, from 0 (all wrong) to 1 (all right); NaN without lines.

    The real part of a drive-point mobility is the power that a unit force puts in: never negative for a passive structure
    (accelerance: Im > 0, receptance: Im < 0). It is counted times the frequency, as the imaginary accelerance, so that resonances rule
    and what remains of an offset of the sensors near 0 Hz does not, which a division by the frequency would blow up.
    """
    _, _, dissipated = _dissipated(frf, response, reference)
    if not dissipated.size:
        return float("nan")
    total = float(np.abs(dissipated).sum())
    return float(np.maximum(dissipated, 0).sum() / total) if total > 0 else float("nan")


def power_signs(frf: Frf, response: int, reference: int) -> tuple[float, float]:
    """Shares of the lines at which the power at a pair flows in, and out, beyond three standard deviations: (1, 0) at a drive point."""
    good, factor, dissipated = _dissipated(frf, response, reference)
    if not dissipated.size:
        return 0.0, 0.0
    variance = np.zeros_like(dissipated) if frf.variance is None else frf.variance[response, reference, good]
    limit = 3 * np.sqrt(np.where(np.isfinite(variance), variance, 0) / 2) * np.abs(factor)
    return float(np.mean(dissipated > limit)), float(np.mean(dissipated < -limit))


def reversing(reference: Dof) -> str:
    """What to write where the force at a DOF has the sense opposite to the accelerometer's."""
    return f'reverse the one that is wrong; the force, for example, by [channels] "{reference}:force" = {{dof = "{reference.opposite}"}}'


def check_drive_points(frf: Frf) -> list[Finding]:
    """Sign and phase of every drive-point FRF, and references without one.

    Parameters
    ----------
    frf : Frf
        FRFs.

    Returns
    -------
    list of Finding
        ``inverted`` where nearly all dissipated power is negative (force or response channel of the wrong sign);
        ``drive_point_sign`` where the sign is mixed (force and response not at the same point, a delay, or a wrong label);
        ``missing_drive_point``, once, for the references without a response on their DOF.

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.frf import check_drive_points
    >>> check_drive_points(frf)
    []
    """
    out: list[Finding] = []
    pairs = {j: i for i, j in frf.drive_points() if np.isfinite(frf.data[i, j]).any()}
    lacking = [str(reference) for j, reference in enumerate(frf.references) if j not in pairs]
    if lacking:
        out.append(missing_drive_points(lacking, frf.name or None, len(pairs)))
    for j, reference in enumerate(frf.references):
        if j not in pairs:
            continue
        i = pairs[j]
        share = power_share(frf, i, j)
        label = f"{frf.responses[i]}/{reference}"
        if np.isnan(share):
            continue
        if share < 1 - SIGN_SHARE:
            out.append(
                Finding(
                    "inverted",
                    f"drive point {label}: {100 * (1 - share):.0f} % of the dissipated power is negative",
                    "error",
                    file=frf.name or None,
                    dof=str(frf.responses[i]),
                    consequence="force and accelerometer have opposite senses there: fits and comparisons reverse one of the two",
                    action=reversing(reference),
                )
            )
        elif share < SIGN_SHARE:
            out.append(
                Finding(
                    "drive_point_sign",
                    f"drive point {label}: only {100 * share:.0f} % of the dissipated power is positive",
                    "warning",
                    file=frf.name or None,
                    dof=str(frf.responses[i]),
                    consequence="the scale of the mode shapes from this drive point is doubtful",
                    action="check that force and response are at the same location and direction, and that no channel is delayed",
                )
            )
    return out


def opposed_dofs(frf: Frf, known: Sequence[Dof] = ()) -> tuple[Dof, ...]:
    """References whose force and accelerometer have opposite senses: nearly all power dissipated at the drive point is negative.

    Those ``known`` are opposite in another measurement with the same sensors: here too, unless nearly all power is positive. Noise leaves
    it open.
    """
    pairs = [(i, j) for i, j in frf.drive_points() if np.isfinite(frf.data[i, j]).any()]
    shares = ((frf.references[j], power_share(frf, i, j)) for i, j in pairs)
    return tuple(d for d, share in shares if share < (SIGN_SHARE if any(d.same_axis(o) for o in known) else 1 - SIGN_SHARE))


def in_one_sense(frf: Frf, opposed: Sequence[Dof]) -> Frf:
    """The FRFs with the polarity reversed of what stays at the DOFs ``opposed``: the accelerometer of a roving hammer, else the force.

    The EMA does the same to FRFs whose drive points absorb no power, so models have this sense.
    """
    if not opposed:
        return frf
    there = [np.array([any(d.same_axis(o) for o in opposed) for d in dofs]) for dofs in (frf.responses, frf.references)]
    hammer_roves = len({d.key for d in frf.references}) > len({d.key for d in frf.responses})
    sign = np.where(there[0][:, None], -1.0, 1.0) if hammer_roves else np.where(there[1][None, :], -1.0, 1.0)
    return replace(frf, data=frf.data * np.broadcast_to(sign, frf.data.shape[:2])[..., None])


def with_fewer_references(frf: Frf) -> Frf:
    """FRFs of a structure at rest with responses and references exchanged where the references are more, as of a roving hammer.

    H is symmetric there (Maxwell's reciprocity). The shape at a reference is part of all of its FRFs, that at a response of its own alone:
    of 64 references and one response a fit of complex modes has 3300 unknowns that all share, of the FRFs exchanged 280.
    """
    if len(frf.references) <= len(frf.responses):
        return frf
    turned: Any = {}
    for name in ("data", "variance", "coherence", "setups"):
        own = getattr(frf, name)
        turned[name] = None if own is None else np.swapaxes(own, 0, 1)
    return replace(frf, responses=frf.references, references=frf.responses, **turned)


def check_rigid_body_signs(frf: Frf) -> list[Finding]:
    """Responses of the wrong sense, seen where a freely suspended structure moves as a rigid body.

    Below a quarter of the first flexible resonance all parallel responses of a translating body are equal. Flagged is a response that is
    opposite and of the same size (within a third) as at least three others, which form the majority and move with the force
    (accelerance Re > 0). Nothing is said where sizes differ (rotation, structures on ground).
    """
    accelerance = frf.to_quantity("accelerance").data
    peaks = resonance_peaks(frf.frequencies_hz, np.nan_to_num(accelerance), frf.variance)
    out: dict[int, Finding] = {}
    # The lowest peak may be the body on its suspension: every peak is tried as the first flexible one.
    for peak in peaks:
        lines = frf.axis.band(0.08 * peak.frequency_hz, 0.25 * peak.frequency_hz)
        for j, reference in enumerate(frf.references):
            rows = [i for i, d in enumerate(frf.responses) if d.axis == reference.axis and d.axis in ("X", "Y", "Z")]
            if len(rows) < 4 or lines.stop - lines.start < 3:
                continue
            sign = np.array([frf.responses[i].sign for i in rows]) * reference.sign
            opposite = _opposite_in_translation(accelerance[rows, j, lines] * sign[:, None])
            for i in (rows[k] for k in opposite):
                low, high = float(frf.frequencies_hz[lines][0]), float(frf.frequencies_hz[lines][-1])
                out.setdefault(
                    i,
                    Finding(
                        "inverted",
                        f"{frf.responses[i]} moves against {len(rows) - len(opposite)} parallel responses of the same size "
                        f"at {low:.3g} to {high:.3g} Hz, where the body is rigid",
                        "warning",
                        file=frf.name or None,
                        dof=str(frf.responses[i]),
                        band_hz=(low, high),
                        consequence="the channel or its label has the wrong sign: wrong mode shapes",
                        action="write the DOF in its other sense in [channels]",
                    ),
                )
    return list(out.values())


def _opposite_in_translation(h: Array) -> list[int]:
    """Rows opposite to the majority, where all rows (n_rows, n_lines) are of the same size and the majority moves with the force."""
    if not np.isfinite(h).all():
        return []
    typical = np.median(h.real, axis=0)
    size = float(np.sum(typical**2))
    if size == 0 or np.mean(typical) <= 0:
        return []
    # Along the typical motion: 1 for a response that moves with it, −1 for an inverted one; the rest must be small.
    along = h.real @ typical / size
    across = np.sqrt(np.sum(np.abs(h - along[:, None] * typical) ** 2, axis=1) / size)
    if np.any(across > 0.5) or np.any(np.abs(along) > 4 / 3) or np.any(np.abs(along) < 3 / 4):
        return []
    opposite = [int(k) for k in np.flatnonzero(along < 0)]
    return opposite if len(along) - len(opposite) >= max(3, 2 * len(opposite)) else []


def missing_drive_points(lacking: Sequence[str], file: str | None, others: int) -> Finding:
    """The finding for the references of a state that no response sits on; ``others`` have one and scale the modes."""
    shown = first_few(lacking)
    one = len(lacking) == 1
    text = f"no response on the reference DOF {shown}" if one else f"no response on {len(lacking)} reference DOFs ({shown})"
    return Finding(
        "missing_drive_point",
        text,
        "info" if others else "warning",
        file=file,
        dof=lacking[0] if one else None,
        consequence=f"{others} other drive point{'s' * (others > 1)} scale the modes"
        if others
        else "modes cannot be scaled to unit modal mass",
        action="" if others else "measure the response where a force acts",
    )


def reciprocity_error(frf: Frf) -> float | None:
    """Largest relative reciprocity error of the pairs of references, noise taken off; None without such a pair.

    sqrt(Σ|H_ij − H_ji|²/Σ½(|H_ij|² + |H_ji|²)) over the lines with a
    signal-to-noise ratio above 10, the expected noise power taken off the numerator.

    Parameters
    ----------
    frf : Frf
        FRFs.

    Returns
    -------
    float or None

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.frf import reciprocity_error
    >>> round(reciprocity_error(frf), 6)
    0.0
    """
    errors = reciprocity_pairs(frf)
    return max(errors.values()) if errors else None


def reciprocity_pairs(frf: Frf) -> dict[tuple[str, str], float]:
    """Relative reciprocity error of each pair of references that both are measured (see :func:`reciprocity_error`)."""
    out: dict[tuple[str, str], float] = {}
    for first, second, forward, backward, total in frf.both_ways():
        good = np.isfinite(forward) & np.isfinite(backward)
        noise = 0.0
        if total is not None:
            size = np.minimum(np.abs(forward) ** 2, np.abs(backward) ** 2)
            good &= np.isfinite(total) & (size > 10 * np.where(np.isfinite(total), total, 0))
            noise = float(total[good].sum())
        power = 0.5 * float(np.sum(np.abs(forward[good]) ** 2 + np.abs(backward[good]) ** 2))
        if good.any() and power > 0:
            difference = float(np.sum(np.abs(forward[good] - backward[good]) ** 2))
            out[(str(first), str(second))] = float(np.sqrt(max(difference - noise, 0.0) / power))
    return out


def check_frf(frf: Frf, band: tuple[float, float] | None = None) -> Frf:
    """The FRF with the findings of all checks: drive points, reciprocity, and coherence in a band [Hz], else on all lines.

    Parameters
    ----------
    frf : Frf
        FRFs.
    band : (float, float), optional
        Band [Hz].

    Returns
    -------
    Frf

    Examples
    --------
    >>> import numpy as np, operando
    >>> idle = operando.ModalModel([20.0, 45.0], [0.01, 0.02], np.array([[1, 1], [1, -1]]), "1+Z, 2+Z", "unit_modal_mass")
    >>> frf = idle.frf(np.arange(5, 80, 0.1))
    >>> from operando.frf import check_frf
    >>> check_frf(frf).findings
    ()
    """
    findings = [*check_drive_points(frf), *check_rigid_body_signs(frf)]
    for (first, second), error in reciprocity_pairs(frf).items():
        if error > NOT_RECIPROCAL:
            findings.append(
                Finding(
                    "not_reciprocal",
                    f"H at {second} from {first} and at {first} from {second} differ by {100 * error:.2g} %",
                    "warning",
                    file=frf.name or None,
                    dof=f"{first},{second}",
                    consequence="a symmetric model cannot represent both; gyroscopic or circulatory effects, or a calibration error",
                    action="check calibration and mounting; repeat one of the two",
                )
            )
    if frf.coherence is not None:
        findings += _low_coherence(frf, band)
    return frf.with_findings(findings)


def _low_coherence(frf: Frf, band: tuple[float, float] | None) -> list[Finding]:
    """Responses whose coherence is low on most lines of the band: above it a shaker may leave nothing to see."""
    out = []
    assert frf.coherence is not None
    low_hz, high_hz = band or (0.0, np.inf)
    lines = (frf.frequencies_hz >= low_hz) & (frf.frequencies_hz <= high_hz)
    for j, reference in enumerate(frf.references):
        low = {}
        for i, response in enumerate(frf.responses):
            values = frf.coherence[i, j][lines & np.isfinite(frf.coherence[i, j])]
            if values.size and float(np.median(values)) < LOW_COHERENCE:
                low[str(response)] = float(np.median(values))
        if low:
            worst = min(low, key=lambda k: low[k])
            names = first_few(low)
            out.append(
                Finding(
                    "low_coherence",
                    f"median coherence with {reference} below {LOW_COHERENCE:g} at {names}; lowest {low[worst]:.3f} at {worst}",
                    "warning",
                    file=frf.name or None,
                    dof=worst,
                    consequence="large variance of these FRFs",
                    action="more averages, a stronger excitation, or another location",
                )
            )
    return out
