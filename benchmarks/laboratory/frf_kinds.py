"""Kinds given as FRFs without coherence: roving hammer, one reference, complex modes; and the faults of such tests.

Every fault has its size and its source in README.md. Shares no code with operando.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lab_files import frf_set, geometry, test_file
from lab_structures import Point, Structure, draw
from lab_truth import answer, visible

RANGES = (100.0, 125.0, 200.0, 250.0, 400.0, 500.0, 625.0, 800.0, 1000.0, 1250.0, 1600.0, 2000.0)  # Hz, of an analyser


@dataclass
class Faults:
    """What goes wrong in one test; None or 0 where it does not. ``told`` goes into the answer."""

    hit_gain: float = 0.0
    hit_miss: float = 0.0  # m, standard deviation
    drift_range: float = 0.0
    drift_scatter: float = 0.0
    wrong_hits: dict[int, tuple[str, float]] = field(default_factory=dict)
    tail: float = 0.0
    hum: float = 0.0
    flicker: float = 0.0
    sensor_gain: float = 0.0
    sensor_rise: float = 0.0
    opposite: bool = False
    noise: float = 1e-5

    def told(self, hits: list[Point]) -> dict[str, object]:
        out = {k: v for k, v in vars(self).items() if k != "wrong_hits"}
        return out | {"wrong_hits": {hits[i].name: list(v) for i, v in self.wrong_hits.items()}}


def draw_faults(rng: np.random.Generator, hits: int, size: float, *, few: bool = False) -> Faults:
    """A plausible mixture; ``few``: no roving faults of many hits (two wrong hits of five are no measurement)."""

    def happens(chance: float) -> bool:
        return bool(rng.uniform() < chance)

    faults = Faults(noise=10 ** -rng.uniform(3.5, 5.0), hit_gain=rng.uniform(0.03, 0.05), hit_miss=size * rng.uniform(0.001, 0.004))
    if happens(0.8):
        faults.drift_range, faults.drift_scatter = rng.uniform(0.0004, 0.002), rng.uniform(0.00005, 0.0003)
    if not few and happens(0.7):
        for i in rng.choice(hits, int(rng.integers(1, 3)), replace=False):
            faults.wrong_hits[int(i)] = ("gain", rng.uniform(1.3, 2.0)) if happens(0.6) else ("direction", 1.0)
    if happens(0.5):
        faults.tail = rng.uniform(0.03, 0.15)
    if happens(0.5):
        faults.hum, faults.flicker = rng.uniform(5, 60), rng.uniform(0.5, 3.0)
    if happens(0.8):
        faults.sensor_gain, faults.sensor_rise = rng.uniform(0.005, 0.015), rng.uniform(0.02, 0.03)
    return faults


def drift(rng: np.random.Generator, hits: int, pairs: int, faults: Faults) -> np.ndarray:
    """Relative frequency (hits, pairs): a slow trend (the lab warms up, or the mounts settle) and scatter from hit to hit."""
    if not faults.drift_range:
        return np.zeros((hits, pairs))
    t = np.linspace(0, 1, hits)
    trend = {0: t, 1: (1 - np.exp(-3 * t)) / (1 - np.exp(-3.0)), 2: np.sin(np.pi * t)}[int(rng.integers(3))]
    sense = rng.choice([-1.0, 1.0])
    modes = rng.uniform(0.3, 1.0, pairs)
    return sense * faults.drift_range * np.outer(trend - 0.5, modes) + faults.drift_scatter * rng.standard_normal((hits, pairs))


@dataclass
class Measured:
    """FRFs (sensors, hits, lines), the noise amplitude (sensors, hits, lines), the drifted frequencies (hits, pairs) in Hz, and the rows
    of the structure (hits, DOFs) where the hits fell (a hit in a wrong direction: its point)."""

    data: np.ndarray
    noise: np.ndarray
    frequencies: np.ndarray
    hit_rows: np.ndarray


def measure(
    rng: np.random.Generator, structure: Structure, sensors: list[Point], hits: list[Point], hz: np.ndarray, faults: Faults
) -> Measured:
    """FRFs of a roving hammer, as the analyser shows them."""
    modal = structure.modal
    outputs = structure.rows(sensors)
    moved = drift(rng, len(hits), len(modal.oscillating), faults)
    data = np.empty((len(sensors), len(hits), len(hz)), complex)
    struck = structure.rows(hits).copy()
    for j, hit in enumerate(hits):
        kind, factor = faults.wrong_hits.get(j, ("", 1.0))
        row = structure.tilted(hit) if kind == "direction" else structure.beside(hit, faults.hit_miss * rng.standard_normal(3))
        if kind != "direction":
            struck[j] = row
        gain = (1 + faults.hit_gain * rng.standard_normal()) * factor
        data[:, j] = gain * modal.accelerance(hz, outputs, row[None], modal.shifted(moved[j]))[:, 0]
    rms = np.sqrt((np.abs(data) ** 2).mean(axis=2, keepdims=True))
    data *= channel_gain(rng, hz, len(sensors), faults)[:, None]
    floor = faults.noise * np.median(np.abs(data).max(axis=2))
    noise = floor * noise_shape(rng, hz, structure.band, faults)
    data = data + tails(rng, hz, structure, rms, faults)
    data = data + hum(rng, hz, floor, data.shape, faults)
    data = data + noise / np.sqrt(2) * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))
    if faults.opposite:
        data = -data
    return Measured(data, np.broadcast_to(noise, data.shape), modal.frequencies * (1 + moved), struck)


def channel_gain(rng: np.random.Generator, hz: np.ndarray, channels: int, faults: Faults) -> np.ndarray:
    """Gain (channels, lines): a wrong sensitivity, and the mounted resonance, whose rise at the last line is ``sensor_rise``."""
    static = 1 + faults.sensor_gain * rng.standard_normal((channels, 1))
    if not faults.sensor_rise:
        return static * np.ones_like(hz)
    rise = faults.sensor_rise * rng.uniform(0.6, 1.0, (channels, 1))
    resonance = hz[-1] / np.sqrt(rise / (1 + rise))
    s = hz / resonance
    return static / (1 - s**2 + 0.04j * s)


def noise_shape(rng: np.random.Generator, hz: np.ndarray, band: tuple[float, float], faults: Faults) -> np.ndarray:
    """Noise over frequency: rising as the force of a half-sine pulse falls, by which it is divided; 1/f at the bottom."""
    width = rng.uniform(0.6, 1.15) / band[1]  # s; the spectrum is at 0.4 to 0.1 of its start at the end of the band
    x = 2 * hz * width
    safe = np.where(np.abs(x - 1) < 1e-6, 1 + 1e-6, x)
    force = np.maximum(np.abs(np.cos(np.pi * safe / 2) / (1 - safe**2)), 0.03)
    corner = faults.flicker * band[0]
    return np.sqrt(1 + (corner / np.maximum(hz, hz[1] - hz[0])) ** 2) / force


def tails(rng: np.random.Generator, hz: np.ndarray, structure: Structure, rms: np.ndarray, faults: Faults) -> np.ndarray:
    """A constant offset under an exponential window, b/(iω + 1/τ); at the lowest mode in band ``tail`` of the rms of the FRF."""
    if not faults.tail:
        return np.zeros(1)
    lowest = structure.modal.frequencies[structure.in_band[0]]
    rate = 2 * np.pi * (hz[1] - hz[0]) * rng.uniform(0.3, 1.0)
    size = faults.tail * rms * np.exp(rng.standard_normal(rms.shape)) * rng.choice([-1.0, 1.0], rms.shape)
    return size * 2 * np.pi * lowest / (2j * np.pi * hz + rate)


def hum(rng: np.random.Generator, hz: np.ndarray, floor: float, shape: tuple[int, ...], faults: Faults) -> np.ndarray:
    """50 Hz and harmonics out of the cables, on the nearest line and, less, beside it."""
    out = np.zeros(shape, complex)
    if not faults.hum:
        return out
    for k in (1, 2, 3, 5):
        if 50 * k > hz[-1]:
            break
        i = int(np.argmin(np.abs(hz - 50 * k)))
        size = faults.hum * floor / k * np.exp(0.5 * rng.standard_normal(shape[:2])) * np.exp(2j * np.pi * rng.uniform(size=shape[:2]))
        for line, share in ((i - 1, -0.35), (i, 1.0), (i + 1, -0.35)):
            if 0 <= line < len(hz):
                out[:, :, line] += share * size
    return out


def axis(rng: np.random.Generator, count: int) -> tuple[np.ndarray, float]:
    """Lines of the analyser and the end of the band within them."""
    end = float(rng.choice(RANGES))
    step = end / count
    start = 0 if rng.uniform() < 0.5 else 1
    return step * np.arange(start, count + 1), end * rng.uniform(0.6, 0.95)


def sensors_for(rng: np.random.Generator, structure: Structure, count: int) -> list[Point]:
    """Points for the accelerometers, as somebody who knows the structure a little would choose: each mode in band moves one of them."""
    size = np.abs(structure.rows(list(structure.points)) @ structure.modal.shapes[:, structure.in_band])
    size = size / size.max(axis=0)
    best, chosen = -1.0, np.arange(count)
    for _ in range(10):
        trial = rng.choice(len(structure.points), count, replace=False)
        worst = float(np.min(size[trial].max(axis=0)))
        if worst > best:
            best, chosen = worst, trial
    return [structure.points[int(i)] for i in chosen]


def roving_hammer(
    rng: np.random.Generator, folder: Path, points: int = 74, accelerometers: int = 3, lines: int = 1600
) -> dict[str, object]:
    """Hammer over many points, a few accelerometers that stay."""
    hz, top = axis(rng, lines)
    structure = draw(rng, points, line=hz[1] - hz[0], top=top)
    sensors, hits = sensors_for(rng, structure, accelerometers), list(structure.points)
    faults = draw_faults(rng, points, structure.size)
    measured = measure(rng, structure, sensors, hits, hz, faults)
    return write(rng, folder, structure, sensors, hits, hz, measured, faults, swap=False)


def single_reference(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """Hammer over 40 to 81 points, one accelerometer; force and accelerometer of opposite sense in some; 800 to 2200 lines."""
    hz, top = axis(rng, int(rng.choice([800, 1600, 2000])))
    points = int(rng.integers(40, 82))
    structure = draw(rng, points, line=hz[1] - hz[0], top=top, kind="plate" if rng.uniform() < 0.6 else None, modes=(6, 14))
    sensors, hits = sensors_for(rng, structure, 1), list(structure.points)
    faults = draw_faults(rng, points, structure.size)
    faults.opposite = bool(rng.uniform() < 0.35)
    measured = measure(rng, structure, sensors, hits, hz, faults)
    return write(rng, folder, structure, sensors, hits, hz, measured, faults, swap=bool(rng.uniform() < 0.5))


def complex_modes(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """Few FRFs of a structure with dampers at one to three points: complex modes, some with 5 to 10 % damping."""
    hz, top = axis(rng, int(rng.choice([400, 800, 1600])))
    responses, references = int(rng.integers(3, 9)), int(rng.integers(1, 3))
    structure = draw(rng, 24, line=hz[1] - hz[0], top=top, modes=(5, 10), local_dampers=True)
    chosen = sensors_for(rng, structure, responses)
    hits = chosen[:references]
    faults = draw_faults(rng, references, structure.size, few=True)
    measured = measure(rng, structure, chosen, hits, hz, faults)
    return write(rng, folder, structure, chosen, hits, hz, measured, faults, swap=False)


def write(
    rng, folder: Path, structure: Structure, sensors, hits, hz, measured: Measured, faults: Faults, *, swap: bool
) -> dict[str, object]:
    """Files and the answer. With ``swap`` the labels are exchanged (as if the accelerometer had roved), which reciprocity allows."""
    unit = str(rng.choice(["m/s2", "g"]))
    apart = len(sensors) > 1 and rng.uniform() < 0.5
    folder.mkdir(parents=True, exist_ok=True)
    parts: dict[str, list[bytes]] = {}
    for i, sensor in enumerate(sensors):
        name = f"frfs_{i + 1}.uff" if apart else "frfs.uff"
        for j, hit in enumerate(hits):
            pair = (hit, sensor) if swap else (sensor, hit)
            parts.setdefault(name, []).append(frf_set(*pair, measured.data[i, j], hz[0], hz[1] - hz[0], unit, "roving hammer"))
    for name, sets in parts.items():
        (folder / name).write_bytes(b"".join(sets))
    (folder / "geometry.uff").write_bytes(geometry(structure))
    names = ", ".join(f'"{name}"' for name in parts)
    (folder / "test.toml").write_text(
        test_file(folder.name, f"[idle]\nfrfs = [{names}]\n", structure.band),
        encoding="utf-8",
    )
    return _answer(structure, sensors, hits, hz, measured, faults)


def _answer(structure: Structure, sensors, hits, hz, measured: Measured, faults: Faults) -> dict[str, object]:
    modal = structure.modal
    outputs, inputs = structure.rows(sensors), measured.hit_rows
    pairs = len(modal.oscillating)
    frequencies = modal.frequencies
    nearest = np.abs(hz[:, None] - frequencies[None]).argmin(axis=0)
    noise = measured.noise[:, :, nearest].transpose(2, 0, 1).reshape(pairs, -1)
    amount = np.array([modal.contributions(np.full(pairs, f), outputs, inputs).reshape(pairs, -1) for f in frequencies])
    seen, reasons = visible(amount, noise)
    power = np.einsum("rrp->rp", np.abs(amount) ** 2).reshape(pairs, len(sensors), len(hits)).sum(axis=1)  # (pairs, hits)
    weighted = (power * measured.frequencies.T).sum(axis=1) / power.sum(axis=1)
    dofs = list(dict.fromkeys([*hits, *sensors]))
    struck = {point: row for point, row in zip(hits, measured.hit_rows, strict=True) if point not in sensors}
    rows = np.array([struck.get(point, at) for point, at in zip(dofs, structure.rows(dofs), strict=True)])
    return answer(
        structure,
        dofs,
        seen,
        reasons,
        frequencies=weighted,
        plain=measured.frequencies.mean(axis=0),
        hit_rows=rows,
        state="idle",
        references=[p.name for p in sensors],
        scaled=True,
        faults=faults.told(hits),
    )
