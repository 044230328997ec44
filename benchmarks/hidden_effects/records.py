"""Raw records of a state: exact steady sections of a longer period, with noise, as binary 58b sets. Shares no code with operando.

Every force is limited to the band of the data logger's filter (flat to 170 Hz, nothing above 250 Hz) and periodic over more than the
record; the response is H·F on each line of that period, and the record is a section of it. A random record begins and ends while the
structure moves; a hammer record begins at rest, for the rest of its period is silence.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from contacts import LEAD, RATE, Contact, added
from days import mode_shapes
from families import Structure
from hidden import Hidden, System
from scipy import fft

sys.path.append(str(Path(__file__).resolve().parents[1] / "example_data"))
from uff import Trace, time_record

RESPONSE_NOISE, FORCE_NOISE = 0.01, 0.002
GRAVITY, POUND = 9.80665, 4.4482216152605
FILTER_END = 250.0
SHARP = (240.0, 255.0)
DATE = "21-NOV-26 08:00:00"


def anti_alias(hz: np.ndarray) -> np.ndarray:
    """Gain of the filter: 1 to 170 Hz, a raised cosine to 0 at 250 Hz."""
    return 0.5 * (1 + np.cos(np.pi * np.clip((hz - 170) / 80, 0, 1)))


def logger_gain(hz: np.ndarray, rate: float = RATE) -> np.ndarray:
    """What a logger of this rate keeps of a motion that is not limited to its band: flat to where no force is left, then a sharp end.

    Forces and the motion they make by themselves are recorded as they are, so the motion that an effect adds must not be filtered by more.
    """
    low, high = (edge * rate / RATE for edge in SHARP)
    return 0.5 * (1 + np.cos(np.pi * np.clip((hz - low) / (high - low), 0, 1)))


def lines(period: int, rate: float = RATE) -> np.ndarray:
    return fft.rfftfreq(period, 1 / rate)


def random_force(rng: np.random.Generator, period: int, rms: np.ndarray, low: float, high: float, rate: float = RATE) -> np.ndarray:
    """Spectra (forces, lines) of stationary random forces of given rms [N] between two frequencies, with soft edges."""
    hz = lines(period, rate)
    shape = anti_alias(hz) / (1 + (low / np.maximum(hz, 1e-6)) ** 8) / (1 + (hz / high) ** 8)
    spectra = (rng.standard_normal((len(rms), hz.size)) + 1j * rng.standard_normal((len(rms), hz.size))) * shape
    spectra[:, 0] = spectra[:, -1] = 0
    return spectra * (rms * period / np.sqrt(2 * np.sum(np.abs(spectra) ** 2, axis=1)))[:, None]


def hammer_force(rng: np.random.Generator, period: int, seconds: float, level: float, rate: float = RATE) -> np.ndarray:
    """Spectrum (1, lines) of half-sine hits of 3 to 5 ms every 7.5 to 9 s, of varying peak."""
    hz = lines(period, rate)
    spectrum = np.zeros(hz.size, complex)
    start = 1.5
    while start < seconds - 6:
        peak, width = level * rng.uniform(0.5, 1.5), rng.uniform(0.003, 0.005)
        x = 2 * hz * width
        x = np.where(np.abs(x - 1) < 1e-9, 1 + 1e-9, x)
        pulse = 2 * peak * width / np.pi * np.cos(np.pi * x / 2) / (1 - x**2)
        spectrum += pulse * np.exp(-2j * np.pi * hz * (start + width / 2))
        start += rng.uniform(7.5, 9.0)
    return (spectrum * anti_alias(hz) * rate)[None]


def steady(system: System, rows: np.ndarray, columns: np.ndarray, forces: np.ndarray, period: int, rate: float = RATE) -> np.ndarray:
    """Acceleration spectra (rows, lines) over the period: H·F on every line, nothing above the filter's end."""
    hz = lines(period, rate)
    wanted = hz < FILTER_END
    spectra = np.zeros((len(rows), hz.size), complex)
    spectra[:, wanted] = system.respond(hz[wanted], forces[:, wanted], rows, columns)
    return spectra


