"""FRFs that an idle model makes with what differs between the days and with effects, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operando.diagnosis.between import OF_A_CHANNEL, OF_A_FORCE, OUTSIDE, Between, channel_laws
from operando.diagnosis.idle import Idle, Moves
from operando.diagnosis.products import Compliance, each_dof, laid, motion, through, times
from operando.diagnosis.terms import Term, added, slopes, touched

Array = NDArray[Any]


@dataclass(frozen=True)
class Outside:
    """What lies outside the band between an undriven place of an effect and an undriven DOF: no column of the test tells it."""

    place: int
    other: int
    below: bool
    spread: float


@dataclass(frozen=True)
class Point:
    """Unknowns in units of their prior standard deviations, and effects.

    Parameters
    ----------
    g : (g,) array
        Of the idle model, shared by all DOFs.
    d : (d,) array
        Between the days, shared by all channels.
    own : (DOFs, k) array
        Of each DOF: its shape, then its channel.
    u : (u,) array
        What lies outside the band at the places of the effects: see :meth:`Forward.outside`.
    terms : tuple of Term
    """

    g: Array
    d: Array
    own: Array
    u: Array
    terms: tuple[Term, ...] = ()


@dataclass
class Prediction:
    """FRFs (lines, responses, references) and their derivatives.

    Attributes
    ----------
    shared : (lines, responses, references, n) array
        By g, d, u, the effects' values, and the unknowns of touched or driven DOFs that reach all channels.
    own : (lines, responses, references, k) array
        By the unknowns of the response's own DOF; zero for those that stand in ``shared``.
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
class Moved:
    """An idle model at a point.

    Attributes
    ----------
    f, zeta : (terms,) arrays
        Hz, ratio.
    phi : (DOFs, terms) array
    shapes : Moves
        How they move from there.
    root, more : float
        Factors on all frequencies and on all damping.
    whole : float
        Relative change of the stiffness of the whole.
    by_mode, by_damping : (terms,) arrays
        Further factors on each frequency; all factors on each damping.
    """

    f: Array
    zeta: Array
    phi: Array
    shapes: Moves
    root: float
    more: float
    whole: float
    by_mode: Array
    by_damping: Array


