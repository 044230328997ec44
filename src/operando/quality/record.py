"""Checks of whole records: each fault becomes a finding with numbers; no sample is changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from operando.data import Finding, TimeRecord, counted
from operando.data.findings import Severity
from operando.errors import DataError
from operando.frf.hits import is_impact
from operando.frf.impact import impact_blocks, overlap_finding
from operando.frf.periodic import period_of
from operando.frf.spectra import cross_spectra
from operando.frf.usable import channel_faults
from operando.printable import first_few
from operando.quality.samples import PileUp, Span, constant_runs, dropouts, not_finite, overload, pile_up, soft_clipping

SHORTEST_PERIOD = 256
"""Samples below which one period (of a tone) is too short to tell how its values are distributed; all samples are taken then."""
INVERTED_SHARE = 0.1
SWAPPED_SHARE = 0.97
ORIGIN_BLOCKS = 8
"""Blocks of which the part of the response that follows the force is told: half overlapped Hann windows make 14 averages of them, and
long blocks resolve the resonances (blocks of a thirtieth lose a tenth of the coherence to leakage)."""
SHORTEST_BLOCK = 64
LONGEST_BLOCK = 1 << 17
"""Samples of a block at most: 25 lines (``LINES_NEEDED``) are then 0.02 % of the sampling rate, narrower than most resonances, and the
lines of 64 channels take 100 MB."""
DRIVEN = 0.5
"""Part of the response power that must follow the force: 0.84 to 1.00 in 28 good records of four structures and the example, machines
running in half."""
MOTION = {"displacement": 1, "velocity": 0, "acceleration": -1}
"""Power of iω that turns the quantity into a velocity."""


def check_record(record: TimeRecord) -> TimeRecord:
    """The same record with findings about its samples, channels and hits.

    Checked are NaN, overload, soft clipping, dropout and flat channels; where there is a force also the drive point (inverted, swapped)
    and, in hammer records, each hit.
    """
    findings = [*check_channels(record), *check_forces(record)]
    known = {(f.kind, f.dof, f.time_s) for f in record.findings}
    return record.with_findings([f for f in findings if (f.kind, f.dof, f.time_s) not in known])


def check_channels(record: TimeRecord) -> list[Finding]:
    """Findings about the samples of each channel."""
    impact = {i for i in record.force_indices if is_impact(_finite(record, i))}
    flat = {fault.row: fault.message for fault in channel_faults(record) if fault.kind == "flat"}
    period = _period(record, impact)
    out: list[Finding] = []
    for i in range(len(record.channels)):
        if i in flat:
            out.append(_finding(record, i, "flat", flat[i], "the channel says nothing", "check cable and sensor"))
        else:
            out += _check_samples(record, i, i in impact, period)
    return out


def _period(record: TimeRecord, impact: set[int]) -> int | None:
    """Samples after which the force repeats itself, None where it does not or is not known."""
    known = record.statistics
    forces = [i for i in record.force_indices if i not in impact and known.finite[i] and not known.flat[i]]
    try:
        return period_of(np.asarray(record.data[forces[0]], float)) if forces else None
    except DataError:
        return None


def _finite(record: TimeRecord, i: int) -> np.ndarray:
    """Samples of a channel, zero where they are not finite."""
    row = record.data[i]
    return row if record.statistics.finite[i] else np.where(np.isfinite(row), row, 0.0)


def _check_samples(record: TimeRecord, i: int, impact: bool, period: int | None) -> list[Finding]:
    """NaN, overload, dropout and soft clipping of one channel that carries a signal.

    Of a signal that repeats itself one period tells whether it is cut: its highest peak comes back in each of them.
    """
    out = []
    bad = [] if record.statistics.finite[i] else not_finite(record.data[i])
    if bad:
        count, spans = sum(s.length for s in bad), "" if len(bad) == 1 else f" in {len(bad)} stretches"
        text = f"{counted(count, 'sample')}{spans} not finite"
        whole = Span(bad[0].first, bad[-1].last)
        # As frf.usable_channels decides: a response gives way to others; without a force or its only response a run says nothing.
        needed = record.force_indices and (record.channels[i].is_force or record.response_indices == [i])
        severity: Severity
        severity, consequence = ("warning", "blocks with them are left out") if needed else ("error", "the channel is left out")
        out.append(_finding(record, i, "nan", text, consequence, "exclude the channel or repair the file", whole, severity))
    x = _finite(record, i)
    runs = constant_runs(x)
    clipped = [] if impact else overload(x, runs)  # a pulse that is cut is judged with the hits
    unit = record.channels[i].unit
    piled = None if impact else _piled(x, period)
    if piled is not None:
        out.append(_cut_finding(record, i, piled))
    elif clipped:
        count = sum(s.length for s in clipped)
        level = max(abs(float(x[s.first])) for s in clipped)
        for n, span in enumerate(_joined(clipped, max(16, x.size // 200))):
            text = f"{count} samples in {len(clipped)} runs at full scale {level:.4g} {unit}"
            text = text if n == 0 else f"clipped at full scale {level:.4g} {unit}"
            consequence = "harmonics and a wrong level; blocks with it are left out"
            out.append(_finding(record, i, "overload", text, consequence, "choose a larger input range", span))
    elif not impact and (soft := soft_clipping(x)) is not None:
        text = f"crest factor {soft.crest:.2f} and slope at the top {100 * soft.slope_ratio:.0f} % of that in the middle (mean square)"
        out.append(_finding(record, i, "soft_clip", text, "large values are compressed", "check amplifier and sensor range"))
    if not impact:
        lost = [s for s in dropouts(x, runs) if not (bad and any(b.first <= s.last and s.first <= b.last for b in bad))]
        lost = [s for s in lost if not (s.first == 0 and _all_constant(record, s))]
        if not (record.channels[i].is_force and sum(s.length for s in lost) > 0.2 * x.size):
            for span in _joined(lost, 16):
                text = f"{span.length} samples of one value ({float(x[span.first]):.3g} {unit})"
                out.append(_finding(record, i, "dropout", text, "blocks with it are left out", "check cable and connector", span))
    return out


def _piled(x: np.ndarray, period: int | None) -> PileUp | None:
    """Samples piled up at an extreme, from one period where the signal repeats itself; the span is that of the whole record."""
    if period is None or period < SHORTEST_PERIOD:
        return pile_up(x)
    found = pile_up(x[-period:])
    if found is None:
        return None
    before = x.size - period
    return replace(found, span=Span((found.span.first + before) % period, found.span.last + before))


def _cut_finding(record: TimeRecord, i: int, piled: PileUp) -> Finding:
    """The finding for a channel that is cut at a level throughout, with what that does to FRFs.

    Of a normally distributed signal cut at a·σ the part p beyond it is erfc(a/√2); the cut signal follows the whole one by 1 − p and
    has the power 1 − p − 2aφ(a) + a²p (Bussgang 1952): H1 with a force so cut is larger by the ratio of the two, with a response so cut
    smaller by 1 − p.
    """
    share = piled.share
    a = float(np.sqrt(2) * special.erfcinv(share))
    power = 1 - share - 2 * a * np.exp(-0.5 * a * a) / np.sqrt(2 * np.pi) + a * a * share
    channel = record.channels[i]
    text = f"{100 * share:.2g} % of the samples are cut at {piled.level:.4g} {channel.unit}".rstrip()
    if channel.is_force:
        consequence = (
            f"the force was larger than measured: FRFs about {20 * np.log10((1 - share) / power):.1f} dB too large; they are right if "
            "the force itself was cut (an amplifier at its limit)"
        )
    else:
        consequence = f"FRFs at this DOF are about {-20 * np.log10(1 - share):.1f} dB too small, with harmonics"
    return _finding(record, i, "overload", text, consequence, "choose a larger input range, or a smaller force", piled.span)


def _all_constant(record: TimeRecord, span: Span) -> bool:
    """Whether every response stands still over the span: the record began before anything moved."""
    responses = record.response_indices or range(len(record.channels))
    part = record.data[list(responses), span.first : span.last + 1]
    return bool(np.all(part.max(axis=1) == part.min(axis=1)))


def _joined(spans: Sequence[Span], gap: int) -> list[Span]:
    """Spans closer than ``gap`` samples as one."""
    out: list[Span] = []
    for span in spans:
        if out and span.first - out[-1].last <= gap:
            out[-1] = Span(out[-1].first, span.last)
        else:
            out.append(span)
    return out


def _finding(
    record: TimeRecord,
    i: int,
    kind: str,
    text: str,
    consequence: str,
    action: str,
    span: Span | None = None,
    severity: Severity = "warning",
) -> Finding:
    """A finding about one channel, or about some of its samples."""
    channel = record.channels[i]
    time = None
    if span is not None:
        time = (record.start_s + span.first / record.sampling_hz, record.start_s + span.last / record.sampling_hz)
        text += f", {time[0]:.4g} to {time[1]:.4g} s"
    return Finding(
        kind,
        f"{channel.label}: {text}",
        severity,
        file=record.name or None,
        set=channel.set,
        dof=channel.label,
        time_s=time,
        consequence=consequence,
        action=action,
    )


def check_forces(record: TimeRecord) -> list[Finding]:
    """Sense of the drive point and hits of a record with force channels (whether there is one is asked of the whole state, by its FRFs)."""
    out: list[Finding] = []
    forces = [i for i in record.force_indices if record.channels[i].dof is not None]
    responses = record.response_indices
    drive = {f: [r for r in responses if record.channels[r].dof.same_axis(record.channels[f].dof)] for f in forces}  # type: ignore[union-attr,arg-type]
    known = record.statistics
    if len(forces) != 1 or not responses or not known.finite[forces[0]]:
        return out
    force = forces[0]
    usable = [r for r in responses if known.finite[r] and not known.flat[r]]
    if not usable or known.flat[force]:
        return out
    if drive[force] and drive[force][0] in usable:
        out += _check_sign(record, force, drive[force][0], usable)
    if is_impact(record.data[force]):
        out += _check_hits(record, force, usable)
    else:
        out += _check_origin(record, force, usable)
    return out


def dissipated_shares(record: TimeRecord, force: int, responses: Sequence[int]) -> np.ndarray:
    """Share of Re(Gvf) with positive sign for each response to one force (n_responses,).

    Re(Gvf) of a drive point is the power that flows into a passive structure at each line, never negative.
    """
    block = int(min(record.n_samples, max(256, min(record.n_samples // 8, 8192))))
    spectra = cross_spectra(record.data, [force], responses, record.sampling_hz, block)
    f = spectra.frequencies_hz
    keep = (f > 3 * record.sampling_hz / block) & (f < record.sampling_hz / 2.56)
    power = np.array([MOTION[record.channels[r].quantity] for r in responses])
    sign = np.array([record.channels[r].dof.sign for r in responses]) * record.channels[force].dof.sign  # type: ignore[union-attr]
    flow = np.real(spectra.cross[:, 0, keep] * sign[:, None] * (2j * np.pi * f[keep]) ** power[:, None])
    total = np.abs(flow).sum(axis=1)
    return np.asarray(np.divide(np.maximum(flow, 0).sum(axis=1), total, out=np.full(total.shape, np.nan), where=total > 0))


def _check_origin(record: TimeRecord, force: int, responses: list[int]) -> list[Finding]:
    """Whether the responses come from the force: the part of their power that follows it, from coherence."""
    block = min(record.n_samples // ORIGIN_BLOCKS, LONGEST_BLOCK)
    if block < SHORTEST_BLOCK:
        return []
    spectra = cross_spectra(record.data, [force], responses, record.sampling_hz, block)
    lines = spectra.frequencies_hz > 3 * record.sampling_hz / block
    g_ff, g_xf = np.real(spectra.force[0, 0, lines]), spectra.cross[:, 0, lines]
    follows = np.divide(np.abs(g_xf) ** 2, g_ff, out=np.zeros(g_xf.shape), where=g_ff > 0).sum(axis=1)
    total = spectra.response[:, lines].sum(axis=1)
    share = np.divide(follows, total, out=np.ones(total.shape), where=total > 0)
    chance = 1 - 0.01 ** (1 / max(spectra.averages - 1, 1))
    label = record.channels[force].label
    if float(share.max()) < chance:
        text = f"{100 * share.max():.0f} % of the response power follows the force, no more than by chance"
        consequence = "the FRFs are noise: this force did not drive these responses"
        action = "check that force and responses are of the same run, and that the force sensor was connected"
        return [_finding(record, force, "force_unrelated", text, consequence, action, severity="error")]
    if float(np.median(share)) < DRIVEN:
        text = f"only {100 * np.median(share):.0f} % of the response power (median of {len(responses)}) follows the force"
        consequence = f"other sources, noise or a nonlinearity make the rest: FRFs with {label} have a large variance"
        action = "average more, drive harder, or stop other sources"
        return [_finding(record, force, "unmeasured_excitation", text, consequence, action)]
    return []


def _check_sign(record: TimeRecord, force: int, drive: int, responses: list[int]) -> list[Finding]:
    """Inverted force or drive-point response; swapped channels where another response is a drive point beyond doubt."""
    shares = dissipated_shares(record, force, responses)
    share = float(shares[responses.index(drive)])
    label = f"{record.channels[drive].label}/{record.channels[force].label}"
    if np.isnan(share):
        return []
    if share < INVERTED_SHARE:
        text = f"drive point {label}: {100 * (1 - share):.0f} % of the power at the force flows out of the structure"
        consequence = "force or response has the wrong sign: negative modal masses"
        return [_finding(record, drive, "inverted", text, consequence, "turn one of the two in [channels]", severity="error")]
    others = [r for r, s in zip(responses, shares, strict=True) if r != drive and s > SWAPPED_SHARE]
    if share < 0.75 and len(others) == 1:
        text = (
            f"drive point {label}: only {100 * share:.0f} % of the power at the force flows into the structure, "
            f"but {100 * shares[responses.index(others[0])]:.0f} % at {record.channels[others[0]].label}"
        )
        action = "check the cables of the two channels"
        return [_finding(record, drive, "swapped", text, "the two channels may be exchanged", action)]
    return []


def _check_hits(record: TimeRecord, force: int, responses: list[int]) -> list[Finding]:
    """Hits that are not fit for use, and overlapping ones."""
    label = record.channels[force].label
    try:
        blocks = impact_blocks(record, force, responses)
    except DataError as error:
        return [Finding("weak_hit", error.message, "error", file=record.name or None, dof=label, action="repeat the measurement")]
    out = blocks.findings(record.name or None, label)
    if blocks.overlapping and not blocks.single:  # what one hit needs is said by the FRF, which knows its window
        out.append(overlap_finding(blocks, record.name or None, label, True))
    return out


def check_runs(records: Sequence[TimeRecord]) -> list[Finding]:
    """Findings about runs that do not belong together: sampling rates, lengths, channels that come and go."""
    out: list[Finding] = []
    if len(records) < 2:
        return out
    rates = sorted({r.sampling_hz for r in records})
    names = {rate: [r.name for r in records if r.sampling_hz == rate] for rate in rates}
    if len(rates) > 1:
        text = "; ".join(f"{rate:g} Hz in {len(names[rate])} run(s)" for rate in rates)
        rare = min(rates, key=lambda rate: len(names[rate]))
        out.append(
            Finding(
                "unequal_rate",
                f"sampling rates differ: {text}",
                "warning",
                file=names[rare][0] or None,
                consequence="only the common band is usable",
                action="use one rate",
            )
        )
    lengths = sorted({r.n_samples / r.sampling_hz for r in records})
    if lengths[-1] > 1.01 * lengths[0]:
        shortest = min(records, key=lambda r: r.duration_s)
        text = f"run lengths differ: {lengths[0]:.4g} to {lengths[-1]:.4g} s"
        out.append(
            Finding(
                "unequal_length",
                text,
                "info",
                file=shortest.name or None,
                consequence="the shortest run sets the resolution",
                action="measure equally long",
            )
        )
    everywhere = [{c.label for k, c in enumerate(r.channels) if k in r.response_indices} for r in records]
    common = set.intersection(*everywhere)
    partial = sorted(set.union(*everywhere) - common)
    if common and partial:
        shown = first_few(partial, 8)
        out.append(
            Finding(
                "missing_response",
                f"{len(partial)} response DOFs are not in every run: {shown}",
                "info",
                consequence="NaN in the FRF where not measured",
            )
        )
    return out
