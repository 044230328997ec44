"""How far the modes of two measurements of one structure are apart, read off their FRFs peak by peak."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.frf.leakage import Peak, resonance_peaks

Array = NDArray[Any]

HALF_WIDTHS = 2.0
"""Lines within this many half-power half widths of a peak enter its pole: beyond, the next mode is no straight line any more (with 4 of
them the poles of the packaged example, read off different sensors, differ by twice as much)."""
WIDTHS_APART = 0.05
"""Median shift over all modes, in half-power half widths, from which files without a common sensor count as different. At resonance a shift
of 5 % of the half width changes H by 5 %. What the local model leaves out differs from sensor to sensor: on the packaged example, cut in
three sets of sensors, the median is 0.1 to 0.9 % of the half width (single modes beside a stronger one: up to 20 %)."""
MODES_NEEDED = 3
"""Modes that the median needs: it then holds although one of them is misjudged."""
UNSURE = 20.0
"""Modes whose shift is so many times less sure than the median are left out: on simulated roving tests suspension modes at the edge of the
band, known to 0.3 % where the others are known to 0.004 %, would else be the largest shift named."""
SIGNIFICANT = 3.0
"""Shifts of less than so many standard deviations are noise."""


@dataclass(frozen=True)
class Shift:
    """Relative shift f₂/f₁ − 1 of the natural frequencies of a second measurement against a first one, with its standard deviation.

    One a peak that both have, all arrays (n,); ``half_widths_hz`` is half of the half-power bandwidth of each.
    """

    frequencies_hz: Array
    relative: Array
    std: Array
    half_widths_hz: Array

    @property
    def apart(self) -> bool:
        """Whether the modes as a whole lie elsewhere, also where the two measurements have no sensor in common."""
        if self.relative.size < MODES_NEEDED:
            return False
        widths = np.abs(self.relative) * self.frequencies_hz / self.half_widths_hz
        return bool(np.median(widths) > WIDTHS_APART and np.median(np.abs(self.relative) / self.std) > SIGNIFICANT)


def local_pole(frequencies_hz: Array, data: Array, variance: Array, peak: Peak) -> tuple[complex, float] | None:
    """Pole f_d + iζf [Hz] of the mode at a peak, common to all rows, from the lines around it, and the standard deviation of its real part.

    Near a peak each row is H = r/(f − p) + b with its own r and b and one p = f_d + iζf. Multiplied by (f − p) the equation is linear:
    f·H = p·H + (r − p·b) + b·f. It is solved by least squares with the noise of each line and, as Sanathanan and Koerner (1963) do, the
    weight 1/(f − p) of the pass before. FRFs (n_rows, n_lines) of any quantity; rows that are not finite are left out. None where fewer
    than five lines or no row lie around the peak, or the pole found does not.
    """
    centre, half = peak.frequency_hz, 0.5 * peak.bandwidth_hz
    near = np.flatnonzero(np.abs(frequencies_hz - centre) <= HALF_WIDTHS * half)
    rows = np.flatnonzero(np.isfinite(data[:, near]).all(axis=1) & (np.abs(data[:, near]) > 0).any(axis=1))
    if near.size < 5 or rows.size == 0:
        return None
    x, h = frequencies_hz[near] - centre, data[np.ix_(rows, near)]
    noise = np.nan_to_num(np.sqrt(np.maximum(variance[np.ix_(rows, near)], 0)))
    noise = np.maximum(noise, 1e-6 * np.sqrt(np.mean(np.abs(h) ** 2, axis=1, keepdims=True)))
    pole = 1j * half
    for _ in range(4):
        weight = 1 / (noise * np.abs(x - pole))
        basis = np.stack([weight, weight * (x / half)], axis=2)
        q = np.linalg.qr(basis)[0]
        left, right = weight * h, weight * x * h
        left = left - np.einsum("rlk,rk->rl", q, np.einsum("rlk,rl->rk", q, left))
        right = right - np.einsum("rlk,rk->rl", q, np.einsum("rlk,rl->rk", q, right))
        power = float(np.sum(np.abs(left) ** 2))
        if power <= 0:
            return None
        pole = complex(np.vdot(left, right) / power)
        if abs(pole.real) > HALF_WIDTHS * half or not 0 < pole.imag < 3 * half:
            return None
    freedom = max(rows.size * (near.size - 2) - 1, 1)
    rest = float(np.sum(np.abs(right - pole * left) ** 2)) / freedom
    return centre + pole, float(np.sqrt(0.5 * rest / power))


def frequency_shifts(frequencies_hz: Array, first: tuple[Array, Array], second: tuple[Array, Array]) -> Shift | None:
    """Shift of each mode that stands out of the noise in both of two measurements; None where no peak is in both.

    Each is (data, variance), (n_rows, n_lines), best of the same rows: then what the local model leaves out is the same in both.
    """
    found = []
    for peak in resonance_peaks(frequencies_hz, first[0][:, None], first[1][:, None]):
        one = local_pole(frequencies_hz, *first, peak)
        two = local_pole(frequencies_hz, *second, peak)
        if one is not None and two is not None:
            found.append((one[0].real, two[0].real / one[0].real - 1, np.hypot(one[1], two[1]) / one[0].real, 0.5 * peak.bandwidth_hz))
    if not found:
        return None
    table = np.array(found)
    table = table[table[:, 2] <= UNSURE * np.median(table[:, 2])]
    return Shift(*table.T)


def in_words(shift: Shift) -> str:
    """By how much the modes are shifted: the median, and the range over the modes."""
    percent = 100 * shift.relative
    if percent.size == 1:
        return f"shifted by {percent[0]:+.2g} % at {shift.frequencies_hz[0]:.4g} Hz"
    return f"shifted by {np.median(percent):+.2g} % (median of {percent.size} modes; {percent.min():+.2g} to {percent.max():+.2g} %)"
