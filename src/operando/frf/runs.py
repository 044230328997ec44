"""Estimates of single runs, and their merging into one matrix."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, FrequencyAxis, Frf, Provenance, common_name, one_level
from operando.dof import Dof, DofIndex
from operando.errors import DataError
from operando.frf.shift import Shift, frequency_shifts, in_words
from operando.printable import first_few

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
    hit_s : float or None
        Time of the hit where the run is a single one, used as a block [s].
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
    hit_s: float | None = None
    findings: tuple[Finding, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)


def by_references(runs: Sequence[RunEstimate]) -> list[list[RunEstimate]]:
    """The runs in groups of the same references."""
    groups: list[list[RunEstimate]] = []
    for run in runs:
        for group in groups:
            if same_references(group[0], run):
                group.append(run)
                break
        else:
            groups.append([run])
    return groups


def same_references(first: RunEstimate, second: RunEstimate) -> bool:
    """Whether two runs excite the same DOFs, in whatever sense and order."""
    key = lambda run: {d.key for d in run.references}  # noqa: E731
    return key(first) == key(second)


def aligned(run: RunEstimate, responses: Sequence[Dof], references: Sequence[Dof]) -> RunEstimate:
    """The run on other rows and columns: NaN where it measured nothing, sign by the sense of each DOF."""
    shape = (len(responses), len(references), run.frequencies_hz.size)
    data, variance, coherence = np.full(shape, np.nan, complex), np.full(shape, np.nan), np.full(shape, np.nan)
    gain = np.zeros((len(references), run.frequencies_hz.size))
    rows, columns = DofIndex(run.responses), DofIndex(run.references)
    for j, reference in enumerate(references):
        column = columns.find(reference)
        if column is None:
            continue
        gain[j] = run.gain[column[0]]
        for i, response in enumerate(responses):
            row = rows.find(response)
            if row is None:
                continue
            sign = row[1] * column[1]
            data[i, j] = sign * run.data[row[0], column[0]]
            variance[i, j] = run.variance[row[0], column[0]]
            coherence[i, j] = run.coherence[row[0], column[0]]
    return replace(
        run, data=data, variance=variance, coherence=coherence, gain=gain, responses=tuple(responses), references=tuple(references)
    )


def inhomogeneity(first: RunEstimate, second: RunEstimate) -> tuple[float, float]:
    """How far two runs of the same reference differ, as a ratio to the variance expected, and relative to |H|.

    The ratio is the median over rows and eight bands of mean |ΔH|² over mean (var₁ + var₂), 1 where only noise differs; the largest band
    counts. The relative difference is sqrt(Σ|ΔH|²/Σ|H|²) over the lines with a signal-to-noise ratio above 10, less the expected noise.
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


def each_once(lists: Iterable[Sequence[Dof]]) -> tuple[Dof, ...]:
    """DOFs of several lists, each once (in the sense of the list that has it first), in order."""
    return tuple(DofIndex(d for dofs in lists for d in dofs))


def pool(runs: Sequence[RunEstimate], responses: Sequence[Dof] | None = None) -> RunEstimate:
    """Mean of runs of the same references over the union of their responses (or some of them): sensors may have roved between the runs.

    The weight is the information in each line over the noise of each response in each run (one number over all lines: weights
    from the variance of single lines would favour lines whose noise happens to look small). A pair that one run alone measured
    stays as it is.
    """
    base = runs[0]
    rows = tuple(responses) if responses is not None else each_once(run.responses for run in runs)
    if len(runs) == 1:
        return base if rows == base.responses else aligned(base, rows, base.references)
    shape = (len(rows), len(base.references), base.frequencies_hz.size)
    total, mean, spread = np.zeros(shape), np.zeros(shape, complex), np.zeros(shape)
    averages, gain, times = np.zeros((*shape[:2], 1)), np.zeros_like(base.gain), np.zeros((*shape[:2], 1), int)
    own = np.zeros(shape)
    parts = [aligned(r, rows, base.references) for r in runs]
    for p in parts:
        times += np.isfinite(p.data).any(axis=2, keepdims=True)
    for p in parts:
        known = np.isfinite(p.data)
        weight = np.where(times == 1, 1.0, np.maximum(p.gain[None] / _noise_level(p), 0))
        weight = np.where(known, weight, 0)
        total += weight
        mean += weight * np.where(known, p.data, 0)
        spread += weight**2 * np.where(np.isfinite(p.variance), p.variance, 0)
        averages += p.averages * known.any(axis=2, keepdims=True)
        own += np.where(known, p.coherence, 0)
        gain += p.gain
    there = total > 0
    mean = np.where(there, mean / np.where(there, total, 1), np.nan)
    variance = np.where(there, spread / np.where(there, total, 1) ** 2, np.nan)
    return replace(
        base,
        data=mean,
        variance=variance,
        coherence=np.where(there, np.where(times == 1, own, coherence_of(mean, variance, averages)), np.nan),
        gain=gain,
        averages=float(averages[averages > 0].min()) if (averages > 0).any() else base.averages,
        responses=rows,
        level=float(np.sqrt(np.mean([p.level**2 for p in parts]))),
        si=all(p.si for p in parts),
        name=common_name(parts),
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


def coherence_of(data: Array, variance: Array, averages: float | Array) -> Array:
    """Coherence γ² = 1/(1 + n·var/|H|²) that belongs to a variance (specification, ``var_meas``)."""
    size = np.abs(data) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size > 0, size / (size + averages * variance), 0.0)


