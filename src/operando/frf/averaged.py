"""H1, H2 and Hv of one run, averaged over blocks or hits, and the findings about the averages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from operando.data import Finding
from operando.dof import Node
from operando.errors import DataError
from operando.frf.cut_off import cut_off_modes, with_whole_decays
from operando.frf.estimators import estimate
from operando.frf.hits import LEAST_BLOCK
from operando.frf.impact import ImpactBlocks, impact_spectra
from operando.frf.inputs import RunInput
from operando.frf.rational import roughness_variance
from operando.frf.runs import RunEstimate, by_references, coherence_of
from operando.frf.spectra import CrossSpectra, block_starts, cross_spectra

FEW_AVERAGES = 4.0
BIASED = 9.0
"""Mean of |H − H1|² over the variance of H from which H2 or Hv is said to be biased: three standard deviations."""
_SAID = 1e-4  # part of its amplitude that a peak lost to the length of blocks, from which its history names it


def _lines(band: tuple[float, float] | None, sampling_hz: float, block: int) -> slice | None:
    if band is None:
        return None
    step = sampling_hz / block
    first, last = int(np.ceil(band[0] / step - 1e-9)), min(block // 2, int(np.floor(band[1] / step + 1e-9)))
    if last < first:
        raise DataError(f"band {band} Hz holds no line of blocks of {block / sampling_hz:g} s", hint="give a longer block_seconds")
    return slice(first, last + 1)


def averaged_run(
    run: RunInput,
    blocks: ImpactBlocks | None,
    block_s: float,
    estimator: str,
    overlap: float | None,
    window: str | None,
    hit_window: str,
    band: tuple[float, float] | None,
    end: float,
) -> RunEstimate:
    """H1, H2 or Hv of one run, averaged over blocks or hits."""
    record = run.record
    block = blocks.block if blocks is not None else max(LEAST_BLOCK, round(block_s * record.sampling_hz))
    lines = _lines(band, record.sampling_hz, block)
    rate, share = 0.0, 0.0
    if blocks is None:
        window = window or "hann"
        share = overlap if overlap is not None else (0.5 if window == "hann" else 0.0)
    run = _with_bad_samples_if_need_be(run, block_starts(record.n_samples, block, share) if blocks is None else blocks.starts, block)
    if blocks is not None:
        window = hit_window
        responses = run.finite(run.responses)
        spectra, rate = impact_spectra(record, run.forces[0], responses, blocks, window=window, end=end, lines=lines, bad=run.bad)
        run = replace(run, responses=tuple(responses))
        how = f"hits={spectra.blocks}, block_seconds={block / record.sampling_hz:g}, window={window!r}"
        used = np.array([s for s in blocks.starts if not any(s <= last and s + block > begin for begin, last in run.bad)])
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
            finite=bool(record.statistics.finite[[*run.forces, *run.responses]].all()),
        )
        how = f"block_seconds={block / record.sampling_hz:g}, overlap={share:g}, window={window!r}"
    h, variance, coherence, condition, inverse = _estimated(spectra, estimator, len(run.forces))
    if blocks is not None and not rate:
        force = np.asarray(record.data[run.forces[0]], float) - blocks.hits.offset
        modes = cut_off_modes(spectra.frequencies_hz, h[:, 0], variance[:, 0], force, used, block, record.sampling_hz)
        if modes:
            # Averaged again: what hits cut off and leave differs from hit to hit, and is no noise.
            data = np.array(record.data, float)
            data[list(run.responses)] = with_whole_decays(data[list(run.responses)], modes, used, block, record.sampling_hz)
            whole = replace(record, data=data)
            spectra, _ = impact_spectra(whole, run.forces[0], run.responses, blocks, window=window or "", end=end, lines=lines, bad=run.bad)
            h, variance, coherence, condition, inverse = _estimated(spectra, estimator, len(run.forces))
        how += "".join(f", cut off at {m.peak_hz:.4g} Hz and put back: {100 * m.part:.1g} %" for m in modes if m.part > _SAID)
    with np.errstate(divide="ignore"):
        gain = spectra.averages / inverse
    findings = (*run.findings, *_average_findings(run, spectra, condition), *_bias_findings(run, spectra, estimator, h, variance))
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
        hit_s=record.start_s + float(blocks.hits.times_s[blocks.hits.used][0]) if blocks is not None and blocks.single else None,
        findings=findings,
        provenance=record.provenance.then(f"estimate_frf(estimator={estimator!r}, {how}, averages={spectra.averages:.3g})"),
    )


def _estimated(spectra: CrossSpectra, estimator: str, n_forces: int) -> tuple[Any, ...]:
    """FRFs, their variance, coherence, condition and inverse of the force matrix; with one average the variance from neighbouring lines."""
    h, variance, coherence, condition, inverse = estimate(spectra, estimator)
    if spectra.averages <= n_forces:
        variance = roughness_variance(h, force_power=np.real(np.einsum("jjl->jl", spectra.force)))
        coherence = coherence_of(h, variance, spectra.averages).min(axis=1)
    return h, variance, coherence, condition, inverse


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
                consequence="the columns cannot be distinguished",
                action="drive the shakers with independent signals",
            )
        )
    return out


def _bias_findings(run: RunInput, spectra: CrossSpectra, estimator: str, h: np.ndarray, variance: np.ndarray) -> list[Finding]:
    """A finding where H2 or Hv differs from H1 by more than the variance says: noise makes one of them wrong, and no variance holds it."""
    if estimator == "h1" or spectra.averages <= len(run.forces):
        return []
    apart = np.abs(h - estimate(spectra, "h1")[0]) ** 2
    known = np.isfinite(apart) & np.isfinite(variance) & (variance > 0)
    if not known.any():
        return []
    ratio = float(np.mean(apart[known] / variance[known]))
    share = float(np.sqrt(np.sum(apart[known]) / np.sum(np.abs(h[known]) ** 2)))
    if ratio < BIASED:
        return []
    name = estimator.capitalize()
    return [
        Finding(
            "biased_estimator",
            f"{name} differs from H1 by {100 * share:.2g} % of the FRFs, on average {np.sqrt(ratio):.2g} times the standard deviation",
            "warning",
            file=run.name,
            consequence=f"noise on the responses makes {name} too large, most between resonances, noise on the force makes H1 too "
            "small, most at resonances; the variance holds neither",
            action='use estimator = "h1" where the force is measured with less noise than the responses',
        )
    ]


def few_averages(estimates: Sequence[RunEstimate]) -> list[Finding]:
    """One finding for the references of a state whose runs together have few averages."""
    few = [(n, g[0]) for g in by_references(estimates) if (n := _least_averages(g)) < FEW_AVERAGES * len(g[0].references)]
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


def _least_averages(runs: Sequence[RunEstimate]) -> float:
    """Averages of the response that runs of the same references have least of: sensors may have roved between the runs."""
    total: dict[tuple[Node, str], float] = {}
    for run in runs:
        for d in run.responses:
            total[d.key] = total.get(d.key, 0.0) + run.averages
    return min(total.values())
