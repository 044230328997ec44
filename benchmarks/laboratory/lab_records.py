"""Raw records: forces, exact responses, what loggers add. Shares no code with operando.

Forces are limited to the band of the logger's filter and periodic over more than the record (a hit: silence for the rest of the period);
the response is H·F on each line of that period, the exact steady answer, and the record is a section of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lab_structures import Point, Structure
from scipy import fft

from lab_files import DATE, GRAVITY, Trace, time_record  # isort: skip

# Samples a second. Their steps have at most six digits, which is what the header of a 58 set keeps.
RATES = (250.0, 320.0, 400.0, 500.0, 800.0, 1000.0, 1250.0, 1600.0, 2000.0, 2500.0, 3200.0, 4000.0)


def anti_alias(hz: np.ndarray, rate: float) -> np.ndarray:
    """Gain of the logger's filter: 1 to 0.39 of the rate (as 2.56 samples a period leave), a raised cosine to 0 at 0.49."""
    return 0.5 * (1 + np.cos(np.pi * np.clip((hz / rate - 0.39) / 0.10, 0, 1)))


def half_sine(hz: np.ndarray, peak: float, width: float, start: float) -> np.ndarray:
    """Fourier integral of a half-sine pulse of a given peak [N] and width [s] that begins at ``start`` [s]."""
    x = 2 * hz * width
    safe = np.where(np.abs(x - 1) < 1e-9, 1 + 1e-9, x)
    return 2 * peak * width / np.pi * np.cos(np.pi * safe / 2) / (1 - safe**2) * np.exp(-2j * np.pi * hz * (start + width / 2))


def coloured(rng: np.random.Generator, hz: np.ndarray, shape: np.ndarray, rms: float, period: int) -> np.ndarray:
    """Spectrum of a stationary random force with an amplitude spectrum of this shape and this rms [N]."""
    values = (rng.standard_normal(hz.size) + 1j * rng.standard_normal(hz.size)) * shape
    values[0] = values[-1] = 0
    return values * rms * period / np.sqrt(2 * np.sum(np.abs(values) ** 2))


@dataclass
class Logger:
    """A logger and its sensors: what it adds to true signals.

    ``noise`` is the rms of white noise as a share of the range, ``hum`` the amplitude of 50 Hz as a multiple of it, ``offset`` a constant
    as a share of the range, ``gain`` the standard deviation of the sensitivities, ``rise`` that of the mounted resonance at the last line.
    The range of a channel is the largest value of that kind in the test.
    """

    rate: float
    unit: str
    noise: float
    hum: float = 0.0
    offset: float = 0.0
    gain: float = 0.0
    rise: float = 0.0

    def told(self) -> dict[str, object]:
        return dict(vars(self))

    def add(self, rng: np.random.Generator, signal: np.ndarray, scale: float) -> np.ndarray:
        """A channel (samples,) as recorded."""
        time = np.arange(signal.size) / self.rate
        out = signal + self.noise * scale * rng.standard_normal(signal.size) + self.offset * scale * rng.standard_normal()
        if self.hum:
            for k in (1, 2, 3, 5):
                if 50 * k < 0.45 * self.rate:
                    size = self.hum * self.noise * scale / k * np.exp(0.4 * rng.standard_normal())
                    out = out + size * np.sin(2 * np.pi * (50 * k * time + rng.uniform()))
        return out

    def sensitivities(self, rng: np.random.Generator, count: int, hz: np.ndarray) -> np.ndarray:
        """Complex gains (count, lines) of so many accelerometers."""
        static = 1 + self.gain * rng.standard_normal((count, 1))
        if not self.rise:
            return static * np.ones(hz.size)
        rise = self.rise * rng.uniform(0.6, 1.0, (count, 1))
        s = hz * np.sqrt(rise / (1 + rise)) / (0.39 * self.rate)
        return static / (1 - s**2 + 0.04j * s)

    def write(self, forces: list[tuple[Point, np.ndarray]], responses: list[tuple[Point, np.ndarray]], name: str) -> bytes:
        """One file: force channels first, then accelerometers in the unit of the logger."""
        traces = [Trace(f"force {p.name}", p.label, p.direction, "force", "N", x) for p, x in forces]
        scale = GRAVITY if self.unit == "g" else 1.0
        traces += [Trace(f"acceleration {p.name}", p.label, p.direction, "acceleration", self.unit, x / scale) for p, x in responses]
        return time_record(traces, self.rate, name, DATE)


def draw_logger(rng: np.random.Generator, rate: float) -> Logger:
    """A logger with a plausible mixture of faults."""
    logger = Logger(rate, str(rng.choice(["m/s2", "g"])), 10 ** -rng.uniform(3.3, 4.5))
    if rng.uniform() < 0.5:
        logger.hum = rng.uniform(0.5, 5.0)
    if rng.uniform() < 0.5:
        logger.offset = rng.uniform(0.0005, 0.005)
    if rng.uniform() < 0.8:
        logger.gain, logger.rise = rng.uniform(0.005, 0.015), rng.uniform(0.02, 0.03)
    return logger


def lines(period: int, rate: float) -> np.ndarray:
    return fft.rfftfreq(period, 1 / rate)


def even_length(samples: int) -> int:
    """The next length that a transform likes, even."""
    period = int(fft.next_fast_len(samples, real=True))
    while period % 2:
        period = int(fft.next_fast_len(period + 1, real=True))
    return period


def respond(
    structure: Structure, outputs: np.ndarray, inputs: np.ndarray, forces: np.ndarray, hz: np.ndarray, rate: float, relative: np.ndarray
) -> np.ndarray:
    """Acceleration spectra (outputs, lines) under force spectra (inputs, lines), the modes moved by ``relative`` (pairs,)."""
    wanted = np.flatnonzero(hz < 0.49 * rate)
    poles = structure.modal.shifted(relative)
    o, i = outputs @ structure.modal.vectors, inputs @ structure.modal.vectors
    out = np.zeros((len(outputs), hz.size), complex)
    for part in np.array_split(wanted, max(1, wanted.size // 8000)):
        s = 2j * np.pi * hz[part]
        out[:, part] = o @ ((i.T @ forces[:, part]) * (s**2 / (s - poles[:, None])))
    return out
