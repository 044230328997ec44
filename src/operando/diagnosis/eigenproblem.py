"""Poles and shapes of an idle model with effects: the matrix T(s) whose null vectors they are, and the way to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import Outside, from_places
from operando.diagnosis.derivatives import Moved
from operando.diagnosis.forward import Forward, Point
from operando.diagnosis.idle import Moves
from operando.diagnosis.terms import Term, added, resonator, touched
from operando.structure.eigenproblem import with_inside

Array = NDArray[Any]
_TURNS, _CLOSE = 30, 1e-11  # of Newton's method; relative change of a pole at which it ends
_STEP = 1e-5  # of s, for derivatives by s: error of second order, 1e-10


@dataclass
class System:
    """T(s) = diag(ω² + 2ζωs + s²) + what ties modes + Φᵀ W(s) Φ at a point, with W = (Z⁻¹ + R)⁻¹ at the places of the effects.

    ``lag`` (DOFs, terms) is in s; ``seen`` (DOFs, terms) what sensors show of a mode beside its shape; ``stiffness_tie`` and
    ``damping_tie`` (pairs,) are between two modes; ``here`` are the DOFs that effects touch.
    """

    forward: Forward
    x: Point
    moved: Moved
    lag: Array
    lags: Moves
    seen: Array
    stiffness_tie: Array
    damping_tie: Array
    here: list[int]
    outside: list[Outside]

    @classmethod
    def of(cls, forward: Forward, x: Point) -> System:
        idle, known, m = forward.idle, forward.between, forward.modes
        shape_own, rest = x.own[:, : forward.n_shape], x.own[:, forward.n_shape :]
        part, own = known.shared_parts(x.d), known.own_parts(rest)
        moved = forward.moved(x)
        late, late_moves = idle.late(x.g, shape_own, moved.later)
        lag = np.zeros_like(moved.phi)
        lag[:, m] = late
        seen = np.zeros_like(moved.phi)
        seen[:, m] = known.across(own["seen"])
        stiffness = part["stiffness_between"] * known.stiffness_scale
        damping = (idle.between + idle.between_root @ x.g + part["damping_between"]) * known.damping_scale * moved.more
        return cls(forward, x, moved, lag, late_moves, seen, stiffness, damping, touched(x.terms), forward.outside(x.terms))

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.x.terms

    @property
    def w(self) -> Array:
        """Natural frequencies of the terms [rad/s]."""
        return np.asarray(2 * np.pi * self.moved.f)

    def phi(self, s: Array) -> Array:
        """Shapes at s, (k, DOFs, terms)."""
        return np.asarray(self.moved.phi - s[:, None, None] * self.lag)

    def z(self, s: Array, terms: Sequence[Term] | None = None) -> Array:
        """Dynamic stiffness of the effects, or of some of them, (k, places, places)."""
        out = np.zeros((s.size, len(self.here), len(self.here)), complex)
        for term in self.terms if terms is None else terms:
            if term.structural:
                b = np.array([self.here.index(i) for i in term.places])
                out[:, b[:, None], b] += added(term, -1j * s, self.forward.band)
        return out

    def r(self, s: Array) -> Array:
        """What lies outside the band, from the places of the effects to all DOFs, (k, DOFs, places)."""
        return from_places(self.outside, self.x.u, self.here, self.forward.n_dofs, s)

    def force(self, s: Array, terms: Sequence[Term] | None = None) -> Array:
        """W(s): what displacements of the modes at the places hold them back by, (k, places, places)."""
        z = self.z(s, terms)
        return np.linalg.solve(np.eye(len(self.here)) + z @ self.r(s)[:, self.here], z)

    def tied(self, s: Array) -> Array:
        """T(s), (k, terms, terms)."""
        w, zeta, known = self.w, self.moved.zeta, self.forward.between
        out = np.zeros((s.size, w.size, w.size), complex)
        i = np.arange(w.size)
        out[:, i, i] = w**2 + 2 * zeta * w * s[:, None] + s[:, None] ** 2
        tie = self.stiffness_tie + s[:, None] * self.damping_tie
        out[:, known.first, known.second] += tie
        out[:, known.second, known.first] += tie
        at = self.phi(s)[:, self.here]
        return np.asarray(out + np.swapaxes(at, 1, 2) @ self.force(s) @ at)

    def displacement(self, s: Array, q: Array) -> Array:
        """All DOFs as their sensors would show them, (k, DOFs)."""
        phi = self.phi(s)
        held = self.force(s) @ (phi[:, self.here] @ q[..., None])
        return np.asarray(((phi + self.seen) @ q[..., None] - self.r(s) @ held)[..., 0])

    def by_s(self, of: Any, s: Array) -> Array:
        """Derivative of something by s."""
        h = _STEP * np.abs(s)
        up, down = of(s + h), of(s - h)
        return np.asarray((up - down) / (2 * h).reshape(-1, *[1] * (up.ndim - 1)))

    def bordered(self, s: Array, q: Array) -> Array:
        """[T, T'q; qᴴ, 0], whose inverse gives the change of q and s, (k, terms + 1, terms + 1)."""
        n = q.shape[1]
        out = np.zeros((s.size, n + 1, n + 1), complex)
        out[:, :n, :n] = self.tied(s)
        out[:, :n, n] = (self.by_s(self.tied, s) @ q[..., None])[..., 0]
        out[:, n, :n] = q.conj()
        return out

    def refined(self, s: Array, q: Array) -> tuple[Array, Array]:
        """Poles and modal coordinates of unit norm, by Newton's method.

        ``LinAlgError`` if it does not end, or two start values lead to one mode.
        """
        q = q / np.linalg.norm(q, axis=1)[:, None]
        for _ in range(_TURNS):
            left = (self.tied(s) @ q[..., None])[..., 0]
            right = -np.concatenate([left, np.zeros((s.size, 1))], 1)
            step = np.linalg.solve(self.bordered(s, q), right[..., None])[..., 0]
            change = step[:, -1]
            limited = np.minimum(1, 0.05 * np.abs(s) / np.maximum(np.abs(change), 1e-300))
            s, q = s + limited * change, q + limited[:, None] * step[:, :-1]
            q = q / np.linalg.norm(q, axis=1)[:, None]
            if not np.all(np.isfinite(s)):
                break
            if np.all(np.abs(change) < _CLOSE * np.abs(s)):
                gap = np.abs(s[:, None] - s) + np.diag(np.full(s.size, np.inf))
                if np.any(gap < 1e-7 * np.abs(s)):
                    break
                return s, q
        raise np.linalg.LinAlgError("poles were not found")

    def quadratic(self, some: Array) -> tuple[Array, ...]:
        """M, C, K whose T(s) agrees with this one at both ends of the band, without lags.

        Over some of the terms, then over what resonates inside effects: that exactly, but for what lies outside the band at its places.
        """
        w, zeta, known = self.w, self.moved.zeta, self.forward.between
        mass, damping, stiffness = np.eye(w.size), np.diag(2 * zeta * w), np.diag(w**2)
        for matrix, tie in ((damping, self.damping_tie), (stiffness, self.stiffness_tie)):
            matrix[known.first, known.second] += tie
            matrix[known.second, known.first] += tie
        inside = [(term, form) for term in self.terms if (form := resonator(term, self.forward.band)) is not None]
        own = [term for term, _ in inside]
        parts = polynomial(self.force(1j * self.ends, [t for t in self.terms if t not in own]), self.ends)
        phi = self.moved.phi[:, some]
        at, square = phi[self.here], np.ix_(some, some)
        out = tuple(a[square] + at.T @ part @ at for a, part in zip((mass, damping, stiffness), parts, strict=True))
        for term, form in inside:
            out = with_inside(out, phi[list(term.places)], form)
        return out

    @property
    def ends(self) -> Array:
        """Both ends of the band [rad/s]."""
        return 2 * np.pi * np.array(self.forward.band)


def polynomial(z: Array, w: Array) -> tuple[Array, Array, Array]:
    """M, C, K of a dynamic stiffness at two frequencies, exact where it is one of them, (2, k, k) → three (k, k).

    Else the dissipated force by least squares: loss that does not grow with frequency would be a damper without bound at a low one.
    """
    mass = (z[0] - z[1]).real / (w[1] ** 2 - w[0] ** 2)
    return mass, np.tensordot(w, z.imag, 1) / (w @ w), z[0].real + w[0] ** 2 * mass


def eigenmodes(mass: Array, damping: Array, stiffness: Array) -> tuple[Array, Array]:
    """All poles (…, 2n) and modal coordinates (…, 2n, n) of M, C, K (…, n, n); ``LinAlgError`` if a mass is not positive."""
    np.linalg.cholesky(mass)
    n = mass.shape[-1]
    # time in units of 1/ω keeps both halves of the state of one size
    unit = float(np.sqrt(np.median(np.diagonal(stiffness, axis1=-2, axis2=-1).ravel().clip(1e-12))))
    inverse = np.linalg.inv(mass)
    a = np.zeros((*mass.shape[:-2], 2 * n, 2 * n))
    a[..., :n, n:] = np.eye(n)
    a[..., n:, :n], a[..., n:, n:] = -inverse @ stiffness / unit**2, -inverse @ damping / unit
    poles, vectors = np.linalg.eig(a)
    return poles * unit, np.swapaxes(vectors[..., :n, :], -1, -2)


def involved(phi: Array, dofs: Sequence[int]) -> Array:
    """Numbers of the terms but for those that move one DOF only, none of these: they tie to nothing."""
    there = np.abs(phi) > 0
    return np.flatnonzero((there.sum(axis=0) > 1) | there[list(dofs)].any(axis=0))
