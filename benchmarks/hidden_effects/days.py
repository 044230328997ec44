"""What differs between two days in a laboratory and is no hidden effect: sensors and shaker put back, another temperature, joints.

Day one is the structure at rest, day two its running state with the check. Every difference has a form of its own, taken from what
causes it, not one number a channel or a mode, so that a diagnosis is not asked to find what it was built to allow for. Sizes:

- Gain of accelerometers and force cells: σ 1 %, what a calibration by comparison leaves (usually stated as 1 to 2 %).
- Mounting: an accelerometer on a magnet or on wax is itself a resonator of 1.2 to 4 kHz, another one each time it is put back; at
  130 Hz the gains of two mountings differ by up to 1.1 %. Low end: a charge amplifier of 1 s (0.16 Hz), whose time constant another
  range or temperature changes by a fifth (σ); 0.6 degrees at 3 Hz.
- Put back by hand: a sensor 0.3 to 1.5 degrees askew, so that 0.5 to 2.6 % of the motion across is seen, and 1 to 4 mm beside its
  place; the shaker 0.5 to 2 degrees askew and 1.5 to 2.5 % of the distance between neighbouring sensors (3 to 10 mm) beside its place.
- Temperature: 5 to 20 K; carbon steel loses 0.03 % of its stiffness a kelvin (203.4 GPa at 21 °C, 198.6 at 93 °C). Assumed: rubber
  mounts 5 times as much, bearings and clamped feet, whose preload changes, 3 times, and no part as warm as the next (40 to 160 %
  as a rule). Scaled so that the modes in band move by 0.1 to 0.3 % rms, which is 0.4 % of stiffness in the middle.
- Damping: the share of each part (in the proportion of its strain energy) changes by itself, as joints settle, to between 0.3 and 2 of
  what it was; scaled so that the damping of the modes in band changes by 7 to 13 % rms. Damping between the modes comes with it.
- Clocks: the module with the force starts up to three steps of 20 µs (a converter of 51.2 kHz) before or after the one with the responses.

Here is also the local damper of cases with complex modes, which stands there on both days. Shares no code with operando.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from families import Sensor, Structure
from hidden import ZETA_LEAST, Hidden, System, add_to_first, idle, least_damping

GAIN = 0.01
MOUNTING_HZ = (1200.0, 4000.0)
CORNER_HZ, CORNER_SPREAD = 0.16, 0.2
SENSOR_ASKEW, SHAKER_ASKEW = (0.3, 1.5), (0.5, 2.0)  # degrees
SENSOR_OFF_M = (0.001, 0.004)
SHAKER_OFF = (0.015, 0.025)  # of the distance between neighbouring sensors
SHIFT = (0.001, 0.003)  # rms of the relative shifts of the frequencies in band
SOFTER = {"foot": 3.0, "bearing": 3.0, "mount": 5.0}  # change of stiffness a kelvin over that of steel
UNEVEN_WARMTH = 0.6
DAMPING = (0.07, 0.13)  # rms of the relative changes of the damping in band
OF_A_PART = (0.3, 2.0)  # the least and most it may have of the damping of day one
SKEW_STEP, SKEW_STEPS = 1 / 51200, 3

DASHPOT_ZETA = (0.05, 0.10)  # of the most damped mode in band
DASHPOT_OTHERS = 0.006  # what it adds to all but two modes at most, less than they have
MPC_MOST = 0.9


@dataclass(frozen=True)
class Channel:
    """What a channel makes of a motion or force on day two, over what it made of it on day one."""

    gain: float
    mounting_hz: tuple[float, float]  # day one, day two
    corner_hz: tuple[float, float]

    def ratio(self, hz: np.ndarray) -> np.ndarray:
        first, second = (1 / (1 - (hz / f) ** 2) for f in self.mounting_hz)
        # jf/(f_c + jf) of both days, whose quotient is finite at 0 Hz
        slow = (self.corner_hz[0] + 1j * hz) / (self.corner_hz[1] + 1j * hz)
        return self.gain * second / first * slow


@dataclass(frozen=True)
class Placing:
    """How a sensor or the shaker was put back: the unit vector it now points along, and how far beside its place [m]."""

    towards: np.ndarray
    beside: np.ndarray

    def row(self, structure: Structure, state: Hidden, sensor: Sensor) -> np.ndarray:
        """Modal row of the motion there: what the node does, and its rotation times the offset."""
        moved = state.shapes[3 * sensor.node : 3 * sensor.node + 3].copy()
        turning = structure.turning[sensor.node]
        moved[:, : turning.shape[1]] += np.cross(turning, self.beside, axisa=0, axisc=0)
        return sensor.sense * self.towards @ moved


@dataclass(frozen=True)
class Remounted:
    """Sensors, shaker and logger of day two; rows in the coordinates of the running structure."""

    rows: np.ndarray  # (sensors, n)
    columns: dict[int, np.ndarray]  # per reference
    sensors: tuple[Channel, ...]
    forces: dict[int, Channel]
    skew: float  # s that the responses are late against the force

    def responses(self, hz: np.ndarray) -> np.ndarray:
        return np.array([c.ratio(hz) for c in self.sensors])

    def force(self, reference: int, hz: np.ndarray) -> np.ndarray:
        return self.forces[reference].ratio(hz) * np.exp(2j * np.pi * hz * self.skew)


@dataclass(frozen=True)
class Days:
    """Everything that differs between the two days."""

    stiffness: dict[str, float]  # relative change of each part
    damping: dict[str, float]
    sensors: tuple[tuple[Channel, Placing], ...]
    forces: dict[int, tuple[Channel, Placing]]  # per reference
    skew: float


def draw_days(structure: Structure, references: tuple[int, ...], rng: np.random.Generator) -> Days:
    """Differences for a structure, at random."""
    inside = structure.in_band
    shares = {p: np.diag(k)[inside] / (2 * np.pi * structure.hz[inside]) ** 2 for p, k in structure.parts.items()}
    soft = np.array([SOFTER.get(p.split()[0], 1.0) for p in shares])
    energy = np.array(list(shares.values()))
    warmer = rng.choice([-1, 1]) * soft * (1 + UNEVEN_WARMTH * rng.standard_normal(soft.size))
    warmer *= rng.uniform(*SHIFT) / _rms(energy.T @ warmer / 2)
    whole = np.diag(idle(structure).system.damping)[inside]
    lost = np.array([np.diag(c)[inside] / whole for c in _dampers(structure).values()])
    for _ in range(200):
        joints = rng.standard_normal(len(lost))
        joints *= rng.uniform(*DAMPING) / _rms(lost.T @ joints)
        if joints.min() > OF_A_PART[0] - 1 and joints.max() < OF_A_PART[1] - 1:
            break
    else:
        raise RuntimeError("no change of the parts' damping gives the modes what they should have")

    def mounted(sensor: Sensor, askew_deg: tuple[float, float], off: tuple[float, float]) -> tuple[Channel, Placing]:
        ends = np.exp(rng.uniform(*np.log(MOUNTING_HZ), 2))
        corner = CORNER_HZ * np.exp(CORNER_SPREAD * rng.standard_normal())
        channel = Channel(1 + GAIN * float(rng.standard_normal()), (float(ends[0]), float(ends[1])), (CORNER_HZ, float(corner)))
        askew, around, along = np.radians(rng.uniform(*askew_deg)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        across = [(sensor.axis + 1) % 3, (sensor.axis + 2) % 3]
        towards, beside = np.zeros(3), np.zeros(3)
        towards[sensor.axis], towards[across] = np.cos(askew), np.sin(askew) * np.array([np.cos(around), np.sin(around)])
        beside[across] = rng.uniform(*off) * np.array([np.cos(along), np.sin(along)])
        return channel, Placing(towards, beside)

    sensors = tuple(mounted(s, SENSOR_ASKEW, SENSOR_OFF_M) for s in structure.sensors)
    beside = (SHAKER_OFF[0] * structure.spacing, SHAKER_OFF[1] * structure.spacing)
    forces = {r: mounted(structure.sensors[r], SHAKER_ASKEW, beside) for r in references}
    skew = SKEW_STEP * rng.uniform(-SKEW_STEPS, SKEW_STEPS)
    return Days(
        dict(zip(shares, map(float, warmer), strict=True)),
        dict(zip(_dampers(structure), map(float, joints), strict=True)),
        sensors,
        forces,
        float(skew),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _dampers(structure: Structure) -> dict[str, np.ndarray]:
    """Modal damping of the parts, which add up to what the structure has: C^½ (strain energy of the part) C^½, and the local damper."""
    omega = 2 * np.pi * structure.hz
    root = np.sqrt(2 * structure.zeta * omega) / omega
    parts = {p: root[:, None] * k * root for p, k in structure.parts.items()}
    return parts if structure.dashpot is None else {**parts, "dashpot": structure.dashpot}


def second_day(structure: Structure, state: Hidden, days: Days) -> Hidden:
    """The running state as it is and as it is measured on day two; what is hidden acts on the structure of day two."""

    def changed(system: System) -> System:
        # A change of all stiffness or damping is one of what there is on day two.
        more = {e["kind"]: 1 + e["parameters"]["change"]["value"] for e in state.effects if e["kind"].startswith("global_")}
        stiffer = sum(days.stiffness[p] * k for p, k in structure.parts.items()) * more.get("global_stiffness", 1.0)
        drier = sum(days.damping[p] * c for p, c in _dampers(structure).items()) * more.get("global_damping", 1.0)
        return replace(system, stiffness=add_to_first(system.stiffness, stiffer), damping=add_to_first(system.damping, drier))

    remounted = Remounted(
        np.array([place.row(structure, state, s) for s, (_, place) in zip(structure.sensors, days.sensors, strict=True)]),
        {r: place.row(structure, state, structure.sensors[r]) for r, (_, place) in days.forces.items()},
        tuple(channel for channel, _ in days.sensors),
        {r: channel for r, (channel, _) in days.forces.items()},
        days.skew,
    )
    check = None if state.check_system is None else changed(state.check_system)
    return replace(state, system=changed(state.system), check_system=check, remounted=remounted)


def some_days(structure: Structure, state: Hidden, references: tuple[int, ...], rng: np.random.Generator) -> tuple[Days, Hidden]:
    """Differences that leave every mode of the running state enough damping, and that state on day two."""
    for _ in range(100):
        days = draw_days(structure, references, rng)
        after = second_day(structure, state, days)
        if least_damping(after.system) >= ZETA_LEAST:
            return days, after
    raise RuntimeError("every drawn change of damping leaves a mode without any")


def told(structure: Structure, references: tuple[int, ...], days: Days) -> dict:
    """The differences with their sizes, for the answer: of the structure with nothing hidden in it."""
    rest = idle(structure)
    after = second_day(structure, rest, days)
    hz, inside = np.linspace(*structure.band, 200), structure.in_band
    before, now = (state.system.poles()[0][: inside.size][inside] for state in (rest, after))
    shift, factor = np.abs(now) / np.abs(before) - 1, (now.real / np.abs(now)) / (before.real / np.abs(before))

    def put_back(channel: Channel, place: Placing, new: np.ndarray, old: np.ndarray) -> dict:
        ratio = channel.ratio(hz)
        return {
            "gain": float(np.mean(ratio.real)),
            "gain_off_rms": _rms(np.abs(ratio - 1)),
            "askew_deg": float(np.degrees(np.arccos(np.abs(place.towards).max()))),
            "beside_m": float(np.linalg.norm(place.beside)),
            "shape_off_rms": _rms((new - old)[inside]) / _rms(old[inside]),
        }

    names = [s.name for s in structure.sensors]
    sensors = [put_back(*d, after.seen[i], rest.rows[i]) for i, d in enumerate(days.sensors)]
    return {
        "sensors": dict(zip(names, sensors, strict=True)),
        "forces": {names[r]: put_back(*days.forces[r], after.remounted.columns[r], rest.rows[r]) for r in references},
        "stiffness_of_parts": days.stiffness,
        "frequency_shift": shift.tolist(),
        "frequency_shift_mean": float(shift.mean()),
        "frequency_shift_rms": _rms(shift),
        "damping_of_parts": days.damping,
        "damping_factor": factor.tolist(),
        "damping_off_rms": _rms(np.log(factor)),
        "response_late_s": days.skew,
    }


def between_db(structure: Structure, references: tuple[int, ...], days: Days) -> dict[str, float]:
    """20·log10 of what day two would measure, with nothing hidden, over the FRF magnitude of day one: rms and median over lines and pairs.

    The rms lives on antiresonances, which a sensor a degree askew fills; the median does not.
    """
    before, after = day_frfs(structure, references, days, np.linspace(*structure.band, 260))
    change = 20 * np.log10(np.abs(after) / np.abs(before))
    return {"between_db": _rms(change), "between_median_db": float(np.median(np.abs(change)))}


def day_frfs(structure: Structure, references: tuple[int, ...], days: Days, hz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Accelerance (sensors, references, lines) as each day measures it, with nothing hidden and without noise."""
    rest = idle(structure)
    after = second_day(structure, rest, days)
    new = after.remounted
    raw = after.system.accelerance(hz, new.rows, np.array([new.columns[r] for r in references]))
    forces = np.array([new.force(r, hz) for r in references])
    return rest.system.accelerance(hz, rest.rows, rest.rows[list(references)]), raw * new.responses(hz)[:, None] / forces


