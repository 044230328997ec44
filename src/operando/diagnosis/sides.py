"""How the unknowns move T(s) of an idle model with effects, and what its DOFs show of its modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.eigenproblem import System
from operando.diagnosis.forward import Forward
from operando.diagnosis.terms import slopes

Array = NDArray[Any]


class Sides:
    """∂T/∂p q and, with q and s held, ∂x/∂p of all DOFs x, for all unknowns p: (k, terms, n) and (k, DOFs, n)."""

    def __init__(self, forward: Forward, system: System, s: Array, q: Array) -> None:
        self.forward, self.system, self.s, self.q = forward, system, s, q
        here = system.here
        self.phi_here = system.phi(s)[:, here]
        self.w_force, self.r = system.force(s), system.r(s)
        self.following = (np.arange(forward.n_terms) != forward.idle.lacking).astype(float)  # those that differ with the day
        self.back = np.swapaxes(self.phi_here, 1, 2) @ self.w_force  # of displacements at the places, (k, terms, places)
        self.held = (self.w_force @ (self.phi_here @ q[..., None]))[..., 0]  # force at the places

    def all(self) -> tuple[Array, Array]:
        """Blocks in the order of the unknowns."""
        blocks = [self._of_g(), *self._of_d(), *self._of_u(), *self._of_terms(), *self._of_own()]
        return tuple(np.concatenate([b[i] for b in blocks], -1) for i in (0, 1))  # type: ignore[return-value]

    def _none(self, count: int) -> tuple[Array, Array]:
        k = self.s.size
        return np.zeros((k, self.forward.n_terms, count), complex), np.zeros((k, self.forward.n_dofs, count), complex)

    @property
    def _by_f(self) -> Array:
        w, zeta = self.system.w, self.system.moved.zeta
        return np.asarray((2 * w + 2 * zeta * self.s[:, None]) * 2 * np.pi * self.q)

    @property
    def _by_zeta(self) -> Array:
        return np.asarray(2 * self.system.w * self.s[:, None] * self.q)

    def _shapes(self, moves: Array, lags: Array | None) -> Array:
        """Moves (DOFs, terms, n) at s, (k, DOFs, terms, n)."""
        if lags is None:
            return np.broadcast_to(moves, (self.s.size, *moves.shape))
        out = np.repeat(moves[None].astype(complex), self.s.size, 0)
        out[:, :, self.forward.modes] -= self.s[:, None, None, None] * lags
        return out

    def _through(self, moves: Array) -> tuple[Array, Array]:
        """Shapes that move at the places, (k, places, terms, n): T, and the force that shows through R."""
        motion = np.einsum("kjtn,kt->kjn", moves, self.q)
        side = np.einsum("kjtn,kj->ktn", moves, self.held) + self.back @ motion
        return side, -self.r @ (self.w_force @ motion)

    def _of_g(self) -> tuple[Array, Array]:
        idle, made, system = self.forward.idle, self.system.moved, self.system
        side = self._by_f[..., None] * made.by_f + self._by_zeta[..., None] * made.by_zeta
        if idle.between_root.any():
            side = side + self._ties(True) @ idle.between_root
        moves = self._shapes(made.shapes.shared, system.lags.shared if idle.complex else None)
        shown = np.einsum("kitn,kt->kin", moves, self.q)
        more, held = self._through(moves[:, system.here])
        return side + more, shown + held

    def _ties(self, damping: bool) -> Array:
        """By what ties two modes, (k, terms, pairs)."""
        known = self.forward.between
        pair = np.arange(known.first.size)
        out = np.zeros((self.s.size, self.forward.n_terms, pair.size), complex)
        scale = self.s[:, None] * known.damping_scale * self.system.moved.more if damping else known.stiffness_scale
        out[:, known.first, pair] += scale * self.q[:, known.second]
        out[:, known.second, pair] += scale * self.q[:, known.first]
        return out

    def _later(self) -> tuple[Array, Array]:
        """By the logarithm of all lags."""
        side, shown = self._none(1)
        if not self.forward.idle.complex:
            return side, shown
        moves = -self.s[:, None, None, None] * self.system.lag[..., None]
        more, held = self._through(moves[:, self.system.here])
        return side + more, np.einsum("kitn,kt->kin", moves, self.q) + held

    def _whole(self) -> tuple[Array, Array]:
        made = self.system.moved
        side, shown = self._later()
        by_poles = (self._by_f * made.f - self._by_zeta * made.zeta) * self.following / 2
        return (by_poles[..., None] - side) / (1 + made.whole), -shown / (1 + made.whole)

    def _all_damping(self) -> tuple[Array, Array]:
        between = self.system.damping_tie / (self.forward.between.damping_scale * self.system.moved.more)
        side, shown = self._later()
        poles = self._by_zeta * self.system.moved.zeta * self.following
        return side + (poles + self._ties(True) @ between)[..., None], shown

    def _of_d(self) -> list[tuple[Array, Array]]:
        forward, known, made, m = self.forward, self.forward.between, self.system.moved, self.forward.modes

        def each(values: Array) -> Array:
            out = np.zeros((self.s.size, forward.n_terms, m.size), complex)
            out[:, m, np.arange(m.size)] = (values * self.following)[:, m]
            return out

        by_name: dict[str, Callable[[], Array]] = {
            "damping": lambda: each(self._by_zeta * made.zeta),
            "damping_local": lambda: each(self._by_zeta * made.zeta) @ known.local_modes + self._ties(True) @ known.local_pairs,
            "mode": lambda: each(self._by_f * made.f),
            "stiffness_between": lambda: self._ties(False),
            "damping_between": lambda: self._ties(True),
        }
        of_all = {"stiffness": self._whole, "damping_whole": self._all_damping}
        out = []
        for name, where in forward.between.shared.items():
            count = where.stop - where.start
            if count:  # what all channels share and no mode shows, as a delay, moves nothing
                side, shown = self._none(count)
                if name in of_all:
                    side, shown = of_all[name]()
                elif name in by_name:
                    side = by_name[name]()
                spread = forward.between.shared_spread[where]
                out.append((side * spread, shown * spread))
        return out

    def _of_u(self) -> list[tuple[Array, Array]]:
        system, out = self.system, []
        for row in system.outside:
            here, slope = system.here, row.spread * row.law(self.s)
            side, shown = self._none(1)
            reached = np.zeros_like(shown[..., 0])
            reached[:, row.other] += slope * self.held[:, here.index(row.place)]
            if row.other in here and row.other != row.place:
                reached[:, row.place] += slope * self.held[:, here.index(row.other)]
            motion = reached[:, here, None]
            side[:] = -self.back @ motion
            shown[:] = self.r @ (self.w_force @ motion) - reached[..., None]
            out.append((side, shown))
        return out

    def _of_terms(self) -> list[tuple[Array, Array]]:
        system, here, out = self.system, self.system.here, []
        at_rest = (self.phi_here @ self.q[..., None])[..., 0]
        motion = at_rest - (self.r[:, here] @ self.held[..., None])[..., 0]
        left = np.eye(len(here)) + system.z(self.s) @ self.r[:, here]
        for term in system.terms:
            side, shown = self._none(len(term.values))
            if term.structural:
                b = [here.index(i) for i in term.places]
                for number, slope in enumerate(slopes(term, -1j * self.s, self.forward.band)):
                    force = np.zeros((self.s.size, len(here), 1), complex)
                    force[:, b] = slope @ motion[:, b, None]
                    force = np.linalg.solve(left, force)
                    side[..., number] = (np.swapaxes(self.phi_here, 1, 2) @ force)[..., 0]
                    shown[..., number] = -(self.r @ force)[..., 0]
            elif term.kind == "global_stiffness":
                side, shown = (part * (term.size or 0.0) for part in self._whole())
            elif term.kind == "global_damping":
                side, shown = self._all_damping()
            elif term.kind == "missing_mode" and self.forward.idle.lacking is not None:
                r, made = self.forward.idle.lacking, system.moved
                side[:, r] = np.stack([self._by_f[:, r] * made.f[r], self._by_zeta[:, r] * made.zeta[r]], -1)
            out.append((side, shown))
        return out

    def _of_own(self) -> list[tuple[Array, Array]]:
        forward, system, out = self.forward, self.system, []
        made, n_shape, seen = system.moved, forward.n_shape, forward.between.own["seen"]
        complex_shapes = forward.idle.complex
        for i in range(forward.n_dofs):
            side, shown = self._none(forward.n_own)
            moves = self._shapes(made.shapes.own[i : i + 1], system.lags.own[i : i + 1] if complex_shapes else None)
            shown[:, i, :n_shape] = np.einsum("ktn,kt->kn", moves[:, 0], self.q)
            if i in system.here:
                at = np.zeros((self.s.size, len(system.here), *moves.shape[2:]), moves.dtype)
                at[:, system.here.index(i)] = moves[:, 0]
                side[..., :n_shape], held = self._through(at)
                shown[..., :n_shape] += held
            if seen.stop > seen.start:
                columns = slice(n_shape + seen.start, n_shape + seen.stop)
                across = forward.between.across(self.q[:, forward.modes], i)
                shown[:, i, columns] = across * forward.between.own_spread[i, seen]
            out.append((side, shown))
        return out
