"""One place and one record: the restoring force without a law, and regressions on restoring forces.

On each line the weighted error is split into its part along h_b = H0·b, a scalar that a force at the place can make, and the rest, which no
force there can. The nuisance (free decays, and what another day leaves open) is eliminated through its normal equations, which do not
depend on the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from operando.diagnosis.records.run import Run
from operando.structure.modal_space import Complex, Real

TOGETHER = 8.0
"""Errors stay together over so many lines: what is stated with a standard deviation counts by as much more against them."""

Normal = tuple[Real, Real, float]
"""Normal equations: gram (c, c), right (c,), and Σ|weighted error|² that there is to explain."""


def summed(parts: Sequence[Normal]) -> Normal:
    """Normal equations of several runs in one."""
    return np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0), float(sum(p[2] for p in parts))


def left_by(normal: Normal, values: Real) -> float:
    """Σ|weighted error|² that columns with these factors leave."""
    gram, right, total = normal
    return total - 2 * float(values @ right) + float(values @ gram @ values)


def solved(normal: Normal, rcond: float | None = None, ridge: float = 0.0) -> Real:
    """Factors of the columns, each scaled to unit size first; combinations below ``rcond`` stay zero, ``ridge`` draws all towards it."""
    gram, right, _ = normal
    size = np.diag(gram)
    scale = np.sqrt(np.where(size > 0, size, np.inf))  # what no line shows stays zero
    system = gram / np.outer(scale, scale) + ridge * np.eye(scale.size)
    return np.asarray(np.linalg.lstsq(system, right / scale, rcond=rcond)[0] / scale)


@dataclass(frozen=True)
class Weighted:
    """A run with its weights, and the normal equations of its J columns of nuisance."""

    run: Run
    root: Real  # 1/σ of each line (q, L)
    error: Complex  # error over σ (q, L)
    gram: Real  # normal matrix of the nuisance (J, J)
    right: Real  # its right side
    total: float  # Σ|error/σ|²

    @classmethod
    def of(cls, run: Run, error: Complex | None = None, gram: Real | None = None) -> Weighted:
        """Weights from the run's variance; another error of the same run where given, with the Gram matrix known."""
        root = 1 / np.sqrt(run.variance)
        weighted = (run.error if error is None else error) * root
        # Column j at response i is nuisance_shapes[i, j]·nuisance[j].
        pulled = run.nuisance_shapes.T @ (weighted * root)
        right = np.sum(run.nuisance.real * pulled.real + run.nuisance.imag * pulled.imag, axis=1)
        if gram is None:
            gram = nuisance_gram(run.nuisance, run.nuisance_shapes, root)
            gram[np.diag_indices_from(gram)] *= 1 + 1e-10
            gram += run.nuisance_prior
        return cls(run, root, weighted, gram, right, float(np.sum(np.abs(weighted) ** 2)))

    @property
    def raw(self) -> Complex:
        """The error itself."""
        return self.error / self.root

    def with_error(self, error: Complex) -> Weighted:
        """The same run and weights with another (unweighted) error."""
        return Weighted.of(self.run, error, self.gram)

    def ringing(self) -> tuple[Real, float]:
        """Amplitudes of the nuisance alone, and Σ|error/σ|² with them."""
        amplitudes = cho_solve(cho_factor(self.gram), self.right)
        return amplitudes, self.total - float(self.right @ amplitudes)

    def decayed(self) -> Complex:
        """Weighted error without the nuisance."""
        return np.asarray(self.error - self.run.fallen(self.ringing()[0]) * self.root)


def nuisance_gram(columns: Complex, shapes: Real, root: Real) -> Real:
    """Normal matrix Σ Re(d_j·d_k*)·Σ_i φ_ij·φ_ik/σ_i² of columns (J, L) with shapes (q, J) and weights 1/σ (q, L)."""
    j, count = columns.shape
    # Where the noise is even over some lines they share the sum over responses.
    edges = np.concatenate([[0], 1 + np.flatnonzero(np.any(np.diff(root, axis=1) != 0, axis=0)), [count]])
    gram = np.zeros((j, j))
    if edges.size - 1 < count / 4:
        for a, b in pairwise(edges):
            d = apart(columns[:, a:b])
            weighted = shapes * root[:, a, None]
            gram += (d @ d.T) * (weighted.T @ weighted)
        return gram
    for shape, r in zip(shapes, root, strict=True):
        both = apart(columns * r)
        gram += (both @ both.T) * np.outer(shape, shape)
    return gram


def apart(a: Complex) -> Real:
    """Real parts, then imaginary parts, along the lines."""
    return np.concatenate([a.real, a.imag], axis=-1)


