"""The raw files of one case through operando, judged by the exact FRFs of the target."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import recordings
from exact import EPSILON, KEPT, LINES, OUTPUTS, accelerance, error_db
from tripod import DOFS, ORIGIN, A, Modes

from operando.data import Frf
from operando.indicators import mac
from operando.pipeline import run
from operando.results import Results

Array = np.ndarray

SOURCES = (f"{A}+Z", f"{ORIGIN}+Z")
BANDS = {"6–172 Hz": recordings.BAND, "6–222 Hz": (6.0, 222.0)}
"""The paper's band of the EMA, and one that holds all operational modes of its Table A3."""


@dataclass(frozen=True)
class RawStudy:
    """One case from raw files.

    Parameters
    ----------
    case : str
    band : (float, float)
    results : Results
    errors : dict
        Input → method → rms dB (mean over the outputs B, C, D, mass).
    found : dict
        ``idle`` and ``operating`` → for each exact mode within 6–222 Hz (index in the exact modes, its row in the model or −1, MAC).
    seconds : float
    """

    case: str
    band: tuple[float, float]
    results: Results
    errors: dict[str, dict[str, float]]
    found: dict[str, list[tuple[int, int, float]]]
    seconds: float

    @property
    def paper_method(self) -> str:
        """The paper used the swapped root over all modes (Eq 20); with more modes than DOFs it does not exist."""
        return "eq20" if "eq20" in self.results.hybrid.alternative_models else "eq15"


def exact_frf(modes: Modes, source: str) -> Array:
    """Exact accelerance of the four outputs."""
    return accelerance(modes.hz[:KEPT], modes.shapes[:, :KEPT], LINES, source=source)


def match(exact: Modes, hz: Array, shapes: Array) -> list[tuple[int, int, float]]:
    """The identified mode behind each exact one: the best MAC within 2 %."""
    out = []
    for i in np.flatnonzero((exact.hz > 6) & (exact.hz < 222)):
        near = np.flatnonzero(np.abs(hz / exact.hz[i] - 1) < 0.02)
        alike = np.asarray(mac(exact.shapes[:, [i]], shapes[:, near]))[0] if near.size else np.zeros(0)
        k = int(np.argmax(alike)) if near.size else -1
        out.append((int(i), int(near[k]), float(alike[k])) if near.size and alike[k] > 0.5 else (int(i), -1, 0.0))
    return out


def study(
    folder: Path, idle: Modes, target: Modes, case: str, band: tuple[float, float], say: Callable[[str], None], noise: float = 0.0
) -> RawStudy:
    """Writes the raw files of a case, runs operando on them and judges the OFRFs."""
    start = time.perf_counter()
    test = recordings.write_case(folder, idle, target, case, EPSILON[case], noise, band=band)
    results = run(
        test, folder / "results", until="compare", progress=lambda stage, text: say(f"{case}, {band[0]:g}–{band[1]:g} Hz: {stage}: {text}")
    )
    errors = {}
    for source in SOURCES:
        reference = exact_frf(target, source)
        errors[source] = {
            name: error_db(model.frf(LINES, OUTPUTS, (source,), variance=False).data[:, 0], reference)
            for name, model in results.hybrid.alternative_models.items()
        }
        errors[source]["auto"] = errors[source][results.hybrid.method]
    found = {}
    for name, modes, model in (("idle", idle, results.idle), ("operating", target, results.operating)):
        rows = [[str(d) for d in model.dofs].index(label) for label in DOFS]
        found[name] = match(modes, model.frequencies_hz, np.asarray(model.shapes)[rows])
    return RawStudy(case, band, results, errors, found, time.perf_counter() - start)


def coverage(study_: RawStudy, target: Modes) -> tuple[float, float]:
    """Share of lines (outputs B, C, D, mass; inputs A and O) whose 95 % band holds the exact FRF, and the median half width [dB]."""
    inside, width = [], []
    for source in SOURCES:
        frf: Frf = study_.results.hybrid.frf(LINES, OUTPUTS, (source,))
        limit = np.sqrt(-np.log(0.05) * frf.variance[:, 0])
        inside.append(np.abs(frf.data[:, 0] - exact_frf(target, source)) < limit)
        width.append(20 * np.log10(1 + limit / np.abs(frf.data[:, 0])))
    return float(np.mean(inside)), float(np.median(width))