@dataclass
class Forward:
    """The model of one check.

    Parameters
    ----------
    idle : Idle
    between : Between
    responses, references : int arrays
        DOFs of the rows and columns.
    band : (float, float)
        Hz.
    """

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

    @property
    def start(self) -> Point:
        """The idle model as it is."""
        return Point(np.zeros(self.n_g), np.zeros(self.n_d), np.zeros((self.n_dofs, self.n_own)), np.zeros(0))

    def outside(self, terms: Sequence[Term]) -> list[Outside]:
        """What lies outside the band at the undriven places of effects: own values, and those to other undriven places."""
        out, known, here, shown = [], self.between, touched(terms), set(self.responses.tolist())
        for place in here:
            if not self.undriven[place]:
                continue
            for below, own, name in ((False, known.own_above, "above"), (True, known.own_below, "below")):
                if below and not known.below.size:
                    continue
                out.append(Outside(place, place, below, OUTSIDE[f"own_{name}"] * float(own[place])))
                for other in np.flatnonzero(self.undriven):
                    # where nothing was measured and nothing acts, nothing shows it
                    if other != place and (other in shown or other in here):
                        out.append(Outside(place, int(other), below, OUTSIDE[f"row_{name}"] * float(np.sqrt(own[place] * own[other]))))
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
        return self._forward(x, w, derivatives, False)[0]

    def scannable(self, x: Point, w: Array) -> Scannable:
        """FRFs with all columns of the structure."""
        found = self._forward(x, w, False, True)[1]
        assert found is not None
        return found

    def moved(self, x: Point) -> Moved:
        """Idle model, stiffness and damping of the whole, frequencies and damping mode by mode."""
        idle, m, terms = self.idle, self.modes, x.terms
        part = self.between.shared_parts(x.d)
        whole = float(part["stiffness"].sum()) + sum(t.size or 0.0 for t in terms if t.kind == "global_stiffness")
        root = np.sqrt(max(1 + whole, 0.05))
        more = np.exp(part["damping_whole"].sum() + sum(t.values[0] for t in terms if t.kind == "global_damping"))
        by_mode, by_damping = np.ones(self.n_terms), np.full(self.n_terms, more)
        by_mode[m], by_damping[m] = np.exp(part["mode"]), more * np.exp(part["damping"])
        f = (idle.f + idle.f_root @ x.g) * root * by_mode
        zeta = (idle.zeta + idle.zeta_root @ x.g) / root * by_damping
        phi, shapes = idle.shape(x.g, x.own[:, : self.n_shape])
        if idle.lacking is not None:
            mode = next((t for t in terms if t.kind == "missing_mode"), None)
            if mode is None:
                phi[:, idle.lacking] = shapes.shared[:, idle.lacking] = shapes.own[:, idle.lacking] = 0
            else:
                own_f, own_zeta = np.exp(mode.values)
                f[idle.lacking], zeta[idle.lacking] = own_f * root * by_mode[-1], own_zeta / root * by_damping[-1]
        return Moved(f, zeta, phi, shapes, float(root), float(more), whole, by_mode, by_damping)

    def _forward(self, x: Point, w: Array, derivatives: bool, every: bool) -> tuple[Prediction, Scannable | None]:
        idle, known, n, m, nd, refs = self.idle, self.between, w.size, self.modes, self.n_dofs, self.references
        shape_own, rest = x.own[:, : self.n_shape], x.own[:, self.n_shape :]
        part, own = known.shared_parts(x.d), known.own_parts(rest)
        terms, line = x.terms, w[:, None]
        made = self.moved(x)
        f, zeta, phi, shapes, root, more, whole = made.f, made.zeta, made.phi, made.shapes, made.root, made.more, made.whole
        by_mode, by_damping = made.by_mode, made.by_damping
        if idle.complex:
            lag, lags = idle.late(x.g, shape_own)
            phi = np.broadcast_to(phi, (n, nd, self.n_terms)).astype(complex)
            phi[:, :, m] -= 1j * w[:, None, None] * lag
        wr = 2 * np.pi * f
        own_dynamic = wr**2 - line**2 + 2j * zeta * wr * line
        damping_between = idle.between + idle.between_root @ x.g + part["damping_between"]
        damping_scale = known.damping_scale * more
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
        phi_f = np.swapaxes(phi[..., refs, :] + driven, -1, -2)
        shape_k = k.after(phi)
        h0 = shape_k @ phi_f + own["rest_above"] - own["rest_below"] / line[:, :, None] ** 2
        # structural effects: a low-rank update in the DOFs they touch
        here, stiff, by_values = self._added(terms, w)
        phi_here = phi[..., here, :]
        columns = shape_k @ np.swapaxes(phi_here, -1, -2)
        outside = self.outside(terms)
        for row, value in zip(outside, x.u * np.array([row.spread for row in outside]), strict=True):
            change = -value / w**2 if row.below else np.full(n, value)
            columns[:, row.other, here.index(row.place)] += change
            if row.other in here and row.other != row.place:
                columns[:, row.place, here.index(row.other)] += change
        inner = np.linalg.solve(np.eye(len(here)) + stiff @ columns[:, here], stiff)
        structure = h0 - columns @ (inner @ h0[:, here])
        touched_columns = columns - columns @ (inner @ columns[:, here])
        force = stiff @ structure[:, here]
        psi = phi - touched_columns @ (stiff @ phi_here)
        kx = k.before(phi_f - np.swapaxes(phi_here, -1, -2) @ force)
        beside = seen @ kx
        structure = structure + beside
        order = self.order(terms)
        laws = channel_laws(w / 2 / np.pi, self.band)
        sensors, forces = self._channels(terms, part, own, laws, w)
        factor = sensors[:, order, None] * forces[:, None]
        h = structure[:, order] * factor
        none = np.zeros((*h.shape, 0), complex)
        scannable = None
        if every:
            all_columns = shape_k @ np.swapaxes(phi, -1, -2)
            scannable = Scannable(h, all_columns - columns @ (inner @ all_columns[:, here]), structure, factor, order)
        if not derivatives:
            return Prediction(h, none, none), scannable

        pk, kt = k.after(psi), np.swapaxes(kx, 1, 2)
        reached = -touched_columns @ stiff  # what forces at the touched DOFs do elsewhere: passive = 1 + reached
        core = -pk[:, :, None, :] * kt[:, None]
        by_f = core * ((2 * wr + 2j * zeta * line) * 2 * np.pi)[:, None, None]
        by_zeta = core * (2j * wr * line)[:, None, None]

        blocks: list[Array] = []
        # g: poles, shapes
        scale = root * by_mode
        by_poles = np.concatenate([idle.f_root * scale[:, None], idle.zeta_root * (by_damping / root)[:, None]])
        by_g = times(np.concatenate([by_f, by_zeta], -1), by_poles)
        at_sensors = each_dof(kt, shapes.shared)
        if idle.complex:
            late = -1j * w[:, None, None, None]
            at_sensors = at_sensors + late * each_dof(kt[:, :, m], lags.shared)
        by_g = by_g + through(at_sensors, reached, at_sensors[:, here])
        # a unit motion of a driven DOF, and of a touched one against the force there
        for j, ref in enumerate(refs):
            by_g[:, :, j] += times(pk, shapes.shared[ref])
            if idle.complex:
                by_g[:, :, j] += late[..., 0] * times(pk[:, :, m], lags.shared[ref])
        for i, dof in enumerate(here):
            by_shape = times(pk, shapes.shared[dof])
            if idle.complex:
                by_shape += late[..., 0] * times(pk[:, :, m], lags.shared[dof])
            by_g -= by_shape[:, :, None] * force[:, None, i, :, None]
        pairs = any(known.shared[name].stop > known.shared[name].start for name in ("damping_between", "damping_local"))
        if pairs or idle.between_root.any() or idle.between.any():
            both = pk[:, :, None, known.first] * kt[:, None, :, known.second] + pk[:, :, None, known.second] * kt[:, None, :, known.first]
            by_between = both * (-1j * w[:, None, None, None] * damping_scale)
            if idle.between_root.any():
                by_g = by_g + times(by_between, idle.between_root)
        else:
            both = by_between = np.zeros((n, nd, refs.size, known.first.size), complex)
        blocks.append(by_g)
        # d
        by_whole = by_f @ (f / 2 / (1 + whole)) - by_zeta @ (zeta / 2 / (1 + whole))
        by_more = by_zeta @ zeta + by_between @ damping_between
        unlike = np.zeros((n, nd, refs.size, refs.size * m.size), complex)
        column = np.zeros((refs.size, *structure.shape, 1), complex)
        for j in range(refs.size):
            unlike[:, :, j, j * m.size : (j + 1) * m.size] = known.across(pk[:, :, m], refs[j])
            column[j, :, :, j, 0] = structure[:, :, j]
        of_force = np.concatenate(list(column), -1)
        by_name = {
            "stiffness": lambda: by_whole[..., None],
            "damping": lambda: by_zeta[..., m] * zeta[m],
            "damping_whole": lambda: by_more[..., None],
            "damping_local": lambda: times(by_zeta[..., m] * zeta[m], known.local_modes) + times(by_between, known.local_pairs),
            "mode": lambda: by_f[..., m] * f[m],
            "driven": lambda: unlike,
            "force": lambda: of_force,
            "force_slope": lambda: of_force * laws["_slope"][:, None, None, None],
            "force_corner": lambda: of_force * laws["_corner"][:, None, None, None],
            "force_late": lambda: of_force * laws["_late"][:, None, None, None],
            "late": lambda: (-1j * w[:, None, None] * structure)[..., None],
            "stiffness_between": lambda: -both * known.stiffness_scale,
            "damping_between": lambda: by_between,
        }
        for name, where in known.shared.items():
            if where.stop > where.start:
                blocks.append(by_name[name]() * known.shared_spread[where])
        # u
        for row in outside:
            slope = (-1 / w**2 if row.below else np.ones(n)) * row.spread
            by_row = -motion(reached, here, row.other, nd)[:, :, None] * force[:, here.index(row.place), None]
            if row.other in here and row.other != row.place:
                by_row = by_row - motion(reached, here, row.place, nd)[:, :, None] * force[:, here.index(row.other), None]
            blocks.append((by_row * slope[:, None, None])[..., None])
        # effects
        for term, laws_of in zip(terms, by_values, strict=True):
            if term.structural:
                acted = (structure - beside)[:, here]
                blocks += [(-touched_columns @ (slope @ acted))[..., None] for slope in laws_of]
            elif term.kind == "global_stiffness":
                blocks.append(by_whole[..., None] * (term.size or 0.0))
            elif term.kind == "global_damping":
                blocks.append(by_more[..., None])
            elif term.kind == "missing_mode":
                blocks += [(v[..., idle.lacking] * of[idle.lacking])[..., None] for v, of in ((by_f, f), (by_zeta, zeta))]
            elif term.values:
                only = np.zeros((*structure.shape, 1), complex)
                by_value = -1j * w if term.kind.endswith("_delay") else np.ones(n)
                if term.definition.group == "force":
                    j = int(np.flatnonzero(refs == term.places[0])[0])
                    only[:, :, j, 0] = -structure[:, :, j] * by_value[:, None]
                else:
                    only[:, term.places[0], :, 0] = structure[:, term.places[0]] * by_value[:, None]
                blocks.append(only)
        # own unknowns of each DOF
        mine = np.zeros((n, nd, refs.size, self.n_own), complex)
        mine[..., : self.n_shape] = each_dof(kt, shapes.own)
        if idle.complex:
            mine[..., : self.n_shape] += late * each_dof(kt[:, :, m], lags.own)
        for name, where in known.own.items():
            if where.stop == where.start:
                continue
            at = slice(self.n_shape + where.start, self.n_shape + where.stop)
            if name in OF_A_CHANNEL:
                mine[..., at] = structure[..., None] * laws[name.removeprefix("sensor")][:, None, None, None]
            elif name == "seen":
                mine[..., at] = known.across(kt[:, None, :, m], (slice(None), None))
            else:
                slope = np.ones(n) if name == "rest_above" else -1 / w**2
                for j in range(refs.size):
                    mine[:, :, j, at.start + j] = slope[:, None]
            mine[..., at] *= known.own_spread[:, None, where]
        for dof in self.reaching_dofs(terms):
            column_of = motion(reached, here, dof, nd)[:, :, None, None]
            far = column_of * mine[:, dof][:, None, :, self.reaching]
            active = np.zeros((n, refs.size), complex)
            active[:, refs == dof] = 1
            if dof in here:
                active -= force[:, here.index(dof)]
            by_shape = pk @ shapes.own[dof]
            if idle.complex:
                by_shape = by_shape - 1j * w[:, None, None] * (pk[:, :, m] @ lags.own[dof])
            far[..., : self.n_shape] += by_shape[:, :, None] * active[:, None, :, None]
            blocks.append(far)
        for dof in self.reaching_dofs(terms):
            mine[:, dof][..., self.reaching] = 0
        measured = factor[..., None]
        shared = np.empty((*h.shape, sum(block.shape[-1] for block in blocks)), complex)
        start = 0
        for block in blocks:
            stop = start + block.shape[-1]
            np.multiply(block[:, order], measured, out=shared[..., start:stop])
            start = stop
        return Prediction(h, shared, mine[:, order] * measured), scannable

    def _added(self, terms: Sequence[Term], w: Array) -> tuple[list[int], Array, list[list[Array]]]:
        """Touched DOFs, the dynamic stiffness over them (lines, k, k), and its derivatives for each term."""
        here = touched(terms)
        stiff = np.zeros((w.size, len(here), len(here)), complex)
        by_values: list[list[Array]] = []
        for term in terms:
            if not term.structural:
                by_values.append([])
                continue
            b = [here.index(i) for i in term.places]

            stiff += laid(added(term, w, self.band), b, len(here))
            by_values.append([laid(slope, b, len(here)) for slope in slopes(term, w, self.band)])
        return here, stiff, by_values

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
