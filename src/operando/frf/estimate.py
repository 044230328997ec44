"""``estimate_frf``: from time records to one FRF matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from operando.data import Finding, FrequencyAxis, Frf, TimeRecord, group_findings
from operando.dof import parse_dofs
from operando.errors import DataError
from operando.frf.estimators import ESTIMATORS, estimate, inverse_force_matrix
from operando.frf.excitation import at_lines, on_common_lines, periodic_runs, within_excited
from operando.frf.hits import is_impact
from operando.frf.impact import ImpactBlocks, impact_blocks, impact_spectra, overlap_finding
from operando.frf.inputs import RunInput, run_input
from operando.frf.leakage import LINES_NEEDED, Peak, resonance_peaks, sharpest
from operando.frf.rational import roughness_variance
from operando.frf.runs import RunEstimate, coherence_of, merge_runs, same_references
from operando.frf.spectra import CrossSpectra, block_starts, cross_spectra
from operando.frf.usable import usable_channels
from operando.frf.wholerecord import choose_lines, rational_run, usable

FEW_AVERAGES = 4.0


def estimate_frf(
    records: TimeRecord | Sequence[TimeRecord],
    *,
    references: object = None,
    estimator: str | None = None,
    block_seconds: float | None = None,
    overlap: float | None = None,
    window: str | None = None,
    hits: str = "auto",
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
        hit), else ``lrm``; the findings ``periodic_excitation`` and ``estimator`` give the reason.
    block_seconds : float, optional
        Block length of H1, H2, Hv [s]. Default: an eighth of the record, less where the resonances are broad enough; hammer:
        the shortest time between two hits.
    overlap : float, optional
        Overlap of blocks, default 0.5 with a Hann window, 0 with a rectangular one.
    window : {"hann", "rectangular"}, or for hammer hits {"rectangular", "force", "exponential", "force_exponential"}
        Default: Hann; hammer: rectangular, but exponential where one hit still rings at the end of its record. An exponential
        window adds damping: ``Frf.exponential_window_rate`` says how much.
    hits : {"auto", "all", "off"}
        Hammer records: use consistent single hits, all hits, or treat the record as continuous.
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

    Raises
    ------
    DataError
        If a record has no force or response, a reference was not excited, or an option does not fit.
    """
    usable_records, left_out = usable_channels([records] if isinstance(records, TimeRecord) else list(records))
    runs = [run_input(r) for r in usable_records]
    if not runs:
        raise DataError("no records given", hint="estimate_frf needs at least one run with a force channel")
    wanted = None if references is None else parse_dofs(references)
    if estimator not in (None, "auto", "lrm", "periodic", *ESTIMATORS):
        raise DataError(f"estimator {estimator!r} is none of auto, periodic, lrm, {', '.join(ESTIMATORS)}")
    if hits not in ("auto", "all", "off"):
        raise DataError(f"hits {hits!r} is none of auto, all, off")
    if band is not None and not 0 <= band[0] < band[1]:
        raise DataError(f"band {band} Hz is empty")
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
    with threadpool_limits(1, "blas"):
        if estimator == "periodic" or (automatic and block_seconds is None):
            periodic = _periodic(runs, band, window_lines, estimator == "periodic")
            if periodic is not None:
                return _finished(merge_runs(periodic, wanted), left_out)
        impacts: list[ImpactBlocks | None] = [None] * len(runs)
        if estimator != "lrm" and hits != "off":
            impacts = _cut_hits(runs, block_seconds, band, hits == "auto")
        averaged: list[RunEstimate] | None = None
        reason, peak = "asked for", None
        if estimator != "lrm":
            kind = "h1" if estimator in (None, "auto") else str(estimator)
            length = _block_seconds(runs, impacts, block_seconds)
            if window is None and any(b is not None and b.single and b.overlapping for b in impacts):
                # One window for all hits: FRFs under different ones are those of different structures.
                window = "exponential" if all(b is not None for b in impacts) else None
            averaged = [
                _averaged_run(r, b, kind, length, overlap, window, band, exponential_end) for r, b in zip(runs, impacts, strict=True)
            ]
            if automatic:
                reason, peak = _leakage_reason(averaged, impacts)
                if reason and not all(usable(r) for r in runs):
                    reason = ""
                if not reason and block_seconds is None and peak is not None and not any(impacts):
                    averaged = _shorter_blocks(runs, averaged, impacts, peak, length, (kind, overlap, window, band, exponential_end))
        if estimator == "lrm" or (automatic and reason):
            lines, peak = choose_lines(runs, band, line_spacing_hz, max_lines, window_lines)
            estimates = [rational_run(r, lines, window_lines) for r in runs]
            estimates = [
                replace(e, findings=(*e.findings, *_hit_findings(r, b, True))) for e, r, b in zip(estimates, runs, impacts, strict=True)
            ]
            extra = [_estimator_finding(reason, peak, lines)]
        else:
            assert averaged is not None
            estimates = [
                replace(e, findings=(*e.findings, *_hit_findings(r, b, False, e.exponential_window_rate)))
                for e, r, b in zip(averaged, runs, impacts, strict=True)
            ]
            extra = _few_averages(estimates)
        estimates, unexcited = within_excited(estimates)
        return _finished(merge_runs(estimates, wanted), [*left_out, *extra, *unexcited])


