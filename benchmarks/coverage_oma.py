"""Do the stated intervals of operational modal analysis hold? Monte Carlo on a plate-like structure under white forces.

    python benchmarks/coverage_oma.py [draws]

Each draw simulates a new record of a simply supported plate (analytic modes, a close pair among them), identifies it blind, and
asks whether the true frequencies and damping ratios lie in the 95 % intervals. Shares no code with the analysis.
"""

from __future__ import annotations

import sys

import numpy as np


class Plate:
    """Simply supported rectangular plate, analytic modes, modal damping; sensors and forces at points."""

    def __init__(self, n_sensors=9, n_forces=6, first_hz=8.0, aspect=1.28, n_modes=12, seed=3):
        rng = np.random.default_rng(seed)
        pairs = [(m, n) for m in range(1, 7) for n in range(1, 7)]
        value = np.array([m**2 / aspect**2 + n**2 for m, n in pairs])
        rank = np.argsort(value)[:n_modes]
        self.hz = first_hz * value[rank] / value[rank][0]
        self.zeta = rng.uniform(0.005, 0.015, n_modes)
        self.sensors = self._shape([pairs[i] for i in rank], rng.uniform(0.08, 0.92, (n_sensors, 2)))
        self.forces = self._shape([pairs[i] for i in rank], rng.uniform(0.08, 0.92, (n_forces, 2)))

    @staticmethod
    def _shape(pairs, xy):
        return np.array([[np.sin(m * np.pi * x) * np.sin(n * np.pi * y) for m, n in pairs] for x, y in xy])

    def record(self, seconds, fs, rng, noise=0.01):
        """Stationary accelerations (sensors, samples): a piece of a longer periodic response to white forces up to 0.43 fs."""
        n = int(1.3 * seconds * fs)
        f = np.fft.rfftfreq(n, 1 / fs)
        w = 2 * np.pi * f
        white = rng.standard_normal((self.forces.shape[0], f.size)) + 1j * rng.standard_normal((self.forces.shape[0], f.size))
        white[:, f > 0.43 * fs] = 0
        modal = self.forces.T @ white
        wr = 2 * np.pi * self.hz[:, None]
        modal *= -(w**2) / (wr**2 - w**2 + 2j * self.zeta[:, None] * wr * w)
        x = np.fft.irfft(self.sensors @ modal, n, axis=1)[:, : int(seconds * fs)]
        return x + noise * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape)


def study(draws=200, seconds=150.0, fs=256.0, band=(4.0, 62.0), seed=0, structure=None, progress=None):
    """Run the study.

    Returns
    -------
    dict with ``hz``, ``zeta`` (true, in band), ``error_f``, ``error_z``, ``std_f``, ``std_z`` (draws, modes; NaN where a mode was missed),
    ``extra`` (modes too many, each draw).
    """
    from operando import Channel, Dof, TimeRecord, fit_oma

    plate = structure or Plate()
    inside = np.flatnonzero((plate.hz > band[0]) & (plate.hz < band[1]))
    shape = (draws, inside.size)
    out = {k: np.full(shape, np.nan) for k in ("error_f", "error_z", "std_f", "std_z")} | {"extra": np.zeros(draws, int)}
    channels = tuple(Channel(Dof(i + 1, "Z"), "acceleration", "m/s2") for i in range(plate.sensors.shape[0]))
    truth = plate.sensors[:, inside] / np.linalg.norm(plate.sensors[:, inside], axis=0)
    for d in range(draws):
        rng = np.random.default_rng([seed, d])
        model = fit_oma(TimeRecord(plate.record(seconds, fs, rng), fs, channels), band=band)
        mac = np.abs(truth.T @ model.shapes) ** 2
        near = np.abs(model.frequencies_hz - plate.hz[inside, None]) < 0.02 * plate.hz[inside, None]
        like = np.where(near, mac, 0)
        for k in range(inside.size):
            if model.n_modes and like[k].max() > 0.8:
                j = int(np.argmax(like[k]))
                out["error_f"][d, k] = model.frequencies_hz[j] - plate.hz[inside[k]]
                out["error_z"][d, k] = model.damping_ratios[j] - plate.zeta[inside[k]]
                out["std_f"][d, k] = model.frequency_std_hz[j]
                out["std_z"][d, k] = model.damping_ratio_std[j]
        out["extra"][d] = model.n_modes - np.sum(np.isfinite(out["error_f"][d]))
        if progress:
            progress(d)
    return out | {"hz": plate.hz[inside], "zeta": plate.zeta[inside]}


def coverage(result):
    """Share of draws with the truth within ±1.96 standard deviations, each mode: (frequency, damping); missed modes do not count."""
    table = []
    for name in ("f", "z"):
        hit = np.abs(result[f"error_{name}"]) <= 1.959964 * result[f"std_{name}"]
        table.append(hit.sum(axis=0) / np.isfinite(result[f"error_{name}"]).sum(axis=0))
    return table


def main(draws=200):
    result = study(draws, progress=lambda d: print(f"\r{d + 1}/{draws}", end="", file=sys.stderr, flush=True))
    print(file=sys.stderr)
    cover_f, cover_z = coverage(result)
    print("mode      f Hz    zeta   found  cover f  cover z   width/scatter f, z    bias/scatter f, z   scatter f %  zeta %")
    for k in range(result["hz"].size):
        scatter = [np.nanstd(result[f"error_{n}"][:, k]) for n in "fz"]
        width = [np.nanmedian(result[f"std_{n}"][:, k]) / s for n, s in zip("fz", scatter, strict=True)]
        bias = [np.nanmean(result[f"error_{n}"][:, k]) / s for n, s in zip("fz", scatter, strict=True)]
        found = int(np.isfinite(result["error_f"][:, k]).sum())
        relative = 100 * scatter[0] / result["hz"][k], 100 * scatter[1] / result["zeta"][k]
        print(
            f"{k:4d} {result['hz'][k]:9.3f} {result['zeta'][k]:7.4f} {found:7d} {cover_f[k]:8.3f} {cover_z[k]:8.3f}"
            f"   {width[0]:8.2f} {width[1]:8.2f}    {bias[0]:8.2f} {bias[1]:8.2f}   {relative[0]:9.4f} {relative[1]:8.2f}"
        )
    pooled = []
    for name in "fz":
        error = result[f"error_{name}"]
        pooled.append(np.mean(np.abs(error) <= 1.959964 * result[f"std_{name}"], where=np.isfinite(error)))
    print(f"pooled coverage: frequency {pooled[0]:.3f}, damping {pooled[1]:.3f}, both {np.mean(pooled):.3f}")
    print(f"modes missed {np.sum(~np.isfinite(result['error_f']))}, modes too many {result['extra'].sum()}, in all draws")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