def through_faults(state: Hidden, spectra: np.ndarray, hz: np.ndarray) -> np.ndarray:
    """What the channels of the running set-up make of the accelerations (sensors, lines) that its sensors see."""
    out = spectra.astype(complex) if state.remounted is None else spectra * state.remounted.responses(hz)
    for i, gain in state.gain.items():
        out[i] *= gain
    for i, delay in state.delay.items():
        out[i] *= np.exp(-2j * np.pi * hz * delay)
    if state.swap is not None:
        out[list(state.swap)] = out[list(state.swap)[::-1]]
    return out


class Logger:
    """Adds noise and writes runs in given units."""

    def __init__(
        self, structure: Structure, rng: np.random.Generator, units: tuple[str, str], noise: float | None = None, rate: float = RATE
    ) -> None:
        self.structure, self.rng, self.units, self.noise, self.rate = structure, rng, units, noise, rate

    def run(self, acceleration: np.ndarray, force: np.ndarray | None, reference: int | None, name: str) -> bytes:
        sensors, (a_unit, f_unit) = self.structure.sensors, self.units
        traces = []
        if force is not None and reference is not None:
            s = sensors[reference]
            noisy = force + FORCE_NOISE * force.std() * self.rng.standard_normal(force.shape)
            scale = POUND if f_unit == "lbf" else 1.0
            traces.append(Trace(f"force {s.name}", s.label, s.sense * (s.axis + 1), "force", f_unit, noisy / scale))
        share = RESPONSE_NOISE if self.noise is None else self.noise
        for s, row in zip(sensors, acceleration, strict=True):
            noisy = row + share * row.std() * self.rng.standard_normal(row.shape)
            scale = GRAVITY if a_unit == "g" else 1.0
            traces.append(Trace(f"acceleration {s.name}", s.label, s.sense * (s.axis + 1), "acceleration", a_unit, noisy / scale))
        return time_record(traces, self.rate, name, DATE)


def forced_run(
    logger: Logger, state: Hidden, reference: int, excitation: str, seconds: float, level: float, name: str, *, check: bool = False
) -> bytes:
    """A run with one measured force at a sensor; in a check run the set-up's faults act."""
    rng, rate = logger.rng, logger.rate
    samples = int(seconds * rate)
    period = fft.next_fast_len(samples + int((60 if excitation == "hammer" else 20) * rate), real=True)
    period += period % 2
    if excitation == "hammer":
        forces = hammer_force(rng, period, seconds, 15 * level, rate)
    else:
        forces = random_force(rng, period, np.array([level]), 3.0, 190.0, rate)
    system, driven = state.system, state.rows[reference]
    if check:
        system = state.check_system or state.system
        driven = driven if state.remounted is None else state.remounted.columns[reference]
    spectra = steady(system, state.seen if check else state.rows, driven[None], forces, period, rate)
    measured, hz = forces[0], lines(period, rate)
    if check:
        spectra = through_faults(state, spectra, hz)
        measured = measured * state.force_gain.get(reference, 1.0) * np.exp(-2j * np.pi * hz * state.force_delay.get(reference, 0.0))
        if state.remounted is not None:
            measured = measured * state.remounted.force(reference, hz)
    acceleration = fft.irfft(spectra, period)[:, :samples]
    return logger.run(acceleration, fft.irfft(measured, period)[:samples], reference, name)


def operating_run(logger: Logger, state: Hidden, seconds: float, orders: tuple[tuple[float, float], ...]) -> bytes:
    """White forces at 24 places of the mesh, unmeasured, and rotor orders (Hz, share) at one of them."""
    rng = logger.rng
    samples = int(seconds * RATE)
    period = fft.next_fast_len(samples + int(20 * RATE), real=True)
    period += period % 2
    size = np.abs(state.shapes).max(axis=1)
    places = rng.choice(np.flatnonzero(size > 0.05 * size.max()), 24, replace=False)
    forces = random_force(rng, period, rng.uniform(0.6, 1.8, places.size), 3.0, 190.0)
    spectra = through_faults(state, steady(state.system, state.seen, state.shapes[places], forces, period), lines(period))
    acceleration = fft.irfft(spectra, period)[:, :samples]
    if orders:
        hz = np.array([f for f, _ in orders])
        gains = state.system.accelerance(hz, state.seen, state.shapes[places[:1]])[:, 0]
        time = np.arange(samples) / RATE
        power = (acceleration**2).mean(axis=1)
        waves = []
        measured = through_faults(state, gains, hz)
        for gain, shown, (f, share) in zip(gains.T, measured.T, orders, strict=True):
            # The force is such that the order holds this share of the mean square of the channel that feels it most.
            amplitude = np.sqrt(share / np.max(np.abs(gain) ** 2 / 2 / power))
            phase = np.exp(2j * np.pi * (f * time + rng.uniform()))
            waves.append(np.real(shown[:, None] * amplitude * phase))
        acceleration = acceleration + sum(waves)
    return logger.run(acceleration, None, None, "running")


