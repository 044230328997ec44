"""A test without operating records: its idle model against the validation measurement, mode by mode."""

from __future__ import annotations

from dataclasses import dataclass

from operando.report.derive import comparison_models
from operando.report.text import finite
from operando.results import Results

TITLE = "Idle model against the validation measurement"


@dataclass(frozen=True)
class IdlePeak:
    """One mode of the idle model beside the peak of the validation measurement that the comparison has for it."""

    idle: int | None  # number of the idle mode; None for a peak that no idle mode makes
    frequency_hz: float | None = None  # this and the next three: of the measured peak; None where the comparison has none
    frequency_std_hz: float | None = None
    damping_ratio: float | None = None
    damping_ratio_std: float | None = None
    percent: float | None = None  # its frequency against the idle mode's


def idle_against_check(results: Results) -> bool:
    """Whether a test has an idle model and a validation measurement, nothing from operation, and no stage that failed."""
    failed = any(reason.startswith("failed") for reason in results.left_out.values())
    return bool(results.idle is not None and results.operating is None and results.hybrid is None and results.check and not failed)


def one_state(results: Results) -> bool:
    """Whether modes of one state alone were identified."""
    return (results.idle is None) != (results.operating is None)


def idle_peaks(results: Results) -> list[IdlePeak]:
    """Idle modes by frequency with the peaks of the validation measurement; empty where the comparison has no peaks.

    The comparison states how far a peak of the idle model's FRFs stands from the measured one. That peak is of the mode nearest to it,
    and within its half-power width.
    """
    idle = results.idle
    rows = [row for row in (comparison_models(results).get("idle") or {}).get("by_mode") or [] if finite(row.get("frequency_hz"))]
    if idle is None or not rows:
        return []
    hz, zeta = idle.frequencies_hz, idle.damping_ratios
    peaks: dict[int, IdlePeak] = {}
    alone = []
    for row in rows:
        seen, error = float(row["frequency_hz"]), row.get("frequency_error_percent")
        found = None
        if finite(error) and idle.n_modes:
            model_hz = seen * (1 + float(error) / 100)
            k = int(abs(hz - model_hz).argmin())
            found = k if abs(hz[k] - model_hz) <= 2 * zeta[k] * hz[k] and k not in peaks else None
        percent = None if found is None else 100 * (seen / float(hz[found]) - 1)
        peak = IdlePeak(found, seen, row.get("frequency_std_hz"), row.get("damping_ratio"), row.get("damping_ratio_std"), percent)
        if found is None:
            alone.append(peak)
        else:
            peaks[found] = peak
    known = [peaks.get(k, IdlePeak(k)) for k in range(idle.n_modes)]
    return sorted(known + alone, key=lambda p: float(hz[p.idle]) if p.idle is not None else p.frequency_hz or 0.0)
