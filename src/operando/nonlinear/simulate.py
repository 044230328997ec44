"""Forward simulation of the idle model with effects under a measured force: as a prediction of its own, and against the records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft

from operando.data import Channel, ModalModel, TimeRecord
from operando.dof import match_dofs, parse_dofs
from operando.effects import Effect, kind_of
from operando.errors import ConfigError, DataError
from operando.nonlinear.closed import Track, fineness, follow, loop_of, on_lines, steepness, sticks, track
from operando.nonlinear.hold_out import decayed
from operando.nonlinear.laws import LawFit
from operando.nonlinear.loop import Loop
from operando.nonlinear.place import Weighted
from operando.nonlinear.run import Complex, Modes, Real, Run, decay_in_time

if TYPE_CHECKING:
    from operando.nonlinear.search import Case
    from operando.nonlinear.steps import Tried

PERIODS = 5.0
"""Length of a window in periods of the lowest mode."""

DRAWN = 400
"""Samples of the figure."""


def simulate(idle: ModalModel, effects: Sequence[Effect], force: TimeRecord, responses: Any = None) -> TimeRecord:
    """Accelerations of the model with effects under a force record, from rest.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent ones, springs and dampers.
    force : TimeRecord
        With force channels at DOFs of the idle model; other channels are not used.
    responses : DOFs, optional
        Default all DOFs of the idle model.

    Returns
    -------
    TimeRecord
        Accelerations [m/s²], sampled like the force.

    Raises
    ------
    DataError
        If the idle model has no scale or no force channel is at one of its DOFs.
    ConfigError
        If an effect has no restoring force of displacement and velocity.
    """
    if idle.scaling != "unit_modal_mass":
        raise DataError("the idle model has no scale, so a force makes no response of known size")
    driven = [i for i in force.force_indices if force.channels[i].dof is not None]
    if not driven:
        raise DataError("no force channel with a DOF", where=force.name or None)
    wanted = idle.dofs if responses is None else tuple(parse_dofs(responses))
    modes = Modes.of(idle)
    free = modes.hz > 1e-3
    modes = modes.only(free)
    at, signs = match_dofs(tuple(d for i in driven if (d := force.channels[i].dof) is not None), idle.dofs)
    rows, senses = match_dofs(wanted, idle.dofs)
    n, rate = force.n_samples, force.sampling_hz
    laws, bs = [], []
    for effect in effects:
        law, b = law_of(effect, idle)
        laws.append(law)
        bs.append(b)
    forces = sfft.rfft(np.asarray(force.data[driven], float) * np.asarray(signs, float)[:, None], axis=1)
    shapes = np.stack([modes.phi.T @ b for b in bs]) if bs else np.zeros((0, modes.hz.size))
    top = min(float(modes.hz[modes.hz < 0.5 * rate].max(initial=0.1 * rate)), 0.5 * rate)
    linear = from_rest(modes, modes.phi[np.asarray(at)].T @ forces, n, 1 / rate)[0]
    steep = [steepness(law, shape, float(np.max(np.abs(shape @ linear)))) for law, shape in zip(laws, shapes, strict=True)]
    fine = fineness(top, rate, max(steep, default=0.0), sticks(laws))
    total, step = n * fine, 1 / (rate * fine)
    drive = np.zeros((modes.hz.size, total // 2 + 1), complex)
    drive[:, : forces.shape[1]] = modes.phi[np.asarray(at)].T @ forces * fine
    if laws:
        x, v = (shapes @ part for part in from_rest(modes, drive, total, step)[:2])
        rest = np.zeros((modes.hz.size, n))
        moving = Track(n, rate, Loop(modes.poles, shapes, step), fine, x, v, rest, rest, np.zeros((len(bs), n)))
        s = follow([moving], [laws], np.inf)[0][0]
        drive = drive - shapes.T @ sfft.rfft(s, total, axis=-1)
    a = from_rest(modes, drive, total, step)[2][:, ::fine]
    data = np.asarray(senses, float)[:, None] * (modes.phi[np.asarray(rows)] @ a)
    channels = tuple(Channel(d, "acceleration", "m/s2") for d in wanted)
    return TimeRecord(data, rate, channels, name=f"{force.name}, simulated" if force.name else "simulated")


def from_rest(modes: Modes, drive: Complex, n: int, step: float) -> tuple[Real, Real, Real]:
    """Modal displacement, velocity and acceleration (modes, n) under modal forces given as spectra, at rest at the first sample."""
    w = 2 * np.pi * sfft.rfftfreq(n, step)
    q = modes.receptance_kernel(w / (2 * np.pi)) * drive
    x, v, a = (sfft.irfft(part, n, axis=1) for part in (q, 1j * w * q, -(w**2) * q))
    poles = modes.poles
    c = -(x[:, 0] / 2 + 1j * (poles.real * x[:, 0] - v[:, 0]) / (2 * poles.imag))
    # decay_in_time divides by 1 − exp(λT), which belongs to periodic sums; here the decay starts at once.
    c = c * (1 - np.exp(poles * n * step))
    more = decay_in_time(poles, np.stack([c, c * poles, c * poles**2]), n, step, apart=True)
    return x + more[0], v + more[1], a + more[2]


def has_restoring_force(effect: Effect) -> bool:
    """Whether an effect is a force of displacement and velocity, as records can be fitted with."""
    linear = ("ground_spring", "ground_damper", "coupling_spring", "coupling_damper")
    return effect.definition.acts == "pseudo_force" or effect.kind in linear


def law_of(effect: Effect, idle: ModalModel) -> tuple[LawFit, Real]:
    """Restoring force of an effect, and the weights of the DOFs along which it acts.

    Raises
    ------
    ConfigError
        If it has none.
    """
    kind = effect.definition
    if not has_restoring_force(effect):
        raise ConfigError(f"{effect.kind} has no restoring force of displacement and velocity, so it cannot be simulated in time")
    if not effect.location:
        raise ConfigError(f"{effect.kind} stands at a position without a sensor: not simulated yet")
    rows, signs = match_dofs(effect.location, idle.dofs)
    b = np.zeros(len(idle.dofs))
    b[rows[0]] = signs[0]
    if len(rows) == 2:
        b[rows[1]] -= signs[1]
    values = {k: float(v) for k, v in effect.values.items()}
    if effect.removed:
        first = kind.parameters[0].name
        values[first] = -values[first]
    return LawFit(effect.kind, 1.0, values, 0.0, len(kind.parameters)), b


def tracks_of(case: Case, accepted: Sequence[Tried], number: int, loop: Loop) -> Track:
    """One run of a case with its accepted laws, ready to be followed."""
    run = [*case.fitted, *case.validation][number]
    places = []
    for t in accepted:
        m = t.spot.whole[number]
        memory = np.zeros(run.n_samples)
        kind = kind_of(t.law.kind)
        if getattr(kind, "has_state", False):
            memory = kind.memory(m.x, t.law.values)[:: m.crossing.fine]  # type: ignore[attr-defined]
        places.append((t.spot.b, m.spectrum(t.law), memory))
    last, m = accepted[-1], accepted[-1].spot.whole[number]
    _, amplitudes, _ = m.along.free_force(0.0, m.under(last.law))
    hz = run.all_hz
    drive = run.drive(case.modes)
    kernel = case.modes.bounded_kernel(hz, spurious(case, accepted), float(run.hz[0]))
    base = np.stack([(case.modes.phi.T @ t.spot.b) @ (kernel * drive) for t in accepted])
    # Beyond its last mode the model knows nothing of a place that was not driven.
    base[:, max(int(run.lines[-1]) + 1, int(np.searchsorted(hz, min(case.modes.known_hz, 0.47 * run.sampling_hz)))) :] = 0
    return track(run, case.modes, loop, base, places, amplitudes)


def loop_for(case: Case, accepted: Sequence[Tried]) -> Loop:
    """Response across the places of the accepted laws."""
    run = case.fitted[0]
    steep = 0.0
    for t in accepted:
        reach = max(float(np.max(np.abs(m.x))) for m in t.spot.whole)
        steep = max(steep, steepness(t.law, case.modes.phi.T @ t.spot.b, reach))
    step = 1 / (run.sampling_hz * fineness(float(run.hz[-1]), run.sampling_hz, steep, sticks(t.law for t in accepted)))
    bs, outside = [t.spot.b for t in accepted], [t.spot.outside for t in accepted]
    return loop_of(case.modes, bs, outside, run, step, spurious(case, accepted))


def spurious(case: Case, accepted: Sequence[Tried]) -> NDArray[np.bool_]:
    """Modes (n,) that say nothing below the band at any of the places."""
    first = float(case.fitted[0].hz[0])
    return np.all([case.modes.spurious(t.spot.b, first) for t in accepted], axis=0)


def lowest_hz(case: Case) -> float:
    """Lowest frequency of a mode that moves under its stiffness [Hz]."""
    hz = case.idle.frequencies_hz
    return float(np.min(hz[hz > 1e-3]))


def against_records(case: Case, accepted: Sequence[Tried]) -> dict[str, Any]:
    """The model with its laws in the closed loop against the validation records (the fitted ones where there is one level).

    Parameters
    ----------
    case : Case
        As it was before anything was accepted, with the noise found.
    accepted : sequence of Tried

    Returns
    -------
    dict
        ``gain_db`` (fall of the error against the idle model), ``horizon_s``, ``records`` [{name, force_n, gain_db, ``idle_misfit``,
        ``misfit``}], ``figure`` {record, dof, time_s, measured, idle, simulated [m/s²]}; empty where the sampling rates differ.
    """
    runs = [*case.fitted, *case.validation]
    n = len(case.fitted)
    picked = list(range(n, len(runs))) or list(range(n))
    if len({runs[i].sampling_hz for i in (0, *picked)}) > 1:
        return {}
    loop = loop_for(case, accepted)
    lowest = lowest_hz(case)
    horizon = PERIODS / lowest
    tracks = [tracks_of(case, accepted, i, loop) for i in picked]
    forces = follow(tracks, [[t.law for t in accepted]], horizon)[0]
    rows: list[dict[str, Any]] = []
    errors: list[list[Complex]] = []
    for i, moving, s in zip(picked, tracks, forces, strict=True):
        m = accepted[0].spot.whole[i]
        idle = m.along.weighted.error / m.along.weighted.root
        error = idle + sum(t.spot.whole[i].along.h * on_lines(runs[i], moving.fine, s[k]) for k, t in enumerate(accepted))
        pair = [decayed(m.along.weighted.with_error(e)) for e in (idle, error)]
        errors.append(pair)
        power = [float(np.mean(np.abs(e) ** 2)) for e in pair]
        rows.append(
            {
                "name": runs[i].name,
                "force_n": runs[i].force_level,
                "idle_misfit": power[0],
                "misfit": power[1],
                "gain_db": float(10 * np.log10(power[0] / power[1])),
            }
        )
    total = [sum(r[key] for r in rows) for key in ("idle_misfit", "misfit")]
    k = int(np.argmax([r["idle_misfit"] for r in rows]))
    i = picked[k]
    figure = _figure(runs[i], accepted[0], accepted[0].spot.whole[i].along.weighted, errors[k], lowest, case)
    return {"gain_db": float(10 * np.log10(total[0] / total[1])), "horizon_s": horizon, "records": rows, "figure": figure}


def _figure(run: Run, first: Tried, weighted: Weighted, errors: Sequence[Complex], lowest: float, case: Case) -> dict[str, Any]:
    """Measured and simulated response where the effect acts, or where the idle model is worst, around the largest one."""
    own = [k for k, row in enumerate(run.rows) if first.spot.b[row] != 0]
    k = own[0] if own else int(np.argmax(np.mean(np.abs(errors[0]) ** 2, axis=1)))
    measured = run.responses[k, run.lines]
    signals = []
    for spectrum in (measured, *(measured - e[k] / weighted.root[k] for e in errors)):
        full = np.zeros(run.n_samples // 2 + 1, complex)
        full[run.lines] = spectrum
        signals.append(sfft.irfft(full, run.n_samples))
    size = min(DRAWN, run.n_samples // 4, int(np.ceil(4 * run.sampling_hz / lowest)) + 1)
    inside = slice(run.n_samples // 20, -run.n_samples // 20)
    middle = run.n_samples // 20 + int(np.argmax(np.abs(signals[0][inside])))
    start = int(np.clip(middle - size // 2, 0, run.n_samples - size))
    part = slice(start, start + size)
    names = ("measured", "idle", "simulated")
    time = (np.arange(run.n_samples)[part] / run.sampling_hz).tolist()
    return {"record": run.name, "dof": str(case.idle.dofs[run.rows[k]]), "time_s": time} | {
        name: signal[part].tolist() for name, signal in zip(names, signals, strict=True)
    }
