"""Modes of several set-ups as one: weighted means of frequency and damping, shapes joined at the shared sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from operando.data import ModalModel
from operando.dof import Dof, DofIndex
from operando.oma.matching import Cluster
from operando.oma.uncertainty import student_widening, unit_changes


@dataclass(frozen=True)
class Merged:
    """Merged modes: hz, zeta (n,), shapes (m, n) of unit norm, seen (m, n) bool, and factor (p, k) of the covariance."""

    dofs: tuple[Dof, ...]
    hz: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    seen: NDArray[np.bool_]
    factor: NDArray[np.float64]
    scatter: NDArray[np.float64]


@dataclass(frozen=True)
class Mean:
    """Weighted mean with weights (k,), the standard deviation ``tau`` between the values beyond their own, and its variance."""

    value: float
    weights: NDArray[np.float64]
    tau: float
    variance: float


def mean_with_scatter(values: NDArray[Any], variances: NDArray[Any], least: NDArray[Any] | float = 0.0) -> Mean:
    """Mean of values with their own variances and a common one between them (random effects; Paule & Mandel 1982).

    The variance between is the one that makes the weighted scatter equal to its expectation, nought where the values agree as their own
    variances say. It is known from few values only: the variance is widened by Student's t with the degrees of freedom of Welch and
    Satterthwaite, so that ±1.96 standard deviations cover about 95 % (by simulation 91 to 97 % of eight values; of three 97 % without
    scatter between them, 85 to 90 % with one or two times as much as their own, which three values often do not show).

    Weights take no variance below ``least``, nor is that of the mean below what it would be with these: values that agree better than they
    can agree by chance.
    """
    y, own_variance = np.asarray(values, float), np.asarray(variances, float)
    v = np.maximum(own_variance, least)

    def excess(tau2: float) -> float:
        w = 1 / (v + tau2)
        return float(np.sum(w * (y - np.sum(w * y) / np.sum(w)) ** 2) - (y.size - 1))

    tau2 = 0.0
    if y.size > 1 and excess(0.0) > 0:
        low, high = 0.0, float(np.ptp(y) ** 2)
        while excess(high) > 0:
            high *= 4
        for _ in range(60):
            tau2 = (low + high) / 2
            low, high = (tau2, high) if excess(tau2) > 0 else (low, tau2)
    w = 1 / (v + tau2)
    w = w / w.sum()
    own, between = float(max(np.sum(w**2 * own_variance), np.sum(w**2 * least))), float(tau2 * np.sum(w**2))
    variance = own + between
    if between > 0:
        freedom = (y.size - 1) * (variance / between) ** 2
        variance *= student_widening(freedom) ** 2
    return Mean(float(np.sum(w * y)), w, float(np.sqrt(tau2)), variance)


def merge(models: Sequence[ModalModel], clusters: Sequence[Cluster], seconds: Sequence[float], blocks: Sequence[int]) -> Merged:
    """Modes of several set-ups joined (post-separate-estimation rescaling, Reynders, Magalhães, De Roeck & Cunha 2009).

    Frequencies and dampings are weighted means (``mean_with_scatter``). The variance of each set-up is brought to the common damping first:
    both grow with the damping as found (Au 2014), so that its own variance would give a set-up weight for too small a damping; and the
    weights take none for better than a resonance seen at its best in so long a record [s]: few blocks agree by chance. Shapes get one
    complex factor a set-up, all together by least squares at the shared sensors (Au 2011).

    Each covariance was widened by Student's t for the blocks it comes from: all together have more.
    """
    dofs = tuple(DofIndex(d for m in models for d in m.dofs))
    places = [DofIndex(dofs).match(m.dofs) for m in models]
    rows = [np.array(index) for index, _ in places]
    signs = [np.array(sense, float) for _, sense in places]
    together = student_widening(sum(b - 1 for b in blocks))
    roots = [covariance_root(m.covariance) * (together / student_widening(b - 1)) for m, b in zip(models, blocks, strict=True)]
    starts = np.concatenate([[0], np.cumsum([r.shape[1] for r in roots])]).astype(int)
    n, m = len(clusters), len(dofs)
    hz, zeta, scatter = np.zeros(n), np.zeros(n), np.zeros(n)
    shapes, seen = np.zeros((m, n), complex), np.zeros((m, n), bool)
    factor = np.zeros((2 * n + 2 * n * m, int(starts[-1])))
    for r, cluster in enumerate(clusters):
        of = list(cluster.members.items())
        f = np.array([models[k].frequencies_hz[i] for k, i in of])
        z = np.array([models[k].damping_ratios[i] for k, i in of])
        own = [np.array([float(np.sum(roots[k][q * models[k].n_modes + i] ** 2)) for k, i in of]) for q in (0, 1)]
        common = float(np.mean(z))
        cycles = 2 * np.pi * float(np.mean(f)) * np.array([seconds[k] for k, _ in of])
        for _ in range(3):
            damping = mean_with_scatter(z, own[1] * common / z, common / cycles)
            common = max(damping.value, 1e-6)
        frequency = mean_with_scatter(f, own[0] * common / z, f**2 * common / cycles)
        hz[r], zeta[r], scatter[r] = frequency.value, damping.value, frequency.tau
        for row, mean, block in ((r, frequency, 0), (n + r, damping, 1)):
            for (k, i), w in zip(of, mean.weights, strict=True):
                factor[row, starts[k] : starts[k + 1]] = w * roots[k][block * models[k].n_modes + i]
            factor[row] *= np.sqrt(mean.variance / max(float(np.sum(factor[row] ** 2)), 1e-300))
        parts = [_Part(k, rows[k], signs[k], models[k], i, roots[k]) for k, i in of]
        shape, change = _joined(parts, m, starts)
        shape, change = unit_changes(shape[:, None], change.T[:, :, None])[0:2]
        shapes[:, r] = shape[:, 0]
        seen[np.concatenate([p.rows for p in parts]), r] = True
        at = slice(2 * n + r * m, 2 * n + (r + 1) * m)
        factor[at] = change[:, :, 0].real.T
        factor[at.start + n * m : at.stop + n * m] = change[:, :, 0].imag.T
    return Merged(dofs, hz, zeta, shapes, seen, factor, scatter)


def covariance_root(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """L with L·Lᵀ the covariance, of as many columns as it has rank."""
    assert covariance is not None
    if covariance.shape[0] == 0:
        return np.zeros((0, 0))
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = eigh(covariance / np.outer(size, size))
    keep = values > 1e-10 * values[-1]
    return np.asarray(size[:, None] * vectors[:, keep] * np.sqrt(values[keep]))


class _Part:
    """A mode as one set-up sees it: rows in the union, shape in the sense of the union, its changes for each column of the root."""

    def __init__(self, setup: int, rows: NDArray[Any], signs: NDArray[Any], model: ModalModel, mode: int, root: NDArray[Any]) -> None:
        self.setup, self.rows = setup, rows
        n, m = model.n_modes, len(model.dofs)
        at = 2 * n + mode * m + np.arange(m)
        self.shape = model.shapes[:, mode] * signs
        self.change = (root[at] + 1j * root[at + n * m]) * signs[:, None]
        variance = np.sum(np.abs(self.change) ** 2, axis=1)
        self.variance = np.maximum(variance, 1e-9 * float(np.mean(np.abs(self.shape) ** 2)))


def _joined(parts: list[_Part], m: int, starts: NDArray[np.int_]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Shape over the union (m,) and its changes (m, k); one factor a set-up from the least squares at the shared sensors."""
    count = np.zeros(m, int)
    for p in parts:
        count[p.rows] += 1
    shared = [np.flatnonzero(count[p.rows] > 1) for p in parts]
    # One weight a set-up: sensors shared weigh by how well the set-up sees the mode at them.
    weight = np.array([1 / np.mean(p.variance[s]) if s.size else 1.0 for p, s in zip(parts, shared, strict=True)])
    c = _factors(parts, shared, weight, m)
    total, shape = np.zeros(m), np.zeros(m, complex)
    share = weight / np.maximum(np.abs(c) ** 2, 1e-300)
    for p, w, c_k in zip(parts, share, c, strict=True):
        total[p.rows] += w
        shape[p.rows] += w * c_k * p.shape
    shape /= np.maximum(total, 1e-300)
    change = np.zeros((m, int(starts[-1])), complex)
    left, expected = 0.0, 0.0
    for p, s, w, c_k in zip(parts, shared, share, c, strict=True):
        d_factor = 0.0
        if s.size:
            u = p.shape[s]
            d_factor = -(u.conj() @ p.change[s]) / float(np.vdot(u, u).real)
            own = w / total[p.rows[s]]
            left += w * float(np.sum(np.abs(c_k * u - shape[p.rows[s]]) ** 2))
            # of the variance at the shared sensors, what the mean takes and one complex factor a set-up are lost
            expected += w * abs(c_k) ** 2 * float(np.sum(p.variance[s] * (1 - own))) * (1 - 1 / s.size)
        moved = c_k * (p.change + p.shape[:, None] * d_factor)
        change[p.rows, starts[p.setup] : starts[p.setup + 1]] += (w / total[p.rows])[:, None] * moved
    if expected > 0:
        change *= np.sqrt(max(left / expected, 1.0))  # Birge ratio: shapes disagree at the shared sensors beyond their variances
    return shape, change


