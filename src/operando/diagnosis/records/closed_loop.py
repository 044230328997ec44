"""Accepted laws in the closed loop: the model with its laws makes the motion itself, only the measured force and first states are given.

Where dry friction sticks, the velocity is a small part of v₀ and the force anything up to F: the motion seen, however little noise it
has, does not say what the force is, and what lies beyond the recorded band counts as much. In the loop the force is what holds the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft
from scipy.optimize import nnls

from operando.compare.verdict import GOOD
from operando.diagnosis.records.case import RecordsCase
from operando.diagnosis.records.fit_laws import misfit
from operando.diagnosis.records.motion import Motion
from operando.diagnosis.records.out_of_band import DAMPING, FACTORS
from operando.diagnosis.records.refine import eased, free_names, linearised, stepped
from operando.diagnosis.records.run import Run
from operando.diagnosis.records.spot import Spot
from operando.diagnosis.records.steps import Tried
from operando.structure.closed_loop import Loop, LoopRecord, follow, max_slope, substeps
from operando.structure.force_law import ForceLaw
from operando.structure.modal_space import Complex, Modes, Real, decay_in_time
from operando.threads import each

KINDS = ("coulomb_friction",)
"""Kinds whose force the motion seen does not give."""

WINDOW = 0.5
"""Length of the windows that run side by side [s]; each begins with the state that the force found so far gives."""

MOST = 12_000_000
"""Steps of all windows followed at once: some hundred megabytes."""

TURNS, ENOUGH, FARTHEST = 6, 0.02, 0.3
"""Turns of force and values at most; fall of the misfit that is worth another; relative change of the size in one turn, at most."""

PERIODS = 5.0
"""Length of a window against the records in periods of the lowest mode."""

DRAWN = 400
"""Samples of the figure."""


def spurious(case: RecordsCase, accepted: Sequence[Tried]) -> NDArray[np.bool_]:
    """Modes (n,) that say nothing below the band at any of the places."""
    first = float(case.fitted[0].hz[0])
    return np.all([case.modes.spurious(t.spot.b, first) for t in accepted], axis=0)


def loop_for(case: RecordsCase, accepted: Sequence[Tried]) -> Loop:
    """Response across the places of accepted laws; for one place with what lies outside the band made passive.

    Spurious modes say nothing below the band; for one place what they add in the band counts among what lies outside.
    """
    run, modes = case.fitted[0], case.modes
    shapes = np.stack([modes.phi.T @ t.spot.b for t in accepted])
    reaches = [max(float(np.max(np.abs(m.x))) for m in t.spot.whole) for t in accepted]
    steep = max(max_slope(t.law, shape, reach) for t, shape, reach in zip(accepted, shapes, reaches, strict=True))
    step = 1 / (run.sampling_hz * substeps(float(run.hz[-1]), run.sampling_hz, steep, [t.law for t in accepted]))
    idle, keep = spurious(case, accepted), modes.hz > 1e-3
    if len(accepted) > 1:
        return Loop(modes.poles[keep & ~idle], shapes[:, keep & ~idle], step)
    outside = accepted[0].spot.outside
    top = max(outside.top_hz, modes.known_hz)
    hz = run.hz[:: max(1, run.hz.size // 200)]
    above = keep & ((modes.hz > top) | idle)
    extra_hz = np.array(FACTORS) * top
    extra = Modes(extra_hz, np.full(extra_hz.size, DAMPING), np.zeros((1, extra_hz.size)))
    wanted = (shapes[0, above] ** 2) @ modes.receptance_kernel(hz)[above] + outside.compliance(hz, accepted[0].spot.b)
    table = extra.receptance_kernel(hz).real.T
    scale = np.max(np.abs(table))
    weights, _ = nnls(table / scale, wanted.real / scale)
    poles = np.concatenate([modes.poles[keep & ~above], extra.poles])
    return Loop(poles, np.concatenate([shapes[:, keep & ~above], np.sqrt(weights)[None]], axis=1), step)


def track(run: Run, modes: Modes, loop: Loop, base: Complex, force: Complex, memory: Real, amplitudes: Real) -> LoopRecord:
    """A run ready to be followed.

    From spectra (p, N//2+1) of the displacement across the places under the measured force (``base``) and of the restoring forces,
    internal states (p, N) of their laws, and amplitudes (J,) of the nuisance.
    """
    fine = round(1 / (run.sampling_hz * loop.step))
    n, hz = run.n_samples, run.all_hz
    w = 2 * np.pi * hz
    spectra = np.zeros((2, len(base), n * fine // 2 + 1), complex)
    spectra[0, :, : hz.size] = base * fine
    spectra[1, :, : hz.size] = spectra[0, :, : hz.size] * 1j * w
    x, v = sfft.irfft(spectra, n * fine, axis=-1)
    poles = loop.poles
    # Modes above the sampling rate follow the force: their state matters as much.
    modal = np.zeros((2, poles.size, hz.size), complex)
    modal[0] = -(loop.shapes.T @ force) / (np.abs(poles[:, None]) ** 2 - w**2 - 2j * poles.real[:, None] * w)
    modal[1] = modal[0] * 1j * w
    q, dq = sfft.irfft(modal, n, axis=-1)
    ringing = modes.ringing(run.sampling_hz)
    own = modes.poles[ringing]
    weights = (amplitudes[: own.size] + 1j * amplitudes[own.size : 2 * own.size]) / own**2
    decays = decay_in_time(own, np.stack([weights, weights * own]), n, 1 / run.sampling_hz, apart=True)
    for k, pole in enumerate(own):
        same = np.flatnonzero(np.abs(poles - pole) < 1e-9 * abs(pole))
        if same.size:
            q[same[0]] += decays[0, k]
            dq[same[0]] += decays[1, k]
    return LoopRecord(n, run.sampling_hz, loop, fine, x, v, q, dq, memory)


def closed_loop_force(case: RecordsCase, tried: Tried, fitted: bool = True) -> Tried:
    """A law with the force that it makes in the closed loop, its size fitted with it; as it was where that is worse than noise.

    The speed over which friction is smoothed stays: where it sticks the loop hardly depends on it, and errors of the model would move it.

    Below the last line of the band the place moves as model and force have it, above as measured. The loop's own response differs from
    that, so the difference times the force found so far goes with the free motion; turns bring the two forces together. Not ``fitted``,
    the values stay as they are.
    """
    law, spot = tried.law, tried.spot
    names = free_names(law)
    if law.kind not in KINDS or len(names) < len(law.values) or len({r.sampling_hz for r in case.runs}) > 1:
        return tried
    loop = recorded(loop_for(case, [tried]), case.runs[0].sampling_hz)
    # The force is known best from the responses, where they show it.
    forces = [m.spectrum(law).copy() for m in spot.whole]
    for m, force in zip(spot.whole, forces, strict=True):
        lines = m.along.run.lines
        force[lines] += m.taken * (m.force - force[lines])
    best, least = tried, np.inf
    for _ in range(TURNS):
        spot = followed(case, spot, law, names, forces, loop)
        gram, right, cost = linearised(law, spot.fit, names)
        fallen = cost < (1 - ENOUGH) * least
        if cost < least:
            best, least = Tried.of(spot, law), cost
        if not fallen:
            break
        step = float(np.clip(right[0] / max(gram[0, 0], 1e-300), -FARTHEST, FARTHEST))
        forces = [m.spectrum(law) for m in spot.whole]
        if fitted:
            law = stepped(law, names[:1], np.array([step]))
    return best if best.selection < max(misfit(tried.law, tried.spot.select), GOOD) else tried


def followed(
    case: RecordsCase, spot: Spot, law: ForceLaw, names: Sequence[str], forces: Sequence[Complex], loop: Loop, most: int = MOST
) -> Spot:
    """The spot with the force that the law, and the law with each of the named values a little larger, make in the loop.

    ``forces`` (N//2+1,) were found so far on all lines of each run; ``most`` steps are followed at once.
    """
    tracks = []
    for m, force in zip(spot.whole, forces, strict=True):
        run, crossing = m.along.run, m.crossing
        base = crossing.base + (loop.receptance(run.all_hz) - crossing.compliance) * force
        _, amplitudes, _ = m.along.free_force(0.0, force[run.lines])
        tracks.append(track(run, case.modes, loop, base[None], force[None], np.zeros((1, run.n_samples)), amplitudes))
    variants = [law, *eased(law, names)]
    made: list[list[Real]] = [[] for _ in variants]
    for together in groups([t.n_samples * t.fine * len(variants) for t in tracks], most):
        for rows, more in zip(made, follow([tracks[i] for i in together], [[v] for v in variants], WINDOW), strict=True):
            rows += more

    def moved(number: int) -> Motion:
        m = spot.whole[number]
        spectra = [m.crossing.lines(rows[number][0], tracks[number].fine) for rows in made]
        x, v = m.crossing.move(spectra[0])
        return replace(m, x=x, v=v, made={}, closed={one.key: s for one, s in zip(variants, spectra, strict=True)})

    return spot.moving(each(moved, range(len(tracks))))


def groups(sizes: Sequence[int], most: int) -> list[list[int]]:
    """Neighbours taken together up to the most that is to be in memory, one at least."""
    out: list[list[int]] = []
    left = 0
    for i, size in enumerate(sizes):
        if not out or size > left:
            out.append([])
            left = most
        out[-1].append(i)
        left -= size
    return out


def recorded(loop: Loop, sampling_hz: float) -> Loop:
    """A loop without modes that the record cannot show: what stands for them in the band makes friction answer too soon."""
    keep = np.abs(loop.poles) < np.pi * sampling_hz
    return Loop(loop.poles[keep], loop.shapes[:, keep], loop.step)


def against_records(case: RecordsCase, accepted: Sequence[Tried]) -> dict[str, Any]:
    """The model with its laws in the closed loop against the validation records (the fitted ones where there is one level).

    The case is as it was before anything was accepted, with the noise found. The dict has ``gain_db`` (fall of the error against the idle
    model), ``horizon_s``, ``records`` [{name, force_n, gain_db, ``idle_misfit``, ``misfit``}], ``figure`` {record, dof, time_s, measured,
    idle, simulated [m/s²]}; it is empty where the sampling rates differ.
    """
    picked = list(range(len(case.runs)))[case.hold_out()]
    if len({case.runs[i].sampling_hz for i in (0, *picked)}) > 1:
        return {}
    loop = loop_for(case, accepted)
    lowest = float(np.min(case.idle.frequencies_hz[case.idle.frequencies_hz > 1e-3]))
    tracks = [_track_of(case, accepted, i, loop) for i in picked]
    forces = follow(tracks, [[t.law for t in accepted]], PERIODS / lowest)[0]
    rows: list[dict[str, Any]] = []
    errors: list[list[Complex]] = []
    for i, moving, s in zip(picked, tracks, forces, strict=True):
        run, weighted = case.runs[i], accepted[0].spot.whole[i].along.weighted
        spectra = sfft.rfft(s, axis=-1)[:, run.lines] / moving.fine
        error = weighted.raw + sum(t.spot.whole[i].along.h * spectra[k] for k, t in enumerate(accepted))
        errors.append([w.decayed() for w in (weighted, weighted.with_error(error))])
        power = [float(np.mean(np.abs(e) ** 2)) for e in errors[-1]]
        row = {"name": run.name, "force_n": run.force_level, "idle_misfit": power[0], "misfit": power[1]}
        rows.append(row | {"gain_db": float(10 * np.log10(power[0] / power[1]))})
    total = [sum(r[key] for r in rows) for key in ("idle_misfit", "misfit")]
    worst = int(np.argmax([r["idle_misfit"] for r in rows]))
    figure = _figure(case, accepted[0].spot, picked[worst], errors[worst], lowest)
    return {"gain_db": float(10 * np.log10(total[0] / total[1])), "horizon_s": PERIODS / lowest, "records": rows, "figure": figure}


def _track_of(case: RecordsCase, accepted: Sequence[Tried], number: int, loop: Loop) -> LoopRecord:
    """One run of a case with its accepted laws, ready to be followed."""
    run, motions = case.runs[number], [t.spot.whole[number] for t in accepted]
    memory = np.zeros((len(accepted), run.n_samples))
    for row, t, m in zip(memory, accepted, motions, strict=True):
        if t.law.remembers:
            row[:] = t.law.definition.memory(m.x, t.law.values, m.v * m.step)[:: m.crossing.fine]  # type: ignore[attr-defined]
    _, amplitudes, _ = motions[-1].along.free_force(0.0, motions[-1].beside(accepted[-1].law))
    hz = run.all_hz
    drive = run.modal_forces
    kernel = case.modes.bounded_kernel(hz, spurious(case, accepted), float(run.hz[0]))
    base = np.stack([(case.modes.phi.T @ t.spot.b) @ (kernel * drive) for t in accepted])
    # Beyond its last mode the model knows nothing of a place that was not driven.
    base[:, max(int(run.lines[-1]) + 1, int(np.searchsorted(hz, min(case.modes.known_hz, 0.47 * run.sampling_hz)))) :] = 0
    forces = np.stack([m.spectrum(t.law) for t, m in zip(accepted, motions, strict=True)])
    return track(run, case.modes, loop, base, forces, memory, amplitudes)


def _figure(case: RecordsCase, spot: Spot, number: int, errors: Sequence[Complex], lowest: float) -> dict[str, Any]:
    """Measured and simulated response where the effect acts, or where the idle model is worst, around the largest one."""
    run, weighted = case.runs[number], spot.whole[number].along.weighted
    own = [k for k, row in enumerate(run.rows) if spot.b[row] != 0]
    k = own[0] if own else int(np.argmax(np.mean(np.abs(errors[0]) ** 2, axis=1)))
    measured = run.responses[k, run.lines]
    full = np.zeros((3, run.n_samples // 2 + 1), complex)
    full[:, run.lines] = [measured, *(measured - e[k] / weighted.root[k] for e in errors)]
    signals = sfft.irfft(full, run.n_samples, axis=-1)
    size = min(DRAWN, run.n_samples // 4, int(np.ceil(4 * run.sampling_hz / lowest)) + 1)
    inside = slice(run.n_samples // 20, -run.n_samples // 20)
    middle = run.n_samples // 20 + int(np.argmax(np.abs(signals[0][inside])))
    start = int(np.clip(middle - size // 2, 0, run.n_samples - size))
    part = slice(start, start + size)
    time = (np.arange(run.n_samples)[part] / run.sampling_hz).tolist()
    signal = {name: signal[part].tolist() for name, signal in zip(("measured", "idle", "simulated"), signals, strict=True)}
    return {"record": run.name, "dof": str(case.idle.dofs[run.rows[k]]), "time_s": time} | signal
