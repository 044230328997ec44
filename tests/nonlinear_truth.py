"""Structures with a level-dependent effect, integrated by a Runge-Kutta method of their own. Shares no code with operando."""

from __future__ import annotations

import numpy as np
from scipy import fft

from operando.data import Channel, ModalModel, TimeRecord
from operando.dof import Dof

RATE = 512.0


class Strip:
    """A strip with smooth shapes: ``count`` modes, ``sensors`` DOFs along it, unit modal mass, some damping."""

    def __init__(self, sensors=8, count=14, first=7.0, mass=2.0, seed=0):
        rng = np.random.default_rng(seed)
        r = np.arange(1, count + 1)
        self.hz = first * r**1.25 * (1 + 0.03 * rng.uniform(-1, 1, count))
        self.zeta = rng.uniform(0.006, 0.012, count)
        self.at = np.sort(np.linspace(0.06, 0.97, sensors) + rng.uniform(-0.03, 0.03, sensors))
        tilt = rng.uniform(-0.25, 0.25, count)
        self.phi = np.sin(np.pi * np.outer(self.at, r) + tilt) * np.sqrt(2 / mass)

    def idle(self, top=95.0, residual=True):
        """What an identification would hand over: modes to a little above the band, and pseudo-modes for what lies beyond."""
        inside = self.hz < 1.2 * top
        keep = inside | residual
        dofs = tuple(Dof(i + 1, "Z", 1) for i in range(len(self.at)))
        return ModalModel.from_terms(
            self.hz[keep],
            self.zeta[keep],
            self.phi[:, keep],
            dofs,
            "unit_modal_mass",
            residual=~inside[keep],
            in_band=(self.hz < top)[keep],
            band_hz=(0.6 * self.hz[0], top),
        )


def band_force(rng, samples, low=3.0, high=180.0, rms=10.0):
    """A random force that is nothing outside a band; periodic over the record and its run-in."""
    f = fft.rfftfreq(samples, 1 / RATE)
    spectrum = np.where((f > low) & (f < high), 1.0, 0.0) * np.exp(2j * np.pi * rng.uniform(size=f.size))
    x = fft.irfft(spectrum, samples)
    return x * rms / x.std()


def zero(x, v, z):
    """No force, and no z that would move."""
    return 0.0 * x


def law_of(kind, p):
    """Restoring force of (x, v, z) and rate of z, from the contract's table."""
    table = {
        "none": (zero, zero),
        "ground_spring": (lambda x, v, z: p["stiffness"] * x, zero),
        "ground_damper": (lambda x, v, z: p["damping"] * v, zero),
        "cubic_stiffness": (lambda x, v, z: p["coefficient"] * x**3, zero),
        "quadratic_stiffness": (lambda x, v, z: p["coefficient"] * x**2, zero),
        "quintic": (lambda x, v, z: p["coefficient"] * x**5, zero),
        "quadratic_damping": (lambda x, v, z: p["coefficient"] * v * np.abs(v), zero),
        "coulomb_friction": (lambda x, v, z: p["force"] * np.tanh(v / p["speed"]), zero),
        "clearance": (lambda x, v, z: p["stiffness"] * (x - np.maximum(np.minimum(x, p["gap"]), -p["gap"])), zero),
        "one_sided_contact": (lambda x, v, z: p["stiffness"] * np.maximum(x - p["gap"], 0), zero),
        "bilinear_stiffness": (lambda x, v, z: p["stiffness"] * np.maximum(x, 0), zero),
        "saturating_spring": (lambda x, v, z: p["stiffness"] * p["knee"] * np.tanh(x / p["knee"]), zero),
        "hysteresis": (
            lambda x, v, z: p["ratio"] * p["stiffness"] * x + (1 - p["ratio"]) * p["yield_force"] * z,
            lambda x, v, z: (
                p["stiffness"]
                / p["yield_force"]
                * (v - 0.5 * (np.abs(v) * np.abs(z) ** (p["exponent"] - 1) * z + v * np.abs(z) ** p["exponent"]))
            ),
        ),
    }
    return table[kind]


