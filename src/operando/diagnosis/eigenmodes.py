"""Modes that an idle model makes with what differs between the days and with effects, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import OF_A_CHANNEL, channel_laws
from operando.diagnosis.eigenproblem import System, eigenmodes, involved, polynomial
from operando.diagnosis.forward import Forward, Point, Prediction
from operando.diagnosis.operating_modes import OperatingModes
from operando.diagnosis.products import Rows
from operando.diagnosis.sides import Sides
from operando.diagnosis.slopes import Slopes
from operando.diagnosis.terms import Term, added, resonator
from operando.structure.eigenproblem import with_inside

Array = NDArray[Any]
_NEAR = 1.3  # terms up to so many times beyond the band are scanned as modes


@dataclass
class Solved:
    """Those modes of a system that are paired with measured ones.

    Poles ``s`` (k,) [rad/s], modal coordinates ``q`` (k, terms), displacements at the sensors ``shown`` (k, responses); ``numbers`` says
    for each set of measured modes which of these modes each is.
    """

    s: Array
    q: Array
    shown: Array
    numbers: list[Array]


@dataclass
class Eigenmodes(Forward):
    """The model of operational modes: poles and shapes that solve T(s) q = 0 over the terms of the idle model (:class:`System`).

    Nothing is driven, so what is told of forces and driven points stays out.
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

    def derived(self, x: Point, w: Array, rows: Rows) -> tuple[Array, Slopes]:
        """Values of the measured modes, and their derivatives as rows of one response."""
        made = self.predict(x, w)
        both = made.shared, made.own
        shared, own = (rows.flat(v) if rows.basis is None else (rows.basis @ v[:, 0, 0])[None] for v in both)
        return made.h, Slopes(lambda at: (shared, own))

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

    def alone(self, x: Point) -> int:
        """The mode of the whole record that is farthest from what stands for it."""
        s, _, shown = self._rough(System.of(self, x))
        up = s.imag > 1e-3 * np.abs(s)
        return self.observed.sets[0].alone(np.abs(s[up]) / 2 / np.pi, shown[up].T)

    def _rough(self, system: System) -> tuple[Array, Array, Array]:
        """Poles, modal coordinates and displacements at the sensors of all modes, but for what lies outside the band."""
        kept = involved(system.moved.phi, system.here)
        s, some = eigenmodes(*system.quadratic(kept))
        q = np.zeros((s.size, self.n_terms), complex)
        q[:, kept] = some[:, : kept.size]
        return s, q, q @ (system.moved.phi + system.seen)[self.shown_dofs(system.terms)].T

    def _solved(self, system: System, used: Sequence[int], channel: Array) -> Solved:
        shown = self.shown_dofs(system.terms)
        s, q, roughly = self._rough(system)
        paired = self.pair(s, roughly, used, channel)
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

        ``sides`` (k, terms, n) are ∂T/∂p q; ``shown`` (k, DOFs, n) ∂x/∂p of the displacements of all DOFs, with s and q held, None where p
        moves nothing there; ``gains`` (measured modes, DOFs, n) ∂ ln of what a channel makes of its motion.
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


@dataclass(frozen=True)
class Near:
    """What a state is made of in and near the band, and as far as that goes.

    ``matrices`` are M, C, K (n, n) over the terms there, then over what resonates inside effects; ``phi`` (DOFs, terms), and what sensors
    show of them ``shown`` (responses, terms). ``rest`` (2, DOFs, DOFs) is the receptance of the other terms at the ends of the band,
    ``bare`` (values, 1) the values of the measured modes without an effect more.
    """

    matrices: tuple[Array, ...]
    phi: Array
    shown: Array
    rest: Array
    bare: Array


@dataclass(frozen=True)
class Trial:
    """An effect more about a state: M, C, K (n, n) with it, and its law.

    ``law`` is its dynamic stiffness (k, places, places) at s, with what lies outside the band; ``beyond`` what it has beyond M, C and K:
    the poles follow that to first order.
    """

    matrices: tuple[Array, ...]
    law: Callable[[Array], Array]
    beyond: Callable[[Array], Array] | None = None


