"""Laws in the closed loop: the model with its laws makes the motion itself, only the measured force and a first state come from the record.

Stops make a lightly damped structure forget its state: two histories that differ by 1e-4 of the force part within seconds. A whole record
cannot be followed then, however right the model. So the loop is closed over windows, each from the state that the reverse path
gives at its beginning; all windows of all records run side by side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft as sfft
from scipy.optimize import nnls

from operando.effects import kind_of
from operando.errors import DataError
from operando.nonlinear.laws import LawFit, law_force
from operando.nonlinear.loop import FrictionLaw, Loop, MemoryLaw, SlipLaw, StepLaw, run_loop
from operando.nonlinear.outside import DAMPING, FACTORS, Outside
from operando.nonlinear.run import Complex, Modes, Real, Run, decay_in_time

PER_CYCLE, STICK_PER_CYCLE = 8.0, 48.0
"""Steps in a period of the highest frequency compared, at least; with dry friction."""

SHARE, FINEST = 0.8, 100
"""Part of a radian that a body moves on the steepest part of a law in a step, at most; steps a sample, at most."""


@dataclass(frozen=True)
class Track:
    """What a run needs to be followed from any of its samples.

    Parameters
    ----------
    n_samples : int
    sampling_hz : float
    loop : Loop
    fine : int
        Steps a sample.
    x, v : (p, N·fine) arrays
        Motion across the places under the measured force alone, periodic over the record.
    q, dq : (n, N) arrays
        Modal displacements and velocities that the restoring forces and the state at the beginning add.
    memory : (p, N) array
        Internal state of laws that remember.
    """

    n_samples: int
    sampling_hz: float
    loop: Loop
    fine: int
    x: Real
    v: Real
    q: Real
    dq: Real
    memory: Real


def fineness(top_hz: float, sampling_hz: float, steepest: float = 0.0, sticks: bool = False) -> int:
    """Steps a sample for lines up to ``top_hz`` and laws as steep as ``steepest`` [rad/s]: the frequency a body would have on them alone.

    With dry friction that ``sticks`` the step that takes hold is solved for, so its kinks alone ask for shorter ones.

    Raises
    ------
    DataError
        If it would take too many.
    """
    per_cycle = STICK_PER_CYCLE if sticks else PER_CYCLE
    fine = max(1, int(np.ceil(per_cycle * top_hz / sampling_hz)), int(np.ceil(steepest / (SHARE * sampling_hz))))
    if fine > FINEST:
        raise DataError(
            f"so stiff a force law takes {fine} steps a sample to be simulated", hint="give the force at a higher sampling rate"
        )
    return fine


def sticks(laws: Iterable[LawFit]) -> bool:
    """Whether there is dry friction among laws."""
    return any(law.kind == "coulomb_friction" for law in laws)


def steepness(law: LawFit, shape: Real, reach: float) -> float:
    """√(k·Σφ²) [rad/s] of a law's greatest slope k within a reach [m] at a place with shape values φ."""
    x = np.linspace(-reach, reach, 201)
    if kind_of(law.kind).acts != "pseudo_force":
        slope = abs(law.values.get("stiffness", 0.0))
    elif law.kind == "hysteresis":
        slope = law.values["stiffness"]
    else:
        slope = float(np.max(np.abs(np.diff(law.force(x, np.zeros_like(x), 1.0)) / (x[1] - x[0])), initial=0.0))
    return float(np.sqrt(slope * np.sum(shape**2)))


