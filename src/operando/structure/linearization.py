"""What level-dependent effects look like to a linear model: the springs and dampers they are equivalent to at a level of the force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from scipy import fft as sfft

from operando.data import ModalModel, one_level
from operando.dof import Dof, match_dofs, parse_dofs
from operando.errors import DataError
from operando.structure.added_mass import with_masses
from operando.structure.effects import Effect
from operando.structure.force_law import law_of
from operando.structure.modal_space import Complex, Modes, Real

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


def slopes(s: Real, x: Real, v: Real) -> tuple[float, float]:
    """Stiffness k and damping c of the line s = k·x + c·v nearest to a restoring force in the mean square; means do not count.

    Statistical linearisation (Caughey 1963), with the motion as it is instead of a Gaussian one.
    """
    s, x, v = (a - np.mean(a) for a in (s, x, v))
    gram = np.array([[x @ x, x @ v], [x @ v, v @ v]])
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    k, c = np.linalg.solve(gram / np.outer(scale, scale) + 1e-12 * np.eye(2), np.array([x @ s, v @ s]) / scale) / scale
    return float(k), float(c)


@dataclass(frozen=True)
class LinearEquivalent:
    """Spring and damper that a level-dependent effect is equivalent to under one force.

    Parameters
    ----------
    level : float
        rms of the force [N].
    displacement, velocity : float
        rms across the place [m, m/s].
    stiffness, damping : float
        [N/m, N·s/m].
    explains : float
        Share of the restoring force that they explain.
    references : tuple of str
        DOFs where the force acted; empty where that is not known.
    """

    level: float
    displacement: float
    velocity: float
    stiffness: float
    damping: float
    explains: float
    references: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON object, with the unit of the level."""
        values = {n: v for n, v in asdict(self).items() if n not in ("level", "references")}
        return {"level": self.level, "unit": "N", "references": list(self.references)} | values

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LinearEquivalent:
        """Of what :meth:`to_dict` made."""
        values = {f.name: float(data[f.name]) for f in fields(cls) if f.name != "references"}
        return cls(**values, references=tuple(data.get("references") or ()))

    def at(self, level: float, reference: Dof) -> bool:
        """Whether it is that of a record with a force of this level at this DOF alone."""
        return one_level(self.level, level) and len(self.references) == 1 and Dof.parse(self.references[0]).same_axis(reference)


def linear_effects(effect: Effect, equivalents: Sequence[LinearEquivalent]) -> list[Effect]:
    """Spring and damper at the place of a level-dependent effect: the mean of its equivalents in the records of the lowest level.

    Parameters
    ----------
    effect : Effect
    equivalents : sequence of LinearEquivalent
        One a record.
    """
    lowest = min(r.level for r in equivalents)
    same = [r for r in equivalents if one_level(r.level, lowest)]
    return as_linear(effect, float(np.mean([r.stiffness for r in same])), float(np.mean([r.damping for r in same])))


def as_linear(effect: Effect, stiffness: float, damping: float) -> list[Effect]:
    """Spring and damper of these sizes at the place of an effect; a negative one is taken away."""
    name = "coupling" if len(effect.location) == 2 else "ground"
    sizes = {f"{name}_spring": ("stiffness", stiffness), f"{name}_damper": ("damping", damping)}
    return [Effect(kind, effect.location, {p: abs(float(v))}, removed=v < 0) for kind, (p, v) in sizes.items() if v != 0]


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
        Level-dependent ones, springs, dampers and point masses.
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
        If the model has no scale, no motion belongs to this level (a law that softens without end), or a mass cannot be taken away.
    ConfigError
        If an effect has no restoring force of displacement and velocity.
    """
    if idle.scaling != "unit_modal_mass" or not idle.si:
        raise DataError("the idle model has no scale, so a force in newtons makes no response of known size")
    if not level > 0:
        raise DataError(f"a force of {level:g} N moves nothing")
    low, high = band or idle.band_hz or (0.6 * float(np.min(idle.frequencies_hz)), 1.1 * float(np.max(idle.frequencies_hz)))
    idle, acting = with_masses(idle, effects)
    modes = Modes.of(idle).free()
    (row,), (sign,) = match_dofs(tuple(parse_dofs((reference,))), idle.dofs)
    pairs = [law_of(e, idle) for e in acting]
    if not pairs:
        return list(effects)
    modes = modes.only(~np.all([modes.spurious(b, low) for _, b in pairs], axis=0))
    laws, shapes = [law for law, _ in pairs], np.stack([modes.phi.T @ b for _, b in pairs])
    rate = OVER * high
    samples = WALKED if any(law.remembers for law in laws) else SAMPLES
    hz = sfft.rfftfreq(samples, 1 / rate)
    inside = np.flatnonzero((hz >= low) & (hz <= high))
    w = 2 * np.pi * hz[inside]
    kernel = modes.receptance_kernel(hz[inside])
    across = np.einsum("pn,qn,nl->lpq", shapes, shapes, kernel)
    driven = np.einsum("pn,nl->lp", shapes, sign * modes.phi[row][:, None] * kernel)
    still = np.einsum("pn,qn,n->pq", shapes, shapes, 1 / (2 * np.pi * modes.hz) ** 2)
    phases = np.exp(2j * np.pi * np.random.default_rng(seed).uniform(size=inside.size))
    force = level * samples / np.sqrt(2 * inside.size) * phases
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
        converged = change.max() < CLOSE and np.all(np.abs(step) < CLOSE * x.std(axis=1))
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
        if converged:
            own = {id(e): sizes for e, *sizes in zip(acting, k, c, strict=True)}
            return [part for e in effects for part in (as_linear(e, *own[id(e)]) if e.definition.level_dependent else [e])]
    raise DataError(f"no steady motion was found at {level:g} N", hint="simulate it: operando.structure.simulate with a force record")


def _motion(across: Complex, driven: Complex, k: Real, c: Real, w: Real, inside: Any, samples: int) -> tuple[Real, Real]:
    """Displacement and velocity across the places, (p, N), with springs and dampers there."""
    stiffness = k + 1j * w[:, None] * c
    x = np.linalg.solve(np.eye(k.size) + across * stiffness[:, None, :], driven[..., None])[..., 0]
    full = np.zeros((2, k.size, samples // 2 + 1), complex)
    full[0][:, inside] = x.T
    full[1][:, inside] = 1j * w * x.T
    both = sfft.irfft(full, samples, axis=-1)
    return both[0], both[1]
