"""Selected poles that are no modes after all: remains of sinusoids, and poles too uncertain to be a resonance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding
from operando.oma.estimate import Estimate
from operando.oma.harmonics import Harmonic
from operando.stabilization import Stabilization

UNCERTAIN = 4.0
"""A pole is doubtful when its damping is this many times less certain than that of a resonance seen at its best."""
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
            value = f"{hz:.4g} ± {float(std[i]):.2g} Hz, damping ratio {100 * zeta:.3g} ± {100 * float(std[n + i]):.3g} %"
            out[i] = ("uncertain", f"{value}: {excess_f:.1f} and {excess_z:.1f} times the scatter of a resonance there in {seconds:.4g} s")
    return out


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
        first, second = (np.var(part, axis=1, dtype=float) for part in (run[:, :half], run[:, half:]))
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
