"""The restoring-force surface: force seen in the data over the motion across a place, and how well a law runs through it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.nonlinear.laws import LawFit, Motion
from operando.nonlinear.run import Complex, Real

BINS = 41


def seen_force(motion: Motion) -> Real:
    """Restoring force in time as the data show it, (N,): the lines of the band where the data decide."""
    run = motion.along.run
    spectrum = np.zeros(run.n_samples // 2 + 1, complex)
    spectrum[run.lines] = motion.force * (motion.taken > 0.5)
    return finely(motion, spectrum)


def finely(motion: Motion, spectrum: Complex) -> Real:
    """A spectrum on the record's lines in time, on the fine grid of the motion."""
    n, fine = motion.x.size, motion.crossing.fine
    full = np.zeros(n // 2 + 1, complex)
    full[: spectrum.size] = spectrum * fine
    return np.asarray(sfft.irfft(full, n))


def same_lines(motion: Motion, force: Real) -> Real:
    """A force in time with only the lines that :func:`seen_force` keeps."""
    run = motion.along.run
    kept = np.zeros(run.n_samples // 2 + 1, complex)
    kept[run.lines] = motion.spectra(force) * (motion.taken > 0.5)
    return finely(motion, kept)


def binned(x: Real, s: Real, bins: int = BINS) -> tuple[Real, Real, Real, Real]:
    """Mean and standard error of s in even bins of x: centre, mean, error, count; bins of fewer than 8 samples are left out."""
    edges = np.linspace(x.min(), x.max(), bins + 1)
    which = np.clip(np.digitize(x, edges) - 1, 0, bins - 1)
    count = np.bincount(which, minlength=bins).astype(float)
    total = np.bincount(which, s, bins)
    square = np.bincount(which, s**2, bins)
    use = count >= 8
    mean = total[use] / count[use]
    spread = np.sqrt(np.maximum(square[use] / count[use] - mean**2, 0) / count[use])
    return (edges[1:] + edges[:-1])[use] / 2, mean, spread, count[use]


def surface(motions: Sequence[Motion], law: LawFit | None, points: int = 400) -> dict[str, Any]:
    """Picture of the restoring force at a place.

    Parameters
    ----------
    motions : sequence of Motion
        Runs, the one with the largest motion is drawn.
    law : LawFit or None
    points : int
        Samples of the cloud.

    Returns
    -------
    dict
        ``displacement``, ``velocity``, ``force`` (a cloud of samples), ``binned`` {displacement, force, force_std, law} and
        ``binned_velocity`` {velocity, …}: force and law brought to the lines that the data decide, so that they can be compared;
        ``law_samples``: the law as it stands at the samples of the cloud; ``goodness`` and ``parity``: see the functions of these names.
    """
    motion = max(motions, key=lambda m: float(np.max(np.abs(m.x))))
    edge = max(8, motion.x.size // 50)
    inner = slice(edge, -edge)
    s = seen_force(motion)
    x, v = motion.x[inner], motion.v[inner]
    pick = np.linspace(0, x.size - 1, min(points, x.size)).astype(int)
    same = None if law is None else same_lines(motion, law.force(motion.x, motion.v, motion.step))[inner]
    out: dict[str, Any] = {
        "displacement": x[pick].tolist(),
        "velocity": v[pick].tolist(),
        "force": s[inner][pick].tolist(),
        "binned": averages("displacement", x, s[inner], same),
        "binned_velocity": averages("velocity", v, s[inner], same),
        "parity": parity(x - np.mean(x), s[inner]),
    }
    out["goodness"] = None
    if law is not None:
        whole = law.force(motion.x, motion.v, motion.step)
        out["law_samples"] = whole[inner][pick].tolist()
        out["goodness"] = goodness(motions, law)
    return out


def parity(x: Real, s: Real, points: int = 20) -> dict[str, float]:
    """Shares of the mean square of a force over displacement: ``linear``, ``odd`` beyond it, and ``even``, over where both sides go.

    A cubic spring, play and saturation are odd; contacts on one side, bilinear and quadratic springs have an even part, which no change of
    level need show.

    Parameters
    ----------
    x, s : (N,) arrays
        Displacement from its mean, force.
    points : int
        Steps from the middle to the smaller of both reaches.
    """
    reach = min(float(np.quantile(x, 0.999)), -float(np.quantile(x, 0.001)))
    if not reach > 0:
        return {"linear": 0.0, "odd": 0.0, "even": 0.0}
    at = (np.arange(points) + 0.5) / points * reach
    centre, mean, _, count = binned(x, s)
    up, down = np.interp(at, centre, mean), np.interp(-at, centre, mean)
    weight = np.interp(at, centre, count) + np.interp(-at, centre, count)
    weight = weight / weight.sum()
    odd, even = 0.5 * (up - down), 0.5 * (up + down)
    # The mean of a force is not in an accelerometer.
    even = even - weight @ even
    line = at * float(weight @ (odd * at)) / float(weight @ at**2)
    parts = {"linear": line, "odd": odd - line, "even": even}
    power = {name: float(weight @ part**2) for name, part in parts.items()}
    total = max(sum(power.values()), 1e-300)
    return {name: value / total for name, value in power.items()}


def averages(name: str, over: Real, force: Real, law: Real | None) -> dict[str, list[float]]:
    """Binned force, and the binned law on the same bins."""
    centre, mean, spread, _ = binned(over, force)
    out = {name: centre.tolist(), "force": mean.tolist(), "force_std": spread.tolist()}
    return out if law is None else out | {"law": binned(over, law)[1].tolist()}


def goodness(motions: Sequence[Motion], law: LawFit) -> float:
    """Share of the restoring force seen in the data that a law explains, on the lines where the data decide; 1 is all of it."""
    rest, total = 0.0, 0.0
    for m in motions:
        good = m.taken > 0.5
        if m.along.run.lines.size != m.force.size:
            continue
        expected = m.under(law)
        rest += float(np.sum(np.abs(m.force - expected)[good] ** 2))
        total += float(np.sum(np.abs(m.force)[good] ** 2))
    return 1 - rest / total if total > 0 else 0.0
