"""One subspace identification of several set-ups: correlations normalised by the sensors all set-ups share, deviations by the jackknife."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular

from operando.dof import Dof
from operando.errors import IdentificationError
from operando.oma.correlation import block_hankel, correlate, pool
from operando.oma.diagram import Prepared
from operando.oma.estimate import best_orders, normalise_shapes, to_displacement
from operando.oma.single import Identification
from operando.oma.subspace import whitening_factor
from operando.oma.uncertainty import student_widening
from operando.stabilization import Stabilization, Tolerances, classify, select_modes

MAX_ORDER = 100
"""Largest model order of the joint estimate."""
LEAST_GROUPS, ALL_GROUPS = 5, 96
"""Groups of blocks a set-up is cut into for the jackknife, and about how many there are in all."""


@dataclass(frozen=True)
class Joint:
    """Modes of all set-ups at once: hz, zeta (n,), shapes (m, n) of unit norm over ``dofs``, their standard deviations, and the diagram."""

    dofs: tuple[Dof, ...]
    hz: NDArray[np.float64]
    zeta: NDArray[np.float64]
    shapes: NDArray[np.complex128]
    hz_std: NDArray[np.float64]
    zeta_std: NDArray[np.float64]
    shape_std: NDArray[np.float64]
    stabilization: Stabilization


@dataclass(frozen=True)
class _Layout:
    """Rows of the references in each set-up, with signs; rows of the others, and where all stand in the union."""

    references: list[NDArray[np.int_]]
    signs: list[NDArray[np.float64]]
    others: list[NDArray[np.int_]]
    dofs: tuple[Dof, ...]
    derivative: NDArray[np.int_]
    where: list[NDArray[np.int_]]


def fit_joint(setups: Sequence[Identification], band: tuple[float, float], tolerances: Tolerances | None = None) -> Joint:
    """Merge before the identification (Döhler, Reynders, Magalhães, Mevel, De Roeck & Cunha 2010) and identify once.

    Hankel matrices of the shared sensors of all set-ups stand side by side; their common left singular vectors are the observability
    matrix of the shared sensors, their right ones say how each set-up was excited; the rows of the other sensors are brought to this common
    basis by least squares. Canonical-variate weights make set-ups of different excitation level comparable. Standard
    deviations come from leaving out one group of blocks of one set-up at a time.
    """
    layout = _layout(setups)
    p = setups[0].prepared
    q = layout.references[0].size
    if any(abs(s.prepared.rate - p.rate) > 1e-6 * p.rate for s in setups):
        raise IdentificationError("the set-ups are sampled at different rates")
    fewest = min(s.prepared.samples for s in setups)
    shortest = min(run.shape[1] for s in setups for run in s.prepared.runs)
    rows = int(max(4, min(np.clip(round(400 / q), 30, 100), fewest // 40, shortest // 12)))
    groups = int(np.clip(ALL_GROUPS // len(setups), LEAST_GROUPS, 24))
    parts = [_correlations(s.prepared, r, 2 * rows, groups) for s, r in zip(setups, layout.references, strict=True)]
    pieces = [
        _Pieces.of(part.mean, part.blocks, part.weights, r, sign, o)
        for part, r, sign, o in zip(parts, layout.references, layout.signs, layout.others, strict=True)
    ]
    chain = _Chain(pieces, rows, [s.prepared.samples for s in setups], p.rate)
    top = int(min(MAX_ORDER, chain.size - 1, (rows - 1) * q)) // 2 * 2
    orders = list(range(4, top + 1, 2))
    poles = [chain.poles(order) for order in orders]
    table = classify(orders, [x[0] for x in poles], [x[1] for x in poles], [x[2] for x in poles], tolerances)
    stabilization = select_modes(table, band=band, tolerances=tolerances)
    if stabilization.selected_hz.size == 0:
        raise IdentificationError("the joint estimate finds no mode")
    chosen = best_orders(stabilization, orders)
    return _conclude(chain, chosen, stabilization, layout)


def _layout(setups: Sequence[Identification]) -> _Layout:
    first = setups[0].responses
    common, signs, others, where = [], [], [], []
    keys = [{d.key: (i, d.sign, int(s.responses.derivative[i])) for i, d in enumerate(s.responses.dofs)} for s in setups]
    shared = [d for d in first.dofs if all(d.key in k for k in keys)]
    shared = [d for d in shared if len({k[d.key][2] for k in keys}) == 1]
    if not shared:
        raise IdentificationError("no sensor is in all set-ups with the same quantity")
    dofs = list(shared)
    derivative = [keys[0][d.key][2] for d in shared]
    names = {d.key for d in shared}
    for s, key in zip(setups, keys, strict=True):
        common.append(np.array([key[d.key][0] for d in shared]))
        signs.append(np.array([key[d.key][1] * d.sign for d in shared], float))
        rest = [i for i, d in enumerate(s.responses.dofs) if d.key not in names]
        others.append(np.array(rest, int))
        where.append(len(dofs) + np.arange(len(rest)))
        dofs += [s.responses.dofs[i] for i in rest]
        derivative += [int(s.responses.derivative[i]) for i in rest]
    return _Layout(common, signs, others, tuple(dofs), np.array(derivative), where)


def _correlations(prepared: Prepared, references: NDArray[np.int_], n_lags: int, groups: int) -> Any:
    """Correlations of a set-up with the shared sensors, in about ``groups`` equal blocks."""
    total = prepared.samples
    counts = [max(1, min(round(groups * run.shape[1] / total), (run.shape[1] - n_lags) // n_lags)) for run in prepared.runs]
    parts = [correlate(run, references, n_lags, n, True, centre=True) for run, n in zip(prepared.runs, counts, strict=True)]
    return pool(parts, [run.shape[1] for run in prepared.runs])


@dataclass(frozen=True)
class _Pieces:
    """Correlations of one set-up with unit power at the shared sensors: of these, and of the others, whole and by block."""

    shared: NDArray[np.float64]
    others: NDArray[np.float64]
    shared_blocks: NDArray[Any]
    other_blocks: NDArray[Any]
    weights: NDArray[np.float64]
    scale: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        mean: NDArray[Any],
        blocks: NDArray[Any] | None,
        weights: NDArray[Any],
        references: NDArray[np.int_],
        signs: NDArray[np.float64],
        others: NDArray[np.int_],
    ) -> _Pieces:
        """Pieces of pooled correlations; other sensors are scaled to unit power each, as the excitation of their set-up has it."""
        assert blocks is not None
        at_shared = mean[0][references, np.arange(references.size)]
        power = float(np.mean(np.abs(at_shared)))
        # power of the other sensors from their coherence with the shared ones is not needed: any positive scale will do
        scale = np.sqrt(np.mean(mean[:, others] ** 2, axis=(0, 2)) / power**2) if others.size else np.zeros(0)
        scale = np.maximum(scale, 1e-300)
        shared = lambda c: c[..., references, :] * (signs[:, None] * signs[None, :]) / power  # noqa: E731
        rest = lambda c: c[..., others, :] * signs[None, :] / (power * scale[:, None])  # noqa: E731
        return cls(shared(mean), rest(mean), shared(blocks), rest(blocks), weights, scale)


class _Chain:
    """Correlations → common basis → state matrix, for the whole and with one block of one set-up left out."""

    def __init__(self, pieces: list[_Pieces], rows: int, samples: list[int], rate: float) -> None:
        self.pieces, self.rows, self.rate = pieces, rows, rate
        self.q = pieces[0].shared.shape[1]
        share = np.asarray(samples, float) / sum(samples)
        mean = np.sum([s * p.shared for s, p in zip(share, pieces, strict=True)], axis=0)
        self.left = whitening_factor(mean, rows, sum(samples), past=False)
        self.past = [whitening_factor(p.shared, rows, n, past=True) for p, n in zip(pieces, samples, strict=True)]
        self.root = np.sqrt(share)
        self.parts = [self._part(k, p.shared, p.others) for k, p in enumerate(pieces)]
        self.grams = [part[0] @ part[0].T for part in self.parts]
        self.basis = self._basis(self.grams, self.parts)
        self.size = self.basis[0].shape[1]

    def _part(self, k: int, shared: NDArray[Any], others: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Weighted Hankel matrices of a set-up: of the shared sensors (whitened on both sides), of the others (on the right)."""
        right = lambda h: solve_triangular(self.past[k], h.T, lower=True, check_finite=False).T  # noqa: E731
        first = right(block_hankel(shared, self.rows, self.rows))
        weighted = solve_triangular(self.left, first, lower=True, check_finite=False) * self.root[k]
        if others.shape[1] == 0:
            return weighted, np.zeros((0, weighted.shape[1]))
        return weighted, right(block_hankel(others, self.rows, self.rows)) * self.root[k]

    def _basis(self, grams: list[NDArray[Any]], parts: list[Any], n: int | None = None) -> tuple[NDArray[Any], list[Any]]:
        """Common left singular vectors, and of each set-up the QR factors of its right-hand side in that basis with the others' rows."""
        _, vectors = eigh(np.sum(grams, axis=0))
        u = vectors[:, ::-1][:, : n or min(vectors.shape[0], MAX_ORDER + 1)]
        sides = []
        for weighted, others in parts:
            orthogonal, triangle = np.linalg.qr((u.T @ weighted).T)
            sides.append((triangle, others @ orthogonal))
        return u, sides

    def observability(self, basis: tuple[NDArray[Any], list[Any]], n: int) -> NDArray[np.float64]:
        """(rows, m, n): shared sensors first, then the others set-up by set-up."""
        u, sides = basis
        blocks = [(self.left @ u[:, :n]).reshape(self.rows, self.q, n)]
        for triangle, rest in sides:
            if rest.shape[0]:
                inverse = solve_triangular(triangle[:n, :n], np.eye(n), trans="T", lower=False, check_finite=False)
                blocks.append((rest[:, :n] @ inverse).reshape(self.rows, -1, n))
        return np.concatenate(blocks, axis=1)

    def poles(self, n: int, basis: tuple[NDArray[Any], list[Any]] | None = None) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """hz, zeta, shapes (m, p) and λ of one order, one of each conjugate pair."""
        observability = self.observability(basis or self.basis, n)
        m = observability.shape[1]
        flat = observability.reshape(-1, n)
        up, down = flat[:-m], flat[m:]
        state = np.linalg.solve(up.T @ up, up.T @ down)
        mu, vectors = np.linalg.eig(state)
        keep = mu.imag > 1e-12
        lam = np.log(mu[keep]) * self.rate
        rank = np.argsort(np.abs(lam))
        lam = lam[rank]
        shapes = observability[0] @ vectors[:, keep][:, rank]
        return np.abs(lam) / 2 / np.pi, -lam.real / np.abs(lam), shapes, lam

    def without(self, k: int, b: int, n: int) -> tuple[NDArray[Any], list[Any]]:
        """The basis with block ``b`` of set-up ``k`` left out."""
        p = self.pieces[k]
        w = p.weights[b]
        less = [(whole - w * block[b]) / (1 - w) for whole, block in ((p.shared, p.shared_blocks), (p.others, p.other_blocks))]
        part = self._part(k, less[0], less[1])
        parts = [part if j == k else other for j, other in enumerate(self.parts)]
        grams = [part[0] @ part[0].T if j == k else g for j, g in enumerate(self.grams)]
        return self._basis(grams, parts, n)


