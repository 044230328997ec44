"""From time records to the arrays that identification needs: response rows, one sense a DOF, and a sampling rate that suits the band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from operando.data import Finding, MappedSamples, Provenance, TimeRecord, filling, row_statistics
from operando.dof import Dof, Node, parse_dofs
from operando.errors import DataError, DofError, IdentificationError

DERIVATIVE = {"displacement": 0, "velocity": 1, "acceleration": 2}
"""Power of λ that a quantity carries relative to displacement."""
STRETCH = 1 << 20
"""Samples that are resampled at once."""
MARGIN = STRETCH // 8
"""Samples of a stretch that its neighbours repeat, at either end."""


@dataclass(frozen=True)
class Responses:
    """Response channels (r, n_samples) of one or several runs, same rows in the same order, means not taken off yet.

    ``derivative`` (r,) is 0 for displacement, 1 for velocity, 2 for acceleration.
    """

    runs: tuple[NDArray[Any], ...]
    sampling_hz: float
    dofs: tuple[Dof, ...]
    derivative: NDArray[np.int_]
    findings: tuple[Finding, ...]
    provenance: Provenance
    names: tuple[str, ...] = ()


def gather_responses(records: TimeRecord | Sequence[TimeRecord]) -> Responses:
    """Response rows that all runs have, in the order and sense of the first run.

    A channel with samples that are not finite, or that is constant, in any run is left out of all, with a finding.
    """
    runs = [records] if isinstance(records, TimeRecord) else list(records)
    if not runs:
        raise DataError("no operating record given")
    first = runs[0]
    findings: list[Finding] = []
    rows: list[int] = []
    seen: dict[tuple[Node, str], int] = {}
    for i in first.response_indices:
        dof = first.channels[i].dof
        assert dof is not None
        if dof.key in seen:
            findings.append(
                Finding(
                    "duplicate_dof",
                    f"DOF {dof} is measured by more than one channel; {first.channels[i].name or 'the later one'} is left out",
                    "info",
                    file=first.name or None,
                    dof=str(dof),
                )
            )
            continue
        seen[dof.key] = i
        rows.append(i)
    if not rows:
        unlabelled = [c.name or "unnamed" for c in first.channels if c.dof is None and not c.is_force]
        raise DofError(
            f"no response channel with a DOF among {len(first.channels)} channels"
            + (f" (without DOF: {', '.join(unlabelled[:8])})" if unlabelled else ""),
            where=first.name or None,
            hint="give node, direction and quantity (acceleration, velocity, displacement) of each sensor, as in [channels]",
        )
    channels = [first.channels[i] for i in rows]
    arrays: list[NDArray[Any]] = []
    unusable: dict[int, str] = {}
    for run in runs:
        if abs(run.sampling_hz - first.sampling_hz) > 1e-6 * first.sampling_hz:
            raise DataError(
                f"sampled at {run.sampling_hz:g} Hz, {first.name or 'the first run'} at {first.sampling_hz:g} Hz", where=run.name or None
            )
        where = {c.dof.key: i for i in reversed(run.response_indices) if (c := run.channels[i]).dof is not None}
        picked, signs = [], []
        for channel in channels:
            dof = channel.dof
            assert dof is not None
            k = where.get(dof.key)
            if k is None:
                raise DofError(
                    f"DOF {dof} of {first.name or 'the first run'} is not in this run",
                    where=run.name or None,
                    hint="runs are averaged only over the same sensors; fit them apart, or exclude the channel",
                )
            other = run.channels[k]
            if other.quantity != channel.quantity:
                raise DataError(f"DOF {dof} is {other.quantity} here and {channel.quantity} in the first run", where=run.name or None)
            assert other.dof is not None
            picked.append(k)
            signs.append(dof.sign * other.dof.sign)
        data = run.data[picked] if picked != list(range(run.data.shape[0])) else run.data
        if any(s < 0 for s in signs):
            data = _turned(data, np.asarray(signs, data.dtype)[:, None])
        known = run.statistics
        for i, (k, channel) in enumerate(zip(picked, channels, strict=True)):
            if not known.finite[k]:
                lost = np.sum(~np.isfinite(run.data[k]))
                unusable.setdefault(i, f"channel {channel.label} holds {lost} samples that are not finite")
            elif known.flat[k]:
                unusable.setdefault(i, f"channel {channel.label} is constant")
            else:
                continue
            findings.append(_left_out(unusable[i], channel.label, run.name))
        arrays.append(data)
        findings += run.findings if run is not first else ()
    if unusable:
        good = [i for i in range(len(channels)) if i not in unusable]
        if not good:
            raise DataError(
                "; ".join(list(unusable.values())[:4]),
                where=first.name or None,
                hint="no channel is left; cut the record to its finite part",
            )
        arrays, channels = [data[good] for data in arrays], [channels[i] for i in good]
    derivative = np.array([DERIVATIVE[c.quantity] for c in channels])
    dofs = parse_dofs([c.dof for c in channels if c.dof is not None])
    provenance = Provenance.merge(*(r.provenance for r in runs))
    return Responses(tuple(arrays), first.sampling_hz, dofs, derivative, tuple(findings), provenance, tuple(r.name for r in runs))


def _turned(data: Any, signs: NDArray[Any]) -> Any:
    """Rows times their signs."""
    if isinstance(data, MappedSamples):
        return data.changed_by(lambda part, rows, first, last: part * signs[list(rows)], data.dtype)
    return data * signs


def _left_out(message: str, label: str, file: str) -> Finding:
    return Finding(
        "channel_left_out",
        message,
        "warning",
        file=file or None,
        dof=label,
        consequence="the channel is left out of the operational modal analysis, in all runs of these sensors",
        action="cut the record to its finite part, or exclude the channel in [channels]",
    )


def resample(data: NDArray[Any], sampling_hz: float, pass_hz: float, new_hz: float) -> tuple[NDArray[np.float64], float]:
    """Low-pass and resample each channel by FFT, flat up to ``pass_hz``, a cosine flank down to half the new rate, no phase; mean removed.

    Records longer than ``STRETCH`` are transformed in stretches that overlap by ``MARGIN`` at either end. What a stretch lacks of its
    neighbours is what the filter rings beyond the margin: its impulse response falls with the third power of time, to 1e-9 of its peak
    after 1000 periods of the flank's width, which the margin exceeds where the flank is wider than 1 % of the sampling rate. A result that
    is too large for the memory lies in a temporary file. The new rate, given back too, is near ``new_hz``: a whole number of samples over
    the padded length.
    """
    if not pass_hz < new_hz / 2 < sampling_hz / 2 * 1.000001:
        raise IdentificationError(f"cannot resample from {sampling_hz:g} to {new_hz:g} Hz with a pass band up to {pass_hz:g} Hz")
    r, n = data.shape
    long = n > STRETCH
    size = STRETCH if long else fft.next_fast_len(n, real=True)
    ratio = STRETCH // MARGIN if long else 2  # stretches begin on samples of both rates
    new_size = round(size * new_hz / sampling_hz / ratio) * ratio if long else round(size * new_hz / sampling_hz)
    new_size += new_size % 2
    rate = sampling_hz * new_size / size
    lines = new_size // 2 + 1
    f = np.arange(lines) * sampling_hz / size
    flank = np.clip((f - pass_hz) / (rate / 2 - pass_hz), 0, 1)
    gain = (0.5 + 0.5 * np.cos(np.pi * flank)) * (new_size / size)
    n_new = int(n * new_size / size)
    if not long:
        out = np.empty((r, n_new))
        for i in range(r):
            row = np.asarray(data[i], float)
            out[i] = fft.irfft(fft.rfft(row - row.mean(), size)[:lines] * gain, new_size)[:n_new]
        return out, rate
    means = row_statistics(data).mean
    with filling((r, n_new), np.float64) as put:
        margin, new_margin = MARGIN, MARGIN * new_size // size
        for first in range(0, n, size - 2 * margin):
            begin, stop = first - margin, min(first - margin + size, n)
            for i in range(r):
                part = np.zeros(size)
                part[max(-begin, 0) : stop - begin] = data[i, max(begin, 0) : stop]
                part[max(-begin, 0) : stop - begin] -= means[i]
                new = fft.irfft(fft.rfft(part, overwrite_x=True)[:lines] * gain, new_size)
                at = first // margin * new_margin
                put(i, at, new[new_margin : new_margin + min(new_size - 2 * new_margin, n_new - at)])
    return put.samples, rate


def at_suitable_rate(responses: Responses, band: tuple[float, float]) -> tuple[list[NDArray[Any]], float]:
    """Resample to two and a half times the upper band limit where the record is much faster."""
    wanted = 2.5 * band[1]
    if responses.sampling_hz < 1.3 * wanted:
        return list(responses.runs), responses.sampling_hz
    done = [resample(run, responses.sampling_hz, 1.05 * band[1], wanted) for run in responses.runs]
    return [d[0] for d in done], done[0][1]
