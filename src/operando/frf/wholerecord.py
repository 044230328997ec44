"""Leakage-free estimates of runs of any length on one grid of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.errors import DataError
from operando.frf.hits import find_hits, hit_begins
from operando.frf.inputs import RunInput
from operando.frf.leakage import Peak, resonance_peaks, sharpest
from operando.frf.rational import local_rational, spectrum_lines, window_indices
from operando.frf.runs import RunEstimate, coherence_of

Array = NDArray[Any]

PILOT_LINES = 1500
PILOT_SAMPLES = 1 << 21
"""Samples in which the sharpest peak is measured: its fine lines are as close as the record is long, and two million samples resolve a
bandwidth of a millionth of the sampling rate."""
LINES_A_PEAK = 5.0


def window_size(n_forces: int, window_lines: int) -> int:
    """Lines a window: six more for each further force."""
    return window_lines + 6 * (n_forces - 1)


def usable(run: RunInput) -> bool:
    """Whether the whole record can be used: finite forces and at least one finite response."""
    return len(run.finite(run.forces)) == len(run.forces) and bool(run.finite(run.responses))


def rational_run(run: RunInput, frequencies_hz: Array, window_lines: int = 17, rejected: Sequence[int] = ()) -> RunEstimate:
    """Local rational estimate of one run at the lines wanted.

    The record stays whole around hits that are ``rejected``, because the structure rings on; the force of each such hit becomes an input of
    its own, whose FRF takes up whatever it did to the structure and is thrown away.
    """
    record = run.record
    if not usable(run):
        raise DataError(
            "the whole-record estimate needs finite force samples and a finite response",
            where=run.name,
            hint='use estimator="h1": it leaves out the blocks with bad samples',
        )
    rows = run.finite(run.responses)
    n = int(fft.prev_fast_len(record.n_samples, real=True))
    centres = np.asarray(frequencies_hz) * n / record.sampling_hz
    size = window_size(len(run.forces) + len(rejected), window_lines)
    first, last = 1, n // 2 - 1
    lines = np.unique(window_indices(centres, size, first, last))
    if rejected:
        force = spectrum_lines(_forces_apart(run, rejected), range(1 + len(rejected)), lines, n)
    else:
        force = spectrum_lines(record.data, run.forces, lines, n)
    response = spectrum_lines(record.data, rows, lines, n)
    result = local_rational(force, response, lines, centres, n_lines=size)
    own = slice(len(run.forces))
    data, variance = result.data[:, own], result.variance[:, own]
    return RunEstimate(
        np.asarray(frequencies_hz, float),
        data,
        variance,
        coherence_of(data, variance, result.degrees_of_freedom),
        result.gain[own] / n,
        result.degrees_of_freedom,
        replace(run, responses=tuple(rows)).response_dofs,
        run.references,
        run.quantity,
        run.level,
        "lrm",
        si=run.si,
        name=record.name,
        findings=run.findings,
        provenance=record.provenance.then(f"estimate_frf(estimator='lrm', window_lines={size}, order=2)"),
    )


def _forces_apart(run: RunInput, rejected: Sequence[int]) -> Array:
    """The force of a hammer run without the rejected hits, and each of them alone, up to the next hit: (1 + n_rejected, n_samples)."""
    force = np.asarray(run.record.data[run.forces[0]], float)
    hits = find_hits(force, run.record.sampling_hz)
    edges = [*hit_begins(hits), force.size]
    rows = np.full((1 + len(rejected), force.size), hits.offset)
    rows[0] = force
    for row, k in enumerate(rejected, 1):
        part = slice(int(edges[k]), int(edges[k + 1]))
        rows[row, part], rows[0, part] = force[part], hits.offset
    return rows


def choose_lines(
    runs: Sequence[RunInput], band: tuple[float, float] | None, spacing: float | None, max_lines: int, window_lines: int
) -> tuple[Array, Peak | None]:
    """Even lines [Hz] on the multiples of the spacing: at most ``max_lines``, unless the sharpest peak needs more (up to three times).

    The sharpest peak gets at least five lines in its half-power bandwidth; it is measured on a coarse pilot estimate, refined around
    its peaks, and returned beside the lines.
    """
    duration = min(float(fft.prev_fast_len(r.record.n_samples, real=True)) / r.record.sampling_hz for r in runs)
    nyquist = min(r.record.sampling_hz for r in runs) / 2
    lowest, highest = (window_lines // 2) / duration, 0.98 * nyquist
    low, high = (lowest, nyquist / 1.28) if band is None else (max(band[0], 1 / duration), min(band[1], highest))
    if not low < high:
        wide = f"a window of {window_lines} lines of a record of {duration:g} s is {window_lines / duration:.3g} Hz wide"
        said = (
            f"{wide}, too wide for all that is measured" if band is None else f"band {band} Hz holds no lines of a record of {duration:g} s"
        )
        raise DataError(
            said, hint="measure longer, or take fewer window_lines" if band is None else "the record is too short or the band wrong"
        )
    peak = None
    if spacing is None:
        coarse = (high - low) / max_lines
        pilots = [_beginning(run) for run in runs]
        seconds = min(float(fft.prev_fast_len(r.record.n_samples, real=True)) / r.record.sampling_hz for r in pilots)
        peak = _sharpest_peak(pilots, max(low, 1 / seconds), high, seconds, window_lines)
        needed = coarse if peak is None else min(coarse, peak.bandwidth_hz / LINES_A_PEAK)
        spacing = max(needed, coarse / 3)
        step = 1 / duration
        spacing = step * max(1.0, np.floor(spacing / step + 1e-9))
    first, last = int(np.ceil(low / spacing - 1e-9)), int(np.floor(high / spacing + 1e-9))
    if last < max(first, 1):
        raise DataError(f"lines {spacing:g} Hz apart: none from {low:.4g} to {high:.4g} Hz", hint="give a smaller line_spacing_hz")
    return spacing * np.arange(max(first, 1), last + 1), peak


def _beginning(run: RunInput) -> RunInput:
    """A run, or the first ``PILOT_SAMPLES`` of it where it is longer."""
    record = run.record
    if record.n_samples <= PILOT_SAMPLES:
        return run
    return replace(run, record=record.cut(stop_s=record.start_s + PILOT_SAMPLES / record.sampling_hz))


def _sharpest_peak(runs: Sequence[RunInput], low: float, high: float, duration: float, window_lines: int) -> Peak | None:
    """The sharpest peak of the runs, from a coarse estimate and fine ones around its peaks."""
    step = max(1 / duration, (high - low) / PILOT_LINES)
    coarse = np.arange(low, high, step)
    pilot = _stack([rational_run(r, coarse, window_lines) for r in runs])
    peaks = resonance_peaks(coarse, *pilot)
    wide = [p for p in peaks if p.bandwidth_hz > 8 * step]
    narrow = [p for p in peaks if p.bandwidth_hz <= 8 * step]
    if narrow and step > 1 / duration:
        segments = [np.arange(p.frequency_hz - 3 * step, p.frequency_hz + 3 * step, 0.5 / duration) for p in narrow]
        inside = [s[(s >= low) & (s <= high)] for s in segments]
        lines, index = np.unique(np.concatenate(inside), return_inverse=True)
        data, variance = _stack([rational_run(r, lines, window_lines) for r in runs])
        narrow, start = [], 0
        for segment in inside:
            i = index[start : start + segment.size]
            start += segment.size
            fine = resonance_peaks(lines[i], data[:, :, i], variance[:, :, i], prominence=1.5)
            if fine:
                narrow.append(max(fine, key=lambda p: -p.bandwidth_hz))
    return sharpest(wide + narrow)


def _stack(estimates: Sequence[RunEstimate]) -> tuple[Array, Array]:
    """All columns of all runs, as one row each (n_pairs, 1, n_lines)."""
    n = estimates[0].frequencies_hz.size
    return np.concatenate([e.data.reshape(-1, 1, n) for e in estimates]), np.concatenate([e.variance.reshape(-1, 1, n) for e in estimates])