def merge_runs(runs: Sequence[RunEstimate], references: Sequence[Dof] | None = None) -> Frf:
    """One FRF matrix from several runs, over the union of their sensors.

    Runs of the same references are averaged, sensor by sensor, where a homogeneity test on the sensors they share finds no difference
    beyond the noise. Else the run of the lowest level (and those like it) gives the rows that are shared; what only another run measured
    is kept, and a finding says how far the runs are apart.

    Parameters
    ----------
    runs : sequence of RunEstimate
        On the same lines.
    references : sequence of Dof, optional
        Columns wanted, in order. Default: all, in the order of the runs.

    Returns
    -------
    Frf

    Raises
    ------
    DataError
        If the lines of the runs differ or a reference was not excited.

    Examples
    --------
    >>> import numpy as np
    >>> from operando.dof import Dof
    >>> f, h = np.arange(1.0, 21.0), np.full((1, 1, 20), 2.0 + 0j)
    >>> small, ones = np.full((1, 1, 20), 1e-6), np.ones((1, 20))
    >>> at = lambda node: (Dof(node, "Z"),)
    >>> run = RunEstimate(f, h, small, 0 * small + 1, ones, 8.0, at(2), at(1), "accelerance", 1.0, "h1", name="run 1")
    >>> merge_runs([run]).data.shape
    (1, 1, 20)
    """
    axis = runs[0].frequencies_hz
    if any(r.frequencies_hz.shape != axis.shape or not np.allclose(r.frequencies_hz, axis) for r in runs[1:]):
        raise DataError("the runs do not have the same frequency lines", hint="use the same sampling rate and block length for all runs")
    findings: list[Finding] = []
    kept = [merge_group(group, findings) for group in by_references(runs)]
    columns: list[Dof] = []
    for run in kept:
        columns += [d for d in run.references if not any(d.same_axis(c) for c in columns)]
    if references is not None:
        missing = [str(d) for d in references if not any(d.same_axis(c) for c in columns)]
        if missing:
            raise DataError(f"no run excites reference {', '.join(missing)}", hint="excited: " + ", ".join(str(c) for c in columns))
        columns = list(references)
        kept = [run for run in kept if any(d.same_axis(c) for d in run.references for c in columns)]
    rates = {r.exponential_window_rate for r in kept}
    if len(rates) > 1:
        raise DataError("runs with different exponential windows cannot be merged", hint="use the same window for all runs")
    responses = each_once(run.responses for run in kept)
    data, variance, coherence = _columns(kept, responses, columns)
    findings += absent_pairs(data, responses, columns)
    return Frf(
        data,
        FrequencyAxis(axis),
        responses,
        tuple(columns),
        kept[0].quantity,
        variance=variance,
        coherence=coherence,
        averages=min(r.averages for r in kept),
        si=all(r.si for r in kept),
        exponential_window_rate=rates.pop(),
        name=common_name(kept),
        setups=measured_by(runs, responses, columns),
        findings=(*(f for r in kept for f in r.findings), *findings),
        provenance=Provenance.merge(*(r.provenance for r in kept)),
    )


