"""Effects that may be missing: kinds, their dynamic stiffness, and all candidates of a set of sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

ONE_PLACE = ("point_mass", "ground_spring", "ground_damper")
TWO_PLACES = ("coupling_spring", "coupling_damper", "gyroscopic")
STRUCTURAL = (*ONE_PLACE, *TWO_PLACES, "tuned_absorber")
SENSOR = ("sensor_gain", "sensor_delay", "sensor_polarity")
GLOBAL = ("global_stiffness", "global_damping")
KINDS = (*STRUCTURAL, *SENSOR, "channel_swap", *GLOBAL)
LINEAR_SCALE = ("sensor_delay",)  # the other values are searched by their logarithm; gain and damping are factors
FACTORS = ("sensor_gain", "global_damping")


@dataclass(frozen=True)
class Effect:
    """An effect at places: numbers of DOFs, values on the search scale, and the sign of its size."""

    kind: str
    places: tuple[int, ...] = ()
    values: tuple[float, ...] = ()
    sign: int = 1

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        return self.kind, tuple(sorted(self.places))

    @property
    def size(self) -> float | None:
        """In SI units; None for kinds without a value."""
        if not self.values:
            return None
        if self.kind in LINEAR_SCALE:
            return self.values[0]
        return (1 if self.kind in FACTORS else self.sign) * float(np.exp(self.values[0]))


def touched(effects: list[Effect]) -> list[int]:
    """DOFs on which structural effects act."""
    return sorted({i for e in effects if e.kind in STRUCTURAL for i in e.places})


def moved(effects: list[Effect], values: np.ndarray) -> list[Effect]:
    """The effects with new values, one after the other."""
    out, i = [], 0
    for effect in effects:
        out.append(replace(effect, values=tuple(values[i : i + len(effect.values)])))
        i += len(effect.values)
    return out


def stiffness(effect: Effect, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Dynamic stiffness on the lines, its pattern over the places, and its derivatives by the values."""
    size = effect.sign * np.exp(effect.values[0])
    between = np.array([[1, -1], [-1, 1]])
    if effect.kind == "tuned_absorber":
        wa, zeta = 2 * np.pi * np.exp(effect.values[1]), np.exp(effect.values[2])
        elastic = 2j * zeta * wa * w + wa**2
        z = -size * w**2 * elastic / (elastic - w**2)
        by_elastic = size * w**4 / (elastic - w**2) ** 2
        return z, np.ones((1, 1)), [z, by_elastic * (2j * zeta * wa * w + 2 * wa**2), by_elastic * 2j * zeta * wa * w]
    z = {
        "point_mass": -size * w**2,
        "ground_spring": size * np.ones(w.size),
        "ground_damper": 1j * w * size,
        "coupling_spring": size * np.ones(w.size),
        "coupling_damper": 1j * w * size,
        "gyroscopic": 1j * w * size,
    }[effect.kind].astype(complex)
    pattern = (
        np.eye(len(effect.places)) if effect.kind in ONE_PLACE else np.array([[0, 1], [-1, 0]]) if effect.kind == "gyroscopic" else between
    )
    return z, pattern, [z]


def with_one(columns: np.ndarray, h: np.ndarray, effect: Effect, w: np.ndarray) -> np.ndarray:
    """FRFs h (lines, DOFs, references) with one structural effect more, given all columns of the structure (lines, DOFs, DOFs)."""
    z, pattern, _ = stiffness(effect, w)
    b = list(effect.places)
    if len(b) == 1:
        i = b[0]
        return h - columns[:, :, i, None] * (z / (1 + z * columns[:, i, i]))[:, None, None] * h[:, i, None]
    matrix = z[:, None, None] * pattern
    inner = np.linalg.solve(np.eye(len(b)) + matrix @ columns[:, b][:, :, b], matrix)
    return h - columns[:, :, b] @ (inner @ h[:, b])


def candidates(nodes: list[tuple[int, ...]], effects: list[Effect]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Kinds and places that are not there yet; a mass acts on all DOFs of its node, an absorber may stand beside another."""
    count = sum(len(node) for node in nodes)
    have = {effect.key for effect in effects}
    for kind in KINDS:
        if kind in GLOBAL:
            places: Iterator[tuple[int, ...]] = iter([()])
        elif kind == "point_mass":
            places = iter(nodes)
        elif kind in (*TWO_PLACES, "channel_swap"):
            places = combinations(range(count), 2)
        else:
            places = ((i,) for i in range(count))
        for place in places:
            if kind == "tuned_absorber" or (kind, place) not in have:
                yield kind, place
