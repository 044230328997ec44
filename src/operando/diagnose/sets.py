"""Lines of the check FRFs and the three sets they are split into before anything is fitted: fit, select, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from operando.data import Frf, ModalModel
from operando.dof import Dof
from operando.errors import DataError, MissingError
from operando.results import CheckRun

FIT, SELECT, JUDGE = 0, 1, 2
BLOCKS = 18
"""Contiguous blocks of lines the band is cut into."""

MAX_LINES = 560
"""Lines kept of one run: enough for some on every peak, few enough for a scan of all pairs of places."""

SHARED, MOST_SHARED = 8.0, 16.0
"""Lines worth one independent line where no two runs tell (a local rational estimate of 17-line windows, every other line), and at most."""

LEVEL_LIMIT = 2.0
"""Runs whose difference exceeds this many times the variance expected from noise are not one linear system."""


@dataclass(frozen=True)
class CheckLines:
    """Check FRFs as receptance lines in the idle model's senses; lines of several runs stand one after the other.

    Parameters
    ----------
    hz : (n,) array
        Frequency of each line [Hz]; a frequency may stand once a run.
    data : (n, n_responses, n_references) complex array
        Receptance [m/N]; 0 where a pair was not measured in that run.
    variance : array of the same shape
        E|ΔH|² of the measurement; infinite where not measured.
    responses, references : (n_responses,), (n_references,) int arrays
        Rows of the idle model.
    group, block, run : (n,) int arrays
        Set (``FIT``, ``SELECT``, ``JUDGE``), block and run of each line.
    runs : tuple of str
        Names of the runs.
    stride : int
        One in ``stride`` measured lines was kept.
    notes : tuple of str
        What was left out, and why; which set is what.
    disagreement : float
        Squared difference of the runs over the variance expected (1 if they are one linear system); NaN with one run.
    shared : float
        Lines kept that are worth one independent line, because estimates at neighbouring lines share data.
    """

    hz: NDArray[np.float64]
    data: NDArray[np.complex128]
    variance: NDArray[np.float64]
    responses: NDArray[np.int_]
    references: NDArray[np.int_]
    group: NDArray[np.int_]
    block: NDArray[np.int_]
    run: NDArray[np.int_]
    runs: tuple[str, ...]
    stride: int
    notes: tuple[str, ...] = ()
    disagreement: float = float("nan")
    shared: float = SHARED

    @property
    def omega(self) -> NDArray[np.float64]:
        """Angular frequency of each line [rad/s]."""
        return 2 * np.pi * self.hz

    def where(self, mask: NDArray[np.bool_]) -> CheckLines:
        """Some of the lines."""
        return CheckLines(
            self.hz[mask],
            self.data[mask],
            self.variance[mask],
            self.responses,
            self.references,
            self.group[mask],
            self.block[mask],
            self.run[mask],
            self.runs,
            self.stride,
            self.notes,
            self.disagreement,
            self.shared,
        )


def blocks_of(count: int, blocks: int = BLOCKS) -> NDArray[np.int_]:
    """Block number of each of ``count`` neighbouring lines: contiguous, as equal as can be."""
    return np.minimum(np.arange(count) * blocks // max(count, 1), blocks - 1)


def group_of_block(block: NDArray[np.int_], judged_elsewhere: bool) -> NDArray[np.int_]:
    """Set of each block: fit and select in turn, and each third block judges where no other run does."""
    if judged_elsewhere:
        return np.asarray(np.where(block % 2 == 0, FIT, SELECT))
    return np.asarray(np.array([FIT, SELECT, JUDGE])[block % 3])


def split_lines(
    check: Sequence[CheckRun], idle: ModalModel, band: tuple[float, float] | None = None, max_lines: int = MAX_LINES
) -> CheckLines:
    """Check runs as lines with their sets, decided from labels and frequencies alone.

    The first run (the lowest level) judges where another run measured the same pairs; the others are fitted and selected on.
    With one run, each third of 18 contiguous blocks of lines judges.

    Parameters
    ----------
    check : sequence of CheckRun
        Lowest level first.
    idle : ModalModel
        Its DOFs and senses are used; what it does not have is left out with a note.
    band : (float, float), optional
        Lines used [Hz]; default the band of the idle modes proper.
    max_lines : int
        Lines kept a run.

    Raises
    ------
    MissingError
        If there is no check run.
    DataError
        If no DOF or line is shared with the idle model.
    """
    if not check:
        raise MissingError("no check run to diagnose from", hint="measure the running state with a known force")
    notes: list[str] = []
    frfs = [_aligned(run, idle, notes) for run in check]
    names = [run.name for run in check]
    frfs, names = _join_references(frfs, names)
    if band is None:
        proper = idle.frequencies_hz[np.asarray(idle.in_band)]
        band = (0.6 * float(proper.min()), 1.08 * float(proper.max())) if proper.size else (0.0, np.inf)
    frfs = [frf.band(max(band[0], 1e-6), band[1]) for frf in frfs]
    if any(len(frf.axis) < BLOCKS for frf in frfs):
        raise DataError(f"fewer than {BLOCKS} check lines lie in {band[0]:g} … {band[1]:g} Hz")
    shared = len(frfs) > 1 and any(
        {(d.node, d.axis) for d in frfs[0].references} & {(d.node, d.axis) for d in frf.references} for frf in frfs[1:]
    )
    responses = tuple(dict.fromkeys(d for frf in frfs for d in frf.responses))
    references = tuple(dict.fromkeys(d for frf in frfs for d in frf.references))
    parts: list[CheckLines] = []
    for number, frf in enumerate(frfs):
        count = len(frf.axis)
        stride = max(1, round(count / max_lines))
        index = np.arange(stride // 2, count, stride)
        block = blocks_of(count)[index]
        if shared and number == 0:
            group = np.full(index.size, JUDGE)
        else:
            group = group_of_block(block, shared)
        data = np.zeros((index.size, len(responses), len(references)), complex)
        variance = np.full(data.shape, np.inf)
        rows, columns = [responses.index(d) for d in frf.responses], [references.index(d) for d in frf.references]
        values, spread = _filled(frf, index)
        data[np.ix_(range(index.size), rows, columns)] = values
        variance[np.ix_(range(index.size), rows, columns)] = spread
        parts.append(
            CheckLines(
                frf.frequencies_hz[index],
                data,
                variance,
                np.array([idle.dofs.index(d) for d in responses]),
                np.array([idle.dofs.index(d) for d in references]),
                group,
                block,
                np.full(index.size, number),
                tuple(names),
                stride,
            )
        )
    if shared:
        notes.append(f"judged on {names[0]}, which nothing is fitted to; blocks of the other lines are fitted and selected on in turn")
    else:
        notes.append(f"{BLOCKS} contiguous blocks of lines: fit, select and judge in turn")
    stride = max(p.stride for p in parts)
    return _stack(parts, tuple(notes), *_disagreement(frfs, stride))


def _aligned(run: CheckRun, idle: ModalModel, notes: list[str]) -> Frf:
    sense = {(d.node, d.axis): d for d in idle.dofs}

    def known(dofs: tuple[Dof, ...], what: str) -> tuple[Dof, ...]:
        lost = [str(d) for d in dofs if (d.node, d.axis) not in sense]
        if lost:
            notes.append(f"{what} not in the idle model, left out: {', '.join(lost)}")
        return tuple(sense[(d.node, d.axis)] for d in dofs if (d.node, d.axis) in sense)

    responses, references = known(run.frf.responses, "response"), known(run.frf.references, "reference")
    if not responses or not references:
        raise DataError("check run and idle model have no response–reference pair in common", where=run.name)
    return run.frf.select(responses, references)


def _join_references(frfs: list[Frf], names: list[str]) -> tuple[list[Frf], list[str]]:
    """Runs of different references on the same lines and responses are one measurement of several columns."""
    out: list[Frf] = []
    told: list[str] = []
    for frf, name in zip(frfs, names, strict=True):
        for i, other in enumerate(out):
            same = other.responses == frf.responses and np.array_equal(other.frequencies_hz, frf.frequencies_hz)
            apart = not {(d.node, d.axis) for d in other.references} & {(d.node, d.axis) for d in frf.references}
            if same and apart and other.quantity == frf.quantity and (other.variance is None) == (frf.variance is None):
                variance = None
                if frf.variance is not None and other.variance is not None:
                    variance = np.concatenate([other.variance, frf.variance], axis=1)
                out[i] = Frf(
                    np.concatenate([other.data, frf.data], axis=1),
                    other.axis,
                    other.responses,
                    (*other.references, *frf.references),
                    frf.quantity,
                    variance=variance,
                    si=frf.si and other.si,
                )
                told[i] = f"{told[i]}, {name}"
                break
        else:
            out.append(frf)
            told.append(name)
    return out, told


def _filled(frf: Frf, index: NDArray[np.int_]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Receptance and variance (lines, responses, references); without a variance 1 % of the pair's size, infinite where not finite."""
    receptance = frf.to_quantity("receptance")
    data = np.moveaxis(receptance.data[:, :, index], 2, 0)
    if receptance.variance is None:
        power = np.nanmean(np.abs(frf.data) ** 2, axis=2) * 1e-4
        scale = np.abs(receptance.data) / np.maximum(np.abs(frf.data), 1e-300)
        variance = np.moveaxis((power[:, :, None] * scale**2)[:, :, index], 2, 0)
    else:
        variance = np.moveaxis(receptance.variance[:, :, index], 2, 0)
    good = np.isfinite(data) & np.isfinite(variance)
    floor = 1e-8 * np.abs(np.where(good, data, 0)) ** 2
    return np.where(good, data, 0), np.where(good, np.maximum(np.where(good, variance, 0), floor), np.inf)


