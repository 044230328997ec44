"""Check lines of one test, and the FRFs that an idle model with nuisance and effects makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from idle import Idle
from kinds import GLOBAL, KINDS, LINEAR_SCALE, STRUCTURAL, TWO_PLACES, Effect, stiffness, touched, with_one
from lines import CORRELATED, FIT_LINES, Lines

KEEP = 0.02  # directions of the idle model that move the FRFs by less than 0.14 σ in all are left out
SPREADS = {
    "sensor": 0.01,  # log gain of each sensor
    "force": 0.01,
    "sensor_slope": 0.005,  # gain at the upper end of the band over that at 0 Hz, growing with f² (mounting resonance)
    "force_slope": 0.005,
    "sensor_corner": 0.003,  # phase at the lower end of the band, falling with 1/f (time constant)
    "force_corner": 0.003,
    "sensor_late": 0.003,  # phase at the upper end of the band, growing with f
    "stiffness": 0.003,  # relative, of the whole
    "damping": 0.12,  # log, of each mode
    "damping_whole": 0.1,  # log, of all modes alike
    "driven": 0.025,  # shape at the driven point, over the rms of the mode's shape
    "mode": 0.0015,  # log frequency of each mode
    "seen": 0.015,  # shape that a sensor shows, over the rms of the mode's shape
    "stiffness_between": 0.0015,  # of two modes, over 2 ω_r ω_s
    "damping_between": 0.15,  # of two modes, over 2 √(ζ_r ω_r ζ_s ω_s)
    "rest_above": 0.15,  # compliance of each pair from above the band, over the root of the product of the own ones
    "rest_below": 0.15,
    "late": 3e-5,  # s, of all responses against the forces
}


CHANNEL = {
    "slope": lambda f, band: (f / band[1]) ** 2,
    "corner": lambda f, band: 1j * band[0] / f,
    "late": lambda f, band: -1j * f / band[1],
}
"""What the response of a channel may have besides a gain, as its logarithm over frequency."""
OUTSIDE = {
    "own_above": 1.0,  # own compliance of a place, over half of what lies above the band there
    "own_below": 1.0,  # own inverse mass, over what lies below
    "row_above": 0.6,  # compliance between a place and an undriven one, over the root of the product of the own ones
    "row_below": 1.0,
}


@dataclass
class Prediction:
    """FRFs (lines, sensors, references) and their derivatives by z, d, u (in σ) and the effects' values."""

    h: np.ndarray
    by_z: np.ndarray
    by_d: np.ndarray
    by_u: np.ndarray
    by_effects: np.ndarray

    @property
    def jacobian(self) -> np.ndarray:
        return np.concatenate([self.by_z, self.by_d, self.by_u, self.by_effects], -1)


@dataclass(frozen=True)
class Outside:
    """What lies outside the band between an undriven place of an effect and an undriven DOF: no column of the test tells it."""

    place: int
    other: int
    below: bool
    spread: float


@dataclass
class Scannable:
    """FRFs of a state with all columns of its structure, and what sensors make of them."""

    h: np.ndarray
    columns: np.ndarray
    structure: np.ndarray
    sensors: np.ndarray
    order: np.ndarray
    forces: np.ndarray

    def seen(self, structure: np.ndarray) -> np.ndarray:
        return structure[:, self.order] * self.sensors[:, :, None] * self.forces[:, None]


