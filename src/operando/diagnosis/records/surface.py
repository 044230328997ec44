"""The restoring-force surface: force seen in the data over the motion across a place, how well a law runs through it, its equivalents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from operando.diagnosis.records.motion import Motion
from operando.dof import Dof
from operando.structure.force_law import ForceLaw
from operando.structure.linearization import LinearEquivalent, slopes
from operando.structure.modal_space import Complex, Real

BINS, LEAST = 41, 8
"""Even bins of a motion, and samples of one that counts."""

CLOUD = 400
"""Samples of the picture."""

SIDE = 20
"""Steps from the middle to the smaller of both reaches at which even and odd parts are compared."""


def in_band(motion: Motion, force: Complex) -> Real:
    """A force (L,) in time (N,), on the lines of the band where the data decide."""
    run = motion.along.run
    spectrum = np.zeros(run.n_samples // 2 + 1, complex)
    spectrum[run.lines] = force * (motion.taken > 0.5)
    return motion.crossing.in_time(spectrum)


def binned(x: Real, s: Real) -> tuple[Real, Real, Real, Real]:
    """Mean and standard error of s in even bins of x: centre, mean, error, count; bins of few samples are left out."""
    edges = np.linspace(x.min(), x.max(), BINS + 1)
    which = np.clip(np.digitize(x, edges) - 1, 0, BINS - 1)
    count = np.bincount(which, minlength=BINS).astype(float)
    total = np.bincount(which, s, BINS)
    square = np.bincount(which, s**2, BINS)
    use = count >= LEAST
    mean = total[use] / count[use]
    spread = np.sqrt(np.maximum(square[use] / count[use] - mean**2, 0) / count[use])
    return (edges[1:] + edges[:-1])[use] / 2, mean, spread, count[use]


def inner(motion: Motion) -> slice:
    """The samples of a motion without its ends."""
    edge = max(8, motion.x.size // 50)
    return slice(edge, -edge)


def surface(motions: Sequence[Motion], law: ForceLaw) -> dict[str, Any]:
    """Picture of the restoring force at a place, of the run with the largest motion.

    ``displacement``, ``velocity``, ``force`` (a cloud of samples), ``binned`` {displacement, force, force_std, law} and ``binned_velocity``
    {velocity, …}: force and law brought to the lines that the data decide, so that they can be compared; ``law_samples``: the law as it
    stands at the samples of the cloud; ``goodness`` and ``parity``: see the functions of these names.
    """
    motion = max(motions, key=lambda m: float(np.max(np.abs(m.x))))
    part = inner(motion)
    whole = law.force(motion.x, motion.v, motion.step)
    x, v, s, law_there = motion.x[part], motion.v[part], in_band(motion, motion.force)[part], in_band(motion, motion.spectra(whole))[part]
    pick = np.linspace(0, x.size - 1, min(CLOUD, x.size)).astype(int)

    def averages(name: str, over: Real) -> dict[str, list[float]]:
        centre, mean, spread, _ = binned(over, s)
        columns = {name: centre, "force": mean, "force_std": spread, "law": binned(over, law_there)[1]}
        return {key: column.tolist() for key, column in columns.items()}

    return {
        "displacement": x[pick].tolist(),
        "velocity": v[pick].tolist(),
        "force": s[pick].tolist(),
        "binned": averages("displacement", x),
        "binned_velocity": averages("velocity", v),
        "parity": parity(x - np.mean(x), s),
        "law_samples": whole[part][pick].tolist(),
        "goodness": goodness(motions, law),
    }


def parity(x: Real, s: Real) -> dict[str, float]:
    """Shares of the mean square of a force over displacement: ``linear``, ``odd`` beyond it, and ``even``, over where both sides go.

    A cubic spring, play and saturation are odd; contacts on one side, bilinear and quadratic springs have an even part, which no change of
    level need show. ``x`` and ``s`` (N,) are the displacement from its mean and the force.
    """
    reach = min(float(np.quantile(x, 0.999)), -float(np.quantile(x, 0.001)))
    if not reach > 0:
        return {"linear": 0.0, "odd": 0.0, "even": 0.0}
    at = (np.arange(SIDE) + 0.5) / SIDE * reach
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


def goodness(motions: Sequence[Motion], law: ForceLaw) -> float:
    """Share of the restoring force seen in the data that a law explains, on the lines where the data decide; 1 is all of it."""
    rest, total = 0.0, 0.0
    for m in motions:
        good = m.taken > 0.5
        if m.along.run.lines.size != m.force.size:
            continue
        rest += float(np.sum(np.abs(m.force - m.beside(law))[good] ** 2))
        total += float(np.sum(np.abs(m.force)[good] ** 2))
    return 1 - rest / total if total > 0 else 0.0


def equivalents(law: ForceLaw, motions: Sequence[Motion], dofs: Sequence[Dof]) -> tuple[LinearEquivalent, ...]:
    """Spring and damper that an accepted law is equivalent to in each run, lowest level first."""
    rows = []
    for m in motions:
        part = inner(m)
        x, v, s = m.x[part], m.v[part], law.force(m.x, m.v, m.step)[part]
        k, c = slopes(s, x, v)
        rest = (s - s.mean()) - k * (x - x.mean()) - c * (v - v.mean())
        explains = float(1 - np.mean(rest**2) / max(np.var(s), 1e-300))
        run = m.along.run
        at = tuple(str(dofs[i]) for i in run.forces_at)
        rows.append(LinearEquivalent(float(run.force_level), float(x.std()), float(v.std()), k, c, explains, at))
    return tuple(sorted(rows, key=lambda r: r.level))
