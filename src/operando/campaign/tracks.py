"""Modes followed through the states of a campaign by MAC and frequency, and where their frequencies cross."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.dof import Dof
from operando.errors import DofError
from operando.indicators import INTERVAL

SAME_SHAPE = 0.5
"""MAC above which a mode may be the one before: of orthogonal shapes only one can have a MAC above one half with a given shape."""
STEP = 0.1
"""Relative change of frequency from state to state that weighs as much as a MAC of 0.6: of candidates with like shapes the nearest in
frequency is taken (MAC times exp(−(ln(f/f₀)/STEP)²/2)); it excludes none."""
FAR = 0.3
"""Largest relative change from state to state: beyond it, few sensors alone make shapes look alike (spatial aliasing)."""


@dataclass(frozen=True)
class Point:
    """A mode in one state."""

    state: int  # place of the state in the order of the axis
    mode: int  # its number in the test's own results
    frequency_hz: float
    frequency_std_hz: float | None
    damping_ratio: float
    damping_ratio_std: float | None
    mac_before: float | None = None  # MAC with the shape last seen
    mac_baseline: float | None = None  # MAC with its shape in the baseline


@dataclass
class Track:
    """One mode through the states."""

    number: int = -1
    points: list[Point] = field(default_factory=list)

    @property
    def by_state(self) -> dict[int, Point]:
        """Its points by state."""
        return {p.state: p for p in self.points}


class Tracker:
    """Follows modes from state to state; of a shape it keeps the last one seen, and those of the state ``baseline``."""

    def __init__(self, baseline: int) -> None:
        self.baseline = baseline
        self.tracks: list[Track] = []
        self._dofs: dict[str, int] = {}
        self._last: list[tuple[NDArray[np.intp], NDArray[np.complex128]]] = []
        self._base: dict[int, tuple[NDArray[np.intp], NDArray[np.complex128]]] = {}

    def add(self, state: int, modes: Sequence[Mapping[str, Any]]) -> None:
        """Join the modes of the next state to the tracks; a mode that fits none begins one."""
        shapes = [self._shape(mode["shape"]) for mode in modes]
        points = [
            Point(state, m["mode"], m["frequency_hz"], m["frequency_std_hz"], m["damping_ratio"], m["damping_ratio_std"]) for m in modes
        ]
        for k, (track, before) in enumerate(self._joined(points, shapes)):
            if track is None:
                track = len(self.tracks)
                self.tracks.append(Track())
                self._last.append(shapes[k])
            self._last[track] = shapes[k]
            if state == self.baseline:
                self._base[track] = shapes[k]
            self.tracks[track].points.append(_with(points[k], before))

    def _joined(self, points: Sequence[Point], shapes: Sequence[Any]) -> list[tuple[int | None, float | None]]:
        """For each mode the track it belongs to, and its MAC with it."""
        if not points or not self.tracks:
            return [(None, None)] * len(points)
        from scipy.optimize import linear_sum_assignment

        macs = self._macs(self._last, shapes)
        last = np.array([t.points[-1].frequency_hz for t in self.tracks])
        away = np.abs(np.log(np.array([p.frequency_hz for p in points])[None, :] / last[:, None]))
        score = np.where((macs > SAME_SHAPE) & (away < FAR), macs * np.exp(-0.5 * (away / STEP) ** 2), 0.0)
        found: list[tuple[int | None, float | None]] = [(None, None)] * len(points)
        for i, k in zip(*linear_sum_assignment(score, maximize=True), strict=True):
            if score[i, k] > 0:
                found[k] = (int(i), float(macs[i, k]))
        return found

    def _shape(self, shape: Mapping[str, Any]) -> tuple[NDArray[np.intp], NDArray[np.complex128]]:
        """A shape by numbers of DOFs; a DOF and its opposite are one."""
        places, values = [], []
        for name, value in shape.items():
            try:
                dof = Dof.parse(name)
                name, sign = str(dof.unsigned), dof.sign
            except DofError:
                sign = 1
            places.append(self._dofs.setdefault(name, len(self._dofs)))
            values.append(sign * (complex(*value) if isinstance(value, list) else complex(value or 0.0)))
        return np.array(places, np.intp), np.array(values, complex)

    def _macs(self, first: Sequence[Any], second: Sequence[Any]) -> NDArray[np.float64]:
        """MAC of each pair of shapes over the DOFs they share; 0 where they share none."""
        (a, has_a), (b, has_b) = (self._dense(shapes) for shapes in (first, second))
        cross = np.abs(a.conj() @ b.T) ** 2
        norms = (np.abs(a) ** 2 @ has_b.T) * (has_a @ (np.abs(b) ** 2).T)
        return np.divide(cross, norms, out=np.zeros_like(cross), where=norms > 0)

    def _dense(self, shapes: Sequence[Any]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
        out, has = np.zeros((len(shapes), len(self._dofs)), complex), np.zeros((len(shapes), len(self._dofs)))
        for row, (places, values) in enumerate(shapes):
            out[row, places], has[row, places] = values, 1.0
        return out, has

    def base_macs(self, state_modes: Iterable[tuple[int, Mapping[str, Any]]]) -> list[float | None]:
        """MAC of modes with the baseline's shape of their tracks: of pairs (track, mode)."""
        out: list[float | None] = []
        for track, mode in state_modes:
            base = self._base.get(track)
            out.append(None if base is None else float(self._macs([base], [self._shape(mode["shape"])])[0, 0]))
        return out


