"""FRFs that an idle model makes with what differs between the days and with effects, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import OF_A_CHANNEL, OF_A_FORCE, OUTSIDE, Between, Outside, channel_laws, from_places
from operando.diagnosis.derivatives import Derivatives, FirstOrder, Moved, Parts
from operando.diagnosis.idle import Idle
from operando.diagnosis.products import Compliance, Rows
from operando.diagnosis.slopes import Slopes, in_blocks
from operando.diagnosis.terms import Term, added, touched

Array = NDArray[Any]


@dataclass(frozen=True)
class Point:
    """Unknowns in units of their prior standard deviations, and effects.

    ``g`` is of the idle model, shared by all DOFs; ``d`` between the days, shared by all channels; ``own`` (DOFs, k) of each DOF: its
    shape, then its channel; ``u`` what lies outside the band at the places of the effects (:meth:`Forward.outside`).
    """

    g: Array
    d: Array
    own: Array
    u: Array
    terms: tuple[Term, ...] = ()

    def same(self, other: Point) -> bool:
        """Whether all values are the same."""
        pairs = [(self.g, other.g), (self.d, other.d), (self.own, other.own), (self.u, other.u)]
        return self.terms == other.terms and all(np.array_equal(a, b) for a, b in pairs)


@dataclass
class Prediction:
    """FRFs (lines, responses, references) and their derivatives.

    ``shared`` (lines, responses, references, n) by g, d, u, the effects' values, and the unknowns of touched or driven DOFs that reach all
    channels; ``own`` (lines, responses, references, k) by the unknowns of the response's own DOF, zero for those that stand in ``shared``.
    """

    h: Array
    shared: Array
    own: Array


@dataclass
class Scannable:
    """FRFs of a state with all columns of its structure, and what channels make of them."""

    h: Array
    columns: Array
    structure: Array
    channel: Array  # (lines, responses, references): measured over structure
    order: Array  # DOF that each response shows

    def measured(self, structure: Array) -> Array:
        """What the channels make of FRFs of the structure (lines, DOFs, references, …)."""
        return structure[:, self.order] * self.channel.reshape(*self.channel.shape, *[1] * (structure.ndim - 3))


@dataclass
class Forward:
    """The model of one check: ``responses`` and ``references`` are the DOFs of rows and columns; the band is in Hz."""

    idle: Idle
    between: Between
    responses: Array
    references: Array
    band: tuple[float, float]

    def __post_init__(self) -> None:
        idle = self.idle
        self.n_dofs, self.n_terms = idle.phi.shape
        self.modes = idle.modes
        self.n_g = idle.f_root.shape[1]
        self.n_d = self.between.shared_spread.size
        self.n_shape = idle.shapes.own.shape[2]
        self.n_own = self.n_shape + self.between.own_spread.shape[1]
        self.undriven = np.ones(self.n_dofs, bool)
        self.undriven[self.references] = False
        # unknowns of a DOF that reach all channels where it is touched or driven: its shape, and what lies outside the band
        reaching = [np.arange(self.n_shape)]
        for name in ("rest_above", "rest_below"):
            part = self.between.own[name]
            reaching.append(self.n_shape + np.arange(part.start, part.stop))
        self.reaching = np.concatenate(reaching)
        self._outside: dict[tuple[int, ...], list[Outside]] = {}
        self._last: tuple[Point, Array, Parts] | None = None

    @property
    def start(self) -> Point:
        """The idle model as it is."""
        return Point(np.zeros(self.n_g), np.zeros(self.n_d), np.zeros((self.n_dofs, self.n_own)), np.zeros(0))

    def outside(self, terms: Sequence[Term]) -> list[Outside]:
        """What lies outside the band at the undriven places of effects: own values, and those to other undriven places."""
        here = tuple(touched(terms))
        if here in self._outside:
            return self._outside[here]
        out, known, shown = [], self.between, set(self.responses.tolist())
        for place in here:
            if not self.undriven[place]:
                continue
            for below, own, name in ((False, known.own_above, "above"), (True, known.own_below, "below")):
                if below and not known.below.size:
                    continue
                swings = known.lag_below, known.swing_below
                out.append(Outside(place, place, below, OUTSIDE[f"own_{name}"] * float(own[place]), *swings))
                for other in np.flatnonzero(self.undriven):
                    # where nothing was measured and nothing acts, nothing shows it
                    if other != place and (other in shown or other in here):
                        spread = OUTSIDE[f"row_{name}"] * float(np.sqrt(own[place] * own[other]))
                        out.append(Outside(place, int(other), below, spread, *swings))
        self._outside[here] = out
        return out

    def reaching_dofs(self, terms: Sequence[Term]) -> list[int]:
        """DOFs whose own unknowns reach all channels: touched, or driven in the check and not at rest."""
        driven = [int(i) for i in self.references if self.idle.shapes.own[i].any()]
        return sorted({*touched(terms), *driven})

    def order(self, terms: Sequence[Term]) -> Array:
        """DOF that each response shows, swapped channels undone."""
        order = np.arange(self.n_dofs)
        for term in terms:
            if term.kind == "channel_swap":
                order[list(term.places)] = order[list(term.places)][::-1]
        return order[self.responses]

    def predict(self, x: Point, w: Array, *, derivatives: bool = True) -> Prediction:
        """FRFs and derivatives on the lines w [rad/s]; what a sensor shows beside its place enters the others' at first order only."""
        parts = self._parts(x, w)
        if not derivatives:
            none = np.zeros((*parts.h.shape, 0), complex)
            return Prediction(parts.h, none, none)
        made = Derivatives(parts, Rows()).all()
        lay = lambda v: np.moveaxis(v[..., 0, :] + 1j * v[..., 1, :], 2, 0)  # noqa: E731
        return Prediction(parts.h, *(lay(v) for v in made))

    def derived(self, x: Point, w: Array, rows: Rows) -> tuple[Array, Slopes]:
        """FRFs (lines, responses, references), and their derivatives as rows."""
        parts = self._parts(x, w)
        every = parts.h[0].size * 2 * w.size
        products = 2 * self.between.first.size + 2 * (4 + len(parts.here)) * self.n_terms  # about as many, beside g and d
        blocks = in_blocks(parts.order.size, every // parts.order.size * (self.n_g + self.n_d + self.n_own + products))

        def block(at: slice) -> tuple[Array, Array]:
            shared, own = Derivatives(replace(parts, order=parts.order[at], factor=parts.factor[:, at]), rows.of_responses(at)).all()
            return shared.reshape(len(shared), -1, shared.shape[-1]), own.reshape(len(own), -1, own.shape[-1])

        return parts.h, Slopes(block, blocks, every * (self.n_g + self.n_d + self.n_own))

    def scannable(self, x: Point, w: Array) -> Scannable:
        """FRFs with all columns of the structure."""
        made = self._parts(x, w)
        every = made.shape_k @ np.swapaxes(made.phi, -1, -2) + made.first_order.rest(np.arange(self.n_dofs))
        every = every - made.columns @ (made.inner @ every[:, made.here])
        return Scannable(made.h, every, made.structure, made.factor, made.order)

    def moved(self, x: Point) -> Moved:
        """Idle model, stiffness and damping of the whole, frequencies and damping mode by mode."""
        idle, m, terms = self.idle, self.modes, x.terms
        part = self.between.shared_parts(x.d)
        whole = float(part["stiffness"].sum()) + sum(t.size or 0.0 for t in terms if t.kind == "global_stiffness")
        root = np.sqrt(max(1 + whole, 0.05))
        more = np.exp(part["damping_whole"].sum() + sum(t.values[0] for t in terms if t.kind == "global_damping"))
        by_mode, by_damping = np.ones(self.n_terms), np.full(self.n_terms, more)
        by_mode[m], by_damping[m] = np.exp(part["mode"]), more * np.exp(part["damping"])
        f, zeta, by_f, by_zeta = idle.diagonals(x.g)
        f_factor, zeta_factor = root * by_mode, by_damping / root
        f, zeta, by_f, by_zeta = f * f_factor, zeta * zeta_factor, by_f * f_factor[:, None], by_zeta * zeta_factor[:, None]
        phi, shapes = idle.shape(x.g, x.own[:, : self.n_shape])
        if idle.lacking is not None:
            mode = next((t for t in terms if t.kind == "missing_mode"), None)
            if mode is None:
                phi[:, idle.lacking] = shapes.shared[:, idle.lacking] = shapes.own[:, idle.lacking] = 0
            else:
                # told as it is in operation, so no difference between the days moves it
                f[idle.lacking], zeta[idle.lacking] = np.exp(mode.values)
        return Moved(f, zeta, by_f, by_zeta, phi, shapes, float(root), float(more), whole)

    def _parts(self, x: Point, w: Array) -> Parts:
        """FRFs at a point, and what they are made of; those made last are kept, for a step that was tried is where the next one begins."""
        last = self._last
        if last is None or not (last[0].same(x) and np.array_equal(last[1], w)):
            last = self._last = x, w, self._made(x, w)
        return last[2]

    def _made(self, x: Point, w: Array) -> Parts:
        idle, known, n, m, nd, refs = self.idle, self.between, w.size, self.modes, self.n_dofs, self.references
        shape_own, rest = x.own[:, : self.n_shape], x.own[:, self.n_shape :]
        part, own = known.shared_parts(x.d), known.own_parts(rest)
        terms, line = x.terms, w[:, None]
        made, lag, lags = self.moved(x), None, None
        phi = made.phi
        if idle.complex:
            lag, lags = idle.late(x.g, shape_own, made.later)
            phi = np.broadcast_to(phi, (n, nd, self.n_terms)).astype(complex)
            phi[:, :, m] -= 1j * w[:, None, None] * lag
        wr = 2 * np.pi * made.f
        own_dynamic = wr**2 - line**2 + 2j * made.zeta * wr * line
        damping_between = idle.between + idle.between_root @ x.g + part["damping_between"]
        damping_scale = known.damping_scale * made.more
        coupled = part["stiffness_between"] * known.stiffness_scale + 1j * line * damping_between * damping_scale
        k = Compliance(1 / own_dynamic)
        if coupled.any():
            dynamic = np.zeros((n, self.n_terms, self.n_terms), complex)
            dynamic[:, np.arange(self.n_terms), np.arange(self.n_terms)] = own_dynamic
            dynamic[:, known.first, known.second] = dynamic[:, known.second, known.first] = coupled
            k = Compliance(k.diagonal, m, np.linalg.inv(dynamic[:, m[:, None], m]))
        driven, seen = np.zeros((refs.size, self.n_terms)), np.zeros((nd, self.n_terms))
        driven[:, m] = known.across(part["driven"].reshape(-1, m.size), refs)
        seen[:, m] = known.across(own["seen"])
        there = np.abs(phi).any(axis=tuple(range(phi.ndim - 1)))
        driven, seen = driven * there, seen * there
        shape_k = k.after(phi)
        base, between = idle.phi[:, idle.linear], [*idle.midway]
        base[between] = made.phi[between][:, idle.linear]  # the products of these no measurement told: squares of their changes count
        first = FirstOrder(idle.linear, base, made.phi[:, idle.linear], k.diagonal[:, idle.linear])
        phi = first.started(phi)
        phi_f = np.swapaxes(phi[..., refs, :] + driven, -1, -2)
        h0 = shape_k @ phi_f + first.rest(refs) + own["rest_above"] - own["rest_below"] / line[:, :, None] ** 2
        # structural effects: a low-rank update in the DOFs they touch
        here, stiff = self._added(terms, w)
        phi_here = phi[..., here, :]
        columns = shape_k @ np.swapaxes(phi_here, -1, -2) + first.rest(here)
        outside = self.outside(terms)
        columns += from_places(outside, x.u, here, nd, 1j * w)
        inner = np.linalg.solve(np.eye(len(here)) + stiff @ columns[:, here], stiff)
        acting = h0 - columns @ (inner @ h0[:, here])
        force = stiff @ acting[:, here]
        kx = k.before(phi_f - np.swapaxes(phi_here, -1, -2) @ force)
        structure = acting + seen @ kx
        order = self.order(terms)
        laws = channel_laws(w / 2 / np.pi, self.band)
        sensors, forces = self._channels(terms, part, own, laws, w)
        factor = sensors[:, order, None] * forces[:, None]
        return Parts(
            idle, known, refs, terms, self.reaching, self.reaching_dofs(terms), w, made, lag, lags, k, first, phi, shape_k, columns,
            inner, stiff, force, kx, acting, structure, here, outside, order, laws, sensors, forces, factor,
            structure[:, order] * factor, damping_between, damping_scale,
        )  # fmt: skip

    def _added(self, terms: Sequence[Term], w: Array) -> tuple[list[int], Array]:
        """Touched DOFs, and the dynamic stiffness over them (lines, k, k)."""
        here = touched(terms)
        stiff = np.zeros((w.size, len(here), len(here)), complex)
        for term in terms:
            if term.structural:
                b = np.array([here.index(i) for i in term.places])
                stiff[:, b[:, None], b] += added(term, w, self.band)
        return here, stiff

    def _channels(
        self, terms: Sequence[Term], part: dict[str, Array], own: dict[str, Array], laws: dict[str, Array], w: Array
    ) -> tuple[Array, Array]:
        """Measured over true of each DOF's sensor (lines, DOFs) and of each force, inverted (lines, references)."""
        sensors = np.exp(sum(own[name][:, 0] * laws[name.removeprefix("sensor")][:, None] for name in OF_A_CHANNEL))
        sensors = sensors * np.exp(-1j * w * part["late"])[:, None]
        forces = np.exp(sum(part[name] * laws[name.removeprefix("force")][:, None] for name in OF_A_FORCE)).astype(complex)
        for term in terms:
            definition = term.definition
            if definition.acts != "sensor_map" or term.kind == "channel_swap":
                continue
            ratio = np.asarray(definition.sensor_map(w / 2 / np.pi, term.sizes(self.band)))
            if definition.group == "force":
                forces[:, self.references == term.places[0]] /= ratio[:, None]
            else:
                sensors[:, term.places[0]] *= ratio
        return sensors, forces
