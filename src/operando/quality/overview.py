"""What a raw record looks like, in a few thousand numbers: outline of its samples, power spectral densities, pulses of its hits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from operando.data import TimeRecord, number_of
from operando.data.arrays import ByContent
from operando.errors import DataError
from operando.frf import Hits, cross_spectra, hits_of

SHOWN_CHANNELS = 8
"""Channels kept of a record, the forces first: as many as a figure can show."""

PLACES = 220
"""Stretches of an outline, each with its least and its greatest sample: one for two pixels of a figure of half the page."""

LINES_A_BAND = 2000
"""Lines of a spectrum where no block length is given: as many as a figure can show."""

LEAST_AVERAGES = 15
"""Blocks that a spectrum should have at least, where no block length is given."""

BEFORE, AFTER = 0.6, 1.4
"""Part of a hit that is kept: so many durations of the pulse before and after its peak (its foot is at 1 % of the peak)."""


@dataclass(frozen=True, eq=False)
class Pulse(ByContent):
    """The force of one hit.

    Parameters
    ----------
    number : int
        As ``hits_reject`` names it.
    time_s : float
        Of its peak, on the axis of the record.
    reason : str
        Why it is not used; empty where it is.
    peak : int
        Sample of the peak in ``force``.
    force : (n,) array
    """

    number: int
    time_s: float
    reason: str
    peak: int
    force: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Overview(ByContent):
    """What the report draws of one record.

    Parameters
    ----------
    state : str
        ``idle``, ``operating`` or ``check``.
    outline : TimeRecord
        Least and greatest sample of each stretch, forces first; with the findings of the record.
    n_channels : int
        Of the record.
    sampling_hz : float
        Of the record.
    frequencies_hz : (k,) array
    densities : (channels of the outline, k) array
        Power spectral densities [unit²/Hz]; empty for a record too short for one.
    pulses : tuple of Pulse
        Of a hammer record.
    """

    state: str
    outline: TimeRecord
    n_channels: int
    sampling_hz: float
    frequencies_hz: NDArray[np.float32]
    densities: NDArray[np.float32]
    pulses: tuple[Pulse, ...] = ()


def overview(record: TimeRecord, state: str) -> Overview:
    """Outline, spectra and hits of a record.

    Parameters
    ----------
    record : TimeRecord
        With a force or a response.
    state : str
        ``idle``, ``operating`` or ``check``.

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.zeros((1, 4000)); force[0, 500:503] = force[0, 2500:2503] = [40.0, 100.0, 40.0]
    >>> seen = overview(operando.TimeRecord(force, 1000.0, (operando.Channel("3+Z", "force", "N"),)), "idle")
    >>> seen.outline.data.shape, [pulse.time_s for pulse in seen.pulses]
    ((1, 440), [0.501, 2.501])
    """
    rows = [*record.force_indices, *record.response_indices][:SHOWN_CHANNELS]
    part = record.select(rows)
    hz, psd = densities(part)
    step = max(1, hz.size // LINES_A_BAND)
    count = min(PLACES, part.n_samples // 2)
    edges = np.linspace(0, part.n_samples, count + 1).astype(int)[:-1]
    outline = np.empty((len(rows), 2 * count), np.float32)
    for row in range(len(rows)):
        x = np.asarray(part.data[row])
        outline[row, ::2], outline[row, 1::2] = np.minimum.reduceat(x, edges), np.maximum.reduceat(x, edges)
    small = replace(part, data=outline, sampling_hz=2 * count * part.sampling_hz / part.n_samples)
    return Overview(
        state,
        small,
        len(record.channels),
        record.sampling_hz,
        hz[::step].astype(np.float32),
        psd[:, ::step].astype(np.float32),
        pulses(record),
    )


def densities(record: TimeRecord, block_seconds: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power spectral densities of all channels (Welch: Hann blocks, half overlapped).

    Parameters
    ----------
    record : TimeRecord
    block_seconds : float, optional
        Length of a block [s]. Default: for some 2000 lines, and 15 averages at least.

    Returns
    -------
    (k,) array, (n_channels, k) array
        Frequencies [Hz] and densities [unit²/Hz].

    Examples
    --------
    >>> import numpy as np, operando
    >>> noise = np.random.default_rng(1).normal(size=(1, 5000))
    >>> hz, psd = densities(operando.TimeRecord(noise, 1000.0, (operando.Channel("3+Z", "acceleration", "m/s2"),)), 1.0)
    >>> hz.size, bool(abs(psd.mean() * 500 - 1) < 0.1)
    (501, True)
    """
    n = record.n_samples
    if block_seconds is None:
        block = min(max(64, min(2 * LINES_A_BAND, 2 * n // (LEAST_AVERAGES + 1))), n)
    else:
        seconds = number_of(block_seconds, "block_seconds", "give a positive number of seconds")
        block = int(seconds * record.sampling_hz)
        if block < 2:
            raise DataError(f"block_seconds = {seconds:g} holds no two samples at {record.sampling_hz:g} Hz", hint="give longer blocks")
    spectra = cross_spectra(record.data, [], list(range(record.data.shape[0])), record.sampling_hz, block)
    return spectra.frequencies_hz, spectra.response


def pulses(record: TimeRecord) -> tuple[Pulse, ...]:
    """The forces of the hits of a hammer record; none of any other.

    Parameters
    ----------
    record : TimeRecord

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.zeros((1, 4000)); force[0, 500:503] = force[0, 2500:2503] = [40.0, 100.0, 40.0]
    >>> record = operando.TimeRecord(force, 1000.0, (operando.Channel("3+Z", "force", "N"),))
    >>> [(pulse.number, float(pulse.force.max())) for pulse in pulses(record)]
    [(0, 100.0), (1, 100.0)]
    """
    hits = hits_of(record)
    if hits is None:
        return ()
    force = np.asarray(record.data[record.force_indices[0]], float) - hits.offset
    out = []
    for k, peak in enumerate(hits.indices):
        a, b = _span(hits, k, force.size)
        out.append(Pulse(k, float(record.start_s + hits.times_s[k]), hits.reasons[k].replace("_", " "), int(peak) - a, force[a:b]))
    return tuple(out)


def _span(hits: Hits, k: int, n: int) -> tuple[int, int]:
    """Samples of one pulse: from before it rises to after it has fallen, a second pulse of a double hit included."""
    peak = int(hits.indices[k])
    wide = max(int(hits.lead[k]) if hits.lead.size > k else 0, 3)
    following = hits.pulses[hits.pulses > peak]
    stop = peak + max(4 * wide, int(AFTER * wide) + 4)
    if hits.reasons[k] == "double_hit" and following.size:
        stop = max(stop, int(following[0]) + 4 * wide)
    return max(0, peak - wide - max(2, int(BEFORE * wide))), min(n, stop)