def _columns(kept: Sequence[RunEstimate], responses: Sequence[Dof], columns: Sequence[Dof]) -> tuple[Array, Array, Array]:
    """Data, variance and coherence of all columns, NaN where a pair was not measured.

    Columns of different groups do not overlap, except where a DOF was driven alone and together with others: the most informative wins.
    """
    if len(kept) == 1 and kept[0].responses == tuple(responses) and kept[0].references == tuple(columns):
        return kept[0].data, kept[0].variance, kept[0].coherence
    shape = (len(responses), len(columns), kept[0].frequencies_hz.size)
    data, variance, coherence = np.full(shape, np.nan, complex), np.full(shape, np.nan), np.full(shape, np.nan)
    for j, column in enumerate(columns):
        parts = [aligned(run, responses, [column]) for run in kept if any(d.same_axis(column) for d in run.references)]
        for part in sorted(parts, key=lambda r: float(np.nansum(r.gain[0]))):
            there = ~np.isnan(part.data[:, 0].real).all(axis=1)
            data[there, j], variance[there, j], coherence[there, j] = part.data[there, 0], part.variance[there, 0], part.coherence[there, 0]
    return data, variance, coherence


def measured_by(
    parts: Sequence[RunEstimate] | Sequence[Frf], responses: Sequence[Dof], references: Sequence[Dof]
) -> NDArray[np.int_] | None:
    """Number of the part that alone measured each pair, −1 for more than one; None where no two parts measured pairs of their own.

    So it is where all parts have the same responses, and where one of them only lost a channel.
    """
    sensors = [{d.key for d in part.responses} for part in parts]
    if all(s == sensors[0] for s in sensors):
        return None
    forces = [{d.key for d in part.references} for part in parts]
    out = np.full((len(responses), len(references)), -1)
    for i, d in enumerate(responses):
        for j, e in enumerate(references):
            having = [k for k in range(len(parts)) if d.key in sensors[k] and e.key in forces[k]]
            if len(having) == 1:
                out[i, j] = having[0]
    return out if np.unique(out[out >= 0]).size > 1 else None


def absent_pairs(data: Array, responses: Sequence[Dof], columns: Sequence[Dof]) -> list[Finding]:
    """The finding ``missing_pair`` where sensors were not measured with every reference."""
    empty = np.isnan(data.real).all(axis=2)
    absent = [f"{d}/{c}" for i, d in enumerate(responses) for j, c in enumerate(columns) if empty[i, j]]
    if not absent:
        return []
    shown = first_few(absent)
    return [
        Finding(
            "missing_pair",
            f"{len(absent)} of {empty.size} response/reference pairs were not measured ({shown})",
            "warning",
            consequence="they have no FRF; the modes come from the pairs there are",
            action="measure every sensor with every reference, if these pairs are wanted",
        )
    ]


def merge_group(group: Sequence[RunEstimate], findings: list[Finding]) -> RunEstimate:
    """Runs of the same references in one: the mean of those that agree with the lowest level, and rows that only others have.

    ``findings`` gains one for the runs that differ, and one for sensors that nothing ties to the others.
    """
    if len(group) == 1:
        return group[0]
    ordered = sorted(group, key=lambda r: r.level)
    used, apart = [ordered[0]], []
    for run in ordered[1:]:
        mine = DofIndex(run.responses)
        sharing = [u for u in used if any(d in mine for d in u.responses)]
        if not sharing:
            findings += _shift_finding(used[0], run)
        ratio, relative = inhomogeneity(run, pool(sharing, run.responses)) if sharing else (0.0, 0.0)
        if ratio > HOMOGENEITY_RATIO and relative > HOMOGENEITY_RELATIVE:
            apart.append((run, ratio, relative))
        else:
            used.append(run)
    base = pool(used)
    if not apart:
        return base
    rest = _own_rows(base, [run for run, _, _ in apart])
    left = [run for (run, _, _), own in zip(apart, rest, strict=True) if own is None]
    findings.append(_apart_finding(base, ordered[0], used[-1].level, apart, left, len(group)))
    return pool([base, *(own for own in rest if own is not None)])


