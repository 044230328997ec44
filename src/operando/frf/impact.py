"""FRFs of hammer records: blocks at the hits, windows, consistent hits, overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data import Finding, TimeRecord
from operando.errors import DataError
from operando.frf.hits import Hits, find_hits, hit_blocks
from operando.frf.remaining import remaining_share
from operando.frf.spectra import CrossSpectra, cross_spectra
from operando.limits import IMPACT_WINDOWS

REMAINING = 0.05
"""Largest share of its amplitude that a mode may keep at the end of a block: its peak is one line wide there, and a narrower one needs the
lines of the whole record."""
INCONSISTENT_RATIO = 6.0
INCONSISTENT = 0.05
"""A hit is inconsistent where the FRF of the others misses more of its response energy than this part, and so many times the median."""


@dataclass(frozen=True)
class ImpactBlocks:
    """Blocks of a hammer record: hits with the reasons of all that are not used, and the first sample of each block used.

    ``remaining`` is the largest share of its amplitude that a line keeps at the end of a block, ``remaining_hz`` that line; ``cut`` counts
    hits used although their force is cut at a level, for there are no others.
    """

    hits: Hits
    starts: NDArray[np.intp]
    block: int
    pre_trigger: int
    remaining: float
    remaining_hz: float
    cut: int = 0

    def findings(self, name: str | None, dof: str | None, *, start_s: float = 0.0) -> list[Finding]:
        """Findings about single hits: each that is not used, and that those used are cut. ``start_s``: time of the first sample [s]."""
        out = self.hits.findings(name, dof, start_s=start_s)
        if self.cut:
            text = f"the force of every hit is cut at {float(self.hits.levels[self.hits.used].max()):.4g} N; {self.cut} hits are used so"
            out.append(
                Finding(
                    "overload",
                    text,
                    "error",
                    file=name,
                    dof=dof,
                    consequence="the force was larger than measured: FRFs are too large and modal masses too small, frequencies are right",
                    action="choose a larger input range and repeat the measurement",
                )
            )
        return out

    @property
    def overlapping(self) -> bool:
        """Whether the response still rings when the next hit comes or the record ends."""
        return self.remaining > REMAINING

    @property
    def single(self) -> bool:
        """Whether the record holds one pulse only: on whole-record spectra its response and a transient look alike."""
        return self.hits.pulses.size == 1


def impact_blocks(
    record: TimeRecord,
    force: int,
    responses: Sequence[int],
    *,
    block_seconds: float | None = None,
    band: tuple[float, float] | None = None,
    select: bool = True,
    rejected: Sequence[int] = (),
) -> ImpactBlocks:
    """Find the hits of a record, choose the consistent ones and cut blocks; those rejected by hand are never used."""
    hits = find_hits(np.asarray(record.data[force], float), record.sampling_hz)
    if not select:
        for i, reason in enumerate(hits.reasons):
            if reason in ("weak_hit", "double_hit"):
                hits = hits.reject(i, "", "")
    for i in rejected:
        hits = hits.reject(i, "rejected_hit", "rejected by hand")
    cut = 0
    if not hits.used.any():
        for i in [i for i, reason in enumerate(hits.reasons) if reason == "overload"]:
            hits, cut = hits.reject(i, "", ""), cut + 1
    hits, starts, block, pre = hit_blocks(hits, record.n_samples, block_seconds)
    if starts.size == 0 or block < 16:
        raise DataError("no usable hit in the record", where=record.name or None, hint="; ".join(m for m in hits.messages if m) or None)
    quiet = int(max(hits.pulses[0] - hits.lead.max(initial=0), 0))
    share, where = remaining_share(record.data, responses, starts, block, record.sampling_hz, band, quiet)
    if select and share <= REMAINING:
        hits, starts = reject_inconsistent(record, force, responses, hits, starts, block, pre, band)
    return ImpactBlocks(hits, starts, block, pre, share, where, cut)


def reject_inconsistent(
    record: TimeRecord,
    force: int,
    responses: Sequence[int],
    hits: Hits,
    starts: NDArray[np.intp],
    block: int,
    pre: int,
    band: tuple[float, float] | None,
) -> tuple[Hits, NDArray[np.intp]]:
    """Reject hits whose responses the FRF of the other hits does not predict.

    The prediction error Σ|X − H·F|²/Σ|X|² of each hit with H from the others must stay below six times the median and 5 %;
    the worst goes first, and three hits always remain.
    """
    fs = record.sampling_hz
    frequency = fft.rfftfreq(block, 1 / fs)
    low, high = band if band is not None else (0.0, fs / 2.56)
    keep = np.flatnonzero((frequency >= low) & (frequency <= high))
    keep = keep[:: max(1, keep.size // 1000)]
    offset = record.statistics.mean[list(responses)]
    f = np.array([fft.rfft(np.asarray(record.data[force, s : s + block], float) - hits.offset)[keep] for s in starts])
    x = np.array(
        [fft.rfft(np.asarray(record.data[list(responses), s : s + block], float) - offset[:, None], axis=1)[:, keep] for s in starts]
    )
    starts = starts.copy()
    while starts.size > 3:
        numerator = np.sum(x * f.conj()[:, None], axis=0)
        denominator = np.sum(np.abs(f) ** 2, axis=0)
        errors = np.empty(starts.size)
        for i in range(starts.size):
            h = (numerator - x[i] * f[i].conj()) / np.maximum(denominator - np.abs(f[i]) ** 2, 1e-300)
            errors[i] = np.sum(np.abs(x[i] - h * f[i]) ** 2) / np.sum(np.abs(x[i]) ** 2)
        worst = int(np.argmax(errors))
        if errors[worst] < max(INCONSISTENT_RATIO * float(np.median(errors)), INCONSISTENT):
            break
        which = int(np.flatnonzero(hits.indices == starts[worst] + pre)[0])
        text = (
            f"the FRF of the other hits misses {100 * errors[worst]:.0f} % of its response energy (median {100 * np.median(errors):.2g} %)"
        )
        hits = hits.reject(which, "inconsistent_hit", text)
        starts, f, x = np.delete(starts, worst), np.delete(f, worst, axis=0), np.delete(x, worst, axis=0)
    return hits, starts


def impact_windows(
    name: str, blocks: ImpactBlocks, force: NDArray[np.floating[Any]], sampling_hz: float, end: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Force window, response window and decay rate β [1/s] for blocks at hits.

    ``force`` keeps the pulse and tapers to zero after it; ``exponential`` multiplies force and response by e^{−βt}, which falls
    to ``end`` over the block: x = h∗f becomes e^{−βt}x = (e^{−βt}h)∗(e^{−βt}f): each pole moves by −β exactly and nothing else
    changes.
    """
    if name not in IMPACT_WINDOWS:
        raise DataError(f"window {name!r} is none of {', '.join(IMPACT_WINDOWS)} for hits")
    if not 0 < end < 1:
        raise DataError(f"exponential window end {end} is not in (0, 1)")
    t = np.arange(blocks.block) / sampling_hz
    force_window, response_window, rate = np.ones(blocks.block), np.ones(blocks.block), 0.0
    if name.startswith("force"):
        width = max(_pulse_samples(np.asarray(force[s : s + blocks.block], float) - blocks.hits.offset) for s in blocks.starts)
        stop = min(blocks.block, blocks.pre_trigger + 4 * width + 8)
        taper = min(blocks.block - stop, max(4, 2 * width))
        force_window[stop:] = 0
        force_window[stop : stop + taper] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(taper) + 0.5) / max(taper, 1))
    if name.endswith("exponential"):
        rate = float(-np.log(end) / (blocks.block / sampling_hz))
        response_window = np.exp(-rate * t)
        force_window = force_window * response_window
    return force_window, response_window, rate


