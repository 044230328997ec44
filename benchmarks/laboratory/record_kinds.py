"""Kinds given as raw records: single hits, roving accelerometers, operating set-ups. Shares no code with operando."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from frf_kinds import Faults, draw_faults, drift, sensors_for
from lab_files import geometry, test_file
from lab_records import RATES, Logger, anti_alias, coloured, draw_logger, even_length, half_sine, lines, respond
from lab_structures import Point, Structure, draw
from lab_truth import answer, visible
from scipy import fft


def finish(folder: Path, structure: Structure, states: str, files: dict[str, bytes]) -> None:
    """Writes the files, the geometry and the test file."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "geometry.uff").write_bytes(geometry(structure))
    (folder / "test.toml").write_text(test_file(folder.name, states, structure.band), encoding="utf-8")


def setting(rng: np.random.Generator, block: int) -> tuple[float, float, float]:
    """Rate [Hz], end of the band [Hz], and the line spacing [Hz] of blocks a tester would choose."""
    rate = float(rng.choice(RATES))
    return rate, 0.39 * rate * rng.uniform(0.6, 0.95), rate / block


def roving_hammer_records(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """20 points, 2 accelerometers, two or three single hits a point, each hit in a file."""
    samples = 4096
    rate, top, line = setting(rng, samples)
    structure = draw(rng, 20, line=2 * line, top=top, modes=(6, 12))  # decayed to e^(−1.6π) = 0.7 % at the end of a record
    sensors, points = sensors_for(rng, structure, 2), list(structure.points)
    logger, faults = draw_logger(rng, rate), draw_faults(rng, 20, structure.size)
    hits = [p for p in points for _ in range(2 + int(rng.uniform() < 0.5))]
    faults.wrong_hits = {int(rng.integers(len(hits))): v for v in faults.wrong_hits.values()}
    period = even_length(4 * samples)
    hz = lines(period, rate)
    outputs = structure.rows(sensors)
    moved = drift(rng, len(hits), len(structure.modal.oscillating), faults)
    sensitivity = logger.sensitivities(rng, len(sensors), hz)
    forces = np.empty((len(hits), samples))
    motion = np.empty((len(hits), len(sensors), samples))
    for j, hit in enumerate(hits):
        kind, factor = faults.wrong_hits.get(j, ("", 1.0))
        row = structure.tilted(hit) if kind == "direction" else structure.beside(hit, faults.hit_miss * rng.standard_normal(3))
        width = rng.uniform(0.6, 1.0) / top
        pulse = half_sine(hz, rng.uniform(50, 200), width, 0.04 * samples / rate) * anti_alias(hz, rate) * rate
        gain = (1 + faults.hit_gain * rng.standard_normal()) * factor
        spectra = gain * sensitivity * respond(structure, outputs, row[None], pulse[None], hz, rate, moved[j])
        forces[j] = fft.irfft(pulse, period)[:samples]
        motion[j] = fft.irfft(spectra, period)[:, :samples]
    scales = np.abs(forces).max(), np.abs(motion).max()
    files = {}
    for j, hit in enumerate(hits):
        responses = [(p, logger.add(rng, x, scales[1])) for p, x in zip(sensors, motion[j], strict=True)]
        force = [(hit, logger.add(rng, forces[j], scales[0]))]
        files[f"hits/hit{j + 1:03d}.uff"] = logger.write(force, responses, f"hit {j + 1} at {hit.name}")
    finish(folder, structure, '[idle]\nrecords = ["hits/*.uff"]\n', files)
    frequencies = structure.modal.frequencies
    force = np.abs(half_sine(frequencies, 100.0, 0.8 / top, 0.0)) * rate / np.sqrt(samples)
    return _forced(structure, sensors, points, hits, moved, force, logger.noise * scales[1], faults.told(hits), logger)


def roving_accelerometers(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """One or two shakers with random force; three or four files of different sensors, one or two of which stay."""
    block = 2048
    rate, top, line = setting(rng, block)
    points = int(rng.integers(20, 37))
    structure = draw(rng, points, line=2 * line, top=top, modes=(6, 14))
    shakers = 1 if rng.uniform() < 0.6 else 2
    stay = sensors_for(rng, structure, max(shakers, int(rng.integers(1, 3))))
    driven, rest = stay[:shakers], [p for p in structure.points if p not in stay]
    setups = [[*stay, *part] for part in _parts(rng, rest, int(rng.integers(3, 5)))]
    logger = draw_logger(rng, rate)
    faults = Faults(drift_range=rng.uniform(0.0002, 0.001), drift_scatter=0.0)
    moved = drift(rng, len(setups), len(structure.modal.oscillating), faults)
    samples = block * int(rng.integers(40, 70))
    period = even_length(int(1.15 * samples))
    hz = lines(period, rate)
    low = 0.5 * structure.band[0]
    shape = anti_alias(hz, rate) / (1 + (low / np.maximum(hz, 1e-3 * low)) ** 6)
    inputs = structure.rows(driven)
    files, records = {}, []
    for k, sensors in enumerate(setups):
        force = np.array([coloured(rng, hz, shape, rng.uniform(8, 12), period) for _ in driven])
        spectra = respond(structure, structure.rows(sensors), inputs, force, hz, rate, moved[k])
        spectra *= logger.sensitivities(rng, len(sensors), hz)
        records.append((fft.irfft(force, period)[:, :samples], fft.irfft(spectra, period)[:, :samples]))
    scales = max(np.abs(f).max() for f, _ in records), max(np.abs(a).max() for _, a in records)
    for k, (sensors, (force, motion)) in enumerate(zip(setups, records, strict=True)):
        measured = [(p, logger.add(rng, x, scales[0])) for p, x in zip(driven, force, strict=True)]
        responses = [(p, logger.add(rng, x, scales[1])) for p, x in zip(sensors, motion, strict=True)]
        files[f"idle/setup{k + 1}.uff"] = logger.write(measured, responses, f"sensors {k + 1}")
    finish(folder, structure, '[idle]\nrecords = ["idle/*.uff"]\n', files)
    level = np.full(len(structure.modal.frequencies), 10.0)
    told = faults.told([]) | {"setups": [[p.name for p in s] for s in setups], "stay": [p.name for p in stay]}
    return _forced(structure, list(structure.points), driven, driven, moved, level, logger.noise * scales[1], told, logger)


def _parts(rng: np.random.Generator, points: list[Point], count: int) -> list[list[Point]]:
    """The points in so many groups, in order or mixed."""
    order = rng.permutation(len(points)) if rng.uniform() < 0.5 else np.arange(len(points))
    return [[points[int(i)] for i in part] for part in np.array_split(order, count)]


def _forced(structure: Structure, sensors, inputs, hits, moved, force, noise: float, told: dict, logger: Logger) -> dict[str, object]:
    """The answer of a test with measured forces: ``force`` (pairs,) is the amplitude at each mode, in the units in which noise is white."""
    modal = structure.modal
    frequencies, pairs = modal.frequencies, len(modal.oscillating)
    rows = structure.rows(sensors), structure.rows(inputs)
    amount = np.array([modal.contributions(np.full(pairs, f), *rows).reshape(pairs, -1) for f in frequencies])
    amount = amount * force[:, None, None]
    seen, reasons = visible(amount, np.full((pairs, amount.shape[2]), noise))
    power = np.einsum("rrp->rp", np.abs(amount) ** 2).reshape(pairs, len(sensors), len(inputs))
    if len(hits) == len(moved):  # a hit a row: weighted by what each shows of the mode
        place = [inputs.index(p) for p in hits]
        weights = power.sum(axis=1)[:, place]
    else:  # a set-up a row: its sensors share the mode about alike
        weights = np.ones((pairs, len(moved)))
    drifted = frequencies * (1 + moved)
    weighted = (weights * drifted.T).sum(axis=1) / weights.sum(axis=1)
    dofs = list(dict.fromkeys([*inputs, *sensors]))
    return answer(
        structure,
        dofs,
        seen,
        reasons,
        frequencies=weighted,
        plain=drifted.mean(axis=0),
        state="idle",
        references=[p.name for p in inputs if p in sensors],
        scaled=True,
        faults=told | {"logger": logger.told()},
    )


def operating_setups(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """Three set-ups of a running structure: unknown coloured forces at many places, two or three sensors that stay."""
    rate, top, line = setting(rng, 2048)
    structure = draw(rng, int(rng.integers(18, 34)), line=2 * line, top=top, modes=(6, 12))
    while structure.band[0] < 0.02 * rate:  # a record of 60 000 samples holds over a thousand periods of the lowest mode
        structure = draw(rng, int(rng.integers(18, 34)), line=2 * line, top=top, modes=(6, 12))
    stay = sensors_for(rng, structure, int(rng.integers(2, 4)))
    setups = [[*stay, *part] for part in _parts(rng, [p for p in structure.points if p not in stay], 3)]
    logger = draw_logger(rng, rate)
    logger.noise *= 3  # the motion is that of the surroundings, far below the range
    faults = Faults(drift_range=0.002 * rng.uniform(0.2, 1.0))
    moved = drift(rng, 3, len(structure.modal.oscillating), faults)
    samples = int(rng.integers(60_000, 120_000))
    period = even_length(int(1.1 * samples))
    hz = lines(period, rate)
    places = [structure.points[int(i)] for i in rng.choice(len(structure.points), min(16, len(structure.points)), replace=False)]
    inputs = structure.rows(places)
    shapes = np.array([colour(rng, hz, structure.band, rate) for _ in places])
    levels = rng.uniform(0.3, 1.0, len(places))
    records = []
    for k, sensors in enumerate(setups):
        loud = rng.uniform(0.7, 1.4)
        force = np.array([coloured(rng, hz, shape, loud * v, period) for shape, v in zip(shapes, levels, strict=True)])
        spectra = respond(structure, structure.rows(sensors), inputs, force, hz, rate, moved[k])
        spectra *= logger.sensitivities(rng, len(sensors), hz)
        records.append(fft.irfft(spectra, period)[:, :samples])
    scale = max(np.abs(a).max() for a in records)
    files = {}
    for k, (sensors, motion) in enumerate(zip(setups, records, strict=True)):
        responses = [(p, logger.add(rng, x, scale)) for p, x in zip(sensors, motion, strict=True)]
        files[f"operating/setup{k + 1}.uff"] = logger.write([], responses, f"set-up {k + 1}")
    finish(folder, structure, '[operating]\nrecords = ["operating/*.uff"]\n', files)
    told = faults.told([]) | {"setups": [[p.name for p in s] for s in setups], "stay": [p.name for p in stay], "logger": logger.told()}
    density = np.array([np.interp(structure.modal.frequencies, hz, s / np.sqrt(np.mean(s**2))) for s in shapes]).T * levels
    return _output_only(structure, stay, inputs, density, moved, logger.noise * scale, told)


def colour(rng: np.random.Generator, hz: np.ndarray, band: tuple[float, float], rate: float) -> np.ndarray:
    """Amplitude spectrum of an unknown force: falling or rising by a power of frequency, with one broad hump (ζ 0.1 to 0.3)."""
    slope = (np.maximum(hz, 0.5 * band[0]) / np.sqrt(band[0] * band[1])) ** rng.uniform(-0.7, 0.3)
    centre, wide = np.exp(rng.uniform(*np.log(band))), rng.uniform(0.1, 0.3)
    hump = 1 + rng.uniform(0, 1.5) / np.sqrt(1 + ((hz / centre - 1) / wide) ** 2)
    return slope * hump * anti_alias(hz, rate) / (1 + (0.3 * band[0] / np.maximum(hz, 1e-3 * band[0])) ** 6)


def _output_only(
    structure: Structure, stay: list[Point], inputs, density: np.ndarray, moved, noise: float, told: dict
) -> dict[str, object]:
    """The answer of an output-only test; a mode must stand out at a sensor that stays, by which the set-ups are joined."""
    modal = structure.modal
    frequencies, pairs = modal.frequencies, len(modal.oscillating)
    rows = structure.rows(stay)
    amount = []
    for f, level in zip(frequencies, density, strict=True):
        parts = modal.contributions(np.full(pairs, f), rows, inputs)
        amount.append(np.sqrt(np.einsum("roi,i->ro", np.abs(parts) ** 2, level**2)))
    seen, reasons = visible(np.array(amount), np.full((pairs, len(stay)), noise))
    drifted = (frequencies * (1 + moved)).mean(axis=0)
    return answer(
        structure, list(structure.points), seen, reasons, frequencies=drifted, state="operating", references=[p.name for p in stay],
        scaled=False, faults=told,
    )  # fmt: skip