def loop_of(
    modes: Modes, bs: Sequence[Real], outside: Sequence[Outside | None], run: Run, step: float, spurious: NDArray[np.bool_]
) -> Loop:
    """Response across the places to forces along them; for one place with what lies outside the band made passive.

    Parameters
    ----------
    modes : Modes
    bs : sequence of (m,) arrays
    outside : sequence of Outside or None
        Corrections, used where there is one place.
    run : Run
        For its lines.
    step : float
        [s].
    spurious : (n,) bool array
        Modes that say nothing below the band; for one place what they add in the band counts among what lies outside.
    """
    shapes = np.stack([modes.phi.T @ b for b in bs])
    poles = modes.poles
    keep = modes.hz > 1e-3
    poles, shapes = poles[keep], shapes[:, keep]
    if len(bs) == 1 and outside[0] is not None:
        top = outside[0].top_hz
        hz = run.hz[:: max(1, run.hz.size // 200)]
        above = (modes.hz[keep] > max(top, modes.known_hz)) | spurious[keep]
        extra_hz = np.array(FACTORS) * max(top, modes.known_hz)
        extra = Modes(extra_hz, np.full(extra_hz.size, DAMPING), np.zeros((1, extra_hz.size)))
        wanted = (shapes[0, above] ** 2) @ modes.receptance_kernel(hz)[keep][above] + outside[0].compliance(hz, bs[0])
        table = extra.receptance_kernel(hz).real.T
        scale = np.max(np.abs(table))
        weights, _ = nnls(table / scale, wanted.real / scale)
        poles = np.concatenate([poles[~above], extra.poles])
        shapes = np.concatenate([shapes[:, ~above], np.sqrt(weights)[None]], axis=1)
    else:
        poles, shapes = poles[~spurious[keep]], shapes[:, ~spurious[keep]]
    return Loop(poles, shapes, step)


def track(run: Run, modes: Modes, loop: Loop, base: Complex, places: Sequence[tuple[Real, Complex, Real]], amplitudes: Real) -> Track:
    """A run ready to be followed.

    Parameters
    ----------
    run : Run
    modes : Modes
    loop : Loop
    base : (p, N//2+1) complex array
        Displacement across the places under the measured force.
    places : sequence of (b, spectrum, memory)
        Restoring force on all lines, and internal state of its law at each sample, for each place.
    amplitudes : (J,) array
        Of the free decays.
    """
    fine = round(1 / (run.sampling_hz * loop.step))
    n, hz = run.n_samples, run.all_hz
    w = 2 * np.pi * hz
    spectra = np.zeros((2, len(places), n * fine // 2 + 1), complex)
    spectra[0, :, : hz.size] = base * fine
    spectra[1, :, : hz.size] = spectra[0, :, : hz.size] * 1j * w
    x, v = sfft.irfft(spectra, n * fine, axis=-1)
    force = np.stack([s for _, s, _ in places])
    poles = loop.poles
    # Modes above the sampling rate follow the force: their state matters as much.
    modal = np.zeros((2, poles.size, hz.size), complex)
    modal[0] = -(loop.shapes.T @ force) / (np.abs(poles[:, None]) ** 2 - w**2 - 2j * poles.real[:, None] * w)
    modal[1] = modal[0] * 1j * w
    q, dq = sfft.irfft(modal, n, axis=-1)
    ringing = modes.ringing(run.sampling_hz)
    own = modes.poles[ringing]
    weights = (amplitudes[: ringing.size] + 1j * amplitudes[ringing.size :]) / own**2
    decays = decay_in_time(own, np.stack([weights, weights * own]), n, 1 / run.sampling_hz, apart=True)
    for k, pole in enumerate(own):
        same = np.flatnonzero(np.abs(poles - pole) < 1e-9 * abs(pole))
        if same.size:
            q[same[0]] += decays[0, k]
            dq[same[0]] += decays[1, k]
    return Track(n, run.sampling_hz, loop, fine, x, v, q, dq, np.stack([z for _, _, z in places]))


def windows(t: Track, seconds: float) -> tuple[Real, Real, Real]:
    """Motion across the places without restoring forces in each window, (p, windows, W) twice, and the laws' memories (p, windows)."""
    size = min(max(8, round(seconds * t.sampling_hz)), t.n_samples)
    starts = np.arange(0, t.n_samples, size)
    index = np.minimum(starts[:, None] * t.fine + np.arange(size * t.fine + 1), t.x.shape[1] - 1)
    poles = t.loop.poles
    q, dq = t.q[:, starts], t.dq[:, starts]
    c = q / 2 + 1j * (poles.real[:, None] * q - dq) / (2 * poles.imag[:, None])
    ring = np.exp(poles[:, None] * t.loop.step * np.arange(size * t.fine + 1))
    decays = 2 * np.real(np.einsum("pn,nw,nk->pwk", t.loop.shapes, c, ring, optimize=True))
    moving = 2 * np.real(np.einsum("pn,nw,nk->pwk", t.loop.shapes, c * poles[:, None], ring, optimize=True))
    return t.x[:, index] + decays, t.v[:, index] + moving, t.memory[:, starts]


def step_law(fits: Sequence[LawFit], step: float, memory: Real) -> StepLaw:
    """One law with values of its own for each case."""
    first = fits[0]
    kind, side = kind_of(first.kind), first.side
    values = {name: np.array([f.values[name] for f in fits]) for name in first.values}
    if first.kind == "hysteresis":
        slope = kind._slope  # type: ignore[attr-defined]
        return MemoryLaw(values["stiffness"], values["yield_force"], values["exponent"], values["ratio"], slope, memory)
    if first.kind == "coulomb_friction":
        level, speed = values["force"], values.get("slip_speed", np.zeros(len(fits)))
        if np.all(speed <= 0):
            return FrictionLaw(level)
        if np.all(speed > 0):
            return SlipLaw(level, speed)
        return StepLaw(lambda x, v: level * np.tanh(v / speed))
    return StepLaw(lambda x, v: side * law_force(kind, side * x, side * v, values, step))


def follow(tracks: Sequence[Track], laws: Sequence[Sequence[LawFit]], seconds: float) -> list[list[Real]]:
    """Restoring forces that the closed loop makes over windows, put together.

    Parameters
    ----------
    tracks : sequence of Track
        Runs of one sampling rate.
    laws : sequence of sequences of LawFit
        Variants; each holds one law a place.
    seconds : float
        Length of a window; infinite follows each run as a whole.

    Returns
    -------
    list of list of (p, N·fine) arrays
        One a variant and run.
    """
    seconds = min(seconds, max(t.n_samples / t.sampling_hz for t in tracks))
    parts = [windows(t, seconds) for t in tracks]
    longest = max(p[0].shape[2] for p in parts)
    pad = lambda a: np.pad(a, ((0, 0), (0, 0), (0, longest - a.shape[2])), mode="edge")  # noqa: E731
    x = np.concatenate([pad(p[0]) for p in parts], axis=1)
    v = np.concatenate([pad(p[1]) for p in parts], axis=1)
    memory = np.concatenate([p[2] for p in parts], axis=1)
    count, many = x.shape[1], len(laws)
    loop = tracks[0].loop
    made = [step_law([law[p] for law in laws for _ in range(count)], loop.step, np.tile(memory[p], many)) for p in range(len(x))]
    s, _, _ = run_loop(loop, np.tile(x, (1, many, 1)), np.tile(v, (1, many, 1)), made)
    out: list[list[Real]] = []
    for k in range(many):
        rows, at = [], k * count
        for t, part in zip(tracks, parts, strict=True):
            w, size = part[0].shape[1], part[0].shape[2] - 1
            rows.append(s[:, at : at + w, :size].reshape(len(x), -1)[:, : t.n_samples * t.fine])
            at += w
        out.append(rows)
    return out


def on_lines(run: Run, fine: int, force: Real) -> Complex:
    """Spectrum on the run's lines of a force on the fine grid, (..., L)."""
    return np.asarray(sfft.rfft(force, axis=-1)[..., run.lines] / fine)
