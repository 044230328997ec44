"""Do the stated intervals of merged set-ups and of free decays hold? Monte Carlo on a plate-like structure.

    python benchmarks/coverage_setups.py [draws] [setups|decays]

Three set-ups of five sensors (two stay) under white forces of another level each, the plate's frequencies moved by 0.02 % between them as
temperature does; and single free decays with noise. Identified blind; shares no code with the analysis.
"""

from __future__ import annotations

import sys

import numpy as np

from coverage_oma import Plate

STAY = (0, 1)
ROVE = ((2, 3, 4), (5, 6), (7, 8))
BAND = (4.0, 36.0)


def match(model, hz, zeta, truth):
    """Errors and deviations of the modes found, NaN where missed; and the number of modes too many."""
    out = np.full((4, hz.size), np.nan)
    used = set()
    for k, f in enumerate(hz):
        near = [j for j in range(model.n_modes) if j not in used and abs(model.frequencies_hz[j] - f) < 0.02 * f]
        like = [abs(truth[:, k] @ model.shapes[:, j]) ** 2 for j in near]
        if near and max(like) > 0.8:
            j = near[int(np.argmax(like))]
            used.add(j)
            out[:, k] = (
                model.frequencies_hz[j] - f,
                model.damping_ratios[j] - zeta[k],
                model.frequency_std_hz[j],
                model.damping_ratio_std[j],
            )
    return out, model.n_modes - len(used)


def setups(draw, seconds=150.0, fs=128.0, spread=2e-4):
    """Merged modes of three set-ups, and the joint estimate's, against the truth."""
    from operando import Channel, Dof, TimeRecord, fit_oma

    plate = Plate(first_hz=6.0)
    rng = np.random.default_rng([1, draw])
    middle, records = plate.hz.copy(), []
    for k, rove in enumerate(ROVE):
        plate.hz = middle * (1 + spread * rng.standard_normal())
        rows = [*STAY, *rove]
        data = 10.0**k * plate.record(seconds, fs, rng)[rows]
        records.append(TimeRecord(data, fs, tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in rows), name=f"setup{k}"))
    inside = (middle > BAND[0]) & (middle < BAND[1])
    model = fit_oma(records, band=BAND)
    truth = plate.sensors[[d.node - 1 for d in model.dofs]][:, inside]
    found = match(model, middle[inside], plate.zeta[inside], truth / np.linalg.norm(truth, axis=0))
    joint = model.details.joint
    beside = np.full((4, int(inside.sum())), np.nan)
    for k, f in enumerate(middle[inside]):
        near = np.flatnonzero(np.abs(joint.frequencies_hz - f) < 0.01 * f)
        if near.size == 1:
            j = near[0]
            beside[:, k] = (
                joint.frequencies_hz[j] - f,
                joint.damping_ratios[j] - plate.zeta[inside][k],
                joint.frequency_std_hz[j],
                joint.damping_ratio_std[j],
            )
    return found, beside


def decay(draw, seconds=12.0, fs=128.0, noise=0.005):
    """Modes of one free decay against the truth."""
    from operando import Channel, Dof, TimeRecord, fit_oma

    plate = Plate(first_hz=6.0)
    rng = np.random.default_rng([2, draw])
    t = np.arange(int(seconds * fs)) / fs
    after = np.maximum(t - 0.5, 0)
    inside = (plate.hz > BAND[0]) & (plate.hz < BAND[1])
    x = np.zeros((plate.sensors.shape[0], t.size))
    for k in np.flatnonzero(inside):
        w, zeta = 2 * np.pi * plate.hz[k], plate.zeta[k]
        wave = np.where(t >= 0.5, np.exp(-zeta * w * after) * np.sin(w * np.sqrt(1 - zeta**2) * after), 0)
        x += np.outer(plate.sensors[:, k] * rng.choice([-1, 1]) * rng.uniform(0.3, 1), wave)
    x += noise * np.abs(x).max() * rng.standard_normal(x.shape)
    channels = tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in range(x.shape[0]))
    model = fit_oma(TimeRecord(x, fs, channels), band=BAND)
    truth = plate.sensors[:, inside] / np.linalg.norm(plate.sensors[:, inside], axis=0)
    assert model.details.settings["method"] == "free-decay"
    return match(model, plate.hz[inside], plate.zeta[inside], truth)


def summary(name, tables, extra):
    """One line: modes found and too many, coverage of frequency and damping, width over scatter."""
    table = np.array(tables)
    error, std = table[:, :2], table[:, 2:]
    known = np.isfinite(error)
    cover = [float(np.mean(np.abs(error[:, q]) <= 1.959964 * std[:, q], where=known[:, q])) for q in (0, 1)]
    width = [float(np.nanmedian(np.nanmedian(std[:, q], axis=0) / np.nanstd(error[:, q], axis=0))) for q in (0, 1)]
    print(
        f"{name}: found {known[:, 0].sum()} of {known[:, 0].size}, too many {extra}; 95 % intervals cover frequency {cover[0]:.3f}, "
        f"damping {cover[1]:.3f}; deviation over scatter {width[0]:.2f}, {width[1]:.2f}"
    )
    return known[:, 0].mean(), cover


def main(draws=60, which="setups decays"):
    if "setups" in which:
        found = [setups(d) for d in range(draws)]
        summary("merged set-ups", [f[0][0] for f in found], sum(f[0][1] for f in found))
        summary("joint estimate", [f[1] for f in found], 0)
    if "decays" in which:
        found = [decay(d) for d in range(draws)]
        summary("free decays", [f[0] for f in found], sum(f[1] for f in found))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 60, " ".join(sys.argv[2:]) or "setups decays")
