"""Modes that an idle model makes with what differs between the days and with effects, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import OF_A_CHANNEL, channel_laws
from operando.diagnosis.eigenproblem import System, eigenmodes, involved, polynomial
from operando.diagnosis.forward import Forward, Point, Prediction
from operando.diagnosis.operating_modes import OperatingModes
from operando.diagnosis.products import Rows
from operando.diagnosis.terms import Term, added, slopes

Array = NDArray[Any]
_NEAR = 1.3  # terms up to so many times beyond the band are scanned as modes


@dataclass
class Solved:
    """Those modes of a system that are paired with measured ones.

    Attributes
    ----------
    s : (k,) complex array [rad/s]
    q : (k, terms) complex array
        In modal coordinates.
    shown : (k, responses) complex array
        Displacements at the sensors.
    numbers : list of int arrays
        For each set of measured modes, which of these modes each is.
    """

    s: Array
    q: Array
    shown: Array
    numbers: list[Array]


@dataclass
class Eigenmodes(Forward):
    """The model of operational modes: poles and shapes that solve T(s) q = 0 over the terms of the idle model (:class:`System`).

    Nothing is driven, so what is told of forces and driven points stays out.

    Parameters
    ----------
    observed : OperatingModes
    """

    observed: OperatingModes

    def __post_init__(self) -> None:
        super().__post_init__()
        self.reaching = np.arange(self.n_own)
        self.undriven = ~self.idle.driven
        modes = np.cumsum([0, *(s.n for s in self.observed.sets)])
        values = np.cumsum([0, *(s.n * s.per_mode for s in self.observed.sets)])
        self._modes = [slice(int(a), int(b)) for a, b in pairwise(modes)]
        self._values = [slice(int(a), int(b)) for a, b in pairwise(values)]
        self._w = 2 * np.pi * np.concatenate([s.f for s in self.observed.sets])

    def reaching_dofs(self, terms: Sequence[Term]) -> list[int]:
        """All: the noise of a shape ties its DOFs to each other."""
        return list(range(self.n_dofs))

    def order(self, terms: Sequence[Term]) -> Array:
        """One block of rows, whose own unknowns stand among the shared ones."""
        return np.zeros(1, int)

    def predict(self, x: Point, w: Array, *, derivatives: bool = True) -> Prediction:
        """Values of the measured modes (values, 1, 1) and derivatives; ``w`` are numbers of values."""
        used = self._used(w)
        system, channel = System.of(self, x), self.channel(x)
        solved = self._solved(system, used, channel)
        h = self.values(solved.s, solved.shown, solved.numbers, used, channel)[w]
        none = np.zeros((*h.shape, 1, 1, 0))
        if not derivatives:
            return Prediction(h[:, None, None], none, none)
        shared = self._derivatives(system, solved, used, channel)[w]
        return Prediction(h[:, None, None], shared[:, None, None], np.zeros((w.size, 1, 1, self.n_own)))

    def derived(self, x: Point, w: Array, rows: Rows) -> Prediction:
        """Values of the measured modes, and their derivatives as rows (1, rows, n)."""
        made = self.predict(x, w)
        if rows.basis is None:
            return Prediction(made.h, rows.flat(made.shared), rows.flat(made.own))
        return Prediction(made.h, *((rows.basis @ v[:, 0, 0])[None] for v in (made.shared, made.own)))

    def scannable(self, x: Point, w: Array) -> ScannableModes:  # type: ignore[override]
        """A state to which effects are added one at a time."""
        return ScannableModes.of(self, x, w)

    def _used(self, w: Array) -> list[int]:
        return sorted(set(self.observed.set_of[w].tolist()))

    def shown_dofs(self, terms: Sequence[Term]) -> Array:
        """DOF that each response shows."""
        return super().order(terms)

    def channel(self, x: Point) -> Array:
        """Measured over true at the frequency of each measured mode, (modes of all sets, responses)."""
        part, own = self.between.shared_parts(x.d), self.between.own_parts(x.own[:, self.n_shape :])
        sensors, _ = self._channels(x.terms, part, own, channel_laws(self._w / 2 / np.pi, self.band), self._w)
        return sensors[:, self.shown_dofs(x.terms)]

    def pair(self, s: Array, shown: Array, used: Sequence[int], channel: Array) -> list[Array]:
        """For each set, which of some modes, shown at the sensors (k, responses), each measured one is."""
        up = np.flatnonzero(s.imag > 1e-3 * np.abs(s))
        f = np.abs(s[up]) / 2 / np.pi
        return [up[self.observed.sets[i].pairs(f, (shown[up] * channel[self._modes[i]].mean(axis=0)).T)] for i in used]

    def _solved(self, system: System, used: Sequence[int], channel: Array) -> Solved:
        shown = self.shown_dofs(system.terms)
        kept = involved(system.moved.phi, system.here)
        matrices = (a[np.ix_(kept, kept)] for a in system.quadratic())
        s, some = eigenmodes(*matrices)
        q = np.zeros((s.size, self.n_terms), complex)
        q[:, kept] = some
        paired = self.pair(s, q @ (system.moved.phi + system.seen)[shown].T, used, channel)
        every = np.unique(np.concatenate(paired))
        s, q = system.refined(s[every], q[every])
        return Solved(s, q, system.displacement(s, q)[:, shown], [np.searchsorted(every, p) for p in paired])

    def values(self, s: Array, shown: Array, numbers: Sequence[Array], used: Sequence[int], channel: Array) -> Array:
        """What was measured of these modes: values of all sets, zeros for those that are not used."""
        out = np.zeros(self.observed.w.size)
        for i, number in zip(used, numbers, strict=True):
            one = self.observed.sets[i]
            out[self._values[i]] = one.values(s[number], shown[number] * channel[self._modes[i]]).ravel()
        return out

    # derivatives

    def _derivatives(self, system: System, solved: Solved, used: Sequence[int], channel: Array) -> Array:
        """By all unknowns in the order of :class:`Problem`, (values of all sets, n)."""
        sides, shown = Sides(self, system, solved.s, solved.q).all()
        return self.passed_on(system, solved, used, channel, sides, shown, self._gains(system, sides.shape[2]))

    def passed_on(
        self, system: System, solved: Solved, used: Sequence[int], channel: Array, sides: Array, shown: Array | None, gains: Array
    ) -> Array:
        """Derivatives of the values (values of all sets, n) by unknowns p.

        Parameters
        ----------
        sides : (k, terms, n) array
            ∂T/∂p q.
        shown : (k, DOFs, n) array, optional
            ∂x/∂p of the displacements of all DOFs, with s and q held; none where p moves nothing there.
        gains : (measured modes, DOFs, n) array
            ∂ ln of what a channel makes of its motion.
        """
        s, q, count = solved.s, solved.q, sides.shape[2]
        right = np.concatenate([-sides, np.zeros((s.size, 1, count))], 1)
        moved = np.linalg.solve(system.bordered(s, q), right)
        by_q, by_s = moved[:, :-1], moved[:, -1]
        phi, order = system.phi(s), self.shown_dofs(system.terms)
        passed = phi + system.seen - system.r(s) @ (system.force(s) @ phi[:, system.here])
        along_s = system.by_s(lambda at: system.displacement(at, q), s)
        by = passed[:, order] @ by_q + along_s[:, order, None] * by_s[:, None]
        if shown is not None:
            by = by + shown[:, order]
        out = np.zeros((self.observed.w.size, count))
        for i, number in zip(used, solved.numbers, strict=True):
            one, at = self.observed.sets[i], self._modes[i]
            psi = solved.shown[number] * channel[at]
            by_psi = by[number] * channel[at][..., None] + psi[..., None] * gains[at][:, order]
            out[self._values[i]] = one.slopes(s[number], psi, by_s[number], by_psi).reshape(-1, count)
        return out

    def _gains(self, system: System, count: int) -> Array:
        """∂ ln of what a channel makes of its motion, by all unknowns, (measured modes, DOFs, n)."""
        first, w = self.n_g + self.n_d + len(system.outside), self._w
        values = sum(len(t.values) for t in system.terms)
        out = np.zeros((w.size, self.n_dofs, count), complex)
        laws, column = channel_laws(w / 2 / np.pi, self.band), first
        for term in system.terms:
            if term.definition.acts == "sensor_map" and term.definition.group != "force" and term.values:
                out[:, term.places[0], column] = -1j * w if term.kind.endswith("_delay") else 1
            column += len(term.values)
        for name in OF_A_CHANNEL:
            part = self.between.own[name]
            if part.stop > part.start:
                for i in range(self.n_dofs):
                    start = first + values + i * self.n_own + self.n_shape + part.start
                    out[:, i, start] = laws[name.removeprefix("sensor")] * self.between.own_spread[i, part.start]
        return out


class Sides:
    """∂T/∂p q and, with q and s held, ∂x/∂p of all DOFs x, for all unknowns p: (k, terms, n) and (k, DOFs, n)."""

    def __init__(self, forward: Eigenmodes, system: System, s: Array, q: Array) -> None:
        self.forward, self.system, self.s, self.q = forward, system, s, q
        here = system.here
        self.phi_here = system.phi(s)[:, here]
        self.w_force, self.r = system.force(s), system.r(s)
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
        by_poles = (self._by_f * made.f - self._by_zeta * made.zeta) / 2
        return (by_poles[..., None] - side) / (1 + made.whole), -shown / (1 + made.whole)

    def _all_damping(self) -> tuple[Array, Array]:
        between = self.system.damping_tie / (self.forward.between.damping_scale * self.system.moved.more)
        side, shown = self._later()
        return side + (self._by_zeta * self.system.moved.zeta + self._ties(True) @ between)[..., None], shown

    def _of_d(self) -> list[tuple[Array, Array]]:
        forward, known, made, m = self.forward, self.forward.between, self.system.moved, self.forward.modes

        def each(values: Array) -> Array:
            out = np.zeros((self.s.size, forward.n_terms, m.size), complex)
            out[:, m, np.arange(m.size)] = values[:, m]
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
            here, slope = system.here, row.spread * (self.s**-2.0 if row.below else np.ones(self.s.size))
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


@dataclass
class ScannableModes:
    """A state to which effects are added one at a time: values of the measured modes, and what each effect makes of them.

    Attributes
    ----------
    h : (values, 1, 1) array
    columns : None
        Of FRFs there are none.
    """

    forward: Eigenmodes
    x: Point
    w: Array
    system: System
    solved: Solved
    used: list[int]
    channel: Array
    h: Array
    columns: None = None
    _base: tuple[Array, list[Array], Array, Array] | None = None

    @property
    def at_rest(self) -> bool:
        """Whether it is the idle model as it is: then what effects make of it is the same for all spreads."""
        x = self.x
        return not (x.terms or x.g.any() or x.d.any() or x.own.any())

    @classmethod
    def of(cls, forward: Eigenmodes, x: Point, w: Array) -> ScannableModes:
        used, system, channel = forward._used(w), System.of(forward, x), forward.channel(x)
        solved = forward._solved(system, used, channel)
        h = forward.values(solved.s, solved.shown, solved.numbers, used, channel)[w]
        return cls(forward, x, w, system, solved, used, channel, h[:, None, None])

    def responses(self, terms: Sequence[Term]) -> Array:
        """Values (values, 1, 1, n) with each of some terms of one kind and place more, NaN where it leaves too few modes."""
        known = self.forward.observed.at_rest if self.at_rest else {}
        key = (*terms, self.w.size)
        if key not in known:
            known[key] = self._exact(terms) if not terms[0].structural else self._changed(terms)
        return known[key]

    def _exact(self, terms: Sequence[Term]) -> Array:
        out = []
        for term in terms:
            more = Point(self.x.g, self.x.d, self.x.own, self.x.u, (*self.x.terms, term))
            try:
                out.append(self.forward.predict(more, self.w, derivatives=False).h)
            except np.linalg.LinAlgError:
                out.append(np.full_like(self.h, np.nan))
        return np.stack(out, -1)

    def _changed(self, terms: Sequence[Term]) -> Array:
        """Over the terms in and near the band; what lies farther follows at once, with its receptance at both ends of the band."""
        if self._base is None:
            self._base = self._near()
        near, matrices, shown, rest = self._base
        places, ends = np.array(terms[0].places), self.system.ends
        at, still = self.system.moved.phi[np.ix_(places, near)], rest[:, places][:, :, places]
        stacks, laws = [[m] for m in matrices], [np.zeros((3, len(places), len(places)))]
        for term in terms:
            z = added(term, ends, self.forward.band)
            laws.append(np.stack(polynomial(np.linalg.solve(np.eye(len(places)) + z @ still, z), ends)))
            for stack, base, part in zip(stacks, matrices, laws[-1], strict=True):
                stack.append(base + at.T @ part @ at)
        follows = rest[:, self.forward.shown_dofs(self.x.terms)][:, :, places].real.mean(axis=0)
        out = np.full((self.w.size, len(terms) + 1), np.nan)
        every = [np.stack(stack) for stack in stacks]
        fine = np.linalg.eigvalsh(every[0])[:, 0] > 0
        poles, coordinates = eigenmodes(*(a[fine] for a in every))
        for number, s, q in zip(np.flatnonzero(fine).tolist(), poles, coordinates, strict=True):
            mass, damping, stiffness = (q @ at.T @ part.T for part in laws[number])
            held = s[:, None] ** 2 * mass + s[:, None] * damping + stiffness
            psi = q @ shown.T - held @ follows.T
            try:
                numbers = self.forward.pair(s, psi, self.used, self.channel)
            except np.linalg.LinAlgError:  # a damper of this size leaves fewer modes than were measured: its values stay NaN
                continue
            out[:, number] = self.forward.values(s, psi, numbers, self.used, self.channel)[self.w]
        # what is left out of the state itself is left out with an effect more, too
        return (out[:, 1:] + self.h[:, 0] - out[:, :1])[:, None, None]

    def _near(self) -> tuple[Array, list[Array], Array, Array]:
        """Terms in and near the band: numbers, M, C, K, shapes at the sensors; the receptance of the others at the band's ends."""
        system, phi = self.system, self.system.moved.phi
        w, zeta, ends = system.w, system.moved.zeta, system.ends
        close = involved(phi, system.here)
        near = close[(w[close] > ends[0] / _NEAR) & (w[close] < ends[1] * _NEAR)]
        far = np.setdiff1d(np.arange(w.size), near)
        matrices = [a[np.ix_(near, near)] for a in system.quadratic()]
        shown = (phi + system.seen)[np.ix_(self.forward.shown_dofs(self.x.terms), near)]
        k = 1 / (w[far] ** 2 - ends[:, None] ** 2 + 2j * zeta[far] * w[far] * ends[:, None])
        return near, matrices, shown, (phi[:, far] * k[:, None]) @ phi[:, far].T

    def slopes(self, terms: Sequence[Term]) -> Array:
        """By the size of each term, at size zero, (values, 1, 1, n)."""
        system, forward, s, q = self.system, self.forward, self.solved.s, self.solved.q
        sides, phi = np.zeros((s.size, forward.n_terms, len(terms)), complex), system.phi(s)
        motion = system.displacement(s, q) - (system.seen @ q[..., None])[..., 0]
        # an effect's force at a place drives modes, and through what lies outside the band the other effects
        held = np.swapaxes(phi[:, system.here], 1, 2) @ system.force(s) @ np.swapaxes(system.r(s), 1, 2)
        passed = phi - np.swapaxes(held, 1, 2)
        gains = np.zeros((forward._w.size, forward.n_dofs, len(terms)), complex)
        for number, term in enumerate(terms):
            if term.structural:
                b = list(term.places)
                unit = added(term.moved((0.0, *term.values[1:])), -1j * s, forward.band)
                force = unit @ motion[:, b, None]
                sides[..., number] = (np.swapaxes(passed[:, b], 1, 2) @ force)[..., 0]
            else:
                gains[:, term.places[0], number] = -1j * forward._w if term.kind.endswith("_delay") else 1
        slopes_of = forward.passed_on(system, self.solved, self.used, self.channel, sides, None, gains)
        return slopes_of[self.w][:, None, None]
