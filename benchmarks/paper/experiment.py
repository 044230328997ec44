"""The plate on legs measured, identified twice from different FRFs, and its operational FRFs: in kind with Section 4.2 of the paper.

Simulated throughout. At rest a hammer strikes three DOFs for the EMA result A and three others for B, four times each. In operation an
exciter pushes at a seventh place with a force that is not recorded. The paper had nothing to hold its OFRFs against but each other; here
the exact ones are known, so both are shown: how far the OFRFs from A and from B differ, and how far each is off.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import legs
import numpy as np
from legs import DOFS, State
from recordings import DATE, Trace, time_record

from operando.data import ModalModel
from operando.scaling import HybridModel

Array = np.ndarray

RATE, BAND = 1280, (30.0, 460.0)
THRESHOLD = 0.8
"""ε of the paper's experiment."""
DAMPING = 0.008
SELECTIONS = {"A": ("1+Z", "6+Z", "12+X"), "B": ("9+Z", "4+Z", "12+Y")}
"""DOFs struck for each EMA result."""
HITS, HIT_SECONDS, OPERATING_SECONDS = 4, 4, 150
NOISE, FORCE_NOISE = 0.005, 0.001
LINES = np.arange(60, 901) / 2
OUTPUTS = tuple(label for label in DOFS if label.endswith("Z"))
INPUTS = ("1+Z", "6+Z", "9+Z", "4+Z")
"""OFRFs that are judged: normal to the plate, from the four places struck normal to it."""


@dataclass(frozen=True)
class Experiment:
    """The study.

    Parameters
    ----------
    at_rest, running : State
        Exact.
    idle : dict of ModalModel
        EMA result by its name.
    operating : ModalModel
    hybrid : dict of HybridModel
        By the name of the EMA result.
    errors : dict
        Method → name of the EMA result → rms dB against the exact OFRFs (``OUTPUTS`` from ``INPUTS``); and "between", rms dB of the
        OFRFs from A against those from B.
    inside : dict
        Name → share of lines whose 95 % band holds the exact OFRF; "between" → whose difference is within both bands together.
    seconds : float
    """

    at_rest: State
    running: State
    idle: dict[str, ModalModel]
    operating: ModalModel
    hybrid: dict[str, HybridModel]
    errors: dict[str, dict[str, float]]
    inside: dict[str, float]
    seconds: float


def frf(state: State, lines: Array, inputs: tuple[str, ...]) -> Array:
    """Exact accelerance (14, inputs, lines)."""
    w, own = 2 * np.pi * lines, 2 * np.pi * state.hz[:, None]
    gain = -(w**2) / (own**2 - w**2 + 2j * DAMPING * own * w)
    return np.einsum("ok,sk,kl->osl", state.shapes, state.shapes[[DOFS.index(i) for i in inputs]], gain, optimize=True)


def respond(state: State, at: Array, force: Array) -> Array:
    """Accelerations (14, samples) to a force (samples,) acting on modes by ``at`` (n,), periodic in the samples."""
    hz = np.fft.rfftfreq(force.size, 1 / RATE)
    spectrum = np.fft.rfft(force)
    w, own = 2 * np.pi * hz, 2 * np.pi * state.hz
    out = np.zeros((len(DOFS), hz.size), complex)
    for shape, value, omega in zip(state.shapes.T, at, own, strict=True):
        out += shape[:, None] * (-(w**2) / (omega**2 - w**2 + 2j * DAMPING * omega * w) * spectrum * value)
    return np.fft.irfft(out, force.size)


def anti_alias(force: Array) -> Array:
    """The force without what lies above 600 Hz; whole to 480 Hz."""
    hz = np.fft.rfftfreq(force.size, 1 / RATE)
    return np.fft.irfft(np.fft.rfft(force) * 0.5 * (1 + np.cos(np.pi * np.clip((hz - 480) / 120, 0, 1))), force.size)


def channel(label: str, quantity: str, samples: Array, noise: float, rng: np.random.Generator) -> Trace:
    """One noisy channel at a DOF."""
    node, axis = label.split("+")
    noisy = samples + noise * samples.std() * rng.standard_normal(samples.size)
    return Trace(f"{quantity} {label}", int(node), "XYZ".index(axis) + 1, quantity, "N" if quantity == "force" else "m/s^2", noisy)


