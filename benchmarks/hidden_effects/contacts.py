"""Level-dependent kinds acting on the modal truth, integrated in time. Shares no code with operando.

The response without the effect is exact, line by line, as for the linear kinds. What the effect adds obeys z' = λz − φ_b·s(x, v) for each
pole λ, x = x_linear + what z makes at the place: integrated by an exponential Runge-Kutta method of second order (Cox and Matthews
2002) at 8192 steps a second, brought through the logger's filter and then to its rate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from families import Structure
from hidden import DB_RANGE, Hidden, _sized, idle
from scipy import fft
from scipy.special import erfc

NONLINEAR = (
    "cubic_stiffness",
    "quadratic_stiffness",
    "quadratic_damping",
    "coulomb_friction",
    "hysteresis",
    "clearance",
    "one_sided_contact",
    "bilinear_stiffness",
    "saturating_spring",
    "quintic",
)
RESPONSE_NOISE = 0.002
RATE, FINE = 512.0, 16  # samples a second, and steps a sample of the integration at that rate
LEAD = 8.0  # s that the effect has acted before the record begins
MOST_DB = 3.0
UNITS = {
    "cubic_stiffness": {"coefficient": "N/m^3"}, "quadratic_stiffness": {"coefficient": "N/m^2"},
    "quadratic_damping": {"coefficient": "N·s²/m²"}, "quintic": {"coefficient": "N/m^5"},
}  # fmt: skip
PLAIN = {"stiffness": "N/m", "gap": "m", "knee": "m", "force": "N", "yield_force": "N", "exponent": "", "ratio": ""}
Law = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Contact:
    """A restoring force along one modal row.

    ``law`` and ``rate`` are functions of displacement, velocity and an internal state that starts at zero.
    """

    row: np.ndarray
    law: Law
    rate: Law


def hide_contact(
    kind: str, structure: Structure, references: tuple[int, ...], rng: np.random.Generator, level: float
) -> tuple[Hidden, Contact]:
    """A level-dependent effect at a sensor or between two; its equivalent at the full level changes the FRFs by 0.5 to 3 dB rms.

    The state returned is linear (nothing hidden in its matrices); what is hidden stands in its list of effects.
    """
    base = idle(structure)
    sensors = structure.sensors
    for _ in range(200):
        count = 2 if rng.uniform() < 0.4 else 1
        at = [int(i) for i in rng.choice(len(sensors), count, replace=False)]
        row = structure.rows[at[0]] - (structure.rows[at[1]] if count == 2 else 0)
        deflection, speed = _typical(structure, base, references, row, level)
        damping = kind in ("quadratic_damping", "coulomb_friction")
        size = _equivalent(structure, base, references, row, rng, damping)
        if size is None:
            continue
        parameters, law, rate = _law(kind, size, deflection, speed, rng, float(row @ row))
        if kind == "quadratic_damping" and 2 * parameters["coefficient"] * 6 * speed * float(row @ row) > RATE * FINE:
            continue  # at six times the rms speed it brakes the place within one step: the integration would run away
        unit = UNITS.get(kind, PLAIN)
        effect = {
            "kind": kind,
            "location": [sensors[i].name for i in at],
            "parameters": {name: {"value": float(v), "unit": unit[name]} for name, v in parameters.items()},
            "rms_displacement_m": deflection,
        }
        return Hidden(base.system, base.rows, base.shapes, (effect,)), Contact(row, law, rate)
    raise RuntimeError(f"no place for {kind}")


def _typical(structure: Structure, base: Hidden, references: tuple[int, ...], row: np.ndarray, level: float) -> tuple[float, float]:
    """rms displacement and velocity at the place under a white force of this rms between 3 and 190 Hz, mean square over the references."""
    hz = np.linspace(3, 190, 6000)
    gain = np.abs(base.system.accelerance(hz, row[None], base.rows[list(references)])[0]) ** 2
    density = level**2 / (hz[-1] - hz[0])
    w = 2 * np.pi * hz
    power = [float(np.mean(np.trapezoid(gain * density / w**p, hz, axis=1))) for p in (4, 2)]
    return float(np.sqrt(power[0])), float(np.sqrt(power[1]))


def _equivalent(
    structure: Structure, base: Hidden, references: tuple[int, ...], row: np.ndarray, rng: np.random.Generator, damping: bool
) -> float | None:
    """Linear spring or damper at the place that changes the FRFs by a drawn number of dB."""
    outer = np.outer(row, row)
    typical_mass = 1 / np.mean(row[: int(structure.in_band.sum())] ** 2)
    centre = 2 * np.pi * np.sqrt(np.prod(structure.band))

    def make(size: float) -> Hidden:
        s = base.system
        changed = replace(s, damping=s.damping + size * outer) if damping else replace(s, stiffness=s.stiffness + size * outer)
        return replace(base, system=changed, effects=({"size": size},))

    wide = typical_mass * centre * (1 if damping else 3 * centre)
    target = float(np.exp(rng.uniform(*np.log((DB_RANGE[0], MOST_DB)))))
    found = _sized((make, 1e-6 * wide, wide), structure, references, base, target)
    return None if found is None else found.effects[0]["size"]


def _law(kind: str, size: float, x: float, v: float, rng: np.random.Generator, mobility: float) -> tuple[dict[str, float], Law, Law]:
    """Parameters whose equivalent for a Gaussian motion of rms x and v is the linear size, and the law with them.

    ``mobility`` is Σφ² at the place: friction is smoothed over no less a speed than the integration can bear.
    """
    none: Law = lambda x, v, z: 0.0 * x  # noqa: E731
    if kind == "cubic_stiffness":
        k = size / (3 * x**2)
        return {"coefficient": k}, lambda x, v, z: k * x**3, none
    if kind == "quintic":
        k = size / (15 * x**4)
        return {"coefficient": k}, lambda x, v, z: k * x**5, none
    if kind == "quadratic_stiffness":
        # Softens towards one side: no more than a sixth of the linear size at six times the rms, lest it runs away.
        k = size / (12 * x)
        return {"coefficient": k}, lambda x, v, z: k * x**2, none
    if kind == "quadratic_damping":
        c = size / (np.sqrt(8 / np.pi) * v)
        return {"coefficient": c}, lambda x, v, z: c * v * np.abs(v), none
    if kind == "coulomb_friction":
        level = size * v * np.sqrt(np.pi / 2)
        speed = max(0.02 * v, level * mobility * 2.5 / (RATE * FINE))
        return {"force": level}, lambda x, v, z: level * np.tanh(v / speed), none
    if kind == "clearance":
        gap = rng.uniform(0.3, 0.8) * x
        k = size / erfc(gap / x / np.sqrt(2))
        return {"stiffness": k, "gap": gap}, lambda x, v, z: k * (x - np.clip(x, -gap, gap)), none
    if kind == "one_sided_contact":
        gap = rng.uniform(0.1, 0.7) * x
        k = 2 * size / erfc(gap / x / np.sqrt(2))
        return {"stiffness": k, "gap": gap}, lambda x, v, z: k * np.maximum(x - gap, 0), none
    if kind == "bilinear_stiffness":
        k = 2 * size
        return {"stiffness": k}, lambda x, v, z: k * np.maximum(x, 0), none
    if kind == "saturating_spring":
        knee = rng.uniform(0.4, 1.0) * x
        u = np.linspace(-6, 6, 2001)
        share = np.trapezoid(u * knee / x * np.tanh(u * x / knee) * np.exp(-(u**2) / 2), u) / np.sqrt(2 * np.pi)
        k = size / share
        return {"stiffness": k, "knee": knee}, lambda x, v, z: k * knee * np.tanh(x / knee), none
    if kind == "hysteresis":
        ratio, exponent, reach = rng.uniform(0.1, 0.4), rng.uniform(1, 3), rng.uniform(0.5, 1.2) * x
        k = size / (ratio + 0.5 * (1 - ratio))
        slip = k * reach

        def rate(x: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
            size_z = np.abs(z)
            return (v - 0.5 * (np.abs(v) * size_z ** (exponent - 1) * z + v * size_z**exponent)) / reach

        return (
            {"stiffness": k, "yield_force": slip, "exponent": exponent, "ratio": ratio},
            lambda x, v, z: ratio * k * x + (1 - ratio) * slip * z,
            rate,
        )
    raise ValueError(f"unknown kind {kind!r}")


def added(
    pole: np.ndarray,
    rows: np.ndarray,
    b: np.ndarray,
    contact: Contact,
    linear: np.ndarray,
    period: int,
    starts: np.ndarray,
    samples: int,
    rate: float,
    gain,
) -> np.ndarray:
    """Accelerations (runs, rows, samples) that the effect adds.

    Of modes with these poles and shapes (rows at the sensors, ``b`` at the place; complex ones so scaled that a residue of the receptance
    is φφᵀ/(2j·Im λ)). ``linear`` (runs, lines) are displacement spectra at the place over the period without the effect, ``starts`` the
    samples at which the records begin; ``gain(hz)`` is what logger and channels make of a motion, (lines,) or (rows, lines).
    """
    lead, fine = int(LEAD * rate), max(round(FINE * RATE / rate), 2)
    n = (lead + samples + int(rate)) * fine
    spectra = np.zeros((len(linear), period * fine // 2 + 1), complex)
    spectra[:, : linear.shape[1]] = linear * fine
    hz = fft.rfftfreq(period * fine, 1 / (rate * fine))
    x_free, v_free = (fft.irfft(s, period * fine, axis=1) for s in (spectra, spectra * 2j * np.pi * hz))
    index = ((starts - lead)[:, None] * fine + np.arange(n + 1)) % (period * fine)
    x_free, v_free = (np.ascontiguousarray(np.take_along_axis(a, index, axis=1).T) for a in (x_free, v_free))
    step = 1 / (rate * fine)
    e = np.exp(pole * step)
    first = (e - 1) / pole
    second = (e - 1 - pole * step) / (pole**2 * step)
    # x = Im(b·y)/ω_d for y' = λy + b·u, its rate from λy.
    to_x = b / pole.imag
    to_v = to_x * pole
    make = np.stack([np.concatenate([to_x.imag, to_x.real]), np.concatenate([to_v.imag, to_v.real])])
    y = np.zeros((pole.size, len(linear)), complex)
    z = np.zeros(len(linear))
    forces = np.empty((n, len(linear)))
    kick_1, kick_2 = -(first * b)[:, None], -(second * b)[:, None]
    e = e[:, None]

    def motion(y: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
        moved = make @ np.concatenate([y.real, y.imag])
        return x_free[i] + moved[0], v_free[i] + moved[1]

    x, v = motion(y, 0)
    for i in range(n):
        s = contact.law(x, v, z)
        forces[i] = s
        dz = contact.rate(x, v, z)
        ahead = e * y + kick_1 * s
        x1, v1 = motion(ahead, i + 1)
        z1 = z + step * dz
        change = contact.law(x1, v1, z1) - s
        y = ahead + kick_2 * change
        x, v = motion(y, i + 1)
        z = z + step / 2 * (dz + contact.rate(x1, v1, z1))
    # The force is known now: accelerations of all sensors in the same way, at the rate kept.
    return _accelerations(rows, b, pole, forces, step, lead, samples, rate, gain)


def _accelerations(rows, b, pole, forces, step, lead, samples, rate, gain) -> np.ndarray:
    """Accelerations at the sensors under forces −s (steps, runs), filtered and brought to the logger's rate."""
    n, runs = forces.shape
    # What rings has died down before it wraps round.
    silence = 9 / -pole.real.max() / step
    pad = (1 << int(np.ceil(np.log2(n + silence)))) // 2
    hz = fft.rfftfreq(2 * pad, step)
    kept = np.atleast_2d(gain(hz))
    wanted = np.flatnonzero((hz > 0) & np.any(kept != 0, axis=0) & (hz < rate / 2))
    spectra = fft.rfft(forces, 2 * pad, axis=0)[wanted]
    s = 2j * np.pi * hz[wanted]
    half = (b / (2j * pole.imag))[:, None]
    out = np.zeros((runs, len(rows), samples))
    receptance = rows @ (half / (s - pole[:, None])) + rows.conj() @ (half.conj() / (s - pole[:, None].conj()))
    transfer = -receptance * s**2 * kept[:, wanted]
    every = round(1 / (step * rate))
    for k in range(runs):
        full = np.zeros((len(rows), pad // every + 1), complex)
        full[:, wanted] = transfer * spectra[:, k] / every
        out[k] = fft.irfft(full, 2 * pad // every, axis=1)[:, lead : lead + samples]
    return out
