"""Stabilisation diagrams of prepared responses: own SSI-cov, and SSI-dat by pyOMA-2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.errors import IdentificationError
from operando.oma.correlation import BlockCorrelations, correlate, pool
from operando.oma.estimate import Estimate, normalise_shapes, taken_poles, to_displacement
from operando.oma.pyoma import pyoma_poles
from operando.oma.subspace import Factors, Poles, Realisation, factorise_weighted, poles_of_orders, realise
from operando.oma.uncertainty import Perturbations, block_products, covariance_of_mean, normalised_changes, perturb
from operando.stabilization import PoleTable, Tolerances, classify

MAX_ORDER = 120
"""Largest model order taken by default."""
MIN_BLOCKS = 8
"""Fewest blocks from which a covariance is stated."""


@dataclass(frozen=True)
class Prepared:
    """Responses ready for identification: runs (each (r, n_samples)), rate [Hz], block rows, reference rows, derivative of each channel."""

    runs: list[NDArray[Any]]
    rate: float
    rows: int
    references: NDArray[np.int_]
    derivative: NDArray[np.int_]

    @property
    def samples(self) -> int:
        """Samples of all runs."""
        return sum(run.shape[1] for run in self.runs)

    @property
    def seconds(self) -> float:
        """Length of all runs [s]."""
        return self.samples / self.rate


@dataclass(frozen=True)
class CovDiagram:
    """Poles of all orders by SSI-cov, and what the covariance needs."""

    table: PoleTable
    orders: list[int]
    poles: list[Poles]
    correlations: BlockCorrelations
    factors: Factors
    realisation: Realisation
    prepared: Prepared

    @property
    def blocks(self) -> int:
        """Number of blocks the correlations were kept of."""
        return int(self.correlations.weights.size)

    @property
    def samples(self) -> int:
        """Samples used."""
        return self.prepared.samples

    def estimate(self, groups: list[tuple[int, int]]) -> Estimate:
        """Modes at the (order, row of the table) given, with covariance."""
        n, r, p, correlations = len(groups), self.realisation.n_channels, self.prepared, self.correlations
        lam, shapes = np.zeros(n, complex), np.zeros((r, n), complex)
        blocks = self.blocks if correlations.blocks is not None else 0
        d_lam, d_shapes = np.zeros((blocks, n), complex), np.zeros((blocks, r, n), complex)
        products = block_products(correlations, self.factors, p.rows) if blocks else None
        for modes, of, columns in taken_poles(groups, self.poles, self.orders, self.table):
            lam[modes] = np.log(of.mu[columns]) * p.rate
            shapes[:, modes] = of.shapes[:, columns]
            if blocks:
                change = perturb(correlations, self.factors, self.realisation, of, columns, p.rows, p.rate, products)
                d_lam[:, modes], d_shapes[:, :, modes] = change.lam, change.shapes
        covariance = None
        if blocks and n:
            changes = normalised_changes(lam, shapes, Perturbations(d_lam, d_shapes), p.derivative)
            covariance = covariance_of_mean(changes, correlations.weights)
        size = np.abs(lam)
        shapes = normalise_shapes(to_displacement(shapes, lam, p.derivative))
        return Estimate(size / 2 / np.pi, -lam.real / size, shapes, covariance, np.array([order for order, _ in groups], int))


@dataclass(frozen=True)
class DatDiagram:
    """Poles of all orders by pyOMA-2's SSI-dat; no covariance."""

    table: PoleTable
    orders: list[int]
    samples: int
    derivative: NDArray[np.int_]
    blocks: int = 1

    def estimate(self, groups: list[tuple[int, int]]) -> Estimate:
        """Modes at the (order, row of the table) given."""
        rows = np.array([g[1] for g in groups], int)
        hz, zeta = self.table.frequency_hz[rows], self.table.damping_ratio[rows]
        w = 2 * np.pi * hz
        lam = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
        shapes = normalise_shapes(to_displacement(self.table.vectors[:, rows], lam, self.derivative))
        return Estimate(hz, zeta, shapes, None, np.array([g[0] for g in groups], int))


def ssi_cov_diagram(
    prepared: Prepared, max_order: int | None, weighting: str, uncertainty: bool, tolerances: Tolerances | None
) -> CovDiagram:
    """Correlations, weighted Hankel matrix, poles of every second order."""
    p = prepared
    r = p.runs[0].shape[0]
    correlations = correlate_runs(p.runs, p.references, 2 * p.rows, uncertainty)
    factors = factorise_weighted(correlations.mean, p.references, p.rows, 2 * (max_order or MAX_ORDER), p.samples, weighting)
    order = min(max_order or default_order(factors, p.samples, weighting), factors.s.size - 1, (p.rows - 1) * r)
    if order < 4:
        raise IdentificationError(
            f"{p.samples} samples of {r} channels allow {order} states only", hint="measure longer, or give max_order of 4 or more"
        )
    realisation = realise(factors, r)
    orders = list(range(4, order + 1, 2))
    poles = poles_of_orders(realisation, orders, p.rate)
    table = classify(orders, [q.hz for q in poles], [q.zeta for q in poles], [q.shapes for q in poles], tolerances)
    return CovDiagram(table, orders, poles, correlations, factors, realisation, p)


def ssi_dat_diagram(prepared: Prepared, max_order: int | None, tolerances: Tolerances | None) -> DatDiagram:
    """Poles by pyOMA-2's data-driven SSI on the longest run."""
    longest = max(prepared.runs, key=lambda run: run.shape[1])
    r = longest.shape[0]
    rows = min(prepared.rows, max(10, round(400 / r)))
    order = min(max_order or 80, (rows - 1) * r, rows * prepared.references.size) // 2 * 2
    limit = (tolerances or Tolerances()).max_damping
    orders, hz, zeta, shapes, used = pyoma_poles(longest, prepared.rate, rows, order, prepared.references, "dat", limit)
    return DatDiagram(classify(orders, hz, zeta, shapes, tolerances), orders, used, prepared.derivative)


def default_order(factors: Factors, samples: int, weighting: str) -> int:
    """Largest model order worth looking at: a third beyond the canonical correlations that exceed what white noise gives."""
    if weighting != "cva":
        return min(80, factors.s.size)
    level = np.sqrt(factors.left.shape[0] / samples) + np.sqrt(factors.right.shape[0] / samples)
    signal = int(np.sum(factors.s > level))
    return int(np.clip(2 * round(1.3 * signal / 2), 40, MAX_ORDER))


def correlate_runs(runs: list[NDArray[Any]], references: NDArray[np.int_], n_lags: int, uncertainty: bool) -> BlockCorrelations:
    """Pooled correlations in blocks of at least four times the lags, about a hundred at most: neighbours hardly depend on each other."""
    samples = [run.shape[1] for run in runs]
    if min(samples) < 5 * n_lags:
        raise IdentificationError(
            f"{min(samples)} samples are too few for {n_lags} correlation lags", hint="take longer runs, or fewer block_rows (keyword)"
        )
    length = max(4 * n_lags, sum(samples) // 100)
    if sum(samples) < 20 * length:
        length = max(2 * n_lags, min(min(samples) // 2, sum(samples) // 20))
    counts = [max(1, (n - n_lags) // length) for n in samples]
    keep = uncertainty and sum(counts) >= MIN_BLOCKS
    parts = []
    for run, n in zip(runs, counts, strict=True):
        parts.append(correlate(run, references, n_lags, n if keep else 1, keep, centre=True))
    return pool(parts, samples)