def _disagreement(frfs: list[Frf], stride: int) -> tuple[float, float]:
    """Squared difference between the first run and each other over the sum of their variances, and how long it stays alike.

    Returns
    -------
    disagreement : float
        The largest mean; NaN without a pair.
    shared : float
        1 + 2 Σ ρ_k over lines ``stride`` apart: lines worth one independent line.
    """
    worst, shared = float("nan"), []
    for other in frfs[1:]:
        refs = tuple(d for d in frfs[0].references if d in other.references)
        responses = tuple(d for d in frfs[0].responses if d in other.responses)
        same = np.array_equal(other.frequencies_hz, frfs[0].frequencies_hz)
        if not refs or not responses or not same:
            continue
        one, two = frfs[0].select(responses, refs), other.select(responses, refs).to_quantity(frfs[0].quantity)
        if one.variance is None or two.variance is None:
            continue
        total = one.variance + two.variance
        good = np.isfinite(total) & (total > 0) & np.isfinite(one.data) & np.isfinite(two.data)
        if np.any(good):
            unit = np.where(good, (one.data - two.data) / np.sqrt(np.where(good, total, 1)), 0)
            worst = float(np.nanmax([worst, np.sum(np.abs(unit) ** 2) / np.sum(good)]))
            shared.append(lines_alike(unit[:, :, stride // 2 :: stride]))
    return worst, float(np.mean(shared)) if shared else SHARED


def lines_alike(unit: NDArray[np.complex128]) -> float:
    """1 + 2 Σ ρ_k of noise along the last axis, the sum ending where ρ falls below 0.05; at most ``MOST_SHARED``.

    Parameters
    ----------
    unit : (..., n_lines) array
        Noise over its standard deviation.
    """
    power = float(np.mean(np.abs(unit) ** 2))
    total = 1.0
    for k in range(1, min(unit.shape[-1] - 1, 24)):
        rho = float(np.mean(np.real(np.conj(unit[..., :-k]) * unit[..., k:]))) / max(power, 1e-300)
        if rho < 0.05:
            break
        total += 2 * rho
    return min(total, MOST_SHARED)


def _stack(parts: list[CheckLines], notes: tuple[str, ...], disagreement: float, shared: float) -> CheckLines:
    first = parts[0]

    def join(name: str) -> NDArray:
        return np.concatenate([getattr(p, name) for p in parts])

    return CheckLines(
        join("hz"),
        join("data"),
        join("variance"),
        first.responses,
        first.references,
        join("group"),
        join("block"),
        join("run"),
        first.runs,
        max(p.stride for p in parts),
        notes,
        disagreement,
        shared,
    )
