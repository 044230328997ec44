"""Detection before naming: does the response scale with the force, and are there even or odd distortions?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import fft as sfft

from operando.nonlinear.run import Complex, Real, Run

if TYPE_CHECKING:
    from operando.nonlinear.search import Case

BLOCK_SECONDS = 4.0
"""Length of the Hann blocks for coherence and levels."""


def blocks(run: Run, seconds: float = BLOCK_SECONDS) -> tuple[Real, Complex, Complex]:
    """Hann spectra of half-overlapping blocks: hz, responses (blocks, q, L), the first force (blocks, L)."""
    n = run.n_samples
    size = int(min(seconds * run.sampling_hz, n // 4))
    x = sfft.irfft(run.responses, n, axis=1)
    f = sfft.irfft(run.forces[:1], n, axis=1)
    starts = np.arange(0, n - size + 1, size // 2)
    window = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    cut = lambda a: np.stack([sfft.rfft(a[:, s : s + size] * window, axis=1) for s in starts])  # noqa: E731
    hz = sfft.rfftfreq(size, 1 / run.sampling_hz)
    keep = (hz >= run.hz[0]) & (hz <= run.hz[-1])
    return hz[keep], cut(x)[:, :, keep], cut(f)[:, 0, keep]


def best_linear(x: Complex, f: Complex) -> tuple[Complex, Real, Real]:
    """Best linear approximation of each response, its variance, and the coherence: (q, L) each."""
    sff = np.mean(np.abs(f) ** 2, axis=0)
    h = np.mean(x * f[:, None].conj(), axis=0) / sff
    rest = np.mean(np.abs(x - h * f[:, None]) ** 2, axis=0)
    sxx = np.maximum(np.mean(np.abs(x) ** 2, axis=0), 1e-300)
    # Half-overlapping Hann blocks count for about 0.95 of their number.
    n = 0.95 * x.shape[0]
    return h, rest / sff / max(n - 1, 1), 1 - rest / sxx


def detect(case: Case) -> dict[str, Any]:
    """What the records say before anything is named.

    Returns
    -------
    dict
        ``levels_n`` force levels [N rms]; ``inhomogeneity``: mean square difference between the best linear approximations of two levels
        over its variance (1: one linear system); ``coherence`` (mean over responses and lines, lowest and highest level);
        ``level_dependent``: whether the levels differ; a bilinear stiffness scales with the level and does not show here.
    """
    groups: dict[tuple[int, ...], list[Run]] = {}
    for run in (*case.fitted, *case.judged):
        groups.setdefault(run.forces_at, []).append(run)
    worst, coherences = float("nan"), []
    for runs in groups.values():
        runs = sorted(runs, key=lambda r: r.force_level)
        estimates = []
        for run in runs:
            _, x, f = blocks(run)
            estimates.append(best_linear(x, f))
            coherences.append((run.force_level, float(np.mean(estimates[-1][2]))))
        for one in estimates[:-1]:
            two = estimates[-1]
            if one[0].shape == two[0].shape:
                worst = float(np.nanmax([worst, np.mean(np.abs(one[0] - two[0]) ** 2 / (one[1] + two[1]))]))
    coherences.sort()
    return {
        "levels_n": [float(level) for level, _ in coherences],
        "coherence": [c for _, c in coherences],
        "inhomogeneity": worst if np.isfinite(worst) else None,
        "level_dependent": bool(worst > 2.0) if np.isfinite(worst) else None,
    }