def _pulse_samples(f: NDArray[np.float64]) -> int:
    """Samples of the pulse above a tenth of its peak."""
    f = np.abs(f)
    peak = int(np.argmax(f))
    above = f > 0.1 * f[peak]
    last = peak
    while last + 1 < f.size and above[last + 1]:
        last += 1
    first = peak
    while first > 0 and above[first - 1]:
        first -= 1
    return last - first + 1


def impact_spectra(
    record: TimeRecord,
    force: int,
    responses: Sequence[int],
    blocks: ImpactBlocks,
    *,
    window: str = "rectangular",
    end: float = 0.01,
    lines: slice | None = None,
    bad: Sequence[tuple[int, int]] = (),
) -> tuple[CrossSpectra, float]:
    """Spectra averaged over the hits, and the rate of the exponential window."""
    force_window, response_window, rate = impact_windows(window, blocks, record.data[force], record.sampling_hz, end)
    offsets = np.zeros(len(record.channels))
    offsets[list(responses)] = record.statistics.mean[list(responses)]
    offsets[force] = blocks.hits.offset
    spectra = cross_spectra(
        record.data,
        [force],
        responses,
        record.sampling_hz,
        blocks.block,
        lines=lines,
        bad=bad,
        starts=blocks.starts,
        windows=(force_window, response_window),
        offsets=offsets,
    )
    return spectra, rate


def overlap_finding(blocks: ImpactBlocks, name: str | None, dof: str, whole_record: bool, window_rate: float = 0.0) -> Finding:
    """The finding ``overlapping_hits``, or ``truncated_response`` for one hit that rings beyond the end of the record."""
    if blocks.single:
        seconds = blocks.block / blocks.hits.sampling_hz
        at_end = blocks.remaining * np.exp(-window_rate * seconds)
        fades = at_end < REMAINING
        return Finding(
            "truncated_response",
            f"at {blocks.remaining_hz:.4g} Hz the response keeps {100 * blocks.remaining:.2g} % of its amplitude at the end of the record "
            f"({seconds:.3g} s after the hit)",
            "info" if fades or whole_record else "warning",
            file=name,
            dof=dof,
            consequence=f"an exponential window ({window_rate:.3g} 1/s) leaves {100 * at_end:.2g} %; the EMA takes its damping off"
            if fades
            else "FRFs need an exponential window"
            if whole_record
            else "the FRF leaks",
            action="record for longer after a hit" if fades or whole_record else "use an exponential window, or record for longer",
        )
    return Finding(
        "overlapping_hits",
        f"at {blocks.remaining_hz:.4g} Hz the response keeps {100 * blocks.remaining:.2g} % of its amplitude until the next hit "
        f"({blocks.block * 1.0 / blocks.hits.sampling_hz:.3g} s)",
        "info" if whole_record else "warning",
        file=name,
        dof=dof,
        consequence="the whole record is used with its transient"
        if whole_record
        else "blocks at the hits hold the end of the hit before; what follows from the poles of the peaks is taken off",
        action="" if whole_record else "leave estimator and hits at auto, or wait longer between hits",
    )