def _periodic(runs: Sequence[RunInput], band: tuple[float, float] | None, window_lines: int, asked: bool) -> list[RunEstimate] | None:
    """Estimates on the excited lines of the runs whose forces repeat, the others by local rational models at those lines.

    None where no run is periodic, or one can be estimated in neither way.

    Raises
    ------
    DataError
        If it was asked for and a run is not periodic.
    """
    found = periodic_runs(runs)
    done = {i for places, _ in found for i in places}
    others = [r for i, r in enumerate(runs) if i not in done]
    if asked and others:
        raise DataError(
            "the forces do not repeat three times, or several forces cannot be told apart",
            where=others[0].name,
            hint="leave estimator at auto, or give at least three periods (and one run for each of several forces)",
        )
    if not found or not all(usable(r) for r in others):
        return None
    estimates = on_common_lines([e for _, e in found])
    hz = estimates[0].frequencies_hz
    if band is not None:
        keep = (hz >= band[0]) & (hz <= band[1])
        if not keep.any():
            raise DataError(f"band {band} Hz holds no excited line", hint=f"the force excites {hz[0]:.4g} to {hz[-1]:.4g} Hz")
        estimates, hz = [at_lines(e, keep) for e in estimates], hz[keep]
    return [*estimates, *(rational_run(r, hz, window_lines) for r in others)]


def _finished(frf: Frf, findings: Sequence[Finding]) -> Frf:
    """The FRF with findings, those alike as one, and without lines that some pair lacks which is measured at others."""
    frf = replace(frf, findings=tuple(group_findings([*findings, *frf.findings])))
    there = np.isfinite(frf.data)
    keep = np.all(there | ~there.any(axis=2, keepdims=True), axis=(0, 1))
    if keep.all() or not keep.any():
        return frf
    part = lambda a: None if a is None else a[:, :, keep]  # noqa: E731
    axis = FrequencyAxis(frf.frequencies_hz[keep])
    return replace(frf, data=frf.data[:, :, keep], axis=axis, variance=part(frf.variance), coherence=part(frf.coherence))


def _cut_hits(
    runs: Sequence[RunInput], block_seconds: float | None, band: tuple[float, float] | None, select: bool
) -> list[ImpactBlocks | None]:
    """Blocks at hits of each hammer run, all of the length of the shortest."""

    def cut(run: RunInput, seconds: float | None) -> ImpactBlocks:
        return impact_blocks(run.record, run.forces[0], run.finite(run.responses), block_seconds=seconds, band=band, select=select)

    hammer = [len(r.forces) == 1 and len(r.finite(r.forces)) == 1 and is_impact(r.record.data[r.forces[0]]) for r in runs]
    blocks = [cut(r, block_seconds) if h else None for r, h in zip(runs, hammer, strict=True)]
    lengths = {b.block / r.record.sampling_hz for b, r in zip(blocks, runs, strict=True) if b is not None}
    if len(lengths) > 1:
        shortest = min(lengths)
        blocks = [
            b if b is None or b.block / r.record.sampling_hz == shortest else cut(r, shortest) for b, r in zip(blocks, runs, strict=True)
        ]
    return blocks


