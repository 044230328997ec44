"""Check lines of one test, and the FRFs that an idle model with nuisance and effects makes of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from kinds import GLOBAL, KINDS, LINEAR_SCALE, STRUCTURAL, Effect, stiffness, with_one

CORRELATED = 6.0  # neighbouring lines of a local rational estimate that count as one
FIT_LINES, VALIDATION_LINES, BLOCKS = 100, 50, 18
KEEP = 0.02  # directions of the idle model that move the FRFs by less than 0.14 σ in all are left out
SPREADS = {
    "sensor": 0.01,  # log gain of each sensor
    "force": 0.01,
    "stiffness": 0.003,  # relative, of the whole
    "damping": 0.12,  # log, of each mode
    "driven": 0.025,  # shape at the driven point, over the rms of the mode's shape
    "own_above": 1.0,  # own compliance of a place, over half of what lies above the band there
    "own_below": 1.0,  # own inverse mass, over what lies below
    "row_above": 0.5,  # compliance between a place and undriven ones, over what the model has
    "row_below": 1.0,
    "mode": 0.0015,  # log frequency of each mode
    "seen": 0.015,  # shape that a sensor shows, over the rms of the mode's shape
    "stiffness_between": 0.0015,  # of two modes, over 2 ω_r ω_s
    "damping_between": 0.15,  # of two modes, over 2 √(ζ_r ω_r ζ_s ω_s)
    "late": 3e-5,  # s, of all responses against the forces
}
DRIVEN_KNOWN = 0.02  # of driven places: their columns are measured


@dataclass
class Prediction:
    """FRFs (lines, sensors, references) and their derivatives by z, d (in σ) and the effects' values."""

    h: np.ndarray
    by_z: np.ndarray
    by_d: np.ndarray
    by_effects: np.ndarray

    @property
    def jacobian(self) -> np.ndarray:
        return np.concatenate([self.by_z, self.by_d, self.by_effects], -1)


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
        return structure[:, self.order] * self.sensors[:, :, None] * self.forces


