"""What a law makes in the closed loop, in place of what the motion seen gives.

Where dry friction sticks, the velocity is a small part of v₀ and the force anything up to F: the motion seen, however little noise it
has, does not say what the force is, and what lies beyond the recorded band counts as much. In the loop the force is what holds the place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import fft as sfft

from operando.nonlinear.closed import follow, track
from operando.nonlinear.hold_out import GOOD
from operando.nonlinear.laws import LawFit, law_cost
from operando.nonlinear.loop import Loop
from operando.nonlinear.polish import EASY, bounded, free_names, linearised
from operando.nonlinear.run import Complex, Real
from operando.nonlinear.search import Case, Spot, moving
from operando.nonlinear.simulate import loop_for
from operando.nonlinear.steps import Tried
from operando.threads import each

KINDS = ("coulomb_friction",)
"""Kinds whose force the motion seen does not give."""

WINDOW = 0.5
"""Length of the windows that run side by side [s]; each begins with the state that the force found so far gives."""

MOST = 12_000_000
"""Steps of all windows followed at once: some hundred megabytes."""

TURNS, ENOUGH, FARTHEST = 6, 0.02, 0.3
"""Turns of force and values at most; fall of the misfit that is worth another; relative change of the size in one turn, at most."""


def by_loop(case: Case, tried: Tried, fitted: bool = True) -> Tried:
    """A law with the force that it makes in the closed loop, its size fitted with it; as it was where that is worse than noise.

    The speed over which friction is smoothed stays: where it sticks the loop hardly depends on it, and errors of the model would move it.

    Below the last line of the band the place moves as model and force have it, above as measured. The loop's own response differs from
    that, so the difference times the force found so far goes with the free motion; turns bring the two forces together.

    Parameters
    ----------
    case : Case
    tried : Tried
        Accepted, its values near.
    fitted : bool
        False leaves its values as they are.
    """
    law, spot = tried.law, tried.spot
    names = free_names(law)
    runs = [*case.fitted, *case.validation]
    if law.kind not in KINDS or len(names) < len(law.values) or len({r.sampling_hz for r in runs}) > 1:
        return tried
    loop = recorded(loop_for(case, [tried]), runs[0].sampling_hz)
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
            (select, n), (validation, k) = law_cost(law, spot.select), law_cost(law, spot.validation)
            best, least = Tried(spot, law, select / n, validation / k), cost
        if not fallen:
            break
        step = float(np.clip(right[0] / max(gram[0, 0], 1e-300), -FARTHEST, FARTHEST))
        forces = [m.spectrum(law) for m in spot.whole]
        if fitted:
            law = bounded(replace(law, values=law.values | {names[0]: law.values[names[0]] * float(np.exp(step))}))
    before, count = law_cost(tried.law, tried.spot.select)
    return best if best.selection < max(before / count, GOOD) else tried


def followed(case: Case, spot: Spot, law: LawFit, names: Sequence[str], forces: Sequence[Complex], loop: Loop) -> Spot:
    """The spot with the force that the law, and the law with each of its values a little larger, make in the loop.

    Parameters
    ----------
    case : Case
    spot : Spot
    law : LawFit
    names : sequence of str
        Values moved.
    forces : sequence of (N//2+1,) arrays
        Restoring force found so far on all lines of each run.
    loop : Loop
    """
    fine = round(1 / (case.fitted[0].sampling_hz * loop.step))
    tracks = []
    for m, force in zip(spot.whole, forces, strict=True):
        run, crossing = m.along.run, m.crossing
        base = crossing.base + (response(loop, run.all_hz) - crossing.compliance) * force
        _, amplitudes, _ = m.along.free_force(0.0, force[run.lines])
        tracks.append(track(run, case.modes, loop, base[None], [(spot.b, force, np.zeros(run.n_samples))], amplitudes))
    variants = [law, *(replace(law, values=law.values | {n: law.values[n] * (1 + EASY)}) for n in names)]
    made: list[list[Real]] = [[] for _ in variants]
    for together in groups([t.n_samples * t.fine * len(variants) for t in tracks]):
        for rows, more in zip(made, follow([tracks[i] for i in together], [[v] for v in variants], WINDOW), strict=True):
            rows += more

    def moved(number: int) -> tuple[Real, Real, dict]:
        m = spot.whole[number]
        spectra = [on_record(rows[number][0], m.crossing.base.size, fine) for rows in made]
        x, v = m.crossing.move(spectra[0])
        return x, v, {one.key: s for one, s in zip(variants, spectra, strict=True)}

    motions = each(moved, range(len(tracks)))
    return moving(spot, case, [replace(m, x=x, v=v, made={}, closed=c) for m, (x, v, c) in zip(spot.whole, motions, strict=True)])


def groups(sizes: Sequence[int]) -> list[list[int]]:
    """Neighbours taken together up to the most that is to be in memory, one at least."""
    out: list[list[int]] = []
    left = 0
    for i, size in enumerate(sizes):
        if not out or size > left:
            out.append([])
            left = MOST
        out[-1].append(i)
        left -= size
    return out


def recorded(loop: Loop, sampling_hz: float) -> Loop:
    """A loop without modes that the record cannot show: what stands for them in the band makes friction answer too soon."""
    keep = np.abs(loop.poles) < np.pi * sampling_hz
    return Loop(loop.poles[keep], loop.shapes[:, keep], loop.step)


def response(loop: Loop, hz: Real) -> Complex:
    """Receptance of a loop across its one place, (L,)."""
    w = 2 * np.pi * hz
    poles = loop.poles[:, None]
    return np.asarray(loop.shapes[0] ** 2 @ (1 / (np.abs(poles) ** 2 - w**2 - 2j * poles.real * w)))


def on_record(force: Real, count: int, fine: int) -> Complex:
    """Spectrum on the ``count`` lines of a record of a force on a grid ``fine`` times as fine."""
    return np.asarray(sfft.rfft(force)[:count] / fine)