def _with(point: Point, mac_before: float | None = None, mac_baseline: float | None = None) -> Point:
    return replace(
        point,
        mac_before=point.mac_before if mac_before is None else mac_before,
        mac_baseline=point.mac_baseline if mac_baseline is None else mac_baseline,
    )


def follow(states: Iterable[Sequence[Mapping[str, Any]]], again: Iterable[Sequence[Mapping[str, Any]]], baseline: int) -> list[Track]:
    """Tracks of the modes of all states, numbered by frequency.

    The modes of each state come in order, twice: the second time to compare with the baseline wherever that stands.
    """
    tracker = Tracker(baseline)
    for state, modes in enumerate(states):
        tracker.add(state, modes)
    where = {(p.state, p.mode): i for i, track in enumerate(tracker.tracks) for p in track.points}
    macs: dict[tuple[int, int], float | None] = {}
    for state, modes in enumerate(again):
        pairs = [(where[state, mode["mode"]], mode) for mode in modes]
        macs |= {(state, mode["mode"]): value for (_, mode), value in zip(pairs, tracker.base_macs(pairs), strict=True)}
    for track in tracker.tracks:
        track.points = [_with(p, mac_baseline=macs.get((p.state, p.mode))) for p in track.points]
    ordered = sorted(tracker.tracks, key=lambda t: t.by_state.get(baseline, t.points[0]).frequency_hz)
    for number, track in enumerate(ordered):
        track.number = number
    return ordered


@dataclass(frozen=True)
class Crossing:
    """Two modes whose frequencies change order between two states, each side by more than their 95 % intervals."""

    first: int
    second: int
    after: int
    before: int
    place: float
    frequency_hz: float


def crossings(tracks: Sequence[Track], places: Sequence[float]) -> list[Crossing]:
    """Where the frequencies of tracked modes cross; ``places`` are those of the states on the axis."""
    out = []
    for i, a in enumerate(tracks):
        for b in tracks[i + 1 :]:
            if len(a.points) < 2 or len(b.points) < 2:
                continue
            out += _crossings_of(a, b, places)
    return sorted(out, key=lambda c: (c.place, c.first, c.second))


def _crossings_of(a: Track, b: Track, places: Sequence[float]) -> list[Crossing]:
    others, out = b.by_state, []
    last: tuple[Point, Point] | None = None
    for p in a.points:
        if (q := others.get(p.state)) is None:
            continue
        spread = np.hypot(p.frequency_std_hz or 0.0, q.frequency_std_hz or 0.0)
        if abs(p.frequency_hz - q.frequency_hz) <= INTERVAL * spread:
            continue  # not told apart here
        if last is not None:
            d0, d1 = last[0].frequency_hz - last[1].frequency_hz, p.frequency_hz - q.frequency_hz
            if d0 * d1 < 0:
                share = d0 / (d0 - d1)
                x0, x1 = places[last[0].state], places[p.state]
                hz = last[0].frequency_hz + share * (p.frequency_hz - last[0].frequency_hz)
                out.append(Crossing(a.number, b.number, last[0].state, p.state, float(x0 + share * (x1 - x0)), float(hz)))
        last = (p, q)
    return out
