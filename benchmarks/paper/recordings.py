"""Raw measurements of the structure as the paper made them, as universal files, and the test files that name them.

- At rest: one hammer pulse at each of the four corners in turn, 5 s at steps of 1 ms. The plate still moves when the record ends, so the
  FRFs need an exponential window, which operando takes by itself.
- In operation: white forces at the four corners at once, steps of 1 ms; the forces are not recorded.
- Check: the exact FRFs of the target, which only the comparison reads.

Responses are H·F on each line of a period longer than the record: exact, no time stepping. Forces are limited to 450 Hz by the same
filter for all channels. Nothing is added: the paper's example has no noise. ``noise`` adds some to see what it does.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from exact import DAMPING, KEPT
from tripod import CORNERS, DOFS, MASS_NODE, ORIGIN, POINTS, A, Modes

sys.path.append(str(Path(__file__).resolve().parents[1] / "example_data"))

from uff import Trace, geometry, time_record

Array = np.ndarray

RATE = 1000
HAMMER_SECONDS, PERIOD_SECONDS = 5, 60
OPERATING_SECONDS = 300
PEAK, WIDTH, START = 100.0, 0.003, 0.12
BAND = (6.0, 172.0)
"""The paper's band of the EMA [Hz]."""
DATE = "21-NOV-26 12:00:00"
CHECK_LINES = np.arange(20, 451) / 2
_AXES = {"X": 1, "Y": 2, "Z": 3}


def frf(modes: Modes, lines: Array, sources: list[int]) -> Array:
    """Exact accelerance (19, sources, lines)."""
    w, wr = 2 * np.pi * lines, 2 * np.pi * modes.hz[:KEPT, None]
    gain = -(w**2) / (wr**2 - w**2 + 2j * DAMPING * wr * w)
    shapes = modes.shapes[:, :KEPT]
    return np.einsum("ok,sk,kl->osl", shapes, shapes[sources], gain, optimize=True)


def filtered(hz: Array) -> Array:
    """Gain of the anti-alias filter: 1 to 350 Hz, a raised cosine to 0 at 450 Hz."""
    return 0.5 * (1 + np.cos(np.pi * np.clip((hz - 350) / 100, 0, 1)))


def respond(modes: Modes, spectra: Array, sources: list[int], period: int) -> Array:
    """Accelerations (19, period) to force spectra (sources, lines)."""
    hz = np.fft.rfftfreq(period, 1 / RATE)
    out = np.zeros((len(DOFS), hz.size), complex)
    live = int(np.searchsorted(hz, 450))
    w, wr = 2 * np.pi * hz[:live], 2 * np.pi * modes.hz[:KEPT, None]
    shapes = modes.shapes[:, :KEPT]
    for first in range(0, live, 8192):
        part = slice(first, min(first + 8192, live))
        gain = -(w[part] ** 2) / (wr**2 - w[part] ** 2 + 2j * DAMPING * wr * w[part])
        out[:, part] = shapes @ (gain * (shapes[sources].T @ spectra[:, part]))
    return np.fft.irfft(out, period)


def traces(acceleration: Array, force: Array | None, corner: int, noise: float, rng: np.random.Generator) -> list[Trace]:
    """One channel a DOF, the force first."""
    out = []
    if force is not None:
        out.append(Trace(f"force {corner}", corner, 3, "force", "N", force + noise / 5 * force.std() * rng.standard_normal(force.size)))
    for label, row in zip(DOFS, acceleration, strict=True):
        node, axis = label.split("+")
        noisy = row + noise * row.std() * rng.standard_normal(row.size)
        out.append(Trace(f"accelerometer {label}", int(node), _AXES[axis], "acceleration", "m/s^2", noisy))
    return out


