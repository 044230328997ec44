"""Laws in the closed loop: what the model with its law does under a measured force, and values refitted to that.

A regression on the measured motion is bent by the noise of that motion. In the closed loop the model makes the motion itself: only the
measured force and the state at the beginning come from the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft as sfft
from scipy.optimize import nnls

from operando.effects import kind_of
from operando.nonlinear.laws import LawFit, law_force
from operando.nonlinear.loop import FrictionLaw, Loop, MemoryLaw, StepLaw, run_loop
from operando.nonlinear.outside import DAMPING, FACTORS, Outside
from operando.nonlinear.place import Along
from operando.nonlinear.run import Complex, Modes, Real, Run, decay_in_time

STEP_SHARE = 0.005
"""Relative change of a value for a difference quotient."""

PER_CYCLE = 7.0
"""Steps in a period of the highest frequency compared, at least."""


@dataclass(frozen=True)
class Free:
    """Motion across places that a run's force alone makes from its first state, on a fine grid.

    Parameters
    ----------
    x, v : (p, N·fine) arrays
    """

    x: Real
    v: Real


def fineness(run: Run) -> int:
    """Steps a sample."""
    return max(1, int(np.ceil(PER_CYCLE * run.hz[-1] / run.sampling_hz)))


def loop_of(modes: Modes, bs: Sequence[Real], outside: Sequence[Outside | None], run: Run) -> Loop:
    """Response across the places to forces along them; for one place with what lies outside the band made passive.

    Parameters
    ----------
    modes : Modes
    bs : sequence of (m,) arrays
    outside : sequence of Outside or None
        Corrections, used where there is one place.
    run : Run
        For its lines and sampling.
    """
    shapes = np.stack([modes.phi.T @ b for b in bs])
    poles = modes.poles
    step = 1 / (run.sampling_hz * fineness(run))
    if len(bs) == 1 and outside[0] is not None:
        top = outside[0].top_hz
        hz = run.hz[:: max(1, run.hz.size // 200)]
        above = modes.hz > top
        wanted = (shapes[0, above] ** 2) @ modes.receptance_kernel(hz)[above] + outside[0].compliance(hz, bs[0])
        extra_hz = np.array(FACTORS) * top
        extra = Modes(extra_hz, np.full(extra_hz.size, DAMPING), np.zeros((1, extra_hz.size)))
        table = extra.receptance_kernel(hz).real.T
        scale = np.max(np.abs(table))
        weights, _ = nnls(table / scale, wanted.real / scale)
        poles = np.concatenate([poles[~above], extra.poles])
        shapes = np.concatenate([shapes[:, ~above], np.sqrt(weights)[None]], axis=1)
    keep = np.any(shapes != 0, axis=0)
    return Loop(poles[keep], shapes[:, keep], step)


def first_state(run: Run, modes: Modes, drive: Complex, amplitudes: Real) -> tuple[Real, Real]:
    """Modal displacements and velocities (n,) at the first sample under modal forces ``drive`` (n, N//2+1) with free decays."""
    hz = run.all_hz
    weight = np.full(hz.size, 2.0)
    weight[0] = 1.0
    if run.n_samples % 2 == 0:
        weight[-1] = 1.0
    q = modes.receptance_kernel(hz) * drive * (weight / run.n_samples)
    ringing = modes.ringing(run.sampling_hz)
    poles = modes.poles[ringing]
    c = amplitudes[: ringing.size] + 1j * amplitudes[ringing.size :]
    c = c / poles**2 / (1 - np.exp(poles * run.n_samples / run.sampling_hz))
    x, v = np.sum(q.real, axis=1), np.sum(-(2 * np.pi * hz) * q.imag, axis=1)
    x[ringing] += 2 * c.real
    v[ringing] += 2 * (c * poles).real
    return x, v


def free_motion(run: Run, modes: Modes, bs: Sequence[Real], state: tuple[Real, Real] | None) -> Free:
    """Motion across the places under the measured force from a first state (at rest where None), on the fine grid."""
    fine = fineness(run)
    total = run.n_samples * fine
    hz = run.all_hz
    drive = run.drive(modes)
    shapes = np.stack([modes.phi.T @ b for b in bs])
    q = modes.receptance_kernel(hz) * drive
    spectra = np.zeros((2, len(bs), total // 2 + 1), complex)
    spectra[0, :, : hz.size] = shapes @ q * fine
    spectra[1] = spectra[0] * 2j * np.pi * sfft.rfftfreq(total, 1 / (run.sampling_hz * fine))
    moved = sfft.irfft(spectra, total, axis=-1)
    x0, v0 = first_state(run, modes, drive, np.zeros(2 * modes.ringing(run.sampling_hz).size))
    want_x, want_v = (np.zeros_like(x0), np.zeros_like(v0)) if state is None else state
    dx, dv = want_x - x0, want_v - v0
    ringing = modes.ringing(run.sampling_hz)
    poles = modes.poles[ringing]
    c = dx[ringing] / 2 + 1j * (poles.real * dx[ringing] - dv[ringing]) / (2 * poles.imag)
    step = 1 / (run.sampling_hz * fine)
    # decay_in_time divides by 1 − exp(λT), which belongs to periodic sums; here the decay starts at once.
    scaled = shapes[:, ringing] * c * (1 - np.exp(poles * total * step))
    return Free(moved[0] + decay_in_time(poles, scaled, total, step), moved[1] + decay_in_time(poles, scaled * poles, total, step))


def step_law(fits: Sequence[LawFit], step: float) -> StepLaw:
    """One law with values of its own for each case."""
    first = fits[0]
    kind, side = kind_of(first.kind), first.side
    values = {name: np.array([f.values[name] for f in fits]) for name in first.values}
    if first.kind == "hysteresis":
        return MemoryLaw(values["stiffness"], values["yield_force"], values["exponent"], values["ratio"], kind._slope)  # type: ignore[attr-defined]
    if first.kind == "coulomb_friction":
        level, speed = values["force"], values.get("slip_speed", np.zeros(len(fits)))
        if np.all(speed <= 0):
            return FrictionLaw(level)
        return StepLaw(lambda x, v: level * np.tanh(v / speed))
    return StepLaw(lambda x, v: side * law_force(kind, side * x, side * v, values, step))


def simulate_runs(loops: Loop, free: Sequence[Free], laws: Sequence[Sequence[LawFit]]) -> tuple[Real, Real, Real]:
    """Restoring forces and motions (p, cases, N) of cases side by side; ``laws[p][case]``."""
    longest = max(f.x.shape[1] for f in free)
    pad = lambda a: np.pad(a, ((0, 0), (0, longest - a.shape[1])), mode="edge")  # noqa: E731
    x = np.stack([pad(f.x) for f in free], axis=1)
    v = np.stack([pad(f.v) for f in free], axis=1)
    return run_loop(loops, x, v, [step_law(list(per), loops.step) for per in laws])


def coarse(run: Run, fine_force: Real) -> Complex:
    """Spectrum on the run's lines of a force on the fine grid."""
    fine = fineness(run)
    return np.asarray(sfft.rfft(fine_force[: run.n_samples * fine])[run.lines] / fine)


@dataclass(frozen=True)
class Refitted:
    """Values from the closed loop.

    Parameters
    ----------
    fit : LawFit
    std : dict
        Standard deviation of each value from the misfit that is left.
    cost : float
    iterations : int
    converged : bool
    """

    fit: LawFit
    std: dict[str, float]
    cost: float
    iterations: int
    converged: bool


def refit_closed(
    fit: LawFit, alongs: Sequence[Along], free: Sequence[Free], loop: Loop, names: Sequence[str], turns: int = 3, tolerance: float = 2e-3
) -> Refitted:
    """Gauss–Newton on the logarithms of a law's values through the closed loop, free decays eliminated.

    Parameters
    ----------
    fit : LawFit
        Start.
    alongs : sequence of Along
        Runs on the lines to fit.
    free : sequence of Free
        Motion of the same runs under their force alone.
    loop : Loop
    names : sequence of str
        Values that move.
    turns : int
    tolerance : float
        Largest relative change at which it stops.
    """
    current, best_cost = fit, np.inf
    move = np.zeros(len(names))
    best = fit
    covariance = np.zeros((len(names), len(names)))
    errors = sum(2 * a.weighted.error.size for a in alongs)
    turn = 0
    for turn in range(turns + 1):
        variants = [current, *(replace(current, values=current.values | {n: current.values[n] * (1 + STEP_SHARE)}) for n in names)]
        cases = [(i, v) for v in variants for i in range(len(alongs))]
        s, _, _ = simulate_runs(loop, [free[i] for i, _ in cases], [[v for _, v in cases]])
        gram, right, cost = np.zeros((len(names),) * 2), np.zeros(len(names)), 0.0
        for i, along in enumerate(alongs):
            spectra = [coarse(along.run, s[0, k * len(alongs) + i]) for k in range(len(variants))]
            columns = np.stack([spectra[0], *((c - spectra[0]) / np.log1p(STEP_SHARE) for c in spectra[1:])])
            g, r, total = along.normal(columns)
            cost += total - 2 * float(r[0]) + float(g[0, 0])
            gram += g[1:, 1:]
            right += r[1:] - g[1:, 0]
        if not np.isfinite(cost):
            break
        if cost < best_cost:
            best, best_cost = current, cost
            covariance = np.linalg.pinv(gram) * cost * 2 / errors
            move = np.clip(np.linalg.lstsq(gram, right, rcond=1e-12)[0], -0.3, 0.3)
        else:
            # Went too far: half way back from the best.
            move = 0.5 * move
        if turn == turns or np.max(np.abs(move)) < tolerance:
            break
        current = replace(best, values=best.values | {n: best.values[n] * float(np.exp(m)) for n, m in zip(names, move, strict=True)})
    std = {n: float(best.values[n] * np.sqrt(max(covariance[k, k], 0))) for k, n in enumerate(names)}
    return Refitted(replace(best, cost=best_cost), std, best_cost, turn, bool(best_cost < np.inf))
