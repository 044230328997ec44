"""Makes data/example: a test of a machine frame at rest and running, as the files a lab would bring home.

    python benchmarks/example_data/make.py [FOLDER]

How the signals are made, so that they can be trusted:

- Every force is periodic with a period longer than the record and limited to the band of the data logger's anti-alias
  filter (linear phase, flat to 170 Hz, nothing above 250 Hz, the same for every channel). The response is H·F on each
  line of that period: the exact steady answer, no integration scheme, no aliasing. The record is a section of the period,
  so a random record begins while the frame already moves and ends while it still does; a hammer record begins at rest,
  because the rest of its period is silence.
- Hammer pulses are half sines of the closed-form spectrum, 4 to 6 ms, of varying level and at uneven times.
- In operation, independent white-ish forces act at 45 places of the plate, and the motor adds two rotor orders.
- Noise is white: 1 % of the rms of each acceleration in the run, 0.2 % of that of the force. Samples are rounded to single precision.

The exact answers go to truth.json beside this file, never to the data folder.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from frame import HIDDEN, MOTOR, REFERENCES, SENSORS, State, grid, idle_state, node_at, operating_state, sensor_rows
from uff import Trace, geometry, time_record

RATE = 512.0  # Hz
GRAVITY = 9.80665
BAND = (5.0, 145.0)
ORDERS_HZ = (24.6, 49.2)
IDLE_SECONDS, OPERATING_SECONDS, CHECK_SECONDS = 72, 150, 32
RESPONSE_NOISE, FORCE_NOISE = 0.01, 0.002
DATE = "17-NOV-26 09:15:00"
HERE = Path(__file__).resolve().parent


def lines(period: int) -> np.ndarray:
    """Frequencies [Hz] of the lines of a period."""
    return np.fft.rfftfreq(period, 1 / RATE)


def anti_alias(hz: np.ndarray) -> np.ndarray:
    """Gain of the data logger's filter: 1 to 170 Hz, a raised cosine to 0 at 250 Hz."""
    return 0.5 * (1 + np.cos(np.pi * np.clip((hz - 170) / 80, 0, 1)))


def half_sine(hz: np.ndarray, peak: float, width: float, start: float) -> np.ndarray:
    """Fourier integral of a half-sine pulse of a given peak [N] and width [s] that begins at start [s]."""
    x = 2 * hz * width
    safe = np.where(np.abs(x - 1) < 1e-9, 1 + 1e-9, x)
    magnitude = 2 * peak * width / np.pi * np.cos(np.pi * safe / 2) / (1 - safe**2)
    return magnitude * np.exp(-2j * np.pi * hz * (start + width / 2))


def hammer_force(rng: np.random.Generator, period: int, close_pair: bool) -> np.ndarray:
    """Spectrum (1, lines) of eight hits; with close_pair the fifth comes too early."""
    hz = lines(period)
    gaps = rng.uniform(8.2, 9.0, 8)
    if close_pair:
        gaps[4] = 4.6
    times = 1.7 + np.concatenate([[0], np.cumsum(gaps[:-1])])
    spectrum = sum(half_sine(hz, rng.uniform(70, 240), rng.uniform(0.004, 0.006), t) for t in times)
    return (spectrum * anti_alias(hz) * RATE)[None]


def random_force(rng: np.random.Generator, period: int, rms: np.ndarray, low: float, high: float) -> np.ndarray:
    """Spectra (forces, lines) of stationary random forces of the given rms [N] between two frequencies, with soft edges."""
    hz = lines(period)
    shape = anti_alias(hz) * (1 / (1 + (low / np.maximum(hz, 1e-6)) ** 8)) / (1 + (hz / high) ** 8)
    noise = rng.standard_normal((len(rms), hz.size)) + 1j * rng.standard_normal((len(rms), hz.size))
    spectra = noise * shape
    spectra[:, 0] = spectra[:, -1] = 0
    level = np.sqrt(2 * np.sum(np.abs(spectra) ** 2, axis=1)) / period
    return spectra * (rms / level)[:, None]


def response(state: State, forces: np.ndarray, columns: np.ndarray, period: int) -> np.ndarray:
    """Accelerations [m/s²] of all sensors over one period."""
    hz = lines(period)
    wanted = hz < 250
    spectra = np.zeros((len(SENSORS), hz.size), complex)
    spectra[:, wanted] = state.respond(hz[wanted], forces[:, wanted], sensor_rows(state.shapes), columns)
    return np.fft.irfft(spectra, period)


def record(rng: np.random.Generator, acceleration: np.ndarray, force: np.ndarray | None, reference: int | None, name: str) -> bytes:
    """Adds the noise and writes a run: the force channel first, then the accelerometers in g."""
    traces = []
    if force is not None and reference is not None:
        noisy = force + FORCE_NOISE * force.std() * rng.standard_normal(force.shape)
        traces.append(Trace(f"force {reference}", reference, 3 * SENSORS[reference][2], "force", "N", noisy))
    for node, row in zip(SENSORS, acceleration / GRAVITY, strict=True):
        noisy = row + RESPONSE_NOISE * row.std() * rng.standard_normal(row.shape)
        traces.append(Trace(f"accelerometer {node}", node, 3 * SENSORS[node][2], "acceleration", "g", noisy))
    return time_record(traces, RATE, name, DATE)


def column(state: State, reference: int) -> np.ndarray:
    """Modal column (1, kept) of a hammer or shaker point."""
    x, y, sense = SENSORS[reference]
    return sense * state.shapes[node_at(x, y)][None]


