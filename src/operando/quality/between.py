"""Checks between files: rates, units and quantities of records, gains and polarities between the FRFs and shapes of two states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.data import Finding, Frf, ModalModel, TimeRecord
from operando.dof import DofIndex
from operando.printable import first_few
from operando.quality.record import check_runs

GAIN_DB = 5.0
"""Median ratio of two FRFs of one pair, on their strongest lines, from which a gain is told. Of 670 pairs of a plate cut, stiffened and
clamped again, and 122 of five structures with a mass, a spring, a clearance or nothing added, none is above 4 dB and as steady as
``STEADY`` asks. The smallest unit taken for another (lbf for N) makes 13 dB, an amplifier step of two 6 dB."""
STEADY = 0.35
"""Largest median deviation of the ratio (dB) from its median, over the median: a changed structure moves resonances, so that its ratio goes
up and down over the band."""
TREND = 0.5
"""A gain is the same at all frequencies: over log f the ratio is no line that has this share of its variance and changes by this part of
its median over the band. 0 to 0.08 of the variance in two chains with a gain of two between them; 0.77 to 0.84, and 0.8 to 2.8 times the
median, in a plate where one hit has a tail over 1/f at one sensor, which medians of −6.7 to −24.5 dB took for a gain."""
STRONG = 0.3
"""Part of the lines that are looked at: those where both FRFs are strongest, each over its own median."""
OPPOSITE = 0.8
"""Share of lines of opposite phase from which a polarity is told: 0.51 to 0.68 were seen over the same pairs, and all lines
are opposite where a sensor is turned."""
MOST = 0.75
"""Share of the responses to one force that must show a gain for it to be the force's."""
LEAST_LINES = 20
"""Lines that two FRFs must share: ``STRONG`` of them are six, so that a median is no matter of one or two lines."""
MOVING = 0.5
"""Rms of an FRF over the largest of its reference above which it tells a gain: at a point that moves little, such as one near a clamp, a
hit some millimetres beside the point makes as much (16 dB in the plate's data)."""
LARGE = 0.3
"""Shape values above this part of the largest tell a gain: smaller ones are noise and small changes of the structure."""
LEAST_MODES = 3
"""Modes that must agree on a gain of one sensor: a change of the structure at a place moves its shape values each in its own way."""
FEW = 1 / 3
"""Largest part of the sensors that may show one: where more do, the structure has changed."""

Array = NDArray[Any]


def check_states(states: Mapping[str, Sequence[TimeRecord]]) -> list[Finding]:
    """Findings about records of one state that do not belong together, and about states that do not.

    Parameters
    ----------
    states : mapping
        Name of the state → its records.
    """
    # Sensors that not every file of a state has are set-ups: those are stated where they are merged.
    out = [f for records in states.values() for f in check_runs(records) if f.kind != "missing_response"]
    rates = {name: sorted({r.sampling_hz for r in records}) for name, records in states.items() if records}
    if len({rate for some in rates.values() for rate in some}) > 1 and all(len(some) == 1 for some in rates.values()):
        text = ", ".join(f"[{name}] {some[0]:g} Hz" for name, some in rates.items())
        lowest = min(some[0] for some in rates.values())
        out.append(
            Finding(
                "unequal_rate",
                f"sampling rates differ between the states: {text}",
                "info",
                consequence=f"what all states share ends at {lowest / 2:g} Hz; if a rate is wrong, so are all frequencies of its state",
                action="compare the rates with those of the measuring system; [units] sampling_hz gives that of tables",
            )
        )
    return [*out, *_check_units([(name, r) for name, records in states.items() for r in records])]