def respond(strip, drive_at, forces, effects, fine=8):
    """Accelerations (runs, m, N) to forces (runs, N), each at one DOF. Classical Runge-Kutta.

    Effects are (b, kind, parameters), b (m,) or, where each run has effects of its own, (m, runs).
    """
    effects = effects or [(np.zeros(len(strip.at)), "none", {})]
    runs, n = forces.shape
    step = 1 / (RATE * fine)
    # Forces at half steps, band-limited interpolation.
    spectrum = fft.rfft(forces, axis=1)
    full = np.zeros((runs, n * fine * 2 // 2 + 1), complex)
    full[:, : spectrum.shape[1]] = spectrum * fine * 2
    f = fft.irfft(full, n * fine * 2, axis=1)
    f = np.ascontiguousarray(f.T)  # (half steps, runs)
    count, states = len(effects), 2 * strip.hz.size + len(effects)
    every = [b if b.ndim == 2 else np.repeat(b[:, None], runs, axis=1) for b, _, _ in effects]
    acts = [np.any(b != 0, axis=0) for b in every]  # in which runs
    rows = np.array([strip.phi.T @ b[:, np.argmax(on)] for b, on in zip(every, acts, strict=True)])  # an effect has one place
    assert all(np.array_equal(b, np.outer(b[:, np.argmax(on)], on)) for b, on in zip(every, acts, strict=True))
    w = 2 * np.pi * strip.hz
    m = w.size
    # the state q, v, z, and what acts on it: restoring forces, and the force of each run in the row of its place
    places = sorted(set(drive_at))
    now = np.zeros((states + count + len(places), runs))
    linear = np.zeros((states, len(now)))
    linear[:m, m : 2 * m] = np.eye(m)
    linear[m : 2 * m, :m], linear[m : 2 * m, m : 2 * m] = np.diag(-(w**2)), np.diag(-2 * strip.zeta * w)
    linear[m : 2 * m, states : states + count] = -rows.T
    linear[m : 2 * m, states + count :] = strip.phi[places].T
    across = np.zeros((2 * count, 2 * m))  # motion and velocity at each effect
    across[:count, :m] = across[count:, m:] = rows
    state, motion, seen = now[:states], now[: 2 * m], np.zeros((2 * count, runs))
    forced, driven = now[states + count :], np.equal.outer(places, drive_at).astype(float)
    a1, a2, a3, a4, part = (np.empty((states, runs)) for _ in range(5))
    laws, rates_of_z = [], []
    for e, (on, (_, kind, p)) in enumerate(zip(acts, effects, strict=True)):
        s, ds = law_of(kind, p)
        if s is not zero and on.any():
            own = slice(np.argmax(on), np.argmax(on) + np.count_nonzero(on))
            assert on[own].all(), "the runs of an effect stand side by side"
            inputs = (seen[e, own], seen[count + e, own], now[2 * m + e, own])
            laws.append((s, inputs, now[states + e, own]))
            if ds is not zero:
                rates_of_z.append((ds, inputs, e, own))

    def rate(force, out):
        np.multiply(driven, force, out=forced)
        np.matmul(across, motion, out=seen)
        for s, inputs, restoring in laws:
            restoring[:] = s(*inputs)
        np.matmul(linear, now, out=out)
        for ds, inputs, e, own in rates_of_z:
            out[2 * m + e, own] = ds(*inputs)

    y = np.zeros((states, runs))
    moved = np.empty((n, m, runs))
    for i in range(n):
        for j in range(fine):
            at = 2 * (i * fine + j)
            state[:] = y
            rate(f[at], a1)
            if j == 0:
                moved[i] = a1[m : 2 * m]
            for share, before, after, force in ((step / 2, a1, a2, 1), (step / 2, a2, a3, 1), (step, a3, a4, 2)):
                np.multiply(before, share, out=part)
                np.add(y, part, out=state)
                rate(f[(at + force) % len(f)], after)
            a2 += a3
            a2 *= 2
            a2 += a1
            a2 += a4
            a2 *= step / 6
            y += a2
    return np.moveaxis(strip.phi @ moved, 2, 0).swapaxes(1, 2)


def measure(strip, effects, **how):
    """Records of one structure, see :func:`measure_many`."""
    return measure_many(strip, {"": effects}, **how)[""]


def measure_many(strip, cases, seconds=24.0, drive_at=(1, 5), levels=(1.0, 0.25), rms=10.0, noise=0.003, seed=1, run_in=4.0, fine=8):
    """Records of each case (name → effects) at each level and drive point, all integrated side by side.

    They are noisy, and cut after a run-in, so that they begin while the structure moves.
    """
    rng = np.random.default_rng(seed)
    lead, n = int(run_in * RATE), int(seconds * RATE)
    runs = [(name, d, level) for name in cases for level in levels for d in drive_at]
    forces = np.stack([band_force(rng, lead + n, rms=rms * level) for _, _, level in runs])
    effects = []
    for name, own in cases.items():
        mine = np.array([other == name for other, _, _ in runs], float)
        effects += [(np.outer(b, mine), kind, p) for b, kind, p in own]
    moved = respond(strip, [d for _, d, _ in runs], forces, effects, fine)[:, :, lead:]
    records = {name: [] for name in cases}
    for (name, d, level), f, a in zip(runs, forces[:, lead:], moved, strict=True):
        measured = a + noise * a.std(axis=1, keepdims=True) * rng.standard_normal(a.shape)
        f = f + 0.001 * f.std() * rng.standard_normal(f.shape)
        channels = (
            Channel(Dof(d + 1, "Z", 1), "force", "N"),
            *(Channel(Dof(i + 1, "Z", 1), "acceleration", "m/s2") for i in range(len(strip.at))),
        )
        records[name].append(TimeRecord(np.vstack([f, measured]), RATE, channels, name=f"at {d + 1}, level {level:g}"))
    return records


def place(strip, *rows):
    """b of one DOF, or of the difference of two."""
    b = np.zeros(len(strip.at))
    b[rows[0]] = 1
    if len(rows) == 2:
        b[rows[1]] = -1
    return b
