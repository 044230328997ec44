"""What the forces of the runs are, and the lines they excite: periodic runs on their own lines, every run within its excited band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, TimeRecord, one_level
from operando.errors import DataError
from operando.frf.hits import is_impact
from operando.frf.inputs import RunInput
from operando.frf.periodic import ALIKE, FREEDOM, LEAST_LINES, PeriodicFrf, SteadyPeriods, periodic_frf, steady_periods
from operando.frf.rational import smooth
from operando.frf.runs import RunEstimate, by_references, coherence_of, same_references

Array = NDArray[Any]

FAINT, UNSEEN = 0.02, 0.9
"""At either end of the band, lines are not excited where the force has less than this part of its typical power and no response has at
least this coherence with it: noise alone. 0.02 is what the fit of whole records asks for (:func:`operando.ema.spectra.excited_limits`)."""

ABSENT = 1e-4
"""Power below which (−40 dB) a line is not excited whatever the coherence: what force is left there is a reaction to the structure's own
motion (harmonics of distortion, measured at −67 dB on the F-16 ground vibration test), not a cause of it."""

REALISATIONS = 3
"""Realisations of a multisine from which their scatter, smoothed to ``FREEDOM`` degrees, is a better variance than that of each alone."""

CHANGED = 9.0
"""Scatter over the variance of single realisations from which runs differ by more than distortion (the ratio of the homogeneity test,
3, squared: what a single realisation misses at peaks is a factor of two; tests/test_frf_periodic.py)."""

DISTORTED = 4.0
"""Distortion is named where its power is this many times the noise's, in the median over lines (6 dB; the ratio of two estimates of the
same noise stays below 2 at nine degrees of freedom and more)."""

MATTERS_DB = -40.0
"""Named distortion above 1 % of the response is a warning, where it stands ``CLEAR`` above the noise. Sensors are calibrated to 1 % at
best, so below that the level matters less than they do; above, the FRF changes with the level by as much or more (a force law that
distorts also stiffens), and frequencies and damping hold for one level of the force alone."""

CLEAR = 10.0
"""Power of distortion over that of noise from which its level is known well enough for a warning: noise off by its own size, as its
estimate may be (``DISTORTED``), changes it by 0.4 dB."""


def is_periodic(record: TimeRecord) -> bool:
    """Whether all forces of a record repeat with one period, three times at least, on enough lines to be a multisine.

    Parameters
    ----------
    record : TimeRecord
        One record.

    Returns
    -------
    bool

    Examples
    --------
    >>> import numpy as np, operando
    >>> rng = np.random.default_rng(0)
    >>> channels = [operando.Channel("1+Z", "force", "N"), operando.Channel("2+Z", "acceleration", "m/s2")]
    >>> record = operando.TimeRecord(rng.standard_normal((2, 1000)), 500.0, channels)
    >>> from operando.frf import is_periodic
    >>> is_periodic(record)
    False
    """
    rows = record.force_indices
    return bool(rows) and _steady(record, rows, []) is not None


def periodic_input(run: RunInput) -> SteadyPeriods | None:
    """Steady periods of a run with periodic forces, None where it has none."""
    return _steady(run.record, list(run.forces), run.finite(run.responses), run.bad)


def _steady(record: TimeRecord, forces: list[int], responses: list[int], bad: Sequence[tuple[int, int]] = ()) -> SteadyPeriods | None:
    data = record.data
    for row in forces:
        if not record.statistics.finite[row] or record.statistics.flat[row] or is_impact(data[row]):
            return None
    try:
        found = steady_periods(data, forces, responses, record.sampling_hz, bad=bad)
    except DataError:
        return None
    return found if np.count_nonzero(found.excited) >= LEAST_LINES else None


def periodic_runs(runs: Sequence[RunInput]) -> list[tuple[tuple[int, ...], RunEstimate]]:
    """FRFs of the periodic runs, each with the places of the runs it is made of.

    A run with one force stands alone. Runs with several forces at once are solved together with those of the same forces and level; where
    they are fewer than forces, or their forces cannot be told apart, they are left to the other estimators.
    """
    periods = [periodic_input(run) for run in runs]
    groups: list[list[int]] = []
    for i, steady in enumerate(periods):
        if steady is None:
            continue
        mine = [g for g in groups if len(runs[i].forces) > 1 and _together(runs[g[0]], periods[g[0]], runs[i], steady)]
        if mine:
            mine[0].append(i)
        else:
            groups.append([i])
    done: list[tuple[tuple[int, ...], SteadyPeriods, PeriodicFrf, RunEstimate]] = []
    for group in groups:
        steadies = [p for i in group if (p := periods[i]) is not None]
        try:
            found = periodic_frf(steadies)
        except DataError:
            continue
        done.append((tuple(group), steadies[0], found, _run_estimate([runs[i] for i in group], steadies, found)))
    variances = _over_realisations([(steady, found, run) for _, steady, found, run in done])
    return [
        (group, replace(run, variance=variance, coherence=coherence_of(run.data, variance, run.averages)))
        for (group, _, _, run), variance in zip(done, variances, strict=True)
    ]


def _over_realisations(found: Sequence[tuple[SteadyPeriods, PeriodicFrf, RunEstimate]]) -> list[Array]:
    """Variance of each run, from all runs of one reference, level and grid of lines.

    Distortion changes with the phases of the force: over three realisations and more the scatter of the FRFs is its variance, with all that
    one realisation cannot show (the height of peaks). Runs with the same phases repeat it, and it does not fall by averaging them.
    """
    out = [f.variance for _, f, _ in found]
    groups: list[list[int]] = []
    for i, (_, periodic, run) in enumerate(found):
        mine = [g for g in groups if _alike(found[g[0]][1:], (periodic, run))]
        if mine:
            mine[0].append(i)
        elif len(run.references) == 1:
            groups.append([i])
    for group in (g for g in groups if len(g) > 1):
        steadies = [found[i][0] for i in group]
        copies = [sum(_same_phases(one, other) for other in steadies) for one in steadies]
        distortion = np.array([found[i][1].distortion for i in group])
        if len(group) >= REALISATIONS and max(copies) == 1:
            h = np.array([found[i][1].data for i in group])
            free = len(group) - 1
            scatter = smooth(h.var(axis=0, ddof=1), 2 * (int(np.ceil(FREEDOM / free)) // 2) + 1)
            stated = np.mean([out[i] for i in group], axis=0)
            # More than distortion: the structure changed between the runs, which the homogeneity test says.
            if np.median(scatter / stated) < CHANGED:
                for i in group:
                    out[i] = np.maximum(scatter, found[i][1].noise)
        for k, i in enumerate(group):
            if copies[k] > 1:
                out[i] = found[i][1].noise + copies[k] * distortion[k]
    return out


def _alike(first: tuple[PeriodicFrf, RunEstimate], second: tuple[PeriodicFrf, RunEstimate]) -> bool:
    """Whether two runs have one reference, the same responses in the same order, level and lines."""
    (a, run), (b, other) = first, second
    same = run.references == other.references and run.responses == other.responses and one_level(run.level, other.level)
    return same and a.frequencies_hz.shape == b.frequencies_hz.shape and bool(np.allclose(a.frequencies_hz, b.frequencies_hz))


def _same_phases(first: SteadyPeriods, second: SteadyPeriods) -> bool:
    """Whether two forces are the same but for their beginning: the correlation of their periods at the best lag."""
    if first.period != second.period:
        return False
    a, b = first.forces[0].mean(axis=0), second.forces[0].mean(axis=0)
    a, b = np.where(first.excited, a, 0), np.where(second.excited, b, 0)
    power = np.sqrt(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2))
    lags = np.fft.irfft(a * b.conj(), first.period) * first.period / 2
    return bool(np.max(np.abs(lags)) > ALIKE * power)


def _together(first: RunInput, periods: SteadyPeriods | None, run: RunInput, steady: SteadyPeriods) -> bool:
    """Whether two runs have the same forces and responses in the same order, one period and one level."""
    same = first.references == run.references and first.response_dofs == run.response_dofs
    return periods is not None and same and periods.period == steady.period and one_level(run.level, first.level)


def _run_estimate(runs: Sequence[RunInput], steadies: Sequence[SteadyPeriods], found: PeriodicFrf) -> RunEstimate:
    run, record = runs[0], runs[0].record
    averages = float(sum(s.count for s in steadies)) / len(run.forces)
    findings = [f for r in runs for f in r.findings]
    for r, steady in zip(runs, steadies, strict=True):
        findings.append(_periodic_finding(r, steady, found))
    findings += _distortion_finding(run, found)
    return RunEstimate(
        found.frequencies_hz,
        found.data,
        found.variance,
        coherence_of(found.data, found.variance, averages),
        found.gain,
        averages,
        replace(run, responses=tuple(run.finite(run.responses))).response_dofs,
        run.references,
        run.quantity,
        float(np.sqrt(np.mean([r.level**2 for r in runs]))),
        "periodic",
        si=all(r.si for r in runs),
        name=record.name,
        findings=tuple(findings),
        provenance=record.provenance.then(
            f"estimate_frf(estimator='periodic', period={steadies[0].period} samples, periods={sum(s.count for s in steadies)})"
        ),
    )


def _periodic_finding(run: RunInput, steady: SteadyPeriods, found: PeriodicFrf) -> Finding:
    hz = found.frequencies_hz
    step = run.record.sampling_hz / steady.period
    left = f", {steady.discarded} left out at the start (transient or bad samples)" if steady.discarded else ""
    whole = round((hz[-1] - hz[0]) / step) + 1
    grid = "every line" if whole == hz.size else f"{hz.size} of {whole} lines"
    return Finding(
        "periodic_excitation",
        f"the force at {', '.join(map(str, run.references))} repeats every {steady.period / run.record.sampling_hz:.5g} s "
        f"({steady.period} samples): {steady.whole} whole periods{left}, {steady.count} averaged; it excites {grid} {step:.4g} Hz apart "
        f"from {hz[0]:.4g} to {hz[-1]:.4g} Hz",
        "info",
        file=run.name,
        dof=", ".join(map(str, run.references)),
        band_hz=(float(hz[0]), float(hz[-1])),
        consequence="FRFs, checks and fit use these lines alone, without leakage; the scatter between periods is their noise",
    )


def _distortion_finding(run: RunInput, found: PeriodicFrf) -> list[Finding]:
    """The size of the nonlinear distortion where it stands out of the noise."""
    ratio = np.median(found.distortion / np.maximum(found.noise, 1e-300), axis=2)
    if not np.any(ratio > DISTORTED):
        return []
    size = 10 * np.log10(np.maximum(np.median(found.distortion / np.maximum(np.abs(found.data) ** 2, 1e-300), axis=2), 1e-30))
    i, j = np.unravel_index(int(np.argmax(size)), size.shape)
    dofs = replace(run, responses=tuple(run.finite(run.responses))).response_dofs
    matters = bool(np.any((size > MATTERS_DB) & (ratio > CLEAR)))
    return [
        Finding(
            "nonlinear_distortion",
            f"nonlinear distortion repeats in each period: {-size[i, j]:.0f} dB below the response at {dofs[i]} (largest), "
            f"{10 * np.log10(ratio[i, j]):.0f} dB above the noise (median over lines)",
            "warning" if matters else "info",
            file=run.name,
            dof=str(dofs[i]),
            band_hz=(float(found.frequencies_hz[0]), float(found.frequencies_hz[-1])),
            consequence="it is part of the variance of the FRFs, which hold for this level of the force",
            action="measure at a second level, and at several phases of the multisine, to know how the structure depends on the level",
        )
    ]


def on_common_lines(estimates: Sequence[RunEstimate]) -> list[RunEstimate]:
    """Estimates on the lines of all references: those of one reference joined, NaN where a run does not excite; references intersected."""
    axes: list[Array] = []
    groups = by_references(estimates)
    spacing = min(float(np.min(np.diff(e.frequencies_hz))) for e in estimates)
    key = lambda hz: np.rint(np.asarray(hz) / (1e-3 * spacing)).astype(np.int64)  # noqa: E731
    names = {int(k): float(v) for e in estimates for k, v in zip(key(e.frequencies_hz), e.frequencies_hz, strict=True)}
    for group in groups:
        axes.append(np.unique(np.concatenate([key(e.frequencies_hz) for e in group])))
    common = axes[0]
    for axis in axes[1:]:
        common = np.intersect1d(common, axis)
    if common.size < max(LEAST_LINES, 0.5 * min(a.size for a in axes)):
        raise DataError(
            f"the periodic runs share {common.size} excited lines of {min(a.size for a in axes)}",
            hint="use one period and one grid of lines for all references, or estimate them apart",
        )
    return [_on_lines(e, key(e.frequencies_hz), common, np.array([names[int(k)] for k in common])) for e in estimates]


def _on_lines(run: RunEstimate, have: NDArray[np.int64], wanted: NDArray[np.int64], hz: Array) -> RunEstimate:
    place = np.searchsorted(have, wanted).clip(0, have.size - 1)
    return replace(_blank(at_lines(run, place), have[place] == wanted), frequencies_hz=hz)


def _blank(run: RunEstimate, there: NDArray[np.bool_]) -> RunEstimate:
    """The estimate without values and information on the other lines."""
    data, variance, coherence = (np.where(there, values, np.nan) for values in (run.data, run.variance, run.coherence))
    return replace(run, data=data, variance=variance, coherence=coherence, gain=np.where(there, run.gain, 0.0))


def excited_span(run: RunEstimate) -> tuple[float, float]:
    """Band [Hz] in which all forces of a run have power, from its information line by line; gaps inside are not looked for."""
    n = run.frequencies_hz.size
    width = int(min(max(8, round(0.01 * n)), max(n // 4, 1)))
    edges = np.arange(0, n, width)
    seen = np.max(np.where(np.isfinite(run.coherence), run.coherence, 0.0), axis=(0, 1))
    coherence = _medians(seen, width)
    low, high = 0, edges.size - 1
    for gain in run.gain:
        power = _medians(np.nan_to_num(gain), width)
        order = np.sort(power)[::-1]
        typical = float(order[int(np.searchsorted(np.cumsum(order), 0.5 * order.sum()))]) if order.sum() > 0 else 0.0
        there = np.flatnonzero((power > ABSENT * typical) & ((power > FAINT * typical) | (coherence > UNSEEN)))
        if there.size:
            low, high = max(low, int(there[0])), min(high, int(there[-1]))
    stop = edges[high + 1] - 1 if high + 1 < edges.size else n - 1
    return float(run.frequencies_hz[edges[low]]), float(run.frequencies_hz[stop])


def _medians(values: Array, width: int) -> Array:
    """Medians of so many values at a time; the last of what is left."""
    whole = values.size - values.size % width
    medians = np.median(values[:whole].reshape(-1, width), axis=1)
    return medians if whole == values.size else np.append(medians, np.median(values[whole:]))


def within_excited(estimates: Sequence[RunEstimate]) -> tuple[list[RunEstimate], list[Finding]]:
    """The estimates without the lines at either end that no run of some reference excites; a finding where lines are left out."""
    axis = estimates[0].frequencies_hz
    for run in estimates:
        if run.frequencies_hz.shape != axis.shape or not np.allclose(run.frequencies_hz, axis):
            found = " and ".join(f"{f.size} lines from {f[0]:g} to {f[-1]:g} Hz" for f in (axis, run.frequencies_hz))
            hint = "runs of different sampling rates: give a band within half of the lowest, and blocks of whole samples of each"
            raise DataError(f"the runs lie on different lines: {found}", hint=hint)
    spans = [excited_span(e) for e in estimates]
    inside = [(axis >= low) & (axis <= high) for low, high in spans]
    keep = np.ones(axis.size, bool)
    for run in estimates:
        keep &= np.any([lines for e, lines in zip(estimates, inside, strict=True) if same_references(e, run)], axis=0)
    if not keep.all() and np.count_nonzero(keep) < LEAST_LINES:
        return list(estimates), []
    out = [_blank(run, lines) if (keep & ~lines).any() else run for run, lines in zip(estimates, inside, strict=True)]
    if keep.all():
        return out, []
    low, high = float(axis[keep][0]), float(axis[keep][-1])
    narrow = min(range(len(spans)), key=lambda i: spans[i][1] - spans[i][0])
    finding = Finding(
        "excited_band",
        f"the force at {', '.join(map(str, estimates[narrow].references))} has power from {low:.4g} to {high:.4g} Hz; "
        f"{axis.size - np.count_nonzero(keep)} of {axis.size} lines to {axis[-1]:.4g} Hz are not excited",
        "info",
        file=estimates[narrow].name or None,
        dof=", ".join(map(str, estimates[narrow].references)),
        band_hz=(low, high),
        consequence="they are left out of FRFs, checks and fit",
    )
    return [at_lines(e, keep) for e in out], [finding]


def at_lines(run: RunEstimate, keep: NDArray[np.bool_] | NDArray[np.intp]) -> RunEstimate:
    """The estimate on some of its lines (mask or positions); a view where a mask names lines that follow one another."""
    lines: slice | NDArray[Any] = keep
    if keep.dtype == bool and (kept := np.flatnonzero(keep)).size and kept[-1] - kept[0] + 1 == kept.size:
        lines = slice(kept[0], kept[-1] + 1)
    parts = {name: getattr(run, name)[..., lines] for name in ("frequencies_hz", "data", "variance", "coherence", "gain")}
    return replace(run, **parts)