def idle_run(state: State, reference: int, seed: int) -> bytes:
    """Eight hammer hits at one point of the frame at rest."""
    rng = np.random.default_rng(seed)
    samples = int(IDLE_SECONDS * RATE)
    period = samples + int(64 * RATE)
    forces = hammer_force(rng, period, close_pair=reference == REFERENCES[-1])
    acceleration = response(state, forces, column(state, reference), period)[:, :samples]
    return record(rng, acceleration, np.fft.irfft(forces[0], period)[:samples], reference, f"frame at rest, hammer at {reference}")


def operating_run(state: State, seed: int) -> bytes:
    """The machine runs; nobody measures its forces."""
    rng = np.random.default_rng(seed)
    samples = int(OPERATING_SECONDS * RATE)
    period = samples + int(20 * RATE)
    places = rng.choice(len(grid()), 45, replace=False)
    forces = random_force(rng, period, rng.uniform(0.6, 1.8, len(places)), 3.0, 190.0)
    acceleration = response(state, forces, state.shapes[places], period)[:, :samples]
    time = np.arange(samples) / RATE
    gains = state.accelerance(np.array(ORDERS_HZ), sensor_rows(state.shapes), state.shapes[[node_at(*MOTOR)]])[:, 0]
    for gain, hz, force, phase in zip(gains.T, ORDERS_HZ, (3.5, 1.6), (0.4, 1.9), strict=True):
        acceleration = acceleration + np.real(np.outer(gain * force, np.exp(1j * (2 * np.pi * hz * time + phase))))
    return record(rng, acceleration, None, None, "frame running")


def check_run(state: State, reference: int, rms: float, seed: int) -> bytes:
    """The machine stands, warm and in its running state, on a shaker of known force."""
    rng = np.random.default_rng(seed)
    samples = int(CHECK_SECONDS * RATE)
    period = samples + int(30 * RATE)
    forces = random_force(rng, period, np.array([rms]), 3.0, 170.0)
    acceleration = response(state, forces, column(state, reference), period)[:, :samples]
    return record(
        rng, acceleration, np.fft.irfft(forces[0], period)[:samples], reference, f"running state, shaker at {reference}, {rms:g} N rms"
    )


def truth(idle: State, operating: State) -> dict[str, object]:
    """What the script knows and the files do not say."""
    count = 14
    idle_hz, idle_zeta, _ = idle.poles()
    operating_hz, operating_zeta, shapes = operating.poles()
    labels = {node: f"{node}{'+' if sense > 0 else '-'}Z" for node, (_, _, sense) in SENSORS.items()}
    spring = {"stiffness": {"value": HIDDEN["stiffness"], "unit": "N/m"}}
    return {
        "effects": [{"kind": HIDDEN["kind"], "location": [labels[HIDDEN["node"]]], "parameters": spring}],
        "band_hz": list(BAND),
        "harmonics_hz": list(ORDERS_HZ),
        "dofs": list(labels.values()),
        "references": [labels[node] for node in REFERENCES],
        "idle": {
            "frequency_hz": idle_hz[:count].tolist(),
            "damping_ratio": idle_zeta[:count].tolist(),
            "shapes_unit_modal_mass": np.round(sensor_rows(idle.shapes)[:, :count], 9).tolist(),
        },
        "operating": {
            "frequency_hz": operating_hz[:count].tolist(),
            "damping_ratio": operating_zeta[:count].tolist(),
            "shapes_unit_norm": np.round([shapes[:, :count].real, shapes[:, :count].imag], 9).tolist(),
        },
    }


TEST_TOML = f"""name = "machine frame"

[idle]                         # at rest, eight hammer hits at each of three points
records = ["idle/*.uff"]

[operating]                    # running, forces unknown
records = ["operating/*.uff"]

[check]                        # the running state with a shaker of known force, at two levels
records = ["check/*.uff"]

[geometry]
file = "geometry.uff"
units = "m"

[analysis]
band = [{BAND[0]}, {BAND[1]}]            # Hz

[report]                       # title block of the report
object = "ribbed steel plate with motor, gearbox and pump on four rubber mounts (simulated)"
sensors = ["13 accelerometers normal to the plate", "impact hammer", "shaker with force sensor"]
comments = "rotor at 24.6 Hz in operation"
"""


def main(folder: Path) -> None:
    """Writes the whole example."""
    idle, operating = idle_state(), operating_state()
    quads = [(1, 2, 6, 5), (3, 4, 8, 7), (5, 6, 10, 9), (7, 8, 12, 11)]
    triangles = [(2, 3, 6), (3, 7, 6), (6, 7, 13), (6, 13, 10), (13, 7, 11), (13, 11, 10)]
    files = {
        "geometry.uff": geometry({node: (x, y, 0.0) for node, (x, y, _) in SENSORS.items()}, triangles, quads),
        "test.toml": TEST_TOML.encode(),
        "operating/run1.uff": operating_run(operating, 2000),
    }
    for i, reference in enumerate(REFERENCES, start=1):
        files[f"idle/hammer{i}.uff"] = idle_run(idle, reference, 1000 + i)
    for i, reference in enumerate((REFERENCES[0], REFERENCES[2]), start=1):
        for level, rms in (("a", 24.0), ("b", 6.0)):
            files[f"check/run{i}{level}.uff"] = check_run(operating, reference, rms, 3000 + 10 * i + (level == "b"))
    for name, content in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        print(f"{name:22s} {len(content) / 1e6:6.2f} MB")
    (HERE / "truth.json").write_text(json.dumps(truth(idle, operating), indent=1) + "\n")
    print(f"{'sum':22s} {sum(map(len, files.values())) / 1e6:6.2f} MB in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE.parents[1] / "data" / "example")