def hammer_record(modes: Modes, corner: int, noise: float, seed: int, hits: int = 1) -> bytes:
    """Pulses at a corner, each with 5 s to itself."""
    period = (PERIOD_SECONDS + hits * HAMMER_SECONDS) * RATE
    hz = np.fft.rfftfreq(period, 1 / RATE)
    x = 2 * hz * WIDTH
    x = np.where(np.abs(x - 1) < 1e-9, 1 + 1e-9, x)
    pulse = (
        2
        * PEAK
        * WIDTH
        / np.pi
        * np.cos(np.pi * x / 2)
        / (1 - x**2)
        * sum(np.exp(-2j * np.pi * hz * (START + WIDTH / 2 + hit * HAMMER_SECONDS)) for hit in range(hits))
    )
    spectrum = (pulse * filtered(hz) * RATE)[None]
    samples = hits * HAMMER_SECONDS * RATE
    acceleration = respond(modes, spectrum, [DOFS.index(f"{corner}+Z")], period)[:, :samples]
    force = np.fft.irfft(spectrum[0], period)[:samples]
    return time_record(traces(acceleration, force, corner, noise, np.random.default_rng(seed)), RATE, f"hammer at {corner}", DATE)


def operating_record(modes: Modes, noise: float, seed: int, seconds: int = OPERATING_SECONDS) -> bytes:
    """White forces of 10 N rms at the four corners, not recorded."""
    rng = np.random.default_rng(seed)
    period = (seconds + 20) * RATE
    hz = np.fft.rfftfreq(period, 1 / RATE)
    spectra = np.fft.rfft(10 * rng.standard_normal((len(CORNERS), period))) * filtered(hz)
    acceleration = respond(modes, spectra, [DOFS.index(f"{c}+Z") for c in CORNERS], period)[:, : seconds * RATE]
    return time_record(traces(acceleration, None, 0, noise, rng), RATE, "white forces at the corners", DATE)


def write_case(
    folder: Path,
    idle: Modes,
    target: Modes,
    name: str,
    epsilon: float,
    noise: float = 0.0,
    hits: int = 1,
    seed: int = 1,
    band: tuple[float, float] = BAND,
) -> Path:
    """Writes the test of one case and returns its test file."""
    from operando.data import FrequencyAxis, Frf
    from operando.dof import Dof
    from operando.io import write_uff

    for sub in ("idle", "operating", "check"):
        (folder / sub).mkdir(parents=True, exist_ok=True)
    for i, corner in enumerate(CORNERS):
        (folder / "idle" / f"hammer{corner}.uff").write_bytes(hammer_record(idle, corner, noise, 100 * seed + i, hits))
    (folder / "operating" / "run1.uff").write_bytes(operating_record(target, noise, 100 * seed + 50))
    sources = (A, ORIGIN)
    exact = frf(target, CHECK_LINES, [DOFS.index(f"{s}+Z") for s in sources])
    responses, references = tuple(Dof.parse(d) for d in DOFS), tuple(Dof.parse(f"{s}+Z") for s in sources)
    write_uff(folder / "check" / "exact.uff", Frf(exact, FrequencyAxis(CHECK_LINES), responses, references))
    nodes = {node: (x, y, 0.0) for node, (x, y) in POINTS.items()} | {MASS_NODE: (0.3, 0.5, 0.15)}
    edge = list(POINTS)
    triangles = [(MASS_NODE, a, b) for a, b in zip(edge, [*edge[1:], edge[0]], strict=True)]
    (folder / "geometry.uff").write_bytes(geometry(nodes, triangles, []))
    test = folder / "test.toml"
    test.write_text(
        f'name = "plate, tripod and mass, {name}"\n\n'
        '[idle]                         # one hammer pulse at each corner, 5 s\nrecords = ["idle/*.uff"]\n\n'
        '[operating]                    # white forces at the corners, unknown\nrecords = ["operating/*.uff"]\n\n'
        '[check]                        # exact FRFs from A and O\nfrfs = ["check/*.uff"]\n\n'
        '[geometry]\nfile = "geometry.uff"\nunits = "m"\n\n'
        f"[analysis]\nband = [{band[0]}, {band[1]}]            # Hz\nthreshold = {epsilon}\n"
    )
    return test
