"""Estimates of single runs, and their merging into one matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, FrequencyAxis, Frf, Provenance
from operando.dof import Dof
from operando.errors import DataError

Array = NDArray[Any]

HOMOGENEITY_RATIO = 3.0
HOMOGENEITY_RELATIVE = 0.01


@dataclass(frozen=True)
class RunEstimate:
    """FRFs of one run, with what is needed to weigh it against others.

    Parameters
    ----------
    data : (n_responses, n_references, n_lines) complex array
    variance : array of the same shape
    coherence : array of the same shape
    gain : (n_references, n_lines) array
        Information in the run: 1/gain is the variance of H at unit noise.
    averages : float
        Effective averages, or residual degrees of freedom of a local model.
    level : float
        Rms of the forces [N].
    method : str
        ``h1``, ``h2``, ``hv`` or ``lrm``.
    """

    frequencies_hz: Array
    data: Array
    variance: Array
    coherence: Array
    gain: Array
    averages: float
    responses: tuple[Dof, ...]
    references: tuple[Dof, ...]
    quantity: str
    level: float
    method: str
    si: bool = True
    name: str = ""
    exponential_window_rate: float = 0.0
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)


def same_references(first: RunEstimate, second: RunEstimate) -> bool:
    """Whether two runs excite the same DOFs, in whatever sense and order."""
    key = lambda run: {(d.node, d.axis) for d in run.references}  # noqa: E731
    return key(first) == key(second)


def aligned(run: RunEstimate, responses: Sequence[Dof], references: Sequence[Dof]) -> RunEstimate:
    """The run on other rows and columns: NaN where it measured nothing, sign by the sense of each DOF."""
    shape = (len(responses), len(references), run.frequencies_hz.size)
    data, variance, coherence = np.full(shape, np.nan, complex), np.full(shape, np.nan), np.full(shape, np.nan)
    gain = np.zeros((len(references), run.frequencies_hz.size))
    rows = {(d.node, d.axis): (i, d.sign) for i, d in enumerate(run.responses)}
    columns = {(d.node, d.axis): (j, d.sign) for j, d in enumerate(run.references)}
    for j, reference in enumerate(references):
        column = columns.get((reference.node, reference.axis))
        if column is None:
            continue
        gain[j] = run.gain[column[0]]
        for i, response in enumerate(responses):
            row = rows.get((response.node, response.axis))
            if row is None:
                continue
            sign = row[1] * column[1] * response.sign * reference.sign
            data[i, j] = sign * run.data[row[0], column[0]]
            variance[i, j] = run.variance[row[0], column[0]]
            coherence[i, j] = run.coherence[row[0], column[0]]
    return replace(
        run, data=data, variance=variance, coherence=coherence, gain=gain, responses=tuple(responses), references=tuple(references)
    )


def inhomogeneity(first: RunEstimate, second: RunEstimate) -> tuple[float, float]:
    """How far two runs of the same reference differ.

    Returns
    -------
    ratio : float
        Median over rows and eight bands of mean |ΔH|² over mean (var₁ + var₂), 1 where only noise differs; the largest band counts.
    relative : float
        sqrt(Σ|ΔH|²/Σ|H|²) over the lines with a signal-to-noise ratio above 10, after taking off the expected noise.
    """
    second = aligned(second, first.responses, first.references)
    difference = np.abs(first.data - second.data) ** 2
    expected = first.variance + second.variance
    size = 0.5 * (np.abs(first.data) ** 2 + np.abs(second.data) ** 2)
    good = np.isfinite(difference) & np.isfinite(expected) & (size > 10 * expected)
    if not good.any():
        return 0.0, 0.0
    zero = lambda a: np.where(good, a, 0.0)  # noqa: E731
    excess = float(np.sum(zero(difference)) - np.sum(zero(expected)))
    relative = float(np.sqrt(max(excess, 0.0) / np.sum(zero(size))))
    ratios = []
    for part in np.array_split(np.arange(good.shape[2]), 8):
        if part.size and good[:, :, part].sum() >= 8:
            top = np.sum(
                np.where(good[:, :, part], difference[:, :, part] / np.where(good[:, :, part], expected[:, :, part], 1), 0), axis=(1, 2)
            )
            count = good[:, :, part].sum(axis=(1, 2))
            ratios.append(float(np.median((top / np.maximum(count, 1))[count > 0])))
    return (max(ratios) if ratios else 0.0), relative


def pool(runs: Sequence[RunEstimate]) -> RunEstimate:
    """Mean of runs of the same references.

    The weight is the information in each line over the noise of each response in each run (one number over all lines: weights
    from the variance of single lines would favour lines whose noise happens to look small).
    """
    base = runs[0]
    if len(runs) == 1:
        return base
    parts = [base, *(aligned(r, base.responses, base.references) for r in runs[1:])]
    data = np.stack([p.data for p in parts])
    variance = np.stack([p.variance for p in parts])
    weight = np.stack([p.gain[None] / _noise_level(p) for p in parts])
    weight = np.where(np.isfinite(data), np.maximum(weight, 0), 0)
    total = weight.sum(axis=0)
    share = np.divide(weight, total, out=np.zeros_like(weight), where=total > 0)
    mean = np.where(total > 0, np.sum(share * np.where(np.isfinite(data), data, 0), axis=0), np.nan)
    mean_variance = np.where(total > 0, np.sum(share**2 * np.where(np.isfinite(variance), variance, 0), axis=0), np.nan)
    averages = float(sum(p.averages for p in parts))
    return replace(
        base,
        data=mean,
        variance=mean_variance,
        coherence=coherence_of(mean, mean_variance, averages),
        gain=sum((p.gain for p in parts), np.zeros_like(base.gain)),
        averages=averages,
        level=float(np.sqrt(np.mean([p.level**2 for p in parts]))),
        findings=tuple(f for p in parts for f in p.findings),
        provenance=Provenance.merge(*(p.provenance for p in parts)),
    )


def _noise_level(run: RunEstimate) -> Array:
    """Noise power of each response (n_responses, n_references, 1): median over lines of variance × gain; 1 where there is no variance."""
    product = np.where(np.isfinite(run.variance), run.variance * run.gain[None], np.nan)
    known = np.isfinite(product).any(axis=2)
    level = np.ones((*product.shape[:2], 1))
    level[known, 0] = np.nanmedian(product[known], axis=1)
    return np.where(level > 0, level, 1.0)


def coherence_of(data: Array, variance: Array, averages: float) -> Array:
    """Coherence γ² = 1/(1 + n·var/|H|²) that belongs to a variance (contract, ``var_meas``)."""
    size = np.abs(data) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size > 0, size / (size + averages * variance), 0.0)


def merge_runs(runs: Sequence[RunEstimate], references: Sequence[Dof] | None = None) -> Frf:
    """One FRF matrix from several runs.

    Runs of the same references are averaged where a homogeneity test finds no difference beyond the noise; else
    the run of the lowest level (and those like it) is kept and the finding ``nonlinear`` says so.

    Parameters
    ----------
    runs : sequence of RunEstimate
        On the same lines.
    references : sequence of Dof, optional
        Columns wanted, in order. Default: all, in the order of the runs.

    Raises
    ------
    DataError
        If the lines of the runs differ or a reference was not excited.
    """
    axis = runs[0].frequencies_hz
    if any(r.frequencies_hz.shape != axis.shape or not np.allclose(r.frequencies_hz, axis) for r in runs[1:]):
        raise DataError("the runs do not have the same frequency lines", hint="use the same sampling rate and block length for all runs")
    findings: list[Finding] = []
    groups: list[list[RunEstimate]] = []
    for run in runs:
        for group in groups:
            if same_references(group[0], run):
                group.append(run)
                break
        else:
            groups.append([run])
    kept = [_lowest_level(group, findings) for group in groups]
    columns: list[Dof] = []
    responses: list[Dof] = []
    for run in kept:
        columns += [d for d in run.references if not any(d.same_axis(c) for c in columns)]
        responses += [d for d in run.responses if not any(d.same_axis(c) for c in responses)]
    if references is not None:
        missing = [str(d) for d in references if not any(d.same_axis(c) for c in columns)]
        if missing:
            raise DataError(f"no run excites reference {', '.join(missing)}", hint="excited: " + ", ".join(str(c) for c in columns))
        columns = list(references)
    # Columns of different runs do not overlap, except where a DOF was driven alone and together with others: the most informative wins.
    parts = sorted((aligned(run, responses, columns) for run in kept), key=lambda r: -len(r.references))
    shape = (len(responses), len(columns), axis.size)
    data, variance, coherence = np.full(shape, np.nan, complex), np.full(shape, np.nan), np.full(shape, np.nan)
    for j in range(len(columns)):
        for part in sorted(parts, key=lambda r: float(np.nansum(r.gain[j]))):
            there = ~np.isnan(part.data[:, j].real).all(axis=1)
            data[there, j], variance[there, j], coherence[there, j] = part.data[there, j], part.variance[there, j], part.coherence[there, j]
    absent = [f"{d}/{c}" for i, d in enumerate(responses) for j, c in enumerate(columns) if np.isnan(data[i, j].real).all()]
    if absent:
        shown = ", ".join(absent[:6]) + (" …" if len(absent) > 6 else "")
        findings.append(
            Finding(
                "missing_pair",
                f"{len(absent)} response/reference pairs were not measured ({shown})",
                "warning",
                consequence="NaN in the FRF",
            )
        )
    rates = {r.exponential_window_rate for r in kept}
    if len(rates) > 1:
        raise DataError("runs with different exponential windows cannot be merged", hint="use the same window for all runs")
    return Frf(
        data,
        FrequencyAxis(axis),
        tuple(responses),
        tuple(columns),
        kept[0].quantity,
        variance=variance,
        coherence=coherence,
        averages=min(r.averages for r in kept),
        si=all(r.si for r in kept),
        exponential_window_rate=rates.pop(),
        name=kept[0].name,
        findings=(*(f for r in kept for f in r.findings), *findings),
        provenance=Provenance.merge(*(r.provenance for r in kept)),
    )


def _lowest_level(group: list[RunEstimate], findings: list[Finding]) -> RunEstimate:
    """Mean of the runs that agree with the one of the lowest level; a finding for those that do not."""
    ordered = sorted(group, key=lambda r: r.level)
    used, left = [ordered[0]], []
    for run in ordered[1:]:
        ratio, relative = inhomogeneity(pool(used), run)
        if ratio > HOMOGENEITY_RATIO and relative > HOMOGENEITY_RELATIVE:
            left.append((run, ratio, relative))
        else:
            used.append(run)
    out = pool(used)
    if left:
        run, ratio, relative = max(left, key=lambda item: item[2])
        same = abs(run.level / max(used[-1].level, 1e-300) - 1) < 0.2
        name = ", ".join(str(d) for d in out.references)
        cause = (
            "at the same level: the structure or its mounting changed between the runs"
            if same
            else f"level {run.level:.3g} N rms against {ordered[0].level:.3g} N rms: the response depends on the level"
        )
        findings.append(
            Finding(
                "nonlinear",
                f"runs at reference {name} differ by {100 * relative:.2g} % of |H| "
                f"({ratio:.3g} times the variance expected from noise), {cause}",
                "warning",
                file=run.name or None,
                dof=str(out.references[0]),
                consequence=f"{len(left)} of {len(group)} runs are left out; the lowest level judges the linear model",
                action="compare the levels; keep the excitation low for a linear model",
            )
        )
    return out