def _check_units(records: Sequence[tuple[str, TimeRecord]]) -> list[Finding]:
    """Sensors whose quantity differs between files, or whose unit is known in some only."""
    seen: dict[tuple[Any, bool], list[tuple[str, str, bool]]] = {}
    for _, record in records:
        for channel in record.channels:
            if channel.dof is not None:
                axis = (channel.dof.key, channel.is_force)
                seen.setdefault(axis, []).append((record.name, channel.quantity, bool(channel.unit)))
    lacking: dict[str, list[str]] = {}
    out = []
    for (axis, force), entries in seen.items():
        label = f"{axis[0]}{axis[1]}"
        quantities = {quantity for _, quantity, known in entries if known}
        if len(quantities) > 1 and not force:
            first = {q: next(name for name, own, _ in entries if own == q) for q in sorted(quantities)}
            out.append(
                Finding(
                    "quantity_differs",
                    f"{label} is {' and '.join(f'{q} in {name}' for q, name in first.items())}",
                    "info",
                    dof=label,
                    consequence="each is brought to acceleration by powers of iω; a wrong label turns and tilts its FRFs",
                    action="check that two different sensors were there, else give the quantity in [channels]",
                )
            )
        if len({known for _, _, known in entries}) > 1:
            for name, _, known in entries:
                if not known:
                    lacking.setdefault(name, []).append(label)
    for name, labels in lacking.items():
        out.append(
            Finding(
                "unit_differs",
                f"no unit is known of {first_few(labels)}, which other files state",
                "warning",
                file=name or None,
                dof=labels[0] if len(labels) == 1 else None,
                consequence="its numbers and those of the other files cannot be compared",
                action="give the unit in [units] or [channels]",
            )
        )
    return out


def check_gains(idle: Frf, check: Frf, name: str = "", band: tuple[float, float] | None = None) -> list[Finding]:
    """Gains and polarities that differ between two states, as their FRFs show them over the whole band.

    Parameters
    ----------
    idle, check : Frf
        Of the same quantity.
    name : str
        Of the check, for the findings.
    band : (float, float), optional
        Lines looked at [Hz].
    """
    if idle.quantity != check.quantity or not (idle.si and check.si):
        return []
    lines, nearest = _shared_lines(idle, check, band)
    rows, columns = DofIndex(idle.responses), DofIndex(idle.references)
    if lines.size < LEAST_LINES:
        return []
    still, now = _moving(idle, lines), _moving(check, nearest)
    out: list[Finding] = []
    by_response: dict[str, list[tuple[float, bool]]] = {}
    whole: set[str] = set()
    for j, reference in enumerate(check.references):
        column = columns.find(reference)
        found: dict[str, tuple[float, bool]] = {}
        for i, response in enumerate(check.responses):
            row = rows.find(response)
            if row is None or column is None or not (still[row[0], column[0]] or now[i, j]):
                continue
            gain = _gain(idle.frequencies_hz[lines], idle.data[row[0], column[0], lines], row[1] * column[1] * check.data[i, j, nearest])
            if gain is not None:
                found[str(response)] = gain
        told = [g for g in found.values() if _told(g)]
        if len(found) > 1 and len(told) >= MOST * len(found) and np.ptp([g[0] for g in told]) < GAIN_DB and len({g[1] for g in told}) == 1:
            out.append(_gain_finding(f"all FRFs of the force at {reference}", str(reference), told, name))
            whole |= set(found)
        else:
            for label, gain in found.items():
                by_response.setdefault(label, []).append(gain)
    for label, gains in by_response.items():
        if all(_told(g) for g in gains) and len({g[1] for g in gains}) == 1:
            out.append(_gain_finding(f"FRFs at {label}", label, gains, name))
    return out


def _shared_lines(idle: Frf, check: Frf, band: tuple[float, float] | None) -> tuple[Array, Array]:
    """Lines of the first within the band and both FRFs, and the nearest of the second to each."""
    f, g = idle.frequencies_hz, check.frequencies_hz
    low, high = band or (0.0, np.inf)
    lines = np.flatnonzero((f > 0) & (f >= max(low, g[0])) & (f <= min(high, g[-1])))
    nearest = np.clip(np.searchsorted(g, f[lines]), 1, max(len(g) - 1, 1))
    nearest = np.where((f[lines] - g[nearest - 1]) < (g[np.minimum(nearest, len(g) - 1)] - f[lines]), nearest - 1, nearest)
    return lines, np.minimum(nearest, len(g) - 1)


def _gain(hz: Array, first: Array, second: Array) -> tuple[float, bool] | None:
    """Median ratio in dB, 0 where it is not steady or has a trend, and whether the phase is opposite; None with too few lines."""
    good = np.isfinite(first) & np.isfinite(second) & (np.abs(first) > 0) & (np.abs(second) > 0)
    if good.sum() < LEAST_LINES:
        return None
    hz, first, second = hz[good], first[good], second[good]
    size = np.minimum(*(np.abs(h) / np.median(np.abs(h)) for h in (first, second)))
    keep = size >= np.quantile(size, 1 - STRONG)
    ratio = second[keep] / first[keep]
    level = 20 * np.log10(np.abs(ratio))
    middle = float(np.median(level))
    steady = float(np.median(np.abs(level - middle))) < STEADY * abs(middle)
    octaves = np.log2(hz[keep])
    slope, _ = np.polyfit(octaves, level, 1)
    tilted = abs(slope) * np.log2(hz[-1] / hz[0]) > TREND * abs(middle) and np.var(level - slope * octaves) < (1 - TREND) * np.var(level)
    return middle if steady and not tilted else 0.0, bool(np.mean(ratio.real < 0) > OPPOSITE)


