"""Derivatives of FRFs as rows of a least-squares problem: few products over lines, then how each unknown moves these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import OF_A_CHANNEL, OF_A_FORCE, Between, Outside
from operando.diagnosis.idle import Idle, Moves
from operando.diagnosis.products import Compliance, Rows
from operando.diagnosis.terms import Term, slopes

Array = NDArray[Any]
_LAWS = ("", "_slope", "_corner", "_late")


@dataclass
class Moved:
    """An idle model at a point: poles (terms,) [Hz, ratio], shapes ``phi`` (DOFs, terms) and how these move from there.

    ``by_f`` and ``by_zeta`` (terms, g) say how g moves the poles; ``root`` and ``more`` are factors on all frequencies and on all damping,
    ``whole`` is the relative change of the stiffness of the whole.
    """

    f: Array
    zeta: Array
    by_f: Array
    by_zeta: Array
    phi: Array
    shapes: Moves
    root: float
    more: float
    whole: float

    @property
    def later(self) -> float:
        """Factor on the lags of shapes: damping that ties modes to what lies outside the band, over the stiffness there."""
        return self.more / self.root**2


@dataclass(frozen=True)
class FirstOrder:
    """Terms that are linear in the change δ of their shape b: they add k (b bᵀ + b δᵀ + δ bᵀ) = k ((b + δ) bᵀ + b δᵀ).

    ``base`` and ``shapes`` (DOFs, l) are b and b + δ of the ``terms`` (l,); both are the shape as it is at places between sensors, where no
    products were measured. ``k`` is (lines, l).
    """

    terms: Array
    base: Array
    shapes: Array
    k: Array

    def started(self, phi: Array) -> Array:
        """Shapes (…, DOFs, all terms) with b for these terms."""
        if not self.terms.size:
            return phi
        out = np.array(phi)
        out[..., self.terms] = self.base
        return out

    @property
    def change(self) -> Array:
        return self.shapes - self.base

    def rest(self, columns: Array | list[int]) -> Array:
        """k b δᵀ at some DOFs, (lines, DOFs, columns)."""
        return np.asarray((self.base * self.k[:, None]) @ self.change[columns].T)


@dataclass
class Parts:
    """FRFs of a point (lines, responses, references) and the products that they and their derivatives are made of."""

    idle: Idle
    between: Between
    references: Array
    terms: tuple[Term, ...]
    reaching: Array  # own unknowns of a touched or driven DOF that reach all channels
    reaching_dofs: list[int]
    w: Array
    moved: Moved
    lag: Array | None
    lags: Moves | None
    k: Compliance
    first_order: FirstOrder
    phi: Array  # b of terms that are linear in the change of their shape
    shape_k: Array  # of all shapes as they are
    columns: Array  # of the structure without effects, at the touched DOFs
    inner: Array
    stiff: Array
    force: Array  # at the touched DOFs
    kx: Array  # (lines, terms, references)
    acting: Array  # (lines, DOFs, references): of the structure at its places
    structure: Array  # as the sensors show it
    here: list[int]
    outside: list[Outside]
    order: Array
    laws: dict[str, Array]
    sensors: Array
    forces: Array
    factor: Array
    h: Array
    damping_between: Array
    damping_scale: Array


class Derivatives:
    """By all unknowns at a point.

    A change of pole r moves an FRF by ψ_r k_r (…) of two factors, and so do changes of shapes; what depends on the lines are only these
    products, some five for each mode. They are brought to rows once, and each unknown is a real combination of them.
    """

    def __init__(self, parts: Parts, rows: Rows) -> None:
        self.of, self.rows = parts, rows
        self.modes = parts.idle.modes
        self.n_shape = parts.idle.shapes.own.shape[2]
        self.n_terms = parts.moved.f.size
        self.moving = np.flatnonzero(~parts.idle.assumed)  # terms whose poles move by themselves
        self.following = (self.moving != parts.idle.lacking).astype(float)[:, None]  # those that differ with the day
        self.dofs = parts.order.tolist()

    def all(self) -> tuple[Array, Array]:
        """By what reaches all channels, and by the unknowns of the response's own DOF (zero where these reach all channels).

        (responses, references, rows, 2, n) and (responses, references, rows, 2, k), real and imaginary parts side by side.
        """
        p = self.of
        self._made()
        known = p.between
        n_g, n_d = p.idle.f_root.shape[1], known.shared_spread.size
        starts = np.cumsum([0, n_g, n_d, len(p.outside), *(len(term.values) for term in p.terms)])
        n = int(starts[-1]) + len(p.reaching_dofs) * p.reaching.size
        responses, references, _, count, _ = self.poles.shape
        shared = np.zeros((responses, references, count, 2, n))
        own = np.zeros((responses, references, count, 2, self.n_shape + known.own_spread.shape[1]))
        by_part, own_by_part = (np.moveaxis(v, 3, 2) for v in (shared, own))
        self._by_g(by_part[..., :n_g])
        self._by_d(by_part[..., n_g : n_g + n_d])
        self._by_direct(by_part[..., n_g + n_d : starts[-1]])
        for term, start, stop in zip(p.terms, starts[3:-1], starts[4:], strict=True):
            self._by_values(term, by_part[..., start:stop])
        self._own(own_by_part)
        start = int(starts[-1])
        for dof in p.reaching_dofs:
            self._far(dof, by_part[..., start : start + p.reaching.size])
            start += p.reaching.size
        for row, dof in enumerate(self.dofs):
            if dof in p.reaching_dofs:
                own[row][..., p.reaching] = 0
        return shared, own

    def _made(self) -> None:
        """The products over lines, as rows (responses, references, part, rows, k)."""
        p, m, w = self.of, self.modes, self.of.w[:, None]
        here, columns = p.here, p.columns[:, p.order]
        touched_columns = columns - columns @ (p.inner @ p.columns[:, here])
        psi = p.phi[..., p.order, :] - touched_columns @ (p.stiff @ p.phi[..., here, :])
        self.touched_columns = touched_columns
        self.reached = -touched_columns @ p.stiff  # what forces at the touched DOFs do elsewhere: passive = 1 + reached
        sensors = p.sensors[:, p.order].T[:, None, :, None]
        forces = p.forces.T[None, :, :, None]
        pk = np.moveaxis(p.k.after(psi), 0, 1)[:, None]  # (responses, 1, lines, terms)
        kt = np.moveaxis(p.kx, 2, 0)[None]
        at_sensor, at_force = sensors * pk, forces * kt
        core = -at_sensor[..., self.moving] * at_force[..., self.moving]
        sensor_change, force_change = (v * side for v, side in zip(self._changes(), (sensors, forces), strict=True))
        if np.isin(self.moving, p.first_order.terms).any():
            core -= at_sensor[..., self.moving] * force_change[..., self.moving]
            core -= sensor_change[..., self.moving] * at_force[..., self.moving]
        response, driven = sensors * at_force, forces * at_sensor
        reached = np.swapaxes(self.reached, 0, 1)[:, None]  # (responses, 1, lines, touched)
        force = np.transpose(p.force, (2, 0, 1))[None]  # (1, references, lines, touched)
        touched = []
        for i, dof in enumerate(here):
            at_response, at_driven = response, driven
            if dof in p.idle.midway:
                at_response, at_driven = response + sensors * force_change, driven + forces * sensor_change
            touched.append(reached[..., i : i + 1] * at_response - force[..., i : i + 1] * at_driven)
        still = self._still([at_sensor[:, 0], sensor_change[:, 0]], [(at_force + force_change)[0], at_force[0]])
        groups = [[core, 1j * w * core, still], *([v] for v in (response, driven, *touched))]
        if p.lags is not None:
            groups[1:] = [[v, -1j * w * v[..., m]] for (v,) in groups[1:]]
        self.poles, self.response, self.driven, *self.touched = self._as_rows(groups)
        factor = sensors * forces
        seen = factor * np.transpose(p.structure[:, p.order], (1, 2, 0))[..., None]
        laws = np.stack([np.broadcast_to(p.laws[name], p.w.size) for name in _LAWS], -1)
        plain = factor * np.concatenate([np.ones_like(w), -1 / w**2], 1)
        self.channel, self.plain, *self.plain_reached = self._as_rows(
            [[seen * laws], [plain], *([reached[..., i : i + 1] * plain] for i in range(len(here)))]
        )
        self.pairs = np.zeros(0)
        self.between: Array | None = None
        shared = p.between.shared
        asked = any(shared[name].stop > shared[name].start for name in ("stiffness_between", "damping_between", "damping_local"))
        if asked or p.idle.between_root.any() or p.idle.between.any():
            self.pairs, self.between = self._of_pairs(at_sensor, at_force)

    def _of_pairs(self, at_sensor: Array, at_force: Array) -> tuple[Array, Array]:
        """Rows by a stiffness and by a damping between two modes, of unit size."""
        known, w = self.of.between, self.of.w[:, None]
        both = at_sensor[..., known.first] * at_force[..., known.second]
        both += at_sensor[..., known.second] * at_force[..., known.first]
        n = known.first.size
        planes = np.empty((*both.shape[:2], 2, both.shape[2], 2 * n))
        stiffness, damping = planes[..., :n], planes[..., n:]
        np.negative(both.real, out=stiffness[:, :, 0])
        np.negative(both.imag, out=stiffness[:, :, 1])
        np.multiply(both.imag, w, out=damping[:, :, 0])
        np.multiply(both.real, -w, out=damping[:, :, 1])
        made = self.rows.of(planes)
        return made[..., :n], made[..., n:]

    def _changes(self) -> tuple[Array, Array]:
        """What the changes of terms that are linear in them do at the sensors, and at the forces: zero for all others."""
        p, first = self.of, self.of.first_order
        psi = first.change[p.order] - self.touched_columns @ (p.stiff @ first.change[p.here])
        driven = first.change[p.references].T - first.change[p.here].T @ p.force
        at_sensor = np.zeros((len(self.dofs), 1, p.w.size, self.n_terms), complex)
        at_force = np.zeros((1, p.references.size, p.w.size, self.n_terms), complex)
        at_sensor[:, 0, :, first.terms] = np.transpose(psi * first.k[:, None], (2, 1, 0))
        at_force[0, :, :, first.terms] = np.transpose(driven * first.k[:, :, None], (1, 2, 0))
        return at_sensor, at_force

    def _still(self, at_sensor: list[Array], at_force: list[Array]) -> Array:
        """What terms add whose poles move only with those of the whole: by the whole stiffness, and by all damping.

        Of FRFs that are sums of products of factors at the sensors (responses, lines, terms) and at the forces (references, lines, terms).
        """
        made, still, w = self.of.moved, np.setdiff1d(np.arange(self.n_terms), self.moving), self.of.w
        f, damping, none = made.f[still, None], made.zeta[still, None], np.zeros((still.size, 1))
        change = 1 / (2 * (1 + made.whole))
        right = np.concatenate([v[..., still] for v in at_force], -1)
        out = []
        for factors in (self._by_pole(f * change, -damping * change, still), self._by_pole(none, damping, still)):
            by_line = factors[: still.size, 0] + 1j * w[:, None] * factors[still.size : 2 * still.size, 0]
            left = np.concatenate([v[..., still] * by_line for v in at_sensor], -1)
            out.append(-np.transpose(np.swapaxes(left, 0, 1) @ np.moveaxis(right, 0, 2), (1, 2, 0)))
        return np.stack(out, -1)

    def _as_rows(self, groups: list[list[Array]]) -> list[Array]:
        """Complex values (responses, references, lines, k) as rows, those of one group side by side."""
        sizes = [sum(v.shape[-1] for v in group) for group in groups]
        values = [v for group in groups for v in group]
        shape = np.broadcast_shapes(*(v.shape[:-1] for v in values))
        planes = np.empty((*shape[:2], 2, shape[2], sum(sizes)))
        start = 0
        for v in values:
            stop = start + v.shape[-1]
            planes[:, :, 0, :, start:stop], planes[:, :, 1, :, start:stop] = v.real, v.imag
            start = stop
        ends = np.cumsum([0, *sizes])
        made = self.rows.of(planes)
        return [made[..., a:b] for a, b in pairwise(ends)]

    def _moves(self, of: str) -> Array:
        """How shapes move, and how they lag, below each other: (DOFs, terms + modes, unknowns)."""
        p = self.of
        shapes = getattr(p.moved.shapes, of)
        return shapes if p.lags is None else np.concatenate([shapes, getattr(p.lags, of)], 1)

    def _by_pole(self, by_f: Array, by_zeta: Array, terms: Array | None = None) -> Array:
        """Factors on the products of poles, from changes of f [Hz] and ζ of those that move by themselves, (products, k)."""
        made, terms = self.of.moved, self.moving if terms is None else terms
        wr = (2 * np.pi * made.f[terms])[:, None]
        parts = [4 * np.pi * wr * by_f, 4 * np.pi * made.zeta[terms, None] * by_f + 2 * wr * by_zeta]
        return np.concatenate([*parts, np.zeros((2, by_f.shape[1]))])

    def _by_g(self, out: Array) -> None:
        p, made = self.of, self.of.moved
        by_poles = self._by_pole(made.by_f[self.moving], made.by_zeta[self.moving])
        by_poles[-1] = p.idle.residual_damping
        moves = self._moves("shared")
        k, size = by_poles.shape[0], moves.shape[1]
        products = np.concatenate([self.poles, self.response, self.driven, *self.touched], -1)
        factors = np.empty((len(self.dofs), p.references.size, products.shape[-1], out.shape[-1]))
        factors[:, :, :k] = by_poles
        factors[:, :, k : k + size] = moves[p.order][:, None]
        factors[:, :, k + size : k + 2 * size] = moves[p.references]
        for number, dof in enumerate(p.here):
            start = k + (2 + number) * size
            factors[:, :, start : start + size] = moves[dof]
        np.matmul(products, factors[:, :, None], out=out)
        if self.between is not None and p.idle.between_root.any():
            out += self.between @ (p.damping_scale[:, None] * p.idle.between_root)

    def _by_later(self) -> Array | float:
        """Rows by the logarithm of all lags."""
        p = self.of
        if p.lag is None:
            return 0.0
        moves = np.concatenate([np.zeros((len(p.lag), self.n_terms)), p.lag], 1)
        out = self.response @ moves[p.order][:, None, None, :, None] + self.driven @ moves[p.references][:, None, :, None]
        for rows, dof in zip(self.touched, p.here, strict=True):
            out += rows @ moves[dof][:, None]
        return np.asarray(out)

    def _by_whole(self) -> Array:
        """Rows by the relative stiffness of the whole."""
        made = self.of.moved
        change = self.following / (2 * (1 + made.whole))
        factors = self._by_pole(made.f[self.moving, None] * change, -made.zeta[self.moving, None] * change)
        factors[-2] = 1
        return np.asarray(self.poles @ factors - self._by_later() / (1 + made.whole))

    def _by_all_damping(self) -> Array:
        """Rows by the logarithm of all damping."""
        made = self.of.moved
        factors = self._by_pole(np.zeros((self.moving.size, 1)), self.following * made.zeta[self.moving, None])
        factors[-1] = 1
        out = np.asarray(self.poles @ factors + self._by_later())
        return out if self.between is None else out + self.between @ (self.of.damping_scale * self.of.damping_between)[:, None]

    def _by_d(self, out: Array) -> None:
        p, m, made = self.of, self.modes, self.of.moved
        known = p.between
        each = (self.moving[:, None] == m) * self.following
        none, f, zeta = np.zeros_like(each), made.f[self.moving, None], made.zeta[self.moving, None]

        def laws_of_force(law: str) -> Array:
            column = np.zeros((*self.channel.shape[:-1], p.references.size))
            for j in range(p.references.size):
                column[:, j, ..., j] = self.channel[:, j, ..., _LAWS.index(law)]
            return column

        def driven() -> Array:
            unlike = np.zeros((*self.driven.shape[:-1], p.references.size * m.size))
            for j, dof in enumerate(p.references):
                unlike[:, j, ..., j * m.size : (j + 1) * m.size] = self.driven[:, j][..., m] @ self._across(dof)
            return unlike

        def local() -> Array:
            assert self.between is not None
            damping = self._by_pole(none, each * zeta) @ known.local_modes
            return self.poles @ damping + self.between @ (p.damping_scale[:, None] * known.local_pairs)

        by_name: dict[str, Callable[[], Array]] = {
            "stiffness": self._by_whole,
            "damping": lambda: self.poles @ self._by_pole(none, each * zeta),
            "damping_whole": self._by_all_damping,
            "damping_local": local,
            "mode": lambda: self.poles @ self._by_pole(each * f, none),
            "driven": driven,
            "late": lambda: 2 * np.pi * self._upper * self.channel[..., 3:],
            **{name: partial(laws_of_force, name.removeprefix("force")) for name in OF_A_FORCE},
        }
        for name, where in known.shared.items():
            if where.stop == where.start:
                continue
            if name == "stiffness_between":
                np.multiply(self.pairs, known.stiffness_scale * known.shared_spread[where], out=out[..., where])
            elif name == "damping_between":
                assert self.between is not None
                np.multiply(self.between, p.damping_scale * known.shared_spread[where], out=out[..., where])
            else:
                np.multiply(by_name[name](), known.shared_spread[where], out=out[..., where])

    @property
    def _upper(self) -> float:
        """Upper end of the band [Hz]: of the delay that the law of a channel has."""
        return self.of.between.band[1]

    def _across(self, dof: int) -> Array:
        """What of a change of a DOF's shape is across its shape at rest, (modes, modes)."""
        return self.of.between.across(np.eye(self.modes.size), np.full(self.modes.size, dof))

    def _by_direct(self, out: Array) -> None:
        """By what lies outside the band at the places of effects, and by the values of structural effects: each has a law of its own."""
        p, start = self.of, len(self.of.outside)
        self._by_outside(out)
        columns: list[Array] = []
        at: list[int] = []
        for term in p.terms:
            if term.structural:
                b = [p.here.index(i) for i in term.places]
                moving = p.acting[:, list(term.places)]
                columns += [-self.touched_columns[..., b] @ (slope @ moving) for slope in slopes(term, p.w, p.between.band)]
                at += range(start, start + len(term.values))
            start += len(term.values)
        if columns:
            values = np.stack([np.transpose(v * p.factor, (1, 2, 0)) for v in columns], -1)
            out[..., at] = self._as_rows([[values]])[0]

    def _by_outside(self, out: Array) -> None:
        """By what lies outside the band at the places of effects: a response shows it at its own DOF, and through the effects."""
        p = self.of
        laws = {row.below: row.law(1j * p.w) for row in p.outside}  # all of one side have one
        if not laws:
            return
        both, here = np.stack([*laws.values()], -1), len(p.here)
        force = -np.transpose(p.force, (2, 0, 1))[..., None] * both[:, None]  # (references, lines, places, laws)
        alone = np.transpose(p.factor, (1, 2, 0))[..., None] * force.reshape(*force.shape[:2], -1)
        reached = np.swapaxes(self.reached, 0, 1)[:, None, ..., None]  # (responses, 1, lines, places, 1)
        through = (reached * alone[..., None, :]).reshape(*alone.shape[:3], -1)
        at_own, at_all = self._as_rows([[alone], [through]])
        at_own = at_own.reshape(*at_own.shape[:-1], here, -1)
        at_all = at_all.reshape(*at_all.shape[:-1], here, here, -1)
        for number, row in enumerate(p.outside):
            column, law, place = out[..., number], [*laws].index(row.below), p.here.index(row.place)
            column[p.order == row.other] = at_own[p.order == row.other, ..., place, law]
            if row.other in p.here:
                other = p.here.index(row.other)
                column += at_all[..., other, place, law]
                if other != place:
                    column += at_all[..., place, other, law]
                    column[p.order == row.place] += at_own[p.order == row.place, ..., other, law]
            column *= row.spread

    def _by_values(self, term: Term, out: Array) -> None:
        """By the values of an effect that adds no dynamic stiffness."""
        p, made = self.of, self.of.moved
        if term.structural or not term.values:
            return
        if term.kind == "global_stiffness":
            out[...] = self._by_whole() * (term.size or 0.0)
        elif term.kind == "global_damping":
            out[...] = self._by_all_damping()
        elif p.idle.lacking is not None and term.kind == "missing_mode":
            alone = (self.moving == p.idle.lacking).astype(float)[:, None]
            f, zeta = made.f[self.moving, None], made.zeta[self.moving, None]
            none = np.zeros_like(alone)
            by = [self._by_pole(alone * f, none), self._by_pole(none, alone * zeta)]
            out[...] = self.poles @ np.concatenate(by, 1)
        else:
            late = term.kind.endswith("_delay")
            by_value = 2 * np.pi * self._upper * self.channel[..., 3] if late else self.channel[..., 0]
            if term.definition.group == "force":
                mine = p.references == term.places[0]
                out[..., 0][:, mine] = -by_value[:, mine]
            else:
                mine = p.order == term.places[0]
                out[..., 0][mine] = by_value[mine]

    def _own(self, out: Array) -> None:
        p, known = self.of, self.of.between
        np.matmul(self.response, self._moves("own")[p.order][:, None, None], out=out[..., : self.n_shape])
        for name, where in known.own.items():
            if where.stop == where.start:
                continue
            spread = known.own_spread[p.order, where]
            mine = out[..., self.n_shape + where.start : self.n_shape + where.stop]
            if name in OF_A_CHANNEL:
                law = _LAWS.index(name.removeprefix("sensor"))
                np.multiply(self.channel[..., law : law + 1], spread[:, None, None, None], out=mine)
            elif name == "seen":
                across = np.stack([self._across(dof) for dof in self.dofs]) * spread[:, None]
                np.matmul(self.response[..., self.modes], across[:, None, None], out=mine)
            else:
                plain = self.plain[..., int(name == "rest_below")]
                for j in range(p.references.size):
                    mine[:, j, ..., j] = plain[:, j] * spread[:, j, None, None]

    def _far(self, dof: int, out: Array) -> None:
        """By the unknowns of one DOF that reach all channels: as a response, as a driven DOF and through an effect there."""
        p, known = self.of, self.of.between
        own, shape = self._moves("own")[dof], out[..., : self.n_shape]
        rows, driven = np.flatnonzero(p.order == dof), np.flatnonzero(p.references == dof)
        number = p.here.index(dof) if dof in p.here else None
        if number is not None:
            np.matmul(self.touched[number], own, out=shape)
        shape[rows] += self.response[rows] @ own
        shape[:, driven] += self.driven[:, driven] @ own
        start = self.n_shape
        for name in ("rest_above", "rest_below"):
            spread = known.own_spread[dof, known.own[name]]
            law = int(name == "rest_below")
            for j in range(spread.size):
                column = out[:, j, ..., start + j]
                if number is not None:
                    column += self.plain_reached[number][:, j, ..., law] * spread[j]
                column[rows] += self.plain[rows, j][..., law] * spread[j]
            start += spread.size