# Complex modes


def mode_shapes(state: Hidden, rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Poles and complex shapes (rows, count) so scaled that a residue of the receptance is φφᵀ/(2j·|Im λ|): unit modal mass."""
    values, left, right = state.system.fractions()
    keep = np.flatnonzero(values.imag > 0)
    keep = keep[np.argsort(np.abs(values[keep]))][:count]
    # Reciprocal: the modal row on the right is the vector on the left times a number.
    scale = np.array([(left[:, k] @ right[k]) / (left[:, k] @ left[:, k]) for k in keep])
    return values[keep], rows @ left[:, keep] * np.sqrt(scale * 2j * np.abs(values[keep].imag))


def mpc(shapes: np.ndarray) -> np.ndarray:
    """Modal phase collinearity of each column: 1 where all places move in phase or against it."""
    xx, yy, xy = (shapes.real**2).sum(axis=0), (shapes.imag**2).sum(axis=0), (shapes.real * shapes.imag).sum(axis=0)
    return ((xx - yy) ** 2 + 4 * xy**2) / (xx + yy) ** 2


def with_dashpot(structure: Structure, rng: np.random.Generator) -> Structure:
    """The structure with one viscous damper to ground at a mesh node, in any direction, that makes one or two modes in band complex.

    The most damped mode has 5 to 10 %, the third and all others get no more than 0.6 %; one mode at least has an MPC below 0.9.
    """
    inside, omega = structure.in_band, 2 * np.pi * structure.hz
    count = int(np.flatnonzero(inside)[-1]) + 1
    for _ in range(20000):
        node, most, direction = rng.integers(len(structure.points)), rng.uniform(*DASHPOT_ZETA), rng.standard_normal(3)
        row = direction @ structure.shapes[3 * node : 3 * node + 3]
        added = row[inside] ** 2 / 2 / omega[inside]
        if added.max() == 0 or np.sort(added)[-3] > DASHPOT_OTHERS / most * added.max():
            continue
        found = replace(structure, dashpot=most / added.max() * np.outer(row, row))
        values, shapes = mode_shapes(idle(found), found.rows, count)
        values, shapes = values[inside[:count]], shapes[:, inside[:count]]
        if mpc(shapes).min() < MPC_MOST and DASHPOT_ZETA[0] < (-values.real / np.abs(values)).max() < DASHPOT_ZETA[1]:
            return found
    raise RuntimeError("no damper makes one or two modes of this structure complex")