@dataclass(frozen=True)
class Along:
    """A weighted run seen along one place, x = b·displacements."""

    weighted: Weighted
    b: Real  # (m,)
    h: Complex  # accelerations per unit force along b (q, L)
    gain: Real  # |h/σ| over all responses: how strongly a force at the place shows on a line (L,)
    error: Complex  # part of the weighted error along h (L,)
    nuisance: Complex  # parts of the nuisance along h (J, L)
    open: Complex  # restoring forces of a unit of the spring and damper that another day leaves open here (2, L), or of none
    open_prior: Real  # inverse variances of their sizes

    @classmethod
    def of(cls, weighted: Weighted, b: Real, h: Complex) -> Along:
        """Split the run along b."""
        run = weighted.run
        seen = h * weighted.root
        gain = np.maximum(np.sqrt(np.sum(np.abs(seen) ** 2, axis=0)), 1e-300)
        u = seen / gain
        error = np.sum(u.conj() * weighted.error, axis=0)
        nuisance = run.nuisance * ((u.conj() * weighted.root).T @ run.nuisance_shapes).T
        return cls(weighted, b, h, gain, error, nuisance, *_open_springs(run, b))

    @property
    def run(self) -> Run:
        """The run."""
        return self.weighted.run

    def taken(self, spread: Real | float) -> Real:
        """How far the data decide about the force on each line, 0 … 1, if its spectrum is expected to be of size ``spread``."""
        strength = np.minimum((self.gain * np.minimum(spread, 1e150)) ** 2, 1e30)
        return np.asarray(strength / (1 + strength))

    def free_force(self, spread: Real | float = np.inf, mean: Complex | None = None) -> tuple[Complex, Real, float]:
        """Restoring force (L,) without a law, amplitudes (J,) of the nuisance, Σ|weighted error|² that no force at the place explains.

        ``spread`` is the standard deviation of the force's spectrum about ``mean`` (0), infinite where nothing is known.
        """
        weight = self.weighted
        expected = 0.0 if mean is None else mean
        error = self.error + self.gain * expected
        # Along h the error has variance 1 + strength, across it 1.
        taken = self.taken(spread)
        both = apart(self.nuisance)
        gram = weight.gram - (both * np.tile(taken, 2)) @ both.T
        gram[np.diag_indices_from(gram)] += 1e-9 * np.diag(weight.gram)
        right = weight.right + both @ apart(error * (1 - taken) - self.error)
        amplitudes = cho_solve(cho_factor(gram), right)
        rest = error - amplitudes @ self.nuisance
        force = expected - rest * taken / self.gain
        total = weight.total + float(np.sum(np.abs(error) ** 2 * (1 - taken) - np.abs(self.error) ** 2))
        return force, amplitudes, total - float(amplitudes @ right)

    def normal(self, forces: Complex) -> Normal:
        """Normal equations of a regression of the error on restoring forces (c, L), nuisance and open springs eliminated."""
        n = len(forces)
        gram, right, total = self._with_open(forces)
        if len(gram) == n:
            return gram, right, total
        inner = np.linalg.solve(gram[n:, n:], np.column_stack([gram[n:, :n], right[n:]]))
        out = gram[:n, n:] @ inner
        return gram[:n, :n] - out[:, :-1], right[:n] - out[:, -1], total - float(right[n:] @ inner[:, -1])

    def beside(self, force: Complex) -> Complex:
        """A restoring force (L,) with what open springs there add to it."""
        gram, right, _ = self._with_open(force[None])
        return np.asarray(force + np.linalg.solve(gram[1:, 1:], right[1:] - gram[1:, 0]) @ self.open) if len(gram) > 1 else force

    def _with_open(self, forces: Complex) -> Normal:
        """Normal equations of restoring forces (c, L) and of the open springs after them, nuisance eliminated."""
        n = len(forces)
        both = apart(np.asarray(-np.concatenate([forces, self.open]) * self.gain, complex))
        cross = both @ apart(self.nuisance).T
        inner = cho_solve(cho_factor(self.weighted.gram), np.column_stack([cross.T, self.weighted.right]))
        gram = both @ both.T - cross @ inner[:, :-1]
        right = both @ apart(self.error) - cross @ inner[:, -1]
        gram[np.arange(n, len(gram)), np.arange(n, len(gram))] += self.open_prior
        return gram, right, self.weighted.total - float(self.weighted.right @ inner[:, -1])

    def under(self, force: Complex) -> Weighted:
        """The weighted run with a restoring force (L,) at the place."""
        return self.weighted.with_error(self.weighted.raw + self.h * force)

    def on(self, part: Weighted, keep: Any) -> Along:
        """The same on some of the lines; ``part`` is the run on them, with its Gram matrix."""
        return replace(
            self,
            weighted=part.with_error(self.weighted.raw[:, keep]),
            h=self.h[:, keep],
            gain=self.gain[keep],
            error=self.error[keep],
            nuisance=self.nuisance[:, keep],
            open=self.open[:, keep],
        )


def _open_springs(run: Run, b: Real) -> tuple[Complex, Real]:
    """Restoring forces of a unit of spring and damper across a place b under the motion measured, and inverse variances of their sizes."""
    place = np.flatnonzero(b)
    at = np.array([int(np.flatnonzero(run.rows == i)[0]) for i in place if i in run.rows], int)
    std = run.springs.get(tuple(place.tolist()))
    if std is None or at.size < place.size:
        return np.zeros((0, run.hz.size), complex), np.zeros(0)
    x = b[place] @ (run.beside[at] - run.responses[at][:, run.lines]) / run.omega**2
    return np.stack([x, 1j * run.omega * x]), (TOGETHER / np.asarray(std)) ** 2
