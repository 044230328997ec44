"""Which modes of different set-ups are one mode: by frequency, and by the shapes at the sensors both have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from operando.data import ModalModel
from operando.dof import DofIndex

MAX_SHIFT = 0.02
"""Largest relative difference of frequency of one mode between two set-ups: moved sensors (mass loading) and temperature shift modes by a
percent at most in published roving tests; two modes nearer than this are told apart by their shapes."""
ENOUGH_MAC = 0.8
"""From this MAC at the shared sensors on, shapes of a shift within ``MAX_SHIFT`` are one (a random pair of two-sensor shapes reaches it in
one of five cases, of three-sensor shapes in one of 25: frequency decides with it)."""
BEYOND = 16.0
"""A lower MAC is still one shape where the difference at the shared sensors is below so many times its variance (4 σ)."""


@dataclass
class Cluster:
    """One mode over the set-ups: index of its mode in each set-up that saw it."""

    members: dict[int, int] = field(default_factory=dict)


def shared_rows(a: ModalModel, b: ModalModel) -> tuple[list[int], list[int], NDArray[np.float64]]:
    """Rows of the sensors both models have, and the sign between their senses."""
    rows = DofIndex(a.dofs).common(b.dofs)
    return [r[0] for r in rows], [r[1] for r in rows], np.array([r[2] for r in rows], float)


def likeness(a: ModalModel, i: int, b: ModalModel, j: int) -> tuple[float, bool]:
    """MAC of two modes at the shared sensors (1 where there is one sensor only, NaN where there is none), and whether they may be one.

    The difference of the shapes there, at the scale that makes it smallest, is set against its variance.
    """
    rows_a, rows_b, sign = shared_rows(a, b)
    if not rows_a:
        return np.nan, True
    u, v = a.shapes[rows_a, i], b.shapes[rows_b, j] * sign
    uu, vv = float(np.vdot(u, u).real), float(np.vdot(v, v).real)
    if uu == 0 or vv == 0:
        return np.nan, True
    mac = float(abs(np.vdot(u, v)) ** 2 / (uu * vv))
    if mac >= ENOUGH_MAC or len(rows_a) == 1:
        return mac, True
    noise = 0.0
    for model, rows, mode, size in ((a, rows_a, i, uu), (b, rows_b, j, vv)):
        std = model.shape_std
        noise += np.inf if std is None else float(np.sum(std[rows, mode] ** 2)) / size
    return mac, (1 - mac) < BEYOND * noise


def frequency_limit(a: ModalModel, i: int, b: ModalModel, j: int) -> float:
    """Largest difference of frequency [Hz] at which two modes may be one."""
    spread = 0.0
    for model, mode in ((a, i), (b, j)):
        std = model.frequency_std_hz
        spread += 0.0 if std is None else float(std[mode]) ** 2
    return max(MAX_SHIFT * float(a.frequencies_hz[i]), 4 * np.sqrt(spread))


def match(models: Sequence[ModalModel]) -> list[Cluster]:
    """Modes of all set-ups in clusters, at most one mode of a set-up in each, by frequency.

    Set-ups are taken by their number of modes; each is assigned to the clusters so far by the smallest sum of frequency difference (in
    units of its limit) and 1 − MAC, pairs beyond the limits excluded; what is left starts clusters of its own.
    """
    from scipy.optimize import linear_sum_assignment

    clusters: list[Cluster] = []
    for k in sorted(range(len(models)), key=lambda q: -models[q].n_modes):
        model = models[k]
        cost = np.full((model.n_modes, len(clusters)), 1e6)
        for c, cluster in enumerate(clusters):
            for i in range(model.n_modes):
                costs = [_cost(model, i, models[m], j) for m, j in cluster.members.items()]
                cost[i, c] = min(float(np.median(costs)), 1e6)
        rows, columns = linear_sum_assignment(cost)
        taken = set()
        for i, c in zip(rows.tolist(), columns.tolist(), strict=True):
            if cost[i, c] < 1e5:
                clusters[c].members[k] = i
                taken.add(i)
        clusters += [Cluster({k: i}) for i in range(model.n_modes) if i not in taken]
    centre = lambda c: float(np.median([models[m].frequencies_hz[i] for m, i in c.members.items()]))  # noqa: E731
    return sorted(clusters, key=centre)


def _cost(a: ModalModel, i: int, b: ModalModel, j: int) -> float:
    far = abs(float(a.frequencies_hz[i] - b.frequencies_hz[j])) / frequency_limit(a, i, b, j)
    if far > 1:
        return 1e6
    mac, one = likeness(a, i, b, j)
    return far + (0.5 if np.isnan(mac) else 1 - mac) if one else 1e6
