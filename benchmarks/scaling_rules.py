"""Which scaling rule is best? Random plates with random effects, exact and noisy modes, error of the OFRF of each method.

Run: python benchmarks/scaling_rules.py [--structures 40] [--first-seed 1000] [--json FILE]

The plates are Ritz models of their own (Legendre products, point springs and masses); nothing here is shared with the analysis.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh

EFFECTS = ("none", "mass", "spring", "coupling", "damper", "global", "patch", "mass+spring", "absorbed mass")


class Plate:
    """A thin rectangular plate on point springs, with a few point masses: Ritz modes at any place."""

    def __init__(self, rng: np.random.Generator, n: int = 11) -> None:
        self.a, self.b = 1.0, rng.uniform(0.65, 0.9)
        h, e, rho, nu = rng.uniform(0.003, 0.005), 70e9, 2700.0, 0.33
        self.n = n
        x, w = legendre.leggauss(24)
        value = np.array([legendre.legval(x, np.eye(n)[i]) for i in range(n)])
        first = np.array([legendre.legval(x, legendre.legder(np.eye(n)[i])) if i else 0 * x for i in range(n)])
        second = np.array([legendre.legval(x, legendre.legder(np.eye(n)[i], 2)) if i > 1 else 0 * x for i in range(n)])
        g = {
            (p, q): np.einsum("iw,jw,w->ij", u, v, w)
            for p, u in enumerate((value, first, second))
            for q, v in enumerate((value, first, second))
        }
        sx, sy = 2 / self.a, 2 / self.b
        area = self.a * self.b / 4
        self.mass = rho * h * area * np.kron(g[0, 0], g[0, 0])
        d = e * h**3 / 12 / (1 - nu**2)
        self.bending = d * area * (
            sx**4 * np.kron(g[2, 2], g[0, 0]) + sy**4 * np.kron(g[0, 0], g[2, 2])
            + nu * sx**2 * sy**2 * (np.kron(g[2, 0], g[0, 2]) + np.kron(g[0, 2], g[2, 0]))
            + 2 * (1 - nu) * sx**2 * sy**2 * np.kron(g[1, 1], g[1, 1])
        )  # fmt: skip
        stiffness = self.bending.copy()
        for _ in range(rng.integers(3, 6)):
            stiffness += 10 ** rng.uniform(3, 4.3) * self._outer(rng.uniform(-0.95, 0.95, 2))
        for _ in range(2):
            self.mass += rng.uniform(0.05, 0.3) * self._outer(rng.uniform(-0.9, 0.9, 2))
        self.total = float(self.mass[0, 0])
        w2, modes = eigh(stiffness, self.mass)
        self.count = 60
        self.w, self.modes = np.sqrt(np.maximum(w2[: self.count], 1)), modes[:, : self.count]
        self.zeta = rng.uniform(0.004, 0.012, self.count)

    def place(self, xy: np.ndarray) -> np.ndarray:
        """Ritz functions at a place (−1 … 1)."""
        return np.kron(legendre.legvander(xy[0], self.n - 1), legendre.legvander(xy[1], self.n - 1)).ravel()

    def _outer(self, xy: np.ndarray) -> np.ndarray:
        v = self.place(xy)
        return np.outer(v, v)

    def at(self, xy: np.ndarray) -> np.ndarray:
        """Mode values at a place."""
        return self.place(xy) @ self.modes

    def patch(self, rng: np.random.Generator) -> np.ndarray:
        """Modal bending stiffness of one quarter (numerically integrated)."""
        x, w = legendre.leggauss(16)
        sx, sy = rng.choice([-1, 1], 2)
        out = np.zeros_like(self.bending)
        x, w = (x + 1) / 2, w / 2
        n = self.n
        dd = [
            np.array([[legendre.legval(s * t, legendre.legder(np.eye(n)[i], k)) if i >= k else 0.0 for i in range(n)] for t in x])
            for s in (sx, sy)
            for k in (0, 2)
        ]
        for i in range(x.size):
            for j in range(x.size):
                lap = np.kron(dd[1][i], dd[2][j]) * (2 / self.a) ** 2 + np.kron(dd[0][i], dd[3][j]) * (2 / self.b) ** 2
                out += w[i] * w[j] * np.outer(lap, lap)
        modal = self.modes.T @ out @ self.modes
        whole = self.modes.T @ self.bending @ self.modes
        return modal * np.median(np.diag(whole)[3:15]) / np.median(np.diag(modal)[3:15]) * 0.3


def effect_matrices(plate: Plate, kind: str, rng: np.random.Generator, sensors: list[np.ndarray]):
    """ΔM, ΔC, ΔK in modal coordinates; half of the places lie at sensors."""
    pick = lambda: sensors[rng.integers(len(sensors))] if rng.uniform() < 0.5 else rng.uniform(-0.9, 0.9, 2)  # noqa: E731
    zero = np.zeros((plate.count, plate.count))
    dm, dc, dk = zero.copy(), zero.copy(), zero.copy()
    b = plate.at(pick())
    weight = plate.total
    if kind in ("mass", "mass+spring"):
        dm += weight * rng.uniform(0.01, 0.06) * np.outer(b, b)
    if kind in ("spring", "mass+spring"):
        s = plate.at(pick())
        dk += 10 ** rng.uniform(3.3, 4.6) * np.outer(s, s)
    if kind == "coupling":
        s = b - plate.at(pick())
        dk += 10 ** rng.uniform(3.3, 4.6) * np.outer(s, s)
    if kind == "damper":
        dc += 10 ** rng.uniform(0.5, 1.5) * np.outer(b, b)
    if kind == "global":
        dk += rng.uniform(-0.15, 0.15) * np.diag(plate.w**2)
    if kind == "patch":
        dk += rng.uniform(0.3, 1.0) * plate.patch(rng)
    if kind == "absorbed mass":
        for _ in range(3):
            s = plate.at(rng.uniform(-0.9, 0.9, 2))
            dm += weight * rng.uniform(0.005, 0.03) * np.outer(s, s)
    return dm, dc, dk


def sensors_of(plate: Plate, rng: np.random.Generator, m: int) -> list[np.ndarray]:
    """m places, well spread: a greedy choice among random ones."""
    pool = rng.uniform(-1, 1, (200, 2))
    chosen = [pool[0]]
    while len(chosen) < m:
        gap = np.min([np.linalg.norm(pool - c, axis=1) for c in chosen], axis=0) * rng.uniform(0.6, 1, 200)
        chosen.append(pool[int(np.argmax(gap))])
    return chosen


def make_trial(seed: int, kind: str, m: int = 12, n: int = 12, shape_noise: float = 0.015, idle_noise: float = 0.003):
    """Idle and operational models as an EMA and an OMA would give them, and the exact operating FRF."""
    from operando.data import ModalModel

    rng = np.random.default_rng(seed)
    plate = Plate(rng)
    places = sensors_of(plate, rng, m)
    phi = np.array([plate.at(p) for p in places])
    dm, dc, dk = effect_matrices(plate, kind, rng, places)
    w, z, k = plate.w, plate.zeta, plate.count
    mass, stiff = np.eye(k) + dm, np.diag(w**2) + dk
    damp = np.diag(2 * z * w) + dc
    inverse = np.linalg.inv(mass)
    a = np.block([[np.zeros((k, k)), np.eye(k)], [-inverse @ stiff, -inverse @ damp]])
    lam, vec = np.linalg.eig(a)
    up = lam.imag > 0
    lam, vec = lam[up], vec[:k, up]
    order = np.argsort(np.abs(lam))
    lam, vec = lam[order], vec[:, order]
    hz = w / 2 / np.pi
    low, high = 0.55 * hz[0], (hz[n - 1] + hz[n]) / 2
    f = np.linspace(low, high, 400)
    exact = np.stack(
        [phi @ np.linalg.solve(stiff - (2 * np.pi * v) ** 2 * mass + 2j * np.pi * v * damp, phi.T) * -((2 * np.pi * v) ** 2) for v in f], -1
    )
    inside = np.flatnonzero((np.abs(lam) / 2 / np.pi < high) & (np.abs(lam) / 2 / np.pi > low))
    shapes = phi @ vec[:, inside]
    rms = np.sqrt(np.mean(np.abs(shapes) ** 2, axis=0))
    sd = shape_noise * rms / np.sqrt(2)
    noisy = shapes + sd * (rng.normal(size=shapes.shape) + 1j * rng.normal(size=shapes.shape))
    fo, zo = np.abs(lam[inside]) / 2 / np.pi, -lam[inside].real / np.abs(lam[inside])
    fo_seen = fo * (1 + 3e-4 * rng.normal(size=fo.size) * (shape_noise > 0))
    zo_seen = zo * (1 + 0.05 * rng.normal(size=fo.size) * (shape_noise > 0))
    var = np.concatenate([(3e-4 * fo) ** 2, (0.05 * zo) ** 2, np.repeat(sd**2, m), np.repeat(sd**2, m)])
    dofs = tuple(f"{i + 1}+Z" for i in range(m))
    operating = ModalModel(fo_seen, zo_seen, noisy, dofs, covariance=np.diag(var) if shape_noise else None, band_hz=(low, high))
    # At rest: the modes in band, a few beyond it, and the rest as pseudo-modes of its static compliance.
    extra = 5
    real = phi[:, : n + extra].copy()
    size = np.sqrt(np.mean(real**2, axis=0))
    sd_idle = np.concatenate([np.full(n, idle_noise), np.full(extra, 0.05 * (idle_noise > 0))]) * size
    real += sd_idle * rng.normal(size=real.shape)
    value, vector = np.linalg.eigh((phi[:, n + extra :] / w[n + extra :] ** 2) @ phi[:, n + extra :].T)
    far = 5 * high
    rest = (vector * np.sqrt(np.maximum(value, 0)))[:, ::-1][:, :4] * 2 * np.pi * far
    idle_hz = np.concatenate([hz[: n + extra], np.full(4, far)])
    idle_z = np.concatenate([z[: n + extra], np.full(4, 0.01)])
    nn = idle_hz.size
    var_e = np.concatenate([(1e-5 * idle_hz) ** 2, (5e-4 * idle_z) ** 2, np.repeat(np.concatenate([sd_idle**2, np.zeros(4)]), m)])
    idle = ModalModel.from_terms(
        idle_hz, idle_z, np.concatenate([real, rest], axis=1), dofs, "unit_modal_mass",
        residual=np.arange(nn) >= n, in_band=np.arange(nn) < n,
        covariance=np.diag(var_e) if idle_noise else None, band_hz=(low, high),
    )  # fmt: skip
    return idle, operating, f, exact


def error_db(made: np.ndarray, exact: np.ndarray) -> float:
    """Rms of the magnitude ratio in dB over lines and pairs."""
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(made) / np.abs(exact))) ** 2)))


def study(structures: int, first_seed: int, noise: float) -> dict[str, dict[str, list[float]]]:
    """Errors by effect and method."""
    from operando.scaling import METHODS, scale_operational

    out: dict[str, dict[str, list[float]]] = {}
    for s in range(structures):
        kind = EFFECTS[s % len(EFFECTS)]
        idle, operating, f, exact = make_trial(first_seed + s, kind, shape_noise=noise, idle_noise=0.003 if noise else 0.0)
        row = out.setdefault(kind, {})
        row.setdefault("idle", []).append(error_db(idle.frf(f).data, exact))
        hybrid = scale_operational(idle, operating)
        for name in METHODS:
            model = hybrid.alternative_models.get(name)
            row.setdefault(name, []).append(error_db(model.frf(f).data, exact) if model is not None else np.nan)
        row.setdefault("auto", []).append(error_db(hybrid.modal.frf(f).data, exact))
        row.setdefault("auto chose", []).append(hybrid.method)
    return out


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--structures", type=int, default=45)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--noise", type=float, default=0.015)
    parser.add_argument("--json")
    options = parser.parse_args()
    start = time.perf_counter()
    table = study(options.structures, options.first_seed, options.noise)
    names = [n for n in next(iter(table.values())) if n != "auto chose"]
    print(f"{'effect':14s}" + "".join(f"{n:>14s}" for n in names) + "   (median dB / worst dB)")
    pooled: dict[str, list[float]] = {n: [] for n in names}
    for kind, row in table.items():
        print(
            f"{kind:14s}" + "".join(f"{np.nanmedian(row[n]):7.2f}/{np.nanmax(row[n]):6.2f}" for n in names), sorted(set(row["auto chose"]))
        )
        for n in names:
            pooled[n] += row[n]
    print(f"{'all':14s}" + "".join(f"{np.nanmedian(pooled[n]):7.2f}/{np.nanmax(pooled[n]):6.2f}" for n in names))
    best = np.nanmin([pooled[n] for n in names if n not in ("auto", "idle")], axis=0)
    print(
        "above the best of each trial, dB: "
        + "".join(f"  {n} {np.nanmedian(pooled[n] - best):.2f}/{np.nanmax(pooled[n] - best):.2f}" for n in names)
    )
    print(f"{time.perf_counter() - start:.1f} s")
    if options.json:
        with open(options.json, "w") as stream:
            json.dump({"noise": options.noise, "first_seed": options.first_seed, "errors_db": table}, stream, indent=1)


if __name__ == "__main__":
    main()
