"""Effects without a location: all stiffness, all damping, a mode missing in the idle model, and excitation that is no structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from operando.data import ModalModel
from operando.structure.effects.base import Array, EffectKind, Parameter, Values


def _scaled(covariance: Array | None, factors: Array) -> Array | None:
    return None if covariance is None else covariance * factors[:, None] * factors


class GlobalStiffness(EffectKind):
    """K times (1 + change); the viscous damping matrix stays, so that ζ falls as 1/√(1 + change)."""

    kind = "global_stiffness"
    plain = "all stiffness changed"
    says = "the whole structure is stiffer or softer than in the idle state ({size}), as by temperature or preload"
    confirms = "measure the idle state again while it is still at working temperature and load: all frequencies must lie as in operation"
    acts = "modal_change"
    places = 0
    parameters = (Parameter("change", "", -0.9, 5.0, "linear", 0.0, "relative change of all stiffness"),)
    moves = "frequencies"

    def modal_change(self, idle: ModalModel, values: Values) -> ModalModel:
        root = float(np.sqrt(1 + values["change"]))
        terms, n = idle.terms, idle.terms.n
        factors = np.r_[np.full(n, root), np.full(n, 1 / root), np.ones(idle.n_parameters - 2 * n)]
        return idle.with_terms(
            frequencies_hz=terms.frequencies_hz * root,
            damping_ratios=terms.damping_ratios / root,
            covariance=_scaled(idle.covariance, factors),
            coupling=None if idle.coupling is None else idle.coupling.scaled(1, 1 + values["change"]),
        )


class GlobalDamping(EffectKind):
    """C times (1 + change)."""

    kind = "global_damping"
    plain = "all damping changed"
    says = "the whole structure is damped more or less than in the idle state ({size})"
    confirms = "measure the idle state again at working temperature, and at half the level: a change with level is friction in joints"
    acts = "modal_change"
    places = 0
    parameters = (Parameter("change", "", -0.95, 20.0, "linear", 0.0, "relative change of all damping"),)
    moves = "damping"

    def modal_change(self, idle: ModalModel, values: Values) -> ModalModel:
        n = idle.terms.n
        factors = np.r_[np.ones(n), np.full(n, 1 + values["change"]), np.ones(idle.n_parameters - 2 * n)]
        more = 1 + values["change"]
        coupling = None if idle.coupling is None else idle.coupling.scaled(more, 1)
        damping = idle.terms.damping_ratios * more
        return idle.with_terms(damping_ratios=damping, covariance=_scaled(idle.covariance, factors), coupling=coupling)


class MissingMode(EffectKind):
    """A mode missing in the idle model, put behind its modes (before its residual terms) with the shape of the effect.

    Its frequency and damping ratio are those in operation: no change of the whole moves it.
    """

    kind = "missing_mode"
    plain = "a mode missing in the idle model"
    says = "a mode is missing in the idle model ({size})"
    confirms = (
        "excite the idle structure at another point, where the mode near {values[frequency]:.4g} Hz can be driven, "
        "and identify the idle model again"
    )
    group = "idle"
    acts = "added_mode"
    places = 0
    parameters = (
        Parameter("frequency", "Hz", None, None, "log", None, "natural frequency"),
        Parameter("damping_ratio", "", 1e-5, 0.3, "log", 0.01, "damping ratio"),
    )

    def added_mode(self, idle: ModalModel, values: Values, shape: Array) -> ModalModel:
        n, at, m = idle.terms.n, idle.n_modes, len(idle.dofs)
        covariance = idle.covariance
        if covariance is not None:
            # The new mode's own uncertainty comes with the effect's values, not with the idle model.
            old = np.r_[:at, at + 1 : n + 1]
            where = np.r_[old, old + n + 1, (2 * (n + 1) + old[:, None] * m + np.arange(m)).ravel()]
            grown = np.zeros(((n + 1) * (2 + m),) * 2)
            grown[np.ix_(where, where)] = covariance
            covariance = grown
        return replace(
            idle,
            frequencies_hz=np.r_[idle.frequencies_hz, float(values["frequency"])],
            damping_ratios=np.r_[idle.damping_ratios, float(values["damping_ratio"])],
            shapes=np.c_[idle.shapes, np.asarray(shape, float)],
            in_band=np.r_[np.asarray(idle.in_band), True],
            covariance=covariance,
            std=None,
            coupling=None if idle.coupling is None else idle.coupling.with_term(at),
        )


class HarmonicExcitation(EffectKind):
    """Narrow lines of the excitation; the structure is not touched."""

    kind = "harmonic_excitation"
    plain = "harmonics of the running machine"
    confirms = "change the speed: these lines move with it, natural frequencies do not"
    group = "excitation"
    acts = "excitation"
    places = 0
    parameters = ()
    constants = (Parameter("frequencies", "Hz", 0.0, 1e6, "linear", 0.0, "lines of the excitation"),)
    moves = "nothing"

    def explain(self, place: str, size: str, removed: bool = False) -> str:
        return f"the machine itself excites at {size or 'lines of its own'}: excitation, not structure"


KINDS = (GlobalStiffness, GlobalDamping, MissingMode, HarmonicExcitation)
