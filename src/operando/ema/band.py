"""The analysis band of an experimental modal analysis: as given, as far as the FRFs reach."""

from __future__ import annotations

from typing import Any

import numpy as np

from operando.data import Finding, Frf, positive_band
from operando.ema.pairs import Real
from operando.errors import IdentificationError
from operando.limits import LEAST_LINES


def analysis_band(given: Frf, lines_hz: Real, band: Any) -> tuple[tuple[float, float], tuple[Finding, ...]]:
    """Limits of the band that is analysed [Hz], and what is to be said of it; without a band the lines without those at the edges.

    ``lines_hz`` are the lines of ``given`` without excluded bands. ``band_beyond_lines`` is said where the band asked for reaches beyond
    the last line by more than the spacing of the lines. FRFs of records end below half the sampling rate, and where the force ends; the
    band of a test file is for all its data, so this is no error.
    """
    f = lines_hz
    if band is None:
        margin = 0.02 * (f[-1] - f[0])
        return (float(max(f[0] + margin, f[f > 0][0])), float(f[-1] - margin)), ()
    low, high = positive_band(band)
    count = int(np.sum((f > 0) & (f >= low) & (f <= high)))
    if count < LEAST_LINES:
        raise IdentificationError(
            f"the band of {low:g} to {high:g} Hz holds {count} lines of the FRFs, which lie at {f[0]:g} to {f[-1]:g} Hz; "
            f"at least {LEAST_LINES} are needed",
            hint="choose another band",
        )
    every = given.frequencies_hz
    end = float(every[-1])
    if high <= end + float(every[-1] - every[-2]):
        return (low, high), ()
    beyond = Finding(
        "band_beyond_lines",
        f"the band of {low:g} to {high:g} Hz reaches beyond the last line of the FRFs, {end:g} Hz",
        "info" if any(said.kind == "excited_band" for said in given.findings) else "warning",
        band_hz=(end, high),
        consequence=f"modes are identified from {low:g} to {end:g} Hz",
        action=f"give band = [{low:g}, {end:g}], or FRFs that reach farther",
    )
    return (low, end), (beyond,)
