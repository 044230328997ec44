"""Hammer hits in a continuous force record: where they are, which are used, and why not."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from operando.data import Finding, TimeRecord
from operando.errors import DataError

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
FINDING_KINDS = {
    "double_hit": "its force spectrum has notches",
    "weak_hit": "its responses are close to the noise",
    "overload": "the force is larger than what was recorded",
    "truncated": "its block is not complete",
    "inconsistent_hit": "it hit another location or direction, or something else moved",
    "rejected_hit": "hits_reject names it",
}
LEAST_BLOCK = 8
"""Samples of a block: three lines between 0 Hz and half the sampling rate, so that one has a neighbour on both sides."""
LEAD_SAMPLES = 5
"""Samples before a pulse begins to rise where a stretch without it ends."""


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
        Empty where the hit is used; else ``double_hit``, ``weak_hit``, ``overload``, ``truncated``, ``inconsistent_hit`` or, by hand,
        ``rejected_hit``.
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

    def findings(self, file: str | None = None, dof: str | None = None, *, start_s: float = 0.0, first: int = 0) -> list[Finding]:
        """A finding for each hit that is not used.

        Parameters
        ----------
        file, dof : str, optional
        start_s : float
            Time of the first sample [s].
        first : int
            Number of the first hit, where the file holds others before.
        """
        out = []
        for number, (t, reason, message) in enumerate(zip(self.times_s + start_s, self.reasons, self.messages, strict=True), first):
            if reason:
                by_hand = reason == "rejected_hit"
                out.append(
                    Finding(
                        reason,
                        f"hit #{number} at {t:.3f} s: {message}",
                        "info" if by_hand else "warning",
                        file=file,
                        dof=dof,
                        time_s=(float(t), float(t)),
                        consequence=f"not used: {FINDING_KINDS[reason]}",
                        action="" if by_hand else "repeat the hit",
                    )
                )
        return out


def is_impact(force: ArrayLike) -> bool:
    """Whether a force record consists of short impacts: 2 % of the samples hold more than 80 % of the energy.

    Parameters
    ----------
    force : array
        Samples of a force channel.

    Returns
    -------
    bool

    Examples
    --------
    >>> import numpy as np
    >>> force = np.zeros(1000)
    >>> force[100:104] = [1.0, 3.0, 3.0, 1.0]
    >>> is_impact(force)
    True
    """
    energy = np.array(force, float)
    energy -= np.median(energy)
    np.square(energy, out=energy)
    total = energy.sum()
    most = max(1, energy.size // 50)
    energy.partition(energy.size - most)
    return bool(total > 0 and energy[-most:].sum() > 0.8 * total)


def find_hits(force: ArrayLike, sampling_hz: float, *, threshold: float | None = None) -> Hits:
    """Find the hits in a force record and rate each by its force alone.

    Rejected are double hits (a second pulse of more than 5 % of the first soon after it), weak hits (below 30 % of the median
    level) and hits that overload the input (three or more equal samples at the top).

    Parameters
    ----------
    force : (n_samples,) array
        Pulses of either sign; the sign of the largest is taken.
    sampling_hz : float
        Sampling rate [Hz].
    threshold : float, optional
        Least pulse height. Default: the larger of 5 % of the largest and ten times the noise.

    Returns
    -------
    Hits

    Examples
    --------
    >>> import numpy as np
    >>> from operando.frf import find_hits
    >>> force = np.zeros(4000)
    >>> force[[1000, 3000]] = 50.0
    >>> find_hits(force, 1000.0).times_s.round(3).tolist()
    [1.0, 3.0]
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

    Returns the hits with those marked that are ``truncated``, the first sample of the block of each hit still used, the samples of a block
    and those before the hit.
    """
    limit = n_samples if block_seconds is None else max(LEAST_BLOCK, round(block_seconds * hits.sampling_hz))
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


def hit_begins(hits: Hits) -> NDArray[np.intp]:
    """Sample just before each pulse begins to rise."""
    return np.maximum(hits.indices - hits.lead - LEAD_SAMPLES, 0)


def rejected_numbers(names: Sequence[str], counts: Sequence[int], hits_reject: Iterable[str]) -> list[tuple[int, ...]]:
    """Which hits of each record are named by ``FILE#NUMBER``, as numbers within it; hits count from 0 through all records of one name."""
    totals: dict[str, int] = {}
    firsts = []
    for name, count in zip(names, counts, strict=True):
        firsts.append(totals.get(name, 0))
        totals[name] = firsts[-1] + count
    wanted: dict[str, set[int]] = {}
    for text in hits_reject:
        name, _, number = text.rpartition("#")
        if name not in totals or not number.isdigit():
            hammer = [known for known, count in totals.items() if count]
            near = difflib.get_close_matches(name or text, hammer, 1, 0.3) or hammer[:1]
            hint = f"write {near[0]}#0 to {near[0]}#{totals[near[0]] - 1}" if near else "none of the records has hits of a hammer"
            if near and number.isdigit() and int(number) < totals[near[0]]:
                hint = f"did you mean '{near[0]}#{number}'?"
            raise DataError(f"hits_reject names {text!r}, which is no hit of these records", hint=hint)
        if int(number) >= totals[name]:
            many = f"which has hits #0 to #{totals[name] - 1}" if totals[name] else "which is no hammer record"
            raise DataError(
                f"hits_reject names hit #{number} of {name}, {many}",
                where=name,
                hint=f"the last one is {name}#{totals[name] - 1}" if totals[name] else None,
            )
        wanted.setdefault(name, set()).add(int(number))
    out = []
    for name, first, count in zip(names, firsts, counts, strict=True):
        out.append(tuple(sorted(k - first for k in wanted.get(name, ()) if first <= k < first + count)))
    return out


def hits_of(record: TimeRecord) -> Hits | None:
    """Hits of a hammer record: one force channel of short impacts; None for any other record."""
    rows = record.force_indices
    if len(rows) != 1:
        return None
    force = np.asarray(record.data[rows[0]], float)
    return find_hits(force, record.sampling_hz) if np.isfinite(force.sum()) and is_impact(force) else None


def without_hits(records: Sequence[TimeRecord], hits_reject: Iterable[str]) -> tuple[list[TimeRecord], list[Finding]]:
    """The stretches of records between hits that are rejected by hand (``FILE#NUMBER``, from 0), for fits of whole records.

    A stretch ends before a rejected hit and begins again with the next one, while the structure may still ring: what uses it must allow for
    its initial motion. A stretch of one hit is left out (its response and a free transient look alike), and a finding says so.
    """
    wanted = list(hits_reject)
    if not wanted:
        return list(records), []
    out: list[TimeRecord] = []
    findings: list[Finding] = []
    found = [hits_of(record) for record in records]
    numbers = rejected_numbers([r.name for r in records], [0 if h is None else h.indices.size for h in found], wanted)
    for record, hits, rejected in zip(records, found, numbers, strict=True):
        if hits is None or not rejected:
            out.append(record)
            continue
        edges = [*hit_begins(hits), record.n_samples]
        first = 0
        for k in (*rejected, len(edges) - 1):
            if k - first >= 2:
                begin = record.start_s + (0 if first == 0 else edges[first]) / record.sampling_hz
                out.append(record.cut(begin, record.start_s + edges[k] / record.sampling_hz))
            elif k > first:
                message = f"hit #{first} stands alone between rejected ones; the fit of whole records leaves it out"
                findings.append(Finding("hit_alone", message, "info", file=record.name or None, consequence="the FRFs still use it"))
            first = k + 1
    return out, findings