@dataclass
class Case:
    """One test: idle model θ = θ₀ + L z, nuisance d in units of its spreads, check lines in two sets.

    All DOFs of the idle model must have been measured in the check.
    """

    idle: Any
    frf: Any
    band: tuple[float, float]
    priors: dict = field(default_factory=dict)

    def __post_init__(self) -> None:
        idle = self.idle
        self.f0, self.zeta0, self.phi0 = (np.array(v, float) for v in (idle.frequencies_hz, idle.damping_ratios, idle.shapes))
        self.n_dofs, self.n_terms = self.phi0.shape
        self.modes = np.flatnonzero(~np.asarray(idle.residual))
        self.dofs = idle.dofs
        frf = self.frf.select(
            [d for d in idle.dofs if any(d.same_axis(e) for e in self.frf.responses)],
            [d for d in idle.dofs if any(d.same_axis(e) for e in self.frf.references)],
        ).to_quantity("receptance")
        self.references = np.array([idle.dofs.index(d) for d in frf.references])
        if len(frf.responses) != self.n_dofs:
            raise ValueError("all DOFs of the idle model must be in the check")
        self._choose_lines(frf.band(*self.band))
        self._prior_of_idle(np.array(idle.covariance))
        self._nuisance()
        self._compress()

    def _choose_lines(self, frf: Any) -> None:
        """Lines to fit and to validate where the FRFs change, by blocks (each third validates); variance, level, correlated lines."""
        hz, h = frf.frequencies_hz, np.moveaxis(frf.data, 2, 0)
        variance = (0.01 * np.abs(h)) ** 2 if frf.variance is None else np.moveaxis(frf.variance, 2, 0)
        good = np.isfinite(h).all((1, 2)) & np.isfinite(variance).all((1, 2))
        hz, h, variance = hz[good], h[good], np.maximum(variance[good], 1e-8 * np.abs(h[good]) ** 2)
        block = np.minimum(np.arange(hz.size) * BLOCKS // hz.size, BLOCKS - 1)
        change = np.median(np.abs(np.gradient(h, axis=0)) ** 2 / variance, axis=(1, 2))
        density = np.convolve(change, np.ones(5) / 5, "same") ** 0.25
        # the discrepancy is a share of the rms over ±1 % of frequency: it does not vanish at antiresonances
        total = np.cumsum(np.concatenate([np.zeros((1, *h.shape[1:])), np.abs(h) ** 2]), 0)
        half = np.maximum(2, (0.01 * hz / np.median(np.diff(hz))).astype(int))
        low, high = np.maximum(0, np.arange(hz.size) - half), np.minimum(hz.size, np.arange(hz.size) + half + 1)
        level = np.sqrt((total[high] - total[low]) / (high - low)[:, None, None])
        chosen, counts = [], []
        for validates, number in ((False, FIT_LINES), (True, VALIDATION_LINES)):
            at = np.flatnonzero((block % 3 == 2) == validates)
            share = np.cumsum(0.6 * density[at] / density[at].sum() + 0.4 / at.size)
            i = np.unique(at[np.searchsorted(share, (np.arange(number) + 0.5) / number * share[-1] * 0.999999)])
            gap = np.gradient(i.astype(float)) if i.size > 1 else np.ones(1)
            chosen.append(i)
            counts.append(np.maximum(1, CORRELATED / np.maximum(gap, 1)))
        i = np.concatenate(chosen)
        self.validation = np.repeat([False, True], [c.size for c in chosen])
        self.fit_lines, self.validation_lines = np.flatnonzero(~self.validation), np.flatnonzero(self.validation)
        self.w, self.h, self.variance, self.level = 2 * np.pi * hz[i], h[i], variance[i], level[i]
        self.count = np.concatenate(counts)[:, None, None]
        self.band = float(hz[0]), float(hz[-1])

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
        above = 0.5 * np.sum(self.phi0[:, self.above] ** 2 / (2 * np.pi * self.f0[self.above]) ** 2, axis=1)
        above = np.maximum(above, 0.3 * np.median(above))
        below = np.sum(self.phi0[:, self.below] ** 2, axis=1)
        unknown = np.where(self.undriven, 1.0, DRIVEN_KNOWN)
        first, second = np.triu_indices(n, 1)
        self.first, self.second = self.modes[first], self.modes[second]
        w0 = 2 * np.pi * self.f0
        self.stiffness_scale = 2 * w0[self.first] * w0[self.second]
        loss = np.abs(self.zeta0 * w0)
        self.damping_scale = 2 * np.sqrt(loss[self.first] * loss[self.second])
        size = {
            "sensor": np.ones(dofs), "force": np.ones(driven.size), "stiffness": np.ones(1), "damping": np.ones(n),
            "driven": np.tile(rms, driven.size), "own_above": above * unknown + 1e-30, "own_below": below * unknown + 1e-30,
            "row_above": unknown, "row_below": unknown, "mode": np.ones(n), "seen": np.tile(rms, dofs),
            "stiffness_between": np.ones(first.size), "damping_between": np.ones(first.size), "late": np.ones(1),
        }  # fmt: skip
        ends = np.cumsum([0, *(v.size for v in size.values())])
        self.parts = {name: slice(a, b) for name, a, b in zip(size, ends[:-1], ends[1:], strict=True)}
        self.spread = np.concatenate([SPREADS[name] * v for name, v in size.items()])
        self.n_d = int(ends[-1])

    def _compress(self) -> None:
        """Directions of z that the FRFs of all pairs, driven or not, could tell: an effect sees places that the check did not drive."""
        at, driven = self.fit_lines, self.references
        self.references = np.arange(self.n_dofs)
        self._nuisance()
        by_z = self.predict(np.zeros(self.root.shape[1]), np.zeros(self.n_d), [], at, by_d=False).by_z
        self.references = driven
        self._nuisance()
        noise = np.sqrt(np.median(self.variance[at] * self.count[at], axis=2))[:, :, None, None]
        least = 1e-3 * np.abs(self.level[at]).mean(2)[:, :, None, None]
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

    def _outside(self, places: list[int], w: np.ndarray) -> dict[str, np.ndarray]:
        """Columns by which nuisance changes what lies outside the band at the places of effects, (lines, DOFs, places) each."""
        own = np.zeros((w.size, self.n_dofs, len(places)))
        own[:, places, np.arange(len(places))] = 1
        return {
            "own_above": own,
            "own_below": -own / w[:, None, None] ** 2,
            "row_above": self.rest_columns(self.above, places, w),
            "row_below": self.rest_columns(self.below, places, w),
        }

    def predict(
        self, z: np.ndarray, d: np.ndarray, effects: list[Effect], at: np.ndarray, *, derivatives: bool = True, by_d: bool = True
    ) -> Prediction:
        """FRFs on lines ``at`` and derivatives; what a sensor shows beside its place enters those by the others at first order only."""
        return self._forward(z, d, effects, at, derivatives=derivatives, by_d=by_d)[0]

    def scannable(self, z: np.ndarray, d: np.ndarray, effects: list[Effect], at: np.ndarray) -> Scannable:
        """The state with all columns of its structure."""
        scannable = self._forward(z, d, effects, at, derivatives=False, all_columns=True)[1]
        assert scannable is not None
        return scannable

    def _forward(
        self,
        z: np.ndarray,
        d: np.ndarray,
        effects: list[Effect],
        at: np.ndarray,
        *,
        derivatives: bool = True,
        by_d: bool = True,
        all_columns: bool = False,
    ) -> tuple[Prediction, Scannable | None]:
        w, n, nt, nd = self.w[at], at.size, self.n_terms, self.n_dofs
        theta, d = self.root @ z, d * self.spread
        part = {name: d[s] for name, s in self.parts.items()}
        m = self.modes
        # idle model, stiffness and damping of the whole, frequencies and damping mode by mode
        change = float(part["stiffness"][0]) + sum(e.size for e in effects if e.kind == "global_stiffness")
        root = np.sqrt(max(1 + change, 0.05))
        by_mode, by_damping = np.ones(nt), np.ones(nt)
        by_mode[m] = np.exp(part["mode"])
        by_damping[m] = np.exp(part["damping"] + sum(e.values[0] for e in effects if e.kind == "global_damping"))
        f = (self.f0 + theta[:nt]) * root * by_mode
        zeta = (self.zeta0 + theta[nt : 2 * nt]) / root * by_damping
        phi = self.phi0 + theta[2 * nt :].reshape(nt, nd).T
        wr, line = 2 * np.pi * f, w[:, None]
        dynamic = np.zeros((n, nt, nt), complex)
        dynamic[:, np.arange(nt), np.arange(nt)] = wr**2 - line**2 + 2j * zeta * wr * line
        between = part["stiffness_between"] * self.stiffness_scale + 1j * line * part["damping_between"] * self.damping_scale
        dynamic[:, self.first, self.second] = dynamic[:, self.second, self.first] = between
        k = np.linalg.inv(dynamic)
        driven, seen = np.zeros((self.references.size, nt)), np.zeros((nd, nt))
        driven[:, m] = part["driven"].reshape(-1, m.size)
        seen[:, m] = part["seen"].reshape(nd, -1)
        phi_f = phi[self.references] + driven
        shape_k = phi @ k
        h0 = shape_k @ phi_f.T
        # structural effects: a low-rank update in the DOFs they touch
        here = sorted({i for e in effects if e.kind in STRUCTURAL for i in e.places})
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
        columns = shape_k @ phi[here].T
        outside = self._outside(here, w) if here else {}
        for name, added in outside.items():
            columns = columns + added * part[name][here]
        inner = np.linalg.solve(np.eye(len(here)) + stiff @ columns[:, here], stiff)
        structure = h0 - columns @ (inner @ h0[:, here])
        touched = columns - columns @ (inner @ columns[:, here])
        force = stiff @ structure[:, here]
        psi = phi - touched @ (stiff @ phi[here])
        chi = phi_f.T - phi[here].T @ force
        kx = k @ chi
        structure = structure + seen @ kx
        # sensors and forces
        sensors = np.exp(part["sensor"]) * np.exp(-1j * line * part["late"])
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
        sensors, forces = sensors[:, order], np.exp(part["force"])

        def seen_by(x: np.ndarray) -> np.ndarray:
            return x[:, order] * sensors.reshape(n, nd, *[1] * (x.ndim - 2)) * forces.reshape(-1, *[1] * (x.ndim - 3))

        h = seen_by(structure)
        none = np.zeros((*h.shape, 0), complex)
        scannable = None
        if all_columns:
            every = shape_k @ phi.T
            every = every - columns @ (inner @ every[:, here])
            scannable = Scannable(h, every, structure, sensors, order, forces)
        if not derivatives:
            return Prediction(h, none, none, none), scannable
        pk = psi @ k
        kt = np.swapaxes(kx, 1, 2)
        core = pk[:, :, None, :] * kt[:, None]
        by_f = -core * ((2 * wr + 2j * zeta * line) * 2 * np.pi)[:, None, None]
        by_zeta = -core * (2j * wr * line)[:, None, None]
        scale = (f * root * by_mode) / np.where(f == 0, 1, f)  # of θ's frequencies: root times the factors of the modes
        root_f, root_z = self.root[:nt] * scale[:, None], self.root[nt : 2 * nt] * (by_damping / root)[:, None]
        root_s = self.root[2 * nt :].reshape(nt, nd, -1)
        passive = np.broadcast_to(np.eye(nd, dtype=complex), (n, nd, nd)).copy()
        passive[:, :, here] -= touched @ stiff
        active = np.zeros((n, nd, self.references.size), complex)
        active[:, self.references, np.arange(self.references.size)] = 1
        active[:, here] -= force
        by_z = by_f @ root_f + by_zeta @ root_z
        by_z = by_z + np.einsum("nia,njaq->nijq", passive, np.einsum("nrj,raq->njaq", kx, root_s, optimize=True), optimize=True)
        by_z = by_z + np.einsum("nir,njrq->nijq", pk, np.einsum("naj,raq->njrq", active, root_s, optimize=True), optimize=True)
        whole = by_f @ (f / 2 / (1 + change)) - by_zeta @ (zeta / 2 / (1 + change))
        by_effects = []
        for effect, slopes in zip(effects, by_values, strict=True):
            if effect.kind in STRUCTURAL:
                by_effects += [seen_by(-touched @ (slope @ (structure - seen @ kx)[:, here])) for slope in slopes]
            elif effect.kind == "global_stiffness":
                by_effects.append(seen_by(whole) * effect.size)
            elif effect.kind == "global_damping":
                by_effects.append(seen_by(by_zeta[..., m] @ zeta[m]))
            elif effect.values:
                only = np.zeros_like(h)
                at_sensor = int(np.flatnonzero(order == effect.places[0])[0])
                only[:, at_sensor] = h[:, at_sensor] * (1 if effect.kind == "sensor_gain" else (-1j * line))
                by_effects.append(only)
        of_effects = np.stack(by_effects, -1) if by_effects else none
        if not by_d:
            return Prediction(h, seen_by(by_z), none, of_effects), scannable
        out = np.zeros((*h.shape, self.n_d), complex)
        s = self.parts
        i, j = np.arange(nd), np.arange(self.references.size)
        out[:, i, :, s["sensor"].start + order] = np.moveaxis(h, 1, 0)
        out[:, :, j, s["force"].start + j] = h
        out[..., s["stiffness"].start] = seen_by(whole)
        out[..., s["damping"]] = seen_by(by_zeta[..., m] * zeta[m])
        out[..., s["mode"]] = seen_by(by_f[..., m] * f[m])
        out[..., s["late"].start] = -1j * w[:, None, None] * h
        at_driven = pk[:, order][:, :, m] * sensors[:, :, None]
        for c in j:
            start = s["driven"].start + c * m.size
            out[:, :, c, start : start + m.size] = at_driven * forces[c]
        for row, dof in enumerate(order):
            start = s["seen"].start + dof * m.size
            out[:, row, :, start : start + m.size] = kt[:, :, m] * (sensors[:, row, None, None] * forces[:, None])
        both = -(pk[:, :, None, self.first] * kt[:, None, :, self.second] + pk[:, :, None, self.second] * kt[:, None, :, self.first])
        out[..., s["stiffness_between"]] = seen_by(both * self.stiffness_scale)
        out[..., s["damping_between"]] = seen_by(both * (1j * w[:, None, None, None] * self.damping_scale))
        for name, added in outside.items():
            for a, dof in enumerate(here):
                column = added[:, :, a : a + 1]
                out[..., s[name].start + dof] = seen_by(-(column - touched @ (stiff @ column[:, here])) @ force[:, a : a + 1])
        return Prediction(h, seen_by(by_z), out * self.spread, of_effects), scannable

    # priors of effects

    def size_range(self, kind: str, places: tuple[int, ...]) -> tuple[float, float]:
        """Log sizes that change the FRFs at rest by 0.1 and 10 dB (rms over lines and pairs)."""
        key = kind, tuple(sorted(places))
        if key in self.priors:
            return self.priors[key]
        if kind == "global_stiffness":
            return float(np.log(5e-4)), float(np.log(0.2))
        if "base" not in self.priors:
            at = self.fit_lines[::2]
            self.priors["base"] = at, self.scannable(np.zeros(self.n_z), np.zeros(self.n_d), [], at)
        at, base = self.priors["base"]
        kind = "point_mass" if kind == "tuned_absorber" else kind
        value = stiffness(Effect(kind, places, (0.0,)), self.w[at])[0]
        own = np.mean([np.abs(base.columns[:, i, i]) for i in places], axis=0)
        grid = np.log(1 / np.median(np.abs(value) * own)) + np.log(10) * np.linspace(-5, 3, 33)
        db = []
        for size in grid:
            h = with_one(base.columns, base.structure, Effect(kind, places, (size,)), self.w[at])
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

    def log_prior(self, effect: Effect) -> float:
        """Place and kind uniform, sizes log-normal, a size taken away one in seven."""
        places = 1 if effect.kind in GLOBAL else self.n_dofs * (self.n_dofs - 1) // 2 if len(effect.places) == 2 else self.n_dofs
        value = -np.log(places) - np.log(len(KINDS))
        mean, std = self.prior(effect)
        if effect.values:
            x = np.array(effect.values)
            value += float(np.sum(-0.5 * ((x - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)))
            if effect.kind in ("gyroscopic", "global_stiffness"):
                value += np.log(0.5)
            elif effect.kind in STRUCTURAL:
                value += np.log(0.85 if effect.sign > 0 else 0.15)
        return float(value)
