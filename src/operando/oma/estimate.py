"""From the selected poles to modes: one model order, normalised shapes, covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.oma.correlation import BlockCorrelations
from operando.oma.subspace import Factors, Poles, Realisation
from operando.oma.uncertainty import Perturbations, block_products, covariance_of_mean, normalised_changes, perturb
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


def estimate_modes(
    groups: list[tuple[int, int]],
    poles: list[Poles],
    orders: list[int],
    correlations: BlockCorrelations,
    factors: Factors,
    realisation: Realisation,
    derivative: NDArray[np.int_],
    rows: int,
    rate: float,
    table: PoleTable,
) -> Estimate:
    """Poles, shapes and covariance of the selected modes, each at its order."""
    n, r = len(groups), realisation.n_channels
    taken = np.array([g[0] for g in groups], int)
    lam = np.zeros(n, complex)
    shapes = np.zeros((r, n), complex)
    blocks = correlations.weights.size if correlations.blocks is not None else 0
    d_lam = np.zeros((blocks, n), complex)
    d_shapes = np.zeros((blocks, r, n), complex)
    products = block_products(correlations, factors, rows) if blocks else None
    for order in np.unique(taken):
        of = poles[orders.index(int(order))]
        modes = np.flatnonzero(taken == order)
        columns = np.array([int(np.argmin(np.abs(of.hz - table.frequency_hz[groups[i][1]]))) for i in modes])
        lam[modes] = np.log(of.mu[columns]) * rate
        shapes[:, modes] = of.shapes[:, columns]
        if blocks:
            change = perturb(correlations, factors, realisation, of, columns, rows, rate, products)
            d_lam[:, modes], d_shapes[:, :, modes] = change.lam, change.shapes
    covariance = None
    if blocks and n:
        covariance = covariance_of_mean(normalised_changes(lam, shapes, Perturbations(d_lam, d_shapes), derivative), correlations.weights)
    size = np.abs(lam)
    shapes = normalise_shapes(to_displacement(shapes, lam, derivative))
    return Estimate(size / 2 / np.pi, -lam.real / size, shapes, covariance, taken)


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