def _block_seconds(runs: Sequence[RunInput], impacts: Sequence[ImpactBlocks | None], given: float | None) -> float:
    """Block length common to all runs [s]."""
    cut = [b.block / r.record.sampling_hz for b, r in zip(impacts, runs, strict=True) if b is not None]
    if cut:
        return min(cut)
    return given if given is not None else min(r.record.duration_s for r in runs) / 8


def _lines(band: tuple[float, float] | None, sampling_hz: float, block: int) -> slice | None:
    if band is None:
        return None
    step = sampling_hz / block
    first, last = int(np.ceil(band[0] / step - 1e-9)), min(block // 2, int(np.floor(band[1] / step + 1e-9)))
    if last < first:
        raise DataError(f"band {band} Hz holds no line of blocks of {block / sampling_hz:g} s", hint="give a longer block_seconds")
    return slice(first, last + 1)


def _averaged_run(
    run: RunInput,
    blocks: ImpactBlocks | None,
    estimator: str,
    block_s: float,
    overlap: float | None,
    window: str | None,
    band: tuple[float, float] | None,
    end: float,
) -> RunEstimate:
    """H1, H2 or Hv of one run, averaged over blocks or hits."""
    record = run.record
    block = blocks.block if blocks is not None else max(8, round(block_s * record.sampling_hz))
    lines = _lines(band, record.sampling_hz, block)
    rate, share = 0.0, 0.0
    if blocks is None:
        window = window or "hann"
        share = overlap if overlap is not None else (0.5 if window == "hann" else 0.0)
    run = _with_bad_samples_if_need_be(run, block_starts(record.n_samples, block, share) if blocks is None else blocks.starts, block)
    if blocks is not None:
        window = window or ("exponential" if blocks.single and blocks.overlapping else "rectangular")
        responses = run.finite(run.responses)
        spectra, rate = impact_spectra(record, run.forces[0], responses, blocks, window=window, end=end, lines=lines, bad=run.bad)
        run = replace(run, responses=tuple(responses))
        how = f"hits={spectra.blocks}, block_seconds={block / record.sampling_hz:g}, window={window!r}"
    else:
        spectra = cross_spectra(
            record.data,
            run.forces,
            run.responses,
            record.sampling_hz,
            block,
            overlap=share,
            window=window or "hann",
            lines=lines,
            bad=run.bad,
        )
        how = f"block_seconds={block / record.sampling_hz:g}, overlap={share:g}, window={window!r}"
    h, variance, coherence, condition = estimate(spectra, estimator)
    if spectra.averages <= len(run.forces):
        variance = roughness_variance(h, force_power=np.real(np.einsum("jjl->jl", spectra.force)))
        coherence = coherence_of(h, variance, spectra.averages).min(axis=1)
    inverse, _ = inverse_force_matrix(spectra.force)
    with np.errstate(divide="ignore"):
        gain = spectra.averages / np.real(np.einsum("jjl->jl", inverse))
    findings = (*run.findings, *_average_findings(run, spectra, condition))
    return RunEstimate(
        spectra.frequencies_hz,
        h,
        variance,
        np.array(np.broadcast_to(coherence[:, None, :], h.shape)),
        np.nan_to_num(gain, nan=0.0, posinf=0.0),
        spectra.averages,
        run.response_dofs,
        run.references,
        run.quantity,
        run.level,
        estimator,
        si=run.si,
        name=record.name,
        exponential_window_rate=rate,
        findings=findings,
        provenance=record.provenance.then(f"estimate_frf(estimator={estimator!r}, {how}, averages={spectra.averages:.3g})"),
    )


def _with_bad_samples_if_need_be(run: RunInput, starts: np.ndarray, block: int) -> RunInput:
    """The run without its bad spans where no block would be left, and the finding that says so: a doubtful estimate is better than none."""
    if not run.bad or not all(any(s <= last and s + block > begin for begin, last in run.bad) for s in starts):
        return run
    finding = Finding(
        "bad_samples_used",
        f"each of {len(starts)} blocks holds samples that are clipped or lost; they are used all the same",
        "warning",
        file=run.name,
        consequence="FRFs of the channels with an overload or dropout are wrong in size",
        action="exclude these channels in [channels], or measure again with a larger input range",
    )
    return replace(run, bad=(), findings=(*run.findings, finding))


def _average_findings(run: RunInput, spectra: CrossSpectra, condition: np.ndarray) -> list[Finding]:
    """Findings about the number of averages, blocks left out and correlated forces."""
    out = []
    dof = ", ".join(str(d) for d in run.references)
    n_f = len(run.forces)
    if spectra.skipped:
        message = f"{spectra.skipped} of {spectra.skipped + spectra.blocks} blocks hold bad samples and are left out"
        out.append(Finding("blocks_left_out", message, "info", file=run.name, consequence="fewer averages"))
    if n_f > 1 and np.median(condition) > 1e3:
        out.append(
            Finding(
                "ill_conditioned",
                f"the forces at {dof} are nearly coherent (median condition number {np.median(condition):.3g})",
                "warning",
                file=run.name,
                consequence="the columns cannot be told apart",
                action="drive the shakers with independent signals",
            )
        )
    return out


def _few_averages(estimates: Sequence[RunEstimate]) -> list[Finding]:
    """One finding for the references of a state whose runs together have few averages."""
    groups: list[list[RunEstimate]] = []
    for run in estimates:
        mine = next((g for g in groups if same_references(g[0], run)), None)
        if mine is None:
            groups.append([run])
        else:
            mine.append(run)
    few = [(sum(r.averages for r in g), g[0]) for g in groups if sum(r.averages for r in g) < FEW_AVERAGES * len(g[0].references)]
    if not few:
        return []
    least, run = min(few, key=lambda item: item[0] / len(item[1].references))
    dofs = [", ".join(map(str, r.references)) for _, r in few]
    shown = "; ".join(dofs[:6]) + (" …" if len(dofs) > 6 else "")
    where = f" at {shown}" if len(dofs) == 1 else f" at the worst of {len(dofs)} references ({shown})"
    return [
        Finding(
            "few_averages",
            f"{least:.3g} effective averages for {len(run.references)} force(s){where}",
            "warning",
            file=run.name if len(few) == 1 else None,
            dof=dofs[0] if len(dofs) == 1 else None,
            consequence="coherence and variance are uncertain"
            if least > len(run.references)
            else "coherence and variance are only those of what is not smooth from line to line",
            action="measure longer, use shorter blocks or more hits",
        )
    ]


def _hit_findings(run: RunInput, blocks: ImpactBlocks | None, whole_record: bool, rate: float = 0.0) -> list[Finding]:
    """Findings of a hammer run: hits that are not used, and overlap. The whole record uses every hit."""
    if blocks is None:
        return []
    dof = str(run.references[0])
    out = [] if whole_record and not blocks.cut else blocks.findings(run.name, dof)
    if blocks.overlapping:
        out.append(overlap_finding(blocks, run.name, dof, whole_record, rate))
    return out


def _leakage_reason(averaged: Sequence[RunEstimate], impacts: Sequence[ImpactBlocks | None]) -> tuple[str, Peak | None]:
    """Why averaging over blocks would leak, empty where it would not; and the sharpest peak."""
    for blocks in impacts:
        if blocks is not None and blocks.overlapping and not blocks.single:
            return f"hits overlap: {100 * blocks.remaining:.2g} % of the amplitude is left at {blocks.remaining_hz:.4g} Hz", None
    peaks = []
    for estimate_, blocks in zip(averaged, impacts, strict=True):
        if blocks is None:
            peak = sharpest(resonance_peaks(estimate_.frequencies_hz, estimate_.data, estimate_.variance))
            if peak is not None:
                peaks.append((peak, float(np.median(np.diff(estimate_.frequencies_hz)))))
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


def _shorter_blocks(
    runs: Sequence[RunInput],
    averaged: list[RunEstimate],
    impacts: Sequence[ImpactBlocks | None],
    peak: Peak,
    length: float,
    options: tuple[str, float | None, str | None, tuple[float, float] | None, float],
) -> list[RunEstimate]:
    """The estimate with blocks just long enough for the sharpest peak (twice the lines needed): more averages, fewer lines."""
    shorter = 2 * LINES_NEEDED / peak.bandwidth_hz
    if shorter > 0.6 * length:
        return averaged
    kind, overlap, window, band, end = options
    return [_averaged_run(r, b, kind, shorter, overlap, window, band, end) for r, b in zip(runs, impacts, strict=True)]


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
