"""Hammer hits in a continuous force record: where they are, which are used, and why not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage

from operando.data import Finding

Array = NDArray[Any]

WEAK = 0.3
DOUBLE = 0.05
RINGING = 0.25
"""Largest side lobe of a band-limited pulse over its highest sample (the peak may fall between two samples)."""
RINGING_SAMPLES = 10
FLAT_TOP = 0.4
"""Part of its width at half height for which a pulse that is cut stays at its top, at least (see :func:`_flat_top`)."""
RISE = 0.01
"""Part of its peak from which a pulse counts as begun."""
STANDS = 20.0
"""A line stands out of the noise at this many times its power (of 1000 lines of noise alone one does with a probability of 2e-6)."""
GROWS = 1.2
"""A response does not grow after the hit: what has a fifth more power in the last quarter than in the first is background."""
BEFORE = 4.0
"""A line was not there before the hit where its power at the end is this many times that before (a tone between two lines of a short
spectrum loses a third of its power, noise the rest)."""
AROUND = 16
"""Lines on either side that tell the noise near a line."""
FINDING_KINDS = {
    "double_hit": "its force spectrum has notches",
    "weak_hit": "its responses are close to the noise",
    "overload": "the force is larger than what was recorded",
    "truncated": "its block is not complete",
    "inconsistent_hit": "it hit another place or direction, or something else moved",
}


@dataclass(frozen=True)
class Hits:
    """Impacts found in a force record.

    Parameters
    ----------
    indices : (n,) array of int
        Sample of each main peak.
    levels : (n,) array
        Peak force above the offset, positive.
    reasons : tuple of str
        Empty where the hit is used; else ``double_hit``, ``weak_hit``, ``overload``, ``truncated`` or ``inconsistent_hit``.
    pulses : (m,) array of int
        Samples of all pulses, seconds of double hits included.
    messages : tuple of str
        The reason in words with its numbers, empty where used.
    noise : float
        Robust standard deviation of the force between the hits.
    offset : float
        Median of the force.
    sampling_hz : float
    lead : (n,) array of int
        Samples from where each pulse begins to rise to its peak.
    """

    indices: NDArray[np.intp]
    levels: NDArray[np.float64]
    reasons: tuple[str, ...]
    messages: tuple[str, ...]
    pulses: NDArray[np.intp]
    noise: float
    offset: float
    sampling_hz: float
    lead: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which hits are used."""
        return np.array([not r for r in self.reasons], bool)

    @property
    def double(self) -> NDArray[np.bool_]:
        """Which hits are double."""
        return np.array([r == "double_hit" for r in self.reasons], bool)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Time of each hit from the first sample [s]."""
        return self.indices / self.sampling_hz

    def reject(self, which: int, reason: str, message: str) -> Hits:
        """The hits with one more that is not used."""
        reasons, messages = list(self.reasons), list(self.messages)
        reasons[which], messages[which] = reason, message
        return replace(self, reasons=tuple(reasons), messages=tuple(messages))

    def findings(self, file: str | None = None, dof: str | None = None) -> list[Finding]:
        """A finding for each hit that is not used."""
        out = []
        for t, reason, message in zip(self.times_s, self.reasons, self.messages, strict=True):
            if reason:
                out.append(
                    Finding(
                        reason,
                        f"hit at {t:.3f} s: {message}",
                        "warning",
                        file=file,
                        dof=dof,
                        time_s=(float(t), float(t)),
                        consequence=f"not used: {FINDING_KINDS[reason]}",
                        action="repeat the hit",
                    )
                )
        return out


def is_impact(force: ArrayLike) -> bool:
    """Whether a force record consists of short impacts: 2 % of the samples hold more than 80 % of the energy."""
    f = np.asarray(force, float)
    f = f - np.median(f)
    energy = np.sort(np.square(f))[::-1]
    total = energy.sum()
    return bool(total > 0 and energy[: max(1, f.size // 50)].sum() > 0.8 * total)


def find_hits(force: ArrayLike, sampling_hz: float, *, threshold: float | None = None) -> Hits:
    """Find the hits in a force record and judge each by its force alone.

    Rejected are double hits (a second pulse of more than 5 % of the first soon after it), weak hits (below 30 % of the median
    level) and hits that overload the input (three or more equal samples at the top).

    Parameters
    ----------
    force : (n_samples,) array
        Pulses of either sign; the sign of the largest is taken.
    sampling_hz : float
    threshold : float, optional
        Least pulse height. Default: the larger of 5 % of the largest and ten times the noise.

    Returns
    -------
    Hits
    """
    f = np.asarray(force, float)
    offset = float(np.median(f))
    f = f - offset
    noise = float(1.4826 * np.median(np.abs(f)))
    peak = int(np.argmax(np.abs(f)))
    f = f * np.sign(f[peak]) if f[peak] else f
    floor = max(DOUBLE * f[peak], 10 * noise) if threshold is None else threshold
    empty = np.zeros(0, np.intp)
    if f[peak] <= 0 or f[peak] < floor:
        return Hits(empty, np.zeros(0), (), (), empty, noise, offset, sampling_hz)
    pulses = _pulses(f, floor)
    hits, seconds = _group(f, pulses, sampling_hz)
    levels = f[hits]
    typical = float(np.median(levels))
    reasons, messages = [], []
    for hit, level, second in zip(hits, levels, seconds, strict=True):
        reason = message = ""
        top = _flat_top(f, int(hit), noise)
        if top >= 3:
            reason, message = "overload", f"{top} samples of one height at the top ({level:.4g} N)"
        elif level < WEAK * typical:
            reason, message = "weak_hit", f"{level:.3g} N is {100 * level / typical:.0f} % of the median level {typical:.3g} N"
        elif second is not None:
            gap = abs(second - hit) / sampling_hz
            reason = "double_hit"
            message = f"second pulse of {100 * f[second] / level:.0f} % of the level, {1000 * gap:.0f} ms apart"
        reasons.append(reason)
        messages.append(message)
    lead = np.array([_lead(f, int(hit), noise) for hit in hits], np.intp)
    return Hits(hits, levels, tuple(reasons), tuple(messages), pulses, noise, offset, sampling_hz, lead)


def _lead(f: Array, peak: int, noise: float) -> int:
    """Samples from the last one before a pulse that is no part of it to its peak."""
    floor = max(RISE * f[peak], 3 * noise)
    k = peak
    while k > 0 and f[k] > floor:
        k -= 1
    return peak - k


def _pulses(f: Array, floor: float) -> NDArray[np.intp]:
    """Peak sample of each pulse: local maxima above the floor, without the shoulders and the ringing of larger ones."""
    maxima = np.flatnonzero((f[1:-1] >= f[:-2]) & (f[1:-1] > f[2:]) & (f[1:-1] >= floor)) + 1
    if f.size > 1:
        maxima = np.concatenate([[0] if f[0] > f[1] and f[0] >= floor else [], maxima]).astype(np.intp)
    kept: list[int] = []
    for k in maxima[np.argsort(-f[maxima])]:
        shadowed = False
        for other in kept:
            distance = abs(int(k) - other)
            if distance > 4096:
                continue
            between = f[min(k, other) : max(k, other) + 1]
            ringing = distance <= RINGING_SAMPLES and f[k] < RINGING * f[other]
            if ringing or between.min() > 0.3 * f[k]:
                shadowed = True
                break
        if not shadowed:
            kept.append(int(k))
    return np.array(sorted(kept), np.intp)


def _group(f: Array, pulses: NDArray[np.intp], sampling_hz: float) -> tuple[NDArray[np.intp], list[int | None]]:
    """Main pulse of each hit, and the second pulse of a double hit (else None)."""
    gaps = np.diff(pulses) / sampling_hz
    wide = gaps[gaps > 0.05]
    dead = min(0.5, 0.4 * float(np.median(wide))) if wide.size else 0.5
    groups: list[list[int]] = []
    for k in pulses:
        if groups and (k - groups[-1][-1]) / sampling_hz < dead:
            groups[-1].append(int(k))
        else:
            groups.append([int(k)])
    hits, seconds = [], []
    for group in groups:
        order = sorted(group, key=lambda k: -f[k])
        others = [k for k in order[1:] if f[k] > DOUBLE * f[order[0]]]
        hits.append(order[0])
        seconds.append(others[0] if others else None)
    return np.array(hits, np.intp), seconds


def _flat_top(f: Array, peak: int, noise: float) -> int:
    """Samples of one height at the top of a pulse that is cut there: three or more equal ones, or four that are too many for its width.

    A half sine is within 5 % of its peak for 30 % of its width at half height, within 2 % for 19 %; one cut at 90 % of its peak for 44 %.
    """

    def around(level: float) -> int:
        first = last = peak
        while first > 0 and f[first - 1] >= level:
            first -= 1
        while last + 1 < f.size and f[last + 1] >= level:
            last += 1
        return last - first + 1

    equal = around(f[peak])
    if equal >= 3:
        return equal
    flat = around(max(0.95 * f[peak], 0.98 * f[peak] - 3 * noise))
    return flat if flat >= 4 and flat > FLAT_TOP * around(0.5 * f[peak]) else 0


def hit_blocks(hits: Hits, n_samples: int, block_seconds: float | None = None) -> tuple[Hits, NDArray[np.intp], int, int]:
    """Blocks of equal length, from shortly before each used hit to shortly before the next pulse.

    Parameters
    ----------
    hits : Hits
    n_samples : int
        Length of the record.
    block_seconds : float, optional
        Upper limit of the block.

    Returns
    -------
    hits : Hits
        With ``truncated`` hits marked.
    starts : array of int
        First sample of the block of each hit still used.
    block, pre_trigger : int
        Samples.
    """
    limit = n_samples if block_seconds is None else max(8, round(block_seconds * hits.sampling_hz))
    edges = np.append(hits.indices, n_samples)
    room = np.diff(edges)
    usable = room[hits.used]
    if usable.size == 0:
        return hits, np.zeros(0, np.intp), 0, 0
    # A last hit cut short by the end of the record must not shorten all the others.
    enough = usable[usable >= 0.7 * np.median(usable)]
    block = int(min(enough.min() - 1, limit))
    pre = int(np.clip(round(0.02 * block), min(8, block // 4), max(8, round(0.1 * hits.sampling_hz))))
    first = int(np.flatnonzero(hits.used)[0])
    if hits.lead.size and hits.lead[hits.used].max() <= hits.indices[first] < pre:
        # A record that the hit itself triggered: nothing of the pulse is missing.
        pre = int(hits.indices[first])
    starts = []
    for i in np.flatnonzero(hits.used):
        start = int(hits.indices[i]) - pre
        if start < 0:
            hits = hits.reject(int(i), "truncated", f"{hits.indices[i]} samples before it, {pre} needed")
        elif start + block > n_samples:
            short = (n_samples - start) / hits.sampling_hz
            hits = hits.reject(int(i), "truncated", f"{short:.3g} s to the end of the record, {block / hits.sampling_hz:.3g} s needed")
        else:
            starts.append(start)
    return hits, np.array(starts, np.intp), block, pre


def remaining_share(
    data: NDArray[np.floating[Any]],
    rows: Sequence[int],
    starts: NDArray[np.intp],
    block: int,
    sampling_hz: float,
    band: tuple[float, float] | None = None,
    quiet: int = 0,
) -> tuple[float, float]:
    """Largest share of its amplitude that a line still has at the end of the blocks, where it stands out of the noise.

    The spectra of the first and last quarter of the blocks are compared line by line. What stands out at the end is no response to the hit
    where the noise near that line is as large, where it grew since the beginning, or where it was there before the hit.

    Parameters
    ----------
    data : (n_channels, n_samples) array
    rows : sequence of int
        Responses.
    starts : array of int
        First sample of each block.
    block : int
        Samples a block.
    sampling_hz : float
    band : (low, high), optional
        Hz; default: what the quarters resolve, up to the anti-alias limit.
    quiet : int
        Samples at the beginning of the record before anything was hit.

    Returns
    -------
    share : float
        0 where nothing stands out of the noise at the end.
    frequency_hz : float
    """
    quarter = block // 4
    if quarter < 16 or starts.size == 0:
        return 1.0, 0.0
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(quarter) / quarter)
    frequency = fft.rfftfreq(quarter, 1 / sampling_hz)
    low, high = band if band is not None else (2 / (quarter / sampling_hz), sampling_hz / 2.56)
    keep = (frequency >= low) & (frequency <= high)
    if not keep.any():
        return 1.0, 0.0
    worst, where = 0.0, 0.0
    for row in rows:
        begin, end = np.zeros(frequency.size), np.zeros(frequency.size)
        for start in starts:
            for total, at in ((begin, start), (end, start + block - quarter)):
                x = np.array(data[row, at : at + quarter], float)
                total += np.abs(fft.rfft((x - x.mean()) * window)) ** 2
        noise = np.quantile(end[keep], 0.25) / 0.3
        stands = keep & (end > STANDS * np.maximum(noise, _noise_near(end))) & (end < GROWS * begin)
        stands &= end > BEFORE * starts.size * _power_before(np.asarray(data[row, :quiet], float), frequency, sampling_hz, quarter)
        if stands.any():
            share = (end[stands] / begin[stands]) ** (0.5 * 4 / 3)
            k = int(np.argmax(share))
            if share[k] > worst:
                worst, where = float(share[k]), float(frequency[stands][k])
    return worst, where


def _noise_near(power: Array) -> Array:
    """Noise power near each line: the lower quartile over the lines around it, scaled to the mean of an exponential distribution."""
    return np.asarray(ndimage.percentile_filter(power, 25, size=2 * AROUND + 1, mode="nearest") / 0.3)


def _power_before(x: Array, frequency: Array, sampling_hz: float, length: int) -> Array:
    """Power of each line before the first hit, as a tone of that size would have in ``length`` samples; 0 below two cycles."""
    out = np.zeros(frequency.size)
    if x.size < 16:
        return out
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(x.size) / x.size)
    power = np.abs(fft.rfft((x - x.mean()) * window)) ** 2
    have = fft.rfftfreq(x.size, 1 / sampling_hz)
    known = frequency > 2 * sampling_hz / x.size
    out[known] = np.interp(frequency[known], have, power) * (length / x.size) ** 2
    return out