def _conclude(chain: _Chain, chosen: list[tuple[int, int]], stabilization: Stabilization, layout: _Layout) -> Joint:
    """Modes at the orders chosen, and their jackknife deviations."""
    wanted = np.array([stabilization.table.frequency_hz[row] for _, row in chosen])
    taken = np.array([order for order, _ in chosen])
    n, m = wanted.size, len(layout.dofs)
    scale = np.concatenate([np.ones(chain.q), *[p.scale for p in chain.pieces]])

    def at(basis: Any, near: NDArray[Any] | None) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        hz, zeta, shapes = np.zeros(n), np.zeros(n), np.zeros((m, n), complex)
        for order in np.unique(taken):
            f, z, v, lam = chain.poles(int(order), basis)
            for i in np.flatnonzero(taken == order):
                j = int(np.argmin(np.abs(f - wanted[i]) if near is None else np.abs(lam - near[i])))
                hz[i], zeta[i] = f[j], z[j]
                raw = v[:, j] * scale
                shapes[:, i] = to_displacement(raw[:, None], lam[[j]], layout.derivative)[:, 0]
        return hz, zeta, normalise_shapes(shapes)

    hz, zeta, shapes = at(None, None)
    w = 2 * np.pi * hz
    lam = -zeta * w + 1j * w * np.sqrt(1 - zeta**2)
    variance = [np.zeros(n), np.zeros(n), np.zeros((m, n))]
    freedom = 0
    for k, piece in enumerate(chain.pieces):
        g = piece.weights.size
        freedom += g - 1
        found = [at(chain.without(k, b, int(taken.max())), lam) for b in range(g)]
        for q in range(3):
            values = np.array([x[q] for x in found])
            variance[q] += (g - 1) / g * np.sum(np.abs(values - values.mean(axis=0)) ** 2, axis=0)
    widen = student_widening(max(freedom, 3))
    std = [np.sqrt(v) * widen for v in variance]
    rank = np.argsort(hz)
    return Joint(layout.dofs, hz[rank], zeta[rank], shapes[:, rank], std[0][rank], std[1][rank], std[2][:, rank], stabilization)
