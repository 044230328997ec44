"""Whether the names and frequencies in the test file are in the data it names, asked before any long stage."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from operando.config import Test
from operando.data import Finding, Geometry
from operando.dof import Dof, split_node
from operando.errors import ConfigError, OperandoError
from operando.limits import LEAST_LINES, LOWER, UPPER
from operando.printable import first_few
from operando.values import nearest

HAND_NAMED = ("modes_hz", "select_hz", "reject_hz")
FREQUENCIES = {**dict.fromkeys(HAND_NAMED, "idle"), **dict.fromkeys(("known_harmonics_hz", "oma_select_hz", "oma_reject_hz"), "operating")}
"""Settings that name frequencies, with the state in whose data they lie."""


class UnfitTest(ConfigError):
    """The test file says something that does not fit the data it names: the run ends."""


@dataclass(frozen=True)
class Lines:
    """What a file can resolve: its highest frequency, and lines in a band.

    Parameters
    ----------
    top_hz : float
        Half the sampling rate of records, the last line of FRFs.
    hz : array or None
        Lines of FRFs.
    duration_s : float
        Of records: the finest line spacing is 1/duration.
    """

    top_hz: float
    hz: Any = None
    duration_s: float = 0.0

    @property
    def ends(self) -> str:
        """What ends at ``top_hz``, in words."""
        return "half its sampling rate" if self.hz is None else "its last line"

    def count(self, band: tuple[float, float], without: Sequence[tuple[float, float]] = ()) -> int:
        """Lines within a band and outside others; of a record at most."""
        low, high = max(band[0], 0.0), min(band[1], self.top_hz)
        if high < low:
            return 0
        if self.hz is None:
            step = max(1 / self.duration_s, (high - low) / 100_000)
            hz = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
        else:
            hz = self.hz[(self.hz >= low) & (self.hz <= high)]
        keep = np.ones(hz.size, bool)
        for a, b in without:
            keep &= (hz < a) | (hz > b)
        return int(keep.sum())


@dataclass(frozen=True)
class Names:
    """What a file calls its channels, all DOFs it measures, where its forces act and its responses are, and its lines."""

    labels: frozenset[str]
    dofs: frozenset[Dof]
    forces: frozenset[Dof]
    responses: frozenset[Dof]
    lines: tuple[Lines, ...] = ()


def names_of(content: Any) -> Names:
    """Names of the content of a file."""
    channels = [c for r in content.records for c in r.channels]
    dofs = [d for h in content.frfs for d in (*h.responses, *h.references)]
    labels = {text for c in channels for text in (c.name, c.label) if text} | {str(d) for d in dofs}
    forces = {c.dof for c in channels if c.is_force and c.dof is not None} | {d for h in content.frfs for d in h.references}
    moving = {d for r in content.records for i in r.response_indices if (d := r.channels[i].dof) is not None}
    responses = moving | {d for h in content.frfs for d in h.responses}
    lines = [Lines(r.sampling_hz / 2, duration_s=r.duration_s) for r in content.records]
    lines += [Lines(float(h.frequencies_hz[-1]), h.frequencies_hz) for h in content.frfs]
    measured = {c.dof for c in channels if c.dof is not None} | set(dofs)
    return Names(frozenset(labels), frozenset(measured), frozenset(forces), frozenset(responses), tuple(lines))


def blamed(test: Test, file: Path, units: dict[str, Any] | None, error: OperandoError) -> UnfitTest | None:
    """The error for an entry of [units] or [channels] without which a file can be read; None where the file itself is at fault."""
    from operando.io import read
    from operando.io.quantities import Asked

    def readable(units: Any = None, channels: Any = None) -> bool:
        try:
            read(file, units=units, channels=Asked(channels))
        except OperandoError:
            return False
        return True

    if not (units or test.channels) or not readable():
        return None
    for section, table in (("channels", test.channels), ("units", test.units)):
        for key, value in table.items():
            if not readable(**{section: {key: value}}):
                hint = error.hint or "compare with what `operando inspect` shows without the test file"
                return UnfitTest(f"{error.message} (in {test.label(file)})", where=test.where(section, key), hint=hint)
    return None


def check_names(test: Test, names: Mapping[Path, Names], found: Collection[str]) -> None:
    """Whether every channel, DOF, band and frequency of the test file is in its files; the nearest to one that is not is named.

    Where a file could not be read, and has no names here, names may be in it: frequencies alone are checked then. ``found`` are the entries
    of [channels] that a file had a channel for.
    """
    if all(file in names for file in test.files):
        _check_channels(test, names, found)
        _check_dofs(test, names)
    lines = {name: [(f, line) for f in state.files if f in names for line in names[f].lines] for name, state in test.states.items()}
    _check_bands(test, lines)
    _check_frequencies(test, lines)


def _check_channels(test: Test, names: Mapping[Path, Names], found: Collection[str]) -> None:
    for name in test.channels:
        if name not in found:
            labels = {label for n in names.values() for label in n.labels} | set(found)  # columns without a name are known by those found
            raise _unknown(f"{name!r} names no channel of any file", name, labels, test.where("channels", name))
    known_dofs = {str(dof.unsigned) for n in names.values() for dof in n.dofs}
    for label in test.directions:
        if label not in known_dofs:
            raise _unknown(f"{label!r} is a DOF of no file", label, known_dofs, test.where("directions", label))


def _check_dofs(test: Test, names: Mapping[Path, Names]) -> None:
    of = lambda state, what: {dof for file in state.files for dof in getattr(names[file], what)}  # noqa: E731
    anywhere = {dof for file in test.files for dof in (*names[file].responses, *names[file].forces)}
    analysis = test.analysis
    for key, wanted, known, lacks in (
        ("references", analysis.references, of(test.idle, "forces"), "no idle force acts at"),
        ("oma_references", analysis.oma_references, of(test.operating, "responses"), "no operating record has a sensor at"),
        ("places", analysis.places, anywhere, "no file has a channel at"),
    ):
        axes = {d.key for d in known}
        for dof in map(Dof.parse, wanted or ()):
            if axes and dof.key not in axes:
                raise _unknown(f"{lacks} {dof}", str(dof), {str(d) for d in known}, test.where("analysis", key))


def _check_bands(test: Test, lines: Mapping[str, list[tuple[Path, Lines]]]) -> None:
    every = [item for items in lines.values() for item in items]
    if not every:
        return
    lowest, least = min(every, key=lambda item: item[1].top_hz)
    analysis = test.analysis
    bands = [("band", analysis.band)] if analysis.band is not None else []
    for key, band in [*bands, *(("exclude_bands", band) for band in analysis.exclude_bands)]:
        spacing = 0.0 if least.hz is None or len(least.hz) < 2 else float(least.hz[-1] - least.hz[-2])
        if band[1] > least.top_hz + spacing:
            text = f"{band[1]:g} Hz is beyond {least.top_hz:g} Hz, {least.ends} ({test.label(lowest)})"
            within = f"[{band[0]:g}, {least.top_hz:g}]"
            hint = f"did you mean {within}?" if band[0] < least.top_hz else "bands are in Hz"
            raise UnfitTest(text, where=test.where("analysis", key), hint=hint)
    for name, items in lines.items():
        if not items or (analysis.band is None and not analysis.exclude_bands):
            continue
        band = analysis.band or (0.0, max(line.top_hz for _, line in items))
        whole = max(line.count(band) for _, line in items)
        if whole < LEAST_LINES:
            raise UnfitTest(
                f"the band of {band[0]:g} to {band[1]:g} Hz holds {whole} lines of [{name}], expected at least {LEAST_LINES}",
                where=test.where("analysis", "band"),
                hint=_in_khz(band, [line for _, line in items]) or "widen the band, or measure for longer",
            )
        left = max(line.count(band, analysis.exclude_bands) for _, line in items)
        if left < LEAST_LINES:
            raise UnfitTest(
                f"they leave {left} lines of [{name}] in the band of {band[0]:g} to {band[1]:g} Hz, expected at least {LEAST_LINES}",
                where=test.where("analysis", "exclude_bands"),
                hint="exclude narrower bands",
            )


def _in_khz(band: tuple[float, float], lines: Sequence[Lines]) -> str | None:
    """What to say where the band would fit the data if it were in kHz."""
    hz = (1e3 * band[0], 1e3 * band[1])
    fits = all(hz[1] <= line.top_hz for line in lines) and max(line.count(hz) for line in lines) >= LEAST_LINES
    return f"bands are in Hz, not kHz: did you mean [{hz[0]:g}, {hz[1]:g}]?" if fits else None


def _check_frequencies(test: Test, lines: Mapping[str, list[tuple[Path, Lines]]]) -> None:
    for key, state in FREQUENCIES.items():
        items = lines[state]
        for hz in getattr(test.analysis, key) if items else ():
            file, line = max(items, key=lambda item: item[1].top_hz)
            where = test.where("analysis", key)
            if hz > line.top_hz:
                text = f"{hz:g} Hz is beyond {line.top_hz:g} Hz, {line.ends} ({test.label(file)})"
                raise UnfitTest(text, where=where, hint="frequencies are in Hz")
            band = test.analysis.band
            if key in HAND_NAMED and band is not None and not LOWER * band[0] <= hz <= UPPER * band[1]:
                hint = "widen the band, or leave the frequency out"
                raise UnfitTest(f"{hz:g} Hz is outside the band of {band[0]:g} to {band[1]:g} Hz", where=where, hint=hint)


def check_geometry(test: Test, geometry: Geometry | None, names: Mapping[Path, Names]) -> list[Finding]:
    """The finding for measured nodes that the geometry lacks."""
    nodes = sorted({dof.node for n in names.values() for dof in n.dofs}, key=split_node)
    if geometry is None or not nodes:
        return []
    there = {int(n) for n in geometry.nodes}
    lacking = [n for n in nodes if n not in there]
    if not lacking:
        return []
    if len(lacking) == len(nodes) and test.geometry_file is not None:
        in_order = sorted(there, key=split_node)
        text = f"{test.label(test.geometry_file)} holds none of the measured nodes ({first_few(nodes, 12)})"
        raise UnfitTest(
            text,
            where=test.where("geometry", "file"),
            hint=f"its nodes are {first_few(in_order, 12)}; node numbers of sensors and geometry must agree",
        )
    return [
        Finding(
            "no_position",
            f"the geometry lacks {len(lacking)} of {len(nodes)} measured nodes: {first_few(lacking, 12)}",
            "warning",
            consequence="they are not drawn, and effects between sensors are not looked for near them",
            action="give their coordinates in the geometry file",
        )
    ]


def _unknown(message: str, name: str, known: Iterable[str], where: str) -> UnfitTest:
    """The error for a name that is not in the data, with the nearest one that is."""
    return UnfitTest(message, where=where, hint=nearest(name, sorted(set(known))))