def _moving(frf: Frf, lines: Array) -> Array:
    """Whether a pair moves at all (n_responses, n_references): its rms over the lines against the largest of its reference."""
    power = np.nan_to_num(np.abs(frf.data[:, :, lines]) ** 2).mean(axis=2)
    return np.asarray(power >= MOVING**2 * np.maximum(power.max(axis=0), 1e-300))


def _told(gain: tuple[float, bool]) -> bool:
    return abs(gain[0]) > GAIN_DB or gain[1]


def _gain_finding(what: str, label: str, gains: Sequence[tuple[float, bool]], name: str) -> Finding:
    level, opposite = float(np.median([g[0] for g in gains])), gains[0][1]
    told = abs(level) > GAIN_DB
    parts = ([f"{10 ** (level / 20):.3g} times the idle ones ({level:+.1f} dB) over the whole band"] if told else []) + (
        ["of opposite sign"] if opposite else []
    )
    return Finding(
        "gain_differs" if told else "inverted",
        f"{what} are {' and '.join(parts)}",
        "warning",
        file=name or None,
        dof=label,
        consequence="a sensitivity, unit or sense that differs between the two states is taken for a change of the structure",
        action="compare sensitivities, units and cables of this channel in both states; correct it in [channels]",
    )


def check_shapes(idle: ModalModel, operating: ModalModel, pairs: Sequence[tuple[int, int]]) -> list[Finding]:
    """Sensors of which one gain or a wrong sense stands in the operational shapes of all modes.

    Parameters
    ----------
    idle, operating : ModalModel
    pairs : sequence of (int, int)
        Idle and operational mode that belong together.
    """
    common = DofIndex(operating.dofs).common(idle.dofs)
    if len(pairs) < LEAST_MODES or len(common) < 4:
        return []
    at_o, at_e = [c[0] for c in common], [c[1] for c in common]
    signs = np.array([c[2] for c in common], float)
    a, b = idle.shapes[at_e][:, [p[0] for p in pairs]], operating.shapes[at_o][:, [p[1] for p in pairs]] * signs[:, None]
    large = np.abs(a) > LARGE * np.max(np.abs(a), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(large, b / a, np.nan)
    if np.any(large.sum(axis=0) < 3):
        return []
    middle = np.nanmedian(ratio.real, axis=0) + 1j * np.nanmedian(ratio.imag, axis=0)
    if np.any(np.abs(middle) == 0):
        return []
    own = (ratio / middle).real
    out = []
    for k, row in enumerate(own):
        values = row[np.isfinite(row)]
        if values.size < LEAST_MODES or len({bool(v < 0) for v in values}) > 1:
            continue
        db = 20 * np.log10(np.maximum(np.abs(values), 1e-12))
        steady = np.ptp(db) < GAIN_DB
        level = float(np.median(db)) if steady and np.min(np.abs(db)) > GAIN_DB / 2 and abs(np.median(db)) > GAIN_DB else 0.0
        if level or (values[0] < 0 and steady):
            out.append(_shape_finding(str(operating.dofs[at_o[k]]), level, bool(values[0] < 0), values.size))
    return out if len(out) <= FEW * len(common) else []


def _shape_finding(label: str, level: float, opposite: bool, modes: int) -> Finding:
    words = [f"{10 ** (level / 20):.3g} times"] * bool(level) + ["of opposite sign to"] * opposite
    return Finding(
        "gain_differs" if level else "inverted",
        f"operational shape values at {label} are {' and '.join(words)} the idle ones in all {modes} modes that move it",
        "warning",
        dof=label,
        consequence="a sensitivity, unit or sense that differs between idle and operating files makes wrong operational FRFs there",
        action="compare sensitivity, unit and cable of this channel in both states; correct it in [channels]",
    )
