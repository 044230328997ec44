"""``estimate_frf``: from time records to one FRF matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from operando.data import Finding, Frf, TimeRecord, count_of, group_findings, number_of, positive_band, several
from operando.dof import parse_dofs
from operando.errors import DataError
from operando.frf.averaged import averaged_run, few_averages
from operando.frf.estimators import ESTIMATORS
from operando.frf.excitation import at_lines, on_common_lines, periodic_runs, within_excited
from operando.frf.hits import LEAST_BLOCK, find_hits, is_impact, rejected_numbers
from operando.frf.impact import ImpactBlocks, impact_blocks, overlap_finding
from operando.frf.inputs import RunInput, run_input
from operando.frf.leakage import HANN_DAMPING, LINES_NEEDED, Peak, resonance_peaks, sharpest
from operando.frf.runs import RunEstimate, merge_runs
from operando.frf.singles import average_hits
from operando.frf.usable import usable_channels
from operando.frf.wholerecord import choose_lines, rational_run, usable
from operando.threads import one_blas_thread

MOST_VALUES = 4e6
"""FRF values (pairs times lines) of one run from which the default blocks become no longer: 64 MB, of which an estimate holds some copies.
Where they are too short for the damping, the estimate on whole records takes their place, as it does for shorter records."""
SHORT = 0.7
"""Blocks of a hammer run shorter than this part of the median over the runs do not shorten those of the others (as within one run)."""

T = TypeVar("T")
S = TypeVar("S")


def estimate_frf(
    records: TimeRecord | Sequence[TimeRecord],
    *,
    references: object = None,
    estimator: str | None = None,
    block_seconds: float | None = None,
    overlap: float | None = None,
    window: str | None = None,
    hits: str = "auto",
    hits_reject: Sequence[str] = (),
    band: tuple[float, float] | None = None,
    line_spacing_hz: float | None = None,
    max_lines: int = 4000,
    window_lines: int = 17,
    exponential_end: float = 0.01,
) -> Frf:
    """Estimate the FRF matrix from runs with measured forces.

    Each run has one or several force channels; runs of different references become columns of one matrix, runs of the same reference are
    averaged after a homogeneity test (see :func:`operando.frf.merge_runs`).

    Parameters
    ----------
    records : TimeRecord or sequence of TimeRecord
        Data may be single precision and memory-mapped; they are read block by block. Responses with samples that are not finite, or
        without a signal, are left out (:func:`operando.frf.usable_channels`).
    references : DOF labels, optional
        Columns wanted. Default: all that were excited.
    estimator : {None, "auto", "h1", "h2", "hv", "lrm", "periodic"}
        ``periodic`` averages whole periods of a force that repeats, on the lines it excites (see :mod:`operando.frf.periodic`).
        ``lrm`` is the leakage-free local rational estimate on whole records. None or ``auto``: ``periodic`` where a force repeats and
        no block length is given; H1 where blocks are long enough for the damping (hammer: where each response decays before the next
        hit), else ``lrm``; in any case of letters. The findings ``periodic_excitation`` and ``estimator`` give the reason.
    block_seconds : float, optional
        Block length of H1, H2, Hv [s], eight samples or more. Default: an eighth of the record, less where the resonances are broad
        enough, or where the lines of all pairs would be more than 4 million; hammer: the shortest time between two hits.
    overlap : float, optional
        Overlap of blocks, default 0.5 with a Hann window, 0 with a rectangular one.
    window : {"hann", "rectangular"}, or for hammer hits {"rectangular", "force", "exponential", "force_exponential"}
        Default: Hann; hammer: rectangular, but exponential where most single hits still ring at the end of their records. An exponential
        window adds damping: ``Frf.exponential_window_rate`` says how much.
    hits : {"auto", "all", "off"}
        Hammer records: use consistent single hits, all hits, or treat the record as continuous.
    hits_reject : sequence of str
        Hits never to be used, as ``NAME#NUMBER`` with the name of the record, numbered from 0 through all records of that name.
    band : (low, high), optional
        Lines wanted [Hz]. Default: all (``lrm``: up to 0.78 of the Nyquist frequency).
    line_spacing_hz, max_lines, window_lines : optional
        Lines of ``lrm``: spacing (default: at most ``max_lines`` lines, but five in the half-power bandwidth of the sharpest
        peak, as far as the record resolves them and three times ``max_lines`` allow), DFT lines that a local model is fitted to.
        Lines closer than a window share data: their errors are correlated.
    exponential_end : float
        Value of an exponential window at the end of the block.

    Returns
    -------
    Frf
        With variance and coherence of each line; ``averages`` is the effective number (``lrm``: residual degrees of freedom). Lines
        without force are left out: those between the lines of a multisine, and those beyond the excited band.
        A record that cannot be used becomes the finding ``unusable_run``, as long as there are others.

    Raises
    ------
    DataError
        If no record can be used, a reference was not excited, a hit named is not there, or an option does not fit.

    Examples
    --------
    >>> import numpy as np, operando
    >>> force = np.random.default_rng(0).standard_normal(20_000)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("1+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(np.stack([force, 2 * force]), 1000.0, channels)
    >>> frf = operando.estimate_frf(record, block_seconds=1.0)
    >>> frf
    <Frf: accelerance [(m/s²)/N]; 1 response 1+Z; 1 reference 1+Z; 501 lines, 0 to 500 Hz in steps of 1 Hz; variance, coherence>
    >>> float(abs(frf.data[0, 0, 100]).round(3))
    2.0
    """
    given = several(records, TimeRecord, "FRFs are estimated from time records", "read(file).records holds them")
    if not given:
        raise DataError("no records given", hint="estimate_frf needs at least one run with a force channel")
    usable_records, lost = usable_channels(given)
    runs = [run for _, run in _survivors(run_input, usable_records, lambda record: record.name, lost)]
    wanted = None if references is None else parse_dofs(references)
    if wanted == ():
        raise DataError(f"references {references!r:.60} names no DOF", hint="leave it out to take all that were excited")
    estimator = estimator.lower() if isinstance(estimator, str) else estimator
    if not isinstance(estimator, str | None) or estimator not in (None, "auto", "lrm", "periodic", *ESTIMATORS):
        raise DataError(f"estimator {estimator!r:.60} is none of auto, periodic, lrm, {', '.join(ESTIMATORS)}")
    if not isinstance(hits, str) or hits not in ("auto", "all", "off"):
        raise DataError(f"hits {hits!r:.60} is none of auto, all, off", hint="auto takes consistent single hits, all every hit, off none")
    band = None if band is None else positive_band(band)
    hits_reject = several(hits_reject, str, "hits are named by texts", 'write ["run1.uff#3"]')
    seconds = "give a positive number of seconds"
    if block_seconds is not None and not (block_seconds := number_of(block_seconds, "block_seconds", seconds)) > 0:
        raise DataError(f"block_seconds = {block_seconds:g} is no length", hint=seconds)
    slowest = min(run.record.sampling_hz for run in runs)
    if block_seconds is not None and round(block_seconds * slowest) < LEAST_BLOCK:
        short = f"block_seconds = {block_seconds:g} is {block_seconds * slowest:.2g} samples at {slowest:g} Hz"
        raise DataError(f"{short}, expected {LEAST_BLOCK} or more", hint=f"give {LEAST_BLOCK / slowest:g} s or more")
    share = "give a share from 0 to below 1"
    if overlap is not None and not 0 <= (overlap := number_of(overlap, "overlap", share)) < 1:
        raise DataError(f"overlap = {overlap:g} is no share of a block", hint=share)
    if line_spacing_hz is not None and not (line_spacing_hz := number_of(line_spacing_hz, "line_spacing_hz", "give it in Hz")) > 0:
        raise DataError(f"line_spacing_hz = {line_spacing_hz:g} is no distance", hint="give it in Hz, above 0")
    max_lines, window_lines = count_of(max_lines, "max_lines", 4000) or 4000, count_of(window_lines, "window_lines", 17) or 17
    quantities = {r.quantity for r in runs}
    if len(quantities) > 1:
        raise DataError(f"the runs measure different quantities: {', '.join(sorted(quantities))}", hint="estimate them apart")
    if wanted is not None:
        excited = [d for r in runs for d in r.references]
        missing = [str(d) for d in wanted if not any(d.same_axis(e) for e in excited)]
        if missing:
            raise DataError(
                f"no run excites reference {', '.join(missing)}", hint="excited: " + ", ".join(dict.fromkeys(map(str, excited)))
            )
    automatic = estimator in (None, "auto")
    of_blocks = {"block_seconds": block_seconds, "overlap": overlap, "window": window}
    if hits_reject and hits == "off":
        raise DataError("hits_reject names hits, and hits is off", hint='set hits to "auto" or "all"')
    with one_blas_thread():
        lost_names = {record.name for record in given} - {run.record.name for run in runs}
        rejected = _rejected(runs, [text for text in hits_reject if text.rpartition("#")[0] not in lost_names])
        cut: list[_Cut] = [(run, None, numbers) for run, numbers in zip(runs, rejected, strict=True)]
        if estimator == "periodic" or (automatic and block_seconds is None):
            periodic = _periodic(cut, band, window_lines, estimator == "periodic")
            if periodic is not None:
                return _finished(merge_runs(periodic, wanted), [*lost, *_without_blocks(of_blocks)])
        if estimator != "lrm" and hits != "off":
            cut = _cut_hits(cut, block_seconds, band, hits == "auto", lost)
        averaged: list[tuple[_Cut, RunEstimate]] = []
        reason, peak = "asked for", None
        if estimator != "lrm":
            kind = "h1" if estimator in (None, "auto") else str(estimator)
            length = _block_seconds(cut, block_seconds)
            fitting = _of_length(cut, length, lost)
            options = (kind, overlap, window, window or _hit_window(fitting), band, exponential_end)
            averaged = _survivors(lambda c: averaged_run(c[0], c[1], length, *options), fitting, _name, lost)
            if automatic:
                reason, peak = _leakage_reason(averaged)
                good = sum(usable(run) for run, _, _ in cut)
                if reason and 2 * good <= len(cut):
                    reason = ""
                if not reason and block_seconds is None and peak is not None and not any(blocks for _, blocks, _ in cut):
                    averaged = _shorter_blocks(averaged, peak, length, options)
        if estimator == "lrm" or (automatic and reason):
            averaged = []  # large, and not used
            lost = [f for f in lost if f.kind != "short_hits"]  # the whole record is used, however soon the next hit came
            lines, peak = choose_lines([c[0] for c in cut if usable(c[0])] or runs, band, line_spacing_hz, max_lines, window_lines)
            whole = _survivors(lambda c: rational_run(c[0], lines, window_lines, c[2]), cut, _name, lost)
            estimates = [replace(e, findings=(*e.findings, *_hit_findings(c, True))) for c, e in whole]
            extra = [_estimator_finding(reason, peak, lines), *_without_blocks(of_blocks)]
        else:
            estimates = [replace(e, findings=(*e.findings, *_hit_findings(c, False, e.exponential_window_rate))) for c, e in averaged]
            estimates = average_hits(estimates)
            at_hits = all(blocks is not None for (_, blocks, _), _ in averaged)
            extra = [*few_averages(estimates), *_shorter_than_asked(block_seconds, length), *_without_overlap(overlap if at_hits else None)]
            extra += [] if window == "rectangular" else _leakage(averaged)
        estimates, unexcited = within_excited(estimates)
        return _finished(merge_runs(estimates, wanted), [*lost, *extra, *unexcited])


_Cut = tuple[RunInput, ImpactBlocks | None, tuple[int, ...]]
"""A run, its blocks at hits where it is a hammer run, and the hits rejected by hand."""


def _name(cut: _Cut) -> str:
    return cut[0].record.name


def _periodic(cut: Sequence[_Cut], band: tuple[float, float] | None, window_lines: int, asked: bool) -> list[RunEstimate] | None:
    """Estimates on the excited lines of the runs whose forces repeat, the others by local rational models at those lines.

    None where no run is periodic, or one can be estimated in neither way.
    """
    found = periodic_runs([run for run, _, _ in cut])
    done = {i for places, _ in found for i in places}
    others = [c for i, c in enumerate(cut) if i not in done]
    if asked and others:
        raise DataError(
            "the forces do not repeat three times, or several forces cannot be distinguished",
            where=others[0][0].name,
            hint="leave estimator at auto, or give at least three periods (and one run for each of several forces)",
        )
    if not found or not all(usable(c[0]) for c in others):
        return None
    estimates = on_common_lines([e for _, e in found])
    hz = estimates[0].frequencies_hz
    if band is not None:
        keep = (hz >= band[0]) & (hz <= band[1])
        if not keep.any():
            raise DataError(f"band {band} Hz holds no excited line", hint=f"the force excites {hz[0]:.4g} to {hz[-1]:.4g} Hz")
        estimates, hz = [at_lines(e, keep) for e in estimates], hz[keep]
    for c in others:
        run = rational_run(c[0], hz, window_lines, c[2])
        estimates.append(replace(run, findings=(*run.findings, *_hit_findings(c, True))))
    return estimates


def _finished(frf: Frf, findings: Sequence[Finding]) -> Frf:
    """The FRF with findings, those alike as one, and without lines that some pair lacks which is measured at others."""
    frf = replace(frf, findings=tuple(group_findings([*findings, *frf.findings])))
    there = np.isfinite(frf.data)
    keep = np.all(there | ~there.any(axis=2, keepdims=True), axis=(0, 1))
    if keep.all() or not keep.any():
        return frf
    return frf.lines(keep)


def _survivors(make: Callable[[T], S], items: Sequence[T], name: Callable[[T], str], lost: list[Finding]) -> list[tuple[T, S]]:
    """What can be made of each item; one that cannot be used becomes a finding and does not spoil the others."""
    out: list[tuple[T, S]] = []
    first: DataError | None = None
    for item in items:
        try:
            out.append((item, make(item)))
        except DataError as error:
            first = first or error
            lost.append(
                Finding(
                    "unusable_run",
                    f"the run cannot be used: {error.message}",
                    "error",
                    file=name(item) or None,
                    consequence="its FRFs are missing, unless another run has them",
                    action=error.hint or "measure it again",
                )
            )
    if first is not None and not out:
        raise first
    return out


def _rejected(runs: Sequence[RunInput], hits_reject: Sequence[str]) -> list[tuple[int, ...]]:
    """Hits of each run that are rejected by hand."""
    if not hits_reject:
        return [()] * len(runs)
    counts = [find_hits(run.record.data[run.forces[0]], run.record.sampling_hz).indices.size if _is_hammer(run) else 0 for run in runs]
    return rejected_numbers([run.record.name for run in runs], counts, hits_reject)


def _is_hammer(run: RunInput) -> bool:
    return len(run.forces) == 1 and len(run.finite(run.forces)) == 1 and is_impact(run.record.data[run.forces[0]])


def _cut_hits(
    runs: Sequence[_Cut], block_seconds: float | None, band: tuple[float, float] | None, select: bool, lost: list[Finding]
) -> list[_Cut]:
    """The runs with blocks at the hits of each hammer run, all of the length of the shortest that is not much shorter than the others."""

    def cut(item: _Cut, seconds: float | None) -> ImpactBlocks | None:
        run, _, rejected = item
        if not _is_hammer(run):
            return None
        responses = run.finite(run.responses)
        return impact_blocks(run.record, run.forces[0], responses, block_seconds=seconds, band=band, select=select, rejected=rejected)

    found: list[_Cut] = [(item[0], blocks, item[2]) for item, blocks in _survivors(lambda r: cut(r, block_seconds), runs, _name, lost)]
    lengths = np.array([blocks.block / run.record.sampling_hz for run, blocks, _ in found if blocks is not None])
    if lengths.size == 0 or np.all(lengths == lengths[0]):
        return found
    shortest = float(lengths[lengths >= SHORT * np.median(lengths)].min())
    return [
        item if item[1] is None or item[1].block / item[0].record.sampling_hz <= shortest else (item[0], cut(item, shortest), item[2])
        for item in found
    ]


def _of_length(runs: Sequence[_Cut], seconds: float, lost: list[Finding]) -> list[_Cut]:
    """The runs without those whose hits follow each other too soon for the blocks of the others; a finding for each of these."""
    out = []
    for item in runs:
        run, blocks, _ = item
        if blocks is None or blocks.block >= round(seconds * run.record.sampling_hz):
            out.append(item)
            continue
        own = blocks.block / run.record.sampling_hz
        lost.append(
            Finding(
                "short_hits",
                f"only {own:.3g} s from hit to hit or to the end of the record, {seconds:.3g} s in most runs",
                "error",
                file=run.name,
                dof=str(run.references[0]),
                consequence="the run is not used: its FRFs would have fewer lines",
                action="measure it again with the pauses of the others, or set block_seconds",
            )
        )
    return out


def _hit_window(runs: Sequence[_Cut]) -> str:
    """The window of all hammer runs (one, so that they can be merged): exponential where most of the single hits still ring at the end."""
    blocks = [b for _, b, _ in runs if b is not None]
    ringing = sum(b.single and b.overlapping for b in blocks)
    return "exponential" if ringing and 2 * ringing >= len(blocks) else "rectangular"


def _block_seconds(runs: Sequence[_Cut], given: float | None) -> float:
    """Block length common to all runs [s]; a hammer run with much shorter ones does not count."""
    cut = np.array([blocks.block / run.record.sampling_hz for run, blocks, _ in runs if blocks is not None])
    if cut.size:
        return float(cut[cut >= SHORT * np.median(cut)].min())
    if given is not None:
        return given
    most = min(MOST_VALUES / (len(run.forces) * len(run.responses)) * 2 / run.record.sampling_hz for run, _, _ in runs)
    return min(min(run.record.duration_s for run, _, _ in runs) / 8, most)


def _hit_findings(cut: _Cut, whole_record: bool, rate: float = 0.0) -> list[Finding]:
    """Findings of a hammer run: hits that are not used, and overlap. The whole record uses every hit but those rejected by hand."""
    run, blocks, rejected = cut
    dof = str(run.references[0])
    if blocks is None:
        hits = find_hits(run.record.data[run.forces[0]], run.record.sampling_hz) if rejected else None
        for k in rejected:
            hits = None if hits is None else hits.reject(k, "rejected_hit", "rejected by hand")
        found = [] if hits is None else hits.findings(run.name, dof, start_s=run.record.start_s)
    else:
        found = blocks.findings(run.name, dof, start_s=run.record.start_s)
    out = found if blocks is not None and blocks.cut else [f for f in found if f.kind == "rejected_hit" or not whole_record]
    if blocks is not None and blocks.overlapping:
        out.append(overlap_finding(blocks, run.name, dof, whole_record, rate))
    return out


def _leakage_reason(averaged: Sequence[tuple[_Cut, RunEstimate]]) -> tuple[str, Peak | None]:
    """Why averaging over blocks would leak, empty where it would not; and the sharpest peak.

    The whole record is no way out where most runs hold a single hit, whose response and a free transient look alike.
    """
    blocks = [b for (_, b, _), _ in averaged if b is not None]
    overlapping = [b for b in blocks if b.overlapping and not b.single]
    if overlapping and sum(b.single for b in blocks) <= len(overlapping):
        b = overlapping[0]
        return f"hits overlap: {100 * b.remaining:.2g} % of the amplitude is left at {b.remaining_hz:.4g} Hz", None
    peaks = []
    for (_, cut, _), made in averaged:
        if cut is None:
            peak = sharpest(resonance_peaks(made.frequencies_hz, made.data, made.variance))
            if peak is not None:
                peaks.append((peak, float(np.median(np.diff(made.frequencies_hz)))))
    if not peaks:
        return "", None
    peak, step = min(peaks, key=lambda item: item[0].bandwidth_hz / item[1])
    lines = peak.bandwidth_hz / step
    if lines < LINES_NEEDED:
        text = (
            f"the peak at {peak.frequency_hz:.4g} Hz is {lines:.2g} lines wide in blocks of {1 / step:.3g} s, {LINES_NEEDED:g} are needed"
        )
        return text, peak
    return "", peak


def _leakage(averaged: Sequence[tuple[_Cut, RunEstimate]]) -> list[Finding]:
    """What averages over Hann windows make of the sharpest peak, where the blocks are too short for it."""
    reason, peak = _leakage_reason(averaged)
    if not reason or peak is None:
        return []
    step = min(float(np.median(np.diff(made.frequencies_hz))) for (_, cut, _), made in averaged if cut is None)
    percent = 100 * HANN_DAMPING * step / peak.bandwidth_hz
    return [
        Finding(
            "leakage",
            reason,
            "warning",
            consequence=f"the peak comes out lower and broader: its damping some {percent:.2g} % too large, which no interval holds",
            action="give longer blocks, or leave the estimator to auto: the estimate on whole records does not leak",
        )
    ]


def _shorter_blocks(
    averaged: list[tuple[_Cut, RunEstimate]],
    peak: Peak,
    length: float,
    options: tuple[str, float | None, str | None, str, tuple[float, float] | None, float],
) -> list[tuple[_Cut, RunEstimate]]:
    """The estimate with blocks just long enough for the sharpest peak (twice the lines needed): more averages, fewer lines."""
    shorter = 2 * LINES_NEEDED / peak.bandwidth_hz
    if shorter > 0.6 * length:
        return averaged
    return [(cut, averaged_run(cut[0], cut[1], shorter, *options)) for cut, _ in averaged]


def _without_blocks(settings: dict[str, float | str | None]) -> list[Finding]:
    """Says which settings of blocks are given and not used, because whole records are."""
    given = ", ".join(f"{name} = {value}" for name, value in settings.items() if value is not None)
    message = f"not used: {given}; whole records are used, without blocks"
    action = "give an estimator that averages over blocks, as h1: it may leak"
    consequence = "spacing of the lines, averages and variance are not those of such blocks"
    return [Finding("setting_unused", message, "warning", consequence=consequence, action=action)] if given else []


def _without_overlap(overlap: float | None) -> list[Finding]:
    """Says that an overlap is given and not used, because blocks begin at hits."""
    message = f"not used: overlap = {overlap}; blocks begin at the hits"
    action, consequence = 'leave overlap out, or set hits to "off"', "averages and variance are those of the hits"
    return [] if overlap is None else [Finding("setting_unused", message, "warning", consequence=consequence, action=action)]


def _shorter_than_asked(asked: float | None, used: float) -> list[Finding]:
    """Says that blocks are not as long as asked for, because hits follow each other sooner."""
    if asked is None or used > 0.99 * asked:  # a block is a whole number of samples
        return []
    message = f"not used: block_seconds = {asked:g}; blocks are {used:.3g} s long, the time to the next hit or the end of the record"
    consequence = f"lines {1 / used:.3g} Hz apart instead of {1 / asked:.3g} Hz"
    return [Finding("setting_unused", message, "warning", consequence=consequence, action="wait longer after each hit")]


def _estimator_finding(reason: str, peak: Peak | None, lines: np.ndarray) -> Finding:
    step = float(lines[1] - lines[0]) if lines.size > 1 else 0.0
    width = f"; sharpest peak {peak.frequency_hz:.4g} Hz, {peak.bandwidth_hz:.3g} Hz wide" if peak is not None else ""
    return Finding(
        "estimator",
        f"local rational estimate on whole records: {reason}{width}",
        "info",
        band_hz=(float(lines[0]), float(lines[-1])),
        consequence=f"no leakage; {lines.size} lines {step:.4g} Hz apart, neighbouring lines share data",
    )
