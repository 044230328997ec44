"""What a case hides: every linear, sensor and operating kind of the contract, acting on the modal truth. Shares no code with operando.

An effect changes the matrices of the structure, and its response is the exact partial-fraction sum of the changed matrices' own
eigenvalue problem; only the rubber spring, whose law is a fractional power, is added to that sum by its closed form for one place.
Sizes are chosen so that the FRFs change by a given number of dB rms over lines and pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from families import Sensor, Structure
from scipy.linalg import eig

if TYPE_CHECKING:
    from days import Remounted

ONE_PLACE = ("point_mass", "ground_spring", "ground_damper", "ground_hysteretic_spring", "ground_rubber", "tuned_absorber")
TWO_PLACES = ("coupling_spring", "coupling_damper", "gyroscopic", "circulatory")
GLOBAL = ("global_stiffness", "global_damping", "missing_mode")
LINEAR = ONE_PLACE + TWO_PLACES + GLOBAL
SENSOR = ("sensor_gain", "sensor_polarity", "sensor_delay", "channel_swap", "sensor_mass", "force_gain", "force_delay")
OUTSIDE = ("distributed_support", "inerter", "added_inertia")
UNITS = {
    "mass": "kg", "stiffness": "N/m", "damping": "N·s/m", "loss_factor": "", "exponent": "", "frequency": "Hz", "damping_ratio": "",
    "change": "", "gain": "", "delay": "s",
}  # fmt: skip
ZETA_LEAST = 0.0015  # what a circulatory or negative effect must leave to every mode
DB_RANGE = (0.5, 6.0)
LEAST_OF_A_FIFTH = 0.06  # dB


@dataclass(frozen=True)
class System:
    """M q'' + C q' + K q = Φᵀ f, with a fractional spring at one place if there is one. Not symmetric where an effect is not."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray  # complex with a hysteretic spring: then for positive frequencies only
    rubber: tuple[np.ndarray, float, float, float] | None = None  # modal row, stiffness, exponent, ω0

    def fractions(self, stiffness: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = len(self.mass)
        inverse = np.linalg.inv(self.mass)
        k = self.stiffness if stiffness is None else stiffness
        values, vectors = eig(np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ k, -inverse @ self.damping]]))
        return values, vectors[:n], np.linalg.inv(vectors)[:, n:] @ inverse

    def respond(self, hz: np.ndarray, forces: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Acceleration spectra (p, lines) at modal rows (p, n) to force spectra (q, lines) at modal rows (q, n)."""
        return self._sum(self.fractions(), hz, forces, rows, columns)

    def _sum(self, fractions: tuple, hz: np.ndarray, forces: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        values, left, right = fractions
        s = 2j * np.pi * hz
        modal = (right @ columns.T @ forces) / (s - values[:, None])
        out = (rows @ left) @ modal
        if self.rubber is not None:
            place, stiffness, exponent, omega = self.rubber
            law = stiffness * (s / omega) ** exponent
            at_place, to_place = (place @ left) @ modal, (right @ place)[:, None] / (s - values[:, None])
            out = out - ((rows @ left) @ to_place) * (law * at_place / (1 + law * ((place @ left) @ to_place)))
        return -((2 * np.pi * hz) ** 2) * out

    def accelerance(self, hz: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Exact accelerance (p, q, lines)."""
        values, left, right = self.fractions()
        s = 2j * np.pi * hz
        each = 1 / (s - values[:, None])
        onto, into = rows @ left, right @ columns.T
        out = ((onto[:, None] * into.T[None]).reshape(-1, values.size) @ each).reshape(len(rows), len(columns), hz.size)
        if self.rubber is not None:
            place, stiffness, exponent, omega = self.rubber
            law = stiffness * (s / omega) ** exponent
            at, to = place @ left, right @ place
            seen, moved, own = (at * into.T) @ each, (onto * to) @ each, (at * to) @ each
            out = out - moved[:, None] * (seen * law / (1 + law * own))[None]
        return -((2 * np.pi * hz) ** 2) * out

    def poles(self) -> tuple[np.ndarray, np.ndarray]:
        """Poles of positive frequency, sorted, and their modal vectors (n, poles)."""
        values, left, _ = self.fractions()
        keep = np.flatnonzero(values.imag > 0)
        keep = keep[np.argsort(np.abs(values[keep]))]
        values, left = values[keep], left[:, keep]
        if self.rubber is None:
            return values, left
        place, stiffness, exponent, omega = self.rubber
        values, left = values.copy(), left.copy()
        for i, pole in enumerate(values[:16]):  # the law depends on the pole: a few fixed-point steps each
            for _step in range(5):
                law = stiffness * (pole / omega) ** exponent
                near, vectors, _ = self.fractions(self.stiffness + law * np.outer(place, place))
                best = int(np.argsort(np.where(near.imag > 0, np.abs(near), np.inf))[i])
                pole, left[:, i] = near[best], vectors[:, best]
            values[i] = pole
        return values, left


@dataclass(frozen=True)
class Hidden:
    """The operating state and the measuring set-up that differ from the idle one."""

    system: System
    rows: np.ndarray  # (sensors, n) of the operating structure (an absorber and a missing mode add a coordinate)
    shapes: np.ndarray  # (3 nodes, n)
    effects: tuple[dict, ...] = ()
    check_system: System | None = None  # where the check runs see another structure (mass of a sensor)
    gain: dict[int, float] = field(default_factory=dict)  # per sensor
    delay: dict[int, float] = field(default_factory=dict)
    swap: tuple[int, int] | None = None
    force_gain: dict[int, float] = field(default_factory=dict)  # per sensor index of the reference, check runs
    force_delay: dict[int, float] = field(default_factory=dict)
    remounted: Remounted | None = None  # sensors and shaker of the running set-up where they were put back on another day

    @property
    def seen(self) -> np.ndarray:
        """Modal rows (sensors, n) of the motions that the sensors of the running set-up see."""
        return self.rows if self.remounted is None else self.remounted.rows


def idle(structure: Structure) -> Hidden:
    """Nothing hidden."""
    omega = 2 * np.pi * structure.hz
    damping = np.diag(2 * structure.zeta * omega)
    if structure.dashpot is not None:
        damping = damping + structure.dashpot
    system = System(np.eye(omega.size), damping, np.diag(omega**2))
    return Hidden(system, structure.rows, structure.shapes)


def change_db(
    structure: Structure, state: Hidden, references: tuple[int, ...], base: Hidden | None = None, system: System | None = None
) -> float:
    """rms over lines in band and pairs of 20·log10 of the operating over the idle FRF magnitude."""
    hz = np.linspace(*structure.band, 260)
    base = base or idle(structure)
    before = base.system.accelerance(hz, base.rows, base.rows[list(references)])
    after = (system or state.system).accelerance(hz, state.rows, state.rows[list(references)])
    return float(np.sqrt(np.mean((20 * np.log10(np.abs(after) / np.abs(before))) ** 2)))


def hide(
    kind: str,
    structure: Structure,
    references: tuple[int, ...],
    rng: np.random.Generator,
    base: Hidden | None = None,
    *,
    most_db: float = DB_RANGE[1],
    largest: float = np.inf,
    target_db: float | None = None,
) -> Hidden:
    """One effect at a random place that changes the FRFs by 0.5 to 6 dB, at random, or by ``target_db``; no larger than ``largest``."""
    base = base or idle(structure)
    if kind in SENSOR:
        return _sensor_fault(kind, structure, references, rng, base)
    for _ in range(60):
        target = target_db or float(np.exp(rng.uniform(*np.log((DB_RANGE[0], most_db)))))
        make, low, high = _maker(kind, structure, rng, base)
        least = DB_RANGE[0] if target_db is None else 0.95 * target_db
        found = _sized((make, low, min(high, largest)), structure, references, base, target, least)
        if found is not None:
            return found
    raise RuntimeError(f"no place for {kind} changes the FRFs by {target_db or DB_RANGE} dB")


def _sized(
    maker, structure: Structure, references: tuple[int, ...], base: Hidden, target: float, least: float = DB_RANGE[0]
) -> Hidden | None:
    """Bisection in the logarithm of the size; None where the target cannot be met or the state is not stable."""
    make, low, high = maker

    def change(size: float) -> float:
        state = make(size)
        if state is None or least_damping(state.system) < ZETA_LEAST:
            return np.inf
        return change_db(structure, state, references, base)

    top = change(high)
    if np.isfinite(top) and top < least:
        return None
    if change(low) > target:
        return None
    if np.isfinite(top) and top <= target:
        low = high
    for _ in range(12 if low < high else 0):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if change(middle) > target else (middle, high)
    # A size beyond which the place is all but fixed cannot be found by anyone: a fifth less must show.
    fifth = LEAST_OF_A_FIFTH * min(1.0, least / DB_RANGE[0])
    if change(low) < least or change_db(structure, make(0.8 * low), references, make(low)) < fifth:
        return None
    return make(low)


def least_damping(system: System) -> float:
    values, _ = system.poles() if system.rubber is None else replace(system, rubber=None).poles()
    return float((-values.real / np.abs(values)).min())


def _effect(kind: str, places: list[Sensor], parameters: dict[str, float], **more: object) -> dict:
    unit = dict(UNITS, coefficient="N·s/m" if kind == "gyroscopic" else "N/m")
    values = {name: {"value": float(value), "unit": unit[name]} for name, value in parameters.items()}
    return {"kind": kind, "location": [s.name for s in places], "parameters": values, **more}


def _maker(kind: str, structure: Structure, rng: np.random.Generator, base: Hidden):
    """(size -> state or None, smallest, largest size) at a place drawn now."""
    sensors, system, rows = structure.sensors, base.system, base.rows
    used = {name for effect in base.effects for name in effect["location"]}
    free = [i for i, s in enumerate(sensors) if s.name not in used]
    i = int(rng.choice(free))
    b = rows[i]
    low_hz, high_hz = structure.band
    # Sizes about which something happens at this place: a mass and a stiffness of the band's centre.
    typical_mass = 1 / np.mean(rows[:, : int(structure.in_band.sum())] ** 2)
    centre = 2 * np.pi * np.sqrt(low_hz * high_hz)

    def state(new: System, places: list[Sensor], parameters: dict[str, float], **more: object) -> Hidden:
        return replace(base, system=new, effects=(*base.effects, _effect(kind, places, parameters, **more)))

    if kind == "point_mass":
        node_rows = [rows[j] for j, s in enumerate(sensors) if s.node == sensors[i].node]
        outer = sum(np.outer(r, r) for r in node_rows)
        return lambda m: state(replace(system, mass=system.mass + m * outer), [sensors[i]], {"mass": m}), 1e-4 * typical_mass, typical_mass
    if kind == "ground_spring":
        wide = 3 * typical_mass * centre**2
        return (
            lambda k: state(replace(system, stiffness=system.stiffness + k * np.outer(b, b)), [sensors[i]], {"stiffness": k}),
            1e-5 * wide,
            wide,
        )
    if kind == "ground_damper":
        wide = typical_mass * centre
        return (
            lambda c: state(replace(system, damping=system.damping + c * np.outer(b, b)), [sensors[i]], {"damping": c}),
            1e-6 * wide,
            wide,
        )
    if kind == "ground_hysteretic_spring":
        wide, eta = 3 * typical_mass * centre**2, rng.uniform(0.08, 0.6)
        return (
            lambda k: state(
                replace(system, stiffness=system.stiffness + k * (1 + 1j * eta) * np.outer(b, b)),
                [sensors[i]],
                {"stiffness": k, "loss_factor": eta},
            ),
            1e-5 * wide,
            wide,
        )
    if kind == "ground_rubber":
        wide, alpha = 3 * typical_mass * centre**2, rng.uniform(0.12, 0.6)
        omega = np.pi * (low_hz + high_hz)
        return (
            lambda k: state(
                replace(system, rubber=(b, k, alpha, omega)),
                [sensors[i]],
                {"stiffness": k, "exponent": alpha},
                reference_hz=omega / 2 / np.pi,
            ),
            1e-5 * wide,
            wide,
        )
    if kind == "tuned_absorber":
        hz, zeta = rng.uniform(low_hz + 0.2 * (high_hz - low_hz), low_hz + 0.85 * (high_hz - low_hz)), rng.uniform(0.02, 0.1)
        return lambda m: _absorber(base, structure, sensors[i], b, [(m, hz, zeta)], kind), 1e-4 * typical_mass, typical_mass
    if kind in TWO_PLACES:
        j = int(rng.choice([k for k in free if k != i]))
        together = [p for p in structure.pairs if p[0] in free and p[1] in free]
        if kind in ("gyroscopic", "circulatory") and together and rng.uniform() < 0.6:
            i, j = together[int(rng.integers(len(together)))]
        b1, b2 = rows[i], rows[j]
        d, skew = np.outer(b1 - b2, b1 - b2), np.outer(b1, b2) - np.outer(b2, b1)
        sign = 1 if rng.uniform() < 0.5 else -1
        ends = [sensors[i], sensors[j]]
        wide_c, wide_k = typical_mass * centre, 3 * typical_mass * centre**2
        if kind == "coupling_spring":
            return lambda k: state(replace(system, stiffness=system.stiffness + k * d), ends, {"stiffness": k}), 1e-5 * wide_k, wide_k
        if kind == "coupling_damper":
            return lambda c: state(replace(system, damping=system.damping + c * d), ends, {"damping": c}), 1e-6 * wide_c, wide_c
        if kind == "gyroscopic":
            return (
                lambda g: state(replace(system, damping=system.damping + sign * g * skew), ends, {"coefficient": sign * g}),
                1e-5 * wide_c,
                wide_c,
            )
        return (
            lambda g: state(replace(system, stiffness=system.stiffness + sign * g * skew), ends, {"coefficient": sign * g}),
            1e-6 * wide_k,
            wide_k,
        )
    own = idle(structure).system  # a change of all is one of the structure, not of what was hung on it before
    if kind == "global_stiffness":
        sign = 1 if rng.uniform() < 0.5 else -1
        return (
            lambda c: state(replace(system, stiffness=add_to_first(system.stiffness, sign * c * own.stiffness)), [], {"change": sign * c}),
            1e-4,
            0.15,
        )
    if kind == "global_damping":
        sign, wide = (1, rng.uniform(0.8, 3.0)) if rng.uniform() < 0.75 else (-1, 0.6)
        return (
            lambda c: state(replace(system, damping=add_to_first(system.damping, sign * c * own.damping)), [], {"change": sign * c}),
            1e-3,
            wide,
        )
    if kind == "missing_mode":
        count = int(structure.in_band.sum())
        modes_hz = structure.hz[: count + 1]
        for _ in range(200):
            hz = rng.uniform(low_hz + 0.1 * (high_hz - low_hz), high_hz - 0.1 * (high_hz - low_hz))
            if np.abs(modes_hz / hz - 1).min() > 0.025:
                break
        zeta = rng.uniform(0.004, 0.012)
        shape = base.shapes[:, :count] @ rng.standard_normal(count)

        def added(size: float) -> Hidden:
            column = size * shape[:, None]
            shapes = np.hstack([base.shapes, column])
            w = 2 * np.pi * hz
            grown = System(_grow(system.mass, 1.0), _grow(system.damping, 2 * zeta * w), _grow(system.stiffness, w**2))
            at = [s.sense * shapes[3 * s.node + s.axis] for s in sensors]
            effect = _effect(kind, [], {"frequency": hz, "damping_ratio": zeta})
            return replace(base, system=grown, rows=np.array(at), shapes=shapes, effects=(*base.effects, effect))

        return added, 1e-3, 2.0
    if kind == "distributed_support":
        moving = np.flatnonzero(np.abs(structure.shapes[:, :6]).max(axis=1) > 0.15 * np.abs(structure.shapes[:, :6]).max())
        bed = structure.shapes[rng.choice(moving, 14, replace=False)]
        weights = rng.uniform(0.3, 1.0, 14)
        ratio = rng.uniform(0.2, 0.6)

        def bedded(k: float) -> Hidden:
            extra_k, extra_m = (bed.T * weights) @ bed, (bed.T * weights[::-1]) @ bed
            changed = replace(system, stiffness=system.stiffness + k * extra_k, mass=system.mass + ratio * k / centre**2 * extra_m)
            return state(changed, [], {"stiffness": k})

        return bedded, 1e-5 * typical_mass * centre**2, typical_mass * centre**2
    if kind == "inerter":  # f = m·(a₁ − a₂) between two places: the catalogue has no such coupling
        j = int(rng.choice([k for k in free if k != i]))
        # In one direction at both ends: between sensors of opposite sense it would be a mass half-way, which the catalogue has.
        one, other = sensors[i].name, sensors[j].name
        turned = -1 if one[-1] == other[-1] and one[-2] != other[-2] else 1
        d = np.outer(b - turned * rows[j], b - turned * rows[j])
        ends = [sensors[i], sensors[j]]
        return lambda m: state(replace(system, mass=system.mass + m * d), ends, {"mass": m}), 1e-4 * typical_mass, typical_mass
    if kind == "added_inertia":
        node = sensors[i].node
        turns = structure.turning[node]
        return (
            lambda m: state(replace(system, mass=system.mass + m * turns.T @ turns), [sensors[i]], {"mass": m}),
            1e-5 * typical_mass,
            typical_mass,
        )
    raise ValueError(f"unknown kind {kind!r}")


def hide_between(kind: str, structure: Structure, references: tuple[int, ...], rng: np.random.Generator) -> Hidden:
    """A one-place effect at a mesh node without a sensor, half-way between two sensors."""
    base = idle(structure)
    for _ in range(60):
        node, axis = structure.gaps[int(rng.integers(len(structure.gaps)))]
        place = Sensor(0, node, axis, 1)
        row = base.shapes[3 * node + axis]
        there = replace(structure, sensors=(place,), pairs=())
        seen = replace(base, rows=row[None])
        make, low, high = _maker(kind, there, rng, seen)
        position = {"location": [], "position": structure.points[node].tolist(), "direction": "+" + "XYZ"[axis]}

        def moved(size: float, make=make, position=position) -> Hidden:
            state = make(size)
            rows = np.zeros((len(base.rows), len(state.system.mass)))
            rows[:, : base.rows.shape[1]] = base.rows
            return replace(state, rows=rows, effects=({**state.effects[0], **position},))

        target = float(np.exp(rng.uniform(*np.log(DB_RANGE))))
        found = _sized((moved, low, high), structure, references, base, target)
        if found is not None:
            return found
    raise RuntimeError(f"no place for {kind} between the sensors")


def _grow(matrix: np.ndarray, value: float) -> np.ndarray:
    out = np.zeros((len(matrix) + 1,) * 2, matrix.dtype)
    out[:-1, :-1], out[-1, -1] = matrix, value
    return out


def add_to_first(matrix: np.ndarray, change: np.ndarray) -> np.ndarray:
    """A change of the structure alone, in a matrix with the coordinates of what was hung on it."""
    out = matrix.copy()
    out[: len(change), : len(change)] += change
    return out


def _absorber(
    base: Hidden, structure: Structure, sensor: Sensor, row: np.ndarray, parts: list[tuple[float, float, float]], kind: str
) -> Hidden:
    """A mass on a spring and a damper hung at a place: one more coordinate, the mass's own displacement times √mass."""
    system, rows, shapes = base.system, base.rows, base.shapes
    for mass, hz, zeta in parts:
        omega = 2 * np.pi * hz
        link = np.append(row, -1 / np.sqrt(mass))
        outer = np.outer(link, link)
        system = System(
            _grow(system.mass, 1.0),
            _grow(system.damping, 0.0) + 2 * zeta * omega * mass * outer,
            _grow(system.stiffness, 0.0) + mass * omega**2 * outer,
            system.rubber,
        )
        rows, shapes = (np.hstack([m, np.zeros((len(m), 1))]) for m in (rows, shapes))
    mass, hz, zeta = parts[0]
    effect = _effect(kind, [sensor], {"mass": mass, "frequency": hz, "damping_ratio": zeta})
    return replace(base, system=system, rows=rows, shapes=shapes, effects=(*base.effects, effect))


def _sensor_fault(kind: str, structure: Structure, references: tuple[int, ...], rng: np.random.Generator, base: Hidden) -> Hidden:
    """Faults of the running set-up: channels in the operating and check runs, forces and the mass of a sensor in the check runs."""
    sensors = structure.sensors
    used = {name for effect in base.effects for name in effect["location"]}
    i = int(rng.choice([k for k, s in enumerate(sensors) if s.name not in used]))
    reference = int(rng.choice(references))
    gain = float(np.exp(rng.choice([-1, 1]) * rng.uniform(0.06, 0.69)))
    delay = float(rng.uniform(3e-4, 3e-3))

    def with_effect(places: list[Sensor], parameters: dict[str, float], **change: object) -> Hidden:
        return replace(base, effects=(*base.effects, _effect(kind, places, parameters)), **change)

    if kind == "sensor_gain":
        return with_effect([sensors[i]], {"gain": gain}, gain={**base.gain, i: gain})
    if kind == "sensor_polarity":
        return with_effect([sensors[i]], {}, gain={**base.gain, i: -1.0})
    if kind == "sensor_delay":
        return with_effect([sensors[i]], {"delay": delay}, delay={**base.delay, i: delay})
    if kind == "channel_swap":
        j = int(rng.choice([k for k in range(len(sensors)) if k != i]))
        return with_effect([sensors[i], sensors[j]], {}, swap=(i, j))
    if kind == "force_gain":
        return with_effect([sensors[reference]], {"gain": gain}, force_gain={reference: gain})
    if kind == "force_delay":
        return with_effect([sensors[reference]], {"delay": delay}, force_delay={reference: delay})
    heavy = hide("point_mass", structure, references, rng, base, most_db=1.5, largest=1.5)
    effect = {**heavy.effects[-1], "kind": "sensor_mass"}
    return replace(base, check_system=heavy.system, effects=(*base.effects, effect))