def _own_rows(base: RunEstimate, runs: Sequence[RunEstimate]) -> list[RunEstimate | None]:
    """Of runs that differ from the others the rows that no earlier one has; None for a run that has none."""
    have = {d.key for d in base.responses}
    out: list[RunEstimate | None] = []
    for run in runs:
        own = [d for d in run.responses if d.key not in have]
        have |= {d.key for d in own}
        out.append(aligned(run, own, run.references) if own else None)
    return out


def shift_between(first: RunEstimate, second: RunEstimate) -> Shift | None:
    """Shift of the modes from one run to another, on the pairs that both measured, else on all of each."""
    n = first.frequencies_hz.size
    other = aligned(second, first.responses, first.references)
    both = np.isfinite(first.data).any(axis=2) & np.isfinite(other.data).any(axis=2)
    if both.any():
        parts = [(run.data[both], run.variance[both]) for run in (first, other)]
    else:
        parts = [(run.data.reshape(-1, n), run.variance.reshape(-1, n)) for run in (first, second)]
    return frequency_shifts(first.frequencies_hz, *parts)


ROVING_CONSEQUENCE = "their FRFs have peaks at different frequencies, which the modal analysis may take for two modes"
ROVING_ACTION = "keep mass, temperature and level the same while sensors move (dummy masses), or measure all at once"


def _shift_finding(first: RunEstimate, run: RunEstimate) -> list[Finding]:
    """``shifted_modes`` for a run that shares no sensor with the others and has its peaks elsewhere."""
    shift = shift_between(first, run)
    if shift is None or not shift.apart:
        return []
    return [
        Finding(
            "shifted_modes",
            f"the modes are {in_words(shift)} against {first.name or 'the run of the lowest level'}, which has other sensors",
            "warning",
            file=run.name or None,
            dof=str(run.references[0]),
            consequence=f"the sensors of all files are used: {ROVING_CONSEQUENCE}",
            action=ROVING_ACTION,
        )
    ]


def _apart_finding(
    base: RunEstimate,
    lowest: RunEstimate,
    highest: float,
    apart: Sequence[tuple[RunEstimate, float, float]],
    left: Sequence[RunEstimate],
    n_runs: int,
) -> Finding:
    """What the homogeneity test found: ``shifted_modes`` where each run that differs has sensors of its own, else ``nonlinear``."""
    run, ratio, relative = max(apart, key=lambda item: item[2])
    same = one_level(run.level, highest)
    kept = [r for r, _, _ in apart if not any(r is one for one in left)]
    # Only the same sensors at two levels tell a level: where sensors moved, too, so did their mass.
    moving = not left
    shift = shift_between(base, run)
    moved = f"; in {run.name or 'one of them'} the modes are {in_words(shift)}" if shift is not None else ""
    others = [f"{r.name} ({100 * share:.2g} %)" for r, _, share in apart if r is not run and r.name]
    also = f"; also {first_few(others)}" if others else ""
    levels = f"level {run.level:.4g} N rms against {(highest if same else lowest.level):.4g} N rms"
    if moving:
        cause = "sensors moved" + ("" if same else f", and the level changed: {levels}")
    elif same:
        cause = f"{levels}, nearly the same: the structure or its mounting changed between the runs, or the response depends on the level"
    else:
        cause = f"{levels}: the response depends on the level"
    consequence = [f"{len(left)} of {n_runs} runs are left out; the linear model is that of the lowest level"] if left else []
    if kept:
        names = ", ".join(dict.fromkeys(r.name for r in kept if r.name))
        consequence.append(f"sensors that only {names or 'such a run'} measured are kept: {ROVING_CONSEQUENCE}")
    return Finding(
        "shifted_modes" if moving else "nonlinear",
        f"runs at reference {', '.join(str(d) for d in base.references)} differ by {100 * relative:.2g} % of |H| at the sensors they share "
        f"({ratio:.3g} times the variance expected from noise), {cause}{moved}{also}",
        "warning",
        file=run.name or None,
        dof=str(base.references[0]),
        consequence="; ".join(consequence),
        action=ROVING_ACTION
        if moving
        else "check mounting, temperature and cables; runs at levels a factor of two apart show whether it is the level"
        if same
        else "compare the levels; keep the excitation low for a linear model",
    )
