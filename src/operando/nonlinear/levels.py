"""At a level that was not measured: what level-dependent effects look like to a linear model under a random force of a given size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.data import ModalModel
from operando.dof import match_dofs, parse_dofs
from operando.effects import Effect
from operando.errors import DataError
from operando.nonlinear.equivalent import as_linear, slopes
from operando.nonlinear.run import Complex, Modes, Real
from operando.nonlinear.simulate import law_of

SAMPLES, OVER = 1 << 17, 6.0
"""Samples of the random motion that laws are averaged over, and its sampling rate over the top of the force's band: with few lines in a
resonance the motion is not Gaussian."""

WALKED = 1 << 15
"""The same where a law remembers: it is walked through sample by sample."""

TURNS, CLOSE = 120, 1e-3
MIX, SHORTEST = 0.5, 0.03
"""Turns at most, relative change at which they end, and how far a turn goes at first and at least."""

TOO_FAR, LEAP = 2.0, 20.0
"""Growth of the change at which turns become shorter, and how many turns the secant may go ahead."""


def at_level(
    idle: ModalModel, effects: Sequence[Effect], level: float, reference: Any, band: tuple[float, float] | None = None, seed: int = 0
) -> list[Effect]:
    """Springs and dampers that level-dependent effects are equivalent to under a random force of given rms at one DOF.

    Statistical linearisation (Caughey 1963): the law is averaged over a Gaussian motion with the spectrum that the linear model with these
    very springs and dampers has; found by repetition. Holds for laws that remember and for a user's own. Linear effects are returned as
    they are.

    Parameters
    ----------
    idle : ModalModel
        Of unit modal mass.
    effects : sequence of Effect
        Level-dependent ones, springs and dampers.
    level : float
        rms of the force [N], even over the band.
    reference : DOF
        Where the force acts.
    band : (float, float), optional
        Of the force [Hz]; default the idle model's.
    seed : int
        Of the phases of the motion.

    Returns
    -------
    list of Effect

    Raises
    ------
    DataError
        If the model has no scale, or no motion belongs to this level: a law that softens without end.
    ConfigError
        If an effect has no restoring force of displacement and velocity.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so a force in newtons makes no response of known size")
    if not level > 0:
        raise DataError(f"a force of {level:g} N moves nothing")
    low, high = band or idle.band_hz or (0.6 * float(np.min(idle.frequencies_hz)), 1.1 * float(np.max(idle.frequencies_hz)))
    modes = Modes.of(idle)
    free = modes.hz > 1e-3
    modes = modes.only(free)
    (row,), (sign,) = match_dofs(tuple(parse_dofs((reference,))), idle.dofs)
    pairs = [law_of(e, idle) for e in effects]
    if not pairs:
        return []
    modes = modes.only(~np.all([modes.spurious(b, low) for _, b in pairs], axis=0))
    laws, shapes = [law for law, _ in pairs], np.stack([modes.phi.T @ b for _, b in pairs])
    rate = OVER * high
    samples = WALKED if any(getattr(e.definition, "has_state", False) for e in effects) else SAMPLES
    hz = sfft.rfftfreq(samples, 1 / rate)
    inside = np.flatnonzero((hz >= low) & (hz <= high))
    w = 2 * np.pi * hz[inside]
    kernel = modes.receptance_kernel(hz[inside])
    across = np.einsum("pn,qn,nl->lpq", shapes, shapes, kernel)
    driven = np.einsum("pn,nl->lp", shapes, sign * modes.phi[row][:, None] * kernel)
    still = np.einsum("pn,qn,n->pq", shapes, shapes, 1 / (2 * np.pi * modes.hz) ** 2)
    phases = np.exp(2j * np.pi * np.random.default_rng(seed).uniform(size=inside.size))
    force = level * samples / np.sqrt(2 * inside.size) * phases
    level_dependent = np.array([e.definition.level_dependent for e in effects])
    k, c, mean = np.zeros((3, len(laws)))
    mix, last = MIX, np.inf
    before = (np.zeros((2, len(laws))), np.zeros((2, len(laws))))
    for turn in range(TURNS):
        x, v = _motion(across, driven * force[:, None], k, c, w, inside, samples)
        new = np.empty((2, len(laws)))
        away = np.empty(len(laws))
        for p, law in enumerate(laws):
            s = law.force(x[p] + mean[p], v[p], 1 / rate)
            away[p] = np.mean(s)
            new[:, p] = slopes(s, x[p], v[p])
        # The mean position: Newton's step with the springs as they are.
        off = mean + still @ away
        step = np.linalg.solve(np.eye(len(laws)) + still * np.maximum(new[0], 0), -off)
        # In units of force: a law without damping has none to settle.
        pace = np.stack([np.ones(len(laws)), v.std(axis=1) / np.maximum(x.std(axis=1), 1e-300)])
        change = np.abs(new - [k, c]) * pace / np.maximum(np.sum(np.abs(new) * pace, axis=0), 1e-300)
        settled = change.max() < CLOSE and np.all(np.abs(step) < CLOSE * x.std(axis=1))
        # The first turn has nothing to mix with; where turns go too far, shorter ones.
        if turn > 1 and change.max() > TOO_FAR * last:
            mix = max(0.6 * mix, SHORTEST)
        last = float(change.max())
        here = np.stack([k, c])
        ahead = new - here
        move = (1.0 if turn == 0 else mix) * ahead
        if turn > 1:
            # The secant through the last two turns (Anderson 1965, depth one): where each changes little, many would be needed.
            bend = ahead - before[1]
            along = float(np.sum(ahead * bend * pace**2) / max(np.sum((bend * pace) ** 2), 1e-300))
            move -= np.clip(along, -LEAP, 1.0) * (here - before[0] + mix * bend)
        before = here, ahead
        k, c = here + move
        mean = mean + (1.0 if turn == 0 else mix) * step
        if not (np.all(np.isfinite(k)) and np.all(np.isfinite(c))):
            break
        if settled:
            return [
                part
                for e, own_k, own_c, varies in zip(effects, k, c, level_dependent, strict=True)
                for part in (as_linear(e, own_k, own_c) if varies else [e])
            ]
    raise DataError(f"no steady motion was found at {level:g} N", hint="simulate it: operando.nonlinear.simulate with a force record")


def _motion(across: Complex, driven: Complex, k: Real, c: Real, w: Real, inside: Any, samples: int) -> tuple[Real, Real]:
    """Displacement and velocity across the places, (p, N), with springs and dampers there."""
    stiffness = k + 1j * w[:, None] * c
    x = np.linalg.solve(np.eye(k.size) + across * stiffness[:, None, :], driven[..., None])[..., 0]
    full = np.zeros((2, k.size, samples // 2 + 1), complex)
    full[0][:, inside] = x.T
    full[1][:, inside] = 1j * w * x.T
    both = sfft.irfft(full, samples, axis=-1)
    return both[0], both[1]