@dataclass
class Case:
    """One test: idle model θ = θ₀ + L z, nuisance d in units of its spreads, lines in two sets.

    All DOFs of the idle model must have been measured.
    """

    idle: Idle
    frf: Any
    band: tuple[float, float]
    spreads: dict[str, float] = field(default_factory=SPREADS.copy)
    number: int = FIT_LINES  # of lines to fit
    priors: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        idle = self.idle
        self.f0, self.zeta0, self.phi0 = idle.f, idle.zeta, idle.phi
        self.n_dofs, self.n_terms = self.phi0.shape
        self.lags = bool(idle.lag.any() or idle.covariance[-idle.lag.size :, -idle.lag.size :].any())
        self.modes = np.flatnonzero(~idle.residual)
        nodes: dict[Any, list[int]] = {}
        for i, dof in enumerate(idle.dofs):
            nodes.setdefault(dof.node, []).append(i)
        self.nodes = [tuple(v) for v in nodes.values()]
        self.dofs = idle.dofs
        frf = self.frf.select(
            [d for d in idle.dofs if any(d.same_axis(e) for e in self.frf.responses)],
            [d for d in idle.dofs if any(d.same_axis(e) for e in self.frf.references)],
        ).to_quantity("receptance")
        self.references = np.array([idle.dofs.index(d) for d in frf.references])
        if len(frf.responses) != self.n_dofs:
            raise ValueError("all DOFs of the idle model must be in the check")
        self.lines = Lines(frf.band(*self.band), self.f0[self.modes], self.zeta0[self.modes], self.number)
        self.band = self.lines.band
        self._prior_of_idle(np.array(idle.covariance))
        self._nuisance()
        self._compress()

    def _prior_of_idle(self, covariance: np.ndarray) -> None:
        scale = np.sqrt(np.diag(covariance))
        on = scale > 0
        values, vectors = np.linalg.eigh(covariance[np.ix_(on, on)] / np.outer(scale[on], scale[on]))
        keep = values > 1e-9 * values[-1]
        self.root = np.zeros((scale.size, int(keep.sum())))
        self.root[on] = scale[on][:, None] * vectors[:, keep] * np.sqrt(values[keep])

    def _nuisance(self) -> None:
        """Slices and spreads of d."""
        n, dofs, driven = self.modes.size, self.n_dofs, self.references
        rest = np.setdiff1d(np.arange(self.n_terms), self.modes)
        self.below = rest[self.f0[rest] < self.band[0]]
        self.above = rest[self.f0[rest] >= self.band[0]]
        self.undriven = np.ones(dofs, bool)
        self.undriven[driven] = False
        rms = np.sqrt(np.mean(self.phi0[:, self.modes] ** 2, axis=0))
        rms = np.maximum(rms, np.median(rms))  # a mode that the sensors hardly see moves as much across them
        above = 0.5 * np.sum(self.phi0[:, self.above] ** 2 / (2 * np.pi * self.f0[self.above]) ** 2, axis=1)
        self.own_above = np.maximum(above, 0.3 * np.median(above))
        self.own_below = np.sum(self.phi0[:, self.below] ** 2, axis=1)
        first, second = np.triu_indices(n, 1)
        self.first, self.second = self.modes[first], self.modes[second]
        w0 = 2 * np.pi * self.f0
        self.stiffness_scale = 2 * w0[self.first] * w0[self.second]
        loss = np.abs(self.zeta0 * w0)
        self.damping_scale = 2 * np.sqrt(loss[self.first] * loss[self.second])
        size = {
            "sensor": np.ones(dofs), "force": np.ones(driven.size), "stiffness": np.ones(1), "damping": np.ones(n),
            "damping_whole": np.ones(1),
            "driven": np.tile(rms, driven.size), "mode": np.ones(n), "seen": np.tile(rms, dofs),
            "stiffness_between": np.ones(first.size), "damping_between": np.ones(first.size), "late": np.ones(1),
            **{f"{c}_{p}": np.ones(n) for c, n in (("sensor", dofs), ("force", driven.size)) for p in CHANNEL},
            "rest_above": np.sqrt(np.outer(self.own_above[driven], self.own_above)).ravel(),
            "rest_below": np.sqrt(np.outer(self.own_below[driven], self.own_below)).ravel(),
        }  # fmt: skip
        size = {name: v if self.spreads.get(name) and v.any() else v[:0] for name, v in size.items()}
        ends = np.cumsum([0, *(v.size for v in size.values())])
        self.parts = {name: slice(a, b) for name, a, b in zip(size, ends[:-1], ends[1:], strict=True)}
        self.groups = {name: [np.arange(s.start, s.stop)] for name, s in self.parts.items()}
        for name, channels in (("seen", dofs), ("driven", driven.size)):  # one is put back more askew than another
            self.groups[name] = np.split(self.groups[name][0], channels)
        self.spread = np.concatenate([self.spreads.get(name, 0) * v for name, v in size.items()])
        self.n_d = int(ends[-1])

    def _compress(self) -> None:
        """Directions of z that the FRFs of all pairs, driven or not, could tell: an effect sees places that the check did not drive."""
        at, driven = self.lines.fit, self.references
        self.references = np.arange(self.n_dofs)
        self._nuisance()
        by_z = self.predict(np.zeros(self.root.shape[1]), np.zeros(self.n_d), np.zeros(0), [], at, by_d=False).by_z
        self.references = driven
        self._nuisance()
        noise = np.sqrt(np.median(self.lines.variance[at], axis=2) * CORRELATED / 2)[:, :, None, None]
        least = 1e-3 * np.abs(self.lines.level[at]).mean(2)[:, :, None, None]
        jacobian = (by_z / np.maximum(noise, least)).reshape(-1, self.root.shape[1])
        values, vectors = np.linalg.eigh((jacobian.conj().T @ jacobian).real)
        self.root = self.root @ vectors[:, values > KEEP]
        self.n_z = self.root.shape[1]

    def rest_columns(self, terms: np.ndarray, places: list[int], w: np.ndarray) -> np.ndarray:
        """What residual terms give between places and undriven ones other than themselves (lines, DOFs, places)."""
        w0 = 2 * np.pi * self.f0[terms]
        k = 1 / (w0**2 - w[:, None] ** 2 + 2j * self.zeta0[terms] * w0 * w[:, None])
        rows = np.repeat(self.undriven[:, None].astype(float), len(places), axis=1)
        rows[places, np.arange(len(places))] = 0
        return ((self.phi0[:, terms] * k[:, None, :]) @ self.phi0[places][:, terms].T) * rows

    def outside(self, effects: list[Effect]) -> list[Outside]:
        """What lies outside the band at the undriven places of effects: own values, and those to other undriven places."""
        out = []
        for place in touched(effects):
            if not self.undriven[place]:
                continue
            for below, own, name in ((False, self.own_above, "above"), (True, self.own_below, "below")):
                if below and not self.below.size:
                    continue
                out.append(Outside(place, place, below, OUTSIDE[f"own_{name}"] * float(own[place])))
                for other in np.flatnonzero(self.undriven):
                    if other != place:
                        out.append(Outside(place, int(other), below, OUTSIDE[f"row_{name}"] * float(np.sqrt(own[place] * own[other]))))
        return out

    def without_rest(self, effects: list[Effect], places: tuple[int, ...]) -> np.ndarray:
        """Values of ``outside`` that take away what residual masses give places."""
        out = []
        for row in self.outside(effects):
            given = 0.0
            if row.below and row.place in places:
                given = float(self.phi0[row.place, self.below] @ self.phi0[row.other, self.below])
            out.append(-given / row.spread if given else 0.0)
        return np.array(out)

    def predict(
        self,
        z: np.ndarray,
        d: np.ndarray,
        u: np.ndarray,
        effects: list[Effect],
        at: np.ndarray,
        *,
        derivatives: bool = True,
        by_d: bool = True,
    ) -> Prediction:
        """FRFs on lines ``at`` and derivatives; what a sensor shows beside its place enters those by the others at first order only."""
        return self._forward(z, d, u, effects, at, derivatives=derivatives, by_d=by_d)[0]

    def scannable(self, z: np.ndarray, d: np.ndarray, u: np.ndarray, effects: list[Effect], at: np.ndarray) -> Scannable:
        """The state with all columns of its structure."""
        scannable = self._forward(z, d, u, effects, at, derivatives=False, all_columns=True)[1]
        assert scannable is not None
        return scannable

    def _forward(
        self,
        z: np.ndarray,
        d: np.ndarray,
        u: np.ndarray,
        effects: list[Effect],
        at: np.ndarray,
        *,
        derivatives: bool = True,
        by_d: bool = True,
        all_columns: bool = False,
    ) -> tuple[Prediction, Scannable | None]:
        w, n, nt, nd, m = self.lines.w[at], at.size, self.n_terms, self.n_dofs, self.modes
        theta, d = self.root @ z, d * self.spread
        part = {name: d[s] for name, s in self.parts.items()}
        none_of = {"mode": m.size, "damping": m.size, "driven": self.references.size * m.size, "seen": nd * m.size}
        none_of |= {"sensor": nd, "force": self.references.size, "late": 1, "stiffness_between": self.first.size}
        none_of |= {"damping_between": self.first.size}
        none_of |= {f"sensor_{p}": nd for p in CHANNEL} | {f"force_{p}": self.references.size for p in CHANNEL}
        none_of |= dict.fromkeys(("rest_above", "rest_below"), nd * self.references.size)
        part |= {name: np.zeros(size) for name, size in none_of.items() if not part[name].size}
        # idle model, stiffness and damping of the whole, frequencies and damping mode by mode
        whole_change = float(part["stiffness"].sum()) + sum(e.size for e in effects if e.kind == "global_stiffness")
        root = np.sqrt(max(1 + whole_change, 0.05))
        by_mode, by_damping = np.ones(nt), np.ones(nt)
        by_mode[m] = np.exp(part["mode"])
        more = np.exp(part["damping_whole"].sum() + sum(e.values[0] for e in effects if e.kind == "global_damping"))
        by_damping[m] = more * np.exp(part["damping"])
        df, dzeta, dphi, dbetween, dlag = self.idle.split(theta)
        f = (self.f0 + df) * root * by_mode
        zeta = (self.zeta0 + dzeta) / root * by_damping
        phi = self.phi0 + dphi.reshape(nt, nd).T
        if self.lags:
            phi = np.broadcast_to(phi, (n, nd, nt)).astype(complex)
            phi[:, :, m] -= 1j * w[:, None, None] * (self.idle.lag + dlag.reshape(m.size, nd).T)
        wr, line = 2 * np.pi * f, w[:, None]
        dynamic = np.zeros((n, nt, nt), complex)
        dynamic[:, np.arange(nt), np.arange(nt)] = wr**2 - line**2 + 2j * zeta * wr * line
        damping_between = self.idle.between + dbetween + part["damping_between"]
        damping_scale = self.damping_scale * more
        between = part["stiffness_between"] * self.stiffness_scale + 1j * line * damping_between * damping_scale
        dynamic[:, self.first, self.second] = dynamic[:, self.second, self.first] = between
        k = np.linalg.inv(dynamic)
        driven, seen = np.zeros((self.references.size, nt)), np.zeros((nd, nt))
        driven[:, m] = part["driven"].reshape(-1, m.size)
        seen[:, m] = part["seen"].reshape(nd, -1)
        phi_f = phi[..., self.references, :] + driven
        shape_k = phi @ k
        h0 = shape_k @ np.swapaxes(phi_f, -1, -2)
        above, below = (part[name].reshape(self.references.size, nd).T for name in ("rest_above", "rest_below"))
        h0 = h0 + above - below / line[:, :, None] ** 2
        # structural effects: a low-rank update in the DOFs they touch
        here = touched(effects)
        stiff, by_values = np.zeros((n, len(here), len(here)), complex), []
        for effect in effects:
            if effect.kind in STRUCTURAL:
                b = [here.index(i) for i in effect.places]
                value, pattern, slopes = stiffness(effect, w)
                full = np.zeros((len(here), len(here)))
                full[np.ix_(b, b)] = pattern
                stiff += value[:, None, None] * full
                by_values.append([slope[:, None, None] * full for slope in slopes])
            else:
                by_values.append([])
        columns = shape_k @ np.swapaxes(phi[..., here, :], -1, -2)
        outside = self.outside(effects)
        for row, value in zip(outside, u * np.array([row.spread for row in outside]), strict=True):
            change = -value / w**2 if row.below else np.full(n, value)
            columns[:, row.other, here.index(row.place)] += change
            if row.other in here and row.other != row.place:
                columns[:, row.place, here.index(row.other)] += change
        inner = np.linalg.solve(np.eye(len(here)) + stiff @ columns[:, here], stiff)
        structure = h0 - columns @ (inner @ h0[:, here])
        touched_columns = columns - columns @ (inner @ columns[:, here])
        force = stiff @ structure[:, here]
        psi = phi - touched_columns @ (stiff @ phi[..., here, :])
        chi = np.swapaxes(phi_f, -1, -2) - np.swapaxes(phi[..., here, :], -1, -2) @ force
        kx = k @ chi
        structure = structure + seen @ kx
        # sensors and forces
        over = {p: law(w / 2 / np.pi, self.band)[:, None] for p, law in CHANNEL.items()}
        sensors = np.exp(part["sensor"] - 1j * line * part["late"] + sum(part[f"sensor_{p}"] * v for p, v in over.items()))
        order = np.arange(nd)
        for effect in effects:
            if effect.kind == "sensor_gain":
                sensors[:, effect.places[0]] *= np.exp(effect.values[0])
            elif effect.kind == "sensor_delay":
                sensors[:, effect.places[0]] *= np.exp(-1j * w * effect.values[0])
            elif effect.kind == "sensor_polarity":
                sensors[:, effect.places[0]] *= -1
            elif effect.kind == "channel_swap":
                order[list(effect.places)] = order[list(effect.places)][::-1]
        sensors = sensors[:, order]
        forces = np.exp(part["force"] + sum(part[f"force_{p}"] * v for p, v in over.items()))

        def seen_by(x: np.ndarray) -> np.ndarray:
            ones = [1] * (x.ndim - 3)
            return x[:, order] * sensors.reshape(n, nd, 1, *ones) * forces.reshape(n, 1, -1, *ones)

        h = seen_by(structure)
        none = np.zeros((*h.shape, 0), complex)
        scannable = None
        if all_columns:
            every = shape_k @ np.swapaxes(phi, -1, -2)
            every = every - columns @ (inner @ every[:, here])
            scannable = Scannable(h, every, structure, sensors, order, forces)
        if not derivatives:
            return Prediction(h, none, none, none, none), scannable
        pk = psi @ k
        kt = np.swapaxes(kx, 1, 2)
        core = pk[:, :, None, :] * kt[:, None]
        by_f = -core * ((2 * wr + 2j * zeta * line) * 2 * np.pi)[:, None, None]
        by_zeta = -core * (2j * wr * line)[:, None, None]
        scale = (f * root * by_mode) / np.where(f == 0, 1, f)  # of θ's frequencies: root times the factors of the modes
        root_f, root_z, root_s, root_b, root_l = self.idle.split(self.root)
        root_f, root_z = root_f * scale[:, None], root_z * (by_damping / root)[:, None]
        root_s, root_l = root_s.reshape(nt, nd, -1), root_l.reshape(m.size, nd, -1)
        passive = np.broadcast_to(np.eye(nd, dtype=complex), (n, nd, nd)).copy()
        passive[:, :, here] -= touched_columns @ stiff
        active = np.zeros((n, nd, self.references.size), complex)
        active[:, self.references, np.arange(self.references.size)] = 1
        active[:, here] -= force
        by_z = by_f @ root_f + by_zeta @ root_z
        at_forces = np.einsum("nrj,raq->njaq", kx, root_s, optimize=True)
        at_sensors = np.einsum("naj,raq->njrq", active, root_s, optimize=True)
        if self.lags:
            late = -1j * w[:, None, None, None]
            at_forces += late * np.einsum("nrj,raq->njaq", kx[:, m], root_l, optimize=True)
            at_sensors[:, :, m] += late * np.einsum("naj,raq->njrq", active, root_l, optimize=True)
        by_z = by_z + np.einsum("nia,njaq->nijq", passive, at_forces, optimize=True)
        by_z = by_z + np.einsum("nir,njrq->nijq", pk, at_sensors, optimize=True)
        if by_d or root_b.any():
            both = pk[:, :, None, self.first] * kt[:, None, :, self.second] + pk[:, :, None, self.second] * kt[:, None, :, self.first]
            by_between = -both * (1j * w[:, None, None, None] * damping_scale)
        if root_b.any():
            by_z = by_z + by_between @ root_b
        whole = by_f @ (f / 2 / (1 + whole_change)) - by_zeta @ (zeta / 2 / (1 + whole_change))
        by_effects = []
        for effect, slopes in zip(effects, by_values, strict=True):
            if effect.kind in STRUCTURAL:
                by_effects += [seen_by(-touched_columns @ (slope @ (structure - seen @ kx)[:, here])) for slope in slopes]
            elif effect.kind == "global_stiffness":
                by_effects.append(seen_by(whole) * effect.size)
            elif effect.kind == "global_damping":
                by_effects.append(seen_by(by_zeta[..., m] @ zeta[m] + by_between @ damping_between))
            elif effect.values:
                only = np.zeros_like(h)
                at_sensor = int(np.flatnonzero(order == effect.places[0])[0])
                only[:, at_sensor] = h[:, at_sensor] * (1 if effect.kind == "sensor_gain" else (-1j * line))
                by_effects.append(only)
        of_effects = np.stack(by_effects, -1) if by_effects else none
        if not by_d:
            return Prediction(h, seen_by(by_z), none, none, of_effects), scannable
        of_outside = np.zeros((*h.shape, len(outside)), complex)
        for q, row in enumerate(outside):
            slope = (-1 / w**2 if row.below else np.ones(n)) * row.spread
            added = passive[:, :, row.other, None] * force[:, here.index(row.place), None]
            if row.other in here and row.other != row.place:
                added = added + passive[:, :, row.place, None] * force[:, here.index(row.other), None]
            of_outside[..., q] = seen_by(-slope[:, None, None] * added)
        out = np.zeros((*h.shape, self.n_d), complex)
        s = self.parts
        i, j = np.arange(nd), np.arange(self.references.size)
        slopes_of = {
            "stiffness": lambda: seen_by(whole)[..., None],
            "damping": lambda: seen_by(by_zeta[..., m] * zeta[m]),
            "damping_whole": lambda: seen_by(by_zeta[..., m] @ zeta[m] + by_between @ damping_between)[..., None],
            "mode": lambda: seen_by(by_f[..., m] * f[m]),
            "late": lambda: (-1j * w[:, None, None] * h)[..., None],
            "stiffness_between": lambda: seen_by(-both * self.stiffness_scale),
            "damping_between": lambda: seen_by(by_between),
        }
        for name, slope_of in slopes_of.items():
            if s[name].stop > s[name].start:
                out[..., s[name]] = slope_of()
        for name, slope in (("rest_above", np.ones(n)), ("rest_below", -1 / w**2)):
            if s[name].stop > s[name].start:
                for c in j:
                    at_column = out[:, :, c, s[name].start + c * nd : s[name].start + (c + 1) * nd]
                    at_column[:] = passive[:, order] * (slope[:, None, None] * sensors[:, :, None]) * forces[:, c, None, None]
        for name, law in {"": np.ones((n, 1)), **{f"_{p}": v for p, v in over.items()}}.items():
            if s[f"sensor{name}"].stop > s[f"sensor{name}"].start:
                out[:, i, :, s[f"sensor{name}"].start + order] = np.moveaxis(h * law[:, None], 1, 0)
            if s[f"force{name}"].stop > s[f"force{name}"].start:
                out[:, :, j, s[f"force{name}"].start + j] = h * law[:, None]
        if s["driven"].stop > s["driven"].start:
            at_driven = pk[:, order][:, :, m] * sensors[:, :, None]
            for c in j:
                start = s["driven"].start + c * m.size
                out[:, :, c, start : start + m.size] = at_driven * forces[:, c, None, None]
        if s["seen"].stop > s["seen"].start:
            for row, dof in enumerate(order):
                start = s["seen"].start + dof * m.size
                out[:, row, :, start : start + m.size] = kt[:, :, m] * (sensors[:, row, None, None] * forces[:, :, None])
        return Prediction(h, seen_by(by_z), out * self.spread, of_outside, of_effects), scannable

    # priors of effects

    def size_range(self, kind: str, places: tuple[int, ...]) -> tuple[float, float]:
        """Log sizes that change the FRFs at rest by 0.1 and 10 dB (rms over lines and pairs)."""
        key = kind, tuple(sorted(places))
        if key in self.priors:
            return self.priors[key]
        if kind == "global_stiffness":
            return float(np.log(5e-4)), float(np.log(0.2))
        if "base" not in self.priors:
            at = self.lines.fit[::2]
            self.priors["base"] = at, self.scannable(np.zeros(self.n_z), np.zeros(self.n_d), np.zeros(0), [], at)
        at, base = self.priors["base"]
        kind = "point_mass" if kind == "tuned_absorber" else kind
        value = stiffness(Effect(kind, places, (0.0,)), self.lines.w[at])[0]
        own = np.mean([np.abs(base.columns[:, i, i]) for i in places], axis=0)
        grid = np.log(1 / np.median(np.abs(value) * own)) + np.log(10) * np.linspace(-5, 3, 33)
        db = []
        for size in grid:
            h = with_one(base.columns, base.structure, Effect(kind, places, (size,)), self.lines.w[at])
            db.append(np.sqrt(np.mean((20 * np.log10(np.abs(h) / np.abs(base.structure))) ** 2)))
        db = np.maximum.accumulate(db)
        low, high = (np.interp(np.log(v), np.log(db), grid) for v in (0.1, min(10, 0.9 * db[-1])))
        self.priors[key] = float(low), float(max(high, low + 2))
        return self.priors[key]

    def prior(self, effect: Effect) -> tuple[np.ndarray, np.ndarray]:
        """Means and standard deviations of the values."""
        if effect.kind == "sensor_gain":
            return np.zeros(1), np.array([0.3])
        if effect.kind in LINEAR_SCALE:
            return np.zeros(1), np.array([0.3 / (2 * np.pi * self.band[1])])
        if effect.kind == "global_damping":
            return np.zeros(1), np.array([0.5])
        if not effect.values:
            return np.zeros(0), np.zeros(0)
        low, high = self.size_range(effect.kind, effect.places)
        mean, std = [(low + high) / 2], [(high - low) / 4]
        if effect.kind == "tuned_absorber":
            a, b = np.log(self.band)
            mean, std = [*mean, (a + b) / 2, np.log(0.02)], [*std, (b - a) / np.sqrt(12), 1.0]
        return np.array(mean), np.array(std)

    def places(self, kind: str) -> int:
        """Number of places where a kind may be."""
        if kind in GLOBAL:
            return 1
        if kind == "point_mass":
            return len(self.nodes)
        return self.n_dofs * (self.n_dofs - 1) // 2 if kind in (*TWO_PLACES, "channel_swap") else self.n_dofs

    def log_prior(self, effect: Effect) -> float:
        """Place and kind uniform, sizes log-normal, a size taken away one in seven."""
        value = -np.log(self.places(effect.kind)) - np.log(len(KINDS))
        mean, std = self.prior(effect)
        if effect.values:
            x = np.array(effect.values)
            value += float(np.sum(-0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)))
            if effect.kind in ("gyroscopic", "global_stiffness"):
                value += np.log(0.5)
            elif effect.kind in STRUCTURAL:
                value += np.log(0.85 if effect.sign > 0 else 0.15)
        return float(value)