def _factors(parts: list[_Part], shared: list[NDArray[Any]], weight: NDArray[Any], m: int) -> NDArray[np.complex128]:
    """Complex factor of each set-up's shape: smallest weighted disagreement at the shared sensors (a generalised eigenvalue problem)."""
    if len(parts) == 1:
        return np.ones(1, complex)
    at = np.zeros((m, len(parts)), complex)
    for k, (p, s) in enumerate(zip(parts, shared, strict=True)):
        at[p.rows[s], k] = p.shape[s]
    size = np.sqrt(np.sum(np.abs(at) ** 2, axis=0))
    there = np.abs(at) > 0
    # A set-up's own variance weighs, relative to its size at the shared sensors, so that no factor can flee to nought.
    w = weight * size**2
    a = at / np.maximum(size, 1e-300)
    total = np.maximum((there * w).sum(axis=1), 1e-300)
    gram = (a.conj() * w).T @ ((a * w) / total[:, None])
    full = np.diag(np.sum(np.abs(a) ** 2 * w[None, :], axis=0))
    metric = np.diag(np.maximum(np.diag(full).real, 1e-12 * float(np.max(w))))
    _, vectors = eigh(full - gram, metric)
    c = vectors[:, 0]
    return np.asarray(c / np.maximum(size, 1e-300))
