"""Periodic multisine at three levels on a structure with one joint that softens. Shares no code with operando.

The joint's spring k, part of the linear structure, gives k·d·tanh(x/d): what it lacks, f(x) = k(d·tanh(x/d) − x), acts as one more force
−bf(x) on the linear structure. The motion under f is integrated with the poles of the modal model by an exponential Adams–Bashforth rule
(Hochbruck & Ostermann, Acta Numerica 2010, 2.7) over some periods, until f repeats itself; its response at the sensors is then exact,
line by line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from frf_kinds import sensors_for
from lab_records import RATES, anti_alias, draw_logger, lines, respond
from lab_structures import Structure, draw
from lab_truth import answer, visible
from record_kinds import finish
from scipy import fft

PERIOD = 4096  # samples
FINE = 8  # steps of the integration a sample
LEAD = 4  # periods until the motion repeats itself


@dataclass(frozen=True)
class Joint:
    """A softening spring along a modal row (kept,): stiffness [N/m] and the knee d [m]."""

    row: np.ndarray
    stiffness: float
    knee: float

    def force(self, x: np.ndarray) -> np.ndarray:
        """What tanh lacks of the linear spring."""
        return self.stiffness * (self.knee * np.tanh(x / self.knee) - x)


def steady_force(structure: Structure, joint: Joint, motion: np.ndarray, rate: float) -> tuple[np.ndarray, float]:
    """Joint force (levels, fine samples) over one period, and the relative change from the period before.

    ``motion`` (levels, fine samples) is the displacement at the joint over a period without its softening, ``rate`` the fine one.
    """
    i = structure.modal.oscillating
    poles = structure.modal.poles[i]
    vectors = joint.row @ structure.modal.vectors[:, i]
    push = (vectors * -vectors)[:, None]  # at the joint, by its own force
    step = 1 / rate
    e = np.exp(poles * step)[:, None]
    g1 = ((e[:, 0] - 1) / poles / step)[:, None]
    g2 = ((e[:, 0] - 1 - poles * step) / (poles * step) ** 2)[:, None]
    now_part, before_part = step * (g1 + g2) * push, -step * g2 * push
    levels, samples = motion.shape
    state = np.zeros((poles.size, levels), complex)
    force, previous = np.zeros((2, samples, levels)), np.zeros(levels)
    columns = np.ascontiguousarray(motion.T)
    for period in range(LEAD + 1):
        into = force[period % 2]
        for k in range(samples):
            now = joint.force(columns[k] + 2 * state.real.sum(axis=0))
            into[k] = now
            state = e * state + now_part * now + before_part * previous
            previous = now
    last, older = force[LEAD % 2], force[(LEAD + 1) % 2]
    return last.T, float(np.abs(last - older).max() / max(np.abs(last).max(), 1e-300))


def lines_driven(rng: np.random.Generator, hz: np.ndarray, band: tuple[float, float]) -> tuple[np.ndarray, str]:
    """Which lines carry force: all in band and a little around, odd ones, or odd ones with one in four left out at random."""
    inside = (hz > 0.7 * band[0]) & (hz < 1.05 * band[1])
    kind = str(rng.choice(["full", "odd", "odd with gaps"]))
    odd = np.arange(hz.size) % 2 == 1
    if kind != "full":
        inside &= odd
    if kind == "odd with gaps":
        inside &= rng.uniform(size=hz.size) > 0.25
    return inside, kind


def multisine(rng: np.random.Generator, folder: Path) -> dict[str, object]:
    """Six to nine periods at each of three levels (1 : 2 : 4), a sensor at the force, a few others; one file a level."""
    rate = float(rng.choice(RATES))
    top = 0.39 * rate * rng.uniform(0.5, 0.9)
    structure = draw(rng, 24, line=2 * rate / PERIOD, top=top, modes=(6, 10))
    # A spring to ground that softens would let a structure on soft bands run away.
    while structure.modal.hz[0] < 0.5 * structure.band[0]:
        structure = draw(rng, 24, line=2 * rate / PERIOD, top=top, modes=(6, 10))
    modal = structure.modal
    sensors = sensors_for(rng, structure, int(rng.integers(4, 11)))
    driven = sensors[0]
    logger = draw_logger(rng, rate)
    hz = lines(PERIOD, rate)
    inside, kind = lines_driven(rng, hz, structure.band)
    inputs, outputs = structure.rows([driven]), structure.rows(sensors)
    spectrum = np.where(inside, np.exp(2j * np.pi * rng.uniform(size=hz.size)), 0) * anti_alias(hz, rate)
    spectrum *= PERIOD / np.sqrt(2 * np.sum(np.abs(spectrum) ** 2))  # rms 1 N
    levels = rng.uniform(4, 15) * np.array([1.0, 2.0, 4.0])
    still = np.zeros(len(modal.oscillating))
    fine_hz = lines(PERIOD * FINE, rate * FINE)
    fine = np.zeros(fine_hz.size, complex)
    fine[: hz.size] = spectrum * FINE
    joint = draw_joint(rng, structure, inputs, fine, fine_hz, levels)
    place = respond(structure, joint.row[None], inputs, fine[None], fine_hz, rate * FINE, still)[0]
    away = np.where(fine_hz > 0, -1 / np.maximum(2 * np.pi * fine_hz, 1e-9) ** 2, 0)
    motion = levels[:, None] * fft.irfft(place * away, PERIOD * FINE)[None]
    force, change = steady_force(structure, joint, motion, rate * FINE)
    periods = int(rng.integers(6, 10))
    sensitivity = logger.sensitivities(rng, len(sensors), hz)
    runs = []
    for level, back in zip(levels, force, strict=True):
        added = fft.rfft(-back)[: hz.size] / FINE * anti_alias(hz, rate)
        both = np.array([level * spectrum, added])
        spectra = sensitivity * respond(structure, outputs, np.vstack([inputs, joint.row[None]]), both, hz, rate, still)
        runs.append((level * fft.irfft(spectrum, PERIOD), fft.irfft(spectra, PERIOD)))
    files = {}
    for n, (drive, response) in enumerate(runs, start=1):
        scales = np.abs(drive).max(), np.abs(response).max()  # the range is set anew at each level
        measured = [(driven, logger.add(rng, np.tile(drive, periods), scales[0]))]
        responses = [(p, logger.add(rng, np.tile(x, periods), scales[1])) for p, x in zip(sensors, response, strict=True)]
        files[f"idle/level{n}.uff"] = logger.write(measured, responses, f"level {n}")
    finish(folder, structure, '[idle]\nrecords = ["idle/*.uff"]\n', files)
    shift = softening(structure, joint, float(motion[2].std()))
    told = {"logger": logger.told(), "lines": kind, "periods": periods, "levels_rms_n": levels.tolist(), "last_period_change": change}
    told |= {"joint": {"stiffness": joint.stiffness, "knee": joint.knee, "rms_motion_m": motion.std(axis=1).tolist()}}
    told["shift_at_highest_level"] = [float(f"{v:.3g}") for v in shift[structure.in_band]]
    amount = np.array([modal.contributions(np.full(shift.size, f), outputs, inputs).reshape(shift.size, -1) for f in modal.frequencies])
    floor = logger.noise * np.abs(runs[0][1]).max() * np.sqrt(PERIOD)
    amplitude = levels[0] * np.median(np.abs(spectrum[inside]))
    seen, reasons = visible(amount, np.full((shift.size, amount.shape[2]), floor / amplitude))
    document = answer(structure, sensors, seen, reasons, state="idle", references=[driven.name], scaled=True, faults=told)
    # The linear truth is that of vanishing motion: where the joint moves a mode, an interval around the mode of a level need not hold it.
    for mode in document["modes"]:  # type: ignore[attr-defined]
        r = int(np.argmin(np.abs(modal.frequencies - mode["frequency_hz"])))
        mode["intervals"] = bool(abs(shift[r]) < 1e-5)
    return document


def draw_joint(rng: np.random.Generator, structure: Structure, inputs, fine: np.ndarray, fine_hz: np.ndarray, levels: np.ndarray) -> Joint:
    """A joint at a point that moves: a tenth to a third of the stiffness there, moved by 0.3 to 0.6 knees rms at the highest level."""
    rows = structure.rows(list(structure.points))
    size = np.abs(rows @ structure.modal.shapes[:, structure.in_band]).max(axis=1)
    row = rows[int(rng.choice(np.flatnonzero(size >= np.median(size))))]
    stiffness = rng.uniform(0.1, 0.33) / float(np.sum(row**2 / (2 * np.pi * structure.modal.hz) ** 2))
    still = np.zeros(len(structure.modal.oscillating))
    place = respond(structure, row[None], inputs, fine[None], fine_hz, 2.05 * fine_hz[-1], still)[0]
    away = np.where(fine_hz > 0, -1 / np.maximum(2 * np.pi * fine_hz, 1e-9) ** 2, 0)
    rms = float(fft.irfft(place * away, 2 * (fine_hz.size - 1)).std()) * levels[-1]
    return Joint(row, stiffness, rms / rng.uniform(0.3, 0.6))


def softening(structure: Structure, joint: Joint, rms: float) -> np.ndarray:
    """Relative change of frequency of each pair (first order) by the equivalent stiffness of the softening, −k (rms/d)²."""
    missing = joint.stiffness * min((rms / joint.knee) ** 2, 1.0)
    modal = structure.modal
    row = np.abs(joint.row @ modal.shapes) ** 2
    return -missing * row / 2 / (2 * np.pi * modal.frequencies) ** 2