@dataclass
class ScannableModes:
    """A state to which effects are added one at a time: values of the measured modes, and what each effect makes of them.

    ``h`` is (values, 1, 1); there are no ``columns``, which FRFs have.
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
    _known: Near | None = None

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
        near, places, ends, band = self._near(), np.array(terms[0].places), self.system.ends, self.forward.band
        at, still = near.phi[places], near.rest[:, places][:, :, places]
        rest = still.mean(axis=0)

        def trial(term: Term) -> Trial:
            form = resonator(term, band)
            if form is not None:
                return Trial(with_inside(near.matrices, at, form), lambda s: added(term, -1j * s, band))
            law = polynomial(_with_rest(added(term, ends, band), still), ends)

            def roughly(s: Array) -> Array:
                return np.asarray(s[:, None, None] ** 2 * law[0] + s[:, None, None] * law[1] + law[2])

            beyond = lambda s: _with_rest(added(term, -1j * s, band), rest) - roughly(s)  # noqa: E731
            return Trial(with_inside(near.matrices, at, law), roughly, beyond)

        # what is left out of the state itself is left out with an effect more, too
        return (self._of_each(near, [trial(term) for term in terms], places) + self.h[:, 0] - near.bare)[:, None, None]

    def _of_each(self, near: Near, trials: Sequence[Trial], places: Array) -> Array:
        """Values (values, n) of n trials at some places; NaN where none are."""
        follows = near.rest[:, self.forward.shown_dofs(self.x.terms)][:, :, places].real.mean(axis=0)
        out, every = np.full((self.w.size, len(trials)), np.nan), [np.stack(a) for a in zip(*(t.matrices for t in trials), strict=True)]
        fine = np.flatnonzero(np.linalg.eigvalsh(every[0])[:, 0] > 0).tolist()
        poles, coordinates = eigenmodes(*(a[fine] for a in every))
        for number, s, whole in zip(fine, poles, coordinates, strict=True):
            q = whole[:, : near.phi.shape[1]]
            motion = q @ near.phi[places].T
            one = trials[number]
            if one.beyond is not None:
                mass, damping = one.matrices[:2]
                by_s = 2 * s * np.sum(whole @ mass * whole, axis=1) + np.sum(whole @ damping * whole, axis=1)
                s = s - np.einsum("ki,kij,kj->k", motion, one.beyond(s), motion) / by_s
            psi = q @ near.shown.T - (one.law(s) @ motion[..., None])[..., 0] @ follows.T
            try:
                numbers = self.forward.pair(s, psi, self.used, self.channel)
            except np.linalg.LinAlgError:  # a damper of this size leaves fewer modes than were measured: its values stay NaN
                continue
            out[:, number] = self.forward.values(s, psi, numbers, self.used, self.channel)[self.w]
        return out

    def _near(self) -> Near:
        if self._known is None:
            system, phi = self.system, self.system.moved.phi
            w, zeta, ends = system.w, system.moved.zeta, system.ends
            close = involved(phi, system.here)
            some = close[(w[close] > ends[0] / _NEAR) & (w[close] < ends[1] * _NEAR)]
            far = np.setdiff1d(np.arange(w.size), some)
            shown = (phi + system.seen)[np.ix_(self.forward.shown_dofs(self.x.terms), some)]
            k = 1 / (w[far] ** 2 - ends[:, None] ** 2 + 2j * zeta[far] * w[far] * ends[:, None])
            near = Near(system.quadratic(some), phi[:, some], shown, (phi[:, far] * k[:, None]) @ phi[:, far].T, np.zeros(0))
            bare = self._of_each(near, [Trial(near.matrices, lambda s: np.zeros((s.size, 0, 0)))], np.zeros(0, int))
            self._known = replace(near, bare=bare)
        return self._known

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


def _with_rest(z: Array, rest: Array) -> Array:
    """Dynamic stiffness of an effect with the receptance at its places that no mode near the band has, (k, places, places)."""
    return np.asarray(np.linalg.solve(np.eye(z.shape[-1]) + z @ rest, z))
