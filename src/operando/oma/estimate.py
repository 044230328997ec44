"""From the selected poles to modes: one model order, normalised shapes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.oma.subspace import Poles
from operando.stabilization import PoleTable, Stabilization


@dataclass(frozen=True)
class Estimate:
    """Modes with covariance: hz, zeta (n,), shapes (r, n) normalised, covariance in the order of ``ModalModel``, orders (n,)."""

    hz: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    covariance: NDArray[np.float64] | None
    orders: NDArray[np.int_]


def best_orders(stabilization: Stabilization, orders: Sequence[int]) -> list[tuple[int, int]]:
    """(order, row of the table) each selected mode is taken from.

    One order for as many modes as possible: of those with most modes the one whose poles lie nearest to the medians over all
    orders; a mode missing there is taken from the order where it lies nearest to its own.
    """
    table = stabilization.table
    count = np.zeros(len(orders))
    distance = np.zeros(len(orders))
    place = {order: k for k, order in enumerate(orders)}
    own: list[dict[int, tuple[float, int]]] = []
    for hz, zeta, members in zip(stabilization.selected_hz, stabilization.selected_damping, stabilization.selected_members, strict=True):
        far = np.abs(table.frequency_hz[members] - hz) / (zeta * hz) + np.abs(table.damping_ratio[members] - zeta) / zeta
        mine = {}
        for row, d in zip(members, far, strict=True):
            k = place[int(table.order[row])]
            count[k] += 1
            distance[k] += d
            mine[k] = (float(d), int(row))
        own.append(mine)
    if not own:
        return []
    full = np.flatnonzero(count == count.max())
    common = int(full[np.argmin(distance[full])])
    out = []
    for mine in own:
        k = common if common in mine else min(mine, key=lambda q: mine[q][0])
        out.append((orders[k], mine[k][1]))
    return out


def taken_poles(
    groups: Sequence[tuple[int, int]], poles: Sequence[Poles], orders: Sequence[int], table: PoleTable
) -> Iterator[tuple[NDArray[np.int_], Poles, list[int]]]:
    """For each model order that modes are taken from: these modes, its poles, and the column of each."""
    taken, rows = np.array(groups, int).reshape(-1, 2).T
    wanted = table.frequency_hz[rows]
    for order in np.unique(taken):
        of = poles[orders.index(int(order))]
        modes = np.flatnonzero(taken == order)
        yield modes, of, [int(np.argmin(np.abs(of.hz - hz))) for hz in wanted[modes]]


def to_displacement(shapes: NDArray[Any], lam: NDArray[np.complex128], derivative: NDArray[np.int_]) -> NDArray[Any]:
    """Shapes in proportions of displacement where channels measure different quantities (each divided by its power of λ)."""
    if np.all(derivative == derivative[0]):
        return shapes
    return np.asarray(shapes / lam[None, :] ** derivative[:, None])


def normalise_shapes(shapes: NDArray[Any]) -> NDArray[np.complex128]:
    """Unit norm, largest component real and positive.

    Parameters
    ----------
    shapes : array
        Shapes in columns.

    Returns
    -------
    complex array

    Examples
    --------
    >>> import numpy as np
    >>> normalise_shapes(np.array([[3.0], [-4.0j]])).round(1).ravel().tolist()
    [0.6j, (0.8-0j)]
    """
    out = np.array(shapes, complex)
    for column in out.T:
        peak = column[np.argmax(np.abs(column))]
        if peak != 0:
            column *= abs(peak) / peak / np.linalg.norm(column)
    return out
