"""Detection before naming: does the response scale with the force, and are there even or odd distortions?"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.data import one_level
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.place import Weighted
from operando.diagnosis.records.run import Run
from operando.structure.modal_space import Complex, Modes, Real

STRETCH = 40
"""Neighbouring lines over which what is proportional to the force, and what rings, is smooth."""

SURELY = 4.0
"""Standard deviations of the scatter of noise: one in 300 measurements of a hundred stretches."""

BLOCK_SECONDS = 4.0
"""Length of the Hann blocks for coherence and levels."""


@dataclass(frozen=True)
class Detection:
    """What the records say before anything is named.

    Parameters
    ----------
    levels_n : tuple of float
        Force levels [N rms], lowest first.
    coherence : tuple of float
        At each level, the mean over responses and lines.
    inhomogeneity : float or None
        Mean square difference between the best linear approximations of two levels over its variance (1: one linear system).
    distortion : float or None
        As of :func:`distortion`.
    level_dependent : bool or None
        Whether the levels differ; a bilinear stiffness scales with the level and does not show here.
    location : tuple of str
        The DOFs at which any force law explains most.
    """

    levels_n: tuple[float, ...] = ()
    coherence: tuple[float, ...] = ()
    inhomogeneity: float | None = None
    distortion: float | None = None
    level_dependent: bool | None = None
    location: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """``detection`` of ``diagnosis.json``."""
        return asdict(self)


def best_linear(run: Run) -> tuple[Complex, Real, Real]:
    """Best linear approximation of each response to the first force, its variance, and the coherence: (q, L) each.

    From Hann spectra of half-overlapping blocks.
    """
    n = run.n_samples
    size = int(min(BLOCK_SECONDS * run.sampling_hz, n // 4))
    hz = sfft.rfftfreq(size, 1 / run.sampling_hz)
    keep = (hz >= run.hz[0]) & (hz <= run.hz[-1])
    window = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    signals = sfft.irfft(np.concatenate([run.forces[:1], run.responses]), n, axis=1)
    starts = np.arange(0, n - size + 1, size // 2)
    spectra = np.stack([sfft.rfft(signals[:, s : s + size] * window, axis=1)[:, keep] for s in starts])
    f, x = spectra[:, :1], spectra[:, 1:]
    sff = np.mean(np.abs(f) ** 2, axis=0)
    h = np.mean(x * f.conj(), axis=0) / sff
    rest = np.mean(np.abs(x - h * f) ** 2, axis=0)
    # Half-overlapping Hann blocks count for about 0.95 of their number.
    count = max(0.95 * len(x) - 1, 1)
    return h, rest / sff / count, 1 - rest / np.maximum(np.mean(np.abs(x) ** 2, axis=0), 1e-300)


def detect(case: RecordsCase) -> Detection:
    """What the records say before anything is named, without the location."""
    worst, coherences = float("nan"), []
    for runs in case.by_reference():
        estimates = [best_linear(run) for run in runs]
        coherences += [(run.force_level, float(np.mean(e[2]))) for run, e in zip(runs, estimates, strict=True)]
        two = estimates[-1]
        for one in estimates[:-1]:
            if one[0].shape == two[0].shape:
                worst = float(np.nanmax([worst, np.mean(np.abs(one[0] - two[0]) ** 2 / (one[1] + two[1]))]))
    coherences.sort()
    finite = bool(np.isfinite(worst))
    return Detection(
        tuple(float(level) for level, _ in coherences),
        tuple(c for _, c in coherences),
        worst if finite else None,
        distortion(case),
        worst > 2.0 if finite else None,
    )


def distortion(case: RecordsCase) -> float | None:
    """How much more, surely, is not proportional to the force at the highest level than at the lowest, over the power of the force.

    Both levels of one linear structure leave the same share, or less at the higher one, where noise does not grow with the level. A law of
    even order leaves the best linear approximation as it is, and shows here.

    In the mean over responses, ``SURELY`` standard deviations less than seen, the largest over stretches of lines (one linear system: no
    more than 1); None where there is one level.
    """
    largest = []
    for runs in case.by_reference():
        low, high = runs[0], runs[-1]
        if one_level(low.force_level, high.force_level) or low.rows.size != high.rows.size:
            continue
        (low_hz, quiet, quiet_variance), (high_hz, loud, loud_variance) = (unproportional(run, case.modes) for run in (low, high))
        if not low_hz.size or not high_hz.size:
            continue
        near = np.abs(low_hz[:, None] - high_hz).argmin(axis=0)
        ratio = loud / np.maximum(quiet[near], 1e-300) * (low.force_level / high.force_level) ** 2
        surely = np.exp(-SURELY * np.sqrt(loud_variance + quiet_variance[near]))
        largest.append(float(np.max(np.mean(ratio, axis=1) * surely)))
    return max(largest, default=None)


def unproportional(run: Run, modes: Modes) -> tuple[Real, Real, Real]:
    """Power of the error that is neither free decays, nor the forces or a constant times a parabola, over stretches: hz (s,), (s, q).

    Over the power that the idle model and the mean of the lines would lead one to expect: noise of the force stands at resonances, and few
    lines of a sharp one would outweigh all others. And the variance (s,) of the logarithm of its mean: power of noise scatters by itself
    from line to line, and the fewer lines hold it, the more.
    """
    starts = np.arange(0, run.lines.size - STRETCH + 1, STRETCH)
    # No stretch over lines that were left out.
    starts = starts[run.lines[starts + STRETCH - 1] - run.lines[starts] == STRETCH - 1] if starts.size else starts
    index = starts[:, None] + np.arange(STRETCH)
    parabola = np.linspace(-1, 1, STRETCH)[:, None] ** np.arange(3)
    forces = run.forces[: len(run.forces_at), run.lines][:, index]
    columns = [f[:, :, None] * parabola for f in forces]
    table = np.concatenate([*columns, np.broadcast_to(parabola, (starts.size, STRETCH, 3))], axis=2)
    if table.shape[2] > STRETCH // 2:
        return np.zeros(0), np.zeros((0, run.rows.size)), np.zeros(0)
    q, _ = np.linalg.qr(table)
    density = np.mean(np.abs(run.forces[: len(run.forces_at), run.lines]) ** 2, axis=1)
    model = sum(p * np.abs(run.accelerance(drive)) ** 2 for p, drive in zip(density, run.drives, strict=False))
    size = np.sqrt(model + np.mean(model, axis=1, keepdims=True)) / np.sqrt(np.sum(density))
    # Without the free decays, which stand as sharp as the resonances.
    error = ((run.error - run.fallen(Weighted.of(run).ringing()[0])) / size)[:, index].transpose(1, 2, 0)
    rest = error - q @ (q.conj().transpose(0, 2, 1) @ error)
    power = np.abs(rest) ** 2
    of_lines = np.sum(power, axis=2)
    variance = np.sum(of_lines**2, axis=1) / np.maximum(np.sum(of_lines, axis=1) ** 2, 1e-300) / 2
    return run.hz[index].mean(axis=1), np.asarray(np.sum(power, axis=1) / (STRETCH - table.shape[2])), np.asarray(variance)