def contact_runs(
    logger: Logger, state: Hidden, contact: Contact, references: list[int], levels: list[float], seconds: float
) -> list[bytes]:
    """Runs with a measured random force each, then one without (forces at 24 places), of a state with a level-dependent effect."""
    rng, rate = logger.rng, logger.rate
    samples = int(seconds * rate)
    period = fft.next_fast_len(samples + int((LEAD + 20) * rate), real=True)
    period += period % 2
    size = np.abs(state.shapes).max(axis=1)
    places = rng.choice(np.flatnonzero(size > 0.05 * size.max()), 24, replace=False)
    put_back = state.remounted
    columns = {r: state.rows[r] if put_back is None else put_back.columns[r] for r in references}
    drives = [
        (random_force(rng, period, np.array([v]), 3.0, 190.0, rate), columns[r][None]) for r, v in zip(references, levels, strict=True)
    ]
    # Together they shake the machine about as much as the shaker does.
    drives.append(
        (random_force(rng, period, rng.uniform(0.2, 0.6, places.size) * max(levels) / 12, 3.0, 190.0, rate), state.shapes[places])
    )
    hz = lines(period, rate)
    away = np.where(hz > 0, -1 / np.maximum(2 * np.pi * hz, 1e-9) ** 2, 0)
    at_place = np.array([steady(state.system, contact.row[None], at, forces, period, rate)[0] * away for forces, at in drives])
    start = int(LEAD * rate)
    starts = np.full(len(drives), start)
    pole, shapes = _modes_at(logger.structure, state, np.concatenate([contact.row[None], state.seen]))

    def kept(hz: np.ndarray) -> np.ndarray:
        return logger_gain(hz, rate) * (1.0 if put_back is None else put_back.responses(hz))

    more = added(pole, shapes[1:], shapes[0], contact, at_place, period, starts, samples, rate, kept)
    out = []
    for k, (forces, at) in enumerate(drives):
        # Exact for forces within the filter's band, as they are.
        spectra = through_faults(state, steady(state.system, state.seen, at, forces, period, rate), hz)
        linear = fft.irfft(spectra, period)[:, start : start + samples]
        driven = k < len(references)
        force = forces[0] * (1.0 if put_back is None or not driven else put_back.force(references[k], hz))
        measured = fft.irfft(force, period)[start : start + samples] if driven else None
        name = f"running state, shaker at {logger.structure.sensors[references[k]].name}" if driven else "running"
        out.append(logger.run(linear + more[k], measured, references[k] if driven else None, name))
    return out


def _modes_at(structure: Structure, state: Hidden, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poles and shapes at rows of a state without what is hidden; on another day damping couples the modes of day one."""
    if state.remounted is None:
        w = 2 * np.pi * structure.hz
        return w * (-structure.zeta + 1j * np.sqrt(1 - structure.zeta**2)), rows
    return mode_shapes(state, rows, structure.hz.size)


def geometry(structure: Structure) -> bytes:
    """Sensor nodes (set 15, metres) and the lines between them (set 82)."""
    nodes = {s.label: structure.points[s.node] for s in structure.sensors}
    text = [f"{-1:6d}", f"{15:6d}"]
    text += [f"{n:10d}{0:10d}{0:10d}{7:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for n, (x, y, z) in sorted(nodes.items())]
    text.append(f"{-1:6d}")
    for number, wire in enumerate(structure.wires, start=1):
        text += [f"{-1:6d}", f"{82:6d}", f"{number:10d}{len(wire):10d}{7:10d}", "line"]
        text += ["".join(f"{n:10d}" for n in wire[i : i + 8]) for i in range(0, len(wire), 8)]
        text.append(f"{-1:6d}")
    return ("\n".join(text) + "\n").encode("ascii")