def hammer_record(state: State, struck: str, rng: np.random.Generator) -> bytes:
    """Strikes of 1.5 ms at a DOF, 4 s apart, not all alike."""
    samples = HITS * HIT_SECONDS * RATE
    t = np.arange(samples + 4 * RATE) / RATE
    force = np.zeros(t.size)
    for hit in range(HITS):
        phase = (t - 0.2 - hit * HIT_SECONDS - rng.uniform(0, 0.01)) / 0.0015
        force += rng.uniform(60, 120) * np.sin(np.pi * np.clip(phase, 0, 1)) ** 2
    force = anti_alias(force)
    response = respond(state, state.shapes[DOFS.index(struck)], force)[:, :samples]
    traces = [channel(struck, "force", force[:samples], FORCE_NOISE, rng)]
    traces += [channel(label, "acceleration", row, NOISE, rng) for label, row in zip(DOFS, response, strict=True)]
    return time_record(traces, RATE, f"hammer at {struck}", DATE)


def operating_record(state: State, rng: np.random.Generator) -> bytes:
    """The exciter's unknown white force of 10 N rms."""
    samples = OPERATING_SECONDS * RATE
    force = anti_alias(10 * rng.standard_normal(samples + 10 * RATE))
    response = respond(state, state.exciter, force)[:, :samples]
    traces = [channel(label, "acceleration", row, NOISE, rng) for label, row in zip(DOFS, response, strict=True)]
    return time_record(traces, RATE, "exciter", DATE)


def write_records(folder: Path, at_rest: State, running: State, seed: int = 1) -> tuple[dict[str, list[Path]], Path]:
    """Writes the raw files; paths of the hammer runs of each selection, and of the operating run."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([42, seed])
    runs: dict[str, list[Path]] = {}
    for name, struck in SELECTIONS.items():
        for label in struck:
            path = folder / f"hammer-{label.replace('+', '')}.uff"
            path.write_bytes(hammer_record(at_rest, label, rng))
            runs.setdefault(name, []).append(path)
    path = folder / "operating.uff"
    path.write_bytes(operating_record(running, rng))
    return runs, path


def study(folder: Path, say: Callable[[str], None], seed: int = 1) -> Experiment:
    """Writes the raw files, identifies A, B and the running state from them, and judges the OFRFs."""
    from operando.ema import fit_ema
    from operando.frf import estimate_frf
    from operando.io import read
    from operando.oma import fit_oma
    from operando.scaling import scale_operational

    start = time.perf_counter()
    at_rest, running = legs.state(legs.AT_REST), legs.state(legs.RUNNING)
    runs, operating_run = write_records(folder, at_rest, running, seed)
    idle = {}
    for name, paths in runs.items():
        records = [record for path in paths for record in read(path).records]
        idle[name] = fit_ema(estimate_frf(records), band=BAND, records=records)
        say(f"plate on legs: EMA {name} from {', '.join(SELECTIONS[name])}")
    operating = fit_oma(read(operating_run).records[0], band=BAND)
    say("plate on legs: OMA")
    hybrid = {name: scale_operational(model, operating, THRESHOLD) for name, model in idle.items()}
    errors, inside = judge(hybrid, running)
    return Experiment(at_rest, running, idle, operating, hybrid, errors, inside, time.perf_counter() - start)


def judge(hybrid: dict[str, HybridModel], running: State) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Errors of each method and coverage of the bands, as in :class:`Experiment`."""
    rows = [DOFS.index(label) for label in OUTPUTS]
    exact = frf(running, LINES, INPUTS)[rows]
    decibel = lambda a, b: float(np.sqrt(np.mean((20 * np.log10(np.abs(a) / np.abs(b))) ** 2)))  # noqa: E731
    errors = {}
    for method in ("auto", *hybrid["A"].alternative_models):
        models = {k: h.modal if method == "auto" else h.alternative_models.get(method) for k, h in hybrid.items()}
        if any(m is None for m in models.values()):
            continue
        made = {k: m.frf(LINES, OUTPUTS, INPUTS, variance=False).data for k, m in models.items()}
        errors[method] = {k: decibel(v, exact) for k, v in made.items()} | {"between": decibel(made["A"], made["B"])}
    full = {k: h.frf(LINES, OUTPUTS, INPUTS) for k, h in hybrid.items()}
    within = lambda difference, variance: float(np.mean(np.abs(difference) ** 2 < -np.log(0.05) * variance))  # noqa: E731
    inside = {k: within(v.data - exact, v.variance) for k, v in full.items()}
    # The OMA is common to both, so its part of the variances counts too much here: a bound, not a test of size.
    inside["between"] = within(full["A"].data - full["B"].data, full["A"].variance + full["B"].variance)
    return errors, inside
