"""Selected poles that are no modes after all: remains of sinusoids, and poles too uncertain to be a resonance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, row_statistics
from operando.indicators import INTERVAL
from operando.oma.estimate import Estimate
from operando.oma.harmonics import Harmonic
from operando.stabilization import Stabilization

UNCERTAIN = 4.0
"""A pole is doubtful when its damping is this many times less certain than that of a resonance seen at its best."""
SHORT = 0.5
"""Relative standard deviation of a damping ratio, at best, from which a record counts as short: its 95 % interval then reaches zero."""
CHANGE = 4.0
"""Ratio of power between the halves of a run from which it counts as not stationary."""


def harmonic_poles(stabilization: Stabilization, harmonics: list[Harmonic], keep_hz: Sequence[float]) -> dict[int, tuple[str, str]]:
    """Selected modes that are what is left of a sinusoid: at its frequency and hardly damped."""
    out = {}
    for i, (hz, zeta) in enumerate(zip(stabilization.selected_hz, stabilization.selected_damping, strict=True)):
        for h in harmonics:
            near = max(0.002 * hz, h.spread_hz)
            if abs(hz - h.hz) < near and zeta < 0.001 and not any(abs(hz - f) < 0.01 * f for f in keep_hz):
                text = f"{hz:.5g} Hz with damping ratio {100 * zeta:.2g} % lies on the sinusoid of {h.hz:.5g} Hz"
                out[i] = ("harmonic", f"{text} (envelope kurtosis {h.kurtosis:.2f})")
    return out


def uncertain_modes(estimate: Estimate, seconds: float, keep_hz: Sequence[float]) -> dict[int, tuple[str, str]]:
    """Modes far less certain, in frequency and in damping, than a resonance would be in so long a record.

    Under white excitation and at high signal-to-noise ratio, the relative standard deviations are at least √(ζ/(2πfT)) for the frequency
    and 1/√(2πζfT) for the damping ratio (long-data asymptotics, Au 2014). Poles that model noise or the flank of a filter are many
    times worse.
    """
    if estimate.covariance is None:
        return {}
    out = {}
    n = estimate.hz.size
    std = np.sqrt(np.diag(estimate.covariance))
    for i in range(n):
        hz, zeta = float(estimate.hz[i]), float(abs(estimate.zeta[i]))
        cycles = 2 * np.pi * hz * seconds
        excess_f = float(std[i]) / hz / np.sqrt(zeta / cycles)
        excess_z = float(std[n + i]) / zeta * np.sqrt(zeta * cycles)
        doubtful = excess_f > UNCERTAIN and excess_z > UNCERTAIN and std[n + i] > 0.5 * zeta
        if doubtful and not any(abs(hz - f) < 0.01 * f for f in keep_hz):
            value = (
                f"{hz:.4g} ± {INTERVAL * float(std[i]):.2g} Hz, damping ratio {100 * zeta:.3g} ± {100 * INTERVAL * float(std[n + i]):.3g} %"
            )
            out[i] = ("uncertain", f"{value}: {excess_f:.1f} and {excess_z:.1f} times the scatter of a resonance there in {seconds:.4g} s")
    return out


def short_record_findings(hz: NDArray[np.float64], zeta: NDArray[np.float64], seconds: float) -> list[Finding]:
    """Records that are short for their modes: at best the damping of some is uncertain by more than half (``SHORT``, one standard
    deviation), or they hold too few periods of the lowest for a mode of 1 % damping to be known better.

    The relative standard deviation of a damping ratio is 1/√(2πζfT) at best (long-data asymptotics, Au 2014).
    """
    if hz.size == 0:
        return []
    best = 1 / np.sqrt(2 * np.pi * np.maximum(zeta, 1e-6) * hz * seconds)
    lowest = float(hz.min())
    periods = lowest * seconds
    few = periods < 1 / (2 * np.pi * 0.01 * SHORT**2)
    bad = np.flatnonzero(best > SHORT)
    if not few and not bad.size:
        return []
    needed = float(np.max(best**2 * seconds)) / 0.2**2
    if bad.size:
        shown = ", ".join(f"{hz[i]:.4g} Hz (± {100 * INTERVAL * best[i]:.0f} %)" for i in bad[:4])
        text = f"damping is uncertain by at least: {shown}" + (f" and {bad.size - 4} more modes" if bad.size > 4 else "")
    else:
        text = "modes of little damping cannot be distinguished from noise"
    return [
        Finding(
            "short_record",
            f"{seconds:.4g} s hold {periods:.0f} periods of the lowest mode found ({lowest:.4g} Hz); {text}",
            "warning",
            time_s=(0.0, seconds),
            consequence="damping ratios are rough, their standard deviations too, and weakly excited modes may be missing",
            action=f"measure {max(needed, 100 / lowest):.2g} s or more for ± 40 % (95 % interval), in one record or several",
        )
    ]


def harmonic_finding(h: Harmonic) -> Finding:
    """Annotation of one sinusoid."""
    kind = "steady" if h.spread_hz == 0 else f"drifting within {h.spread_hz:.2g} Hz"
    return Finding(
        "harmonic",
        f"sinusoid at {h.hz:.5g} Hz, {kind}, up to {100 * h.energy_share:.2g} % of a channel's mean square",
        "info",
        band_hz=(h.hz - max(h.spread_hz, 1e-3 * h.hz) / 2, h.hz + max(h.spread_hz, 1e-3 * h.hz) / 2),
        consequence="taken out of the operating records before identification, so that it is not taken for a mode",
        action="name rotor orders as known_harmonics_hz to be sure of them",
    )


def stationarity_findings(runs: Sequence[NDArray[Any]], rate: float) -> list[Finding]:
    """Runs whose vibration is more than four times as strong (in power) in one half as in the other."""
    out = []
    for k, run in enumerate(runs):
        half = run.shape[1] // 2
        first, second = (row_statistics(part).std ** 2 for part in (run[:, :half], run[:, half:]))
        ratio = float(np.median(second / np.maximum(first, 1e-300)))
        if not 1 / CHANGE < ratio < CHANGE:
            out.append(
                Finding(
                    "nonstationary",
                    f"run {k}: the second half vibrates {ratio:.2g} times as strongly (power) as the first",
                    time_s=(0.0, run.shape[1] / rate),
                    consequence="operational modal analysis averages both; standard deviations are rough",
                    action="analyse stretches of constant operation apart",
                )
            )
    return out
